"""What all frame formats share: the frame, the parser and its counters, and the cutting of bytes at a delimiter.

Parsers know no port: bytes in, frames and counters out. However the bytes are cut into chunks, the frames and counters
are the same, and memory is bounded whatever comes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

SATURATED_BIT = 0x01
"""In a frame's flags: an amplifier is at its limit. The other bits are reserved and sent as zero."""

T_US_MODULUS = 1 << 32
"""Time at which a clock of 32 bits wraps to 0, us."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One reading of a sensor.

    Attributes:
        seq: Counter of frames, modulo the parser's `seq_modulus`; None if the format has none.
        t_us: The device's clock, us, modulo the parser's `t_us_modulus`; None if the format has none.
        values: One value for each channel, in the device's unit; our binary frame has pC.
        flags: Bits; see `SATURATED_BIT`.
        names: Names of the channels; empty if the format has none.
    """

    seq: int | None
    t_us: int | None
    values: tuple[float, ...]
    flags: int = 0
    names: tuple[str, ...] = ()


@dataclass(slots=True)
class FrameCounts:
    """Counters of a parser.

    Attributes:
        frames: Intact frames.
        crc_errors: Pieces whose checksum did not fit.
        malformed: Pieces that were no frame for another reason: stuffing, length, version, not a number.
        bytes_dropped: Bytes of those pieces, with their delimiters.
        resyncs: Intact frames that came right after dropped bytes.
        astray: Whether bytes were dropped since the last intact frame.
    """

    frames: int = 0
    crc_errors: int = 0
    malformed: int = 0
    bytes_dropped: int = 0
    resyncs: int = 0
    astray: bool = False

    def accept(self, frames: int = 1) -> None:
        """Count intact frames."""
        self.frames += frames
        self.resyncs += self.astray
        self.astray = False

    def refuse(self, size: int, *, damaged: bool = False) -> None:
        """Count a dropped piece of `size` bytes; `damaged` if its checksum did not fit."""
        self.crc_errors += damaged
        self.malformed += not damaged
        self.drop(size)

    def drop(self, size: int) -> None:
        """Count dropped bytes."""
        self.bytes_dropped += size
        self.astray = True


class Parser(Protocol):
    """Bytes in, frames out."""

    @property
    def counts(self) -> FrameCounts:
        """The counters so far."""

    @property
    def seq_modulus(self) -> int:
        """The number at which a frame's `seq` wraps to 0."""

    @property
    def t_us_modulus(self) -> int:
        """The time at which a frame's `t_us` wraps to 0, us."""

    @property
    def format(self) -> str:
        """The format, for people."""

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`; the bytes after them wait for the next call."""

    def forget(self) -> None:
        """Drop what is unfinished: what comes next is from another connection."""


class Splitter:
    """Cuts bytes at a delimiter; pieces longer than any frame are dropped and counted, so memory is bounded."""

    def __init__(self, delimiter: bytes, longest: int, counts: FrameCounts) -> None:
        self._delimiter, self._longest, self._counts = delimiter, longest, counts
        self._tail = b""
        self._overlong = False

    def feed(self, data: bytes) -> Iterator[bytes]:
        """The pieces that end within `data`, without delimiter; a dropped one is counted when its turn comes."""
        *pieces, self._tail = (self._tail + data).split(self._delimiter)
        for piece in pieces:
            if self._fits(piece):
                yield piece
        if self._overlong or len(self._tail) > self._longest:
            self._overlong = True
            self._counts.drop(len(self._tail))
            self._tail = b""

    def forget(self) -> None:
        """Drop what is unfinished."""
        if self._tail:
            self._counts.drop(len(self._tail))
        self._tail = b""

    def _fits(self, piece: bytes) -> bool:
        if not self._overlong and len(piece) <= self._longest:
            return True
        self._overlong = False
        self._counts.refuse(len(piece) + len(self._delimiter))
        return False
