"""Which bytes of a frame are its sync, its number, its clock and its channels.

Every way to part the bytes into fields has a score, in bits: what the steps of its values need, and `Weights` for what
each part is. The lowest score wins: of two ways that explain the bytes alike the simpler one, above all channels of one
type side by side. `tests/benchmarks/fit_recognition.py` fits the weights on random boards.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from isocharge.serve.frames.frame_layout import ByteOrder
from isocharge.serve.recognition.framing import Bytes

Series = NDArray[Any]

FEWEST = 5
"""Smallest number of values of which anything is said."""

COUNTING_SHARE = 0.9
"""Share of steps by which a counter or a clock goes on, dimensionless: frames may be lost, and counters start anew."""

CLOCK_SPREAD = (0.3, 1.7)
"""Smallest and largest usual step of a clock, in its median step."""

UNITS_HZ = {"t_s": 1.0, "t_ms": 1e3, "t_us": 1e6}
"""Ticks per second of a clock by the name of its field, Hz."""

USUAL_HZ = (100.0, 1e4, 1e5, 1024.0, 32768.0, 31250.0, 500e3, 2e6, 4e6, 8e6, 16e6)
"""Other rates at which clocks of boards tick, Hz."""

TOLERANCE = 0.06
"""Largest relative difference of a clock's rate from a usual one, dimensionless: frames arrive in bursts."""

BITS_OF_SIGN = 1.5
"""What a value that varies needs besides the size of its steps, bits: sign and fraction."""

PLAUSIBLE = (1e-7, 1e8)
"""Smallest and largest magnitude of a plausible floating-point value other than 0."""

PLAUSIBLE_SHARE = 0.95
"""Share of values that are plausible, dimensionless: some may be damaged."""

LEAST_NOISE = 1e-5
"""Smallest step of a floating-point value that varies, in its magnitude, dimensionless: converters have 20 bits."""


def steps(values: Series, bits: int) -> Series:
    """Steps of an unsigned counter of some bits, taken over its wraps, shape (n - 1,), int64; up to half its range."""
    half = 1 << (bits - 1)
    difference: Series = np.diff(values.astype(np.int64))
    return (difference + half) % (2 * half) - half


def is_counter(step: Series) -> bool:
    """Whether values go on by one."""
    return len(step) >= FEWEST - 1 and float(np.mean(step == 1)) >= COUNTING_SHARE


def clock_step(step: Series) -> float | None:
    """The mean step of a clock, without those over lost frames; None if values do not go on by steps of one size."""
    if len(step) < FEWEST - 1 or not (median := float(np.median(step))) > 0:
        return None
    low, high = CLOCK_SPREAD
    usual = (step >= low * median) & (step <= high * median)
    return float(step[usual].mean()) if float(np.mean(usual)) >= COUNTING_SHARE else None


def clock_of(step: Series, rate_Hz: float) -> tuple[str, float] | None:
    """The name of a clock's field, and the value of one tick in the unit that the name says; None if it is no clock.

    Args:
        step: From frame to frame, shape (n,).
        rate_Hz: Frames per second, Hz.
    """
    if (ticks := clock_step(step)) is None:
        return None
    for name, unit_Hz in UNITS_HZ.items():
        if abs(ticks * rate_Hz / unit_Hz - 1.0) < TOLERANCE:
            return name, 1.0
    usual = (usual_Hz for usual_Hz in USUAL_HZ if abs(ticks * rate_Hz / usual_Hz - 1.0) < TOLERANCE)
    return next((("t_us", UNITS_HZ["t_us"] / usual_Hz) for usual_Hz in usual), None)


def bits_of_steps(step: Series) -> float:
    """Mean number of bits that steps need; 0 for a constant."""
    if not step.any():
        return 0.0
    return float(np.log2(1.0 + np.abs(step.astype(float))).mean()) + BITS_OF_SIGN


def bits_of_floats(values: Series, integers: Series, mantissa: int) -> float | None:
    """Mean number of bits that floating-point values need; None if too many are not plausible.

    Args:
        values: The values, shape (n,).
        integers: Their bytes as integers, shape (n,).
        mantissa: Bits of their fraction, the first one too.
    """
    low, high = PLAUSIBLE
    with np.errstate(invalid="ignore"):
        magnitude = np.abs(values.astype(float))
    plausible = (magnitude == 0) | ((magnitude > low) & (magnitude < high))
    if float(np.mean(plausible)) < PLAUSIBLE_SHARE:
        return None
    values, integers, magnitude = values[plausible], integers[plausible], magnitude[plausible]
    used = int(np.bitwise_or.reduce(integers)) & ((1 << mantissa) - 1)
    zeros = min(mantissa - 1, (used & -used).bit_length() - 1 if used else mantissa)  # values that came from few bits
    typical = float(np.median(magnitude)) or float(magnitude.max())
    quantum = typical * 2.0 ** (zeros - mantissa) or 1.0
    step = np.diff(values.astype(float))
    if step.any() and float(np.median(np.abs(step))) < LEAST_NOISE * typical:
        return None
    return bits_of_steps(step / quantum)


def rest_of(values: Series) -> float:
    """The level at which a channel rests: the median of its values; 0 without a finite one."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


def noise_of(values: Series) -> float:
    """Standard deviation of a channel, from the median size of its steps, which presses hardly change.

    Coarse counts that stand still most of the time have a median step of 0; their mean step decides.
    """
    step = np.abs(np.diff(values[np.isfinite(values)].astype(float)))
    if not len(step):
        return 0.0
    return float(np.median(step) / (0.6745 * np.sqrt(2.0)) or step.mean() * np.sqrt(np.pi) / 2.0)


FLOATS = {4: ("f4", "i4", 24), 8: ("f8", "i8", 53)}
"""Floating-point values by size: NumPy's letters for them and for integers of that size, bits of the fraction."""

CONSTANT_SHARE = 0.98
"""Share of frames in which a constant byte has its value, dimensionless: some may be damaged."""

LONGEST_SYNC = 6
"""Longest sync, bytes: what follows may be constant for a while only."""

DULL = (0x00, 0x80, 0xFF)
"""Bytes that are often the high ones of a number, and seldom of a sync."""

CLOCK_RESOLUTION = 1e-3
"""Finest jitter of a floating-point clock that counts, in its step."""

FULL_RANGE_BITS = 1.3
"""Values that need more bits than their size less this fill their range: noise or a checksum."""


@dataclass(frozen=True)
class Weights:
    """What a part of a frame adds to the score, bits.

    Attributes:
        row: A row of channels of one type.
        channel: A channel, besides the bits of its steps; one that never varies needs none.
        counter: A number or a clock.
        sync: A byte of the sync.
        unusual: Something that boards seldom have: a sync of one byte, or with a byte that is dull; a clock of three
            bytes, for each of them; a number whose high half stands still and is not 0; two byte orders.
        constant: A byte that is always the same and nothing else.
        noise: A byte that varies and is nothing else; a byte of the stream outside all frames.
        float_byte: Taken off for a byte of a floating-point number: few other bytes are plausible ones.
        check_byte: Taken off for a byte of the checksum.
        no_check: Frames without a checksum.
    """

    row: float = 1.5
    channel: float = 0.15
    counter: float = 0.2
    sync: float = 0.05
    unusual: float = 0.8
    constant: float = 0.4
    noise: float = 8.3
    float_byte: float = 0.6
    check_byte: float = 1.0
    no_check: float = 4.0


@dataclass(frozen=True)
class Part:
    """A part of a frame.

    Attributes:
        role: What it is.
        at, size: Its first byte, and its bytes.
        score: What it adds, bits, without the row that a channel may begin.
        is_float: Whether it is a floating-point number.
        is_dead: Whether it is a channel that never varies.
        clock: Name of its field in a device file and value of one tick, of a clock.
    """

    role: Literal["sync", "pad", "seq", "clock", "channel"]
    at: int
    size: int
    score: float = 0.0
    is_float: bool = False
    is_dead: bool = False
    clock: tuple[str, float] = ("", 1.0)

    @property
    def row(self) -> tuple[int, bool] | None:
        """What channels of one row have in common; None for other parts."""
        return (self.size, self.is_float) if self.role == "channel" else None


@dataclass(frozen=True)
class Split:
    """A frame in parts, and its score in bits."""

    score: float
    parts: tuple[Part, ...]
    order: ByteOrder


def number_values(rows: Bytes, at: int, size: int, order: ByteOrder, *, is_float: bool = False) -> Series:
    """The numbers at a byte in all frames, unsigned unless floating-point, shape (n,)."""
    cut = np.ascontiguousarray(rows[:, at : at + size])
    if is_float:
        return cut.view(("<" if order == "little" else ">") + FLOATS[size][0])[:, 0]
    powers = 256 ** np.arange(size, dtype=np.int64)
    values: Series = cut @ (powers if order == "little" else powers[::-1])
    return values


def split_frame(
    rows: Bytes, end: int, rate_Hz: float, weights: Weights, *, needs_sync: bool, order: ByteOrder | None = None
) -> Split | None:
    """The way to part frames with the lowest score, of both byte orders; None if they cannot be parted.

    Args:
        rows: Frames from their first byte on, shape (n, length).
        end: Bytes before the checksum.
        rate_Hz: Frames per second, Hz; a clock ticks at a usual rate.
        weights: Of the score.
        needs_sync: Whether a frame has to begin with a constant byte.
        order: The byte order of the checksum.
    """
    usual = np.array([np.bincount(column, minlength=256).argmax() for column in rows[:, :end].T], np.uint8)
    constant = (rows[:, :end] == usual).mean(axis=0) >= CONSTANT_SHARE
    begins = dict(_syncs(usual, constant, weights)) if needs_sync else {0: 0.0}
    best: Split | None = None
    for way in ("little", "big"):
        fields = [list(_fields_at(rows, at, end, way, rate_Hz, constant, weights)) for at in range(end)]
        for begin, score in begins.items():
            tail, parts = _cheapest(fields, begin, weights)
            score += tail + weights.unusual * (order not in (None, way))
            if best is None or score < best.score:
                best = Split(score, (Part("sync", 0, begin), *parts)[not begin :], way)
    return best


def _syncs(usual: Bytes, constant: Series, weights: Weights) -> Iterator[tuple[int, float]]:
    """(length of a sync, its score)."""
    score = 0.0
    for size, (is_constant, byte) in enumerate(zip(constant, usual.tolist(), strict=True), start=1):
        if not is_constant or size > LONGEST_SYNC:
            return
        score += weights.sync + weights.unusual * (byte in DULL)
        yield size, score + weights.unusual * (size == 1)


def _cheapest(fields: list[list[Part]], begin: int, weights: Weights) -> tuple[float, tuple[Part, ...]]:
    """The lowest score of the bytes from one on, and their parts."""

    @cache
    def lowest(at: int, row: tuple[int, bool] | None) -> tuple[float, Part | None]:
        """The score from a byte on, after a channel of a row, and the part that begins there."""
        if at == len(fields):
            return 0.0, None
        options = [
            (part.score + weights.row * (part.row not in (None, row)) + lowest(at + part.size, part.row)[0], part)
            for part in fields[at]
            if part.row == row or not part.is_dead
        ]
        return min(options, key=lambda option: option[0])

    score, part = lowest(begin, None)
    parts: list[Part] = []
    while part is not None:
        parts.append(part)
        _, part = lowest(part.at + part.size, part.row)
    return score, tuple(parts)


def _fields_at(
    rows: Bytes, at: int, end: int, order: ByteOrder, rate_Hz: float, constant: Series, weights: Weights
) -> Iterator[Part]:
    """The numbers, clocks and channels that may begin at a byte; the byte alone, without a meaning, first."""
    yield Part("pad", at, 1, weights.constant if constant[at] else weights.noise)
    for size in range(1, min(4, end - at) + 1):
        values = number_values(rows, at, size, order)
        step, half = steps(values, 8 * size), 4 * size
        stands = int(values.min()) >> half == int(values.max()) >> half != 0
        unusual = weights.counter + weights.unusual * ((size == 4 and stands) + 3 * (size == 3))
        if is_counter(step):
            yield Part("seq", at, size, unusual)
        elif size > 1 and (clock := clock_of(step, rate_Hz)) is not None:
            yield Part("clock", at, size, unusual + bits_of_steps(step - float(np.median(step))), clock=clock)
        if constant[at : at + size].all():
            yield Part("channel", at, size, weights.channel, is_dead=True)
        elif (bits := bits_of_steps(step)) <= 8 * size - FULL_RANGE_BITS:
            yield Part("channel", at, size, bits + weights.channel)
    for size in FLOATS:
        if at + size <= end:
            yield from _float_at(rows, at, size, order, rate_Hz, weights)


def _float_at(rows: Bytes, at: int, size: int, order: ByteOrder, rate_Hz: float, weights: Weights) -> Iterator[Part]:
    values = number_values(rows, at, size, order, is_float=True)
    _, letter, mantissa = FLOATS[size]
    bits = bits_of_floats(values, np.ascontiguousarray(values).view(values.dtype.byteorder + letter), mantissa)
    if bits is None:
        return
    step = np.diff(values.astype(float))
    if not step.any():
        yield Part("channel", at, size, weights.channel, is_float=True, is_dead=True)
        return
    if (clock := clock_of(step, rate_Hz)) is not None and clock[1] == 1.0:
        typical = float(np.median(step))
        jitter = bits_of_steps((step - typical) / (CLOCK_RESOLUTION * typical))
        yield Part("clock", at, size, weights.counter + jitter, is_float=True, clock=clock)
    score = max(1.0, bits - weights.float_byte * size) + weights.channel
    yield Part("channel", at, size, score, is_float=True)
