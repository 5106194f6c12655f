"""Search for presses in the values of a board whose gain and rest levels are not known.

The values are replaced by their medians over blocks of 0.1 s, because hum averages out in a block. A single damaged
value does not change the median of a block. A press begins with a large change within half a second. Warming, creep and
the slow noise of amplifiers cause slower changes. The stage `isocharge.serve.signal_chain.touch.Touch` finds the
touches of a film that should be at rest, and the press that is held during the port check.

A press that is held with a constant force during the whole time does not change the values. A press without a beginning
and an end cannot be distinguished from an amplifier with another rest level.
"""

import math
import warnings
from collections.abc import Sequence

import numpy as np

from isocharge.common.arrays import Array, Booleans, Reals
from isocharge.common.errors import printable
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.stage import Device, Setup
from isocharge.serve.signal_chain.touch import Touch, TouchRule

BLOCK_S = 0.1
"""Length of a block, s. A block contains a whole number of mains periods at 50 and at 60 Hz."""

CHANGE_BLOCKS = 5
"""Number of blocks within which a touch changes the values. Together, these blocks last half a second."""


def touched_blocks(values: Array, times_s: Array, min_noise: float = 0.0) -> tuple[Reals, Array, Booleans]:
    """Return the time of each block, the median of each channel in it, and whether something touches the film in it.

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
    levels = np.nan_to_num(medians[:, 1:])
    # Whole numbers have a rounding error between -0.5 and 0.5, whose standard deviation is 12**-0.5.
    are_whole_numbers = ((values == np.round(values)) | ~np.isfinite(values)).all(axis=0)  # shape (channels,)
    rounding_noise = np.where(are_whole_numbers, 12.0**-0.5, 0.0)
    noise = np.maximum(estimate_noise(values), rounding_noise)
    is_touched = _detect_touches(levels, np.maximum(noise, min_noise))
    return block_times_s, levels, is_touched


BLOCK_RULE = TouchRule(sigmas=26.0, floor_pC=0.0)
"""Threshold of a touch, which is about 20 standard deviations of the noise of three channels."""


def _detect_touches(levels: Array, noise: Array) -> Booleans:
    """Return whether something touches the film in each block, shape (blocks,).

    The stage `Touch` of a stream detects the touches. The charges of this stage are the differences between the levels
    and the rest levels. Before a touch, the rest levels are the levels `CHANGE_BLOCKS` blocks earlier, so that a slow
    change does not count as a touch. During a touch, the rest levels remain the same.

    Args:
        levels: Levels of the channels, shape (blocks, channels), in any unit.
        noise: Noise of each channel, shape (channels,), in the unit of the levels.
    """
    channels = tuple(map(str, range(len(noise))))
    detector = Touch(Setup(channels, Device(rules={TouchRule: BLOCK_RULE}), has_any_sign=True))
    is_touched = np.zeros(len(levels), dtype=bool)
    for number, level in enumerate(levels):
        was_touched = number > 0 and is_touched[number - 1]
        if not was_touched:  # always true for the first block
            rest_level = levels[max(number - CHANGE_BLOCKS, 0)]
        frame = Frame(seq=None, t_us=None, values=(), dt_s=BLOCK_S, charge_pC=level - rest_level)
        frame.noise_pC = noise  # cannot be passed to the constructor
        detector.step(frame)
        is_touched[number] = frame.is_contact
    return is_touched


def touch_sentence(names: Sequence[str], values: Array, times_s: Array, unit: str, min_noise_pC: float = 1.0) -> str:
    """Return a sentence about a touch of a film that should be at rest; empty if the film is not touched.

    If the values are not in pC, the smallest change that counts as a touch is derived from the noise only. If the time
    is too short, no touch is found.

    Args:
        names: Names of the channels.
        values: Values of the channels, shape (n, channels).
        times_s: Times since the first frame, shape (n,), s.
        unit: Unit of the values.
        min_noise_pC: Smallest noise of a channel in pC. A touch exceeds about 20 standard deviations of the noise. With
            the default, the smallest touch is therefore 20 pC. A press of 0.01 N on a film of 25 um causes 40 pC.
    """
    min_noise = min_noise_pC if unit == "pC" else 0.0
    block_times_s, levels, is_touched = touched_blocks(values, times_s, min_noise)
    if not is_touched.any():
        return ""
    changes = np.ptp(levels, axis=0)
    name = printable(names[int(np.argmax(changes))])
    begin_s = block_times_s[np.argmax(is_touched)]  # time of the first touched block
    return (
        f"an untouched film: channel {name} changes by {changes.max():.4g} {unit} about {begin_s:.1f} s after the "
        "first frame, as under a touch; take the finger away, and try again"
    )


def block_medians(values: Array, times_s: Array) -> Array:
    """Compute the median of each channel over each complete block of time of the length `BLOCK_S`.

    Args:
        values: Values of the channels, shape (n, channels).
        times_s: Times since the first frame, shape (n,), s, in ascending order.

    Returns:
        Medians of the finite values, shape (blocks, channels). Blocks without frames are left out, and so is the last
        block, which may be incomplete. A median is NaN if the channel has no finite value in the block.
    """
    block_numbers = np.floor(times_s / BLOCK_S + 1e-6)  # a rounding error must not move a frame
    first_rows = np.flatnonzero(np.diff(block_numbers)) + 1  # first frame of each block except the first block
    finite_values = np.where(np.isfinite(values), values, np.nan)
    *complete_blocks, _last_block = np.split(finite_values, first_rows)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of a block without finite values
        medians = [np.nanmedian(block, axis=0) for block in complete_blocks]
    return np.reshape(medians, (-1, values.shape[1]))  # has one column for each channel even if there is no block


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
            mean_estimate = differences.mean() * math.sqrt(math.pi) / 2.0
            noise[column] = median_estimate if median_estimate > 0.0 else mean_estimate
    return noise
