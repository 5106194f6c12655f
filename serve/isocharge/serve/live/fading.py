"""Cause of the decrease of the charges of a held press: a leak of the amplifiers, or creep of the film.

A leak removes the same share of the charge in every second. The logarithm of the charge Q is then a linear function of
the time t since the touch, ln Q = a - t / tau. Creep removes the same share of the charge in every decade of time. The
logarithm of the charge Q is then a linear function of ln t, ln Q = a + b ln t. Both functions are fitted to the charges
of a press. A cause is only stated if the other function has a much larger sum of squared residuals.

The section `[leak]` of a device file corrects a leak. Creep is not corrected. If the section `[leak]` is used for a
film that creeps, the error of the charges increases with time.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array

MIN_RESIDUAL_RATIO = 9.0
"""Smallest ratio of the sums of the squared residuals of two laws for which the better law is reported.

With a smaller ratio, variations in the force of a hand could decide which law is reported.
"""

MIN_WINDOWS = 5
"""Smallest number of windows of a press to which the laws are fitted."""


class Fading(NamedTuple):
    """Cause for which the charges of a held press decrease.

    Attributes:
        cause: The cause and advice to the user, as a part of a sentence.
        tau_s: Time constant of the leak with two significant digits, s; None if the cause is not a leak.
    """

    cause: str
    tau_s: float | None = None


def cause_of_fading(mean_magnitudes: Sequence[tuple[float, float]]) -> Fading:
    """Determine why the charges of a press with a constant force decrease.

    The cause is not known if there are fewer than `MIN_WINDOWS` pairs, if the charges do not decrease, or if neither
    law fits clearly better than the other.

    Args:
        mean_magnitudes: Pairs (t, Q). The first value is a time since the touch, s. The second value is the mean
            magnitude of the charges at this time, in any unit, which must be positive.
    """
    unknown = Fading(
        "the charges follow neither a leak of the amplifier nor creep of the film clearly: hold a press for several "
        "seconds, with a weight, and set no [leak] before"
    )
    if len(mean_magnitudes) < MIN_WINDOWS:
        return unknown
    held_s, magnitude = np.array(mean_magnitudes).T
    leak_slope_per_s, leak_residual = _fit_line(held_s, np.log(magnitude))
    creep_slope, creep_residual = _fit_line(np.log(held_s), np.log(magnitude))
    if leak_slope_per_s >= 0.0 or creep_slope >= 0.0:
        return unknown
    if creep_residual > MIN_RESIDUAL_RATIO * leak_residual:
        tau_s = float(f"{-1.0 / leak_slope_per_s:.2g}")
        return Fading(f"the amplifier leaks: put [leak] tau_s = {tau_s:g} into a device file", tau_s)
    if leak_residual > MIN_RESIDUAL_RATIO * creep_residual:
        lost_percent = 100.0 * (1.0 - 10.0**creep_slope)
        return Fading(
            f"the film creeps by {lost_percent:.2g} % in each decade of time, which is not corrected: set no [leak] "
            "for it, and wait longer before each reading"
        )
    return unknown


def _fit_line(x: Array, y: Array) -> tuple[float, float]:
    """Return the slope and the sum of the squared residuals of a least-squares line through points of shape (n,)."""
    (slope, _), (squared_residual,), *_ = np.polyfit(x, y, deg=1, full=True)
    return float(slope), float(squared_residual)
