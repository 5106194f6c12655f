"""Whether noise explains errors: their summary, the part that all presses share, and the sum of squares."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.prediction.chi_squared import chi_squared_survival
from isocharge.serve.prediction.press_errors import PressErrors

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
