"""Calibration of a film: its properties are estimated from measured presses, and the estimated film is solved again."""

from concurrent.futures import Executor

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.serve.presses.measured_presses import MeasuredPresses
from isocharge.simulate.sensor.film_properties import PRETENSION, UNEVEN_TENSIONS
from isocharge.simulate.solver.assembly import single_threaded_blas
from isocharge.train.calibration.contact_error import ContactSensitivity
from isocharge.train.calibration.diagnosis import (
    SUSPICIOUS_MISFIT,
    check_channels,
    check_places,
    find_mistakes,
    is_one_place,
    misfit,
    unexplained_error,
)
from isocharge.train.calibration.estimator import Estimation, estimate
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_estimate import FilmEstimate
from isocharge.train.calibration.press_data import PressData
from isocharge.train.calibration.problem import CalibrationProblem, domain_words
from isocharge.train.calibration.result import CalibrationResult
from isocharge.train.data.presses import have_charges_of_earlier

MAX_SOLVED_FILMS = 4
"""Largest number of axisymmetric films that are solved one after the other."""

SAME_FILM_STD = 0.3
"""Largest accepted difference between an estimated property and that of the solved film, in standard deviations."""

MAX_NEGLECTED_EFFECT = 0.001
"""Second-order effect of the imperfections, relative to the charges, above which the uneven film itself is solved."""

NOT_CONVERGED = (
    "the estimated film differs from the solved one, so its charges may err by more than "
    f"{100.0 * MAX_NEGLECTED_EFFECT:g} %, and the model by more than it states: describe the film better in the sensor "
    "file, or give more presses"
)
"""Caution about an uneven film whose solution changes the estimate again and again."""

MAX_USUAL_NOISE = 0.01
"""Noise, relative to the charge, above which a caution is given, dimensionless."""

PLACEMENT_PROPERTIES = ("shift_x", "shift_y", "rotation")
"""Names of the properties that describe where the electrodes are."""

UNUSUAL_DEVIATION = 3.0
"""Deviation of a property from its prior mean, in prior standard deviations, above which a caution is given."""


def calibrate(
    presses: MeasuredPresses,
    problem: CalibrationProblem,
    *,
    executor: Executor | None = None,
    start: FilmCharges | None = None,
    accurate: bool = True,
) -> CalibrationResult:
    """Estimate the properties of a film from presses on this film.

    The presses are checked first, and a press with the same charges as an earlier press is left out. Then an
    axisymmetric film is solved, and the properties are estimated with the charges of this film and their derivatives.
    Both steps are repeated until the estimate hardly changes. If the film is uneven, the uneven film itself is solved.

    Args:
        presses: The presses in the order in which they were made, with position, force or both, and the standard
            deviations of these measurements. If the sensor has more than three electrodes, presses without position and
            force can show how the film has changed since an earlier calibration.
        problem: The calibration problem.
        executor: Executor that runs the solves; None for this process.
        start: Solved film of an earlier calibration of the same problem, with which the calibration begins; None to
            solve a new film.
        accurate: Whether an uneven film is solved. If False, the unevenness is only taken into account to first order,
            which is enough to choose further presses.

    Raises:
        PressError: If the records of the presses are impossible, if no film explains the presses, or if the electrodes
            would be too far from their described places. The message names the reason if it is found.
    """
    # Check the recorded presses, and select those that are used.
    recorded_presses = presses.of_electrodes(problem.electrodes, problem.sensor.name)
    check_places(recorded_presses, problem.sensor.film)
    cautions = []
    # A press that is in the file twice would count as two independent measurements.
    is_copy = have_charges_of_earlier(recorded_presses.charge_pC)
    if is_copy.any():
        cautions.append(f"{recorded_presses[is_copy].line_words}: the charges of an earlier press; left out")
    distinct_presses = recorded_presses[~is_copy]
    if _is_uninformative(distinct_presses):
        raise PressError(
            f"{len(distinct_presses)} presses of unknown position and force: three charges only determine x, y and the "
            "force, so they say nothing about the film; give the position or the force of a press (four electrodes "
            "would have one redundant charge)"
        )
    # The solved domain is larger than the working area, because errors may move presses at its edge to the outside.
    is_outside = problem.solved_domain.is_outside(distinct_presses.contact)
    used_presses = distinct_presses[~is_outside]
    outside_message = (
        f"{distinct_presses[is_outside].line_words}: a calibration takes presses {domain_words(problem.solved_domain)} "
        "(--radius, --force)"
    )
    if is_outside.any():
        if len(distinct_presses) == 1 or _is_uninformative(used_presses):
            raise PressError(outside_message)
        cautions.append(f"{outside_message}; left out")

    # Estimate the film.
    with single_threaded_blas():
        start_film = start or solve_even(problem, executor)
        if is_outside.mean() > 0.5:
            # The records probably contain a mistake, such as a wrong unit, for which `unexplained_error` searches.
            raise unexplained_error(distinct_presses, start_film, outside_message)
        estimation = _fit_film(problem, used_presses, start_film, accurate, executor)
        # The last solved film must be so similar to the final estimate that the charges of the estimate are accurate.
        if accurate and not _has_accurate_charges(estimation.charges, estimation.film.film_values, estimation.contact):
            cautions.append(NOT_CONVERGED)
        _check_placement(estimation.film)
        sensitivity = ContactSensitivity.of(estimation.film, estimation.charges, problem.domain)
    return CalibrationResult(
        problem=problem,
        presses=used_presses,
        estimation=estimation,
        sensitivity=sensitivity,
        cautions=(*cautions, *_cautions(used_presses, estimation)),
    )


def solve_even(
    problem: CalibrationProblem, executor: Executor | None = None, values: Array | None = None
) -> FilmCharges:
    """Return the charges of an axisymmetric film with given properties, for which a few presses are solved.

    The presses are made with an axisymmetric probe.

    Args:
        problem: The calibration problem.
        executor: Executor that runs the solves; None for this process.
        values: Properties of the film, shape (n_property,); None for the properties with which a calibration begins.
            Imperfections are ignored.
    """
    layout = problem.prior.layout
    film_values = problem.prior.mean[layout.film] if values is None else values
    return FilmCharges.of_even_film(layout.prior, film_values, problem.solved_domain, executor)


def _fit_film(
    problem: CalibrationProblem,
    presses: MeasuredPresses,
    charges: FilmCharges,
    solve_uneven: bool,
    executor: Executor | None,
) -> Estimation:
    """Estimate a film from presses in the solved domain.

    An even film has no imperfections, so it is axisymmetric and quickly solved. In the first stage, even films are
    solved and the properties are estimated in turn, until the estimate hardly changes. In the second stage, the
    estimated film is solved with its imperfections and its real probe, and the properties are estimated again. If the
    film then differs much from the solved one, the second stage is repeated once. The second stage is left out for a
    nearly even film under an axisymmetric probe.

    Args:
        problem: The calibration problem.
        presses: The presses, with the electrodes in the order of the sensor.
        charges: Charges of the film that is used first, and of similar films.
        solve_uneven: Whether the second stage may take place.
        executor: Executor that runs the solves; None for this process.

    Raises:
        PressError: If the presses probably contain a mistake, or no film explains them.
    """
    # Refuse presses whose records contain a mistake. `find_mistakes` returns an empty list if it finds none.
    check_channels(presses, charges)
    if misfit(presses, charges) > SUSPICIOUS_MISFIT and find_mistakes(presses, charges):
        raise unexplained_error(presses, charges, "their charges are very different from those of its films")

    # First stage: even films. The given film is used first.
    data = PressData.of(presses, problem.noise, problem.solved_domain)
    estimation = estimate(charges, data, problem.prior)
    for _ in range(MAX_SOLVED_FILMS - 1):
        if _largest_deviation(estimation) < SAME_FILM_STD:
            break
        charges = solve_even(problem, executor, estimation.film.film_values)
        estimation = estimate(charges, data, problem.prior, estimation)

    # Search for mistakes again if the estimate assumes larger errors than stated, or has a property at a bound.
    is_at_bound = np.equal(estimation.film.film_values, problem.prior.layout.prior.bounds)  # lower or upper
    is_doubtful = estimation.hypothesis.errors.position_ratio > 1.0 or is_at_bound.any()
    if is_doubtful and find_mistakes(presses, charges):
        raise unexplained_error(
            presses, charges, "only larger errors of the positions or an improbable film would explain them"
        )

    # Second stage: the film with its imperfections. Its solution takes long. It would not help presses that no film
    # explains, because the first stage already contains the first-order effects of the imperfections. It may help if
    # the probe is not axisymmetric, because the first stage replaces the probe by a circle.
    is_final = not solve_uneven or (estimation.is_unexplained and problem.probe.is_axisymmetric)
    for _ in range(2):
        values = estimation.film.film_values
        if is_final or _has_accurate_charges(estimation.charges, values, estimation.contact):
            break
        estimation = estimate(estimation.charges.solved(values, executor), data, problem.prior, estimation)
    if estimation.is_unexplained:
        raise unexplained_error(
            presses,
            estimation.charges,
            f"{estimation.is_bad.sum()} of them do not agree with the others, and the charges of the best film differ "
            f"from those of the others by {estimation.residual:.2g} times the noise",
        )
    return estimation


def _largest_deviation(estimation: Estimation) -> float:
    """Return the largest difference between properties of the estimated and the solved film, in standard deviations.

    Only properties that change the stress of an axisymmetric film are compared. The other properties are imperfections,
    or their effects on the charges are exact without a new solution.
    """
    film, charges = estimation.film, estimation.charges
    is_even = charges.prior.changes_stress & ~charges.prior.is_imperfection
    std = np.sqrt(np.diagonal(film.covariance)[film.layout.film])
    return float(np.abs((film.film_values - charges.values) / std)[is_even].max())


def _has_accurate_charges(charges: FilmCharges, film_values: Array, contact: Array) -> bool:
    """Return whether first-order changes of a solved film give the charges of a film with given properties accurately.

    The solved film may lack some imperfections. Of these imperfections, only first-order effects on the charges are
    known. First-order effects are accurate enough if the second-order effects are below `MAX_NEGLECTED_EFFECT`. If the
    solved probe or the solved material lacks a property, even the first-order effect of this property is unknown.

    Args:
        charges: The solved film, with its charges and their derivatives.
        film_values: The given properties, shape (n_property,).
        contact: Contacts at which the effects are computed, shape (n, 3).
    """
    solved, prior = charges.film, charges.prior
    if solved.probe.is_axisymmetric != prior.probe.is_axisymmetric:  # a circle was solved instead of the real probe
        return False
    if solved.sensor.film.shear != prior.sensor.film.shear:  # a film without the described shear modulus was solved
        return False

    # Compute the first-order effect of the imperfections that the solved film lacks, relative to the charges. Only
    # imperfections that change the stress can be missing. The effects of all other imperfections are exact.
    charge, _, jacobian = charges.linearised(film_values, contact)
    charge_size = np.linalg.norm(charge)
    can_be_missing = prior.is_imperfection & prior.changes_stress
    missing = np.where(can_be_missing, film_values - charges.values, 0.0)  # missing part of each property
    first_order_effect = np.linalg.norm(jacobian @ missing) / charge_size

    # An uneven tension also has a second-order effect of its own, even if its first-order effect is small. If u is the
    # ratio of the uneven tension to the mean tension T, the film behaves as if T were smaller by up to T u^2 / 2.
    tension_index = prior.index(PRETENSION.name)
    missing_shares = missing[np.isin(prior.names, UNEVEN_TENSIONS)]  # the two components of u
    lost_tension_MPa = 0.5 * film_values[tension_index] * (missing_shares**2).sum()
    tension_effect = lost_tension_MPa * np.linalg.norm(jacobian[:, :, tension_index]) / charge_size
    # All other second-order effects together are about the square of the first-order effect.
    return bool(first_order_effect**2 + tension_effect < MAX_NEGLECTED_EFFECT)


def _is_uninformative(presses: MeasuredPresses) -> bool:
    """Return whether presses only determine their own contacts, and so contain no information about the film.

    This is the case if all contacts are unknown, and each press has at most three charges for its x, y and force.
    Without presses, the result is False.
    """
    return len(presses) > 0 and len(presses.electrodes) <= 3 and bool(np.isnan(presses.contact).all())


def _check_placement(film: FilmEstimate) -> None:
    """Check that the estimated shift and rotation of the electrodes are inside the ranges that the estimator searches.

    Raises:
        PressError: If the shift or the rotation is at an end of its range. The true value then probably lies outside
            the range, so that neither the estimate nor its standard deviation is right.
    """
    for film_property in film.layout.prior.properties:
        value = film.value(film_property.name)
        if film_property.name in PLACEMENT_PROPERTIES and value in film_property.limits:
            raise PressError(
                f"{film_property.meaning}: the presses agree best with {value:.3g} {film_property.unit}, which is an "
                "end of the range that is searched: is the origin of the stage the centre of the film, are its axes "
                "those of the film, and are the electrodes where the sensor file describes them?"
            )


def _cautions(presses: MeasuredPresses, estimation: Estimation) -> list[str]:
    """Return warnings about presses, the session, and a film that differs much from its description.

    The estimator has compared several hypotheses about the errors of the presses. Some warnings state the errors of the
    most probable hypothesis, which may be larger than the user has stated.
    """
    cautions = []
    film = estimation.film  # its noise is an average over the hypotheses
    if estimation.is_bad.any():
        cautions.append(f"{presses[estimation.is_bad].line_words}: does not agree with the other presses; left out")
    if estimation.is_improbable:  # the residuals are too large for the most probable hypothesis
        cautions.append(
            f"the presses differ from the best film by {estimation.residual:.2g} times their errors, so the model may "
            "err by as many times more than it states: make the presses again, or state larger errors (--charge-std, "
            "--position-std, --force-std)"
        )
    errors = estimation.hypothesis.errors  # a further scatter is zero if the stated errors are large enough
    if errors.noise.gain > MAX_USUAL_NOISE:
        cautions.append(
            f"the charges scatter by about {100.0 * film.noise.gain:.2g} %, which the standard deviations of the model "
            "contain: are the charges read at rest, does the film lie still, and is the noise of the board at most "
            f"{film.noise.white:g} pC (--charge-std)?"
        )
    if errors.position_ratio > 1.0:
        cautions.append(
            f"the positions scatter about {errors.position_ratio:.0f} times as much as stated (--position-std): are "
            "they measured from the centre of the film, and does the probe touch it where the stage says?"
        )
    if errors.force_scatter + errors.constant_force_scatter > 0.0:  # none of them is negative
        cautions.append(
            f"the forces scatter more than stated, by about {100.0 * errors.force_scatter:.2g} % of each force and "
            f"{100.0 * errors.constant_force_scatter:.2g} % of their geometric mean: is the load cell zero "
            "without a load, does it lag behind, or do the charges leak between the press and its reading? The "
            "standard deviations of the model do not contain errors that many forces share"
        )
    cautions.extend(film.session_cautions())
    for declared in film.layout.prior.properties:  # the declaration states the prior distribution of a property
        value = film.value(declared.name)
        is_unusual = abs(value - declared.mean) > UNUSUAL_DEVIATION * declared.std
        if is_unusual and not declared.is_imperfection:
            value_text = f"{value:.3g} {declared.unit}".removesuffix(" 1")  # a ratio has the unit 1
            cautions.append(
                f"{declared.meaning}: {value_text}, which is unusually far from the sensor file: is the origin of the "
                "stage the centre of the film, are its axes those of the film, are the forces in N and the charges in "
                "pC, and has each channel the gain of the sensor file?"
            )
    if is_one_place(presses):
        cautions.append("all known positions are at one place, so they do not determine where the electrodes are")
    return cautions
