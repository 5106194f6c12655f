"""Detection of touches in the values of a board whose gain and rest levels are not known.

The values are replaced by their medians over blocks of 0.1 s, because hum averages out in a block. A single damaged
value does not change the median of a block. The channels are quiet if they change little within half a second. Warming,
creep and the slow noise of amplifiers cause slower changes than a touch. One detector, `PressDetector`, finds the
touches of a film that should be at rest, the press that is held during the port check, and the press near each
electrode.

A press that is held with a constant force during the whole time does not change the values. It cannot be distinguished
from an amplifier with another rest level.
"""

import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Array

BLOCK_S = 0.1
"""Time over which values are averaged, s. It contains whole periods of 50 and of 60 Hz."""

QUIET_BLOCKS = 5
"""Number of blocks within which a touch changes the values, which is half a second."""

CHANGE_SIGMAS = 20.0
"""Smallest change within half a second that counts as a touch, in standard deviations of the noise of one frame."""

MIN_NOISE_PC = 1.0
"""Smallest noise of a channel in pC. The smallest touch is then 20 pC; 0.01 N on a film of 25 um cause 40 pC."""

MAX_SLOW_CHANGE_PC = 100.0
"""Largest change during the whole time without a touch, pC. It is the largest offset that a tare accepts."""

RELEASED_SHARE = 0.3
"""Share of the largest change below which a press may have ended, dimensionless.

The share is not small, because a leaking amplifier returns to rest slowly.
"""

RELEASE_SPEED = 0.1
"""Smallest fall of the charge within two blocks at the end of a press, relative to the largest change.

A leaking amplifier loses the charge of a held press more slowly.
"""


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


def find_touch(values: Array, times_s: Array, unit_is_pC: bool) -> TouchFound | None:
    """Search for a touch in the values of a film that should be at rest.

    The film is touched if a press begins, or if the channels are never quiet. If the values are in pC, a large slow
    change is a touch, too.

    Args:
        values: Values of the channels, shape (n, channels).
        times_s: Times since the first frame, shape (n,), s.
        unit_is_pC: Whether the values are charges in pC. Otherwise the smallest change of a touch is derived from the
            noise only.

    Returns:
        The channel with the largest total change, relative to its noise. None if the film is not touched, or if the
        time is too short.
    """
    blocks = block_medians(values, times_s)  # shape (blocks, channels)
    if len(blocks) <= QUIET_BLOCKS + 1:
        return None
    # Smooth the blocks with the median of three consecutive blocks. A channel without finite values is not touched.
    smoothed = np.nan_to_num(np.median([blocks[:-2], blocks[1:-1], blocks[2:]], axis=0), posinf=0.0, neginf=0.0)
    noise = np.array([channel_noise(column) for column in values.T])
    if unit_is_pC:
        noise = np.maximum(noise, MIN_NOISE_PC)
    detector = PressDetector()
    for level in smoothed:
        detector.feed(level, noise)
    total_changes = np.ptp(smoothed, axis=0)
    is_slow_touch = unit_is_pC and bool((total_changes > MAX_SLOW_CHANGE_PC).any())
    if detector.begin_block is None and detector.rest is not None and not is_slow_touch:
        return None
    column = int(np.argmax(total_changes))
    begin_block = (detector.begin_block or 0) + 1  # smoothing has removed the first block
    return TouchFound(column, float(total_changes[column]), BLOCK_S * begin_block)


class PressDetector:
    """Detector of the begin and the end of presses. It processes the median values of one block of time after another.

    The rest level is the mean of the latest quiet blocks before a press. After a press, the rest level before this
    press is used until the channels are quiet again, so that the next press may follow at once.

    Attributes:
        rest: Level of each channel at rest, shape (channels,); None while it is not known.
        begin_block: Number of the block with which the present or latest press began; None before the first press.
        change: Change of each channel in the block with the largest change of this press, shape (channels,).
        is_pressed: Whether a press has begun and has not ended.
    """

    def __init__(self) -> None:
        """Begin without any block."""
        self._count = 0  # number of blocks
        self.begin_block: int | None = None
        self.change = np.zeros(0)
        self.rest: Array | None = None
        self.is_pressed = False
        self._min_change = np.zeros(0)  # smallest change of each channel that begins a press
        self._recent: deque[Array] = deque(maxlen=QUIET_BLOCKS)  # levels of the latest blocks
        self._recent_totals: deque[float] = deque(maxlen=2)  # their total changes since the begin of the press
        self._largest_total = 0.0  # largest total change of the present press
        self._released_total = 0.0  # total change at the end of a press, until the channels are quiet again

    def feed(self, level: Array, noise: Array) -> bool:
        """Process the next block, and return whether a press has ended with it.

        A press begins when the change of a channel since the rest is much larger than the noise. It ends when most of
        the change has disappeared at once, or all of it slowly.

        Args:
            level: Median of each channel in the block, shape (channels,), in the unit of the board.
            noise: Noise of each channel in one frame, shape (channels,).
        """
        self._count += 1
        self._recent.append(level)
        change = np.zeros_like(level) if self.rest is None else level - self.rest
        if self.is_pressed:
            return self._continue_press(change)
        total = float(np.abs(change).sum())
        is_near_rest = self.rest is None or total <= max(self._released_total, float(self._min_change.sum()))
        is_quiet = bool((np.ptp(self._recent, axis=0) <= CHANGE_SIGMAS * noise).all())
        if len(self._recent) == QUIET_BLOCKS and is_quiet and is_near_rest:
            self.rest = np.mean(self._recent, axis=0)
            self._min_change = CHANGE_SIGMAS * noise
            self._released_total = 0.0
        elif self.rest is not None and bool((np.abs(change) > self._min_change).any()) and total > self._released_total:
            self.is_pressed = True
            self.begin_block = self._count - 1
            self._largest_total = 0.0
            self._recent_totals.clear()
            return self._continue_press(change)
        return False

    def _continue_press(self, change: Array) -> bool:
        """Process a block of a press, and return whether the press has ended with it.

        Args:
            change: Change of each channel since the rest, shape (channels,).
        """
        if float(np.abs(change).sum()) > self._largest_total:
            self.change = change
            self._largest_total = float(np.abs(change).sum())
        # Sum of the changes, in which a channel counts as negative if it has another sign than at the largest change
        total = float(np.sign(self.change) @ change)
        fall = max(self._recent_totals, default=total) - total
        self._recent_totals.append(total)
        is_gone = not bool((np.abs(change) > self._min_change).any())
        is_released = total < RELEASED_SHARE * self._largest_total and fall > RELEASE_SPEED * self._largest_total
        if not (is_gone or is_released):
            return False
        self.is_pressed = False
        self._released_total = max(RELEASED_SHARE * self._largest_total, abs(total))
        self._recent.clear()
        return True


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


def channel_noise(column: Array) -> float:
    """Return the noise of a channel, shape (n,), at least the error of rounding if all values are whole numbers.

    Rounding errors are distributed uniformly between -0.5 and 0.5, so that their standard deviation is 12**-0.5.
    """
    finite_values = column[np.isfinite(column)]
    are_whole_numbers = bool((finite_values == np.round(finite_values)).all())
    return max(estimate_noise(column), 12.0**-0.5 if are_whole_numbers else 0.0)


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
