"""What nobody knows of a real film: its parameters, and how they spread about what a sensor's file says.

Film, coefficients, gains and the place of the electrodes are known to some percent or tenths of a millimetre before
anything is measured; the pretension is hardly known at all. A calibration starts from this spread, a virtual film is a
draw from it, and a network for all films is trained over it.

Parameters are deviations from the sensor's file, so that zero is the film as described, but for the pretension, which
is the pretension itself:

    pretension                     MPa
    young, thickness, d31, d32     ln(value / described value), dimensionless
    shift_x, shift_y, rotation     of the electrodes, added to the described ones, mm and rad
    probe_radius                   added to the described radius, mm
    gain A, gain B, ...            ln(gain / described gain), dimensionless, by electrode
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Sensor

SHARED = ("pretension", "young", "thickness", "d31", "d32", "shift_x", "shift_y", "rotation", "probe_radius")
"""Parameters that every film has; gains follow, one for each electrode."""

REACH = 2.5
"""Largest deviation that a film or a calibration may have, in standard deviations; the pretension ends at `TAUTEST`."""

TAUTEST = 4.0 / 3.0
"""Largest pretension that a calibration may find, over the largest of the spread."""

PROBES = (0.5, 1.5)
"""Smallest and largest radius of a probe that a calibration may find, over the described one."""


@dataclass(frozen=True)
class FilmSpread:
    """How far films spread: the largest pretension, and one standard deviation of everything else.

    Attributes:
        pretension: Largest pretension, MPa; all from none to this are equally likely.
        young: Of the logarithm of Young's modulus, dimensionless, as those of thickness, d31, d32 and gain.
        thickness: As above.
        d31: As above.
        d32: As above.
        shift: Displacement of the electrodes along x and along y, mm.
        rotation: Rotation of the electrodes, rad.
        probe_radius: mm.
        gain: Of every electrode's gain, each by itself.
    """

    pretension: float = 3.0
    young: float = 0.2
    thickness: float = 0.05
    d31: float = 0.2
    d32: float = 0.2
    shift: float = 0.3
    rotation: float = float(np.deg2rad(2.0))
    probe_radius: float = 0.3
    gain: float = 0.05

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value > 0.0):
                raise SceneError(f"spread of {field.name}: expected a positive number, got {value}")


@dataclass(frozen=True)
class FilmPrior:
    """The films that a described sensor may be, under a probe whose radius is not exactly known either.

    Attributes:
        sensor: The sensor as described.
        probe: The probe as described; round, since its radius is one of the parameters.
        spread: How far the films spread.
    """

    sensor: Sensor
    probe: Circle
    spread: FilmSpread = FilmSpread()

    def __post_init__(self) -> None:
        sensor, most = self.sensor, float(np.hypot(REACH, REACH)) * self.spread.shift
        for electrode in sensor.electrodes:
            reach = np.linalg.norm(sensor.calibration.place(np.concatenate(electrode.parts)), axis=1).max()
            if not reach + most < sensor.film.radius:
                raise SensorError(
                    f"electrode {electrode.name!r} reaches {reach:.4g} mm from the centre, and electrodes may be "
                    f"{most:.3g} mm off their place: expected {sensor.film.radius - most:.4g} mm at most, or it lies "
                    "over the rim of some films; move it inwards"
                )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in their order."""
        return (*SHARED, *(f"gain {name}" for name in self.sensor.electrode_names))

    @cached_property
    def mean(self) -> Array:
        """Means of the parameters, shape (n_parameter,): the film as described, half of the largest pretension."""
        mean = np.zeros(len(self.names))
        mean[0] = 0.5 * self.spread.pretension
        return mean

    @cached_property
    def std(self) -> Array:
        """Standard deviations of the parameters, shape (n_parameter,)."""
        spread, count = self.spread, len(self.sensor.electrodes)
        shared = [spread.pretension / np.sqrt(12.0), spread.young, spread.thickness, spread.d31, spread.d32]
        placed = [spread.shift, spread.shift, spread.rotation, min(spread.probe_radius, 0.3 * self.probe.radius)]
        return np.array([*shared, *placed, *[spread.gain] * count])

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Smallest and largest parameters that a film or a calibration may have, each of shape (n_parameter,)."""
        low, high = self.mean - REACH * self.std, self.mean + REACH * self.std
        low[0], high[0] = 0.0, TAUTEST * self.spread.pretension
        radius = self.names.index("probe_radius")
        low[radius] = max(low[radius], (PROBES[0] - 1.0) * self.probe.radius)
        high[radius] = min(high[radius], (PROBES[1] - 1.0) * self.probe.radius)
        return low, high

    @property
    def described(self) -> Array:
        """The parameters of the film exactly as described, shape (n_parameter,)."""
        return self.parameters_of(self.sensor, self.probe)

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Films drawn from the spread, shape (count, n_parameter); deviations beyond the bounds are drawn again."""
        drawn = self.mean + self.std * rng.standard_normal((count, len(self.names)))
        while (outside := (drawn < self.bounds[0]) | (drawn > self.bounds[1])).any():
            again = self.mean + self.std * rng.standard_normal(drawn.shape)
            drawn = np.where(outside, again, drawn)
        drawn[:, 0] = self.spread.pretension * rng.random(count)
        return drawn

    def film(self, parameters: Array) -> tuple[Sensor, Circle]:
        """The sensor and the probe that parameters, shape (n_parameter,), describe.

        Raises:
            SensorError: If there can be no such sensor: electrodes moved off the film, or a negative pretension.
        """
        values = dict(zip(self.names, parameters.tolist(), strict=True))
        factors = dict(zip(self.names, np.exp(parameters).tolist(), strict=True))
        film, piezo, before = self.sensor.film, self.sensor.piezo, self.sensor.calibration
        shift = (before.shift[0] + values["shift_x"], before.shift[1] + values["shift_y"])
        gains = {name: before.gain.get(name, 1.0) * factors[f"gain {name}"] for name in self.sensor.electrode_names}
        sensor = replace(
            self.sensor,
            film=replace(
                film,
                young=film.young * factors["young"],
                thickness=film.thickness * factors["thickness"],
                pretension=values["pretension"],
            ),
            piezo=replace(piezo, d31=piezo.d31 * factors["d31"], d32=piezo.d32 * factors["d32"]),
            calibration=replace(before, gain=gains, shift=shift, rotation=before.rotation + values["rotation"]),
        )
        return sensor, Circle(self.probe.radius + values["probe_radius"])

    def parameters_of(self, sensor: Sensor, probe: Circle) -> Array:
        """The parameters of a sensor that differs from the described one by them alone: the inverse of `film`.

        Raises:
            SensorError: If it differs otherwise: other electrodes, another radius, another readout.
        """
        described = self.sensor
        if _shapes(sensor) != _shapes(described):
            raise SensorError(
                f"{sensor.name}: expected the electrodes of {described.name} ({_centres(described)}), got others "
                f"({_centres(sensor)})"
            )
        for what, value, expected in (
            ("readout", (sensor.readout, sensor.surface), (described.readout, described.surface)),
            ("film radius (mm)", round(sensor.film.radius, 6), round(described.film.radius, 6)),
            ("film poisson", round(sensor.film.poisson, 9), round(described.film.poisson, 9)),
            ("d33 (pC/N)", sensor.piezo.d33, described.piezo.d33),
            ("d12 (pC/N)", sensor.piezo.d12, described.piezo.d12),
            ("crosstalk", sensor.calibration.crosstalk, described.calibration.crosstalk),
            ("what is not alike all round the film", sensor.film.around, described.film.around),
        ):
            if value != expected:
                raise SensorError(f"{sensor.name}: {what}: expected those of {described.name}, {expected}, got {value}")
        film, piezo, calibration = sensor.film, sensor.piezo, sensor.calibration
        before = described.calibration
        logs = {
            "young": film.young / described.film.young,
            "thickness": film.thickness / described.film.thickness,
            "d31": _ratio(piezo.d31, described.piezo.d31),
            "d32": _ratio(piezo.d32, described.piezo.d32),
            **{
                f"gain {name}": calibration.gain.get(name, 1.0) / before.gain.get(name, 1.0)
                for name in sensor.electrode_names
            },
        }
        if min(logs.values()) <= 0.0:
            raise SensorError(f"{sensor.name}: d31 and d32: expected the signs of {described.name}")
        differences = {
            "pretension": film.pretension,
            "shift_x": calibration.shift[0] - before.shift[0],
            "shift_y": calibration.shift[1] - before.shift[1],
            "rotation": calibration.rotation - before.rotation,
            "probe_radius": probe.radius - self.probe.radius,
            **{name: float(np.log(ratio)) for name, ratio in logs.items()},
        }
        return np.array([differences[name] for name in self.names])


def _shapes(sensor: Sensor) -> dict[str, list[tuple[float, float]]]:
    """Corners of what collects as described, mm, rounded to a nanometre."""
    return {e.name: [(round(x, 6), round(y, 6)) for part in e.parts for x, y in part] for e in sensor.electrodes}


def _centres(sensor: Sensor) -> str:
    places = [(e.name, *e.centre) for e in sensor.electrodes]
    return ", ".join(f"{name} at ({x:.4g}, {y:.4g})" for name, x, y in places[:8]) + " mm" + ", ..." * (len(places) > 8)


def _ratio(value: float, described: float) -> float:
    return 1.0 if value == described == 0.0 else value / described if described else 0.0


def virtual_film(sensor: Sensor, probe: Circle, seed: int) -> tuple[Sensor, Circle]:
    """A film drawn from the spread about a sensor and a probe."""
    prior = FilmPrior(sensor, probe)
    return prior.film(prior.draw(np.random.default_rng(seed), 1)[0])
