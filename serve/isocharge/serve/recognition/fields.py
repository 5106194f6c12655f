"""Which bytes of a frame are its sync, its number, its clock and its channels.

Every way to part the bytes into fields has a score: the bits that the values of one frame need, besides what is known
from the frame before, and `Weights` for what each part is. The lowest score wins: of two ways that explain the bytes
alike the simpler one, above all channels of one type side by side. `tests/benchmarks/fit_recognition.py` fits the
weights on random boards.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.frames.frame_layout import ByteOrder
from isocharge.serve.recognition.framing import Bytes, usual_bytes

COUNTING_SHARE = 0.9
"""Share of steps by which a counter or a clock goes on, dimensionless: frames may be lost, and counters start anew."""

STEADY_SPREAD = 0.7
"""Largest distance of a usual step of a clock from its median step, in that step."""

CLOCKS = {1.0: ("t_s", 1.0), 1e3: ("t_ms", 1.0), 1e6: ("t_us", 1.0)} | {
    rate_Hz: ("t_us", 1e6 / rate_Hz)
    for rate_Hz in (100.0, 1e4, 1e5, 1024.0, 32768.0, 31250.0, 500e3, 2e6, 4e6, 8e6, 16e6)
}
"""Name of its field and value of one tick in the unit that the name says, by the rate at which a clock ticks, Hz."""

TOLERANCE = 0.06
"""Largest relative difference of a clock's rate from a usual one, dimensionless: frames arrive in bursts."""

PLAUSIBLE = (1e-7, 1e8)
"""Smallest and largest typical magnitude of a floating-point channel."""

TYPES = ("u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32", "f32", "f64")
"""Types of numbers, as device files write them."""


def steady_step(step: Array) -> float:
    """The mean step of values that go on by steps of about one size, without those over lost frames; 0 for others."""
    median = np.median(step)
    usual = step[np.abs(step - median) <= STEADY_SPREAD * median]
    return float(usual.mean()) if len(usual) >= COUNTING_SHARE * len(step) else 0.0


def clock_of(step: Array, rate_Hz: float) -> tuple[str, float] | None:
    """The name of a clock's field, and the value of one tick in the unit that the name says; None if it is no clock.

    Args:
        step: From frame to frame, shape (n,).
        rate_Hz: Frames per second, Hz.
    """
    ticks_Hz = steady_step(step) * rate_Hz
    return next((clock for usual_Hz, clock in CLOCKS.items() if abs(ticks_Hz / usual_Hz - 1.0) < TOLERANCE), None)


@dataclass(frozen=True)
class Weights:
    """What a part of a frame adds to the score, bits.

    Attributes:
        row: A row of channels of one type.
        channel: A channel, besides the size of its steps.
        constant: A byte that is always the same and nothing else, or a channel that is always the same.
        noise: A byte that varies and is nothing else; a byte of the stream outside all frames.
        fraction: Share of the bits of a floating-point number that tell its value from one of equal size,
            dimensionless.
    """

    row: float = 4.0
    channel: float = 1.65
    constant: float = 0.8
    noise: float = 8.0
    fraction: float = 0.65


class Part(NamedTuple):
    """A part of a frame.

    Attributes:
        role: What it is.
        kind: Its type in a device file.
        size: Bytes.
        score: What it adds, bits, without the row that a channel may begin.
        is_constant: Whether it is a channel that never varies: such a one begins no row.
        name: Of its field in a device file, but for channels.
        scale: Value of one tick of a clock, in the unit that its name says.
        row: The type that the channels of a row have in common; empty for other parts.
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
    """The parts that may begin at each byte of a frame; the byte alone, without a meaning, is the first of them.

    Args:
        rows: Frames, each with the one after it, shape (n, 2 * length): where a frame begins need not be known.
        order: Byte order of the numbers.
        rate_Hz: Frames per second, Hz; a clock ticks at a usual rate.
        weights: Of the score.
    """
    (usual, constant), length = usual_bytes(rows), rows.shape[1] // 2
    is_zero, way = constant & (usual == 0), 1 if order == "little" else -1
    parts_at: list[list[Part]] = []
    for at in range(length):
        parts_at.append([Part("pad", "pad", 1, weights.constant if constant[at] else weights.noise)])
        for kind in TYPES:
            there = slice(at, at + int(kind[1:]) // 8)
            if there.stop <= 2 * length:
                parts_at[at] += _numbers(
                    rows[:, there][:, ::way], constant[there][::way], is_zero[there][::way], kind, rate_Hz, weights
                )
    return parts_at


def _numbers(
    cut: Bytes, constant: Booleans, is_zero: Booleans, kind: str, rate_Hz: float, weights: Weights
) -> Iterator[Part]:
    """What bytes, lowest first, may be as a number of a type: a frame's number or a clock, and a channel.

    Args:
        cut: The bytes, shape (n, size).
        constant, is_zero: Which of them are always the same, and always 0, shape (size,).
        kind: The type.
        rate_Hz: Frames per second, Hz.
        weights: Of the score.
    """
    size = len(constant)
    if constant.all():
        yield Part("channel", kind, size, weights.constant, is_constant=True, row=kind)
        return
    values, half = _values(cut, kind), 1 << (8 * size - 1)
    step = going = np.diff(values)
    rest = float(np.median(np.abs(values)))
    unit = rest * 256.0 ** (np.argmin(is_zero) - weights.fraction * size) if kind[0] == "f" else 1.0
    if kind[0] == "f" and not PLAUSIBLE[0] < rest < PLAUSIBLE[1]:
        return
    if kind[0] == "u":
        going = (step + half) % (2 * half) - half  # a counter begins anew
        rest = float(np.median(np.abs(values - half)))
    if kind[0] == "u" and size != 3 and steady_step(going) == 1.0:
        yield Part("seq", kind, size, 0.0, name="seq")
    elif kind[0] != "i" and size not in (1, 3) and (clock := clock_of(going, rate_Hz)) is not None:
        yield Part("clock", kind, size, _bits(going - np.median(going), unit, size), False, *clock)
    yield Part("channel", kind, size, weights.channel + _bits(np.append(step, rest), unit, size), row=kind)


def split_frame(
    parts_at: Sequence[Sequence[Part]], syncs: Iterable[int], weights: Weights
) -> tuple[float, int, tuple[Part, ...]]:
    """The way to part a frame with the lowest score: the score in bits, the bytes of the sync, the parts after it.

    Args:
        parts_at: The parts that may begin at each byte before the checksum.
        syncs: Bytes that the sync may have; the shortest of equal ones is taken.
        weights: Of the score.
    """

    @cache
    def lowest(at: int, row: str) -> tuple[float, tuple[Part, ...]]:
        """The lowest score of the bytes from one on, after a channel of a row, and their parts."""
        if at >= len(parts_at):
            return (0.0 if at == len(parts_at) else np.inf), ()
        best: tuple[float, tuple[Part, ...]] = (np.inf, ())
        for part in parts_at[at]:
            begins_row = part.row not in ("", row)
            tail, parts = lowest(at + part.size, part.row)
            score = part.score + weights.row * begins_row + tail
            if score < best[0] and not (begins_row and part.is_constant):
                best = (score, (part, *parts))
        return best

    scored = [(lowest(sync, "")[0] + weights.constant * (sync == 1), sync) for sync in syncs]  # one byte is seldom all
    score, sync = min(scored)
    return score, sync, lowest(sync, "")[1]


def _values(cut: Bytes, kind: str) -> Array:
    """The bytes of a number in all frames, lowest first, shape (n, size), as values of a type, shape (n,)."""
    size = cut.shape[1]
    if kind[0] == "f":
        return np.ascontiguousarray(cut).view(f"<f{size}")[:, 0].astype(float)
    values: Array = cut @ 256.0 ** np.arange(size)
    return values - 256.0**size * (values >= 256.0**size / 2) if kind[0] == "i" else values


def _bits(step: Array, unit: float, size: int) -> float:
    """Mean number of bits for the size of steps of numbers; a step of no finite size needs all that there are."""
    return float(np.fmin(np.log2(1.0 + np.abs(step) / unit), 8 * size).mean())
