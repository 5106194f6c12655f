"""Errors of a model on measured presses, one by one, beside the deviations that noise and rig explain.

Whether these explain them: a summary, the part that all presses share, and the sum of squares.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.flags import MISFIT, OUTSIDE
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.session import N_WITHOUT_CORRELATION
from isocharge.serve.prediction.contact import MISFIT_LIMIT, Contacts, Validity, inside_polygon
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.serve.prediction.predictor import Predictor

NO_CHARGE, NOTHING_KNOWN, NOT_TRAINED = "a charge is unknown", "neither place nor force is known", "not trained for"
"""Reasons why a press does not count."""


@dataclass(frozen=True)
class PressErrors:
    """A model's answers to n measured presses, and how far they are off.

    Attributes:
        lines: Number of each press in its file.
        row_noun: What `lines` counts: "line" of a CSV file, "row" of a Parquet file.
        answer: The numbers of a `Contact`, shape (n, 10); NaN where they or a charge are unknown.
        error: Predicted less known x and y, mm, and force, a share of the known one, shape (n, 3); NaN where unknown.
        noise_std: The model's own standard deviations, in the units of `error`, shape (n, 3): noise of the charges.
        rig_std: Those of what is known, in the units of `error`, shape (n, 3).
        flags: `outside` (the answer, as `Validity` has it) and `misfit` (beyond 1 % of good presses) of each press.
        left_out: Why a press does not count, empty if it does.
    """

    lines: tuple[int, ...]
    row_noun: str
    answer: Array
    error: Array
    noise_std: Array
    rig_std: Array
    flags: tuple[tuple[str, ...], ...]
    left_out: tuple[str, ...]

    @property
    def counted(self) -> Booleans:
        """Presses that count, shape (n,)."""
        return np.array([not reason for reason in self.left_out], dtype=np.bool_)

    @property
    def variance(self) -> Array:
        """Expected squares of the errors, shape (n, 3)."""
        return self.noise_std**2 + self.rig_std**2

    @property
    def position_error_mm(self) -> Array:
        """Distance from the known place, shape (n,), mm; NaN where unknown."""
        return np.hypot(self.error[:, 0], self.error[:, 1])

    def row(self, press: int) -> dict[str, Any]:
        """One press, names with units."""
        error, noise, rig = self.error[press], self.noise_std[press], self.rig_std[press]
        return {
            "line": self.lines[press],
            **dict(zip(Contacts._fields[:N_WITHOUT_CORRELATION], self.answer[press].tolist(), strict=False)),
            "x_error_mm": error[0],
            "y_error_mm": error[1],
            "position_error_mm": self.position_error_mm[press],
            "force_error_percent": 100.0 * error[2],
            "noise_std_percent": 100.0 * noise[2],
            "position_std_mm": rig[0],
            "force_std_percent": 100.0 * rig[2],
            "flags": list(self.flags[press]),
            "left_out": self.left_out[press] or None,
        }


def press_errors(predictor: Predictor, presses: MeasuredPresses) -> PressErrors:
    """Predict measured presses and compare.

    Raises:
        PressError: If a charge of one of the model's electrodes is missing.
    """
    metadata = predictor.metadata
    presses = presses.of_electrodes(metadata.electrodes, metadata.label)
    answer = _answers(predictor, presses.charge_pC)
    known = presses.contact
    scale = np.column_stack([np.ones((len(presses), 2)), known[:, 2]])
    rig_std = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std])
    unknown = np.where(np.isnan(known), np.nan, 1.0)
    return PressErrors(
        presses.lines,
        presses.row_noun,
        answer,
        (answer[:, :3] - known) / scale,
        answer[:, 3:6] / scale * unknown,
        rig_std * unknown,
        _flags(metadata, answer),
        _reasons(metadata, presses),
    )


def misfit_limit(metadata: ModelMetadata) -> float:
    """Misfit that 1 % of good presses exceed, as the model states it."""
    return float(metadata.errors.get("misfit_p99", MISFIT_LIMIT))


def _answers(predictor: Predictor, charge_pC: Array) -> Array:
    answer = np.full((len(charge_pC), len(Contacts._fields)), np.nan)
    whole = ~np.isnan(charge_pC).any(axis=1)
    answer[whole] = np.column_stack(predictor.predict_batch(charge_pC[whole]))
    return answer


def _flags(metadata: ModelMetadata, answer: Array) -> tuple[tuple[str, ...], ...]:
    outside = [OUTSIDE in flags for flags in Validity.of(metadata).batch_flags(Contacts(*answer.astype(np.float32).T))]
    misfit, whole = answer[:, N_WITHOUT_CORRELATION - 1] > misfit_limit(metadata), ~np.isnan(answer[:, 0])
    return tuple(
        (OUTSIDE,) * (is_outside and is_whole) + (MISFIT,) * is_misfit
        for is_outside, is_misfit, is_whole in zip(outside, misfit.tolist(), whole.tolist(), strict=True)
    )


def _reasons(metadata: ModelMetadata, presses: MeasuredPresses) -> tuple[str, ...]:
    """Why a press does not count; a press is in the model's domain by what is known of it, not by the answer."""
    (x_mm, y_mm, force_N), (low, high) = presses.contact.T, metadata.force_range_N
    off = ~np.isnan(x_mm) & ~inside_polygon(x_mm, y_mm, np.array(metadata.working_area_mm))
    off |= (force_N < low) | (force_N > high)
    nothing = np.isnan(presses.contact).all(axis=1)
    partial = np.isnan(presses.charge_pC).any(axis=1)
    return tuple(np.select([partial, nothing, off], [NO_CHARGE, NOTHING_KNOWN, NOT_TRAINED], "").tolist())


SIGNIFICANCE = 0.01
"""Probability with which a film that fits is said not to; half each for the sum of squares and the common part."""

SLACK = 1.1
"""Chi-squared per degree of freedom that is always accepted: standard deviations are known to 5 %, not better."""

COMMON_SHARE = 0.2
"""Share of its deviation by which a rig may be off in all presses alike: a stage has an offset, a load cell a scale."""


@dataclass(frozen=True)
class ErrorSummary:
    """Errors of one kind, mm or %.

    Attributes:
        presses: Number of presses.
        rms, median, max: Of the errors' sizes.
        noise, rig: Root mean square that noise of the charges explains, and that the rig's uncertainty explains.
        explained: Both together.
        beyond: Root of the difference of rms^2 and explained^2, 0 if that is negative.
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
    def of(cls, size: Array, noise_variance: Array, rig_variance: Array) -> "ErrorSummary | None":
        """Of the sizes of errors and their expected squares, each of shape (n,); None without presses."""
        if not size.size:
            return None
        square, noise, rig = (float(np.mean(values)) for values in (size**2, noise_variance, rig_variance))
        roots = np.sqrt([noise, rig, noise + rig, max(square - noise - rig, 0.0)]).tolist()
        return cls(size.size, square**0.5, float(np.median(size)), float(size.max()), *roots)


@dataclass(frozen=True)
class Common:
    """The part of an error that all presses share: its weighted mean.

    Attributes:
        mean: mm, or a share of the force; NaN if nothing is known.
        std: Standard error, from noise and rig, widened where the presses scatter more than these explain.
        significance: Mean over the standard error that includes what a rig may be off in all presses alike.
    """

    mean: float
    std: float
    significance: float

    @classmethod
    def of(cls, error: Array, variance: Array) -> "Common":
        """Of errors and their expected squares, shape (n,), NaN where unknown."""
        known = ~np.isnan(error)
        if not known.any():
            return cls(np.nan, np.nan, 0.0)
        error, weight = error[known], 1.0 / variance[known]
        mean, square = float(weight @ error / weight.sum()), 1.0 / float(weight.sum())
        scatter = float(weight @ (error - mean) ** 2) / max(len(error) - 1, 1)
        wide = square * (1.0 + COMMON_SHARE**2 * len(error))
        return cls(mean, (square * max(scatter, 1.0)) ** 0.5, mean / wide**0.5)


@dataclass(frozen=True)
class Agreement:
    """Whether noise and rig explain the errors of some presses.

    Attributes:
        chi_squared, degrees: Sum of squared errors over expected squares, and their number.
        p_value: Probability of a larger sum from noise and rig alone; NaN without presses.
        shift_x, shift_y: Common part of the position errors, mm.
        force: Common part of the force errors, a share.
        common_p_value: Probability of larger common parts from noise and rig alone; NaN without presses.
    """

    chi_squared: float
    degrees: int
    p_value: float
    shift_x: Common
    shift_y: Common
    force: Common
    common_p_value: float

    @classmethod
    def of(cls, errors: PressErrors, rows: Booleans) -> "Agreement":
        """Of some rows, shape (n,)."""
        error, variance = errors.error[rows], errors.variance[rows]
        chi_squared, degrees = float(np.nansum(error**2 / variance)), int(np.count_nonzero(~np.isnan(error)))
        x, y, force = (Common.of(error[:, kind], variance[:, kind]) for kind in range(3))
        known = [part.significance for part in (x, y, force) if not np.isnan(part.mean)]
        common_p_value = _p_value(sum(value**2 for value in known), len(known))
        return cls(chi_squared, degrees, _p_value(chi_squared, degrees), x, y, force, common_p_value)

    @property
    def acceptable(self) -> bool:
        """Whether noise and rig explain the errors."""
        scatters = self.p_value < 0.5 * SIGNIFICANCE and self.chi_squared > SLACK * self.degrees
        return not scatters and not self.common_p_value < 0.5 * SIGNIFICANCE


def _p_value(chi_squared: float, degrees: int) -> float:
    return chi_squared_survival(chi_squared, degrees) if degrees else np.nan


def chi_squared_survival(statistic: float, degrees: int) -> float:
    """Probability that a chi-squared variable exceeds a value.

    The tail is a finite sum (Abramowitz and Stegun 1964, 26.4.4 and 26.4.5): with x = statistic / 2, and erfc(sqrt(x))
    added for odd degrees,

        sum of x^s exp(-x) / Gamma(s + 1) over s = degrees / 2 - 1, degrees / 2 - 2, ... down to 0 or 1/2.

    Args:
        statistic: Sum of squares, not negative; infinity gives 0.
        degrees: Degrees of freedom, 1 or more.
    """
    x, odd = 0.5 * statistic, degrees % 2
    if x == 0.0 or math.isinf(x):
        return 0.0 if x else 1.0
    first = 0.5 * odd * math.log(4.0 * x / math.pi) - x  # the term of s = 0 or 1/2, of which the others are multiples
    ratios = np.log(x / (np.arange(1, degrees // 2) + 0.5 * odd))
    logarithms = first + np.concatenate([[0.0], np.cumsum(ratios)])[: degrees // 2]
    return min(1.0, odd * math.erfc(math.sqrt(x)) + float(np.exp(logarithms).sum()))
