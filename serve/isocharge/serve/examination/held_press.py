"""Search for a press that is held during the port check, and for the reason why its charge changes.

The levels of all channels form a vector, which changes in some direction at the beginning of the press. The charge of
the press is the component of the vector in this direction, minus the mean of this component before the press. The
charge shows whether an amplifier leaks or the film creeps. A leak removes the same share of the charge in every second.
The logarithm of the charge Q is then a linear function of the time t since the touch, ln Q = a - t / tau. Creep removes
the same share of the charge in every decade of time. The logarithm of the charge Q is then a linear function of ln t,
ln Q = a + b ln t. The functions of a leak and of creep are fitted to the charges of a press. The program states one of
these causes only if the function of the other cause has a much larger sum of squared residuals.

The section `[leak]` of a device file corrects a leak. Creep is not corrected. If the section `[leak]` is used for a
film that creeps, the error of the charges increases with time.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Reals
from isocharge.serve.examination.press_detector import CHANGE_BLOCKS, touched_blocks

MIN_HELD_S = 4.0
"""Shortest time for which the press must be held after its force has become constant, s."""

STEADY_SHARE = 0.02
"""Largest relative change of the charge of a steady press, dimensionless."""


class HeldPress(NamedTuple):
    """A press that was held during the port check. The default values mean that no press was held.

    Attributes:
        rest_end_s: Time at which the rest before the press ends, s since the first frame.
        tau_s: Time constant of the leak that explains the decrease of the charge, s; None if no leak explains the
            decrease.
        description: Sentence that describes whether and how the charge of the press changes.
    """

    rest_end_s: float = math.inf
    tau_s: float | None = None
    description: str = ""


def find_held_press(values: Array, times_s: Array) -> HeldPress:
    """Find a press that is held for at least `MIN_HELD_S`, and describe how its charge changes.

    Args:
        values: Values of the channels, shape (n, channels), in any unit.
        times_s: Times since the first frame, shape (n,), s.

    Returns:
        The press; an empty `HeldPress()`, whose description is empty, if no such press is found.
    """
    # Find the first touch. A block is an interval of 0.1 s, and its levels are the medians of the channels in it. An
    # element behind the last block makes the search end there if no block is touched, or if the film is touched until
    # the end.
    block_times_s, block_levels, is_touched = touched_blocks(values, times_s)
    begin = int(np.argmax([*is_touched, True]))  # first block of the touch
    end = begin + int(np.argmin([*is_touched[begin:], False]))  # first block after the touch

    # Choose the blocks in which the film is at rest before the press, and those in which the force is constant. The
    # force may have begun to rise in the block before the touch, rises for up to `CHANGE_BLOCKS`, and may have begun to
    # fall in the last block of the touch.
    rest = slice(max(begin - 1, 0))
    held = slice(begin + CHANGE_BLOCKS, max(end - 1, 0))
    rest_times_s = block_times_s[rest]
    held_times_s = block_times_s[held]
    has_levels = len(rest_times_s) >= 2 * CHANGE_BLOCKS and len(held_times_s) >= CHANGE_BLOCKS
    if not has_levels or block_times_s[end - 1] - held_times_s[0] < MIN_HELD_S:
        return HeldPress()

    # Reduce the levels of all channels to one charge, which is their component along the change that the press causes.
    # It has the value 1 at the beginning of the press. The blocks of rest ensure that block `begin - 1` exists.
    press_change = block_levels[held][0] - block_levels[rest][-1]
    projected_levels = block_levels @ press_change / (press_change @ press_change)  # shape (blocks,)
    charge = projected_levels[held] - projected_levels[rest].mean()
    drift_per_s, _ = _fit_line(rest_times_s, projected_levels[rest])
    begin_s = (block_times_s[begin - 1] + block_times_s[begin]) / 2.0
    tau_s, description = _describe_change(held_times_s - begin_s, charge, drift_per_s)
    rest_end_s = float(rest_times_s[-1] + block_times_s[begin - 1]) / 2.0
    return HeldPress(rest_end_s, tau_s, description)


def _describe_change(held_times_s: Reals, charge: Reals, drift_per_s: float) -> tuple[float | None, str]:
    """Describe how the charge of a press changes: whether it is constant, drifts, leaks or creeps.

    Args:
        held_times_s: Times since the beginning of the press, shape (n,), s.
        charge: Charge of the press at these times, shape (n,), relative to the charge at the beginning.
        drift_per_s: Slope of the level before the press, relative to the charge at the beginning, 1/s.

    Returns:
        Two values: the time constant of the leak, s, or None if the charge does not leak; and a sentence for the user.
    """
    if abs(drift_per_s) * MIN_HELD_S > STEADY_SHARE:  # the drift would be mistaken for a change of the charge
        percent_per_s = 100.0 * drift_per_s
        return None, (
            f"the rest level drifts by {percent_per_s:.2g} % of the press per second: do not touch the film until the "
            "drift has ended, and measure again"
        )
    first_third, _, last_third = np.array_split(charge, 3)
    change = float(last_third.mean() / first_third.mean()) - 1.0
    if abs(change) < STEADY_SHARE:
        return None, f"a held press keeps its charge for {held_times_s[-1]:.0f} s"
    tau_s, cause = _cause_of_change(held_times_s, np.maximum(charge, 1e-9))  # the logarithm needs positive charges
    return tau_s, f"a held press changes by {100.0 * change:.2g} %: {cause}"


def _cause_of_change(held_s: Reals, charge: Reals, min_residual_ratio: float = 9.0) -> tuple[float | None, str]:
    """Determine why the charge of a press with a constant force changes.

    Args:
        held_s: Times since the beginning of the press, shape (n,), s.
        charge: Positive charge of the press at these times, shape (n,), in any unit.
        min_residual_ratio: The better of two laws is reported only if the sum of squared residuals of the other law is
            larger by at least this factor. With a smaller factor, variations in the force of a hand could decide which
            law is reported.

    Returns:
        Two values: the time constant of the leak with two significant digits, s, or None if the cause is not a leak;
        and a part of a sentence that states the cause and advises the user.
    """
    # A leak makes the charge decay exponentially with time. Creep makes the charge decay as a power of time.
    leak_slope_per_s, leak_residual = _fit_line(held_s, np.log(charge))
    creep_slope, creep_residual = _fit_line(np.log(held_s), np.log(charge))  # the slope is the exponent of the power
    if leak_slope_per_s < 0.0 and creep_residual > min_residual_ratio * leak_residual:
        tau_s = float(f"{-1.0 / leak_slope_per_s:.2g}")
        return tau_s, f"the amplifier leaks: put [leak] tau_s = {tau_s:g} into a device file"
    if creep_slope < 0.0 and leak_residual > min_residual_ratio * creep_residual:
        lost_percent = 100.0 * (1.0 - 10.0**creep_slope)
        return None, (
            f"the film creeps by {lost_percent:.2g} % in each decade of time, which is not corrected: set no [leak] "
            "for it, and wait longer before each reading"
        )
    return None, (
        "the charges follow neither a leak of the amplifier nor creep of the film clearly: hold a press for several "
        "seconds, with a weight, and set no [leak] before"
    )


def _fit_line(x: Reals, y: Reals) -> tuple[float, float]:
    """Return the slope and the sum of the squared residuals of a least-squares line through points of shape (n,)."""
    (slope, _), (squared_residual,), *_ = np.polyfit(x, y, deg=1, full=True)
    return float(slope), float(squared_residual)
