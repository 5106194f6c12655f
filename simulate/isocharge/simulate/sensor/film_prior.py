"""Unknown parameters of a real film, and the prior distribution of these parameters.

The prior distribution is centred on the film that a sensor file describes. Before any measurement, the properties of
the film, the piezoelectric coefficients and the gains are known only to within a few percent. The positions of the
electrodes are known to within tenths of a millimetre, and the pretension is almost unknown. Calibrations start from
this prior distribution. Virtual films are drawn from the same distribution. The films with which networks for all films
are trained are also drawn from it.

`PARAMETERS` declares the parameters that every film has. The parameter vector also contains one gain for each
electrode. Each parameter except the pretension is a deviation from the sensor file, so it is zero for the described
film. The parameter of the pretension is the pretension itself.
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

MAX_DEVIATION = 2.5
"""Largest allowed deviation of a parameter from its mean, in standard deviations. The pretension has other bounds."""

MAX_PRETENSION_FACTOR = 4.0 / 3.0
"""Largest pretension that a calibration may find, divided by the largest pretension of the prior distribution."""

MIN_PROBE_RADIUS_FACTOR = 0.5
"""Smallest probe radius that a calibration may find, divided by the described radius, dimensionless."""

MAX_PROBE_RADIUS_FACTOR = 1.5
"""Largest probe radius that a calibration may find, divided by the described radius, dimensionless."""

MAX_SHOWN_CENTRES = 8
"""Largest number of electrodes whose centres an error message lists."""


@dataclass(frozen=True)
class FilmSpread:
    """Widths of the prior distribution from which the parameters of a film are drawn.

    The width of the pretension is its largest value. The widths of all other parameters are standard deviations.

    Attributes:
        pretension: Largest pretension, MPa. All values from zero to the largest pretension are equally likely.
        young: Standard deviation of the logarithm of Young's modulus, dimensionless.
        thickness: Standard deviation of the logarithm of the thickness, dimensionless.
        d31: Standard deviation of the logarithm of d31, dimensionless.
        d32: Standard deviation of the logarithm of d32, dimensionless.
        shift: Standard deviation of the displacement of the electrodes along x and along y, mm.
        rotation: Standard deviation of the rotation of the electrodes, rad.
        probe_radius: Standard deviation of the radius of the probe, mm.
        gain: Standard deviation of the logarithm of each gain, dimensionless. The gains are independent.
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
"""Objects whose attributes the parameters change, by name.

The objects are the `film`, the `piezo` and the `calibration` of a sensor, and the `probe`.
"""


@dataclass(frozen=True)
class FilmParameter:
    """Declaration of one unknown parameter of a film.

    Attributes:
        name: Name of the parameter.
        unit: Unit of the parameter.
        component: Name of the object in `Components` whose attribute the parameter changes.
        attribute: Name of the attribute that contains the physical value, such as `young`.
        form: Relation between the parameter and the physical value: "logarithm" for ln(value / described value),
            "difference" for value - described value, "value" for the value itself.
        spread: Name of the field of `FilmSpread` that contains the width of the prior distribution.
        derivative: Method by which the derivative of the charges is computed: "difference" between two films, or
            "scaling" with the dimensionless groups.
        item: Index or key of the physical value if the attribute is a tuple or a mapping; None if it is a number.
        file_factor: Factor that converts the unit of the parameter into the unit in calibration files (Pa or m).
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
        """Return the mean of the prior distribution. The mean is zero, which is the parameter of the described film.

        Args:
            prior: Prior distribution. Only subclasses use it.
        """
        del prior
        return 0.0

    def std(self, prior: "FilmPrior") -> float:
        """Return the standard deviation of the parameter in a prior distribution."""
        return float(getattr(prior.spread, self.spread))

    def bounds(self, prior: "FilmPrior") -> tuple[float, float]:
        """Return the smallest and the largest value that the parameter of a film or a calibration may have."""
        max_deviation = MAX_DEVIATION * self.std(prior)
        return self.mean(prior) - max_deviation, self.mean(prior) + max_deviation

    def physical_value(self, components: Components) -> float:
        """Return the physical value of the parameter, such as Young's modulus, for a sensor or a probe.

        Args:
            components: Objects of the sensor, and the probe.
        """
        value = getattr(components[self.component], self.attribute)
        if isinstance(value, Mapping):  # the gains by electrode; a gain that is missing is 1
            return float(value.get(self.item, 1.0))
        return float(value if self.item is None else value[self.item])

    def to_physical_value(self, described_value: float, parameter: float, exp_parameter: float) -> float:
        """Convert the value of the parameter into a physical value, according to `form`.

        The parameter describes how a film differs from the film in the sensor file (the described film). If the form is
        "logarithm", the parameter is the logarithm of the ratio of both physical values. If the form is "difference",
        the parameter is their difference. If the form is "value", the parameter is the physical value itself.

        Args:
            described_value: Physical value of the described film.
            parameter: Value of the parameter.
            exp_parameter: Exponential of `parameter`, which the caller computes for all parameters at once. It is used
                only if the form is "logarithm".

        Returns:
            The physical value, in the unit of `described_value`.
        """
        if self.form == "logarithm":
            return described_value * exp_parameter
        if self.form == "difference":
            return described_value + parameter
        return parameter

    def from_physical_value(self, value: float, described_value: float) -> float:
        """Convert a physical value into the value of the parameter, according to `form`.

        This method is the inverse of `to_physical_value`.

        Args:
            value: Physical value of a film.
            described_value: Physical value of the described film, in the same unit.

        Returns:
            The logarithm of the ratio of both values, their difference, or `value` itself.

        Raises:
            ValueError: If the parameter is a logarithm, and the values have different signs or only one of them is
                zero.
        """
        if self.form == "logarithm":
            ratio = _ratio(value, described_value)
            if ratio <= 0.0:
                raise ValueError(f"expected the sign of {described_value:g}, got {value:g}")
            return float(np.log(ratio))
        if self.form == "difference":
            return value - described_value
        return value


class PretensionParameter(FilmParameter):
    """Declaration of the pretension, which is uniformly distributed between zero and the largest pretension."""

    def mean(self, prior: "FilmPrior") -> float:
        """Return the mean of the pretension (MPa), which is half of the largest pretension."""
        return 0.5 * prior.spread.pretension

    def std(self, prior: "FilmPrior") -> float:
        """Return the standard deviation of the pretension, MPa.

        The standard deviation of a uniform distribution is the width of its range divided by the square root of 12.
        """
        return prior.spread.pretension / float(np.sqrt(12.0))

    def bounds(self, prior: "FilmPrior") -> tuple[float, float]:
        """Return the bounds of the pretension, MPa.

        The lower bound is zero. The upper bound is `MAX_PRETENSION_FACTOR` times the largest pretension of the prior
        distribution.
        """
        return 0.0, MAX_PRETENSION_FACTOR * prior.spread.pretension


class ProbeRadiusParameter(FilmParameter):
    """Declaration of the radius of the probe. The bounds of the radius are proportional to the described radius."""

    def std(self, prior: "FilmPrior") -> float:
        """Return the standard deviation of the radius (mm), which is at most 0.3 times the described radius."""
        return min(prior.spread.probe_radius, 0.3 * prior.probe.radius)

    def bounds(self, prior: "FilmPrior") -> tuple[float, float]:
        """Return the bounds of the difference between the radius and the described radius, mm.

        The radius is at least `MIN_PROBE_RADIUS_FACTOR` and at most `MAX_PROBE_RADIUS_FACTOR` times the described
        radius.

        Args:
            prior: Prior distribution with the described probe.
        """
        lower, upper = super().bounds(prior)
        radius = prior.probe.radius
        smallest_difference = (MIN_PROBE_RADIUS_FACTOR - 1.0) * radius
        largest_difference = (MAX_PROBE_RADIUS_FACTOR - 1.0) * radius
        return max(lower, smallest_difference), min(upper, largest_difference)


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
"""Parameters that every film has. In the parameter vector, the gains of the electrodes follow these parameters."""

SHARED = tuple(parameter.name for parameter in PARAMETERS)
"""Names of the parameters that every film has, in the order of the parameter vector."""


def gain_parameter(electrode: str) -> FilmParameter:
    """Return the declaration of the gain of an electrode.

    Args:
        electrode: Name of the electrode.
    """
    return FilmParameter(
        f"gain {electrode}", "1", "calibration", "gain", "logarithm", "gain", "scaling", item=electrode
    )


@dataclass(frozen=True)
class FilmPrior:
    """Prior distribution of the parameters of a real sensor, and of the radius of the probe.

    Attributes:
        sensor: Sensor as described by its file, on which the distribution is centred.
        probe: Described probe. It is circular, because its radius is one of the parameters.
        spread: Widths of the prior distribution.
    """

    sensor: Sensor
    probe: Circle
    spread: FilmSpread = FilmSpread()

    def __post_init__(self) -> None:
        """Check that the electrodes lie within the rim for every film of the distribution.

        Raises:
            SensorError: If an electrode may lie over the rim of a film.
        """
        # The largest shift is the largest deviation along x combined with the largest deviation along y.
        sensor = self.sensor
        max_shift = float(np.hypot(MAX_DEVIATION, MAX_DEVIATION)) * self.spread.shift
        for electrode in sensor.electrodes:
            corners = sensor.calibration.place(np.concatenate(electrode.parts))
            farthest = np.linalg.norm(corners, axis=1).max()
            if not farthest + max_shift < sensor.film.radius:
                raise SensorError(
                    f"electrode {electrode.name!r} reaches {farthest:.4g} mm from the centre, and electrodes may be "
                    f"{max_shift:.3g} mm off their place: expected {sensor.film.radius - max_shift:.4g} mm at most, "
                    "or it lies over the rim of some films; move it inwards"
                )

    @cached_property
    def parameters(self) -> tuple[FilmParameter, ...]:
        """Declarations of all parameters, in the order of the parameter vector."""
        return (*PARAMETERS, *(gain_parameter(name) for name in self.sensor.electrode_names))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, in the order of the parameter vector."""
        return tuple(parameter.name for parameter in self.parameters)

    def index(self, name: str) -> int:
        """Return the index of the parameter with the given name in the parameter vector."""
        return self.names.index(name)

    @cached_property
    def gains(self) -> slice:
        """Indices of the gains in the parameter vector."""
        return slice(len(PARAMETERS), len(self.parameters))

    @cached_property
    def mean(self) -> Array:
        """Means of the parameters, shape (n_parameter,).

        Except for the pretension, the means are the parameters of the described film. The mean of the pretension is
        half of the largest pretension.
        """
        return np.array([parameter.mean(self) for parameter in self.parameters])

    @cached_property
    def std(self) -> Array:
        """Standard deviations of the parameters, shape (n_parameter,)."""
        return np.array([parameter.std(self) for parameter in self.parameters])

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Smallest and largest allowed values of the parameters, each of shape (n_parameter,)."""
        low, high = np.array([parameter.bounds(self) for parameter in self.parameters]).T
        return low, high

    @cached_property
    def file_factors(self) -> Array:
        """Factors that convert the parameters into the units of calibration files, shape (n_parameter,)."""
        return np.array([parameter.file_factor for parameter in self.parameters])

    @cached_property
    def _components(self) -> Components:
        """Objects whose attributes the parameters change: parts of the described sensor, and the probe."""
        return _components_of(self.sensor, self.probe)

    @property
    def described(self) -> Array:
        """Parameters of the film that the sensor file describes, shape (n_parameter,).

        In contrast to `mean`, the pretension is that of the sensor file.
        """
        return self.parameters_of(self.sensor, self.probe)

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Draw the parameters of films from the prior distribution.

        The pretension is distributed uniformly. All other parameters are distributed normally, and values outside their
        bounds are drawn again.

        Args:
            rng: Random number generator.
            count: Number of films.

        Returns:
            Parameters of each film, shape (count, n_parameter).
        """
        # Draw all parameters from normal distributions. Values outside the bounds are drawn again, until all values lie
        # within the bounds. Each repetition draws a whole array, of which only the required values are used.
        lower_bounds, upper_bounds = self.bounds
        drawn = self.mean + self.std * rng.standard_normal((count, len(self.names)))
        is_outside = (drawn < lower_bounds) | (drawn > upper_bounds)
        while is_outside.any():
            replacement = self.mean + self.std * rng.standard_normal(drawn.shape)
            drawn = np.where(is_outside, replacement, drawn)
            is_outside = (drawn < lower_bounds) | (drawn > upper_bounds)

        # The pretension is distributed uniformly, so its values from the normal distribution are replaced.
        drawn[:, self.index("pretension")] = self.spread.pretension * rng.random(count)
        return drawn

    def film(self, parameters: Array) -> tuple[Sensor, Circle]:
        """Return the sensor and the probe that a parameter vector describes.

        They are copies of the sensor and the probe of this prior distribution, in which some attributes are changed.

        Args:
            parameters: Parameters, shape (n_parameter,).

        Returns:
            The changed sensor and the changed probe.

        Raises:
            SensorError: If no such sensor can exist, for example because an electrode lies over the rim.
        """
        # Collect the changed attributes of each component (film, piezo, calibration and probe). An attribute that is a
        # tuple or a mapping, such as the gains, has several parameters. Collect its changed items by index or key.
        changes: dict[str, dict[str, Any]] = {component: {} for component in self._components}
        exp_parameters = np.exp(parameters)
        for declaration, described_value, parameter, exp_parameter in zip(
            self.parameters, self._described_values, parameters.tolist(), exp_parameters.tolist(), strict=True
        ):
            value = declaration.to_physical_value(described_value, parameter, exp_parameter)
            attributes = changes[declaration.component]
            if declaration.item is None:
                attributes[declaration.attribute] = value
            else:
                attributes.setdefault(declaration.attribute, {})[declaration.item] = value

        # The items of the shift were collected by index (0 for x, 1 for y). The calibration requires a tuple.
        calibration = changes["calibration"]
        shift = calibration["shift"]
        calibration["shift"] = (shift[0], shift[1])
        sensor = replace(
            self.sensor,
            film=replace(self.sensor.film, **changes["film"]),
            piezo=replace(self.sensor.piezo, **changes["piezo"]),
            calibration=replace(self.sensor.calibration, **calibration),
        )
        return sensor, replace(self.probe, **changes["probe"])

    @cached_property
    def _described_values(self) -> tuple[float, ...]:
        """Physical values of the described sensor and probe, in the order of the parameter vector."""
        return tuple(parameter.physical_value(self._components) for parameter in self.parameters)

    def parameters_of(self, sensor: Sensor, probe: Circle) -> Array:
        """Return the parameter vector of a sensor and a probe.

        This method is the inverse of `film`.

        Args:
            sensor: Sensor that may differ from the described sensor only in the values of the parameters.
            probe: Probe that may differ from the described probe only in its radius.

        Returns:
            Parameters, shape (n_parameter,).

        Raises:
            SensorError: If the sensor differs from the described sensor in other properties, such as the electrodes, or
                if the sign of d31 or d32 differs.
        """
        described = self.sensor
        if _rounded_corners(sensor) != _rounded_corners(described):
            raise SensorError(
                f"{sensor.name}: expected the electrodes of {described.name} ({_centres(described)}), got others "
                f"({_centres(sensor)})"
            )
        # All other properties that are not parameters must be equal, too.
        for property_name, value, expected in (
            ("readout", (sensor.readout, sensor.surface), (described.readout, described.surface)),
            ("film radius (mm)", round(sensor.film.radius, 6), round(described.film.radius, 6)),
            ("film poisson", round(sensor.film.poisson, 9), round(described.film.poisson, 9)),
            ("d33 (pC/N)", sensor.piezo.d33, described.piezo.d33),
            ("d12 (pC/N)", sensor.piezo.d12, described.piezo.d12),
            ("crosstalk", sensor.calibration.crosstalk, described.calibration.crosstalk),
            ("back volume (mm^3)", sensor.film.back_volume, described.film.back_volume),
            ("static pressure (MPa)", sensor.film.static_pressure, described.film.static_pressure),
            ("asymmetry of the film", sensor.film.asymmetries, described.film.asymmetries),
        ):
            if value != expected:
                raise SensorError(
                    f"{sensor.name}: {property_name}: expected those of {described.name}, {expected}, got {value}"
                )

        # Only d31 and d32 may have another sign than in the described sensor. The logarithm of the ratio of both values
        # does not exist in this case, and `from_physical_value` raises a ValueError.
        components = _components_of(sensor, probe)
        try:
            values = [
                parameter.from_physical_value(parameter.physical_value(components), described_value)
                for parameter, described_value in zip(self.parameters, self._described_values, strict=True)
            ]
        except ValueError as error:
            raise SensorError(
                f"{sensor.name}: d31 and d32: expected the signs of {described.name} ({error})"
            ) from error
        return np.array(values)


def _components_of(sensor: Sensor, probe: Circle) -> Components:
    """Return the objects whose attributes the parameters change: parts of a sensor, and the probe."""
    return {"film": sensor.film, "piezo": sensor.piezo, "calibration": sensor.calibration, "probe": probe}


def _rounded_corners(sensor: Sensor) -> dict[str, list[tuple[float, float]]]:
    """Return a dictionary from electrode names to the corners of all parts, rounded to a nanometre, mm."""
    return {
        electrode.name: [(round(x, 6), round(y, 6)) for part in electrode.parts for x, y in part]
        for electrode in sensor.electrodes
    }


def _centres(sensor: Sensor) -> str:
    """List the centres of at most `MAX_SHOWN_CENTRES` electrodes in a text for an error message."""
    centres = []
    for electrode in sensor.electrodes[:MAX_SHOWN_CENTRES]:
        x, y = electrode.centre
        centres.append(f"{electrode.name} at ({x:.4g}, {y:.4g})")
    text = ", ".join(centres) + " mm"
    if len(sensor.electrodes) > MAX_SHOWN_CENTRES:
        text += ", ..."
    return text


def _ratio(value: float, described: float) -> float:
    """Return the ratio of a value to the described value.

    If both values are zero, the ratio is 1. If only the described value is zero, the ratio is 0.
    """
    if described != 0.0:
        return value / described
    return 1.0 if value == 0.0 else 0.0


def virtual_film(sensor: Sensor, probe: Circle, seed: int) -> tuple[Sensor, Circle]:
    """Draw a random film from the prior distribution of a described sensor and a described probe.

    Args:
        sensor: Described sensor.
        probe: Described probe.
        seed: Seed of the random number generator.

    Returns:
        Sensor with the drawn film, gains and electrode positions. Probe with the drawn radius.
    """
    prior = FilmPrior(sensor, probe)
    return prior.film(prior.draw(np.random.default_rng(seed), 1)[0])
