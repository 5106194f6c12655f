"""Recognition of the fields of a frame: sync bytes, frame counter, clock and channels.

Every division of the bytes of a frame into fields has a score in bits. The score is the sum of two numbers. The first
number states how many bits are needed to encode the values of a frame if the previous frame is known. The second number
is the sum of the `Weights` of the fields. The program chooses the division with the lowest score. Because of the
weights, a simple division has a lower score than a complicated division. A division is simple, for example, if all
channels are adjacent and have the same type. The weights were fitted to random boards.
"""

from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isocharge.common.arrays import Array
from isocharge.serve.frames.frame import SEQ
from isocharge.serve.frames.frame_layout import PADDING, STRUCT_FORMATS, ByteOrder, FieldType
from isocharge.serve.recognition.framing import INTACT_SHARE, Bytes, usual_bytes

CLOCKS = {1.0: ("t_s", 1.0), 1e3: ("t_ms", 1.0)} | {
    tick_rate_Hz: ("t_us", 1e6 / tick_rate_Hz)
    for tick_rate_Hz in (1e6, 100.0, 1e4, 1e5, 32768.0, 31250.0, 500e3, 2e6, 4e6, 8e6, 16e6, 1e9)
}
"""For each tick rate of a clock, Hz: name of the clock field, and duration of one tick in the unit of the name."""

LARGEST_SIZE = 8
"""Size of the largest numbers, bytes."""

CHANNEL = "channel"
"""Name of all channels during the recognition."""


def possible_meanings(steps: Array, frame_rate_Hz: float, tolerance: float = 0.04) -> Iterator[tuple[str, float]]:
    """Yield the possible meanings of a number from its values in consecutive frames: first the counter, then a clock.

    A counter increases by 1. A clock has one of the usual tick rates of boards. At about 1000 frames per second, a
    clock in ms also increases by 1, but it repeats some of its values. Nothing is yielded if the values are constant,
    or if too many steps differ much from the median step.

    Args:
        steps: Differences of the values of consecutive frames, shape (n,).
        frame_rate_Hz: Number of frames per second, Hz.
        tolerance: Largest relative deviation of a tick rate from a usual tick rate. The default is large, because
            frames arrive in bursts.

    Yields:
        The name of the field, which is `seq`, `t_s`, `t_ms` or `t_us`, and the value of one tick in the unit of this
        name.
    """
    # A step is regular if it differs from the median step by at most 70 %, or by at most 1, because a slow clock may
    # repeat some of its values. Steps over lost or damaged frames are not regular, so only three quarters of the steps
    # (`INTACT_SHARE`) need to be regular.
    median_step = np.median(steps)
    regular_steps = steps[np.abs(steps - median_step) <= max(1.0, 0.7 * median_step)]
    is_regular = len(regular_steps) >= INTACT_SHARE * len(steps) and regular_steps.min() >= 0.0
    is_constant = np.mean(steps == 0.0) >= INTACT_SHARE
    if not is_regular or is_constant:
        return

    # If only the high bytes of a number are a counter, and its low bytes belong to the channel beside the counter, the
    # number increases by a power of 256 from frame to frame. The rates of such shifted counters are compared together
    # with those of the clocks. If a shifted counter has the nearest rate, the number is not a clock.
    tick_rate_Hz = float(regular_steps.mean()) * frame_rate_Hz
    shifted_counter_rates_Hz = [frame_rate_Hz * 256.0**byte_count for byte_count in (1, 2, 3)]
    known_rates_Hz = (*CLOCKS, *shifted_counter_rates_Hz)
    deviation, nearest_rate_Hz = min((abs(tick_rate_Hz / known_Hz - 1.0), known_Hz) for known_Hz in known_rates_Hz)
    is_clock = nearest_rate_Hz in CLOCKS and deviation < tolerance

    increases_by_one = np.mean(steps == 1.0) >= INTACT_SHARE
    repeats_values = not steps.all()
    if increases_by_one and not (is_clock and repeats_values):
        yield SEQ, 1.0
    if is_clock:
        yield CLOCKS[nearest_rate_Hz]  # name of the field, and value of one tick


def count_wraps(steps: Array) -> int:
    """Return how often a number wraps. Each wrap causes a large step back.

    A damaged value also causes a large step back, but it causes a large step forwards, too. Such a pair of steps is not
    counted.

    Args:
        steps: Differences of the values of consecutive frames, shape (n,).
    """
    large_step = 20.0 * (np.median(steps) or 1.0)
    return int((steps < -large_step).sum() - (steps > large_step).sum())


class Weights:
    """Contributions to the score of a division of a frame into parts, in bits.

    The parts are the fields, the padding and the checksum. The division with the lowest score is chosen. The weights
    were fitted to random boards.

    Attributes:
        channel_group: Contribution of a group of adjacent channels of one type.
        channel: Contribution of a channel, in addition to the bits of its steps.
        constant: Contribution of a constant byte without a meaning, or of a constant channel.
        constant_high: Contribution of each constant byte in a counter or clock of three bytes, unless the byte is 0.
            This weight is larger than `constant`, because counters of two bytes are more usual, and a counter that is
            read with too many bytes causes false restarts.
        noise: Contribution of a varying byte without a meaning, and of a byte outside of all frames.
        fraction: Share of the bits of a floating-point number that belong to its significant digits, dimensionless.
    """

    channel_group = 4.0
    channel = 1.65
    constant = 0.8
    constant_high = 1.3
    noise = 8.0
    fraction = 0.65


class Part(NamedTuple):
    """A part of a frame.

    Adjacent channels of one type form a group of channels.

    Attributes:
        name: Name of the field in a device file; `CHANNEL` for every channel, and empty for padding.
        type_name: Type of the number, as in device files.
        size: Number of bytes.
        score: Contribution of the part to the score of a division, bits. If the part begins a group of channels, the
            contribution of the group is not included.
        is_constant: Whether the part is a channel with a constant value. Such a channel does not begin a group.
        scale: Value of one tick of a clock, in the unit of its name.
    """

    name: str
    type_name: FieldType
    size: int
    score: float
    is_constant: bool = False
    scale: float = 1.0


@np.errstate(all="ignore")
def possible_parts(rows: Bytes, order: ByteOrder, frame_rate_Hz: float) -> list[list[Part]]:
    """List the possible parts of a frame that begin at each byte.

    A part is a single byte without a meaning (padding), or a number of one of the types in `STRUCT_FORMATS`.

    Args:
        rows: Bytes of each frame, followed by the next `LARGEST_SIZE` bytes of the stream, shape (n, length +
            `LARGEST_SIZE`). A number that begins near the end of a frame may end in the next bytes.
        order: Byte order of the numbers.
        frame_rate_Hz: Number of frames per second, Hz, from which the tick rate of a clock follows.

    Returns:
        For each of the `length` bytes, a list of parts, of which the first is padding.
    """
    usual, is_constant = usual_bytes(rows)
    constant_bytes = np.where(is_constant, usual.astype(int), -1)  # -1 for a byte that varies
    byte_step = 1 if order == "little" else -1
    parts_at_each_byte: list[list[Part]] = []
    for position in range(rows.shape[1] - LARGEST_SIZE):
        # One byte of padding, which has no name. `Weights` contains constant scores, in bits.
        parts = [Part("", PADDING, size=1, score=Weights.constant if is_constant[position] else Weights.noise)]
        for type_name in STRUCT_FORMATS:  # such as "u16", whose size is 16 bits
            end = position + int(type_name[1:]) // 8
            if all(is_constant[position:end]):  # a channel that never changes
                parts.append(Part(CHANNEL, type_name, end - position, Weights.constant, is_constant=True))
                continue
            lowest_first = range(position, end)[::byte_step]  # positions of the bytes, that of the lowest byte first
            number_bytes = np.ascontiguousarray(rows[:, lowest_first])
            parts += _number_parts(number_bytes, constant_bytes[lowest_first], type_name, frame_rate_Hz)
        parts_at_each_byte.append(parts)
    return parts_at_each_byte


def _number_parts(
    number_bytes: Bytes, constant_bytes: NDArray[np.int64], type_name: FieldType, frame_rate_Hz: float
) -> Iterator[Part]:
    """Yield the possible meanings of some bytes of each frame if these bytes are a number of a given type.

    Every number may be a channel, and some numbers may also be the frame counter or a clock. Nothing is yielded for
    floating-point numbers that are implausibly small or large.

    Each part has a score in bits, which is lower for a more probable part. The score of a channel grows with the mean
    number of bits that are needed to encode its steps from frame to frame. This number is small for a true channel,
    because its value changes little.

    Args:
        number_bytes: Bytes of the number, the lowest first, shape (n, size).
        constant_bytes: Value of each byte that is constant, and -1 for the other bytes, shape (size,).
        type_name: Type of the number, such as "u16", "i16" or "f32".
        frame_rate_Hz: Number of frames per second, Hz.
    """
    size = len(constant_bytes)
    values = _decoded_values(number_bytes, type_name)
    steps = np.diff(values)
    magnitude = np.median(np.abs(values))
    unit = 1.0  # smallest step that the number can represent
    if type_name[0] == "f":
        if not 1e-7 < magnitude < 1e10:  # a Unix time is the largest of the usual numbers
            return
        # The significant digits of a floating-point number of `size` bytes are in about `Weights.fraction` * `size` of
        # its bytes. Low bytes that are always 0 contain no digits. The smallest step of a number with n bytes of digits
        # is its magnitude divided by 256**n.
        low_zero_byte_count = np.argmax(constant_bytes != 0)  # index of the first byte that is not always 0
        unit = magnitude * 256.0 ** (low_zero_byte_count - Weights.fraction * size)

    counter_or_clock = _counter_or_clock(steps, constant_bytes, type_name, unit, frame_rate_Hz)
    if counter_or_clock is not None:
        yield counter_or_clock
    if type_name == "i64":  # times only
        return
    # The magnitude is counted as one more step, the step from 0 to the first value. A type therefore has a lower score
    # if its values are close to 0. `_decoded_values` has subtracted half of the range from the values of an unsigned
    # type, so that 0 is the middle of its range.
    yield Part(CHANNEL, type_name, size, Weights.channel + _bits(np.append(steps, magnitude), unit, size))


def _counter_or_clock(
    steps: Array, constant_bytes: NDArray[np.int64], type_name: FieldType, unit: float, frame_rate_Hz: float
) -> Part | None:
    """Return the part for a number that may be the frame counter or a clock; None if the number can be neither of them.

    The score of the part, in bits, is lower for a more probable part. The score is the mean number of bits that are
    needed to encode a value if the previous value is known. Because a counter increases by 1 in every frame, its value
    follows from the previous value, so that the score of a counter is 0. The score of a clock grows with the deviations
    of its steps from the median step. Two corrections make a number of three bytes less probable, and a clock of eight
    bytes more probable.

    Args:
        steps: Differences of the values of consecutive frames, shape (n,).
        constant_bytes: Value of each byte that is constant, and -1 for the other bytes, shape (size,).
        type_name: Type of the number, such as "u16", "i16" or "f32".
        unit: Smallest step that the number can represent.
        frame_rate_Hz: Number of frames per second, Hz.
    """
    size = len(constant_bytes)
    if type_name[0] == "u":
        # An unsigned number wraps: after its largest value, it continues at 0. The modulo replaces the large step back
        # from the largest value to 0 by the small step forwards that it stands for.
        half_range = 1 << (8 * size - 1)
        steps = (steps + half_range) % (2 * half_range) - half_range
    # If several meanings are possible, the first one is the counter. The name is "" if the number has neither meaning.
    name, tick = next(possible_meanings(steps, frame_rate_Hz), ("", 1.0))
    has_usual_size = size < 8 or tick in (1.0, 1e-3)  # only clocks in s, ms, us or ns have 8 bytes
    # The modulo has removed the wraps at the end of the range. If the number still wraps, its high bytes belong to
    # another field. For example, a counter of one byte wraps at 256, also if it is read with the next byte as a `u16`.
    has_foreign_bytes = count_wraps(steps) > 0
    if not name or not has_usual_size or has_foreign_bytes:
        return None

    score = 0.0
    if size == 3:  # rare: a constant byte that is not 0 is more probably another field behind a number of 2 bytes
        score += Weights.constant_high * np.count_nonzero(constant_bytes > 0)
    if name != SEQ:
        score += _bits(steps - np.median(steps), unit, size)
        if size == 8:
            # Without this reduction, an `f64` with few digits could have a lower score. It would consist of the high
            # bytes of the clock and of the first bytes behind them.
            score -= Weights.noise
    return Part(name, type_name, size, score, scale=tick)


def split_frame(
    parts_at_each_byte: Sequence[Sequence[Part]], sync_lengths: Iterable[int], checksum_start: int
) -> tuple[float, tuple[Part, ...], int]:
    """Divide a frame into parts so that the score of the division is as low as possible.

    The frame begins with the sync pattern, a constant pattern of bytes that marks the beginning of the frame. The best
    division of the other bytes is found by dynamic programming. For every position, the best division of the bytes
    after this position is computed once and stored.

    Args:
        parts_at_each_byte: Parts that may begin at each byte of the frame before the checksum. At each byte, at least
            one part of one byte begins, which is padding. A part that does not end before the checksum is not used.
        sync_lengths: Possible lengths of the sync pattern, bytes; 0 if the frame has no sync pattern. If several
            lengths have the lowest score, the first of them is chosen.
        checksum_start: First byte that the checksum covers. The checksum covers either all bytes of a number or none of
            them.

    Returns:
        The score in bits, the parts after the sync pattern, and the length of the sync pattern in bytes.
    """

    @cache
    def best_division(position: int, previous_channel_type: str) -> tuple[float, tuple[Part, ...]]:
        """Find the division with the lowest score for the bytes from a given position to the end.

        The function tries each part that may begin at the position, and calls itself for the bytes after the part.
        The results are cached. `parts_at_each_byte` lists the parts that may begin at each byte, and `checksum_start`
        is the first byte that the checksum covers.

        Adjacent channels of one type form a group. A channel that begins a group adds `Weights.channel_group` to the
        score. A channel with a constant value cannot begin a group.

        Args:
            position: Position of the first byte.
            previous_channel_type: Type of the channel that ends just before this byte; empty if no channel ends there.

        Returns:
            The score and the parts of the division.
        """
        if position == len(parts_at_each_byte):
            return 0.0, ()
        divisions = []
        for part in parts_at_each_byte[position]:
            end = position + part.size
            # Leave out a part that ends behind the last byte, and a part of which the checksum covers only some bytes.
            if end > len(parts_at_each_byte) or position < checksum_start < end:
                continue
            channel_type = part.type_name if part.name == CHANNEL else ""
            begins_group = channel_type not in ("", previous_channel_type)
            if begins_group and part.is_constant:
                continue
            rest_score, rest_parts = best_division(end, channel_type)
            group_score = Weights.channel_group if begins_group else 0.0
            divisions.append((part.score + rest_score + group_score, (part, *rest_parts)))
        return min(divisions, key=itemgetter(0))  # of equal scores, the first division

    # For each length of the sync pattern, find the best division of the bytes behind the pattern: its score, its parts
    # and the length. Choose the one with the lowest score, which is the element with the index 0.
    return min(((*best_division(length, ""), length) for length in sync_lengths), key=itemgetter(0))


def _decoded_values(number_bytes: Bytes, type_name: str) -> Array:
    """Decode one number in all frames, and return its values, shape (n,).

    Half of the range is subtracted from unsigned values, so that they have the same range as signed values. The
    differences between the values remain the same.

    Args:
        number_bytes: Bytes of the number, the lowest first, shape (n, size).
        type_name: Type of the number, such as "u16": "f" (floating-point), "u" (unsigned) or "i" (signed), and the size
            in bits.
    """
    size = number_bytes.shape[1]
    if type_name[0] == "f":
        return number_bytes.view(f"<f{size}")[:, 0].astype(float)
    # Integers may have any size from 1 to 8 bytes. Low bytes of 0 are added, and the result is read as a signed number
    # of 8 bytes. Each added byte multiplies the number by 256.
    added_count = 8 - size
    eight_bytes = np.pad(number_bytes, [(0, 0), (added_count, 0)])
    if type_name[0] == "u":
        eight_bytes[:, -1] ^= 0x80  # to invert the highest bit is to subtract half of the range
    values: Array = eight_bytes.view(np.int64)[:, 0] / 256.0**added_count
    return values


def _bits(steps: Array, unit: float, size: int) -> float:
    """Return the mean number of bits that are needed to encode the step of a number from one frame to the next.

    Each step counts at most as many bits as the number itself has.

    Args:
        steps: Differences of the values of consecutive frames, shape (n,).
        unit: Smallest step that the number can represent.
        size: Size of the number, bytes.
    """
    step_bits = np.log2(1.0 + np.abs(steps) / unit)
    return float(np.fmin(step_bits, 8 * size).mean())  # `fmin` also replaces NaN
