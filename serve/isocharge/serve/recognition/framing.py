"""Where frames begin, how long they are, and which checksum they end with: bytes to windows of one length.

A stuffed stream is parted by its delimiter. Otherwise some bytes of every frame are the same, and come again after the
length of a frame: of all pairs of bytes the one is taken whose most frequent distance to its next occurrence covers
most of the stream. Where within a frame that pair stands is not known yet.

Named checksums are tried from every first byte. Of cyclic checks without a name only the polynomials have to be tried:
in frames of one length, start and final value and whatever is the same in all frames add up to a constant.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import chain, islice
from math import gcd
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isocharge.serve.frames.checksums import CHECKSUMS, Crc
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

SINGLE_SHARE = 0.05
"""Share of a stream that a single byte has to cover more than a pair, which seldom occurs by chance, dimensionless."""

MOST_LENGTHS = 3
"""Number of lengths that are tried."""

CONSTANT_SHARE = 0.98
"""Share of frames in which a constant byte has its value, dimensionless: some may be damaged."""


class Windows(NamedTuple):
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

    def rows(self) -> Bytes:
        """The bytes of each window and as many after it, shape (frames, 2 * length): frames begin anywhere in it."""
        starts = self.starts[self.starts + 2 * self.length <= len(self.stream)]
        return np.asarray(self.stream[starts[:, None] + np.arange(2 * self.length)])


def usual_bytes(rows: Bytes) -> tuple[Bytes, NDArray[np.bool_]]:
    """The most frequent byte at each place of a frame, and whether nearly all frames have it, shape (length,)."""
    usual = np.array([np.bincount(column).argmax() for column in rows.T], np.uint8)
    return usual, (rows == usual).mean(axis=0) >= CONSTANT_SHARE


def framings(chunks: Sequence[bytes], *, are_datagrams: bool) -> Iterator[Windows]:
    """Every way to cut a stream into frames, the most certain first."""
    data = b"".join(chunks)[:MOST_BYTES]
    if are_datagrams:
        common = gcd(*map(len, chunks))
        lengths = [length for length in range(SHORTEST, min(common, LONGEST) + 1) if common % length == 0]
        yield from (_side_by_side(DATAGRAM, data, length) for length in lengths)
    for name, stuffing in STUFFINGS.items():
        yield from _stuffed(name, stuffing, data)
    yield from _synchronised(np.frombuffer(data, np.uint8))


def _side_by_side(framing: str, data: bytes, length: int) -> Windows:
    return Windows(framing, np.frombuffer(data, np.uint8), np.arange(0, len(data), length), length)


def _stuffed(name: str, stuffing: Stuffing, data: bytes) -> Iterator[Windows]:
    pieces = [piece for piece in data.split(stuffing.delimiter)[1:-1] if piece]
    decoded = []
    for piece in pieces:
        with suppress(ValueError):
            decoded.append(stuffing.decode(piece))
    length, count = _most_common_length(decoded)
    if count < STUFFED_SHARE * len(pieces) or not SHORTEST <= length <= LONGEST:
        return
    if name == "cobs" or count > _most_common_length(pieces)[1]:  # else every frame happens to begin with that byte
        yield _side_by_side(name, b"".join(piece for piece in decoded if len(piece) == length), length)


def _most_common_length(pieces: Sequence[bytes]) -> tuple[int, int]:
    """The most frequent length, and how often it occurs."""
    return Counter(map(len, pieces)).most_common(1)[0] if pieces else (0, 0)


def _synchronised(stream: Bytes) -> Iterator[Windows]:
    single = stream.astype(np.int64)
    best: dict[int, tuple[float, NDArray[np.int64]]] = {}
    for codes, less in ((256 * single[:-1] + single[1:], 0.0), (single, SINGLE_SHARE)):
        for length, starts in _repeats(codes):
            coverage = len(starts) * length / len(stream) - less
            if coverage > best.get(length, (COVERED_SHARE - less,))[0]:
                best[length] = coverage, starts
    for length in sorted(best, key=lambda length: (-round(best[length][0], 1), length))[:MOST_LENGTHS]:
        yield Windows(SYNC, stream, best[length][1], length)


def _repeats(codes: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Distances to the next occurrence of a code that are frequent, and where these codes stand."""
    order = np.argsort(codes, kind="stable")
    gaps, firsts = np.diff(order), order[:-1]
    repeats = (np.diff(codes[order]) == 0) & (gaps >= SHORTEST) & (gaps <= LONGEST)
    gaps, firsts = gaps[repeats], firsts[repeats]
    keys = codes[firsts] * (LONGEST + 1) + gaps
    for key, count in zip(*np.unique(keys, return_counts=True), strict=True):
        length = int(key) % (LONGEST + 1)
        if count * length >= COVERED_SHARE * len(codes):
            yield length, firsts[keys == key]


CYCLIC = {
    size: [Crc(8 * size, polynomial, 0, reflected, 0) for polynomial in polynomials for reflected in (False, True)]
    for size, polynomials in {
        4: (0x04C11DB7, 0x1EDC6F41),
        3: (0x864CFB,),
        2: (0x1021, 0x8005, 0x3D65, 0x8BB7),
        1: (0x07, 0x31, 0x1D, 0x2F, 0x9B, 0x39, 0xD5),
    }.items()
}
"""Cyclic checks that are looked for without a name, by their bytes, without start and final value."""

FEWEST_ROWS, MOST_ROWS = 6, 24
"""Smallest number of different frames for a checksum, and how many are looked at."""

FITTING_SHARE = 0.75
"""Share of frames whose checksum fits, dimensionless: some may be damaged."""

MOST_SKIPPED = 16
"""Largest first byte that a checksum covers."""


ORDERS: tuple[ByteOrder, ...] = ("little", "big")


class Check(NamedTuple):
    """A checksum that fits: its bytes, 0 for none, their order, and its keys in a device file."""

    size: int
    order: ByteOrder
    keys: dict[str, Any]


def find_checks(rows: Bytes) -> Iterator[Check]:
    """Checksums that fit frames, shape (n, length), the widest first."""
    rows = np.unique(rows, axis=0)
    rows = rows[np.random.default_rng(0).permutation(len(rows))[:MOST_ROWS]]  # neighbours differ in few bits only
    if len(rows) < FEWEST_ROWS:
        return
    constant, frames = usual_bytes(rows)[1], [row.tobytes() for row in rows]
    skipped = int(np.argmin([*constant[:MOST_SKIPPED], False]))
    for size in CYCLIC:
        if size + 2 > len(constant) or constant[-size:].all():
            continue
        for order in ORDERS[:size]:
            named = _named(frames, size, order, range(min(skipped, len(constant) - size - 1) + 1))
            yield from islice(chain(named, _unnamed(frames, size, order)), 1)


def _named(frames: list[bytes], size: int, order: ByteOrder, begins: range) -> Iterator[Check]:
    names = [name for name, checksum in CHECKSUMS.items() if checksum.size == size]
    for begin in begins:
        for name in names:
            if _fits(CHECKSUMS[name].compute, frames, begin, size, order):
                yield Check(size, order, {"checksum": name} | ({"checksum_from": begin} if begin else {}))


def _fits(compute: Callable[[bytes], int], frames: list[bytes], begin: int, size: int, order: ByteOrder) -> bool:
    """Whether nearly all frames end with their checksum; four decide whether the others are looked at."""

    def fitting(part: list[bytes]) -> int:
        return sum(compute(frame[begin:-size]) == int.from_bytes(frame[-size:], order) for frame in part)

    return fitting(frames[:4]) >= 2 and fitting(frames) >= FITTING_SHARE * len(frames)


def _unnamed(frames: list[bytes], size: int, order: ByteOrder) -> Iterator[Check]:
    """Cyclic checks by their parameters, in which the constant part is the final value."""
    for crc in CYCLIC[size]:
        finals = Counter(crc(frame[:-size]) ^ int.from_bytes(frame[-size:], order) for frame in frames)
        final, count = finals.most_common(1)[0]
        if count >= FITTING_SHARE * len(frames):
            numbers = {"polynomial": f"{crc.polynomial:0{2 * size}X}", "final": f"{final:0{2 * size}X}"}
            yield Check(size, order, {"checksum": {"width": crc.width, "reflected": crc.reflected} | numbers})
