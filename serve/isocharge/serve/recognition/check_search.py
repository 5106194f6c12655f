"""Which checksum frames end with, and what it covers.

The cyclic checks of two frames of one length differ by the check of their difference: start, final value and whatever
is the same in all frames cancel. So only polynomials have to be tried; which name and first byte give the constant part
is looked up afterwards. A check that has no name is described by its parameters.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from isocharge.serve.frames.checksums import CHECKSUMS, CRCS, Crc
from isocharge.serve.frames.frame_layout import ByteOrder
from isocharge.serve.recognition.framing import Bytes

POLYNOMIALS = {
    8: (0x07, 0x31, 0x1D, 0x2F, 0x9B, 0x39, 0xD5),
    16: (0x1021, 0x8005, 0x3D65, 0x8BB7),
    24: (0x864CFB,),
    32: (0x04C11DB7, 0x1EDC6F41),
}
"""Of the cyclic checks that are looked for, by their bits."""

FEWEST_ROWS, MOST_ROWS = 6, 48
"""Smallest number of different frames for a checksum, and how many are looked at."""

FITTING_SHARE = 0.9
"""Share of frames whose checksum fits, dimensionless: some may be damaged."""

MOST_SKIPPED = 16
"""Largest first byte that a checksum covers."""


@dataclass(frozen=True)
class FoundCheck:
    """A checksum that fits.

    Attributes:
        size: Bytes.
        checksum: Its name, or the parameters of a device file.
        begin: First byte that it covers.
        order: Its byte order.
    """

    size: int = 0
    checksum: str | dict[str, Any] = "none"
    begin: int = 0
    order: ByteOrder = "little"


@cache
def _kinds(width: int) -> tuple[Crc, ...]:
    """The cyclic checks of a width, without start and final value."""
    return tuple(Crc(width, polynomial, 0, way, 0) for polynomial in POLYNOMIALS[width] for way in (False, True))


def find_checks(rows: Bytes) -> Iterator[FoundCheck]:
    """Checksums that fit frames, shape (n, length), the widest first."""
    rows = np.unique(rows, axis=0)
    rows = rows[np.random.default_rng(0).permutation(len(rows))[:MOST_ROWS]]  # neighbours differ in few bits only
    if len(rows) < FEWEST_ROWS:
        return
    constant = (rows == rows[0]).mean(axis=0) >= FITTING_SHARE
    prefix = len(constant) if constant.all() else int(np.argmin(constant))
    frames = [row.tobytes() for row in rows]
    for size in (4, 3, 2, 1):
        if size + 2 > len(constant) or constant[-size:].all():
            continue
        orders: tuple[ByteOrder, ...] = ("little", "big") if size > 1 else ("little",)
        begins = range(min(prefix, MOST_SKIPPED, len(constant) - size - 1) + 1)
        for order in orders:
            sums = [name for name in set(CHECKSUMS) - set(CRCS) if CHECKSUMS[name].size == size]
            found = _cyclic(frames, size, order, begins) or _named(sums, frames, size, order, begins)
            if found is not None:
                yield found


def _cyclic(frames: list[bytes], size: int, order: ByteOrder, begins: range) -> FoundCheck | None:
    for base in frames[:2]:
        differences = [bytes(a ^ b for a, b in zip(base, other, strict=True)) for other in frames if other is not base]
        for crc in _kinds(8 * size):
            if _fits(crc, differences, 0, size, order):
                alike = [name for name, other in CRCS.items() if _kind(other) == _kind(crc)]
                return _named(alike, frames, size, order, begins) or _parameters(crc, frames, size, order)
    return None


def _kind(crc: Crc) -> tuple[int, int, bool]:
    return crc.width, crc.polynomial, crc.reflected


def _named(names: list[str], frames: list[bytes], size: int, order: ByteOrder, begins: range) -> FoundCheck | None:
    fitting = (
        FoundCheck(size, name, begin, order)
        for begin in begins
        for name in sorted(names)
        if _fits(CHECKSUMS[name].compute, frames, begin, size, order)
    )
    return next(fitting, None)


def _parameters(crc: Crc, frames: list[bytes], size: int, order: ByteOrder) -> FoundCheck:
    """A check without a name, in which the constant part is the final value."""
    finals = [crc(frame[:-size]) ^ int.from_bytes(frame[-size:], order) for frame in frames]
    final, digits = max(set(finals), key=finals.count), 2 * size
    numbers = {"polynomial": f"{crc.polynomial:0{digits}X}", "final": f"{final:0{digits}X}"}
    return FoundCheck(size, {"width": crc.width, "reflected": crc.reflected} | numbers, 0, order)


def _fits(compute: Callable[[bytes], int], frames: list[bytes], begin: int, size: int, order: ByteOrder) -> bool:
    """Whether nearly all frames end with their checksum; four decide whether the others are looked at."""

    def share(part: list[bytes]) -> float:
        fits = [compute(frame[begin:-size]) == int.from_bytes(frame[-size:], order) for frame in part]
        return sum(fits) / len(fits)

    return share(frames[:4]) >= 0.5 and share(frames) >= FITTING_SHARE
