"""Calibration of a film: estimation of its properties from measured presses, by solving the film that is found."""

from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.serve.presses.measured_presses import MeasuredPresses, row_words
from isocharge.train.calibration.contact_error import N_CONTACTS, ContactSensitivity, spread_contacts
from isocharge.train.calibration.diagnosis import (
    FAR_FROM_ALL_FILMS,
    MOSTLY_OUTSIDE,
    check_channels,
    check_places,
    find_mistakes,
    large_residual_reason,
    misfit,
    unexplained_error,
)
from isocharge.train.calibration.estimator import Estimation, estimate, is_unexplained
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_estimate import FilmEstimate
from isocharge.train.calibration.press_data import PressData, known_temperatures
from isocharge.train.calibration.problem import CalibrationProblem
from isocharge.train.calibration.result import CalibrationResult

MAX_SOLVED_FILMS = 4
"""Largest number of axisymmetric films that are solved one after the other."""

SAME_FILM_STD = 0.3
"""Largest change of a mechanical property, in prior standard deviations, for which the film is not solved again."""

VISIBLE_ASYMMETRY = 0.03
"""Relative root-mean-square effect of the imperfections on the charges above which the uneven film itself is solved.

The neglected second-order effect is about the square of this value.
"""

SUSPICIOUS_MISFIT = 8.0
"""Misfit of the recorded presses, as `misfit` returns it, above which mistakes are searched for before the fit."""

UNEXPLAINED_PROBABILITY = 1e-6
"""Probability of residuals as large as those of the best film, below which no film explains the presses."""

UNEXPLAINED_CHI2 = 9.0
"""Mean squared residual above which no film explains the presses, in units of the noise variance."""

MIN_SCATTER_PROBABILITY = 0.01
"""Probability of residuals as large as those of the fit, below which the stated errors are increased."""

MIN_POSITION_EXTENT_MM = 1.0
"""Range of the positions below which the presses do not determine the electrodes' positions, mm."""

UNUSUAL_SHIFT = 3.0
"""Ratio of a shift or rotation of the electrodes to its prior standard deviation above which a caution is given."""


@dataclass(frozen=True)
class _Fit:
    """A solved film, and the estimate that was computed with it."""

    charges: FilmCharges
    estimation: Estimation


def calibrate(
    presses: MeasuredPresses,
    problem: CalibrationProblem,
    *,
    executor: Executor | None = None,
    start: FilmCharges | None = None,
    accurate: bool = True,
) -> CalibrationResult:
    """Estimate the properties of a film from presses on this film.

    The presses are checked first. Then an axisymmetric film is solved, the properties are estimated with the charges of
    this film and their derivatives, and the film is solved again until the estimate hardly changes. If the film is
    uneven, the uneven film itself is solved.

    Args:
        presses: The presses in the order in which they were made, with position, force or both, and the standard
            deviations of these measurements. If the sensor has more than three electrodes, presses without position and
            force can show how the film has changed since an earlier calibration.
        problem: The calibration problem.
        executor: Executor that runs the solves; None for this process.
        start: A solved film that is used first, from an earlier calibration of the same problem; None to solve one.
        accurate: Whether an uneven film is solved. Without it, its unevenness is a first-order change, which is enough
            to choose further presses.

    Raises:
        PressError: If the records of the presses are impossible, or if no film explains the presses. The message names
            the reason if it is found.
    """
    ordered_presses = presses.of_electrodes(problem.electrodes, problem.sensor.name)
    check_places(ordered_presses, problem.sensor.film.radius)
    _check_enough_measured(ordered_presses)
    used_presses, cautions = _within_domain(ordered_presses, problem)
    problem = _at_temperature_of(problem, used_presses)
    with threadpool_limits(1):  # the matrices are small, so a second thread would only wait
        charges = start or solve_start(problem, executor)
        if cautions is None:
            raise unexplained_error(ordered_presses, charges, MOSTLY_OUTSIDE)
        check_channels(used_presses, charges)
        is_suspicious = not _is_one_place(used_presses) and misfit(used_presses, charges) > SUSPICIOUS_MISFIT
        if is_suspicious and find_mistakes(used_presses, charges):
            raise unexplained_error(used_presses, charges, FAR_FROM_ALL_FILMS)
        data = PressData.of(used_presses, problem.noise, problem.solved_domain)
        fit = _fit_even_film(problem, data, charges, executor)
        if accurate:
            fit = _fit_uneven_film(problem, data, fit, executor)
        _refuse_unexplained(used_presses, fit)
        estimation, scatter_cautions = _scaled_by_scatter(fit.estimation)
        sensitivity = ContactSensitivity.of(problem, fit.charges, estimation.film.values)
    return CalibrationResult(
        problem=problem,
        presses=used_presses,
        estimation=estimation,
        charges=fit.charges,
        sensitivity=sensitivity,
        cautions=(*cautions, *scatter_cautions, *_cautions(used_presses, estimation)),
    )


def solve_start(problem: CalibrationProblem, executor: Executor | None = None) -> FilmCharges:
    """Solve the film with which a calibration begins."""
    with_side_forces = problem.friction > 0.0 or problem.side_force > 0.0
    return FilmCharges.solve_roughly(
        problem.prior.layout.prior,
        problem.start,
        problem.solved_domain,
        executor,
        with_side_forces=with_side_forces,
    )


def solve_film(problem: CalibrationProblem, film: FilmEstimate, executor: Executor | None = None) -> FilmCharges:
    """Solve an estimated film, with its imperfections if they are visible and with its real probe.

    Args:
        problem: The calibration problem.
        film: The estimate.
        executor: Executor that runs the solves; None for this process.
    """
    charges = solve_start(replace(problem, earlier=film), executor)
    contact = spread_contacts(problem.domain, N_CONTACTS)
    return charges if _is_exact(charges, film.film_values, contact) else charges.solved(film.film_values, executor)


def _fit_even_film(
    problem: CalibrationProblem, data: PressData, charges: FilmCharges, executor: Executor | None
) -> _Fit:
    """Solve axisymmetric films and estimate the properties in turn, until the estimate hardly changes."""
    estimation: Estimation | None = None
    for _ in range(MAX_SOLVED_FILMS):
        estimation = _estimated(problem, data, charges, estimation)
        values = estimation.film.film_values
        if _solved_distance(charges, values) < SAME_FILM_STD:
            break
        charges = FilmCharges.solve_roughly(
            charges.prior, values, charges.domain, executor, with_side_forces=charges.side_forces is not None
        )
    assert estimation is not None
    return _Fit(charges, estimation)


def _fit_uneven_film(problem: CalibrationProblem, data: PressData, fit: _Fit, executor: Executor | None) -> _Fit:
    """Solve the film that was found with its imperfections and its real probe, and estimate the properties again.

    The film is solved at most twice. A film that is nearly even under a circular probe is not solved again.
    """
    for _ in range(2):
        charges, estimation = fit.charges, fit.estimation
        if _is_exact(charges, estimation.film.film_values, estimation.contact):
            break
        solved = charges.solved(estimation.film.film_values, executor)
        fit = _Fit(solved, _estimated(problem, data, solved, estimation))
    return fit


def _estimated(
    problem: CalibrationProblem, data: PressData, charges: FilmCharges, previous: Estimation | None
) -> Estimation:
    """Estimate the unknowns with one solved film, beginning with a previous estimate.

    The charges that friction adds are computed at the contacts of the previous estimate.
    """
    contact = None if previous is None else previous.contact
    if problem.friction > 0.0 and charges.side_forces is not None:
        measured = np.column_stack([data.contact[:, :2], np.exp(data.contact[:, 2])])
        place = charges.into_domain(measured if contact is None else contact)
        friction_charge = charges.side_forces.friction_charges(place, problem.friction) / problem.friction
        data = replace(data, friction_charge=friction_charge)
    return estimate(charges, data, problem.prior, None if previous is None else previous.film.values, contact)


def _solved_distance(charges: FilmCharges, values: Array) -> float:
    """Return the largest distance of the even properties from those of the solved film, in prior std deviations."""
    prior = charges.prior
    names = ("pretension", "young", "thickness", "probe_radius")
    rows = [prior.index(name) for name in names if name in prior.names]
    return float(np.abs((values - charges.values)[rows] / prior.std[rows]).max())


def _is_exact(charges: FilmCharges, values: Array, contact: Array) -> bool:
    """Return whether the solved film has the real probe, and nearly all imperfections of a film.

    Args:
        charges: The solved film.
        values: Properties of the film, shape (n_property,).
        contact: Contacts at which the effect of the missing imperfections is computed, shape (n, 3).
    """
    if charges.film.probe.is_axisymmetric != charges.prior.probe.is_axisymmetric:
        return False
    charge, jacobian = charges.linearised(values, contact)
    missing = np.where(charges.prior.is_imperfection, values - charges.values, 0.0)
    missing[[charges.prior.index(name) for name in ("d12", "crosstalk")]] = 0.0  # their effect is exact
    return bool(np.linalg.norm(jacobian @ missing) < VISIBLE_ASYMMETRY * np.linalg.norm(charge))


def _at_temperature_of(problem: CalibrationProblem, presses: MeasuredPresses) -> CalibrationProblem:
    """Convert the estimate before the presses to their mean temperature, if both temperatures are known."""
    temperature_C = known_temperatures(presses)
    if problem.earlier is None or temperature_C is None:
        return problem
    return replace(problem, earlier=problem.earlier.at_temperature(float(temperature_C.mean())))


def _within_domain(
    presses: MeasuredPresses, problem: CalibrationProblem
) -> tuple[MeasuredPresses, tuple[str, ...] | None]:
    """Select the presses within the domain.

    Returns:
        The presses within the domain, and warnings about the others. If most of several presses lie outside, all
        presses are returned, with None instead of the warnings.

    Raises:
        PressError: If a single press lies outside.
    """
    domain = problem.solved_domain  # presses at the edge may lie outside the working area by their errors
    contact = presses.contact
    low, high = domain.force_range
    is_far = np.hypot(contact[:, 0], contact[:, 1]) > domain.radius  # False for an unknown position
    is_outside = is_far | (contact[:, 2] < low) | (contact[:, 2] > high)
    if not is_outside.any():
        return presses, ()
    sentence = (
        f"{row_words(presses[is_outside].lines, presses.row_noun)}: a calibration takes presses within "
        f"{domain.radius:.3g} mm of the centre and of {low:.2g} to {high:.2g} N"
    )
    if is_outside.all() and len(presses) == 1:
        raise PressError(sentence)
    if is_outside.mean() > 0.5:
        return presses, None
    return presses[~is_outside], (f"{sentence}; left out",)


def _check_enough_measured(presses: MeasuredPresses) -> None:
    """Raise PressError if all contacts are unknown and three charges only determine the contact."""
    if np.isnan(presses.contact).all() and len(presses.electrodes) <= 3:
        raise PressError(
            f"{len(presses)} presses of unknown position and force: three charges only determine x, y and the force, "
            "so they say nothing about the film; give the position or the force of a press (four electrodes would "
            "have one redundant charge)"
        )


def _refuse_unexplained(presses: MeasuredPresses, fit: _Fit) -> None:
    """Raise PressError if the residuals are so large that no film explains the presses."""
    estimation = fit.estimation
    if is_unexplained(estimation, UNEXPLAINED_PROBABILITY, UNEXPLAINED_CHI2):
        ratio = float(np.sqrt(estimation.chi2 / estimation.redundancy))
        raise unexplained_error(presses, fit.charges, large_residual_reason(ratio))


def _scaled_by_scatter(estimation: Estimation) -> tuple[Estimation, tuple[str, ...]]:
    """Increase the covariance by Birge's ratio (Birge 1932) if the presses scatter more than expected."""
    if not is_unexplained(estimation, MIN_SCATTER_PROBABILITY, 1.0):
        return estimation, ()
    ratio = estimation.chi2 / estimation.redundancy
    film = replace(estimation.film, covariance=ratio * estimation.film.covariance)
    caution = (
        f"the presses scatter {np.sqrt(ratio):.2g} times as much as the noise and the stated standard deviations of "
        "the rig explain; the stated errors are increased by this factor: are positions and forces as certain as "
        "assumed?"
    )
    return replace(estimation, film=film), (caution,)


def _cautions(presses: MeasuredPresses, estimation: Estimation) -> list[str]:
    """Return warnings about presses, the session, and electrodes far from their described places."""
    cautions = []
    film = estimation.film
    if estimation.is_bad.any():
        rows = row_words(presses[estimation.is_bad].lines, presses.row_noun)
        cautions.append(f"{rows}: does not agree with the other presses; left out")
    if estimation.hypothesis.force_scatter > 0.0:
        cautions.append(
            f"the forces scatter by about {100.0 * estimation.hypothesis.force_scatter:.2g} % more than stated: does "
            "the load cell lag behind, or do the charges leak between the press and its reading?"
        )
    cautions.extend(film.session_cautions())
    prior = film.layout.prior
    for name in ("shift_x", "shift_y", "rotation"):
        one = prior.properties[prior.index(name)]
        if abs(film.value(name)) > UNUSUAL_SHIFT * one.std:
            cautions.append(
                f"{one.meaning}: {film.value(name):.3g} {one.unit}, which is unusually far from the sensor file: is "
                "the origin of the stage the centre of the film, and are its axes those of the film?"
            )
    if _is_one_place(presses):
        cautions.append("all presses are at one place, so they do not determine where the electrodes are")
    return cautions


def _is_one_place(presses: MeasuredPresses) -> bool:
    """Return whether the presses have known positions, which are all at one place."""
    position = presses.contact[np.isfinite(presses.contact[:, 0]), :2]
    return len(position) > 0 and float(np.ptp(position, axis=0).max()) < MIN_POSITION_EXTENT_MM
