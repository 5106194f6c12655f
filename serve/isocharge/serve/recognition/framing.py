"""Where frames begin and how long they are: bytes to windows of one length.

A stuffed stream is parted by its delimiter. Otherwise some bytes of every frame are the same, and come again after the
length of a frame: of all pairs of bytes the one is taken whose most frequent distance to its next occurrence covers
most of the stream. Where within a frame that pair stands is not known yet.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from isocharge.serve.frames.frame_layout import DATAGRAM, SYNC
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
