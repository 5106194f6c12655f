"""Search for presses in the values of a board whose gain and rest levels are not known.

The values are replaced by their medians over blocks of 0.1 s, because hum averages out in a block. A single damaged
value does not change the median of a block. A press begins with a large change within half a second. Warming, creep and
the slow noise of amplifiers cause slower changes. The stage `isocharge.serve.signal_chain.touch.Touch` finds the
touches of a film that should be at rest, and the press that is held during the port check.

A press that is held with a constant force during the whole time does not change the values. A press without a beginning
and an end cannot be distinguished from an amplifier with another rest level.

The charge of a press that is held shows whether an amplifier leaks or the film creeps. At the beginning of the press,
the channel levels change in some direction. The charge of the press is the component of the levels in this direction,
minus its mean before the press. A leak removes the same share of the charge in every second. The logarithm of the
charge Q is then a linear function of the time t since the touch, ln Q = a - t / tau. Creep removes the same share of
the charge in every decade of time. The logarithm of the charge Q is then a linear function of ln t, ln Q = a + b ln t.
The functions of a leak and of creep are fitted to the charges of a press. A cause is only stated if the other function
has a much larger sum of squared residuals.

The section `[leak]` of a device file corrects a leak. Creep is not corrected. If the section `[leak]` is used for a
film that creeps, the error of the charges increases with time.
"""

import math
import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans, Reals
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.stage import Device, Setup
from isocharge.serve.signal_chain.touch import Touch, TouchRule

BLOCK_S = 0.1
"""Length of a block, s. A block contains a whole number of mains periods at 50 and at 60 Hz."""

CHANGE_BLOCKS = 5
"""Number of blocks, which last half a second in total, within which a touch changes the values."""


def touched_blocks(values: Array, times_s: Array, min_noise: float = 0.0) -> tuple[Reals, Array, Booleans]:
    """Return the time of each block, the median of each channel in it, and whether something touches the film in it.

    The stage `Touch` of a stream detects the touches. The charges of this stage are the differences from the levels
    `CHANGE_BLOCKS` earlier, so that a slow change is no touch. During a touch, the earlier levels are those before its
    beginning.

    Args:
        values: Values of the channels, shape (n, channels), in any unit.
        times_s: Times since the first frame, shape (n,), s.
        min_noise: Smallest noise of a channel, in the unit of the values.

    Returns:
        The median times of the frames of the blocks, shape (blocks,), s; the medians of the values, shape (blocks,
        channels); and whether each block is touched, shape (blocks,). The median of a channel without finite values is
        0, so that the channel is not touched.
    """
    medians = block_medians(np.column_stack([times_s, values]), times_s)
    block_times_s = medians[:, 0]
    steps_s = np.diff(block_times_s, prepend=0.0)  # longer than `BLOCK_S` if frames are rare or were lost
    levels = np.nan_to_num(medians[:, 1:])
    # Whole numbers have a rounding error between -0.5 and 0.5, whose standard deviation is 12**-0.5.
    are_whole_numbers = ((values == np.round(values)) | ~np.isfinite(values)).all(axis=0)
    smallest_noise = np.where(are_whole_numbers, max(12.0**-0.5, min_noise), min_noise)
    noise = np.maximum(estimate_noise(values), smallest_noise)
    channels = tuple(map(str, range(len(noise))))
    detector = Touch(Setup(channels, Device(rules={TouchRule: BLOCK_RULE}), has_any_sign=True))
    is_contact = np.zeros(len(levels), dtype=bool)
    for number, level in enumerate(levels):
        if not is_contact[number - 1]:  # true for the first block, because the last element is still False
            rest = levels[max(number - CHANGE_BLOCKS, 0)]
        frame = Frame(seq=None, t_us=None, values=(), dt_s=float(steps_s[number]), charge_pC=level - rest)
        frame.noise_pC = noise
        detector.step(frame)
        is_contact[number] = frame.is_contact
    return block_times_s, levels, is_contact


BLOCK_RULE = TouchRule(sigmas=26.0, floor_pC=0.0)
"""Threshold of a touch, which is about 20 standard deviations of the noise of three channels."""


class TouchFound(NamedTuple):
    """A channel that was touched while the film should be at rest.

    Attributes:
        column: Column of the channel in the array of values.
        total_change: Largest minus smallest value of the channel, in the unit of the values.
        time_s: Time of the beginning of the touch, s from the first frame.
    """

    column: int
    total_change: float
    time_s: float


def find_touch(
    values: Array, times_s: Array, unit_is_pC: bool, min_noise_pC: float = 1.0, max_slow_change_pC: float = 100.0
) -> TouchFound | None:
    """Search for a touch in the values of a film that should be at rest.

    If the values are in pC, a large slow change is a touch, too.

    Args:
        values: Values of the channels, shape (n, channels).
        times_s: Times since the first frame, shape (n,), s.
        unit_is_pC: Whether the values are charges in pC. Otherwise the smallest change of a touch is derived from the
            noise only.
        min_noise_pC: Smallest noise of a channel in pC. With the default, the smallest touch is 20 pC. A press of 0.01
            N on a film of 25 um causes 40 pC.
        max_slow_change_pC: Largest change during the whole time without a touch, pC. The default is the largest offset
            that a tare accepts.

    Returns:
        The channel with the largest total change. None if the film is not touched, or if the time is too short.
    """
    block_times_s, levels, is_touched = touched_blocks(values, times_s, min_noise_pC if unit_is_pC else 0.0)
    if len(levels) == 0:
        return None
    total_changes = np.ptp(levels, axis=0)
    is_slow_touch = unit_is_pC and (total_changes > max_slow_change_pC).any()
    if not (is_touched.any() or is_slow_touch):
        return None
    column = int(np.argmax(total_changes))
    begin_block = np.argmax(is_touched)
    return TouchFound(column, float(total_changes[column]), float(block_times_s[begin_block]))


def block_medians(values: Array, times_s: Array) -> Array:
    """Compute the median of each channel over each complete block of time of the length `BLOCK_S`.

    Args:
        values: Values of the channels, shape (n, channels).
        times_s: Times since the first frame, shape (n,), s, in ascending order.

    Returns:
        Medians of the finite values, shape (blocks, channels). Blocks without frames are left out, and so is the last
        block, which may be incomplete. NaN if a block of a channel has no finite value.
    """
    block_numbers = np.floor(times_s / BLOCK_S + 1e-6).astype(int)  # a rounding error must not move a frame
    first_rows = np.flatnonzero(np.diff(block_numbers, prepend=-1))  # first frame of each block; the first has number 0

    # Divide the values at the first rows of all blocks except the first block, and leave out the last block.
    finite_values = np.where(np.isfinite(values), values, np.nan)
    complete_blocks = np.split(finite_values, first_rows[1:])[:-1]
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of a block without finite values
        medians = [np.nanmedian(block, axis=0) for block in complete_blocks]
    return np.reshape(medians, (-1, values.shape[1]))  # also without a block


def estimate_noise(values: Array) -> Array:
    """Estimate the noise of each channel from the differences between consecutive values.

    Presses have little effect on these differences. If the noise is normally distributed, the median magnitude of a
    difference is 0.6745 * sqrt(2) standard deviations. For coarse counts, most differences may be 0. If most
    differences are 0, the mean magnitude of a difference is used, which is 2 / sqrt(pi) standard deviations.

    Args:
        values: Values of the channels, shape (n, channels), any unit. Values that are not finite are left out.

    Returns:
        The standard deviations, shape (channels,), in the unit of the values; 0 for a channel with fewer than two
        finite values.
    """
    noise = np.zeros(values.shape[1])
    for column, channel_values in enumerate(values.T):
        differences = np.abs(np.diff(channel_values[np.isfinite(channel_values)]))
        if len(differences) > 0:
            median_estimate = np.median(differences) / (0.6745 * math.sqrt(2.0))
            noise[column] = median_estimate or differences.mean() * math.sqrt(math.pi) / 2.0
    return noise


MIN_HELD_S = 4.0
"""Shortest time for which the press must be held afterwards, s."""

STEADY_SHARE = 0.02
"""Largest relative change of the charge of a steady press, dimensionless."""


@dataclass(frozen=True)
class HeldPress:
    """A press that was held during the port check. The default values mean that no press was held.

    Attributes:
        rest_end_s: Time at which the rest before the press ends, s since the first frame.
        tau_s: Time constant of the leak that explains the decrease of the charge, s; None if it is not a leak.
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
        The press; the default values if no such press is found.
    """
    block_times_s, levels, is_touched = touched_blocks(values, times_s)
    if not is_touched.any():
        return HeldPress()

    # Choose the blocks in which the film is at rest before the press, and those in which the press is held.
    begin_block = int(np.argmax(is_touched))
    held_blocks = int(np.argmin([*is_touched[begin_block:], False]))
    end_block = begin_block + held_blocks - 1  # the force may have begun to fall in the block before
    settled_block = begin_block + CHANGE_BLOCKS  # the force is constant from here on
    rest_blocks = begin_block - 1  # the force may have begun to rise in the block before
    has_rest = rest_blocks >= 2 * CHANGE_BLOCKS
    has_levels = end_block - settled_block >= CHANGE_BLOCKS
    if not (has_rest and has_levels and block_times_s[end_block] - block_times_s[settled_block] >= MIN_HELD_S):
        return HeldPress()

    # Project the levels onto the step. One unit is the charge at the beginning of the press.
    step = levels[settled_block] - levels[rest_blocks - 1]
    projected_levels = levels @ step / (step @ step)  # shape (blocks,)
    rest = projected_levels[:rest_blocks]
    drift_per_s = float(np.polyfit(block_times_s[:rest_blocks], rest, deg=1)[0])
    charge = projected_levels[settled_block:end_block] - rest.mean()
    block_ends_s = (block_times_s[:-1] + block_times_s[1:]) / 2.0
    begin_s = block_ends_s[begin_block - 1]
    tau_s, description = _describe(block_times_s[settled_block:end_block] - begin_s, charge, drift_per_s)
    return HeldPress(float(block_ends_s[rest_blocks - 1]), tau_s, description)


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
