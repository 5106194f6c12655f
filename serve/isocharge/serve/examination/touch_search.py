"""Search for touches in charges that should come from a film at rest.

The gain and the rest level of a board are not known yet. A touch is therefore recognised by changes of the charges
within half a second. Warming, creep and the slow noise of amplifiers cause slower changes.

The values are replaced by their medians over blocks of 0.1 s, because hum averages out in a block. A single damaged
value does not change the median of a block.

A press that is held with a constant force during the whole check does not change the charges. A press with a constant
force cannot be distinguished from an amplifier with another rest level.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from isocharge.common.arrays import Array
from isocharge.serve.examination.proposal import estimate_noise

BLOCK_S = 0.1
"""Time over which values are averaged, s. It contains whole periods of 50 and of 60 Hz."""

MIN_BLOCKS = 6
"""Smallest number of blocks in which a touch is searched for."""

STEEP_BLOCKS = 5
"""Number of blocks within which a touch changes the charges, which is half a second."""

CHANGE_SIGMAS = 20.0
"""Smallest change within half a second that counts as a touch, in standard deviations of the noise of one frame."""

MIN_CHANGE_PC = 20.0
"""Smallest change within half a second that counts as a touch, pC. A press of 0.01 N on a film of 25 um causes 40."""

MAX_SLOW_CHANGE_PC = 100.0
"""Largest change during the whole time without a touch, pC. It is the largest offset that a tare accepts."""


class TouchFound(NamedTuple):
    """A channel that was touched while the film should be at rest.

    Attributes:
        column: Column of the channel in the array of values.
        total_change: Largest minus smallest value of the channel, in the unit of the values.
        time_s: Time of the steepest change, s from the first frame.
    """

    column: int
    total_change: float
    time_s: float


def find_touch(values: Array, times_s: Array, unit_is_pC: bool) -> TouchFound | None:
    """Search for a touch in the values of a film that should be at rest.

    A channel is touched if its value changes within half a second by more than noise can explain. If the values are in
    pC, a large slow change is a touch, too. The values are first replaced by medians over short blocks of time, so that
    hum and single damaged values have little effect.

    Args:
        values: Values of the channels, shape (n, channels).
        times_s: Times since the first frame, shape (n,), s.
        unit_is_pC: Whether the values are charges in pC. Otherwise the smallest change of a touch is derived from the
            noise only.

    Returns:
        The touched channel with the largest total change. None if no channel is touched, or if the time is too short.
    """
    blocks = block_medians(values, times_s)  # shape (blocks, channels)
    if len(blocks) < MIN_BLOCKS:
        return None
    # Smooth the blocks with the median of three consecutive blocks. The result has the shape (blocks - 2, channels).
    smoothed = np.median([blocks[:-2], blocks[1:-1], blocks[2:]], axis=0)
    touches: list[TouchFound] = []
    for column, channel_levels in enumerate(smoothed.T):
        if not np.isfinite(channel_levels).all():
            continue
        min_change = _smallest_touch(values[:, column], unit_is_pC)
        total_change, steepest_change, steepest_time_s = _changes_of_channel(channel_levels)
        is_fast_touch = steepest_change > min_change  # faster than warming or the drift of an amplifier
        is_slow_touch = unit_is_pC and total_change > max(min_change, MAX_SLOW_CHANGE_PC)
        if is_fast_touch or is_slow_touch:
            touches.append(TouchFound(column, total_change, steepest_time_s))
    return max(touches, key=lambda touch: touch.total_change, default=None)


def _changes_of_channel(smoothed_levels: Array) -> tuple[float, float, float]:
    """Compute the total change of a channel, its largest change within half a second, and the time of this change.

    Args:
        smoothed_levels: Level of the channel in each block of time, shape (blocks - 2,). Smoothing over three blocks
            has removed the first and the last block.

    Returns:
        The two changes in the unit of the levels, and the time of the middle of the half second, s from the first
        frame.
    """
    windows = sliding_window_view(smoothed_levels, min(STEEP_BLOCKS, len(smoothed_levels)))
    window_changes = np.ptp(windows, axis=1)  # largest minus smallest level of each window, shape (windows,)
    steepest_window = int(np.argmax(window_changes))
    first_block = steepest_window + 1  # the first smoothed level belongs to the second block
    middle_block = first_block + STEEP_BLOCKS // 2
    return float(np.ptp(smoothed_levels)), float(window_changes.max()), BLOCK_S * middle_block


def _smallest_touch(channel_values: Array, unit_is_pC: bool) -> float:
    """Return the smallest change of a channel within half a second that counts as a touch, in the unit of the values.

    Args:
        channel_values: Values of the channel, shape (n,).
        unit_is_pC: Whether the values are charges in pC.
    """
    noise_limit = CHANGE_SIGMAS * estimate_noise(channel_values)
    if unit_is_pC:
        return max(noise_limit, MIN_CHANGE_PC)
    # The values of a coarse converter may all be equal at rest. They then have no noise, but errors of rounding.
    return max(noise_limit, CHANGE_SIGMAS * rounding_error_std(channel_values))


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
    return np.array([_finite_medians(block) for block in complete_blocks])


def _finite_medians(block: Array) -> Array:
    """Compute the median of the finite values of each column.

    Args:
        block: Values, shape (n, channels), some of which may be NaN or infinite.

    Returns:
        Medians, shape (channels,); NaN for a column without a finite value.
    """
    medians = np.full(block.shape[1], np.nan)
    for channel_index, column in enumerate(block.T):
        finite_values = column[np.isfinite(column)]
        if finite_values.size:
            medians[channel_index] = np.median(finite_values)
    return medians


def rounding_error_std(column: Array) -> float:
    """Return the standard deviation of the rounding errors of a channel.

    It is 12**-0.5 if all finite values are whole numbers, because rounding errors are distributed uniformly between
    -0.5 and 0.5. It is 0 for other values, whose rounding is not known.

    Args:
        column: Values of the channel, shape (n,).
    """
    finite_values = column[np.isfinite(column)]
    are_whole_numbers = bool((finite_values == np.round(finite_values)).all())
    return 12.0**-0.5 if are_whole_numbers else 0.0
