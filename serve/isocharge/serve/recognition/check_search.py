"""Which checksum frames end with, and what it covers.

The checksums of two frames of one length differ by the checksum of their difference: start, final value and whatever is
the same in all frames cancel. So only polynomials have to be tried; which name and first byte give the constant part is
looked up afterwards. A check that has no name is described by its parameters.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from isocharge.serve.frames.checksums import CHECKSUMS, CRCS, Crc
from isocharge.serve.recognition.framing import Bytes

FEWEST_ROWS = 6
"""Smallest number of different frames for a checksum."""

MOST_ROWS = 48
"""Frames that are looked at."""

FITTING_SHARE = 0.9
"""Share of frames whose checksum fits, dimensionless: some may be damaged."""

MOST_SKIPPED = 16
"""Largest first byte that a checksum covers."""


@dataclass(frozen=True)
class Check:
    """A checksum that fits.

    Attributes:
        turn: Bytes from the begin of a window to that of its frame.
        size: Bytes.
        checksum: Its name, or the parameters of a device file.
        begin: First byte that it covers.
        order: Its byte order.
    """

    turn: int
    size: int
    checksum: str | dict[str, Any]
    begin: int
    order: str

    @property
    def table(self) -> dict[str, Any]:
        """The keys of a device file; that of the byte order only where it says something."""
        keys: dict[str, Any] = {"checksum": self.checksum}
        keys |= {"checksum_from": self.begin} if self.begin else {}
        return keys | ({"checksum_order": self.order} if self.size > 1 else {})


@cache
def _kinds() -> tuple[tuple[int, int, bool], ...]:
    """(width, polynomial, reflected) of every cyclic check with a name, and of their mirror images; wide ones first."""
    kinds = {(crc.width, crc.polynomial, reflected) for crc in CRCS.values() for reflected in (False, True)}
    return tuple(sorted(kinds, reverse=True))


@cache
def _plain(width: int, polynomial: int, reflected: bool) -> Crc:
    return Crc(width, polynomial, 0, reflected, 0)


def checks(rows: Bytes, turn: int) -> Iterator[Check]:
    """Checksums that fit frames, shape (n, length), whose windows were turned by `turn`; the widest first."""
    rows = np.unique(rows, axis=0)
    rows = rows[np.random.default_rng(0).permutation(len(rows))[:MOST_ROWS]]  # neighbours differ in few bits only
    if len(rows) < FEWEST_ROWS:
        return
    constant = (rows == rows[0]).mean(axis=0) >= FITTING_SHARE
    prefix = int(np.argmin(constant)) if not constant.all() else len(constant)
    frames = [row.tobytes() for row in rows]
    yield from _cyclic(frames, constant, prefix, turn)
    yield from _named(frames, constant, prefix, turn)


def _cyclic(frames: list[bytes], constant: Any, prefix: int, turn: int) -> Iterator[Check]:
    for base in frames[:2]:
        others = [frame for frame in frames if frame is not base]
        differences = [bytes(a ^ b for a, b in zip(base, other, strict=True)) for other in others]
        for width, polynomial, reflected in _kinds():
            size, crc = width // 8, _plain(width, polynomial, reflected)
            if size + 2 > len(base) or constant[-size:].all():
                continue
            for order in ("little", "big")[: min(size, 2)]:
                if _fits_differences(crc, size, order, differences):
                    yield _described(crc, order, frames, prefix, turn)
                    return


def _fits_differences(crc: Crc, size: int, order: Any, differences: list[bytes]) -> bool:
    """Whether nearly all differences have the check of their bytes; three decide whether the others are looked at."""
    fits = [crc(data[:-size]) == int.from_bytes(data[-size:], order) for data in differences[:3]]
    if sum(fits) < min(2, len(fits)):
        return False
    fits += [crc(data[:-size]) == int.from_bytes(data[-size:], order) for data in differences[3:]]
    return sum(fits) >= FITTING_SHARE * len(fits)


def _described(crc: Crc, order: Any, frames: list[bytes], prefix: int, turn: int) -> Check:
    """The name and first byte of a check; without a name, its parameters, in which the constant part is the end."""
    size = crc.width // 8
    alike = [name for name, other in CRCS.items() if _kind(other) == _kind(crc)]
    for begin in range(min(prefix, MOST_SKIPPED) + 1):
        for name in alike:
            if _share(name, begin, size, order, frames) >= FITTING_SHARE:
                return Check(turn, size, name, begin, order)
    finals = [crc(frame[:-size]) ^ int.from_bytes(frame[-size:], order) for frame in frames]
    final = max(set(finals), key=finals.count)
    digits = crc.width // 4
    parameters = {
        "width": crc.width,
        "polynomial": f"{crc.polynomial:0{digits}X}",
        "reflected": crc.reflected,
        "final": f"{final:0{digits}X}",
    }
    return Check(turn, size, parameters, 0, order)


def _kind(crc: Crc) -> tuple[int, int, bool]:
    return crc.width, crc.polynomial, crc.reflected


def _named(frames: list[bytes], constant: Any, prefix: int, turn: int) -> Iterator[Check]:
    """Sums and their like, by trying."""
    for name in sorted(set(CHECKSUMS) - set(CRCS) - {"none"}, key=lambda name: -CHECKSUMS[name].size):
        size = CHECKSUMS[name].size
        if constant[-size:].all():
            continue
        for order in ("little", "big")[: min(size, 2)]:
            for begin in range(min(prefix, MOST_SKIPPED, len(frames[0]) - size - 1) + 1):
                if _share(name, begin, size, order, frames) >= FITTING_SHARE:
                    yield Check(turn, size, name, begin, order)
                    break


def _share(name: str, begin: int, size: int, order: Any, frames: list[bytes]) -> float:
    """Share of frames whose checksum is that of a name."""
    compute = CHECKSUMS[name].compute
    fits = [compute(frame[begin:-size]) == int.from_bytes(frame[-size:], order) for frame in frames[:4]]
    if sum(fits) < 3:
        return 0.0
    fits += [compute(frame[begin:-size]) == int.from_bytes(frame[-size:], order) for frame in frames[4:]]
    return sum(fits) / len(fits)
