"""Calibration: from measured presses to the film they were made on, with its remaining uncertainty."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import scipy  # loads a part when it is used
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.measured_presses import MeasuredPresses, row_words
from isocharge.common.statistics import rms
from isocharge.simulate import Circle, Sensor
from isocharge.train.calibration.closed_back import CLOSED_BACK_CAUTION, has_closed_back, refuse_closed_back
from isocharge.train.calibration.contact_error import ContactError, ContactSensitivity, next_presses
from isocharge.train.calibration.cross_validation import HeldOutAnswers, cross_validate
from isocharge.train.calibration.diagnosis import (
    FAR_FROM_ALL_FILMS,
    MOSTLY_OUTSIDE,
    check_channels,
    check_places,
    find_mistakes,
    large_residual,
    misfit,
    unexplained_error,
)
from isocharge.train.calibration.film_fit import MISTAKE_PROBABILITY, PROBABLE, FilmPosterior, fit_film
from isocharge.train.calibration.hypotheses import Hypothesis
from isocharge.train.calibration.nuisances import NUISANCES, NuisanceEstimate, film_warming_sentences
from isocharge.train.calibration.press_data import PressData, no_presses, temperatures
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate
from isocharge.train.calibration.quantities import Quantity, quantities, summarise
from isocharge.train.films.films_model import AddedVariance
from isocharge.train.training.fitted import Fitted

UNEXPLAINED_PROBABILITY = 1e-6
"""Probability of the residuals for presses of a possible film, below which no film explains the presses, provided that
the residuals exceed `UNEXPLAINED_CHI2`."""

UNEXPLAINED_CHI2 = 9.0
"""Mean squared residual, in units of the noise variance, above which no film explains the presses."""

UNCERTAIN_PROBABILITY = 0.01
"""Probability of the residuals below which the stated errors are increased by Birge's ratio."""

STRAINED_PROBABILITY = 1e-7
"""Probability of a film that differs this much from its description, below which the presses are considered to be
recorded wrongly."""

ODD_PROBABILITY = 1e-3
"""Probability of such a film below which common mistakes in the records of presses are searched for."""

MISLEADING_MISFIT = 8.0
"""Misfit of the recorded presses, as `misfit` returns it, above which mistakes are searched for before a fit."""

FEW = 3
"""Largest number of presses among which a wrong one cannot be recognised. The user is warned."""

BOUND_DISTANCE = 0.1
"""Distance from its bound within which a parameter counts as limited by the bound, in prior standard deviations."""

PLANNED_PRESSES = 30
"""Number of further presses whose benefit is stated if the film has a discrepancy."""

VISIBLE_TRACE = 2.0
"""Smallest width of a trace, in its standard deviations, for which the trace is named."""

CLOSE_MM = 1.0
"""Distance within which all presses lie too close to each other to determine the positions of the electrodes, mm."""


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
        """The network of this film, for `evaluate` and `release`.

        Its standard deviations include the uncertainty of the film. If there are enough presses, its errors are those
        of calibrations on presses that they did not use; see `held_out`.
        """
        fitted = self.fitted_film(self.posterior.parameters, release=True)
        if self.held_out is None:
            return fitted
        return replace(fitted, test=self.held_out.presses, cross_validated=self.held_out.answers)

    @cached_property
    def held_out(self) -> HeldOutAnswers | None:
        """Answers to presses from calibrations that did not use them; None if there are too few presses.

        See `cross_validate`. The answers are computed when they are first used, which takes about as long as the
        calibration.
        """
        if self.moved:
            return None
        warming = self.posterior.warming
        at_C = None if warming is None else warming.at_C

        def network_of(film: FilmPosterior) -> Fitted:
            return self._network_of(film.unknowns, film.joint)

        return cross_validate(self.problem, self.presses, self.posterior, network_of, at_C)

    def fitted_film(self, parameters: Array, *, release: bool = False) -> Fitted:
        """Return the network of a film near this one, with the same coefficients and the same uncertainty.

        Args:
            parameters: Parameters of the film, shape (n_parameter,).
            release: Whether the network will be released; see `CalibrationProblem.fitted`.
        """
        unknowns = np.concatenate([parameters, self.posterior.coefficients])
        return self._network_of(unknowns, self.posterior.joint, release=release)

    def _network_of(self, unknowns: Array, covariance: Array, *, release: bool = False) -> Fitted:
        """Return the network of a film with the variances of contacts by a covariance of its unknowns.

        The variances are linearised at the calibrated film.
        """
        contact_covariance = self.sensitivity.contact_covariance(covariance)
        added_variance = AddedVariance(self.sensitivity.contact, np.einsum("nii->ni", contact_covariance))
        parameters = unknowns[self.problem.charges.layout.parameters]
        factor = partial(self.problem.charges.factor, unknowns)
        return self.problem.fitted(parameters, added_variance, factor, release=release)

    @property
    def reduced_chi2(self) -> float:
        """Mean squared residual of the fitted presses over its expected value, about 1; NaN without any redundancy."""
        chi2, degrees_of_freedom = self.posterior.total
        if degrees_of_freedom == 0.0:
            return np.nan
        return chi2 / degrees_of_freedom

    @property
    def bad_lines(self) -> tuple[int, ...]:
        """Lines of the presses that were left out because they do not agree with the others."""
        return self.presses[self.posterior.bad].lines

    @cached_property
    def summary(self) -> tuple[str, ...]:
        """The result in sentences. They are computed once, because they contain a plan of further presses."""
        after = self.error_left
        before = self.error_left_before
        noise = self.sensitivity.noise_error
        event = "it was moved" if self.moved else "these presses"
        film_errors = (
            f"The uncertainty of the film causes errors of {after.position_mm:.2g} mm and {after.force_percent:.2g} % "
            f"of the force (root mean square); before {event} they were {before.position_mm:.2g} mm and "
            f"{before.force_percent:.2g} %. Noise alone causes {noise.position_mm:.2g} mm and "
            f"{noise.force_percent:.2g} %."
        )
        film_quantities = summarise(self.quantities)
        if self.moved:
            film_quantities = (f"The film was {self.moved}, without presses.",)
        rig_errors = (
            "Errors of the load cell, and of the origin and the axes of the stage, affect every answer in addition to "
            "these errors."
        )
        return (
            film_errors,
            *self._held_out_sentences(),
            *film_quantities,
            *self._temperature_sentences(),
            *film_warming_sentences(self.posterior.nuisances),
            rig_errors,
            *self._discrepancy_sentences(),
            *self.cautions,
        )

    def _held_out_sentences(self) -> Iterator[str]:
        """Yield the errors on presses that were held out, if there are enough."""
        if self.held_out is None:
            return
        held_out_errors = self.held_out.errors
        yield (
            f"On {len(self.held_out.presses)} presses, calibrations without a fifth of the positions have errors of "
            f"{held_out_errors['position_rms_mm']:.2g} mm and {held_out_errors['force_rms_percent']:.2g} % at these "
            "positions (root mean square, including the errors of the measured positions and forces)."
        )

    def _temperature_sentences(self) -> Iterator[str]:
        """Yield a sentence on how the pretension changes with the temperature, if temperatures are known."""
        warming = self.posterior.warming
        if warming is None:
            return
        if not warming.identified:
            yield (
                f"The presses were made at about {warming.at_C:.1f} C; presses over a wider range of temperatures "
                "would determine how the pretension changes with the temperature."
            )
            return
        yield (
            f"The pretension changes by {warming.MPa_per_K:.3g} +- {warming.std:.2g} MPa per kelvin. The result holds "
            f"at {warming.at_C:.1f} C; --from with --temperature computes the film at another temperature."
        )

    def _discrepancy_sentences(self) -> Iterator[str]:
        """Yield sentences on the discrepancy, if there is one, and on the benefit of further presses."""
        if not self.posterior.imperfect:
            return
        factor = self.problem.charges.factor(self.posterior.unknowns, self.sensitivity.contact)
        percent = 100.0 * rms(np.log(factor))
        plan = next_presses(self.problem, PLANNED_PRESSES, self.posterior)
        places = ", ".join(f"{press.force_N:.2f} N at ({press.x_mm:g}, {press.y_mm:g}) mm" for press in plan[:3])
        yield (
            f"The charges of this film differ from those of its parameters by {percent:.2g} % (root mean square), "
            f"smoothly over the film. The remaining error is {self.error_left.position_mm:.2g} mm. {PLANNED_PRESSES} "
            f"more presses would reduce it to {plan[-1].position_mm:.2g} mm. The first of them are {places}; --next "
            "lists more."
        )
        if self.posterior.probability("traces") > PROBABLE:
            widths = self.problem.charges.trace_widths(self.posterior.unknowns, self.posterior.joint)
            visible = [f"{name} {width:.2g} mm" for name, (width, std) in widths.items() if width > VISIBLE_TRACE * std]
            yield (
                "Most of this difference is charge that electrodes collect outside their pads, like traces to the rim "
                f"of this width: {', '.join(visible)}. If the sensor file describes the traces, the error is smaller."
            )


def calibrate(presses: MeasuredPresses, problem: CalibrationProblem) -> CalibrationResult:
    """Estimate the film on which presses were made.

    Args:
        presses: The presses in the order in which they were made, with position, force or both, and their standard
            deviations. Presses without both show how a film has changed since an earlier calibration, if it has more
            than three electrodes.
        problem: The possible films.

    Raises:
        PressError: If the records of the presses are impossible, or no film explains them. The message names the
            reason if it is found.
    """
    presses = presses.of_electrodes(problem.electrodes, problem.sensor.name)
    check_places(presses, problem.prior.sensor.film.radius)
    check_channels(presses, problem.charges)
    _check_enough_measured(presses, problem)
    presses, domain_cautions = _within_domain(presses, problem)
    if misfit(presses, problem.charges) > MISLEADING_MISFIT and find_mistakes(presses, problem.charges):
        refuse_closed_back(presses, problem.charges)
        raise unexplained_error(presses, problem.charges, FAR_FROM_ALL_FILMS)
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
    """Return the presses at positions and forces for which the films have charges, and a caution about the others.

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
        if len(presses) == 1:
            raise PressError(sentence)
        raise unexplained_error(presses, problem.charges, MOSTLY_OUTSIDE)
    return presses[~is_outside], [f"{sentence}; left out"]


def _scaled_by_scatter(posterior: FilmPosterior) -> tuple[FilmPosterior, list[str]]:
    """Increase the stated errors if the presses scatter more than expected, by Birge's ratio (1932).

    Returns:
        The estimate, and a caution if the errors were increased.
    """
    chi2, degrees_of_freedom = posterior.total
    if degrees_of_freedom == 0.0 or scipy.stats.chi2.sf(chi2, degrees_of_freedom) >= UNCERTAIN_PROBABILITY:
        return posterior, []
    variance_ratio = chi2 / degrees_of_freedom
    caution = (
        f"the presses scatter {np.sqrt(variance_ratio):.2g} times as much as the noise and the stated standard "
        "deviations of the rig explain; the stated errors are increased by this factor: are positions and forces as "
        "certain as assumed?"
    )
    return posterior.scaled(variance_ratio), [caution]


def film_without_presses(problem: CalibrationProblem, film: FilmEstimate, moved: str) -> CalibrationResult:
    """Return an estimate of a film as a calibration result without presses.

    Args:
        problem: The calibration.
        film: The estimate.
        moved: Words that describe how an earlier calibration was moved to another temperature.
    """
    layout = problem.charges.layout
    joint = np.zeros((layout.film_count, layout.film_count))
    estimated = slice(0, len(film.unknowns))
    joint[estimated, estimated] = film.unknown_covariance
    has_coefficients = film.coefficients.size > 0
    warming = film.warming
    if warming is not None:
        warming = warming.with_unknowns(layout.film_count)
    posterior = FilmPosterior(
        parameters=film.parameters,
        covariance=film.covariance,
        coefficients=film.coefficients if has_coefficients else np.zeros(layout.coefficient_count),
        joint=joint,
        warming=warming,
        contact=np.empty((0, 3)),
        chi2=np.empty(0),
        degrees_of_freedom=np.empty(0),
        bad=np.empty(0, dtype=bool),
        nuisances={nuisance.name: NuisanceEstimate(0.0, 0.0) for nuisance in NUISANCES},
        force_scatter=0.0,
        probabilities={Hypothesis(modes=float(has_coefficients)): 1.0},
    )
    return CalibrationResult(problem, no_presses(problem.electrodes), posterior, moved=moved)


def _check_enough_measured(presses: MeasuredPresses, problem: CalibrationProblem) -> None:
    """Raise PressError if position and force of all presses are unknown and the charges have no redundancy."""
    if np.isnan(presses.contact).all() and len(problem.electrodes) <= 3:
        raise PressError(
            f"{len(presses)} presses of unknown position and force: three charges only determine x, y and the force, "
            "so they say nothing about the film; give the position or the force of a press (four electrodes would "
            "have one redundant charge)"
        )


def _refuse_unexplained(presses: MeasuredPresses, problem: CalibrationProblem, posterior: FilmPosterior) -> None:
    """Raise PressError if no film explains the presses, or only an improbable film does.

    A few presses with a common mistake may agree with a film that is possible but unusual. The presses are then
    compared with those of common mistakes.
    """
    chi2, degrees_of_freedom = posterior.total
    is_unexplained = (
        degrees_of_freedom > 0.0
        and chi2 / degrees_of_freedom > UNEXPLAINED_CHI2
        and scipy.stats.chi2.sf(chi2, degrees_of_freedom) < UNEXPLAINED_PROBABILITY
    )
    # Squared Mahalanobis distance of the film from its description.
    deviation = (posterior.parameters - problem.before.parameters) / problem.prior.std
    squared_distance = float(deviation @ np.linalg.solve(problem.before.covariance, deviation))
    film_probability = scipy.stats.chi2.sf(squared_distance, deviation.size)
    is_unusual = posterior.imperfect or posterior.bad.any() or film_probability < ODD_PROBABILITY
    is_mistaken = is_unusual and bool(find_mistakes(presses, problem.charges))
    if is_unexplained or film_probability < STRAINED_PROBABILITY or is_mistaken:
        refuse_closed_back(presses, problem.charges)
        worst = max(chi2 / max(degrees_of_freedom, 1.0), squared_distance / deviation.size)
        raise unexplained_error(presses, problem.charges, large_residual(float(np.sqrt(worst))))


def _with_unseen_mistakes(posterior: FilmPosterior, before: FilmEstimate) -> FilmPosterior:
    """Return the estimate with a larger covariance, for wrong presses that cannot be recognised among so few.

    If there is such a press, the film is only known as before the presses. The covariance is the mean of both cases,
    weighted by their probabilities.

    Args:
        posterior: The estimate after the presses.
        before: The estimate before the presses.
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
    parameters = slice(0, len(before.parameters))
    return replace(posterior, joint=joint, covariance=joint[parameters, parameters], warming=warming)


def _cautions(presses: MeasuredPresses, problem: CalibrationProblem, posterior: FilmPosterior) -> Iterator[str]:
    """Yield warnings about the presses and the estimate, one sentence each."""
    if posterior.bad.any():
        lines = row_words(presses[posterior.bad].lines, presses.row_noun)
        yield f"{lines}: left out, because no film explains them together with the others; check them"
    good = presses[~posterior.bad]
    if len(good) <= FEW:
        noun = "presses" if len(good) > 1 else "press"
        yield (
            f"only {len(good)} {noun}: a wrong one among so few cannot be recognised, and the stated errors include "
            "this possibility; with more than three presses they become much smaller"
        )
    if posterior.imperfect and has_closed_back(good, problem.charges):
        yield CLOSED_BACK_CAUTION
    for nuisance in NUISANCES:
        if posterior.probability(nuisance.name) > PROBABLE:
            yield nuisance.caution(posterior.nuisances[nuisance.name])
    if posterior.probability("force_scatter") > PROBABLE:
        yield (
            f"the forces scatter by {100.0 * posterior.force_scatter:.2g} % about those of the charges, in addition to "
            "their stated standard deviation: are force and charges read at the same moment, or does charge leak in "
            "between? An effect that lowers charges at random also lowers their mean. The stated errors include it"
        )
    limited = _parameters_at_bounds(problem, posterior)
    if limited:
        yield (
            f"at the limit of the allowed difference from the sensor file: {', '.join(limited)}; the errors may be "
            "larger than stated. Do the sensor file, and the origin and axes of the stage, belong to this film?"
        )
    positions = good.contact[np.isfinite(good.contact[:, 0]), :2]
    if len(positions) == 0:
        yield (
            "no position is known: positions will be correct only up to the shift and the rotation of the electrodes, "
            "and only if the charges are in the right columns"
        )
    elif len(positions) > 1:
        extent_mm = np.ptp(positions, axis=0).max()
        if extent_mm < CLOSE_MM:
            yield (
                f"all presses lie within {extent_mm:.2g} mm of each other: they determine neither the positions of the "
                "electrodes nor the response of the film elsewhere; press at positions all over the working area"
            )


def _parameters_at_bounds(problem: CalibrationProblem, posterior: FilmPosterior) -> list[str]:
    """Return the names of the parameters that are limited by their bounds.

    A pretension of zero is a physical limit and does not count.
    """
    prior = problem.prior
    lower, upper = prior.bounds
    margin = BOUND_DISTANCE * prior.std
    is_low = (posterior.parameters < lower + margin) & (lower < 0.0)
    is_high = posterior.parameters > upper - margin
    return [name for name, is_limited in zip(prior.names, is_low | is_high, strict=True) if is_limited]
