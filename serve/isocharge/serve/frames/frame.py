"""What all frame formats share: the frame, the parser with its counters, rows of numbers, the numbers of frames.

Parsers know no port: bytes in, frames and counters out. However the bytes are cut into chunks, the frames and counters
are the same, and memory is bounded whatever comes. `SequenceGaps` finds gaps, repeats and restarts in the numbers of
frames, `CounterWrap` where a counter in text wraps.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from isocharge.serve.flags import GAP, REPEAT, RESTART

SEQ_MODULUS = 1 << 16
"""Number at which a counter of 16 bits wraps to 0."""


class SequenceGaps:
    """Follows the frame numbers.

    Attributes:
        lost: Frames missing between those that came.
        repeated: Frames with the number of the one before.
        restarts: Times that the numbers went back, as after a reset of the device; frames lost then are not counted.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.repeated = 0
        self.restarts = 0
        self._last: int | None = None

    def forget(self) -> None:
        """Start over: the next number is the first one of a new connection, and no gap."""
        self._last = None

    def update(self, seq: int | None, modulus: int = SEQ_MODULUS) -> tuple[str, ...]:
        """Count the next frame, and give its flags (see `isocharge.serve.flags`).

        Args:
            seq: Its number; None if the format has none.
            modulus: The number at which `seq` wraps to 0.
        """
        if seq is None:
            return ()
        step = 1 if self._last is None else (seq - self._last) % modulus
        self._last = seq
        if step == 1:
            return ()
        if step == 0:
            self.repeated += 1
            return (REPEAT,)
        if step >= modulus // 2:
            self.restarts += 1
            return (RESTART,)
        self.lost += step - 1
        return (GAP,)


class CounterWrap:
    """The number at which a counter in text wraps to 0: text does not say how wide a counter is.

    A counter that falls has wrapped if all it ever showed is below a usual modulus, and the step modulo that is no
    larger than its steps before. Otherwise it has begun anew.
    """

    def __init__(self, usual: Iterable[int], modulus: int, most_steps: int) -> None:
        """Set up the watch.

        Args:
            usual: Moduli that boards use, smallest first.
            modulus: That of a counter which has not wrapped yet.
            most_steps: Largest step over a wrap, in steps before.
        """
        self._usual, self._modulus, self._most_steps = tuple(usual), modulus, most_steps
        self._last: int | None = None
        self._step, self._largest = 1, 0

    def update(self, value: int | None) -> int:
        """Take the next value, None where a connection ends, and give the modulus as far as it is known."""
        last, self._last = self._last, value
        if value is None or last is None:
            return self._modulus
        if value < last:
            most = self._most_steps * self._step
            fits = (m for m in self._usual if self._largest < m and (value - last) % m <= min(most, m // 2))
            self._modulus = next(fits, self._modulus)
        elif value > last:
            self._step = value - last
        self._largest = max(self._largest, value)
        return self._modulus


SATURATED_BIT = 0x01
"""In a frame's flags: an amplifier is at its limit. The other bits are reserved and sent as zero."""

T_US_MODULUS = 1 << 32
"""Time at which a clock of 32 bits wraps to 0, us."""

SEQ, FLAGS = "seq", "flags"
"""Names under which a device sends the number of a frame, and its flags."""

TIMES_US = {"t_us": 1.0, "t_ms": 1e3, "t_s": 1e6}
"""Names under which a device sends its clock, with their units, us."""

Raw = TypeVar("Raw")
"""What a frame is decoded from: its bytes, or the numbers of a row."""


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

    def accept(self) -> None:
        """Count an intact frame."""
        self.frames += 1
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
        self.astray |= size > 0


class ChecksumError(ValueError):
    """The checksum of a piece does not fit; the parser counts it."""


class Columns:
    """What the numbers of a row are: frame number, clock and flags by their names, channels all others.

    Attributes:
        seq, time: Positions of number and clock; None without them.
        us: Unit of the clock, us.
        channels: Positions of the channels, with the value of one count.
        names: Names of the channels; empty if they have none.
    """

    def __init__(self, names: Sequence[str], scales: Sequence[float], flags: int | None = None) -> None:
        """Look up the names.

        Args:
            names: Of all numbers; empty texts for numbers without names.
            scales: Value of one count of each.
            flags: Position of the flags; None without them.
        """
        times = [names.index(name) for name in TIMES_US if name in names]
        self.seq = names.index(SEQ) if SEQ in names else None
        self.time = times[0] if times else None
        self.us = TIMES_US[names[times[0]]] * scales[times[0]] if times else 1.0
        self.channels = [(at, scale) for at, scale in enumerate(scales) if at not in (self.seq, flags, *times)]
        self.names = tuple(names[at] for at, _ in self.channels) if any(names) else ()
        self._flags = flags

    def frame(self, numbers: Sequence[Any]) -> Frame:
        """The frame of a row.

        Raises:
            ValueError, OverflowError: If number or clock is not finite.
        """
        return Frame(
            None if self.seq is None else round(numbers[self.seq]),
            None if self.time is None else round(numbers[self.time] * self.us),
            tuple([numbers[at] * scale for at, scale in self.channels]),
            0 if self._flags is None else int(numbers[self._flags]),
            self.names,
        )


class Parser(ABC):
    """Bytes in, frames out.

    Attributes:
        format: The format, for people.
        seq_modulus: The number at which a frame's `seq` wraps to 0.
        t_us_modulus: The time at which a frame's `t_us` wraps to 0, us.
        counts: The counters so far.
    """

    def __init__(self, format: str, seq_modulus: int = SEQ_MODULUS, t_us_modulus: int = T_US_MODULUS) -> None:
        """Begin without bytes."""
        self.format, self.seq_modulus, self.t_us_modulus = format, seq_modulus, t_us_modulus
        self.counts = FrameCounts()
        self._tail = b""

    @abstractmethod
    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`; the bytes after them wait for the next call."""

    def forget(self) -> None:
        """Drop what is unfinished: what comes next is from another connection."""
        self.counts.drop(len(self._tail))
        self._tail = b""

    def _attempt(self, decode: Callable[[Raw], Frame], raw: Raw, size: int) -> list[Frame]:
        """The frame that is decoded; one that is wrong is counted, with the bytes that it costs."""
        try:
            frame = decode(raw)
        except (ValueError, OverflowError) as error:
            self.counts.refuse(size, damaged=isinstance(error, ChecksumError))
            return []
        self.counts.accept()
        return [frame]


class DelimitedParser(Parser):
    """A parser of pieces between delimiters of one byte; a piece longer than any frame is dropped and counted."""

    def __init__(self, delimiter: bytes, longest: int, *about: Any) -> None:
        """Begin without bytes.

        Args:
            delimiter: The byte after a piece.
            longest: Length of the longest piece that is read, bytes.
            about: As `Parser` takes it.
        """
        super().__init__(*about)
        self._delimiter, self._longest = delimiter, longest
        self._is_overlong = False

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`; the bytes after the last delimiter wait for the next call."""
        *pieces, tail = (self._tail + data).split(self._delimiter)
        frames = []
        for piece in pieces:
            if self._is_overlong or len(piece) > self._longest:
                self._is_overlong = False
                self.counts.refuse(len(piece) + 1)
            else:
                frames += self._take(piece)
        self._tail = tail
        if self._is_overlong or len(tail) > self._longest:
            self._is_overlong = True
            super().forget()
        return frames

    def forget(self) -> None:
        """Drop what is unfinished: what comes next is from another connection."""
        super().forget()
        self._is_overlong = False

    @abstractmethod
    def _take(self, piece: bytes) -> list[Frame]:
        """The frames that a piece completes; what is none is counted."""


class StuffedParser(DelimitedParser):
    """A parser of frames with byte stuffing: each piece is a frame, and an empty one an idle line."""

    def __init__(self, delimiter: bytes, longest: int, decode: Callable[[bytes], Frame], *about: Any) -> None:
        """Begin without bytes; `decode` turns a piece into its frame, the other arguments are of `DelimitedParser`."""
        super().__init__(delimiter, longest, *about)
        self._decode = decode

    def _take(self, piece: bytes) -> list[Frame]:
        return self._attempt(self._decode, piece, len(piece) + 1) if piece else []
