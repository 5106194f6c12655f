"""Problem of a calibration, which contains the prior of the films and the network for all of these films."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import ModelError, PressError, SceneError, SensorError
from isocharge.serve.model.model_folder import find_model, model_names, repositories
from isocharge.simulate import Circle, Domain, FilmPrior, NoiseModel, Probe, Sensor
from isocharge.simulate.solver.stress_limit import force_within_stress
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.hypotheses import Hypothesis
from isocharge.train.calibration.nuisances import PRETENSION_PER_KELVIN
from isocharge.train.films.films_file import FILE, read_films
from isocharge.train.films.films_model import AddedVariance, FilmsModel
from isocharge.train.training.fitted import Fitted

DRIFT = {
    "pretension": 0.4,
    "young": 0.03,
    "thickness": 0.03,
    "d31": 0.05,
    "d32": 0.05,
    "shift": 0.03,
    "rotation": 0.03,
    "probe_radius": 0.03,
    "gain": 0.1,
}
"""Standard deviation of the change of each parameter since an earlier calibration, relative to the prior.

The keys are fields of `FilmSpread`.

The values correspond to 0.35 MPa of the pretension (creep and a degree of temperature), 1 % of the piezoelectric
coefficients and 0.5 % of the gains. Presses with a known force can also reveal larger changes. Touches with an unknown
force can only show a change of the pretension."""

COEFFICIENT_DRIFT_STD = 0.002
"""Standard deviation of the change of the coefficients of a discrepancy since an earlier calibration."""

CREEP = 0.1
"""Standard deviation of the change of the pretension, relative to the prior, between two known temperatures.

If both temperatures are known, the effect of the temperature is subtracted, and only creep remains."""

PLANNED_IMPERFECTIONS = Hypothesis(modes=0.5, discrepancy=0.01)
"""Imperfections that are assumed when presses are planned: half as large as on typical imperfect films.

If smaller imperfections are assumed, the remaining errors on imperfect films are 1.5 times as large. On a film without
imperfections, the assumption does not change the error after eight presses, and increases it by 7 % after five."""

MAX_IDENTIFIED_STD_RATIO = 0.5
"""Largest ratio of the standard deviations after and before the presses at which a quantity counts as identified."""


class Warming(NamedTuple):
    """Change of the pretension of a film with temperature.

    Attributes:
        MPa_per_K: Change of the pretension per kelvin.
        std: Standard deviation of this change, MPa/K.
        at_C: Temperature of the film for which its parameters are given, degrees Celsius.
        covariance: Covariance of this change with the unknowns of the film, shape (n_unknown,), MPa/K. Parameters are
            in units of their prior standard deviations.
    """

    MPa_per_K: float
    std: float
    at_C: float
    covariance: Array

    @property
    def identified(self) -> bool:
        """Whether presses have at least halved the standard deviation of the change."""
        return self.std <= MAX_IDENTIFIED_STD_RATIO * PRETENSION_PER_KELVIN.std_with_temperatures

    def with_unknowns(self, count: int) -> "Warming":
        """Return the change of the pretension with covariances for another number of unknowns.

        Args:
            count: Number of unknowns. The last unknowns are removed, or unknowns without a covariance are added.
        """
        extended = np.pad(self.covariance, (0, count))
        return self._replace(covariance=extended[:count])


@dataclass(frozen=True)
class FilmEstimate:
    """Estimate of a film: mean and covariance of a Gaussian distribution of its unknowns.

    Attributes:
        parameters: Best parameters, as in `FilmPrior`, shape (n_parameter,).
        covariance: Covariance of the parameters in units of their prior standard deviations, shape
            (n_parameter, n_parameter).
        coefficients: Coefficients of the discrepancy, shape (n_coefficient,); empty if there is none.
        joint: Covariance of parameters and coefficients, shape (n_parameter + n_coefficient, n_parameter +
            n_coefficient); empty if there is no discrepancy.
        warming: Change of the pretension with temperature; None if the temperatures of the presses are not known.
    """

    parameters: Array
    covariance: Array
    coefficients: Array = field(default_factory=lambda: np.empty(0))
    joint: Array = field(default_factory=lambda: np.empty((0, 0)))
    warming: Warming | None = None

    @property
    def unknowns(self) -> Array:
        """Parameters and coefficients, as `FilmCharges.film` takes them."""
        return np.concatenate([self.parameters, self.coefficients])

    @property
    def unknown_covariance(self) -> Array:
        """Covariance of parameters and coefficients."""
        return self.joint if self.coefficients.size else self.covariance

    def drifted(self, prior: FilmPrior, *, knows_temperature: bool = False) -> "FilmEstimate":
        """Return the estimate for a later time, with the drift that the film may have had in its covariance.

        The drift of each parameter is independent. If both temperatures are known, only creep changes the pretension.

        Args:
            prior: Distribution of the films.
            knows_temperature: Whether the temperature at the later time is known.
        """
        drift_std = np.array([DRIFT[parameter.spread] for parameter in prior.parameters])
        if knows_temperature and self.warming is not None:
            drift_std[prior.index("pretension")] = CREEP
        covariance = self.covariance + np.diag(drift_std**2)

        # The coefficients of imperfections and discrepancy change as well, if the estimate has them.
        joint = self.joint
        if joint.size:
            coefficient_drift_std = np.full(self.coefficients.size, COEFFICIENT_DRIFT_STD)
            joint_drift_std = np.concatenate([drift_std, coefficient_drift_std])
            joint = joint + np.diag(joint_drift_std**2)
        parameters = np.clip(self.parameters, *prior.bounds)
        return FilmEstimate(parameters, covariance, self.coefficients, joint, self.warming)

    def at_temperature(self, at_C: float, prior: FilmPrior) -> "FilmEstimate":
        """Return the estimate of the film at another temperature.

        Only the pretension changes, in proportion to the change of the temperature. If `warming` is None, the
        temperature of the estimate is unknown. The estimate is then returned unchanged.

        Args:
            at_C: The other temperature, degrees Celsius.
            prior: Distribution of the films.

        Raises:
            PressError: If the pretension would be outside the bounds of the films.
        """
        if self.warming is None:
            return self

        pretension = prior.index("pretension")
        change_K = at_C - self.warming.at_C
        parameters = self.parameters.copy()
        parameters[pretension] += change_K * self.warming.MPa_per_K
        lower, upper = (float(bound[pretension]) for bound in prior.bounds)
        if not lower <= parameters[pretension] <= upper:
            raise PressError(
                f"at {at_C:g} C the pretension would be {parameters[pretension]:.2f} MPa; expected {lower:g} to "
                f"{upper:g} MPa: a temperature nearer to that of the presses"
            )

        # The new pretension T + k w is the sum of the old pretension T and the change k w, with the difference k of the
        # temperatures and the change w per kelvin. The covariance with another unknown u becomes
        # cov(T, u) + k cov(w, u). It replaces first the row of the pretension, then cov(w, T), and then the column of
        # the pretension.
        scaled_change = change_K / prior.std[pretension]
        covariance = self.unknown_covariance.copy()
        warming_covariance = self.warming.covariance.copy()
        covariance[pretension] += scaled_change * warming_covariance
        warming_covariance[pretension] += scaled_change * self.warming.std**2
        covariance[:, pretension] += scaled_change * warming_covariance

        n_parameter = len(parameters)
        return FilmEstimate(
            parameters=parameters,
            covariance=covariance[:n_parameter, :n_parameter],
            coefficients=self.coefficients,
            joint=covariance if self.joint.size else self.joint,
            warming=self.warming._replace(at_C=at_C, covariance=warming_covariance),
        )


@dataclass(frozen=True)
class CalibrationProblem:
    """Films that a sensor may have, and the contacts for which the sensor is calibrated.

    Attributes:
        sensor: The sensor as described in its file.
        probe: The probe as described.
        films: The network for all films of the layout.
        earlier: Estimate of the film from an earlier calibration, as `read_earlier` returns it; None for the sensor as
            described.
        stress_limit: Largest stress of the film in a proposed press, MPa.
        friction: Expected coefficient of friction between tip and film, for presses on a vertical stage; 0 if the
            presses have no friction.
        side_force: Largest side force over the force that contacts of the calibrated model may have in any direction.

    Example:
        >>> problem = CalibrationProblem.of(load_sensor("four-25um-biaxial"), Circle(1.0))  # doctest: +SKIP
        >>> result = calibrate(read_presses(Path("presses.csv")), problem)  # doctest: +SKIP
        >>> write_calibration(result, Path("my-film"))  # doctest: +SKIP
    """

    sensor: Sensor
    probe: Circle
    films: FilmsModel
    earlier: FilmEstimate | None = None
    stress_limit: float = DEFAULT_STRESS_LIMIT
    friction: float = 0.0
    side_force: float = 0.0

    @classmethod
    def of(cls, sensor: Sensor, probe: Probe, models: Path | None = None) -> "CalibrationProblem":
        """Create the problem of a sensor and a probe, and find the installed network that fits them.

        Args:
            sensor: The sensor; see `films_for`.
            probe: The probe.
            models: Folder of models that is searched first.

        Raises:
            SceneError: If the probe is not a circle.
            ModelError: If no network was trained for this layout; the message says how to train one.
        """
        if not isinstance(probe, Circle):
            raise SceneError(
                f"probe {probe.notation}: expected a circle, such as circle:1.0, because its radius is calibrated as "
                "well"
            )
        return cls(sensor, probe, films_for(sensor, probe, models))

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the electrodes of the sensor."""
        return self.sensor.electrode_names

    @cached_property
    def prior(self) -> FilmPrior:
        """Distribution of the films, with the electrodes and traces of the sensor."""
        return _with_electrodes(self.films.prior, self.sensor)

    @cached_property
    def charges(self) -> FilmCharges:
        """Charges of the films."""
        return FilmCharges(self.prior, self.films.family)

    def fitted(
        self,
        parameters: Array,
        added_variance: AddedVariance,
        factor: Callable[[Array], Array],
        *,
        release: bool = True,
    ) -> Fitted:
        """Return the network of a film, adapted to the charges of this film and sensor.

        The charges that follow from the parameters of the film are multiplied by a given factor. If the sensor has
        other electrodes than the network for all films, the ratio of the charges of both is a further factor.

        Args:
            parameters: Parameters of the film, shape (n_parameter,).
            added_variance: Variances that are added to those of the network.
            factor: Function of contacts (x, y, F), shape (n, 3), mm and N. It returns factors on the charges, shape (n,
                n_electrode).
            release: Whether the network will be released. Only a network that will be released learns correlations and
                gets presses on which its errors are measured.
        """
        options: dict[str, Any] = {} if release else {"correlation": False, "n_test": 0}
        sensor_map = self.charges.forward_map(parameters)
        network_map = self.films.forward_map(parameters)

        has_same_electrodes = self.prior is self.films.prior  # otherwise, the electrodes of the prior were replaced

        def charge_factor(contact: Array) -> Array:
            """Return the ratio of the film's charges to those of the training, shape (n, n_electrode).

            Args:
                contact: Contacts (x, y, F), shape (n, 3), mm and N.
            """
            if has_same_electrodes:
                return factor(contact)
            electrode_factor = sensor_map.charges(contact) / network_map.charges(contact)
            return np.asarray(factor(contact) * electrode_factor)

        fitted = self.films.film(parameters, added_variance=added_variance, charge_factor=charge_factor, **options)
        return replace(fitted, sensor=sensor_map.sensor)

    @property
    def domain(self) -> Domain:
        """Contacts for which the sensor is calibrated."""
        return self.films.domain

    @cached_property
    def proposed_forces(self) -> tuple[float, float]:
        """Smallest and largest force of a proposed press, N, which are within the domain and the stress limit.

        Raises:
            SceneError: If the smallest force already exceeds the limit.
        """
        force_range = self.domain.force_range
        smallest_force, _ = force_range
        return smallest_force, force_within_stress(self.sensor.film, self.probe, self.stress_limit, force_range)

    @property
    def noise(self) -> NoiseModel:
        """Noise of the charges."""
        return self.films.noise

    @cached_property
    def before(self) -> FilmEstimate:
        """Estimate of the film before the presses: the earlier calibration, or the film of the sensor file."""
        if self.earlier:
            return self.earlier
        parameters = self.prior.parameters_of(self.sensor, self.probe)
        pretension = self.prior.index("pretension")
        # A sensor file without a pretension has the value 0, but its film is not necessarily slack.
        if parameters[pretension] <= 0.0:
            parameters[pretension] = self.prior.mean[pretension]
        prior_covariance = np.eye(parameters.size)  # in units of the prior standard deviations
        return FilmEstimate(parameters, prior_covariance)

    @cached_property
    def expected(self) -> FilmEstimate:
        """Estimate of the film with which presses are planned.

        Without an earlier calibration, the estimate includes the imperfections of `PLANNED_IMPERFECTIONS`.
        """
        if self.earlier:
            return self.before
        layout = self.charges.layout
        joint = PLANNED_IMPERFECTIONS.covariance(layout)[layout.film, layout.film]
        joint[layout.parameters, layout.parameters] += self.before.covariance
        return replace(self.before, coefficients=np.zeros(layout.coefficient_count), joint=joint)


def films_for(sensor: Sensor, probe: Circle, models: Path | None = None) -> FilmsModel:
    """Find the network that was trained for all films with the electrodes of a sensor.

    The networks are tried in order until one fits. The name of the sensor does not matter.

    Args:
        sensor: The sensor. The pads, the radius of the film and the readout must be the same as in the training of the
            network. All other properties may differ within the spread of the films, and the electrodes may have traces
            and patterned backs.
        probe: The probe. Its radius must be within the spread of the films.
        models: Folder of models that is searched first.

    Returns:
        The first network that fits.

    Raises:
        ModelError: If no network was trained for this layout; the message says how to train one.
    """
    reasons = []
    for folder in _network_folders(models, sensor.name):
        films = read_films(folder)
        try:
            parameters = _with_electrodes(films.prior, sensor).parameters_of(sensor, probe)
        except SensorError as error:
            reasons.append(f"{folder.parent.name}: {error}")
            continue

        # The parameters of the sensor must lie in the range for which the network was trained.
        lower, upper = films.prior.bounds
        is_outside = (parameters < lower) | (parameters > upper)
        if not is_outside.any():
            return films
        outside_names = np.array(films.prior.names)[is_outside]
        reasons.append(
            f"{folder.parent.name}: {', '.join(outside_names)}: farther from its films than it was trained for"
        )
    raise ModelError(
        f"no network for all films fits the sensor {sensor.name!r} under {probe.notation} "
        f"({'; '.join(reasons) or 'none is installed'}); train one first, once for a layout: "
        f"isocharge train fit --films --sensor SENSOR -o models/{sensor.name}-films"
    )


def _with_electrodes(prior: FilmPrior, sensor: Sensor) -> FilmPrior:
    """Return a prior with the electrodes of a sensor, if the pads of both are equal; otherwise, return the given prior.

    The electrodes of the sensor may have traces and patterned backs.
    """
    has_other_pads = _pad_corners(prior.sensor) != _pad_corners(sensor)
    has_equal_electrodes = prior.sensor.electrodes == sensor.electrodes
    if has_other_pads or has_equal_electrodes:
        return prior
    return replace(prior, sensor=replace(prior.sensor, electrodes=sensor.electrodes))


def _pad_corners(sensor: Sensor) -> dict[str, list[list[float]]]:
    """Return the corners of the pads by the names of the electrodes, rounded to 1e-6 mm."""
    return {electrode.name: np.round(electrode.corners, 6).tolist() for electrode in sensor.electrodes}


def _network_folders(models: Path | None, name: str) -> list[Path]:
    """Return the version folders that contain a network for all films.

    The folders of models that have the name of the sensor come first.

    Args:
        models: Folder of models that is searched first.
        name: Name of the sensor.
    """
    folders_with_network = []
    for root in repositories(models):
        for model in model_names(root):
            version_folder = find_model((root / model).resolve())
            if (version_folder / FILE).is_file():
                folders_with_network.append(version_folder)

    def has_other_name(version_folder: Path) -> bool:
        """Return whether the name of a model does not begin with the name of the sensor. False is sorted first."""
        return not version_folder.parent.name.startswith(name)

    return sorted(folders_with_network, key=has_other_name)
