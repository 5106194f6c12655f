"""Recognition of the framing: the beginning and the length of frames, and their checksum.

A stream with byte stuffing is split at its delimiter. In other streams, some bytes are the same in every frame. Such
bytes therefore repeat after the length of a frame. The repetitions of each pair of bytes cover a part of the stream.
The pair that covers the largest part is chosen. The position of this pair in the frame is determined later.

Named checksums are tried with every possible first byte. For cyclic redundancy checks without a name, only the
polynomials have to be tried. The initial value, the final value and all constant bytes contribute the same constant in
all frames of one length.
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
from isocharge.serve.frames.frame_field import ByteOrder
from isocharge.serve.frames.frame_layout import DATAGRAM, SYNC
from isocharge.serve.frames.stuffing import STUFFINGS, Stuffing

Bytes = NDArray[np.uint8]

MIN_FRAME_BYTES = 4
"""Shortest frame that is recognised, bytes."""

MAX_FRAME_BYTES = 256
"""Longest frame that is recognised, bytes."""

MIN_FRAMES = 5
"""Smallest number of frames from which a format is recognised."""

MAX_EXAMINED_BYTES = 1 << 16
"""Largest number of bytes of a stream that are examined."""

STUFFED_SHARE = 0.9
"""Smallest share of the pieces between delimiters that must have one length, dimensionless."""

COVERED_SHARE = 0.4
"""Smallest share of a stream that frames of one length must cover, dimensionless."""

SINGLE_BYTE_PENALTY = 0.05
"""Share of a stream by which a single byte must cover more than a pair of bytes.

A pair of bytes rarely repeats by chance, but a single byte often does.
"""

MAX_FRAME_LENGTHS = 3
"""Number of frame lengths that are tried."""

CONSTANT_SHARE = 0.98
"""Smallest share of frames in which a constant byte has its value, because some frames may be damaged."""


class Windows(NamedTuple):
    """Frames of one length in a stream.

    Attributes:
        framing: Kind of framing, one of `isocharge.serve.frames.frame_layout.Framing`.
        stream: All bytes of the stream, shape (n,).
        starts: Positions at which the windows begin, shape (frames,).
        length: Number of bytes in a window.
    """

    framing: str
    stream: Bytes
    starts: NDArray[np.int64]
    length: int

    def rows(self) -> Bytes:
        """Return the bytes of each window and the same number of bytes after it, shape (frames, 2 * length).

        The position at which a frame begins is unknown, but it is the same in every window.
        """
        row_length = 2 * self.length
        starts = self.starts[self.starts + row_length <= len(self.stream)]
        positions = starts[:, None] + np.arange(row_length)  # positions in the stream, shape (frames, 2 * length)
        return np.asarray(self.stream[positions])


def usual_bytes(rows: Bytes) -> tuple[Bytes, NDArray[np.bool_]]:
    """Return the most frequent byte at each position, and whether nearly all frames have this byte.

    Args:
        rows: Bytes of the frames, shape (n, length).

    Returns:
        The most frequent bytes, and whether each of them is constant, each of shape (length,).
    """
    usual = np.array([np.bincount(column).argmax() for column in rows.T], np.uint8)
    share_of_frames = (rows == usual).mean(axis=0)
    return usual, share_of_frames >= CONSTANT_SHARE


def framings(chunks: Sequence[bytes], *, are_datagrams: bool) -> Iterator[Windows]:
    """Yield every possible division of a stream into frames, in the order of decreasing certainty.

    Args:
        chunks: The bytes of the stream.
        are_datagrams: Whether each chunk is a datagram, which contains one or several whole frames.
    """
    data = b"".join(chunks)[:MAX_EXAMINED_BYTES]
    if are_datagrams:
        common_divisor = gcd(*map(len, chunks))
        for length in range(MIN_FRAME_BYTES, min(common_divisor, MAX_FRAME_BYTES) + 1):
            if common_divisor % length == 0:
                yield _adjacent_frames(DATAGRAM, data, length)
    for name, stuffing in STUFFINGS.items():
        yield from _stuffed_frames(name, stuffing, data)
    yield from _synchronised_frames(np.frombuffer(data, np.uint8))


def _adjacent_frames(framing: str, data: bytes, length: int) -> Windows:
    """Return the windows of a stream that contains only whole frames of one length."""
    return Windows(framing, np.frombuffer(data, np.uint8), np.arange(0, len(data), length), length)


def _stuffed_frames(name: str, stuffing: Stuffing, data: bytes) -> Iterator[Windows]:
    """Yield the division of a stream at the delimiters of a byte stuffing, if the pieces are frames of one length.

    Args:
        name: Name of the stuffing.
        stuffing: The stuffing.
        data: Bytes of the stream.
    """
    whole_pieces = data.split(stuffing.delimiter)[1:-1]  # the first and the last piece may be incomplete
    pieces = [piece for piece in whole_pieces if piece]
    decoded_pieces = []
    for piece in pieces:
        with suppress(ValueError):
            decoded_pieces.append(stuffing.decode(piece))
    length, count = _most_common_length(decoded_pieces)
    has_frame_length = MIN_FRAME_BYTES <= length <= MAX_FRAME_BYTES
    if count < STUFFED_SHARE * len(pieces) or not has_frame_length:
        return

    # If the lengths are as regular without decoding, there is no stuffing, and frames begin with this byte by chance.
    # COBS is an exception, because it makes all frames of one length longer by the same number of bytes.
    _, count_without_decoding = _most_common_length(pieces)
    if name == "cobs" or count > count_without_decoding:
        frames = [piece for piece in decoded_pieces if len(piece) == length]
        yield _adjacent_frames(name, b"".join(frames), length)


def _most_common_length(pieces: Sequence[bytes]) -> tuple[int, int]:
    """Return the most frequent length of the pieces, and how often it occurs."""
    if not pieces:
        return 0, 0
    return Counter(map(len, pieces)).most_common(1)[0]


def _synchronised_frames(stream: Bytes) -> Iterator[Windows]:
    """Yield the divisions of a stream at bytes that repeat after the length of a frame.

    For each length, the pair of bytes or the single byte is chosen whose repetitions cover the largest share of the
    stream. The lengths with the largest shares are yielded. If the shares are about equal, the shorter length comes
    first.

    Args:
        stream: Bytes of the stream, shape (n,).
    """
    single_bytes = stream.astype(np.int64)
    byte_pairs = 256 * single_bytes[:-1] + single_bytes[1:]

    # For each length of a frame, the largest share of the stream that is covered, and where its frames begin.
    best_coverage: dict[int, float] = {}
    best_starts: dict[int, NDArray[np.int64]] = {}
    for codes, penalty in ((byte_pairs, 0.0), (single_bytes, SINGLE_BYTE_PENALTY)):
        for length, starts in _frequent_distances(codes):
            coverage = len(starts) * length / len(stream) - penalty
            required_coverage = best_coverage.get(length, COVERED_SHARE - penalty)
            if coverage > required_coverage:
                best_coverage[length] = coverage
                best_starts[length] = starts

    def sorting_key(length: int) -> tuple[float, int]:
        """Return a key that sorts by decreasing coverage in steps of 10 %, and then by increasing length."""
        return -round(best_coverage[length], 1), length

    best_lengths = sorted(best_coverage, key=sorting_key)[:MAX_FRAME_LENGTHS]
    for length in best_lengths:
        yield Windows(SYNC, stream, best_starts[length], length)


def _frequent_distances(codes: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield the frequent distances from a code to its next occurrence, and the positions of the code.

    Args:
        codes: Code at each position of the stream, shape (n,). A code is a byte, or a pair of bytes as a number.
    """
    # A stable sort puts equal codes side by side, in the order of their positions.
    sorted_positions = np.argsort(codes, kind="stable")
    all_positions = sorted_positions[:-1]
    all_distances = np.diff(sorted_positions)
    has_equal_code = np.diff(codes[sorted_positions]) == 0
    has_frame_length = (all_distances >= MIN_FRAME_BYTES) & (all_distances <= MAX_FRAME_BYTES)
    positions = all_positions[has_equal_code & has_frame_length]
    distances = all_distances[has_equal_code & has_frame_length]

    # Count the pairs of code and distance. Each pair is encoded as one number, code * distance_count + distance.
    distance_count = MAX_FRAME_BYTES + 1
    keys = codes[positions] * distance_count + distances
    for key, count in zip(*np.unique(keys, return_counts=True), strict=True):
        distance = int(key) % distance_count
        if count * distance >= COVERED_SHARE * len(codes):
            yield distance, positions[keys == key]


CRC_POLYNOMIALS = {
    4: (0x04C11DB7, 0x1EDC6F41),
    3: (0x864CFB,),
    2: (0x1021, 0x8005, 0x3D65, 0x8BB7),
    1: (0x07, 0x31, 0x1D, 0x2F, 0x9B, 0x39, 0xD5),
}
"""Polynomials of cyclic redundancy checks that are tried without a name, by the size of the check in bytes."""


def _crcs_of_size(size: int) -> list[Crc]:
    """Return the checks of a size in bytes with both bit orders. Their initial and final values are 0."""
    bit_count = 8 * size
    polynomials = CRC_POLYNOMIALS[size]
    return [Crc(bit_count, polynomial, 0, reflected, 0) for polynomial in polynomials for reflected in (False, True)]


UNNAMED_CRCS = {size: _crcs_of_size(size) for size in CRC_POLYNOMIALS}
"""Cyclic redundancy checks that are tried without a name, by their size in bytes."""

MIN_CHECKED_FRAMES = 6
"""Smallest number of different frames from which a checksum is recognised."""

MAX_CHECKED_FRAMES = 24
"""Largest number of different frames from which a checksum is recognised."""

N_FIRST_FRAMES = 4
"""Number of frames for which each checksum is computed first."""

MIN_FITTING_FIRST_FRAMES = 2
"""Smallest number of these first frames whose checksum must fit, before it is computed for the other frames."""

FITTING_SHARE = 0.75
"""Smallest share of frames whose checksum must fit, because some frames may be damaged."""

MAX_FIRST_COVERED_BYTE = 16
"""Largest position of the first byte that a checksum covers."""


ORDERS: tuple[ByteOrder, ...] = ("little", "big")
"""Byte orders that are tried."""


class Check(NamedTuple):
    """A checksum that fits.

    Attributes:
        size: Number of bytes; 0 if the frames have no checksum.
        order: Byte order.
        keys: Keys of the checksum in a device file.
    """

    size: int
    order: ByteOrder
    keys: dict[str, Any]


def find_checks(rows: Bytes) -> Iterator[Check]:
    """Yield the checksums that fit the frames, from the widest to the narrowest.

    The checksum is at the end of a frame. It covers the other bytes of the frame, but may leave out constant bytes at
    the beginning, such as a sync pattern. For each size and byte order, at most one checksum is yielded.

    Args:
        rows: Bytes of the frames, shape (n, length).
    """
    different_rows = np.unique(rows, axis=0)

    # The frames are drawn at random, because neighbours in the sorted array differ in a few bits only.
    drawn = np.random.default_rng(0).permutation(len(different_rows))[:MAX_CHECKED_FRAMES]
    checked_rows = different_rows[drawn]
    if len(checked_rows) < MIN_CHECKED_FRAMES:
        return
    _usual, is_constant = usual_bytes(checked_rows)
    length = len(is_constant)
    frames = [row.tobytes() for row in checked_rows]
    # Number of constant bytes at the beginning: the position of the first False
    leading_constant_count = int(np.argmin([*is_constant[:MAX_FIRST_COVERED_BYTE], False]))
    for size in UNNAMED_CRCS:
        is_too_wide = size + 2 > length  # at least two bytes must remain
        if is_too_wide or is_constant[-size:].all():
            continue
        last_begin = min(leading_constant_count, length - size - 1)
        for order in ORDERS[:size]:  # a single byte has no byte order
            named_checks = _named_checks(frames, size, order, range(last_begin + 1))
            unnamed_checks = _unnamed_checks(frames, size, order)
            all_checks = chain(named_checks, unnamed_checks)
            yield from islice(all_checks, 1)  # the first check that fits


def _named_checks(frames: list[bytes], size: int, order: ByteOrder, begins: range) -> Iterator[Check]:
    """Yield the named checksums that fit, and the position of the first byte that each of them covers.

    Args:
        frames: The frames, which are of one length.
        size: Number of bytes of the checksum.
        order: Byte order of the checksum.
        begins: Positions of the first covered byte that are tried.
    """
    names = [name for name, checksum in CHECKSUMS.items() if checksum.size == size]
    for begin in begins:
        for name in names:
            if _fits(CHECKSUMS[name].compute, frames, begin, size, order):
                keys: dict[str, Any] = {"checksum": name}
                if begin > 0:
                    keys["checksum_from"] = begin
                yield Check(size, order, keys)


def _fits(compute: Callable[[bytes], int], frames: list[bytes], begin: int, size: int, order: ByteOrder) -> bool:
    """Return whether most frames end with their checksum.

    If it fits too few of the first frames, the other frames are not examined, which saves time.

    Args:
        compute: Function that computes the checksum of bytes.
        frames: The frames, which are of one length.
        begin: Position of the first byte that the checksum covers.
        size: Number of bytes of the checksum.
        order: Byte order of the checksum.
    """

    def count_fitting(some_frames: list[bytes]) -> int:
        """Return the number of frames whose computed checksum is the checksum that was sent."""
        return sum(compute(frame[begin:-size]) == int.from_bytes(frame[-size:], order) for frame in some_frames)

    if count_fitting(frames[:N_FIRST_FRAMES]) < MIN_FITTING_FIRST_FRAMES:
        return False
    return count_fitting(frames) >= FITTING_SHARE * len(frames)


def _unnamed_checks(frames: list[bytes], size: int, order: ByteOrder) -> Iterator[Check]:
    """Yield the cyclic redundancy checks that fit, described by their parameters.

    With the right polynomial, the computed and the sent value differ by the same constant in all frames. The constant
    is stored as the final value of the check.

    Args:
        frames: The frames, which are of one length.
        size: Number of bytes of the checksum.
        order: Byte order of the checksum.
    """
    for crc in UNNAMED_CRCS[size]:
        differences: Counter[int] = Counter()
        for frame in frames:
            computed = crc(frame[:-size])
            sent = int.from_bytes(frame[-size:], order)
            differences[computed ^ sent] += 1
        final, count = differences.most_common(1)[0]
        if count >= FITTING_SHARE * len(frames):
            parameters = {
                "width": crc.width,
                "reflected": crc.reflected,
                "polynomial": f"{crc.polynomial:0{2 * size}X}",
                "final": f"{final:0{2 * size}X}",
            }
            yield Check(size, order, {"checksum": parameters})
