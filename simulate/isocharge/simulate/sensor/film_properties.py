"""Unknown properties of a real film, and their prior distribution.

A sensor file describes a film. The real film differs from the described film. The properties of the film and its
piezoelectric coefficients are known only to within some percent. The positions of the electrodes are known to within
tenths of a millimetre. The pretension is almost unknown. The table `FILM_PROPERTIES` declares the unknown properties,
each with its name, its unit and its prior distribution. The function `changed_film` changes a sensor according to given
values of the properties. A calibration estimates the properties, and virtual films are drawn from their prior
distribution.

A value of a property is its deviation from the sensor file. The pretension is an exception: its value is the pretension
itself. A property that depends on the direction has a size and an axis. Its two components are the size times the
cosine, and the size times the sine, of twice the angle of the axis.
"""

import cmath
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import SensorError
from isocharge.simulate.sensor.film import Film, add_anisotropy, add_axial
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Calibration, Sensor, outermost_corner

MAX_DEVIATION = 4.0
"""Largest allowed deviation of a property from its mean, in standard deviations."""

MAX_DRAWN_DEVIATION = 2.5
"""Largest deviation of a randomly drawn property from its mean, in standard deviations."""

LARGEST_PRETENSION = 3.0
"""Largest pretension of a randomly drawn film, MPa. All values from zero to this pretension are equally likely."""

MIN_RIM_GAP_MM = 0.5
"""Smallest distance between an electrode and the rim, mm."""

MAX_RADIUS_DEVIATION = 0.5
"""Largest deviation of the radius of a probe, relative to the described radius."""


@dataclass(frozen=True)
class FilmProperty:
    """Declaration of one unknown property of a film.

    Attributes:
        name: Name of the property.
        meaning: Description of the property, for tables.
        unit: Unit of the value.
        std: Standard deviation of the prior distribution.
        drift: Standard deviation of the change of the property between two calibrations.
        mean: Mean of the prior distribution.
        bounds: Smallest and largest value; None for limits at `MAX_DEVIATION` standard deviations from the mean.
        is_imperfection: Whether the property is an imperfection, which a good film does not have.
    """

    name: str
    meaning: str
    unit: str
    std: float
    drift: float
    mean: float = 0.0
    bounds: tuple[float, float] | None = None
    is_imperfection: bool = False

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest value of the property."""
        return self.bounds or (self.mean - MAX_DEVIATION * self.std, self.mean + MAX_DEVIATION * self.std)


def _imperfection(name: str, meaning: str, unit: str, std: float, largest: float | None = None) -> FilmProperty:
    """Declare an imperfection of a film. The drift of the imperfection is a tenth of its standard deviation.

    Args:
        name: Name of the property.
        meaning: Description of the property, for tables.
        unit: Unit of the value.
        std: Standard deviation of the prior distribution.
        largest: Largest magnitude of the value; None for a limit of `MAX_DEVIATION` standard deviations.
    """
    bounds = None if largest is None else (-largest, largest)
    return FilmProperty(name, meaning, unit, std, drift=0.1 * std, bounds=bounds, is_imperfection=True)


PRETENSION = FilmProperty(
    "pretension",
    "mean pretension",
    "MPa",
    LARGEST_PRETENSION / math.sqrt(12.0),  # standard deviation of the uniform distribution
    drift=0.35,  # creep, and a degree of temperature
    mean=0.5 * LARGEST_PRETENSION,
    bounds=(0.0, 4.0),
)
"""Mean pretension. The value of this property is the pretension itself, not a deviation."""

UNEVEN_TENSIONS = ("tension_difference", "tension_shear")
"""Names of the properties for the uneven part of the pretension, whose values are shares of the mean pretension."""

FILM_PROPERTIES = (
    PRETENSION,
    FilmProperty("young", "ln of Young's modulus", "1", 0.2, 0.006),
    FilmProperty("thickness", "ln of the thickness", "1", 0.05, 0.002),
    FilmProperty("d31", "ln of d31", "1", 0.2, 0.01),
    FilmProperty("d32", "ln of d32", "1", 0.2, 0.01),
    FilmProperty("shift_x", "shift of the electrodes along x", "mm", 0.3, 0.01),
    FilmProperty("shift_y", "shift of the electrodes along y", "mm", 0.3, 0.01),
    FilmProperty("rotation", "rotation of the electrodes", "rad", math.radians(2.0), 0.001),
    _imperfection("tension_difference", "(T11 - T22) / (T11 + T22)", "1", 0.25, 0.9),
    _imperfection("tension_shear", "2 T12 / (T11 + T22)", "1", 0.15, 0.9),
    _imperfection("stiffness_x", "ln(E1 / E2), times the cosine of twice its angle", "1", 0.15, 1.0),
    _imperfection("stiffness_xy", "ln(E1 / E2), times the sine of twice its angle", "1", 0.1, 1.0),
    _imperfection("oval_x", "e of an oval clamp, times the cosine of twice its angle", "1", 0.006),
    _imperfection("oval_xy", "e of an oval clamp, times the sine of twice its angle", "1", 0.006),
    _imperfection("d12", "d12, by axes that are rotated", "pC/N", 0.3),
    _imperfection("crosstalk", "share of the charge of each other electrode", "1", 0.01),
)
"""Properties of every film.

In a vector of values, the probe radius and the gains of the electrodes come after these properties.
"""


def changed_film(sensor: Sensor, probe: Probe, values: Mapping[str, float]) -> tuple[Sensor, Probe]:
    """Change the properties of a film and its electrodes, and the radius of a probe.

    Args:
        sensor: Sensor that is changed.
        probe: Probe that is changed. A probe that is not circular remains unchanged.
        values: Value of each property by its name. Properties without a value remain unchanged. The value of the
            pretension is the new pretension. The values of `young`, `thickness`, `d31`, `d32` and the gains are
            logarithms of factors. The values of the uneven tensions are shares of the pretension. All other values are
            added to the properties.

    Returns:
        The changed sensor and the changed probe.

    Raises:
        SensorError: If the changed sensor cannot exist, for example because an electrode lies over the rim.
    """
    # A property without a value gets the value 0, which changes nothing. The pretension is kept if it has no value.
    value_of = defaultdict(float, {PRETENSION.name: sensor.film.pretension, **values})
    film = _changed_mechanics(sensor.film, value_of)
    piezo = replace(
        sensor.piezo,
        d31=sensor.piezo.d31 * math.exp(value_of["d31"]),
        d32=sensor.piezo.d32 * math.exp(value_of["d32"]),
        d12=sensor.piezo.d12 + value_of["d12"],
    )

    # Change the gains and the positions of the electrodes.
    calibration = sensor.calibration
    gain = dict(calibration.gain)  # an electrode without an entry has the gain 1
    for name in sensor.electrode_names:
        log_factor = value_of[f"gain {name}"]
        if log_factor:  # an unchanged gain needs no new entry
            gain[name] = gain.get(name, 1.0) * math.exp(log_factor)
    shift_x, shift_y = calibration.shift
    changed_calibration = Calibration(
        gain=gain,
        shift=(shift_x + value_of["shift_x"], shift_y + value_of["shift_y"]),
        rotation=calibration.rotation + value_of["rotation"],
        crosstalk=calibration.crosstalk + value_of["crosstalk"],
    )
    changed_sensor = replace(sensor, film=film, piezo=piezo, calibration=changed_calibration)
    if isinstance(probe, Circle):
        probe = replace(probe, radius=probe.radius + value_of["probe_radius"])
    return changed_sensor, probe


def _changed_mechanics(film: Film, value_of: Mapping[str, float]) -> Film:
    """Return a film with changed mechanical properties.

    Args:
        film: Film that is changed.
        value_of: Value of each property by its name. The value of the pretension is the new pretension (MPa). The
            values of `young` and `thickness` are logarithms of factors. The uneven tensions are shares of the new
            pretension, which are added to the deviator. The anisotropy of the stiffness and the oval shape of the
            clamp each have a size and an axis. Their values with the endings x and xy are the size times the cosine and
            the sine of twice the angle of the axis. They are added as the parts of a complex number.
    """
    pretension = value_of[PRETENSION.name]
    half_difference, tension_shear = film.deviator  # (T11 - T22) / 2 and T12, MPa
    young_factor = math.exp(value_of["young"])
    oval, oval_axis = add_axial(film.oval, film.oval_axis, complex(value_of["oval_x"], value_of["oval_xy"]))
    return replace(
        add_anisotropy(film, complex(value_of["stiffness_x"], value_of["stiffness_xy"])),
        pretension=pretension,
        young=film.young * young_factor,
        thickness=film.thickness * math.exp(value_of["thickness"]),
        deviator=(
            half_difference + value_of["tension_difference"] * pretension,
            tension_shear + value_of["tension_shear"] * pretension,
        ),
        shear=None if film.shear is None else film.shear * young_factor,  # the shear modulus changes like the others
        oval=oval,
        oval_axis=oval_axis,
    )


@dataclass(frozen=True)
class FilmPrior:
    """Prior distribution of the properties of a real film and its electrodes, and of the radius of a circular probe.

    Attributes:
        sensor: Sensor as its file describes it.
        probe: Probe as its notation describes it.
    """

    sensor: Sensor
    probe: Probe

    def __post_init__(self) -> None:
        """Check that the electrodes can move a little without reaching the rim.

        Raises:
            SensorError: If an electrode is too close to the rim.
        """
        if self._rim_gap < MIN_RIM_GAP_MM:
            film = self.sensor.film
            raise SensorError(
                f"{self.sensor.name}: expected electrodes within {film.inner_radius - MIN_RIM_GAP_MM:.4g} mm of the "
                "centre, because a real electrode lies beside its place and a real clamp is slightly oval; one reaches "
                f"{film.inner_radius - self._rim_gap:.4g} mm; move it inwards"
            )

    @cached_property
    def _rim_gap(self) -> float:
        """Smallest distance between an electrode and the rim of the described film, mm."""
        polygons = [polygon for electrode in self.sensor.electrodes for polygon in electrode.collecting_polygons]
        return self.sensor.film.inner_radius - outermost_corner(self.sensor, polygons)

    @cached_property
    def properties(self) -> tuple[FilmProperty, ...]:
        """Declarations of all unknown properties, in the order of their values in a vector.

        The properties in `FILM_PROPERTIES` come first. The radius of a circular probe and the gains of the electrodes
        follow. The number `std` is the uncertainty of the described value, and `drift` is the standard deviation of its
        change between two calibrations.
        """
        # No electrode may reach the rim. A shift of the electrodes may use half of the gap between the electrodes and
        # the rim, and an oval clamp the other half. Each of them has two components. If both components have the
        # largest size, the length of their vector sum is sqrt(2) times this size.
        largest_shift = 0.5 * self._rim_gap / math.sqrt(2.0)  # mm
        largest_oval = largest_shift / self.sensor.film.radius  # relative to the radius of the film
        largest_size_of = {  # by the name of the property
            "shift_x": largest_shift,
            "shift_y": largest_shift,
            "oval_x": largest_oval,
            "oval_xy": largest_oval,
        }
        properties = []
        for film_property in FILM_PROPERTIES:
            low, high = film_property.limits
            largest_size = largest_size_of.get(film_property.name, math.inf)
            bounds = (max(low, -largest_size), min(high, largest_size))
            properties.append(replace(film_property, bounds=bounds))

        if isinstance(self.probe, Circle):
            radius = self.probe.radius
            largest_deviation = MAX_RADIUS_DEVIATION * radius
            probe_radius = FilmProperty(
                name="probe_radius",
                meaning="radius of the probe",
                unit="mm",
                std=min(0.3, 0.3 * radius),  # 0.3 mm, but at most 30 % of the radius
                drift=0.01,
                bounds=(-largest_deviation, largest_deviation),
            )
            properties.append(probe_radius)
        for name in self.sensor.electrode_names:
            gain = FilmProperty(
                name=f"gain {name}",
                meaning=f"ln of the gain of {name}",
                unit="1",
                std=0.05,  # 5 %
                drift=0.005,
                bounds=(-1.5, 1.5),  # a factor of at most 4.5
            )
            properties.append(gain)
        return tuple(properties)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the properties, in the order of their values in a vector."""
        return tuple(film_property.name for film_property in self.properties)

    def index(self, name: str) -> int:
        """Return the index of the property with the given name in a vector of values."""
        return self.names.index(name)

    @cached_property
    def mean(self) -> Array:
        """Means of the properties, shape (n_property,)."""
        return np.array([film_property.mean for film_property in self.properties])

    @cached_property
    def std(self) -> Array:
        """Standard deviations of the properties, shape (n_property,)."""
        return np.array([film_property.std for film_property in self.properties])

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Smallest and largest values of the properties, each of shape (n_property,)."""
        low, high = np.array([film_property.limits for film_property in self.properties]).T
        return low, high

    @cached_property
    def is_imperfection(self) -> Booleans:
        """Whether each property is an imperfection, shape (n_property,)."""
        return np.array([film_property.is_imperfection for film_property in self.properties])

    @cached_property
    def changes_stress(self) -> Booleans:
        """Whether each property changes the stress of the film, shape (n_property,).

        Changes of the electrodes and of the piezoelectric coefficients do not change the stress.
        """
        # In each row, one property differs from its mean by one standard deviation, or by less at a bound. The stress
        # can only change if the film or the probe changes.
        changed_values = np.clip(self.mean + np.diag(self.std), *self.bounds)
        mean_sensor, mean_probe = self.film(self.mean)
        changes = []
        for values in changed_values:
            sensor, probe = self.film(values)
            changes.append(sensor.film != mean_sensor.film or probe != mean_probe)
        return np.array(changes)

    def without_imperfections(self, values: Array) -> Array:
        """Return the values of a film with the same properties, but without imperfections.

        The sensor file may describe a film with imperfections. The value of an imperfection is its deviation from the
        sensor file, so a value of zero leaves the described imperfection unchanged. The returned value of each
        imperfection is the described imperfection with the opposite sign, so that both cancel. A shear modulus in the
        sensor file remains, because no imperfection describes it.

        Args:
            values: Values of the properties, shape (n_property,).

        Returns:
            Values of the properties of the film without imperfections, shape (n_property,).
        """
        # Collect the imperfections of the described film, in the units of the properties. The components of a property
        # with an axis are its size times the cosine and the sine of twice the angle of the axis.
        film = self.sensor.film
        stiffness = cmath.rect(math.log(film.young_ratio), 2.0 * film.axis)  # complex number with both components
        oval = cmath.rect(film.oval, 2.0 * film.oval_axis)
        described_imperfections = {
            "stiffness_x": stiffness.real,
            "stiffness_xy": stiffness.imag,
            "oval_x": oval.real,
            "oval_xy": oval.imag,
        }
        # The value of an uneven tension times the given pretension is added to the described deviator (MPa). The value
        # must therefore cancel the deviator divided by this pretension. Without a pretension, no value has an effect.
        pretension = values[self.index(PRETENSION.name)]
        if pretension > 0.0:
            described_imperfections |= dict(zip(UNEVEN_TENSIONS, np.divide(film.deviator, pretension), strict=True))

        # The values of all other properties are kept.
        cancelling_values = [-described_imperfections.get(name, 0.0) for name in self.names]
        return np.where(self.is_imperfection, cancelling_values, values)

    def film(self, values: Array) -> tuple[Sensor, Probe]:
        """Return the sensor and the probe that have the given values of the properties.

        Args:
            values: Values of the properties, shape (n_property,).

        Raises:
            SensorError: If the sensor cannot exist, for example because an electrode lies over the rim.
        """
        return changed_film(self.sensor, self.probe, dict(zip(self.names, np.asarray(values).tolist(), strict=True)))

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Draw films without imperfections from the prior distribution.

        The pretension is distributed uniformly. All other properties are distributed normally, and values that deviate
        by more than `MAX_DRAWN_DEVIATION` standard deviations are drawn again.

        Args:
            rng: Random number generator.
            count: Number of films.

        Returns:
            Values of the properties of each film, shape (count, n_property).
        """
        deviation = rng.standard_normal((count, len(self.properties)))  # from the mean, in standard deviations
        while (is_far := np.abs(deviation) > MAX_DRAWN_DEVIATION).any():
            deviation = np.where(is_far, rng.standard_normal(deviation.shape), deviation)
        deviation[:, self.is_imperfection] = 0.0
        values = self.mean + self.std * deviation
        values[:, self.index(PRETENSION.name)] = LARGEST_PRETENSION * rng.random(count)  # uniform instead of normal
        low, high = self.bounds
        return np.clip(values, low, high)


def virtual_film(sensor: Sensor, probe: Probe, seed: int) -> tuple[Sensor, Probe]:
    """Draw a random film without imperfections from the prior distribution of a described sensor and a probe.

    Args:
        sensor: Described sensor.
        probe: Described probe.
        seed: Seed of the random number generator.

    Returns:
        Sensor with the drawn film, gains and electrode positions, and probe. A circular probe has the drawn radius.
    """
    prior = FilmPrior(sensor, probe)
    return prior.film(prior.draw(np.random.default_rng(seed), 1)[0])
