"""Comparison of a model with measured presses.

The rig is the machine that sets the position and the force of each press. The result of the comparison contains the
errors of the model and a verdict. The result also states which part of the errors is explained by the noise and by the
uncertainty of the rig.

If the noise of the charges and the uncertainty of the rig do not explain the errors, the model does not describe the
film. Either the film was never calibrated, or the film has aged or crept since its calibration. A drift of the film
first appears as a common scale factor of all forces and as a common shift of all positions.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.structs import plain_values
from isocharge.serve.model.contact import Validity
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.model.session import COLUMNS
from isocharge.serve.prediction.press_errors import (
    FORCE,
    NOT_TRAINED,
    TEST_SIGNIFICANCE,
    Agreement,
    PressErrors,
    chi_squared_deviate,
    misfit_limit,
    press_errors,
)
from isocharge.serve.presses.measured_presses import MeasuredPresses
from isocharge.serve.presses.std_factor import FEWEST_HELD_OUT, StdFactor, binomial_distribution

MIN_PRESSES = 3
"""Smallest number of presses for a verdict. With fewer presses, a single bad press cannot be recognised."""

MAX_BAD_FRACTION = 0.1
"""Largest fraction of bad presses for which a model may still fit. A single bad press is always allowed."""

MISFIT_FRACTION = 0.01
"""Largest fraction of good presses whose misfit is above `misfit_limit`."""

RIG_REMEDY = (
    "if the positions or forces of the rig may scatter by as much, state it: --position-std, --force-std, or columns "
    "of the file, which take precedence"
)
FILM_REMEDY = (
    "if the film has changed since its calibration, or was never calibrated, run `isocharge train calibrate`; if a "
    "calibration does not help, train on at least 500 measured presses: `isocharge train fit PRESSES.csv`"
)
"""Notes about possible remedies for a model that does not fit."""


@dataclass(frozen=True)
class ErrorSummary:
    """Summary of the errors of the positions in mm, or of the forces in %.

    Attributes:
        presses: Number of presses.
        rms: Root mean square of the errors.
        median: Median of the absolute errors.
        max: Largest absolute error.
        noise: Expected root mean square of the errors that the noise of the charges causes.
        rig: Expected root mean square of the errors that the uncertainty of the rig causes.
        explained: Expected root mean square of the errors that noise and rig cause together.
        beyond: Part of the errors that noise and rig do not explain: the square root of rms^2 - explained^2, or 0 if
            this difference is negative.
    """

    presses: int
    rms: float
    median: float
    max: float
    noise: float
    rig: float
    explained: float
    beyond: float

    @classmethod
    def from_errors(cls, error: Array, noise_std: Array, rig_std: Array) -> "ErrorSummary | None":
        """Summarise errors, and compare the mean square error with the variances that noise and rig cause.

        The noise is that of the charges. The rig is the machine that sets the position and the force of each press.

        Args:
            error: Components of the error of each press, shape (n, components); NaN where unknown.
            noise_std: Standard deviations of the components, as caused by the noise of the charges.
            rig_std: Standard deviations of the components, as caused by the uncertainty of the rig.

        Returns:
            The summary; None if there are no presses with known errors.
        """
        is_known = ~np.isnan(error).any(axis=1)
        if not is_known.any():
            return None
        magnitude = np.linalg.norm(error[is_known], axis=1)
        # The next four values are root mean squares over the presses, in the unit of the errors.
        rms = _rms_of_vectors(error[is_known])
        noise = _rms_of_vectors(noise_std[is_known])
        rig = _rms_of_vectors(rig_std[is_known])
        explained = math.hypot(noise, rig)
        return cls(
            presses=magnitude.size,
            rms=rms,
            median=float(np.median(magnitude)),
            max=float(magnitude.max()),
            noise=noise,
            rig=rig,
            explained=explained,
            beyond=math.sqrt(max(rms**2 - explained**2, 0.0)),  # the errors may happen to be smaller than expected
        )


def _rms_of_vectors(components: Array) -> float:
    """Return the root mean square of the lengths of vectors, whose components have the shape (n, components)."""
    return float(np.sqrt(np.mean(np.sum(components**2, axis=1))))


@dataclass(frozen=True)
class PressCheck:
    """Result of the comparison of a model with measured presses.

    Attributes:
        model: Label of the model, `name/version`.
        presses: Number of presses in the file.
        compared: Number of presses from which the errors and the tests are computed.
        position_mm: Errors of the positions; None if no position is known.
        force_percent: Errors of the forces; None if no force is known.
        agreement: Statistical tests of the errors.
        fits: Whether the noise and the uncertainty of the rig explain the errors; None if there are too few presses.
        verdict: The result of the comparison in words.
        notes: Further findings, as one sentence for each finding.
        errors: Errors of each press.
        std_factor: Factor for the standard deviations of the model that guarantees a coverage; None if there are too
            few presses.
    """

    model: str
    presses: int
    compared: int
    position_mm: ErrorSummary | None
    force_percent: ErrorSummary | None
    agreement: Agreement
    fits: bool | None
    verdict: str
    notes: tuple[str, ...]
    errors: PressErrors
    std_factor: StdFactor | None

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary of values that can be written as JSON.

        The names of the values contain the units. Unknown values are None.
        """
        agreement = self.agreement
        degrees_of_freedom = agreement.degrees
        # Mean errors that are common to all presses, in the order x (mm), y (mm), force (relative). `FORCE` is the
        # index of the force.
        common_error = agreement.common
        values: dict[str, Any] = {
            "each": self.errors.rows(),
            "model": self.model,
            "presses": self.presses,
            "counted": self.compared,
            "position_mm": self.position_mm,
            "force_percent": self.force_percent,
            "chi_squared": agreement.chi_squared,
            "degrees_of_freedom": degrees_of_freedom,
            "chi_squared_per_degree": agreement.chi_squared / degrees_of_freedom if degrees_of_freedom else None,
            "p_value": agreement.p_value,
            "shift_mm": common_error.mean[:FORCE],  # x and y
            "shift_std_mm": common_error.std[:FORCE],
            "force_scale": 1.0 + common_error.mean[FORCE],  # predicted force relative to the measured force
            "force_scale_std": common_error.std[FORCE],
            "common_p_value": agreement.common_p_value,
            "std_factor": None if self.std_factor is None else self.std_factor.factor,
            "fits": self.fits,
            "notes": self.notes,
            "verdict": self.verdict,
        }
        return dict(plain_values(values))


def check_presses(predictor: Predictor, presses: MeasuredPresses) -> PressCheck:
    """Compare a model with measured presses.

    A press is compared if all charges of the press are known, and if the position, the force or both are known. If the
    position is known, it must lie in the working area of the model. If the force is known, it must lie in the range of
    forces of the model. A few bad presses are reported and excluded if all other presses agree with the model.

    Args:
        predictor: The model.
        presses: The presses, with at least the electrodes of the model.

    Raises:
        PressError: If the presses contain no charges of one of the model's electrodes.
    """
    # Exclude the bad presses, and test whether noise and rig explain the errors of the other presses.
    metadata = predictor.metadata
    errors = press_errors(predictor, presses)
    is_compared = errors.is_compared
    is_bad = _bad_presses(errors)
    is_selected = is_compared & ~is_bad
    selected_count = int(is_selected.sum())
    agreement = Agreement.from_errors(errors, is_selected)

    # Summarise the errors of the positions and the errors of the forces, together with the standard deviations that
    # noise and rig cause. An error is the predicted minus the measured value. Each array has the columns x, y (mm) and
    # force (relative), shape (n_selected, 3). `FORCE` is the index of the column of the force.
    selected = (errors.error[is_selected], errors.noise_std[is_selected], errors.rig_std[is_selected])
    position_mm = ErrorSummary.from_errors(*[columns[:, :FORCE] for columns in selected])
    force_percent = ErrorSummary.from_errors(*[100.0 * columns[:, FORCE:] for columns in selected])
    misfit_text = _misfit_statement(errors, is_selected, metadata)  # empty unless too many presses have a large misfit

    fits = None  # True or False for a verdict; remains None if there are too few presses
    if selected_count >= MIN_PRESSES:
        fits = agreement.acceptable and not misfit_text

    # The guarantee holds for all presses, so that the factor is computed from the bad presses, too.
    std_factor = None  # remains None if too few presses are compared for a guarantee
    if is_compared.sum() >= FEWEST_HELD_OUT:
        std_factor = StdFactor.from_errors(errors.error[is_compared], errors.noise_std[is_compared])

    # Collect the explanations for the user.
    notes: list[str] = []
    if fits is False:
        if not misfit_text:  # no error of the rig explains charges that fit no press
            notes.append(RIG_REMEDY)
        notes.append(FILM_REMEDY)
    notes += _exclusion_notes(errors, predictor.validity)
    if is_bad.any():
        notes.append(f"{errors.presses[is_bad].line_words}: nothing like the other presses, left out; look at it")
    if fits is not None:
        notes += _common_notes(agreement)
    return PressCheck(
        model=metadata.label,
        presses=len(presses),
        compared=selected_count,
        position_mm=position_mm,
        force_percent=force_percent,
        agreement=agreement,
        fits=fits,
        verdict=_verdict(fits, selected_count, position_mm, force_percent, misfit_text),
        notes=tuple(notes),
        errors=errors,
        std_factor=std_factor,
    )


def _bad_presses(errors: PressErrors) -> Booleans:
    """Find bad presses. A bad press has an improbable error, although all other presses agree with the model.

    Presses are considered bad only under three conditions: the presses as a whole do not agree with the model, only a
    few presses have improbable errors, and the other presses agree with the model. A single press always counts as few.
    At least `MIN_PRESSES` presses must remain.

    Args:
        errors: Errors of all presses.

    Returns:
        Whether each press is bad, shape (n,).
    """
    # The probability of such large errors is below a limit, which is divided by the number of compared presses
    # (Bonferroni correction). If all presses are good, the probability that one of them is found is therefore at most
    # `TEST_SIGNIFICANCE`.
    is_compared = errors.is_compared
    compared_count = is_compared.sum()
    # Number of known errors of each press, which is the number of degrees of freedom of its chi-squared; 1 if none
    degrees_of_freedom = np.maximum(np.count_nonzero(~np.isnan(errors.error), axis=1), 1)
    # Chi-squared is converted to a variable that has a standard normal distribution for good presses.
    z_score = chi_squared_deviate(errors.chi_squared, degrees_of_freedom)
    limit = NormalDist().inv_cdf(1.0 - TEST_SIGNIFICANCE / max(1, compared_count))
    is_improbable = is_compared & (z_score > limit)

    improbable_count = is_improbable.sum()
    few_are_improbable = improbable_count <= max(1.0, MAX_BAD_FRACTION * compared_count)
    enough_others_remain = compared_count - improbable_count >= MIN_PRESSES
    all_agree = Agreement.from_errors(errors, is_compared).acceptable
    others_agree = Agreement.from_errors(errors, is_compared & ~is_improbable).acceptable
    return is_improbable & (few_are_improbable and enough_others_remain and others_agree and not all_agree)


def _misfit_statement(errors: PressErrors, is_selected: Booleans, metadata: ModelMetadata) -> str:
    """Return a statement for the user if more presses have a large misfit than chance can explain.

    The misfit is the distance between the measured charges and the nearest charges of a single contact. A misfit is
    large if it is above `misfit_limit`. Each good press has a large misfit with a probability of at most 1 %, so that
    the number of large misfits of good presses has a binomial distribution.

    Args:
        errors: Errors of all presses.
        is_selected: Whether each press is counted, shape (n,).
        metadata: Metadata of the model.

    Returns:
        The statement; empty if chance can explain the number of presses with a large misfit.
    """
    selected_count = int(is_selected.sum())
    limit = misfit_limit(metadata)
    misfit_count = np.count_nonzero(errors.predicted[is_selected, COLUMNS["misfit"]] > limit)
    if misfit_count == 0:
        return ""
    # Probabilities that at most 0, 1, ... presses have a large misfit, if all presses are good
    probability_of_at_most = binomial_distribution(selected_count, MISFIT_FRACTION)
    # At least `misfit_count` presses have a large misfit unless at most `misfit_count - 1` presses have one.
    probability_of_so_many = 1.0 - probability_of_at_most[misfit_count - 1]
    if probability_of_so_many >= TEST_SIGNIFICANCE:
        return ""
    return (
        f"{misfit_count} of {selected_count} presses have a misfit above {limit:.3g}, although "
        "at most 1 % of good presses have: no single press on the model's film gives such charges (gain, tare, swapped "
        "or dead electrode)"
    )


def _verdict(
    fits: bool | None, count: int, position: ErrorSummary | None, force: ErrorSummary | None, misfit_text: str
) -> str:
    """Return a sentence that states the result of the comparison.

    Args:
        fits: Whether the model fits the presses; None if there are too few presses for a verdict.
        count: Number of compared presses.
        position: Errors of the positions; None if no position is known.
        force: Errors of the forces; None if no force is known.
        misfit_text: Statement that too many presses have a large misfit; empty if this is not the case.
    """
    if fits is None:
        return f"too few presses to say: {count} can be compared, {MIN_PRESSES} are needed"
    if fits:
        return "fits: noise explains the errors"

    # State the part of the errors that noise and rig do not explain, which is the attribute `beyond`.
    summaries = {"mm": position, "%": force}
    unexplained = [f"{summary.beyond:.2g} {unit}" for unit, summary in summaries.items() if summary is not None]
    verdict = f"does not fit: {' and '.join(unexplained)} beyond noise"
    if misfit_text:
        return f"{verdict}; {misfit_text}"
    return verdict


def _exclusion_notes(errors: PressErrors, validity: Validity) -> Iterator[str]:
    """Yield one note for each reason why presses were excluded from the comparison.

    Each note contains the reason, and lists the lines of the presses that were excluded for this reason.

    Args:
        errors: Errors of all presses, with the reason why each press was excluded.
        validity: The working area and the range of forces of the model.
    """
    min_force_N, max_force_N = validity.force_range_N
    outside_domain = (  # replaces the short reason NOT_TRAINED
        f"outside the model's working area ({validity.area_text}) or forces ({min_force_N:.3g} to {max_force_N:.3g} N)"
        "; if these are most, look at the units"
    )
    reasons = errors.exclusion_reasons
    for reason in sorted(set(reasons.tolist()) - {""}):  # a press that is compared has an empty reason
        excluded = errors.presses[reasons == reason]
        explanation = outside_domain if reason == NOT_TRAINED else reason
        yield f"{len(excluded)} of {len(reasons)} presses do not count: {explanation} ({excluded.line_words})"


def _common_notes(agreement: Agreement) -> Iterator[str]:
    """Yield a note about a common shift of all positions, and a note about a common scale factor of all forces.

    A note is only yielded if its shift or change of scale is significant. If the presses have no common error, chance
    causes such a value of x, of y or of the force with a probability of at most `TEST_SIGNIFICANCE` each.

    Args:
        agreement: Tests of the errors, which contain the common errors of x, y and the force.
    """
    # Common errors of x (mm), y (mm) and the force (relative), their standard errors, and the common errors divided by
    # standard errors that include the rig; each of shape (3,). `FORCE` is the index of the force.
    mean, std, z_score = agreement.common
    limit = NormalDist().inv_cdf(1.0 - 0.5 * TEST_SIGNIFICANCE)  # errors of both signs count
    x_shift_mm, y_shift_mm, force_scale_change = mean
    if np.nanmax(np.abs(z_score[:FORCE]), initial=0.0) > limit:
        yield (
            f"positions are off by ({x_shift_mm:.2g}, {y_shift_mm:.2g}) +- {std[:FORCE].max():.2g} mm on the average: "
            "electrodes or rig are shifted"
        )
    if abs(z_score[FORCE]) > limit:
        yield (
            f"forces are {1.0 + force_scale_change:.4g} +- {std[FORCE]:.2g} times the measured ones on the average, as "
            "after a change of pretension, d31 or gains"
        )
