"""Which bytes of a frame are its sync, its number, its clock and its channels.

Every way to part the bytes into fields has a price: the bits that the steps of its values need, and something for each
field, so that of two ways that explain the bytes alike the simpler one is cheaper, above all channels of one type side
by side. Bytes at the end of a long number and those of noise cost the same, so the price of a field decides there. The
cheapest way is computed from the end of the frame to its begin.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from isocharge.serve.recognition.clock_unit import clock_name, is_usual
from isocharge.serve.recognition.framing import Bytes
from isocharge.serve.recognition.series import (
    Series,
    bits_of_floats,
    bits_of_steps,
    clock_step,
    is_counter,
    steps,
)

SIZES = (1, 2, 3, 4)
"""Sizes of integers, bytes."""

FLOATS = {4: ("f4", "i4", 24), 8: ("f8", "i8", 53)}
"""Floating-point values by size: NumPy's letters for them and for integers of that size, bits of the fraction."""

CONSTANT_SHARE = 0.98
"""Share of frames in which a constant byte has its value, dimensionless: some may be damaged."""

LONGEST_SYNC = 6
"""Longest sync, bytes: what follows may be constant for a while only."""

MOST_CHANNELS = 64
"""Largest number of channels side by side."""

PRICE_OF_FIELD, PRICE_OF_CHANNEL = 1.5, 0.15
"""For a field or a row of channels, and for each channel in a row, bits."""

PRICE_OF_COUNTER, PRICE_OF_WIDTH = 0.4, 0.05
"""For a number or clock, less for each byte of it, bits: wide ones are likelier than constant bytes beside them."""

PRICE_OF_CONSTANT, PRICE_OF_NOISE = 0.4, 8.3
"""For a byte without meaning, bits: a constant one, and another."""

PRICE_OF_DEAD = 1.0
"""For a channel that never varies, bits: more often it is a part of its neighbour."""

PRICE_OF_LEVEL = 0.03
"""For each bit of the level of a channel, bits: of two readings that vary alike the one nearer zero is likelier."""

PRICE_OF_OLD_COUNTER = 1.0
"""For a number or clock of four bytes whose high ones are constant and not 0: they may be something else, bits."""

PRICE_OF_ODD_SIZE = 2.0
"""For a clock of three bytes, bits."""

PRICE_OF_SHORT_SYNC, PRICE_OF_DULL_SYNC = 1.2, 0.7
"""For a sync of one byte, and for each of `DULL` in it, bits."""

DULL = (0x00, 0x80, 0xFF)
"""Bytes that are often the high ones of a number, and seldom of a sync."""

CLOCK_RESOLUTION = 1e-3
"""Finest jitter of a floating-point clock that counts, in its step."""

PRICE_OF_ODD_CLOCK = 8.0
"""For a clock that ticks at no usual rate, bits."""

PRICE_OF_OTHER_ORDER = 0.3
"""For fields of another byte order than that of the checksum, bits."""

FLOAT_BONUS = {4: 2.0, 8: 6.0}
"""By the size of a floating-point value, bits: few other bytes are plausible ones."""

FULL_RANGE_BITS = 1.3
"""Values that need more bits than their size less this fill their range: noise or a checksum."""


class Role(StrEnum):
    """What a part of a frame is."""

    sync = "sync"
    pad = "pad"
    seq = "seq"
    clock = "clock"
    channel = "channel"


@dataclass(frozen=True)
class Part:
    """A part of a frame.

    Attributes:
        role: What it is.
        at, size: Its first byte, and its bytes.
        is_float: Whether it is a floating-point number.
    """

    role: Role
    at: int
    size: int
    is_float: bool = False


@dataclass(frozen=True)
class Split:
    """A frame in parts, and its price in bits."""

    price: float
    parts: tuple[Part, ...]
    order: str


def number_values(rows: Bytes, part: Part, order: str) -> Series:
    """The numbers of a part in all frames, unsigned unless floating-point, shape (n,)."""
    cut = np.ascontiguousarray(rows[:, part.at : part.at + part.size])
    if part.is_float:
        return cut.view(("<" if order == "little" else ">") + FLOATS[part.size][0])[:, 0]
    weighted = cut[:, ::-1] if order == "little" else cut
    values = np.zeros(len(rows), np.uint64)
    for column in weighted.T:
        values = (values << np.uint64(8)) | column
    return values


def split_frame(rows: Bytes, end: int, rate_Hz: float, *, needs_sync: bool, order: str | None = None) -> Split | None:
    """The cheapest way to part frames, of both byte orders.

    Args:
        rows: Frames from their first byte on, shape (n, length).
        end: Bytes before the checksum.
        rate_Hz: Frames per second, Hz; a clock is expected to tick at a usual rate.
        needs_sync: Whether a frame has to begin with a constant byte.
        order: The byte order of the checksum: that of the fields if nothing speaks against it.
    """
    splits = [_split(rows, end, order, rate_Hz, needs_sync) for order in ("little", "big")]
    prices = {
        split: split.price + PRICE_OF_OTHER_ORDER * (order not in (None, split.order)) for split in splits if split
    }
    return min(prices, key=lambda split: prices[split], default=None)


def _split(rows: Bytes, end: int, order: str, rate_Hz: float, needs_sync: bool) -> Split | None:
    constant = (rows[:, :end] == _usual(rows[:, :end])).mean(axis=0) >= CONSTANT_SHARE
    prices: list[float] = [np.inf] * end + [0.0]
    nexts: list[tuple[Part, ...]] = [()] * end
    columns = [_fields_at(rows, at, end, order, rate_Hz, constant) for at in range(end)]
    for at in range(end - 1, -1, -1):
        for price, parts in _options(columns, at, end, constant):
            last = parts[-1]
            total = price + prices[last.at + last.size]
            if total < prices[at]:
                prices[at], nexts[at] = total, parts
    begins = _begins(rows, constant, needs_sync)
    begin, price = min(begins, key=lambda begin: begin[1] + prices[begin[0]], default=(0, np.inf))
    if not np.isfinite(price + prices[begin]):
        return None
    chain, at = [Part(Role.sync, 0, begin)] if begin else [], begin
    while at < end:
        chain += nexts[at]
        at = chain[-1].at + chain[-1].size
    return Split(float(price + prices[begin]), tuple(chain), order)


def _usual(rows: Bytes) -> Bytes:
    """The most frequent byte of each column, shape (columns,)."""
    return np.array([np.bincount(column, minlength=256).argmax() for column in rows.T], np.uint8)


def _begins(rows: Bytes, constant: Series, needs_sync: bool) -> Iterator[tuple[int, float]]:
    """(length of a sync, its price)."""
    if not needs_sync:
        yield 0, 0.0
        return
    price = 0.0
    for size, (is_constant, byte) in enumerate(zip(constant, _usual(rows).tolist(), strict=False), start=1):
        if not is_constant or size > LONGEST_SYNC:
            return
        price += PRICE_OF_DULL_SYNC * (byte in DULL)
        yield size, price + PRICE_OF_SHORT_SYNC * (size == 1)


Priced = tuple[float, Part]


def _fields_at(rows: Bytes, at: int, end: int, order: str, rate_Hz: float, constant: Series) -> list[Priced]:
    """The numbers, clocks and channels that may begin at a byte, each with the bits of its values."""
    fields: list[Priced] = []
    for size in SIZES:
        if at + size > end:
            break
        values = number_values(rows, Part(Role.channel, at, size), order)
        step = steps(values, 8 * size)
        is_constant = bool(constant[at : at + size].all())
        old = PRICE_OF_OLD_COUNTER * (size == 4 and int(values.min()) >> 16 == int(values.max()) >> 16 != 0)
        if is_counter(step) and size != 3:
            fields.append((PRICE_OF_COUNTER - PRICE_OF_WIDTH * size + old, Part(Role.seq, at, size)))
        elif size > 1 and (ticks := clock_step(step)) is not None:
            price = _price_of_clock(step, ticks * rate_Hz) - PRICE_OF_WIDTH * size + PRICE_OF_ODD_SIZE * (size == 3)
            fields.append((price + old, Part(Role.clock, at, size)))
        bits = PRICE_OF_DEAD if is_constant else bits_of_steps(step) + _price_of_level(values, 8 * size)
        if bits <= 8 * size - FULL_RANGE_BITS:
            fields.append((bits, Part(Role.channel, at, size)))
    for size in FLOATS:
        if at + size <= end:
            fields += _float_at(rows, Part(Role.channel, at, size, is_float=True), order, rate_Hz)
    return fields


def _price_of_level(values: Series, bits: int) -> float:
    """Something for the distance of a channel from zero, of integers with a sign, without, or offset by half."""
    level, half = float(np.median(values.astype(float))), float(1 << (bits - 1))
    return PRICE_OF_LEVEL * float(np.log2(1.0 + min(level, abs(level - half), 2.0 * half - level)))


def _price_of_clock(step: Series, ticks_Hz: float) -> float:
    """The bits that the jitter of a clock needs, and something if it ticks as no other does."""
    price = PRICE_OF_COUNTER + bits_of_steps(step - float(np.median(step)))
    return price + PRICE_OF_ODD_CLOCK * (not is_usual(ticks_Hz))


def _float_at(rows: Bytes, part: Part, order: str, rate_Hz: float) -> Iterator[Priced]:
    values = number_values(rows, part, order)
    _, letter, mantissa = FLOATS[part.size]
    integers = np.ascontiguousarray(values).view(values.dtype.byteorder + letter)
    bits = bits_of_floats(values, integers, mantissa)
    if bits is None:
        return
    if not np.ptp(values.astype(float)):
        yield PRICE_OF_DEAD, part
        return
    step = np.diff(values.astype(float))
    ticks = clock_step(step)
    if ticks is not None and clock_name(ticks * rate_Hz)[1] == 1.0:
        price = PRICE_OF_COUNTER + bits_of_steps((step - ticks) / (CLOCK_RESOLUTION * ticks))
        yield price, Part(Role.clock, part.at, part.size, is_float=True)
    yield max(1.0, bits - FLOAT_BONUS[part.size]), part


def _options(
    columns: list[list[Priced]], at: int, end: int, constant: Series
) -> Iterator[tuple[float, tuple[Part, ...]]]:
    """Every part, or row of channels, that may begin at a byte, with its price."""
    yield (PRICE_OF_CONSTANT if constant[at] else PRICE_OF_NOISE), (Part(Role.pad, at, 1),)
    for bits, part in columns[at]:
        if part.role is not Role.channel:
            yield bits, (part,)
            continue
        row, total, varies = [part], bits, bits != PRICE_OF_DEAD
        if varies:
            yield bits + PRICE_OF_FIELD, (part,)
        while len(row) < MOST_CHANNELS and (beside := _beside(columns, row[-1], end)) is not None:
            total, varies = total + beside[0], varies or beside[0] != PRICE_OF_DEAD
            row.append(beside[1])
            if varies:
                yield total + PRICE_OF_FIELD + PRICE_OF_CHANNEL * len(row), tuple(row)


def _beside(columns: list[list[Priced]], part: Part, end: int) -> Priced | None:
    """The channel of the same type that begins where another ends."""
    at = part.at + part.size
    if at >= end:
        return None
    alike = (
        priced
        for priced in columns[at]
        if priced[1].role is Role.channel and (priced[1].size, priced[1].is_float) == (part.size, part.is_float)
    )
    return next(alike, None)
