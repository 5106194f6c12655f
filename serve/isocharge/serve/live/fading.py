"""Why a held press fades: the amplifier leaks, or the film creeps.

A leak takes the same share of the charge in equal times, creep in equal ratios of time:

    ln Q = a - t / tau,    ln Q = a + b ln t,

t since the touch. Both lines are fitted to the charges of the press; which of them holds is said only where the other
leaves three times its residual. [leak] undoes the first and would make an error that grows with time of the second.
"""

from collections.abc import Sequence

import numpy as np

CLEARER = 9.0
"""Ratio of the squared residuals from which one law is said to hold: below it a hand that trembles decides."""

FEWEST = 5
"""Charges of a press that are compared, at least."""

UNTOLD = (
    "or the amplifier leaks or the film creeps, which cannot be told apart yet: hold a press for several seconds, and "
    "set no [leak] before"
)


def cause_of_fading(sizes: Sequence[tuple[float, float]]) -> str:
    """What may fade a press that is held with the same force, and what to do: the end of a sentence.

    Args:
        sizes: Times since the touch, s, and mean magnitudes of the charges then, positive, pC.
    """
    if len(sizes) < FEWEST:
        return UNTOLD
    held_s, size_pC = np.array(sizes).T
    of_leak, left_by_leak = _line(held_s, np.log(size_pC))
    of_creep, left_by_creep = _line(np.log(held_s), np.log(size_pC))
    if max(of_leak, of_creep) >= 0.0:
        return UNTOLD
    if left_by_creep > CLEARER * left_by_leak:
        return f"or the amplifier leaks: then put [leak] tau_s = {-1.0 / of_leak:.2g} into a device file"
    if left_by_leak > CLEARER * left_by_creep:
        percent = -100.0 * np.expm1(of_creep * np.log(10.0))
        return (
            f"or the film creeps, by {percent:.2g} % in each decade of time: wait longer before each reading; this is "
            "no leak, so set no [leak] for it"
        )
    return UNTOLD


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope of the straight line through points, and the sum of its squared residuals."""
    x, y = x - x.mean(), y - y.mean()
    slope = float(x @ y) / float(x @ x)
    return slope, float(np.square(y - slope * x).sum())
