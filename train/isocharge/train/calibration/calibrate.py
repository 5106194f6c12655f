"""Estimation of the parameters of a film and their uncertainty from measured presses."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Booleans
from isocharge.common.errors import PressError
from isocharge.common.measured_presses import MeasuredPresses, row_words
from isocharge.simulate import SideForceMap
from isocharge.train.calibration import chi_square
from isocharge.train.calibration.closed_back import CLOSED_BACK_CAUTION, has_closed_back, refuse_closed_back
from isocharge.train.calibration.diagnosis import (
    FAR_FROM_ALL_FILMS,
    MOSTLY_OUTSIDE,
    UNUSUAL_FILM,
    check_channels,
    check_places,
    find_mistakes,
    large_residual_reason,
    misfit,
    unexplained_error,
)
from isocharge.train.calibration.film_fit import MISTAKE_PROBABILITY, PROBABLE, FilmPosterior, fit_film
from isocharge.train.calibration.nuisances import FRICTION, NUISANCES, PRETENSION_PER_KELVIN
from isocharge.train.calibration.press_data import PressData, temperatures
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate, Warming
from isocharge.train.calibration.result import CalibrationResult
from isocharge.train.calibration.side_forces import solve_side_forces, with_friction

UNEXPLAINED_PROBABILITY = 1e-6
"""Probability of residuals as large as those of the fit, below which no film explains the presses.

The presses are refused only if the mean squared residual also exceeds `UNEXPLAINED_CHI2`."""

UNEXPLAINED_CHI2 = 9.0
"""Mean squared residual, in units of the noise variance, above which no film explains the presses."""

MIN_SCATTER_PROBABILITY = 0.01
"""Probability of residuals as large as those of the fit, below which the stated errors are increased.

They are multiplied by Birge's ratio; see `_scaled_by_scatter`."""

MIN_FILM_PROBABILITY = 1e-7
"""Probability of an estimated film below which the presses are refused, because they were probably recorded wrongly.

The probability of an estimated film is the probability that some film differs at least as much from the estimate
before the presses."""

UNUSUAL_FILM_PROBABILITY = 1e-3
"""Probability of an estimated film below which common mistakes in the records are searched for.

The probability is defined as for `MIN_FILM_PROBABILITY`."""

SUSPICIOUS_MISFIT = 8.0
"""Misfit of the recorded presses, as `misfit` returns it, above which mistakes are searched for before the fit."""

MAX_MISTAKE_PROBABILITY = 0.5
"""Largest probability of an undetected mistake that is assumed because other presses were left out."""

FEW_PRESSES = 3
"""Largest number of presses that counts as few. Among a few presses, a wrong press cannot be recognised."""

BOUND_DISTANCE = 0.1
"""Distance from a bound within which a parameter counts as limited by the bound, in prior standard deviations."""

MAX_FRICTION_ROUNDS = 3
"""Largest number of fits of presses with friction. Each fit uses the effect of friction on the previous film."""

MAX_FRICTION_STEP = 0.25
"""Largest step of a parameter, in prior standard deviations, for which the effect of friction is not computed again."""

MIN_POSITION_EXTENT_MM = 1.0
"""Range of the positions of all presses below which the presses do not determine the electrodes' positions, mm."""


def calibrate(presses: MeasuredPresses, problem: CalibrationProblem) -> CalibrationResult:
    """Estimate the parameters of a film from presses on this film.

    First, the presses are checked, and presses outside the domain of the films are removed. The parameters of the film
    are then fitted to the remaining presses. An error is raised if no film explains these presses. The covariance of
    the estimate is increased if the presses scatter more than expected, if some presses were left out as wrong, or if
    there are only a few presses. The returned result also contains warnings about the presses and the estimate.

    Args:
        presses: The presses in the order in which they were made, with position, force or both, and the standard
            deviations of these measurements. If the sensor has more than three electrodes, presses without position and
            force can show how the film has changed since an earlier calibration.
        problem: The calibration problem, which defines the possible films and their estimate before the presses.

    Raises:
        PressError: If the records of the presses are impossible, or if no film explains the presses. The message names
            the reason if it is found.
    """
    ordered_presses = presses.of_electrodes(problem.electrodes, problem.sensor.name)  # columns as in the sensor file
    used_presses, domain_cautions = _checked_presses(ordered_presses, problem)

    # The pretension depends on the temperature. The new estimate describes the film at the mean temperature of the
    # presses, so the estimate before the presses is converted to this temperature.
    mean_temperature_C = None
    if used_presses.knows_temperature:
        mean_temperature_C = float(temperatures(used_presses).mean())
        problem = replace(problem, earlier=problem.before.at_temperature(mean_temperature_C, problem.prior))
    data = PressData.from_presses(used_presses, problem.noise, problem.charges.domain)

    with threadpool_limits(1):  # the matrices are small, so a second thread would only wait
        posterior = fit_film(problem.charges, data, problem.before, mean_temperature_C)
        side_force_map = None
        if problem.friction > 0.0:
            posterior, side_force_map = _fit_with_friction(problem, data, posterior, mean_temperature_C)
        elif problem.side_force > 0.0:  # a declared side force acts only on later contacts, so the fit does not change
            side_force_map = solve_side_forces(problem.charges, posterior.parameters)

    # The decision to refuse the presses uses the covariance of the fit. Therefore, it is increased only afterwards.
    _refuse_unexplained(used_presses, problem, posterior)
    posterior, scatter_cautions = _scaled_by_scatter(posterior)
    posterior = _with_undetected_mistakes(posterior, problem.before)
    cautions = (*domain_cautions, *scatter_cautions, *_cautions(used_presses, problem, posterior))
    return CalibrationResult(problem, used_presses, posterior, cautions, side_force_map=side_force_map)


def _checked_presses(presses: MeasuredPresses, problem: CalibrationProblem) -> tuple[MeasuredPresses, list[str]]:
    """Check presses before a fit, and remove presses outside the domain of the films.

    Args:
        presses: The presses, with the electrodes in the order of the problem.
        problem: The calibration problem, which defines the possible films.

    Returns:
        The presses within the domain, and a list of warnings about the removed presses.

    Raises:
        PressError: If the records of the presses are impossible, if more than half of the presses lie outside the
            domain, or if the presses differ much from all films. In the last case, an error is raised only if a common
            mistake would explain the difference.
    """
    check_places(presses, problem.prior.sensor.film.radius)
    check_channels(presses, problem.charges)
    _check_enough_measured(presses, problem)
    inside_presses, warnings = _within_domain(presses, problem)

    # Presses that differ much from all films are refused here only if a common mistake explains them. Otherwise, the
    # presses are fitted, and the residuals of the fit decide.
    is_far_from_films = misfit(inside_presses, problem.charges) > SUSPICIOUS_MISFIT
    if is_far_from_films and find_mistakes(inside_presses, problem.charges):
        # Air that is trapped behind the film can look like a mistake in the records. Therefore, a closed back is
        # examined first. The next line raises an error only if the back is closed.
        refuse_closed_back(inside_presses, problem.charges)
        raise unexplained_error(inside_presses, problem.charges, FAR_FROM_ALL_FILMS)
    return inside_presses, warnings


def _fit_with_friction(
    problem: CalibrationProblem, data: PressData, posterior: FilmPosterior, mean_temperature_C: float | None
) -> tuple[FilmPosterior, SideForceMap]:
    """Estimate a film from presses with friction, and compute how side forces change the charges of this film.

    The effect of friction on the charges depends on the parameters of the film and on the coefficient of friction.
    Therefore, the effect and the parameters are computed alternately. The computation ends when the parameters hardly
    change, or after `MAX_FRICTION_ROUNDS` rounds.

    Args:
        problem: The calibration problem, with the expected coefficient of friction.
        data: The measured presses.
        posterior: Estimate of the film from a fit without friction.
        mean_temperature_C: Mean temperature of the presses, degrees Celsius; None if temperatures were not measured.

    Returns:
        The estimate of the film, and the effect of side forces on the charges that was used for this estimate. This
        effect was computed for the film of the previous round, which hardly differs.
    """
    expected_friction = problem.friction
    estimated_friction = expected_friction
    for _ in range(MAX_FRICTION_ROUNDS):
        side_force_map = solve_side_forces(problem.charges, posterior.parameters)
        data_with_friction = with_friction(data, problem.charges, side_force_map, posterior.contact, estimated_friction)

        # Each fit begins again with the estimates of the film and of the friction before the presses.
        previous = posterior
        posterior = fit_film(
            problem.charges, data_with_friction, problem.before, mean_temperature_C, friction=expected_friction
        )
        estimated_friction = posterior.nuisances[FRICTION.name].value
        parameter_change = np.abs(posterior.parameters - previous.parameters) / problem.prior.std
        if parameter_change.max() < MAX_FRICTION_STEP:
            break
    return posterior, side_force_map


def _within_domain(presses: MeasuredPresses, problem: CalibrationProblem) -> tuple[MeasuredPresses, list[str]]:
    """Select the presses within the domain of the films, and create a warning about the other presses.

    Args:
        presses: The measured presses. An unknown position or force does not count as outside.
        problem: The calibration problem. The charges of its films are known only within a domain of contacts.

    Returns:
        The presses within the domain, and a list with the warning. The list is empty if no press lies outside.

    Raises:
        PressError: If more than half of the presses lie outside the domain.
    """
    domain = problem.charges.domain
    is_outside = domain.is_outside(presses.contact)
    if not is_outside.any():
        return presses, []
    min_force, max_force = domain.force_range
    outside_rows = row_words(presses[is_outside].lines, presses.row_noun)
    outside_sentence = (
        f"{outside_rows}: a calibration takes presses within {domain.radius:.3g} mm of the "
        f"centre and of {min_force:.2g} to {max_force:.2g} N"
    )
    is_mostly_outside = is_outside.mean() > 0.5
    if is_mostly_outside and len(presses) == 1:
        # A single press does not suggest a mistake in all records, such as a wrong unit. No mistake is searched for.
        raise PressError(outside_sentence)
    if is_mostly_outside:
        raise unexplained_error(presses, problem.charges, MOSTLY_OUTSIDE)
    return presses[~is_outside], [f"{outside_sentence}; left out"]


def _scaled_by_scatter(posterior: FilmPosterior) -> tuple[FilmPosterior, list[str]]:
    """Increase the variances of an estimate if the residuals of the presses are larger than expected.

    The variances are multiplied by chi2 / degrees_of_freedom, where chi2 is the sum of the squared residuals. This
    quotient is the square of Birge's ratio (Birge 1932). The variances are not changed if random errors of the expected
    size can explain the residuals.

    Args:
        posterior: The estimate of the film from presses.

    Returns:
        The estimate, and a list that contains a warning if the variances were increased and is empty otherwise.
    """
    chi2, degrees_of_freedom = posterior.total  # over all presses that were not left out as wrong
    if degrees_of_freedom == 0.0:  # without redundant measurements, no scatter can be observed
        return posterior, []
    probability_of_chance = chi_square.probability_above(chi2, degrees_of_freedom)
    if probability_of_chance >= MIN_SCATTER_PROBABILITY:
        return posterior, []
    variance_ratio = chi2 / degrees_of_freedom
    caution = (
        f"the presses scatter {np.sqrt(variance_ratio):.2g} times as much as the noise and the stated standard "
        "deviations of the rig explain; the stated errors are increased by this factor: are positions and forces as "
        "certain as assumed?"
    )
    return posterior.scaled(variance_ratio), [caution]


def _check_enough_measured(presses: MeasuredPresses, problem: CalibrationProblem) -> None:
    """Raise PressError if all positions and forces are unknown and the sensor has at most three electrodes.

    Three charges determine only the position and the force of a press. They determine no property of the film.
    """
    if np.isnan(presses.contact).all() and len(problem.electrodes) <= 3:
        raise PressError(
            f"{len(presses)} presses of unknown position and force: three charges only determine x, y and the force, "
            "so they say nothing about the film; give the position or the force of a press (four electrodes would "
            "have one redundant charge)"
        )


def _refuse_unexplained(presses: MeasuredPresses, problem: CalibrationProblem, posterior: FilmPosterior) -> None:
    """Raise PressError if the estimate from the presses cannot be trusted. There are three possible reasons.

    The first reason is that the residuals of the presses are too large, so that no film explains the presses. The
    second reason is that the estimated film was very improbable before the presses. The third reason is that the
    estimate is unusual, and the correction of a common mistake in all presses, such as a wrong unit, makes the presses
    agree far better with a film.

    Args:
        presses: The presses to which the film was fitted.
        problem: The calibration problem, which defines the possible films and their estimate before the presses.
        posterior: The estimate of the film from these presses.
    """
    chi2, degrees_of_freedom = posterior.total  # over all presses that were not left out as wrong
    are_residuals_too_large = (
        degrees_of_freedom > 0.0
        and chi2 / degrees_of_freedom > UNEXPLAINED_CHI2
        and chi_square.probability_above(chi2, degrees_of_freedom) < UNEXPLAINED_PROBABILITY
    )

    # Squared Mahalanobis distance of the estimated film from the film that was expected before the presses
    deviation = (posterior.parameters - problem.before.parameters) / problem.prior.std
    squared_distance = float(deviation @ np.linalg.solve(problem.before.covariance, deviation))
    film_probability = chi_square.probability_above(squared_distance, deviation.size)
    is_film_improbable = film_probability < MIN_FILM_PROBABILITY

    # Mistakes are searched for only if the estimate is unusual: the film has imperfections, presses were left out as
    # bad, or the film is rather improbable.
    is_unusual = posterior.imperfect or posterior.bad.any() or film_probability < UNUSUAL_FILM_PROBABILITY
    has_common_mistake = is_unusual and bool(find_mistakes(presses, problem.charges))
    if not (are_residuals_too_large or is_film_improbable or has_common_mistake):
        return

    # A closed back is a more specific reason, so it is examined first. The next line raises an error if it is closed.
    refuse_closed_back(presses, problem.charges)
    if are_residuals_too_large or is_film_improbable:
        # The message states the larger of two root-mean-square deviations: that of the presses from the film, in units
        # of the noise, and that of the film from the film before the presses, in standard deviations.
        mean_square_of_presses = chi2 / max(degrees_of_freedom, 1.0)
        mean_square_of_film = squared_distance / deviation.size
        reason = large_residual_reason(float(np.sqrt(max(mean_square_of_presses, mean_square_of_film))))
    else:
        reason = UNUSUAL_FILM
    raise unexplained_error(presses, problem.charges, reason)


def _with_undetected_mistakes(posterior: FilmPosterior, before: FilmEstimate) -> FilmPosterior:
    """Increase the covariance of an estimate, because one of the used presses may have been recorded wrongly.

    If one of the used presses was recorded wrongly, all presses are assumed to contain no information. The returned
    covariance is therefore a weighted mean of the covariances before and after the presses. The weight of the
    covariance before the presses is the probability of such an undetected mistake. The same applies to the warming,
    which is the change of the pretension with temperature.

    Args:
        posterior: The estimate after the presses. Its unknowns are the parameters of the film, followed by the
            coefficients of its imperfections.
        before: The estimate before the presses. It may contain the parameters without the coefficients.
    """
    mistake_probability = _mistake_probability(posterior.bad)
    correct_probability = 1.0 - mistake_probability

    # Weighted mean of the covariances of all unknowns. Coefficients that the estimate before the presses does not
    # contain were fixed at zero before the presses, so their variance was zero.
    joint_covariance = correct_probability * posterior.joint
    unknowns_before = slice(0, len(before.unknowns))
    joint_covariance[unknowns_before, unknowns_before] += mistake_probability * before.unknown_covariance
    parameters = slice(0, len(before.parameters))
    parameter_covariance = joint_covariance[parameters, parameters]

    warming = posterior.warming
    if warming is not None:
        warming = _warming_with_undetected_mistakes(warming, before.warming, mistake_probability)
    return replace(posterior, joint=joint_covariance, covariance=parameter_covariance, warming=warming)


def _warming_with_undetected_mistakes(
    warming: Warming, warming_before: Warming | None, mistake_probability: float
) -> Warming:
    """Increase the variance of the warming, because one of the used presses may have been recorded wrongly.

    The warming is the change of the pretension with temperature. As in `_with_undetected_mistakes`, its variance and
    its covariances with the unknowns become weighted means of the values before and after the presses.

    Args:
        warming: The estimate after the presses.
        warming_before: The estimate of an earlier calibration; None if there is no such estimate. The warming is then
            assumed to have its prior variance, and not to be correlated with the unknowns.
        mistake_probability: Probability of an undetected mistake.
    """
    unknown_count = warming.covariance.size
    if warming_before is None:
        std_before = PRETENSION_PER_KELVIN.std_with_temperatures
        covariance_before = np.zeros(unknown_count)
    else:
        std_before = warming_before.std
        covariance_before = warming_before.with_unknowns(unknown_count).covariance
    correct_probability = 1.0 - mistake_probability
    variance = correct_probability * warming.std**2 + mistake_probability * std_before**2
    covariance = correct_probability * warming.covariance + mistake_probability * covariance_before
    return warming._replace(std=float(np.sqrt(variance)), covariance=covariance)


def _mistake_probability(is_left_out: Booleans) -> float:
    """Return the probability that one of the used presses was recorded wrongly, although it agrees with the others.

    A used press is a press that was not left out.

    Args:
        is_left_out: Whether each press was left out as wrong, shape (n,).
    """
    # Presses that were left out as wrong make further mistakes likely, unless many used presses agree with each other.
    # As a rule of thumb, the probability of a mistake is the number of presses that were left out, divided by the
    # square of the number of used presses.
    used_count = int((~is_left_out).sum())
    left_out_count = int(is_left_out.sum())
    probability = min(left_out_count / used_count**2, MAX_MISTAKE_PROBABILITY)

    # Among only a few presses, a wrong press cannot be recognised. `MISTAKE_PROBABILITY` is that of a single press.
    if used_count <= FEW_PRESSES:
        probability += MISTAKE_PROBABILITY * used_count
    return probability


def _cautions(presses: MeasuredPresses, problem: CalibrationProblem, posterior: FilmPosterior) -> Iterator[str]:
    """Yield warnings about the presses and the estimate, each as one string.

    Args:
        presses: All presses of the calibration.
        problem: The calibration problem, which defines the possible films.
        posterior: The estimate of the film, which also states the presses that were left out as bad.
    """
    if posterior.bad.any():
        left_out_rows = row_words(presses[posterior.bad].lines, presses.row_noun)
        yield f"{left_out_rows}: left out, because no film explains them together with the others; check them"
    used_presses = presses[~posterior.bad]
    if len(used_presses) <= FEW_PRESSES:
        noun = "presses" if len(used_presses) > 1 else "press"
        yield (
            f"only {len(used_presses)} {noun}: a wrong one among so few cannot be recognised, and the stated errors "
            "include this possibility; with more than three presses they become much smaller"
        )
    # Air that is trapped behind a film changes its charges. The fit may have attributed this effect to imperfections.
    if posterior.imperfect and has_closed_back(used_presses, problem.charges):
        yield CLOSED_BACK_CAUTION

    # Nuisances are effects of the session that are not properties of the film, such as a drift of the charges.
    for nuisance in NUISANCES:
        if posterior.probability(nuisance.name) > PROBABLE:
            yield nuisance.caution(posterior.nuisances[nuisance.name])
    if posterior.probability("force_scatter") > PROBABLE:
        yield (
            f"the forces scatter by {100.0 * posterior.force_scatter:.2g} % about those of the charges, in addition to "
            "their stated standard deviation: are force and charges read at the same moment, or does charge leak in "
            "between? An effect that lowers charges at random also lowers their mean. The stated errors include it"
        )
    limited_parameters = _parameters_at_bounds(problem, posterior)
    if limited_parameters:
        yield (
            f"at the limit of the allowed difference from the sensor file: {', '.join(limited_parameters)}; the errors "
            "may be larger than stated. Do the sensor file, and the origin and axes of the stage, belong to this film?"
        )
    yield from _position_cautions(used_presses)


def _position_cautions(presses: MeasuredPresses) -> Iterator[str]:
    """Yield a warning if no press has a known position, or if the known positions lie close to each other.

    Args:
        presses: The presses that were not left out. Unknown positions are NaN.
    """
    has_position = np.isfinite(presses.contact[:, 0])
    positions = presses.contact[has_position, :2]
    if len(positions) == 0:
        yield (
            "no position is known: positions will be correct only up to the shift and the rotation of the electrodes, "
            "and only if the charges are in the right columns"
        )
    elif len(positions) > 1:  # a single position has no extent
        extent_mm = np.ptp(positions, axis=0).max()
        if extent_mm < MIN_POSITION_EXTENT_MM:
            yield (
                f"all presses lie within {extent_mm:.2g} mm of each other: they determine neither the positions of the "
                "electrodes nor the response of the film elsewhere; press at positions all over the working area"
            )


def _parameters_at_bounds(problem: CalibrationProblem, posterior: FilmPosterior) -> list[str]:
    """Return the names of the parameters whose estimates lie on a bound or close to it.

    A lower bound of zero or more, such as a pretension of zero, is a physical limit that real films may reach. The
    name of a parameter at such a lower bound is not returned.

    Args:
        problem: The calibration problem, which defines the bounds of the parameters.
        posterior: The estimate of the film from presses.
    """
    prior = problem.prior
    lower, upper = prior.bounds
    margin = BOUND_DISTANCE * prior.std
    is_physical_limit = lower >= 0.0
    is_at_lower = (posterior.parameters < lower + margin) & ~is_physical_limit
    is_at_upper = posterior.parameters > upper - margin
    is_at_bound = is_at_lower | is_at_upper
    return [name for name, is_limited in zip(prior.names, is_at_bound, strict=True) if is_limited]
