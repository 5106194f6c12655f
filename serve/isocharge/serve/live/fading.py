"""Why a held press fades: the amplifier leaks, or the film creeps.

A leak takes the same share of the charge in equal times, creep in equal ratios of time:

    ln Q = a - t / tau,    ln Q = a + b ln t,

t since the touch. Both lines are fitted to the charges of the press; which of them holds is said only where the other
leaves three times its residual. [leak] undoes the first and would make an error that grows with time of the second.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

CLEARER = 9.0
"""Ratio of the squared residuals from which one law is said to hold: below it a hand that trembles decides."""

FEWEST = 5
"""Charges of a press that are compared, at least."""

UNTOLD = (
    "or the amplifier leaks or the film creeps, which cannot be told apart yet: hold a press for several seconds, and "
    "set no [leak] before"
)


class Fading(NamedTuple):
    """The law by which a press fades; nothing where none is clear.

    Attributes:
        tau_s: Time constant of a leak, s.
        creep: Share that creep takes in each decade of time, dimensionless.
    """

    tau_s: float | None = None
    creep: float | None = None


def law_of_fading(sizes: Sequence[tuple[float, float]]) -> Fading:
    """By which law a press fades that is held with the same force.

    Args:
        sizes: Times since the touch, s, and mean magnitudes of the charges then, positive, pC.
    """
    if len(sizes) < FEWEST:
        return Fading()
    held_s, size_pC = np.array(sizes).T
    of_leak, left_by_leak = _line(held_s, np.log(size_pC))
    of_creep, left_by_creep = _line(np.log(held_s), np.log(size_pC))
    if max(of_leak, of_creep) >= 0.0:
        return Fading()
    if left_by_creep > CLEARER * left_by_leak:
        return Fading(tau_s=-1.0 / of_leak)
    if left_by_leak > CLEARER * left_by_creep:
        return Fading(creep=-float(np.expm1(of_creep * np.log(10.0))))
    return Fading()


def cause_of_fading(sizes: Sequence[tuple[float, float]]) -> str:
    """What may fade such a press, and what to do: the end of a sentence; `sizes` as for `law_of_fading`."""
    law = law_of_fading(sizes)
    if law.tau_s is not None:
        return f"or the amplifier leaks: then put [leak] tau_s = {law.tau_s:.2g} into a device file"
    if law.creep is not None:
        return (
            f"or the film creeps, by {100.0 * law.creep:.2g} % in each decade of time: wait longer before each "
            "reading; this is no leak, so set no [leak] for it"
        )
    return UNTOLD


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope of the straight line through points, and the sum of its squared residuals."""
    x, y = x - x.mean(), y - y.mean()
    slope = float(x @ y) / float(x @ x)
    return slope, float(np.square(y - slope * x).sum())
