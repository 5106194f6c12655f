"""Where frames begin, how long they are, and which checksum they end with: bytes to windows of one length.

A stuffed stream is parted by its delimiter. Otherwise some bytes of every frame are the same, and come again after the
length of a frame: of all pairs of bytes the one is taken whose most frequent distance to its next occurrence covers
most of the stream. Where within a frame that pair stands is not known yet.

The cyclic checks of two frames of one length differ by the check of their difference: start, final value and whatever
is the same in all frames cancel. So only polynomials have to be tried; which name and first byte give the constant part
is looked up afterwards. A check that has no name is described by its parameters.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isocharge.serve.frames.checksums import CHECKSUMS, CRCS, Crc
from isocharge.serve.frames.frame_layout import DATAGRAM, SYNC, ByteOrder
from isocharge.serve.frames.stuffing import STUFFINGS, Stuffing

Bytes = NDArray[np.uint8]

SHORTEST, LONGEST = 4, 256
"""Shortest and longest frame that is looked for, bytes."""

FEWEST = 5
"""Smallest number of frames from which anything is recognised."""

MOST_BYTES = 1 << 16
"""Bytes of a stream that are examined."""

STUFFED_SHARE = 0.9
"""Share of pieces between delimiters that are frames of one length, dimensionless."""

COVERED_SHARE = 0.4
"""Share of a stream that frames of one length cover, dimensionless."""

MOST_LENGTHS = 3
"""Number of lengths that are tried."""


@dataclass(frozen=True)
class Windows:
    """Frames of one length in a stream.

    Attributes:
        framing: One of `isocharge.serve.frames.frame_layout.Framing`.
        stream: All bytes, shape (n,).
        starts: Where windows begin, shape (frames,).
        length: Bytes in each.
    """

    framing: str
    stream: Bytes
    starts: NDArray[np.int64]
    length: int

    def rows(self, turn: int = 0) -> Bytes:
        """The bytes of the windows from `turn` on, shape (frames, length)."""
        starts = self.starts[self.starts + turn + self.length <= len(self.stream)] + turn
        rows: Bytes = self.stream[starts[:, None] + np.arange(self.length)]
        return rows


def framings(chunks: Sequence[bytes], *, are_datagrams: bool) -> Iterator[Windows]:
    """Every way to cut a stream into frames, the most certain first."""
    if are_datagrams:
        yield from _datagrams(chunks)
    data = b"".join(chunks)[:MOST_BYTES]
    for name, stuffing in STUFFINGS.items():
        if (windows := _stuffed(name, stuffing, data)) is not None:
            yield windows
    yield from _synchronised(data)


def _windows(framing: str, pieces: Sequence[bytes]) -> Windows:
    """Windows of pieces of one length."""
    stream = np.frombuffer(b"".join(pieces), np.uint8)
    return Windows(framing, stream, np.arange(len(pieces)) * len(pieces[0]), len(pieces[0]))


def _stuffed(name: str, stuffing: Stuffing, data: bytes) -> Windows | None:
    pieces = [piece for piece in data.split(stuffing.delimiter)[1:-1] if piece]
    if len(pieces) < FEWEST or sum(map(len, pieces)) < COVERED_SHARE * len(data):
        return None
    decoded = []
    for piece in pieces:
        with suppress(ValueError):
            decoded.append(stuffing.decode(piece))
    length, count = _most_common_length(decoded)
    if count < STUFFED_SHARE * len(pieces) or not SHORTEST <= length <= LONGEST:
        return None
    if name != "cobs" and count <= _most_common_length(pieces)[1]:
        return None  # without the stuffing they fit better: a byte with which every frame happens to begin or end
    return _windows(name, [piece for piece in decoded if len(piece) == length])


def _most_common_length(pieces: Sequence[bytes]) -> tuple[int, int]:
    """The most frequent length, and how often it occurs."""
    return Counter(map(len, pieces)).most_common(1)[0] if pieces else (0, 0)


def _synchronised(data: bytes) -> Iterator[Windows]:
    stream = np.frombuffer(data, np.uint8)
    if len(stream) < FEWEST * SHORTEST:
        return
    pairs = (stream[:-1].astype(np.int64) << 8) | stream[1:]
    best: dict[int, tuple[float, int, bool]] = {}
    for codes, is_pair in ((pairs, True), (stream.astype(np.int64), False)):
        for code, gap, coverage in _coverages(codes):
            if coverage > best.get(gap, (0.0,))[0] + (0.0 if is_pair else 0.05):
                best[gap] = (coverage, code, is_pair)
    ranked = sorted(best, key=lambda gap: (-round(best[gap][0], 1), gap))
    for length in ranked[:MOST_LENGTHS]:
        _, code, is_pair = best[length]
        positions = np.flatnonzero((pairs if is_pair else stream) == code)
        follows = np.flatnonzero(np.diff(positions) == length)
        if len(follows) >= FEWEST - 1:
            yield Windows(SYNC, stream, positions[follows].astype(np.int64), length)


def _coverages(codes: NDArray[np.int64]) -> Iterator[tuple[int, int, float]]:
    """(code, gap, share of the stream that this gap covers between two of this code), those that cover much."""
    order = np.argsort(codes, kind="stable")
    same = codes[order][1:] == codes[order][:-1]
    gaps, of = np.diff(order)[same], codes[order][1:][same]
    fitting = (gaps >= SHORTEST) & (gaps <= LONGEST)
    keys, counts = np.unique(of[fitting] * (LONGEST + 1) + gaps[fitting], return_counts=True)
    for key, count in zip(keys.tolist(), counts.tolist(), strict=True):
        code, gap = divmod(key, LONGEST + 1)
        coverage = count * gap / len(codes)
        if coverage >= COVERED_SHARE and count >= FEWEST - 1:
            yield code, gap, coverage


def _datagrams(chunks: Sequence[bytes]) -> Iterator[Windows]:
    """Datagrams that hold frames of one length: what divides the lengths of all."""
    lengths = [len(chunk) for chunk in chunks if chunk]
    if len(lengths) < FEWEST:
        return
    common, data = int(np.gcd.reduce(lengths)), b"".join(chunks)[:MOST_BYTES]
    for length in range(SHORTEST, min(common, LONGEST) + 1):
        if common % length == 0:
            size = len(data) // length * length
            yield _windows(DATAGRAM, [data[at : at + length] for at in range(0, size, length)])


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
