"""The unknown parameters of a real film, and how they spread about what a sensor's file says.

Film, coefficients, gains and the place of the electrodes are known to some percent or tenths of a millimetre before
anything is measured; the pretension is hardly known at all. A calibration starts from this spread, a virtual film is a
draw from it, and a network for all films is trained over it.

`PARAMETERS` declares each parameter once; the gains of the electrodes follow it, one for each electrode. Parameters are
deviations from the sensor's file, so that zero is the film as described. Only the pretension is the pretension itself.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Sensor

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


Components = Mapping[str, Any]
"""What parameters change: the `film`, `piezo` and `calibration` of a sensor, and the `probe`."""


@dataclass(frozen=True)
class FilmParameter:
    """Declaration of one unknown parameter of a film.

    Attributes:
        name: Name of the parameter.
        unit: Unit of the parameter.
        component: Which of `Components` it changes.
        attribute: The attribute of the component.
        form: "logarithm" for ln(value / described value), "difference" for value - described value, "value" for the
            value itself.
        spread: The field of `FilmSpread` with its standard deviation.
        derivative: How the derivative of the charges is computed: by a "difference" of films, or by "scaling", from the
            dimensionless groups.
        item: Index or key of the value, where the attribute is a tuple or a table.
        file_factor: Factor from its unit to the unit in files of calibrations, which is Pa or m.
    """

    name: str
    unit: str
    component: Literal["film", "piezo", "calibration", "probe"]
    attribute: str
    form: Literal["logarithm", "difference", "value"]
    spread: str
    derivative: Literal["difference", "scaling"] = "difference"
    item: int | str | None = None
    file_factor: float = 1.0

    def mean(self, prior: "FilmPrior") -> float:
        """Return the mean over films."""
        del prior
        return 0.0

    def std(self, prior: "FilmPrior") -> float:
        """Return the standard deviation over films."""
        return float(getattr(prior.spread, self.spread))

    def bounds(self, prior: "FilmPrior") -> tuple[float, float]:
        """Return the smallest and largest value that a film or a calibration may have."""
        reach = REACH * self.std(prior)
        return self.mean(prior) - reach, self.mean(prior) + reach

    def described(self, components: Components) -> float:
        """Return the value of the quantity that a sensor and a probe have; a gain that is not given is 1."""
        value = getattr(components[self.component], self.attribute)
        if isinstance(value, Mapping):
            return float(value.get(self.item, 1.0))
        return float(value if self.item is None else value[self.item])

    def changed(self, described: float, parameter: float, factor: float) -> float:
        """Return the value of the quantity for a parameter; `factor` is the exponential of the parameter."""
        if self.form == "logarithm":
            return described * factor
        if self.form == "difference":
            return described + parameter
        return parameter

    def from_values(self, value: float, described: float) -> float:
        """Return the parameter of a value; the inverse of `changed`.

        Raises:
            ValueError: If the parameter is a logarithm, and the values have different signs.
        """
        if self.form == "logarithm":
            ratio = _ratio(value, described)
            if ratio <= 0.0:
                raise ValueError(f"expected the sign of {described:g}, got {value:g}")
            return float(np.log(ratio))
        if self.form == "difference":
            return value - described
        return value


class PretensionParameter(FilmParameter):
    """The pretension, which is equally likely between none and the largest of the spread."""

    def mean(self, prior: "FilmPrior") -> float:
        """Return half of the largest pretension."""
        return 0.5 * prior.spread.pretension

    def std(self, prior: "FilmPrior") -> float:
        """Return the standard deviation of the uniform distribution."""
        return prior.spread.pretension / float(np.sqrt(12.0))

    def bounds(self, prior: "FilmPrior") -> tuple[float, float]:
        """Return no pretension, and somewhat more than the largest of the spread."""
        return 0.0, TAUTEST * prior.spread.pretension


class ProbeRadiusParameter(FilmParameter):
    """The radius of the probe, which is neither negative nor far from the described one."""

    def std(self, prior: "FilmPrior") -> float:
        """Return the spread, or less for a small probe."""
        return min(prior.spread.probe_radius, 0.3 * prior.probe.radius)

    def bounds(self, prior: "FilmPrior") -> tuple[float, float]:
        """Return the usual bounds, within `PROBES`."""
        low, high = super().bounds(prior)
        smallest, largest = PROBES
        radius = prior.probe.radius
        return max(low, (smallest - 1.0) * radius), min(high, (largest - 1.0) * radius)


PARAMETERS = (
    PretensionParameter("pretension", "MPa", "film", "pretension", "value", "pretension", file_factor=1e6),
    FilmParameter("young", "1", "film", "young", "logarithm", "young", "scaling"),
    FilmParameter("thickness", "1", "film", "thickness", "logarithm", "thickness"),
    FilmParameter("d31", "1", "piezo", "d31", "logarithm", "d31", "scaling"),
    FilmParameter("d32", "1", "piezo", "d32", "logarithm", "d32", "scaling"),
    FilmParameter("shift_x", "mm", "calibration", "shift", "difference", "shift", item=0, file_factor=1e-3),
    FilmParameter("shift_y", "mm", "calibration", "shift", "difference", "shift", item=1, file_factor=1e-3),
    FilmParameter("rotation", "rad", "calibration", "rotation", "difference", "rotation"),
    ProbeRadiusParameter("probe_radius", "mm", "probe", "radius", "difference", "probe_radius", file_factor=1e-3),
)
"""Parameters that every film has; gains follow, one for each electrode."""

SHARED = tuple(parameter.name for parameter in PARAMETERS)
"""Names of these parameters."""


def gain_parameter(electrode: str) -> FilmParameter:
    """Return the declaration of the gain of an electrode."""
    return FilmParameter(
        f"gain {electrode}", "1", "calibration", "gain", "logarithm", "gain", "scaling", item=electrode
    )


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
    def parameters(self) -> tuple[FilmParameter, ...]:
        """Declarations of the parameters, in their order."""
        return (*PARAMETERS, *(gain_parameter(name) for name in self.sensor.electrode_names))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in their order."""
        return tuple(parameter.name for parameter in self.parameters)

    def index(self, name: str) -> int:
        """Return the place of a parameter in the vector of parameters."""
        return self.names.index(name)

    @cached_property
    def gains(self) -> slice:
        """Places of the gains in the vector of parameters."""
        return slice(len(PARAMETERS), len(self.parameters))

    @cached_property
    def mean(self) -> Array:
        """Means of the parameters, shape (n_parameter,): the film as described, half of the largest pretension."""
        return np.array([parameter.mean(self) for parameter in self.parameters])

    @cached_property
    def std(self) -> Array:
        """Standard deviations of the parameters, shape (n_parameter,)."""
        return np.array([parameter.std(self) for parameter in self.parameters])

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Smallest and largest parameters that a film or a calibration may have, each of shape (n_parameter,)."""
        low, high = np.array([parameter.bounds(self) for parameter in self.parameters]).T
        return low, high

    @cached_property
    def file_factors(self) -> Array:
        """Factors from the parameters' units to those in files of calibrations, shape (n_parameter,)."""
        return np.array([parameter.file_factor for parameter in self.parameters])

    @cached_property
    def _components(self) -> Components:
        """Film, coefficients and calibration of the described sensor, and the described probe."""
        return _components_of(self.sensor, self.probe)

    @property
    def described(self) -> Array:
        """The parameters of the film exactly as described, shape (n_parameter,)."""
        return self.parameters_of(self.sensor, self.probe)

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Return films drawn from the spread, shape (count, n_parameter).

        Deviations beyond the bounds are drawn again. All pretensions up to the largest are equally likely.
        """
        drawn = self.mean + self.std * rng.standard_normal((count, len(self.names)))
        while (outside := (drawn < self.bounds[0]) | (drawn > self.bounds[1])).any():
            again = self.mean + self.std * rng.standard_normal(drawn.shape)
            drawn = np.where(outside, again, drawn)
        drawn[:, self.index("pretension")] = self.spread.pretension * rng.random(count)
        return drawn

    def film(self, parameters: Array) -> tuple[Sensor, Circle]:
        """Return the sensor and the probe that parameters, shape (n_parameter,), describe.

        Raises:
            SensorError: If there can be no such sensor: electrodes moved off the film, or a negative pretension.
        """
        changes: dict[str, dict[str, Any]] = {component: {} for component in self._components}
        factors = np.exp(parameters)
        for declared, described, parameter, factor in zip(
            self.parameters, self._described_values, parameters.tolist(), factors.tolist(), strict=True
        ):
            value = declared.changed(described, parameter, factor)
            component = changes[declared.component]
            if declared.item is None:
                component[declared.attribute] = value
            else:
                component.setdefault(declared.attribute, {})[declared.item] = value
        calibration = changes["calibration"]
        calibration["shift"] = (calibration["shift"][0], calibration["shift"][1])
        sensor = replace(
            self.sensor,
            film=replace(self.sensor.film, **changes["film"]),
            piezo=replace(self.sensor.piezo, **changes["piezo"]),
            calibration=replace(self.sensor.calibration, **calibration),
        )
        return sensor, replace(self.probe, **changes["probe"])

    @cached_property
    def _described_values(self) -> tuple[float, ...]:
        """Values of the parameters' quantities that the described sensor and probe have."""
        return tuple(parameter.described(self._components) for parameter in self.parameters)

    def parameters_of(self, sensor: Sensor, probe: Circle) -> Array:
        """Return the parameters of a sensor that differs from the described one by them alone: the inverse of `film`.

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
        components = _components_of(sensor, probe)
        try:
            values = [
                parameter.from_values(parameter.described(components), described_value)
                for parameter, described_value in zip(self.parameters, self._described_values, strict=True)
            ]
        except ValueError as error:
            raise SensorError(
                f"{sensor.name}: d31 and d32: expected the signs of {described.name} ({error})"
            ) from error
        return np.array(values)


def _components_of(sensor: Sensor, probe: Circle) -> Components:
    """Return what parameters change of a sensor and a probe."""
    return {"film": sensor.film, "piezo": sensor.piezo, "calibration": sensor.calibration, "probe": probe}


def _shapes(sensor: Sensor) -> dict[str, list[tuple[float, float]]]:
    """Corners of what collects as described, mm, rounded to a nanometre."""
    return {e.name: [(round(x, 6), round(y, 6)) for part in e.parts for x, y in part] for e in sensor.electrodes}


def _centres(sensor: Sensor) -> str:
    places = [(e.name, *e.centre) for e in sensor.electrodes]
    return ", ".join(f"{name} at ({x:.4g}, {y:.4g})" for name, x, y in places[:8]) + " mm" + ", ..." * (len(places) > 8)


def _ratio(value: float, described: float) -> float:
    """Return value / described; 1 if both are zero, and 0 if only the described value is zero."""
    if described != 0.0:
        return value / described
    return 1.0 if value == 0.0 else 0.0


def virtual_film(sensor: Sensor, probe: Circle, seed: int) -> tuple[Sensor, Circle]:
    """A film drawn from the spread about a sensor and a probe."""
    prior = FilmPrior(sensor, probe)
    return prior.film(prior.draw(np.random.default_rng(seed), 1)[0])
