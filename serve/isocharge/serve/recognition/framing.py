"""Recognition of where the frames in a stream begin, how long they are, and which checksum they have.

Byte stuffing is an encoding that marks the ends of frames with a delimiter. A stream with byte stuffing is split at its
delimiters. In a stream without byte stuffing, some bytes are usually the same in every frame, and repeat at a distance
of one frame length. For each repeated pair of bytes, frames are assumed to begin at every repetition. The program
chooses the pair whose frames would cover the largest part of the stream. The position of the chosen pair within a frame
is determined later.

All checksums with a name are tried for every possible position of the first byte that they cover.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from cobs import cobs
from numpy.typing import NDArray

from isocharge.serve.frames.frame_layout import DATAGRAM, SYNC, ByteOrder, Framing
from isocharge.serve.frames.transmission import CHECKSUMS, STUFFINGS, Stuffing

Bytes = NDArray[np.uint8]

MIN_FRAME_BYTES = 4
"""Shortest frame that is recognised, bytes."""

MAX_FRAME_BYTES = 256
"""Longest frame that is recognised, bytes."""

MIN_FRAMES = 5
"""Smallest number of frames from which a format is recognised."""

MAX_EXAMINED_BYTES = 1 << 16
"""Largest number of bytes of a stream that are examined."""

INTACT_SHARE = 0.75
"""Smallest share of frames, steps or bytes that must agree with a description, because some frames may be damaged."""

COVERED_SHARE = 0.4
"""Smallest share of a stream that frames of one length must cover, dimensionless."""

MAX_CONSTANT_BYTES = 16
"""Largest number of constant bytes that are tried as the first byte of a frame, or as the first under a checksum."""


class FrameDivision(NamedTuple):
    """Division of a stream into frames of the same length.

    Attributes:
        framing: Kind of framing, as in device files.
        stream: All bytes of the stream, shape (n,).
        starts: One position in the stream for each frame, shape (frames,). All positions have the same distance from
            the beginnings of their frames.
        length: Number of bytes in a frame.
    """

    framing: Framing
    stream: Bytes
    starts: NDArray[np.int64]
    length: int

    @property
    def covered_share(self) -> float:
        """Share of the bytes of the stream that belong to frames, dimensionless."""
        return min(1.0, len(self.starts) * self.length / len(self.stream))

    def rows(self, distance: int = 0, next_bytes: int = 0) -> Bytes:
        """Return the bytes of the frames, shape (frames, length + next_bytes).

        A frame is left out if its bytes and the next bytes do not all lie within the stream.

        Args:
            distance: Distance from `starts` to the beginnings of the frames, bytes.
            next_bytes: Number of bytes behind each frame that are also returned.
        """
        starts = self.starts + distance
        width = self.length + next_bytes
        whole_starts = starts[starts + width <= len(self.stream)]
        positions = whole_starts[:, None] + np.arange(width)  # of all bytes of each frame, shape (frames, width)
        return np.asarray(self.stream[positions])


def usual_bytes(rows: Bytes) -> tuple[Bytes, NDArray[np.bool_]]:
    """Return the most frequent byte at each position of a frame, and whether nearly all frames have this byte there.

    Args:
        rows: Bytes of the frames, shape (n, length).

    Returns:
        Two arrays of shape (length,): the most frequent bytes, and whether each of these bytes is constant.
    """
    usual = np.array([np.bincount(column).argmax() for column in rows.T], np.uint8)
    share_of_frames = (rows == usual).mean(axis=0)
    return usual, share_of_frames >= INTACT_SHARE


def count_leading(are_true: NDArray[np.bool_]) -> int:
    """Return the number of true elements before the first false element, at most `MAX_CONSTANT_BYTES`."""
    return int(np.argmin([*are_true[:MAX_CONSTANT_BYTES], False]))


def possible_divisions(chunks: Sequence[bytes], *, are_datagrams: bool) -> Iterator[Iterable[FrameDivision]]:
    """For each kind of framing, yield all possible divisions of a stream into frames as one group.

    The kinds of framing are yielded from the most certain to the least certain kind. Datagrams of whole frames are the
    most certain kind, followed by frames with byte stuffing. Frames that begin at a repeated byte or pair of bytes are
    the least certain kind.

    Args:
        chunks: The bytes of the stream.
        are_datagrams: Whether each chunk is a datagram, which contains one or several whole frames.
    """
    data = b"".join(chunks)[:MAX_EXAMINED_BYTES]
    if are_datagrams:
        # The length of a frame divides the lengths of nearly all datagrams. A line feed may follow the frames in the
        # other datagrams; see `DatagramParser`.
        divisions = []
        for length in range(MIN_FRAME_BYTES, MAX_FRAME_BYTES + 1):
            whole_datagrams = [chunk for chunk in chunks if len(chunk) % length == 0]
            if len(whole_datagrams) >= INTACT_SHARE * len(chunks):
                divisions.append(_adjacent_frames(DATAGRAM, b"".join(whole_datagrams)[:MAX_EXAMINED_BYTES], length))
        yield divisions
    for name, stuffing in STUFFINGS.items():
        yield _stuffed_frames(name, stuffing, data)
    yield _synchronised_frames(data)


def _adjacent_frames(framing: Framing, data: bytes, length: int) -> FrameDivision:
    """Divide a stream that consists only of whole frames of one length into its frames.

    Args:
        framing: Kind of framing, which is stored in the result.
        data: Bytes of the stream.
        length: Length of each frame, bytes.
    """
    return FrameDivision(framing, np.frombuffer(data, np.uint8), np.arange(0, len(data), length), length)


def _stuffed_frames(name: Framing, stuffing: Stuffing, data: bytes) -> Iterator[FrameDivision]:
    """Decode a stream with a byte stuffing. If most of the decoded frames have the same length, yield these frames.

    A byte stuffing is an encoding that marks the ends of frames with a delimiter. At most one division is yielded.

    Args:
        name: Name of the byte stuffing.
        stuffing: Delimiter and functions of the byte stuffing.
        data: Bytes of the stream.
    """
    # The first and the last frame may be incomplete, and nothing is between two adjacent delimiters.
    encoded_frames = [frame for frame in data.split(stuffing.delimiter)[1:-1] if frame]
    decoded_frames = []
    for encoded_frame in encoded_frames:
        with suppress(ValueError, cobs.DecodeError):  # the frame is damaged, because no encoder produces it
            decoded_frames.append(stuffing.decode(encoded_frame))
    length, count = _most_common_length(decoded_frames)
    has_frame_length = MIN_FRAME_BYTES <= length <= MAX_FRAME_BYTES
    if count < INTACT_SHARE * len(encoded_frames) or not has_frame_length:  # most frames have no common length
        return

    # If the lengths are as regular without decoding, there is no stuffing, and the delimiter is a byte that only
    # happens to begin every frame. COBS is an exception, because it adds the same number of bytes to all frames of one
    # length.
    _, count_without_decoding = _most_common_length(encoded_frames)
    if name == "cobs" or count > count_without_decoding:
        frames = [frame for frame in decoded_frames if len(frame) == length]
        yield _adjacent_frames(name, b"".join(frames), length)


def _most_common_length(frames: Sequence[bytes]) -> tuple[int, int]:
    """Return the most frequent length of the frames, and the number of frames with this length.

    The length and the number are 0 if there are no frames.
    """
    return max(Counter(map(len, frames)).items(), key=itemgetter(1), default=(0, 0))


def _synchronised_frames(data: bytes, max_count: int = 3) -> Iterator[FrameDivision]:
    """Yield divisions of a stream into frames that begin at a repeated byte or a repeated pair of bytes.

    If a byte or a pair of bytes is the same in every frame, it repeats at a distance of one frame length. Frames are
    therefore assumed to begin at every repetition of a byte or pair. For each frame length, the byte or pair whose
    frames would cover the largest share of the stream is chosen. Only the divisions with the largest shares are
    yielded, because it takes long to examine a division.

    Args:
        data: Bytes of the stream.
        max_count: Largest number of divisions.
    """
    stream = np.frombuffer(data, np.uint8)
    single_bytes = stream.astype(int)
    pairs = 256 * single_bytes[:-1] + single_bytes[1:]

    # A code is the number of a byte or of a pair. For each length of a frame, frames may begin at all positions of one
    # code at which the same code follows at the distance of this length. The code with the most such positions is
    # chosen.
    division_of_length: dict[int, FrameDivision] = {}
    for codes in (pairs, single_bytes):
        # All positions of the smallest code in ascending order, then those of the next code, and so on. The difference
        # of two adjacent positions is the distance between two occurrences of a code, unless the codes differ.
        positions_by_code = np.argsort(codes, kind="stable")
        has_same_code = np.diff(codes[positions_by_code]) == 0
        distances = np.where(has_same_code, np.diff(positions_by_code), 0)
        for length in range(MIN_FRAME_BYTES, MAX_FRAME_BYTES + 1):
            starts = positions_by_code[:-1][distances == length]  # the last position has no distance to a next one
            best_code = np.bincount(codes[starts], minlength=1).argmax()  # 0 if there are no positions
            division = FrameDivision(SYNC, stream, starts[codes[starts] == best_code], length)
            # Pairs are examined first, without an earlier division to compare with. Of equal shares, `max` returns the
            # first division, which is that of the pair.
            earlier_division = division_of_length.get(length, division)
            division_of_length[length] = max(earlier_division, division, key=lambda division: division.covered_share)

    # The largest shares come first. They are rounded to 0.1, so that of two lengths with about equal shares the shorter
    # length comes first.
    frequent = [division for division in division_of_length.values() if division.covered_share > COVERED_SHARE]
    yield from sorted(frequent, key=lambda division: (-round(division.covered_share, 1), division.length))[:max_count]


ORDERS: tuple[ByteOrder, ...] = ("little", "big")
"""Byte orders that are tried."""


class Check(NamedTuple):
    """A checksum at the end of each frame.

    Attributes:
        name: Name of the checksum; "none" if the frames have no checksum.
        order: Byte order of the checksum.
        start: First byte that the checksum covers.
    """

    name: str = "none"
    order: ByteOrder = "little"
    start: int = 0

    @property
    def size(self) -> int:
        """Number of bytes of the checksum."""
        return CHECKSUMS[self.name].size

    def is_correct(self, frame: bytes) -> bool:
        """Return whether the checksum at the end of a frame is correct for the other bytes of the frame."""
        computed = CHECKSUMS[self.name].compute(frame[self.start : -self.size])
        return computed == int.from_bytes(frame[-self.size :], self.order)


def find_checks(rows: Bytes) -> Iterator[Check]:
    """Yield the checksums that fit the frames, from the widest to the narrowest checksum.

    A checksum consists of the last bytes of a frame, and covers the bytes before them. Constant bytes at the beginning,
    such as a sync pattern, need not be covered. For each size and byte order, at most one checksum is yielded. If there
    are fewer than `MIN_FRAMES` different frames, no checksum is yielded.

    Args:
        rows: Bytes of the frames, shape (n, length).
    """
    # `np.unique` sorts the different frames. The first frames differ in a few bits only, so that a wrong checksum could
    # fit all of them by chance. At most 24 frames are therefore drawn at random.
    checked_rows = np.random.default_rng(0).permutation(np.unique(rows, axis=0))[:24]
    if len(checked_rows) < MIN_FRAMES:
        return
    frames = [row.tobytes() for row in checked_rows]
    _usual, is_constant = usual_bytes(checked_rows)  # `is_constant` has the shape (length,)
    for size in (4, 3, 2, 1):  # in bytes
        if is_constant[-size:].all():  # a checksum would differ from frame to frame
            continue
        # The first covered byte may be each of the constant bytes at the beginning of the frame, or the first byte that
        # is not constant. A checksum covers at least two bytes, which stand before its own `size` bytes.
        last_possible_start = min(count_leading(is_constant), len(is_constant) - size - 2)
        names = [name for name, checksum in CHECKSUMS.items() if checksum.size == size]
        orders = ORDERS if size > 1 else ORDERS[:1]  # a single byte has no byte order
        for order in orders:
            candidates = (Check(name, order, start) for start in range(last_possible_start + 1) for name in names)
            check = next((candidate for candidate in candidates if _fits(candidate, frames)), None)
            if check is not None:
                yield check


def _fits(check: Check, frames: Sequence[bytes]) -> bool:
    """Return whether a checksum is correct in nearly all frames. Some frames may be damaged."""
    correct_count = sum(map(check.is_correct, frames))
    return correct_count >= INTACT_SHARE * len(frames)
