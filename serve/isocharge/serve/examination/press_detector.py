"""Search for presses in the values of a board whose gain and rest levels are not known.

The values are replaced by their medians over blocks of 0.1 s, because hum averages out in a block. A single damaged
value does not change the median of a block. A press begins with a large change within half a second. Warming, creep and
the slow noise of amplifiers cause slower changes. One function, `find_press`, finds the touches of a film that should
be at rest, the press that is held during the port check, and the press near each electrode.

A press that is held with a constant force during the whole time does not change the values. It cannot be distinguished
from an amplifier with another rest level.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Array

BLOCK_S = 0.1
"""Time over which values are averaged, s. It contains whole periods of 50 and of 60 Hz."""

CHANGE_BLOCKS = 5
"""Number of blocks within which a touch changes the values, which is half a second."""


class Press(NamedTuple):
    """A press in a sequence of blocks.

    Attributes:
        begin: Number of the first block of the press.
        end: Number of the first block after the press; None if the press has not ended.
        change: Change of each channel in the block with the largest change, shape (channels,).
    """

    begin: int
    end: int | None
    change: Array


def find_press(levels: Array, noise: Array, sigmas: float = 20.0, release_share: float = 0.3) -> Press | None:
    """Find the first press in a sequence of blocks.

    A press begins when a channel changes within half a second by much more than its noise. A press ends when most of
    the change has disappeared within half a second, or all of the change slowly.

    Args:
        levels: Median of each channel in each block, shape (blocks, channels), in any unit.
        noise: Noise of each channel in one frame, shape (channels,).
        sigmas: Smallest change within half a second with which a press begins, in standard deviations of the noise.
        release_share: Share of the largest change below which the change must fall at the end of a press. The change
            must also fall by this share within half a second, because a leaking amplifier loses the charge of a held
            press slowly. The share is not smaller, because after the release such an amplifier returns to rest slowly.

    Returns:
        The press; None if no press begins.
    """
    min_change = sigmas * noise
    earlier_blocks = np.maximum(np.arange(len(levels)) - CHANGE_BLOCKS, 0)
    begins_press = (np.abs(levels - levels[earlier_blocks]) > min_change).any(axis=1)
    if not begins_press.any():
        return None
    begin = int(np.argmax(begins_press))
    changes = levels - levels[earlier_blocks[begin]]
    peak = begin + int(np.argmax(np.abs(changes[begin:]).sum(axis=1)))

    # Sum of the changes, in which a channel counts as negative if it has another sign than at the largest change
    total = changes @ np.sign(changes[peak])
    is_low = total < release_share * total[peak]
    is_falling = total[earlier_blocks] - total > release_share * total[peak]
    is_gone = (np.abs(changes) <= min_change).all(axis=1)
    is_released = (is_low & is_falling) | is_gone
    is_released[: peak + 1] = False
    end = int(np.argmax(is_released)) if is_released.any() else None
    return Press(begin, end, changes[peak])


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
    blocks = block_medians(values, times_s)  # shape (blocks, channels)
    if len(blocks) <= CHANGE_BLOCKS + 1:
        return None
    # Smooth the blocks with the median of three consecutive blocks. A channel without finite values is not touched.
    smoothed = np.nan_to_num(np.median([blocks[:-2], blocks[1:-1], blocks[2:]], axis=0), posinf=0.0, neginf=0.0)
    noise = channel_noise(values)
    if unit_is_pC:
        noise = np.maximum(noise, min_noise_pC)
    press = find_press(smoothed, noise)
    total_changes = np.ptp(smoothed, axis=0)
    is_slow_touch = unit_is_pC and bool((total_changes > max_slow_change_pC).any())
    if press is None and not is_slow_touch:
        return None
    column = int(np.argmax(total_changes))
    begin_block = 1 if press is None else press.begin + 1  # smoothing has removed the first block
    return TouchFound(column, float(total_changes[column]), BLOCK_S * begin_block)


def block_medians(values: Array, times_s: Array) -> Array:
    """Compute the median of each channel over each complete block of time of the length `BLOCK_S`.

    Args:
        values: Values of the channels, shape (n, channels).
        times_s: Times since the first frame, shape (n,), s, in ascending order.

    Returns:
        Medians of the finite values, shape (blocks, channels). Blocks without frames are left out, and so is the last
        block, which may be incomplete. NaN if a block of a channel has no finite value.
    """
    block_numbers = np.floor(times_s / BLOCK_S).astype(int)  # number of the block of each frame
    begins_block = np.diff(block_numbers, prepend=-1) != 0  # true for the first frame, whose block has the number 0
    first_rows = np.flatnonzero(begins_block)  # first frame of each block
    blocks = np.split(values, first_rows[1:])
    complete_blocks = blocks[:-1]  # the last block may be incomplete
    if not complete_blocks:
        channel_count = values.shape[1]
        return np.zeros((0, channel_count))
    masked_median: Any = np.ma.median  # has no types
    medians = [masked_median(np.ma.masked_invalid(block), axis=0) for block in complete_blocks]
    return np.array([np.ma.filled(median, np.nan) for median in medians])


def channel_noise(values: Array) -> Array:
    """Return the noise of each channel, at least the error of rounding if all values are whole numbers.

    Rounding errors are distributed uniformly between -0.5 and 0.5, so that their standard deviation is 12**-0.5.

    Args:
        values: Values of the channels, shape (n, channels), any unit.

    Returns:
        The standard deviations, shape (channels,), in the unit of the values.
    """
    are_whole_numbers = ((values == np.round(values)) | ~np.isfinite(values)).all(axis=0)
    rounding_noise = np.where(are_whole_numbers, 12.0**-0.5, 0.0)
    return np.maximum([estimate_noise(column) for column in values.T], rounding_noise)


def estimate_noise(values: Array) -> float:
    """Estimate the noise of a channel from the differences between consecutive values.

    Presses have little effect on these differences. If the noise is normally distributed, the median magnitude of a
    difference is 0.6745 * sqrt(2) standard deviations. For coarse counts, most differences may be 0. In this case, the
    mean magnitude of a difference is used, which is 2 / sqrt(pi) standard deviations.

    Args:
        values: Values of the channel, shape (n,), any unit. Values that are not finite are left out.

    Returns:
        The standard deviation in the unit of the values; 0 if there are fewer than two finite values.
    """
    finite_values = values[np.isfinite(values)].astype(float)
    differences = np.abs(np.diff(finite_values))
    if len(differences) == 0:
        return 0.0
    median_difference = float(np.median(differences))
    if median_difference > 0.0:
        return median_difference / (0.6745 * math.sqrt(2.0))
    return float(differences.mean()) * math.sqrt(math.pi) / 2.0
