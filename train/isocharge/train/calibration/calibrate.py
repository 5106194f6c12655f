"""Calibration: from measured presses to the film they were made on, with its remaining uncertainty."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy  # loads a part when it is used
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.measured_presses import MeasuredPresses, row_words
from isocharge.common.statistics import rms
from isocharge.simulate import Circle, Sensor
from isocharge.train.calibration.contact_error import ContactError, ContactSensitivity, next_presses
from isocharge.train.calibration.cross_validation import HeldOutAnswers, cross_validate
from isocharge.train.calibration.diagnosis import check_channels, check_places, explain, find_mistakes, misfit
from isocharge.train.calibration.film_fit import MISTAKE_PROBABILITY, PROBABLE, FilmPosterior, fit_film
from isocharge.train.calibration.hypotheses import Hypothesis
from isocharge.train.calibration.nuisances import NUISANCES, NuisanceEstimate
from isocharge.train.calibration.press_data import PressData, temperatures
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate
from isocharge.train.calibration.quantities import Quantity, quantities, summarise
from isocharge.train.films.films_model import AddedVariance
from isocharge.train.training.fitted import Fitted

UNEXPLAINED_PROBABILITY = 1e-6
"""Probability of residuals as large as these, below which no film explains the presses, if they are also large; see
`UNEXPLAINED_CHI2`."""

UNEXPLAINED_CHI2 = 9.0
"""Mean squared residual above which no film explains the presses: three times the noise."""

UNCERTAIN_PROBABILITY = 0.01
"""Probability of residuals as large as these, below which the errors are scaled up by their ratio."""

STRAINED_PROBABILITY = 1e-7
"""Probability of a film as far from the described one as this, below which presses are taken for wrongly written."""

ODD_PROBABILITY = 1e-3
"""Probability of such a film, below which presses are compared with those of common mistakes."""

MISLEADING_MISFIT = 8.0
"""Misfit of presses as they are written, as `misfit` gives it, above which mistakes are looked for before a fit."""

FEW = 3
"""Largest number of presses among which a wrong one cannot be seen; the user is told."""

BOUND_DISTANCE = 0.1
"""Distance from its bound within which a parameter counts as held by the bound, in prior standard deviations."""

PLANNED_PRESSES = 30
"""Number of further presses whose benefit is given, where a film has what no parameter describes."""

VISIBLE_TRACE = 2.0
"""Width of a trace, in its standard deviations, from which on the trace is named."""

CLOSE_MM = 1.0
"""Presses that all lie within this distance of each other do not identify places; the user is told."""


@dataclass(frozen=True)
class CalibrationResult:
    """Calibration of a film: its estimate, and what follows from it.

    Attributes:
        problem: The films that were considered.
        presses: The presses that were fitted.
        posterior: Best parameters, covariance, residuals.
        cautions: Warnings for the user, a sentence each.
        moved: How an earlier calibration was moved to another temperature, without presses; empty with presses.
    """

    problem: CalibrationProblem
    presses: MeasuredPresses
    posterior: FilmPosterior
    cautions: tuple[str, ...] = ()
    moved: str = ""

    @cached_property
    def film(self) -> tuple[Sensor, Circle]:
        """The calibrated sensor and probe."""
        return self.problem.prior.film(self.posterior.parameters)

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """Quantities of the film by name, beside what its description alone gives."""
        return quantities(self.problem.prior, self.posterior)

    @cached_property
    def sensitivity(self) -> ContactSensitivity:
        """How contacts respond to noise and to a wrong film, at the calibrated film."""
        return ContactSensitivity.at(self.problem, self.posterior.unknowns)

    @cached_property
    def error_left(self) -> ContactError:
        """Error of contacts that the remaining uncertainty of the film causes."""
        return self.sensitivity.contact_error(self.posterior.joint)

    @cached_property
    def error_left_before(self) -> ContactError:
        """The same error before the presses, or before the film was moved to another temperature."""
        before = self.problem.before
        count = len(self.posterior.joint)
        estimated = slice(0, len(before.unknowns))
        covariance = np.zeros((count, count))
        covariance[estimated, estimated] = before.unknown_covariance
        if not self.moved:
            return self.sensitivity.contact_error(covariance)
        unknowns = np.zeros(count)
        unknowns[estimated] = before.unknowns
        return ContactSensitivity.at(self.problem, unknowns).contact_error(covariance)

    @property
    def fitted(self) -> Fitted:
        """The network of this film, for `evaluate` and `release`; its deviations contain the film's uncertainty.

        With enough presses its errors are those of the presses, as calibrations without them answer them.
        """
        fitted = self.fitted_film(self.posterior.parameters, release=True)
        if self.held_out is None:
            return fitted
        return replace(fitted, test=self.held_out.presses, cross_validated=self.held_out.answers)

    @cached_property
    def held_out(self) -> HeldOutAnswers | None:
        """Answers to the presses by calibrations without them; None if there are too few presses, see `cross_validate`.

        The answers are computed when they are first used, which takes about as long as the calibration.
        """
        if self.moved:
            return None
        warming = self.posterior.warming
        at_C = None if warming is None else warming.at_C
        return cross_validate(self.problem, self.presses, self.posterior, self._network_of, at_C)

    def fitted_film(self, parameters: Array, *, release: bool = False) -> Fitted:
        """Return the network of a film near this one, with the same discrepancy and the same uncertainty.

        Args:
            parameters: Parameters of the film, shape (n_parameter,).
            release: Whether the network will be released; see `CalibrationProblem.fitted`.
        """
        added_variance = self._added_variance(self.posterior)
        return self.problem.fitted(parameters, added_variance, self._factor, release=release)

    def _network_of(self, film: FilmPosterior) -> Fitted:
        """Return the network of another estimate of the film, with its own discrepancy and uncertainty."""

        def factor(contact: Array) -> Array:
            return self.problem.charges.factor(film.unknowns, contact)

        return self.problem.fitted(film.parameters, self._added_variance(film), factor, release=False)

    def _added_variance(self, film: FilmPosterior) -> AddedVariance:
        """Return the variances of contacts by the uncertainty of a film, linearised at this one."""
        contact_covariance = self.sensitivity.contact_covariance(film.joint)
        return AddedVariance(self.sensitivity.contact, np.einsum("nii->ni", contact_covariance))

    @cached_property
    def _factor(self) -> Callable[[Array], Array]:
        """Factor of the film's discrepancy; answers are cached, since the networks of a film ask for the same."""
        cache: dict[bytes, Array] = {}

        def factor(contact: Array) -> Array:
            keys = [row.tobytes() for row in contact]
            missing = [number for number, key in enumerate(keys) if key not in cache]
            if missing:
                factors = self.problem.charges.factor(self.posterior.unknowns, contact[missing])
                cache.update(zip([keys[number] for number in missing], factors, strict=True))
            return np.stack([cache[key] for key in keys])

        return factor

    @property
    def reduced_chi2(self) -> float:
        """Mean squared residual of the fitted presses over what noise and rig explain; about one."""
        chi2, freedom = self.posterior.total
        return chi2 / freedom if freedom > 0.0 else np.nan

    @property
    def bad_lines(self) -> tuple[int, ...]:
        """Lines of the presses that were left out because they fit no film that the others fit."""
        return self.presses[self.posterior.bad].lines

    @cached_property
    def summary(self) -> tuple[str, ...]:
        """The result in sentences; they are computed once, since they contain a plan of further presses."""
        left = self.error_left
        before = self.error_left_before
        noise = self.sensitivity.noise_error
        when = "it was moved" if self.moved else "these presses"
        errors = (
            f"Not knowing the film leaves {left.position_mm:.2g} mm and {left.force_percent:.2g} % of the "
            f"force (root mean square); before {when} it was {before.position_mm:.2g} mm and "
            f"{before.force_percent:.2g} %. Noise alone leaves {noise.position_mm:.2g} mm and "
            f"{noise.force_percent:.2g} %."
        )
        film = (f"The film was {self.moved}, without presses.",) if self.moved else summarise(self.quantities)
        rig = (
            "Forces are as right as the load cell, and places as the origin and the axes of the stage: an error of "
            "theirs is in every answer, beside these."
        )
        return (
            errors,
            *self._held_out_sentences(),
            *film,
            *self._temperature_sentences(),
            rig,
            *self._discrepancy_sentences(),
            *self.cautions,
        )

    def _held_out_sentences(self) -> Iterator[str]:
        """Yield the errors on presses that were held out, if there are enough."""
        if self.held_out is None:
            return
        held_out_errors = self.held_out.errors
        yield (
            f"Calibrations that each leave out a fifth of the places err on the {len(self.held_out.presses)} presses "
            f"there by {held_out_errors['position_rms_mm']:.2g} mm and {held_out_errors['force_rms_percent']:.2g} % "
            "(root mean square, with the errors of the measured places and forces)."
        )

    def _temperature_sentences(self) -> Iterator[str]:
        """Yield what a kelvin does to the film, if the temperatures of the presses are known."""
        warming = self.posterior.warming
        if warming is None:
            return
        if not warming.identified:
            yield (
                f"The presses were made at {warming.at_C:.1f} C; over more degrees they would tell what a kelvin does."
            )
            return
        yield (
            f"A kelvin more changes the pretension by {warming.MPa_per_K:.3g} +- {warming.std:.2g} MPa. This is the "
            f"film at {warming.at_C:.1f} C; --from with --temperature gives it at another."
        )

    def _discrepancy_sentences(self) -> Iterator[str]:
        """Yield what no parameter describes, and what more presses would do about it."""
        if not self.posterior.imperfect:
            return
        factor = self.problem.charges.factor(self.posterior.unknowns, self.sensitivity.contact)
        percent = 100.0 * rms(np.log(factor))
        plan = next_presses(self.problem, PLANNED_PRESSES, self.posterior)
        places = ", ".join(f"{press.force_N:.2f} N at ({press.x_mm:g}, {press.y_mm:g}) mm" for press in plan[:3])
        yield (
            f"Beyond these parameters, the charges of this film differ by {percent:.2g} % (root mean square), "
            f"smoothly over the film: {self.error_left.position_mm:.2g} mm are left now. {PLANNED_PRESSES} more "
            f"presses would reach {plan[-1].position_mm:.2g} mm, the first of them {places}; --next lists more."
        )
        if self.posterior.probability("traces") > PROBABLE:
            widths = self.problem.charges.trace_widths(self.posterior.unknowns, self.posterior.joint)
            visible = [f"{name} {width:.2g} mm" for name, (width, std) in widths.items() if width > VISIBLE_TRACE * std]
            yield (
                f"Most of it is that electrodes collect beyond their pads, as traces to the rim of this width would: "
                f"{', '.join(visible)}. Described in the sensor file, they leave less."
            )


def calibrate(presses: MeasuredPresses, problem: CalibrationProblem) -> CalibrationResult:
    """Find the film on which presses were made.

    Args:
        presses: The presses in the order in which they were made, with place and force, or one of them. Presses without
            both show how a film has changed since an earlier calibration, if it has more than three electrodes. Their
            standard deviations count.
        problem: The films that it may be.

    Raises:
        PressError: If the presses cannot be as they are written, or no film explains them; the reason is named where it
            is found.
    """
    presses = presses.of_electrodes(problem.electrodes, problem.sensor.name)
    check_places(presses, problem.prior.sensor.film.radius)
    check_channels(presses, problem.charges)
    _check_enough_measured(presses, problem)
    presses, domain_cautions = _within_domain(presses, problem)
    if misfit(presses, problem.charges) > MISLEADING_MISFIT and find_mistakes(presses, problem.charges):
        raise explain(presses, problem.charges, np.nan)
    at_C = None
    if presses.knows_temperature:
        at_C = float(temperatures(presses).mean())
        problem = replace(problem, earlier=problem.before.at_temperature(at_C, problem.prior))
    data = PressData.of(presses, problem.noise, problem.charges.domain)
    with threadpool_limits(1):  # many small matrices: a second thread only waits
        posterior = fit_film(problem.charges, data, problem.before, at_C)
    _refuse_unexplained(presses, problem, posterior)
    posterior, scatter_cautions = _scaled_by_scatter(posterior)
    posterior = _with_unseen_mistakes(posterior, problem.before)
    cautions = (*domain_cautions, *scatter_cautions, *_cautions(presses, problem, posterior))
    return CalibrationResult(problem, presses, posterior, cautions)


def _within_domain(presses: MeasuredPresses, problem: CalibrationProblem) -> tuple[MeasuredPresses, list[str]]:
    """Return the presses whose places and forces the films have charges for, and a caution about the others.

    Raises:
        PressError: If most presses lie outside.
    """
    domain = problem.charges.domain
    is_outside = domain.is_outside(presses.contact)
    if not is_outside.any():
        return presses, []
    low, high = domain.force_range
    words = row_words(presses[is_outside].lines, presses.row_noun)
    sentence = (
        f"{words}: a calibration takes presses within {domain.radius:.3g} mm of the "
        f"centre and of {low:.2g} to {high:.2g} N"
    )
    if is_outside.mean() > 0.5:
        raise explain(presses, problem.charges, np.inf) if len(presses) > 1 else PressError(sentence)
    return presses[~is_outside], [f"{sentence}; left out"]


def _scaled_by_scatter(posterior: FilmPosterior) -> tuple[FilmPosterior, list[str]]:
    """Scale the errors up where the presses scatter more than they should, by Birge's ratio (1932)."""
    chi2, freedom = posterior.total
    if freedom == 0.0 or scipy.stats.chi2.sf(chi2, freedom) >= UNCERTAIN_PROBABILITY:
        return posterior, []
    caution = (
        f"the presses scatter {np.sqrt(chi2 / freedom):.2g} times as much as noise and rig are said to; the errors "
        "are given larger by this factor: are places and forces as certain as assumed?"
    )
    return posterior.scaled(chi2 / freedom), [caution]


def film_without_presses(problem: CalibrationProblem, film: FilmEstimate, moved: str) -> CalibrationResult:
    """Return an estimate of a film as a calibration result without presses.

    Args:
        problem: The calibration.
        film: The estimate.
        moved: How an earlier calibration was moved to another temperature, for people.
    """
    layout = problem.charges.layout
    joint = np.zeros((layout.film_count, layout.film_count))
    estimated = slice(0, len(film.unknowns))
    joint[estimated, estimated] = film.unknown_covariance
    has_coefficients = film.coefficients.size > 0
    posterior = FilmPosterior(
        parameters=film.parameters,
        covariance=film.covariance,
        coefficients=film.coefficients if has_coefficients else np.zeros(layout.coefficient_count),
        joint=joint,
        warming=film.warming and film.warming.with_unknowns(layout.film_count),
        contact=np.empty((0, 3)),
        chi2=np.empty(0),
        degrees_of_freedom=np.empty(0),
        bad=np.empty(0, dtype=bool),
        nuisances={nuisance.name: NuisanceEstimate(0.0, 0.0) for nuisance in NUISANCES},
        force_scatter=0.0,
        probabilities={Hypothesis(modes=float(has_coefficients)): 1.0},
    )
    return CalibrationResult(problem, no_presses(problem.electrodes), posterior, moved=moved)


def no_presses(electrodes: tuple[str, ...]) -> MeasuredPresses:
    """What was measured before the first press."""
    none = np.empty(0)
    return MeasuredPresses(np.empty((0, 3)), np.empty((0, len(electrodes))), none, none, electrodes, ())


def _check_enough_measured(presses: MeasuredPresses, problem: CalibrationProblem) -> None:
    """Refuse presses without place and force where charges alone say nothing about the film."""
    if np.isnan(presses.contact).all() and len(problem.electrodes) <= 3:
        raise PressError(
            f"{len(presses)} presses of unknown place and force: three charges are used up by x, y and force, so they "
            "tell nothing of the film; give the place or the force of a press (four electrodes would have one charge "
            "to spare)"
        )


def _refuse_unexplained(presses: MeasuredPresses, problem: CalibrationProblem, posterior: FilmPosterior) -> None:
    """Raise PressError if no film explains the presses, or only a film that hardly exists."""
    chi2, freedom = posterior.total
    is_unexplained = (
        freedom > 0.0
        and chi2 / freedom > UNEXPLAINED_CHI2
        and scipy.stats.chi2.sf(chi2, freedom) < UNEXPLAINED_PROBABILITY
    )
    deviation = (posterior.parameters - problem.before.parameters) / problem.prior.std
    strain = float(deviation @ np.linalg.solve(problem.before.covariance, deviation))
    probability = scipy.stats.chi2.sf(strain, deviation.size)
    is_strange = posterior.imperfect or posterior.bad.any() or probability < ODD_PROBABILITY
    # a few presses with a common mistake may find a film that exists, but is strange
    is_mistaken = is_strange and bool(find_mistakes(presses, problem.charges))
    if is_unexplained or probability < STRAINED_PROBABILITY or is_mistaken:
        worst = max(chi2 / max(freedom, 1.0), strain / deviation.size)
        raise explain(presses, problem.charges, float(np.sqrt(worst)))


def _with_unseen_mistakes(posterior: FilmPosterior, before: FilmEstimate) -> FilmPosterior:
    """Allow for wrong presses that so few presses cannot show.

    With the probability of such a press, the film is only known as before the presses.
    """
    good_count = int((~posterior.bad).sum())
    left_out_count = int(posterior.bad.sum())
    probability = min(left_out_count / (good_count * good_count), 0.5)
    if good_count <= FEW:
        probability += MISTAKE_PROBABILITY * good_count
    joint = (1.0 - probability) * posterior.joint
    estimated = slice(0, len(before.unknowns))
    joint[estimated, estimated] += probability * before.unknown_covariance
    warming = posterior.warming
    if warming is not None:
        warming = warming._replace(covariance=(1.0 - probability) * warming.covariance)
    count = len(before.parameters)
    return replace(posterior, joint=joint, covariance=joint[:count, :count], warming=warming)


def _cautions(presses: MeasuredPresses, problem: CalibrationProblem, posterior: FilmPosterior) -> Iterator[str]:
    """Yield warnings for the user, a sentence each."""
    if posterior.bad.any():
        lines = row_words(presses[posterior.bad].lines, presses.row_noun)
        yield f"{lines}: left out, since no film fits them and all others; look at them again"
    good = presses[~posterior.bad]
    if len(good) <= FEW:
        noun = "presses" if len(good) > 1 else "press"
        yield (
            f"only {len(good)} {noun}: a wrong one among so few cannot be seen, and the "
            "errors allow for it; more than three tell far more"
        )
    for nuisance in NUISANCES:
        if posterior.probability(nuisance.name) > PROBABLE:
            yield nuisance.caution(posterior.nuisances[nuisance.name])
    if posterior.probability("force_scatter") > PROBABLE:
        yield (
            f"the forces scatter by {100.0 * posterior.force_scatter:.2g} % about those of the charges, in addition to "
            "their stated standard deviation: are force and charges read at the same moment, or does charge leak in "
            "between? An effect that lowers charges at random also lowers their mean. The stated errors include it"
        )
    held = _parameters_at_bounds(problem, posterior)
    if held:
        yield (
            f"as far from their description as a film may be: {', '.join(held)}; the errors may "
            "be larger than is said. Are the sensor file, and the origin and axes of the stage, those of this film?"
        )
    places = good.contact[np.isfinite(good.contact[:, 0]), :2]
    if len(places) > 1 and np.ptp(places, axis=0).max() < CLOSE_MM:
        yield (
            f"all presses lie within {np.ptp(places, axis=0).max():.2g} mm of each other: they cannot tell where the "
            "electrodes are, nor how the film answers elsewhere; press at places spread over the working area"
        )
    if not len(places):
        yield (
            "no place is known: positions will be right only up to the shift and the turn of the electrodes "
            "themselves, and if the charges are in the right columns"
        )


def _parameters_at_bounds(problem: CalibrationProblem, posterior: FilmPosterior) -> list[str]:
    """Return the names of the parameters that their bounds hold; no pretension is no such bound."""
    prior = problem.prior
    lower, upper = prior.bounds
    margin = BOUND_DISTANCE * prior.std
    is_low = (posterior.parameters < lower + margin) & (lower < 0.0)
    is_high = posterior.parameters > upper - margin
    return [name for name, is_held in zip(prior.names, is_low | is_high, strict=True) if is_held]
