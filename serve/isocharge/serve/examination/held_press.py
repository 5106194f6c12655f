"""Description of a press that is held during the port check: whether its charge is constant, leaks or creeps.

A press is recognised by a change of the channels that is large compared with their noise, because the gain of the board
may be unknown. The charge of the press is the projection of the channel levels onto the direction of this change, minus
the mean level before the press.

A leak removes the same share of the charge in every second. The logarithm of the charge Q is then a linear function of
the time t since the touch, ln Q = a - t / tau. Creep removes the same share of the charge in every decade of time. The
logarithm of the charge Q is then a linear function of ln t, ln Q = a + b ln t. Both functions are fitted to the charges
of a press. A cause is only stated if the other function has a much larger sum of squared residuals.

The section `[leak]` of a device file corrects a leak. Creep is not corrected. If the section `[leak]` is used for a
film that creeps, the error of the charges increases with time.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Reals
from isocharge.serve.examination.press_detector import BLOCK_S, CHANGE_BLOCKS, block_medians, channel_noise, find_press

MIN_HELD_S = 4.0
"""Shortest time for which the press must be held afterwards, s."""

STEADY_SHARE = 0.02
"""Largest relative change of the charge of a steady press, dimensionless."""


@dataclass(frozen=True)
class HeldPress:
    """A press that was held during the port check.

    Attributes:
        rest_end_s: Time at which the rest before the press ends, s since the first frame.
        tau_s: Time constant of the leak that explains the decrease of the charge, s; None if it is not a leak.
        description: Sentence that describes whether and how the charge of the press changes.
    """

    rest_end_s: float
    tau_s: float | None
    description: str


def find_held_press(values: Array, times_s: Array) -> HeldPress | None:
    """Find a press that is held for at least `MIN_HELD_S`, and describe how its charge changes.

    Args:
        values: Values of the channels, shape (n, channels), in any unit.
        times_s: Times since the first frame, shape (n,), s.

    Returns:
        The press; None if no such press is found.
    """
    levels = block_medians(values, times_s)  # shape (blocks, channels)
    if not np.isfinite(levels).all():
        return None
    press = find_press(levels, channel_noise(values))
    if press is None:
        return None

    begin_block = press.begin
    end_block = len(levels) if press.end is None else press.end - 1  # the force may have begun to fall before
    settled_block = begin_block + CHANGE_BLOCKS  # the force is constant from here on
    rest_blocks = begin_block - 1  # the force may have begun to rise in the block before
    has_rest = rest_blocks >= 2 * CHANGE_BLOCKS
    is_long = (end_block - settled_block) * BLOCK_S >= MIN_HELD_S
    if not (has_rest and is_long):
        return None

    # Project the levels onto the step. One unit is the charge at the beginning of the press.
    step = levels[settled_block] - levels[rest_blocks - 1]
    component = levels @ step / (step @ step)
    block_times_s = BLOCK_S * (np.arange(len(component)) + 0.5)  # middle of each block
    rest = component[:rest_blocks]
    drift_per_s = float(np.polyfit(block_times_s[:rest_blocks], rest, deg=1)[0])
    charge = component[settled_block:end_block] - rest.mean()
    begin_s = BLOCK_S * begin_block
    tau_s, description = _describe(block_times_s[settled_block:end_block] - begin_s, charge, drift_per_s)
    return HeldPress(BLOCK_S * rest_blocks, tau_s, description)


def _describe(held_times_s: Reals, charge: Reals, drift_per_s: float) -> tuple[float | None, str]:
    """Describe how the charge of a press changes: whether it is constant, drifts, leaks or creeps.

    Args:
        held_times_s: Times since the beginning of the press, shape (n,), s.
        charge: Charge of the press at these times, shape (n,), relative to the charge at the beginning.
        drift_per_s: Slope of the level before the press, relative to the charge at the beginning, 1/s.

    Returns:
        The time constant of the leak, s, or None if the charge does not leak, and a sentence.
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
        min_residual_ratio: Smallest ratio of the sums of the squared residuals of two laws for which the better law is
            reported. With a smaller ratio, variations in the force of a hand could decide which law is reported.

    Returns:
        The time constant of the leak with two significant digits, s, or None if the cause is not a leak, and the cause
        with advice to the user, as a part of a sentence.
    """
    leak_slope_per_s, leak_residual = _fit_line(held_s, np.log(charge))
    creep_slope, creep_residual = _fit_line(np.log(held_s), np.log(charge))
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
