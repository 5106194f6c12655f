"""Problem of a calibration, with the prior distribution of the films and the network for all films."""

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
from isocharge.train.films.films_model import AddedCovariance, FilmsModel
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
"""Standard deviation of the change of each parameter since an earlier calibration, in prior standard deviations.

The keys are fields of `FilmSpread`.

The values correspond to 0.35 MPa of the pretension (creep and a degree of temperature), 1 % of the piezoelectric
coefficients and 0.5 % of the gains. Presses with a known force can also reveal larger changes. Touches with an unknown
force can only show a change of the pretension."""

COEFFICIENT_DRIFT_STD = 0.002
"""Standard deviation of the change of the coefficients of a discrepancy since an earlier calibration."""

CREEP = 0.1
"""Standard deviation of the change of the pretension by creep, in prior standard deviations.

It replaces the value in `DRIFT` if the temperatures of both calibrations are known. The effect of the temperature is
then computed, and only creep remains."""

PLANNED_IMPERFECTIONS = Hypothesis(modes=0.5, discrepancy=0.01)
"""Imperfections that are assumed when presses are planned. They are half as large as on typical imperfect films.

If smaller imperfections are assumed, the remaining errors on imperfect films are 1.5 times as large. On a film without
imperfections, the assumption does not change the error after eight presses, and increases it by 7 % after five."""

MAX_IDENTIFIED_STD_RATIO = 0.5
"""Ratio of the standard deviation after the presses to that before, up to which a quantity counts as identified."""


class Warming(NamedTuple):
    """Change of the pretension of a film with temperature.

    Attributes:
        MPa_per_K: Change of the pretension per kelvin, MPa/K.
        std: Standard deviation of `MPa_per_K`, MPa/K.
        at_C: Temperature at which the film has its estimated parameters, degrees Celsius.
        covariance: Covariance of `MPa_per_K` with each unknown of the film, shape (n_unknown,), MPa/K. Parameters are
            in units of their prior standard deviations.
    """

    MPa_per_K: float
    std: float
    at_C: float
    covariance: Array

    @property
    def identified(self) -> bool:
        """Whether the presses have reduced the standard deviation of the change per kelvin to half or less."""
        return self.std <= MAX_IDENTIFIED_STD_RATIO * PRETENSION_PER_KELVIN.std_with_temperatures

    def with_unknowns(self, count: int) -> "Warming":
        """Return a copy with a covariance for another number of unknowns.

        Args:
            count: New number of unknowns. If it is smaller, the last unknowns are removed. If it is larger, unknowns
                with a covariance of zero are appended.
        """
        shared_count = min(count, self.covariance.size)
        covariance = np.zeros(count)
        covariance[:shared_count] = self.covariance[:shared_count]
        return self._replace(covariance=covariance)


@dataclass(frozen=True)
class FilmEstimate:
    """Estimate of a film, which is a Gaussian distribution of the film's unknowns.

    Attributes:
        parameters: Best parameters, as in `FilmPrior`, shape (n_parameter,).
        covariance: Covariance of the parameters in units of their prior standard deviations, shape
            (n_parameter, n_parameter).
        coefficients: Coefficients of imperfections, traces and discrepancy, shape (n_coefficient,); empty if the
            estimate has no coefficients.
        joint: Covariance of parameters and coefficients together, shape (n_parameter + n_coefficient, n_parameter +
            n_coefficient); empty if the estimate has no coefficients.
        warming: Change of the pretension with temperature; None if the temperatures of the presses are not known.
    """

    parameters: Array
    covariance: Array
    coefficients: Array = field(default_factory=lambda: np.empty(0))
    joint: Array = field(default_factory=lambda: np.empty((0, 0)))
    warming: Warming | None = None

    @property
    def unknowns(self) -> Array:
        """Parameters in their own units, followed by the coefficients if the estimate has any."""
        return np.concatenate([self.parameters, self.coefficients])

    @property
    def unknown_covariance(self) -> Array:
        """Covariance of `unknowns`, with parameters in units of their prior standard deviations."""
        return self.joint if self.coefficients.size else self.covariance

    def drifted(self, prior: FilmPrior, *, knows_temperature: bool = False) -> "FilmEstimate":
        """Return the estimate for a later time, with the possible drift of the film added to the covariance.

        The parameters drift independently of each other. If the temperatures at both times are known, only creep
        contributes to the drift of the pretension.

        Args:
            prior: Distribution of the films, with the bounds of the parameters.
            knows_temperature: Whether the temperature at the later time is known.
        """
        drift_std = np.array([DRIFT[parameter.spread] for parameter in prior.parameters])
        if knows_temperature and self.warming is not None:
            drift_std[prior.index("pretension")] = CREEP
        covariance = self.covariance + np.diag(drift_std**2)

        # The coefficients also drift, if the estimate has coefficients.
        joint = self.joint
        if joint.size:
            coefficient_drift_std = np.full(self.coefficients.size, COEFFICIENT_DRIFT_STD)
            joint_drift_std = np.concatenate([drift_std, coefficient_drift_std])
            joint = joint + np.diag(joint_drift_std**2)
        parameters = np.clip(self.parameters, *prior.bounds)
        return FilmEstimate(parameters, covariance, self.coefficients, joint, self.warming)

    def at_temperature(self, at_C: float, prior: FilmPrior) -> "FilmEstimate":
        """Return the estimate of the film for another temperature.

        Only the pretension changes, in proportion to the change of the temperature. If `warming` is None, the function
        returns the estimate unchanged, because the temperature of the film is unknown.

        Args:
            at_C: The other temperature, degrees Celsius.
            prior: Distribution of the films, with the bounds of the parameters.

        Raises:
            PressError: If the pretension at the other temperature would be outside its bounds.
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

        change_in_prior_stds = change_K / prior.std[pretension]
        covariance, warming_covariance = self._covariance_after_warming(self.warming, change_in_prior_stds, pretension)
        n_parameter = len(parameters)
        return FilmEstimate(
            parameters=parameters,
            covariance=covariance[:n_parameter, :n_parameter],
            coefficients=self.coefficients,
            joint=covariance if self.joint.size else self.joint,
            warming=self.warming._replace(at_C=at_C, covariance=warming_covariance),
        )

    def _covariance_after_warming(self, warming: Warming, change: float, pretension: int) -> tuple[Array, Array]:
        """Compute the covariances of the unknowns after the pretension T has changed to T + k w.

        Here w is the change of the pretension per kelvin, and k is the change of the temperature.

        Args:
            warming: The value w, with its standard deviation and its covariances with the unknowns.
            change: Change k, in K, divided by the prior standard deviation of the pretension.
            pretension: Index of the pretension among the unknowns.

        Returns:
            Covariance of the unknowns, shape (n, n), and covariances of w with the unknowns, shape (n,).
        """
        covariance = self.unknown_covariance.copy()
        warming_covariance = warming.covariance.copy()

        # Replace T by T + k w, first in the rows of the covariance: cov(T + k w, u) for every unknown u.
        covariance[pretension] += change * warming_covariance
        # cov(w, T + k w)
        warming_covariance[pretension] += change * warming.std**2
        # Replace T in the columns. This step uses the covariance of w with the new pretension, because the pretension
        # of the row was already replaced.
        covariance[:, pretension] += change * warming_covariance
        return covariance, warming_covariance


@dataclass(frozen=True)
class CalibrationProblem:
    """Problem of a calibration, with the films that a sensor may have and the range of contacts.

    Attributes:
        sensor: The sensor as described in its file.
        probe: The probe as described.
        films: The network for all films with the layout of the sensor.
        earlier: Estimate of the film from an earlier calibration, as `read_earlier` returns it. If it is None, the
            sensor file is the estimate before the presses.
        stress_limit: Largest stress of the film that a proposed press may cause, MPa.
        friction: Expected coefficient of friction between tip and film, for presses on a vertical stage; 0 if the
            presses have no friction.
        side_force: Largest side force of later contacts in any direction, divided by the force of the contact.

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
        """Create the problem for a sensor and a probe, and find an installed network that fits them.

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
        """Prior distribution of the films, with the electrodes and traces of the sensor."""
        return _with_electrodes(self.films.prior, self.sensor)

    @cached_property
    def charges(self) -> FilmCharges:
        """Model of the charges of all films."""
        return FilmCharges(self.prior, self.films.family)

    def fitted(
        self,
        parameters: Array,
        added_covariance: AddedCovariance,
        film_factor_of: Callable[[Array], Array],
        *,
        release: bool = True,
    ) -> Fitted:
        """Return a network for one film, which is derived from the network for all films.

        The network for all films is given only the parameters of a film. The real charges may differ from the charges
        that this network expects, for two reasons. First, effects such as imperfections multiply the charges by given
        factors. Second, the sensor may have other electrodes than the sensor of the network for all films. Therefore,
        the network is adapted to the ratio of real to expected charges.

        Args:
            parameters: Parameters of the film, shape (n_parameter,).
            added_covariance: Covariances of errors that are added to those that noise causes.
            film_factor_of: Function that converts contacts (x, y, F), shape (n, 3), mm and N, into factors on the
                charges, shape (n, n_electrode).
            release: Whether the network will be released. Only a network that will be released learns correlations and
                gets presses on which its errors are measured.
        """
        options: dict[str, Any] = {} if release else {"correlation": False, "n_test": 0}
        sensor_map = self.charges.forward_map(parameters)
        network_map = self.films.forward_map(parameters)
        # The property `prior` is a new object if and only if the electrodes in the prior of the network were replaced.
        has_same_electrodes = self.prior is self.films.prior

        def charge_factor(contact: Array) -> Array:
            """Return the ratio of the real charges of the film to the charges that the network for all films expects.

            Args:
                contact: Contacts (x, y, F), shape (n, 3), mm and N.

            Returns:
                Ratios, shape (n, n_electrode).
            """
            film_factor = film_factor_of(contact)
            if has_same_electrodes:
                return film_factor
            electrode_factor = sensor_map.charges(contact) / network_map.charges(contact)
            return np.asarray(film_factor * electrode_factor)

        fitted = self.films.film(parameters, added_covariance=added_covariance, charge_factor=charge_factor, **options)
        return replace(fitted, sensor=sensor_map.sensor)

    @property
    def domain(self) -> Domain:
        """Contacts for which the sensor is calibrated."""
        return self.films.domain

    @cached_property
    def proposed_forces(self) -> tuple[float, float]:
        """Smallest and largest force of a proposed press, N. Both forces are within the domain and the stress limit.

        Raises:
            SceneError: If the smallest force of the domain already exceeds the stress limit.
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
        """Estimate of the film before the presses.

        If there is an earlier calibration, its estimate is used. Otherwise, the estimate is the film of the sensor
        file.
        """
        if self.earlier:
            return self.earlier
        parameters = self.prior.parameters_of(self.sensor, self.probe)
        pretension = self.prior.index("pretension")
        # A pretension of 0 means that the sensor file does not state one. The film is not necessarily slack.
        if parameters[pretension] <= 0.0:
            parameters[pretension] = self.prior.mean[pretension]
        prior_covariance = np.eye(parameters.size)  # in units of the prior standard deviations
        return FilmEstimate(parameters, prior_covariance)

    @cached_property
    def expected(self) -> FilmEstimate:
        """Estimate of the film, used to plan presses before any press is made.

        Without an earlier calibration, the covariance of this estimate includes `PLANNED_IMPERFECTIONS`.
        """
        if self.earlier:
            return self.before
        layout = self.charges.layout
        joint = PLANNED_IMPERFECTIONS.covariance(layout)[layout.film, layout.film]
        joint[layout.parameters, layout.parameters] += self.before.covariance
        return replace(self.before, coefficients=np.zeros(layout.coefficient_count), joint=joint)


def films_for(sensor: Sensor, probe: Circle, models: Path | None = None) -> FilmsModel:
    """Find a network that was trained for all films with the electrodes of a sensor.

    The installed networks are tried one after the other until one fits. Networks whose names begin with the name of the
    sensor are tried first. Networks with other names may also fit.

    Args:
        sensor: The sensor. Its pads, the radius of its film and its readout must be the same as in the training of the
            network. All other properties may differ within the spread of the films. The electrodes may also have traces
            and patterned backs.
        probe: The probe. Its radius must be within the spread of the films.
        models: Folder of models that is searched first.

    Returns:
        The first network that fits.

    Raises:
        ModelError: If no network was trained for this layout; the message says how to train one.
    """
    reasons = []  # why each network does not fit, for the error message
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
    """If a prior and a sensor have the same pads, replace the electrodes of the prior by those of the sensor.

    The electrodes of the sensor may have traces and patterned backs. If the pads differ, or if the prior has the
    electrodes of the sensor already, the function returns the given prior itself.

    Args:
        prior: Distribution of the films for which a network was trained.
        sensor: Sensor whose electrodes are used.
    """
    has_other_pads = _pad_corners(prior.sensor) != _pad_corners(sensor)
    has_same_electrodes = prior.sensor.electrodes == sensor.electrodes
    if has_other_pads or has_same_electrodes:
        return prior
    return replace(prior, sensor=replace(prior.sensor, electrodes=sensor.electrodes))


def _pad_corners(sensor: Sensor) -> dict[str, list[list[float]]]:
    """Return the corners of each pad by the name of its electrode. The corners are rounded to 1e-6 mm."""
    return {electrode.name: np.round(electrode.corners, 6).tolist() for electrode in sensor.electrodes}


def _network_folders(models: Path | None, name: str) -> list[Path]:
    """Return the version folders that contain a network for all films.

    Models whose names begin with the name of the sensor come first.

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
        """Return whether a model has a name that does not begin with the name of the sensor. False is sorted first."""
        return not version_folder.parent.name.startswith(name)

    return sorted(folders_with_network, key=has_other_name)
