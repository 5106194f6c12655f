"""What a calibration is about: the film as it is described, and the network for all films that fits its layout."""

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

DRIFT = {"pretension": 0.4, "d31": 0.05, "d32": 0.05, "gain": 0.1}
"""Standard deviations of what may have changed since an earlier calibration, over those of the prior: creep of the
pretension and a degree of temperature 0.35 MPa, coefficients 1 %, gains 0.5 %; everything else by `REMOUNTED`. What
presses of known force show beyond that, they show in spite of it; touches of unknown force can only follow the
pretension."""

REMOUNTED = 0.03
"""See `DRIFT`."""

UNSTEADY = 0.002
"""Standard deviation by which coefficients of a discrepancy may have changed."""

THERMOMETER = 0.1
"""Standard deviation of the same for the pretension where the temperatures of both days are known: creep."""

LIKELY = Hypothesis(modes=0.5, size=0.01)
"""What presses are planned for besides a film of the prior: half of what imperfect films have. Plans for less leave
half as much again of such films, and this one leaves as much of a film of the prior after eight presses, 7 % more after
five."""

IDENTIFIED = 0.5
"""Standard deviation after the presses over that before, below which a quantity counts as identified, dimensionless."""


class Warming(NamedTuple):
    """What temperature does to the pretension of a film.

    Attributes:
        MPa_per_K: Change of the pretension.
        std: Its standard deviation, MPa/K.
        at_C: Temperature at which the film is given, degrees Celsius.
        covariance: Of this change and the film's unknowns, parameters over their prior standard deviations, shape
            (n_unknown,), MPa/K.
    """

    MPa_per_K: float
    std: float
    at_C: float
    covariance: Array

    @property
    def identified(self) -> bool:
        """Whether presses have at least halved its standard deviation."""
        return self.std <= IDENTIFIED * PRETENSION_PER_KELVIN.std_with_temperatures

    def with_unknowns(self, count: int) -> "Warming":
        """Return the change beside the first unknowns of a film, or beside more, which do not depend on it."""
        return self._replace(covariance=np.pad(self.covariance, (0, count))[:count])


@dataclass(frozen=True)
class FilmEstimate:
    """Estimate of a film: a Gaussian about its best parameters.

    Attributes:
        parameters: Parameters, as in `FilmPrior`, shape (n_parameter,).
        covariance: Covariance of the parameters over their prior standard deviations, shape (n_parameter, n_parameter).
        coefficients: Coefficients of the discrepancy, shape (n_coefficient,); empty if there is none.
        joint: Covariance of parameters and coefficients, shape (n_parameter + n_coefficient,) twice; empty if there is
            no discrepancy.
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
        """Return the estimate after the film may have drifted (`DRIFT`).

        Args:
            prior: The films.
            knows_temperature: Whether temperatures are known since as well.
        """
        drift_std = np.array([DRIFT.get(name.partition(" ")[0], REMOUNTED) for name in prior.names])
        if knows_temperature and self.warming is not None:
            drift_std[prior.index("pretension")] = THERMOMETER
        covariance = self.covariance + np.diag(drift_std**2)
        joint = self.joint
        if joint.size:
            coefficient_std = np.full(self.coefficients.size, UNSTEADY)
            joint = joint + np.diag(np.concatenate([drift_std, coefficient_std]) ** 2)
        parameters = np.clip(self.parameters, *prior.bounds)
        return FilmEstimate(parameters, covariance, self.coefficients, joint, self.warming)

    def at_temperature(self, at_C: float, prior: FilmPrior) -> "FilmEstimate":
        """Return the film at another temperature, a linear map of the estimate: there and back is the same film.

        Without `warming` the temperature of the estimate is unknown, and the estimate stays as it is.

        Raises:
            PressError: If the films do not reach so far.
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
        scaled_change = change_K / prior.std[pretension]
        covariance = self.unknown_covariance.copy()
        warming_covariance = self.warming.covariance.copy()
        covariance[pretension] += scaled_change * warming_covariance
        warming_covariance[pretension] += scaled_change * self.warming.std**2
        covariance[:, pretension] += scaled_change * warming_covariance
        count = len(parameters)
        return FilmEstimate(
            parameters=parameters,
            covariance=covariance[:count, :count],
            coefficients=self.coefficients,
            joint=covariance if self.joint.size else self.joint,
            warming=self.warming._replace(at_C=at_C, covariance=warming_covariance),
        )


@dataclass(frozen=True)
class CalibrationProblem:
    """Which films a sensor may be, and where contacts shall be right.

    Attributes:
        sensor: As described.
        probe: As described.
        films: The network for all films of the layout.
        earlier: An earlier calibration of this film, as `read_earlier` gives it; what the sensor's file says if absent.
        stress_limit: Largest stress of the film in a press that is proposed, MPa.

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

    @classmethod
    def of(cls, sensor: Sensor, probe: Probe, models: Path | None = None) -> "CalibrationProblem":
        """A sensor and a probe, with the installed network that fits them; arguments as `films_for`.

        Raises:
            SceneError: If the probe is not round.
            ModelError: If no network was trained for this layout; the message says how to train one.
        """
        if not isinstance(probe, Circle):
            raise SceneError(
                f"probe {probe.notation}: expected a round one, such as circle:1.0, for its radius is calibrated as "
                "well"
            )
        return cls(sensor, probe, films_for(sensor, probe, models))

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the electrodes."""
        return self.sensor.electrode_names

    @cached_property
    def prior(self) -> FilmPrior:
        """How films spread; their electrodes are as described, traces included."""
        return _with_electrodes(self.films.prior, self.sensor)

    @cached_property
    def charges(self) -> FilmCharges:
        """The films' charges."""
        return FilmCharges(self.prior, self.films.family)

    def fitted(
        self,
        parameters: Array,
        added_variance: AddedVariance,
        factor: Callable[[Array], Array],
        *,
        release: bool = True,
    ) -> Fitted:
        """The network of a film, arguments as `FilmsModel.film` takes them.

        The network is changed for its factor and for what only the described electrodes have. Only one for `release`
        learns correlations and is judged.
        """
        about: dict[str, Any] = {} if release else {"correlation": False, "n_test": 0}
        described, own = self.charges.forward_map(parameters), self.films.forward_map(parameters)

        def over_own(contact: Array) -> Array:
            if self.prior is self.films.prior:
                return factor(contact)
            return np.asarray(factor(contact) * described.charges(contact) / own.charges(contact))

        fitted = self.films.film(parameters, added_variance=added_variance, charge_factor=over_own, **about)
        return replace(fitted, sensor=described.sensor)

    @property
    def domain(self) -> Domain:
        """Where contacts shall be right."""
        return self.films.domain

    @cached_property
    def proposed_forces(self) -> tuple[float, float]:
        """Smallest and largest force of a press that is proposed, N: those of the domain within the stress limit.

        Raises:
            SceneError: If the smallest force already exceeds the limit.
        """
        domain = self.domain.force_range
        return domain[0], force_within_stress(self.sensor.film, self.probe, self.stress_limit, domain)

    @property
    def noise(self) -> NoiseModel:
        """Of the charges."""
        return self.films.noise

    @cached_property
    def before(self) -> FilmEstimate:
        """What is known of the film before the presses."""
        if self.earlier:
            return self.earlier
        parameters = self.prior.parameters_of(self.sensor, self.probe)
        pretension = self.prior.index("pretension")
        if parameters[pretension] <= 0.0:  # a sensor file that gives no pretension does not say that there is none
            parameters[pretension] = self.prior.mean[pretension]
        return FilmEstimate(parameters, np.eye(parameters.size))

    @cached_property
    def expected(self) -> FilmEstimate:
        """The same for a plan of presses: a film of which no press has told anything may have `LIKELY` besides."""
        if self.earlier:
            return self.before
        layout = self.charges.layout
        joint = LIKELY.covariance(layout)[layout.film, layout.film]
        joint[layout.parameters, layout.parameters] += self.before.covariance
        return replace(self.before, coefficients=np.zeros(layout.coefficient_count), joint=joint)


def films_for(sensor: Sensor, probe: Circle, models: Path | None = None) -> FilmsModel:
    """The network for all films of a sensor's layout, looked up by the electrodes, not by the name.

    Args:
        sensor: Its pads, radius and readout must be those of a network's; everything else may differ within the spread
            of its films, and electrodes may have traces and patterned backs besides.
        probe: What presses; its radius must be within the spread as well.
        models: Folder of models that is searched first.

    Raises:
        ModelError: If no network was trained for this layout; the message says how to train one.
    """
    reasons = []
    for folder in _folders(models, sensor.name):
        films = read_films(folder)
        try:
            parameters = _with_electrodes(films.prior, sensor).parameters_of(sensor, probe)
        except SensorError as error:
            reasons.append(f"{folder.parent.name}: {error}")
            continue
        low, high = films.prior.bounds
        outside = np.array(films.prior.names)[(parameters < low) | (parameters > high)]
        if not outside.size:
            return films
        reasons.append(f"{folder.parent.name}: {', '.join(outside)}: farther from its films than it was trained for")
    raise ModelError(
        f"no network for all films fits the sensor {sensor.name!r} under {probe.notation} "
        f"({'; '.join(reasons) or 'none is installed'}); train one first, once for a layout: "
        f"isocharge train fit --films --sensor SENSOR -o models/{sensor.name}-films"
    )


def _with_electrodes(prior: FilmPrior, sensor: Sensor) -> FilmPrior:
    """The prior with a sensor's electrodes if their pads are its own: they may have traces and patterned backs."""
    own, pads = ({e.name: np.round(e.corners, 6).tolist() for e in each.electrodes} for each in (prior.sensor, sensor))
    if own != pads or prior.sensor.electrodes == sensor.electrodes:
        return prior
    return replace(prior, sensor=replace(prior.sensor, electrodes=sensor.electrodes))


def _folders(models: Path | None, name: str) -> list[Path]:
    """Version folders with a films file, those named after the sensor first."""
    folders = [find_model((root / model).resolve()) for root in repositories(models) for model in model_names(root)]
    with_films = [folder for folder in folders if (folder / FILE).is_file()]
    return sorted(with_films, key=lambda folder: not folder.parent.name.startswith(name))
