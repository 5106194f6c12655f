"""Why a held press fades: the amplifier leaks, or the film creeps.

A leak takes the same share of the charge in equal times, creep in equal ratios of time:

    ln Q = a - t / tau,    ln Q = a + b ln t,

t since the touch. Both lines are fitted to the charges of the press; which of them holds is said only where the other
leaves three times its residual. Creep with a thermoelastic step (`isocharge.serve.signal_chain.memory`) is said
where that leaves a third of what either leaves. [leak] undoes the first and would make an error that grows with time of
the others, which [memory] undoes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.memory import MOST_CREEP, MemoryRule

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
        thermoelastic: Share that the touch had more at first, dimensionless.
    """

    tau_s: float | None = None
    creep: float | None = None
    thermoelastic: float = 0.0

    @property
    def memory(self) -> dict[str, float] | None:
        """The section `[memory]` that undoes it; None if there is none."""
        if self.creep is None or not self.creep < MOST_CREEP:
            return None
        step = {"thermoelastic": float(f"{self.thermoelastic:.2g}")} if self.thermoelastic else {}
        return {"creep": float(f"{self.creep:.2g}")} | step

    @property
    def remedy(self) -> str:
        """What to do about creep: half a sentence."""
        if self.memory is None:
            return "wait longer before each reading"
        keys = ", ".join(f"{key} = {value:g}" for key, value in self.memory.items())
        return f"wait longer before each reading, or put [memory] {keys} into a device file"


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
    both = _of_both(held_s, size_pC, min(left_by_leak, left_by_creep) / CLEARER)
    if both is None and left_by_leak > CLEARER * left_by_creep:
        return Fading(creep=-float(np.expm1(of_creep * np.log(10.0))))
    return both or Fading()


def _of_both(held_s: Array, size_pC: Array, most: float) -> Fading | None:
    """Creep with a thermoelastic step, if that leaves at most so much of the squares of ln Q."""
    step = np.exp(-held_s / MemoryRule().warmth_s)
    columns = np.column_stack([np.ones_like(held_s), -np.log10(held_s), step])
    level, creep, cooled = np.linalg.lstsq(columns, size_pC, rcond=None)[0].tolist()
    fitted_pC = columns @ [level, creep, cooled]
    if not (level > 0.0 and 0.0 < creep < level and 0.0 < cooled < level and fitted_pC.min() > 0.0):
        return None
    left = float(np.square(np.log(size_pC / fitted_pC)).sum())
    return Fading(creep=creep / level, thermoelastic=cooled / level) if left < most else None


def cause_of_fading(sizes: Sequence[tuple[float, float]]) -> str:
    """What may fade such a press, and what to do: the end of a sentence; `sizes` as for `law_of_fading`."""
    law = law_of_fading(sizes)
    if law.tau_s is not None:
        return f"or the amplifier leaks: then put [leak] tau_s = {law.tau_s:.2g} into a device file"
    if law.creep is not None:
        return (
            f"or the film creeps, by {100.0 * law.creep:.2g} % in each decade of time: {law.remedy}; this is no leak, "
            "so set no [leak] for it"
        )
    return UNTOLD


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope of the straight line through points, and the sum of its squared residuals."""
    x, y = x - x.mean(), y - y.mean()
    slope = float(x @ y) / float(x @ x)
    return slope, float(np.square(y - slope * x).sum())
