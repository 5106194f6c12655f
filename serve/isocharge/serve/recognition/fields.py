"""Recognition of the fields of a frame: sync bytes, frame counter, clock and channels.

Every division of the bytes into fields has a score in bits. The score is the sum of two numbers: the bits that are
needed to encode the values of a frame after the previous frame, and the `Weights` of the fields. The division with the
lowest score is chosen. With these weights, simple divisions have lower scores than complicated ones. For example, a
division is simple if its channels are adjacent and have the same type.
`tests/benchmarks/fit_recognition.py` fits the weights on random boards.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.frames.frame_field import ByteOrder
from isocharge.serve.recognition.framing import Bytes, usual_bytes

COUNTING_SHARE = 0.9
"""Smallest share of regular steps of a counter or a clock. Frames may be lost, and counters may restart."""

STEADY_SPREAD = 0.7
"""Largest deviation of a regular step of a clock from the median step, relative to the median step."""

CLOCKS = {1.0: ("t_s", 1.0), 1e3: ("t_ms", 1.0), 1e6: ("t_us", 1.0)} | {
    rate_Hz: ("t_us", 1e6 / rate_Hz)
    for rate_Hz in (100.0, 1e4, 1e5, 1024.0, 32768.0, 31250.0, 500e3, 2e6, 4e6, 8e6, 16e6)
}
"""Name of the field, and value of one tick in the unit of that name, by the tick rate of a clock, Hz."""

CLOCK_RATE_TOLERANCE = 0.06
"""Largest relative deviation of a tick rate from a common tick rate. It is large, because frames arrive in bursts."""

PLAUSIBLE_MAGNITUDES = (1e-7, 1e8)
"""Smallest and largest typical magnitude of a floating-point channel."""

TYPES = ("u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32", "f32", "f64")
"""Types of numbers, as in device files."""


def steady_step(step: Array) -> float:
    """Return the mean of the regular steps of a counter or clock; 0 if too few steps are regular.

    A step is regular if it is close to the median step. Lost frames cause other steps.

    Args:
        step: Differences of the values of consecutive frames, shape (n,).
    """
    median_step = np.median(step)
    is_regular = np.abs(step - median_step) <= STEADY_SPREAD * median_step
    regular_steps = step[is_regular]
    if len(regular_steps) < COUNTING_SHARE * len(step):
        return 0.0
    return float(regular_steps.mean())


def clock_of(step: Array, rate_Hz: float) -> tuple[str, float] | None:
    """Return the name of a clock field, such as `t_us`, and the duration of one tick in the unit of the name, here us.

    Args:
        step: Differences of the values of consecutive frames, shape (n,).
        rate_Hz: Number of frames per second, Hz.

    Returns:
        The name and the duration of a tick; None if the values do not come from a clock.
    """
    tick_rate_Hz = steady_step(step) * rate_Hz
    for common_rate_Hz, clock in CLOCKS.items():
        if abs(tick_rate_Hz / common_rate_Hz - 1.0) < CLOCK_RATE_TOLERANCE:
            return clock
    return None


@dataclass(frozen=True)
class Weights:
    """Contributions of the parts of a frame to the score, bits.

    Attributes:
        row: Contribution of a row of adjacent channels of one type.
        channel: Contribution of a channel, in addition to the bits of its steps.
        constant: Contribution of a constant byte without a meaning, or of a constant channel.
        noise: Contribution of a varying byte without a meaning, and of a byte outside of all frames.
        fraction: Share of the bits of a floating-point number that belong to its significant digits, dimensionless.
    """

    row: float = 4.0
    channel: float = 1.65
    constant: float = 0.8
    noise: float = 8.0
    fraction: float = 0.65


class Part(NamedTuple):
    """A part of a frame.

    Attributes:
        role: Meaning of the part.
        kind: Type of the number, as in device files.
        size: Number of bytes.
        score: Contribution to the score without that of a new row, bits.
        is_constant: Whether the part is a channel with a constant value. Such a channel does not begin a row.
        name: Name of the field in a device file; empty for channels.
        scale: Value of one tick of a clock, in the unit of its name.
        row: Type that the channels of a row have in common; empty for other parts.
    """

    role: Literal["pad", "seq", "clock", "channel"]
    kind: str
    size: int
    score: float
    is_constant: bool = False
    name: str = ""
    scale: float = 1.0
    row: str = ""


@np.errstate(all="ignore")
def parts_of(rows: Bytes, order: ByteOrder, rate_Hz: float, weights: Weights) -> list[list[Part]]:
    """Return the possible parts that begin at each byte of a frame.

    For each byte, the first entry is a part of one byte without a meaning. The other entries are numbers of the types
    `TYPES` that may begin at this byte. A number may continue in the next frame, because the first byte of the frames
    is not known yet.

    Args:
        rows: Bytes of the frames, each followed by the next frame, shape (n, 2 * length). The frames may begin at any
            position.
        order: Byte order of the numbers.
        rate_Hz: Number of frames per second, Hz, from which the tick rate of a clock follows.
        weights: Contributions to the score.
    """
    usual, is_constant = usual_bytes(rows)
    is_zero = is_constant & (usual == 0)
    length = rows.shape[1] // 2  # a row has the bytes of two frames
    byte_step = 1 if order == "little" else -1  # reverses big-endian numbers, so that the lowest byte comes first
    parts_at: list[list[Part]] = []
    for position in range(length):
        pad_score = weights.constant if is_constant[position] else weights.noise
        parts = [Part("pad", "pad", 1, pad_score)]
        for kind in TYPES:  # such as "u16": the number is the size in bits
            size = int(kind[1:]) // 8  # in bytes
            span = slice(position, position + size)
            if span.stop <= 2 * length:
                number_bytes = rows[:, span][:, ::byte_step]
                number_is_constant = is_constant[span][::byte_step]
                number_is_zero = is_zero[span][::byte_step]
                parts += _number_parts(number_bytes, number_is_constant, number_is_zero, kind, rate_Hz, weights)
        parts_at.append(parts)
    return parts_at


def _number_parts(
    number_bytes: Bytes, is_constant: Booleans, is_zero: Booleans, kind: str, rate_Hz: float, weights: Weights
) -> Iterator[Part]:
    """Yield the possible meanings of bytes that are read as a number of one type.

    The meanings are frame counter or clock, and channel.

    Args:
        number_bytes: Bytes of the number, the lowest first, shape (n, size).
        is_constant: Whether each byte is constant, shape (size,).
        is_zero: Whether each byte is always 0, shape (size,).
        kind: Type of the number.
        rate_Hz: Number of frames per second, Hz.
        weights: Contributions to the score.
    """
    size = len(is_constant)
    if is_constant.all():
        yield Part("channel", kind, size, weights.constant, is_constant=True, row=kind)
        return
    is_float = kind[0] == "f"
    is_unsigned = kind[0] == "u"
    is_signed = kind[0] == "i"
    values = _values(number_bytes, kind)
    step = np.diff(values)
    counter_step = step
    magnitude = float(np.median(np.abs(values)))
    unit = 1.0  # smallest step that the number can represent
    if is_float:
        min_magnitude, max_magnitude = PLAUSIBLE_MAGNITUDES
        if not min_magnitude < magnitude < max_magnitude:
            return
        zero_byte_count = np.argmin(is_zero)  # low bytes that are always 0 carry no digits
        unit = magnitude * 256.0 ** (zero_byte_count - weights.fraction * size)
    if is_unsigned:
        half_range = 1 << (8 * size - 1)
        counter_step = (step + half_range) % (2 * half_range) - half_range  # a counter that overflows restarts at 0
        magnitude = float(np.median(np.abs(values - half_range)))

    can_be_counter = is_unsigned and size != 3
    can_be_clock = not is_signed and size not in (1, 3)
    if can_be_counter and steady_step(counter_step) == 1.0:
        yield Part("seq", kind, size, 0.0, name="seq")
    elif can_be_clock:
        clock = clock_of(counter_step, rate_Hz)
        if clock is not None:
            name, scale = clock
            clock_score = _bits(counter_step - np.median(counter_step), unit, size)
            yield Part("clock", kind, size, clock_score, name=name, scale=scale)
    channel_score = weights.channel + _bits(np.append(step, magnitude), unit, size)
    yield Part("channel", kind, size, channel_score, row=kind)


def split_frame(
    parts_at: Sequence[Sequence[Part]], syncs: Iterable[int], weights: Weights
) -> tuple[float, int, tuple[Part, ...]]:
    """Divide a frame into the parts with the lowest sum of scores.

    The division is found by dynamic programming, from the last byte to the first.

    Args:
        parts_at: Possible parts that begin at each byte before the checksum.
        syncs: Possible lengths of the sync, bytes. The shortest one with the lowest score is chosen.
        weights: Contributions to the score.

    Returns:
        The score in bits, the length of the sync in bytes, and the parts after the sync.
    """

    @cache
    def best_division(position: int, row: str) -> tuple[float, tuple[Part, ...]]:
        """Find the best division of the bytes from a position to the end, and return its score and its parts.

        The best division has the lowest score. The score is infinite if no division ends exactly at the last byte. A
        row of channels does not begin with a part that is constant.

        Args:
            position: Position of the first byte.
            row: Type of the channel before this byte; empty if the part before it is no channel. A channel of the same
                type continues a row of channels; any other channel begins a row, which adds to the score.
        """
        if position == len(parts_at):
            return 0.0, ()
        if position > len(parts_at):  # the part before this position is too long
            return np.inf, ()
        best_score = np.inf
        best_parts: tuple[Part, ...] = ()
        for part in parts_at[position]:
            is_channel = part.row != ""
            begins_row = is_channel and part.row != row
            if begins_row and part.is_constant:
                continue
            rest_score, rest_parts = best_division(position + part.size, part.row)
            score = part.score + rest_score
            if begins_row:
                score = part.score + weights.row + rest_score
            if score < best_score:
                best_score = score
                best_parts = (part, *rest_parts)
        return best_score, best_parts

    scored_syncs = []
    for sync_length in syncs:
        score, _ = best_division(sync_length, "")
        if sync_length == 1:  # a sync of a single byte is rare
            score += weights.constant
        scored_syncs.append((score, sync_length))
    lowest_score, best_sync_length = min(scored_syncs)
    _, best_parts = best_division(best_sync_length, "")
    return lowest_score, best_sync_length, best_parts


def _values(number_bytes: Bytes, kind: str) -> Array:
    """Return the values of a number in all frames, shape (n,).

    Args:
        number_bytes: Bytes of the number, the lowest first, shape (n, size).
        kind: Type of the number: "f" for floating-point, "u" for unsigned or "i" for signed, and the size in bits.
    """
    size = number_bytes.shape[1]
    if kind[0] == "f":
        return np.ascontiguousarray(number_bytes).view(f"<f{size}")[:, 0].astype(float)
    byte_weights = 256.0 ** np.arange(size)
    unsigned: Array = number_bytes @ byte_weights
    if kind[0] == "u":
        return unsigned
    value_count = 256.0**size
    is_negative = unsigned >= value_count / 2  # two's complement
    signed: Array = unsigned - value_count * is_negative
    return signed


def _bits(step: Array, unit: float, size: int) -> float:
    """Return the mean number of bits that encode a step of a number, at most the size of the number.

    Args:
        step: Differences of the values of consecutive frames, shape (n,).
        unit: Smallest step that the number can represent.
        size: Size of the number, bytes.
    """
    step_bits = np.log2(1.0 + np.abs(step) / unit)
    limited_bits = np.fmin(step_bits, 8 * size)  # also replaces NaN by the size
    return float(limited_bits.mean())
