"""Classes that all frame formats use: the frame, base classes of parsers, counters, and columns of a row of numbers.

A parser converts bytes to frames, and is independent of the source of the bytes. The frames and counters do not depend
on how the bytes are divided into chunks. The memory of a parser is bounded for any input.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from isocharge.serve.flags import GAP, REPEAT, RESTART

SEQ_MODULUS = 1 << 16
"""Value at which a 16-bit frame counter wraps to 0."""

T_US_MODULUS = 1 << 32
"""Time at which a 32-bit clock in microseconds wraps to 0, us."""

SATURATED_BIT = 0x01
"""Bit in the flags of a frame that reports an amplifier at its limit. The other bits are reserved and sent as zero."""

SEQ = "seq"
"""Name of the field with the frame counter."""

FLAGS = "flags"
"""Name of the field with the flags of a frame."""

TIMES_US = {"t_us": 1.0, "t_ms": 1e3, "t_s": 1e6}
"""Names of the field with the clock of a device, and the unit of each, us."""

Raw = TypeVar("Raw")
"""Type of the data from which a frame is decoded: bytes, or the numbers of a row."""


class SequenceGaps:
    """Uses the frame counters to detect missing frames, repeated frames and restarts of the board.

    Attributes:
        lost: Number of frames that are missing between received frames.
        repeated: Number of frames with the same counter as the previous frame.
        restarts: Number of times that the counter went back, for example after a reset of the device. Frames that were
            lost during a restart are not counted.
    """

    def __init__(self) -> None:
        """Begin without a frame."""
        self.lost = 0
        self.repeated = 0
        self.restarts = 0
        self._last_seq: int | None = None

    def reset(self) -> None:
        """Treat the next frame as the first frame of a new connection. No gap is then counted before this frame.

        The counters are kept.
        """
        self._last_seq = None

    def update(self, seq: int | None, modulus: int = SEQ_MODULUS) -> tuple[str, ...]:
        """Count the next frame.

        Args:
            seq: Counter of the frame; None if the format has no counter.
            modulus: Value at which the counter wraps to 0.

        Returns:
            Flags of the frame: empty, or one of `gap`, `repeat` and `restart` (see `isocharge.serve.flags`).
        """
        if seq is None:
            return ()
        last_seq = self._last_seq
        self._last_seq = seq
        if last_seq is None:
            return ()
        step = (seq - last_seq) % modulus  # from 0 to modulus - 1, also if the counter has wrapped
        if step == 1:
            return ()
        if step == 0:
            self.repeated += 1
            return (REPEAT,)
        if step >= modulus // 2:  # the counter went back
            self.restarts += 1
            return (RESTART,)
        self.lost += step - 1
        return (GAP,)


class CounterWrap:
    """Learns the value at which a counter in text wraps to 0, because text does not show the width of a counter.

    If the counter decreases, it has either wrapped or restarted. A wrap is assumed if a usual modulus explains the
    decrease. The modulus must be larger than all previous values, and the step modulo this modulus must be about as
    small as the previous steps.
    """

    def __init__(self, usual_moduli: Iterable[int], initial_modulus: int, max_steps: int) -> None:
        """Begin without any value.

        Args:
            usual_moduli: Moduli that boards use, in ascending order.
            initial_modulus: Modulus to assume until the counter wraps.
            max_steps: Largest step across a wrap, as a multiple of the previous step.
        """
        self._usual_moduli = tuple(usual_moduli)
        self._modulus = initial_modulus
        self._max_steps = max_steps
        self._last_value: int | None = None
        self._last_step = 1  # the latest increase
        self._largest_value = 0

    def update(self, value: int | None) -> int:
        """Process the next value of the counter, and return the modulus.

        Args:
            value: The value; None if a connection has ended.

        Returns:
            The modulus that was learned, or the initial modulus before the first wrap.
        """
        last_value = self._last_value
        self._last_value = value
        if value is None or last_value is None:
            return self._modulus
        if value < last_value:
            self._modulus = self._modulus_after_decrease(value - last_value)
        elif value > last_value:
            self._last_step = value - last_value
        self._largest_value = max(self._largest_value, value)
        return self._modulus

    def _modulus_after_decrease(self, step: int) -> int:
        """Return the smallest usual modulus that explains a negative step.

        If no modulus explains the step, the present modulus is returned.

        A modulus explains the step if it is larger than all values, and if the step modulo the modulus is at most
        `max_steps` times the previous step.

        Args:
            step: Present value minus previous value, negative.
        """
        max_step = self._max_steps * self._last_step
        for modulus in self._usual_moduli:
            step_across_wrap = step % modulus  # positive, although `step` is negative
            has_plausible_step = step_across_wrap <= min(max_step, modulus // 2)
            if self._largest_value < modulus and has_plausible_step:
                return modulus
        return self._modulus


@dataclass(frozen=True, slots=True)
class Frame:
    """One reading of a sensor.

    Attributes:
        seq: Frame counter, modulo the `seq_modulus` of the parser; None if the format has no counter.
        t_us: Clock of the device, us, modulo the `t_us_modulus` of the parser; None if the format has no clock.
        values: One value for each channel, in the unit of the device. In the binary frame of isocharge, the unit is pC.
        flags: Bits; see `SATURATED_BIT`.
        names: Names of the channels; empty if the format has no names.
    """

    seq: int | None
    t_us: int | None
    values: tuple[float, ...]
    flags: int = 0
    names: tuple[str, ...] = ()


@dataclass(slots=True)
class FrameCounts:
    """Counters of a parser. A piece is a sequence of bytes that should be a frame, such as a line of text.

    Attributes:
        frames: Number of intact frames.
        crc_errors: Number of pieces with a wrong checksum.
        malformed: Number of pieces that were rejected for another reason, such as a wrong length.
        bytes_dropped: Number of bytes in the rejected pieces, including their delimiters.
        resyncs: Number of intact frames that followed dropped bytes.
        is_out_of_sync: Whether bytes were dropped since the last intact frame.
    """

    frames: int = 0
    crc_errors: int = 0
    malformed: int = 0
    bytes_dropped: int = 0
    resyncs: int = 0
    is_out_of_sync: bool = False

    def count_frame(self) -> None:
        """Count an intact frame."""
        self.frames += 1
        if self.is_out_of_sync:
            self.resyncs += 1
        self.is_out_of_sync = False

    def count_rejected(self, size: int, *, wrong_checksum: bool = False) -> None:
        """Count a rejected piece.

        Args:
            size: Length of the piece with its delimiter, bytes.
            wrong_checksum: Whether the piece was rejected because of its checksum.
        """
        if wrong_checksum:
            self.crc_errors += 1
        else:
            self.malformed += 1
        self.count_dropped(size)

    def count_dropped(self, size: int) -> None:
        """Count dropped bytes."""
        self.bytes_dropped += size
        if size > 0:
            self.is_out_of_sync = True


class ChecksumError(ValueError):
    """The checksum of a piece is wrong. The parser counts it."""


class Columns:
    """Meaning of the numbers of a row: frame counter, clock, flags, or channel.

    Args:
        names: Names of all numbers; an empty text for a number without a name.
        scales: Factor by which each number is multiplied, in the unit of the field per count.
        flags: Position of the number that contains the flags; None if there is no such number.

    Attributes:
        seq: Position of the frame counter; None if there is none.
        time: Position of the clock; None if there is none.
        time_unit_us: Unit of the clock, us.
        channels: Position and factor of each channel.
        names: Names of the channels; empty if they have no names.
    """

    def __init__(self, names: Sequence[str], scales: Sequence[float], flags: int | None = None) -> None:
        """Find the columns of the frame counter, of the clock and of the channels by their names.

        If there are several clocks, the first in the order of `TIMES_US` is used. Each column that is neither a
        counter, nor a clock, nor the flags is a channel.

        Args:
            names: Names of all columns; an empty text for a column without a name.
            scales: Factor by which the numbers of each column are multiplied.
            flags: Position of the column with the flags; None if there is no such column.
        """
        clock_columns = [names.index(name) for name in TIMES_US if name in names]
        self.seq = names.index(SEQ) if SEQ in names else None
        self.time = clock_columns[0] if clock_columns else None
        self.time_unit_us = 1.0
        if self.time is not None:
            clock_name = names[self.time]
            self.time_unit_us = TIMES_US[clock_name] * scales[self.time]

        other_columns = {self.seq, flags, *clock_columns}
        self.channels = [(column, scale) for column, scale in enumerate(scales) if column not in other_columns]
        self.names: tuple[str, ...] = ()
        if any(names):
            self.names = tuple(names[column] for column, _ in self.channels)
        self._flags = flags

    def frame(self, numbers: Sequence[Any]) -> Frame:
        """Return the frame of a row of numbers.

        Raises:
            ValueError, OverflowError: If the frame counter or the clock is not finite.
        """
        return Frame(
            seq=None if self.seq is None else round(numbers[self.seq]),
            t_us=None if self.time is None else round(numbers[self.time] * self.time_unit_us),
            values=tuple([numbers[position] * scale for position, scale in self.channels]),
            flags=0 if self._flags is None else int(numbers[self._flags]),
            names=self.names,
        )


class Parser(ABC):
    """Base class of all parsers, which convert bytes to frames.

    Attributes:
        counts: Counters since the parser was created.
    """

    def __init__(self, format: str, seq_modulus: int = SEQ_MODULUS, t_us_modulus: int = T_US_MODULUS) -> None:
        """Begin without bytes.

        Args:
            format: Description of the format, for the user.
            seq_modulus: Value at which the `seq` of a frame wraps to 0.
            t_us_modulus: Time at which the `t_us` of a frame wraps to 0, us.
        """
        self.format = format
        self.seq_modulus = seq_modulus
        self.t_us_modulus = t_us_modulus
        self.counts = FrameCounts()
        self._tail = b""

    @abstractmethod
    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that end within `data`. Bytes of an unfinished frame are stored for the next call."""

    def reset(self) -> None:
        """Drop the bytes of an unfinished frame, because the next bytes come from another connection."""
        self.counts.count_dropped(len(self._tail))
        self._tail = b""

    def _attempt(self, decode: Callable[[Raw], Frame], raw: Raw, size: int) -> list[Frame]:
        """Decode one frame and count it.

        Args:
            decode: Function that decodes a frame, and raises ValueError or OverflowError if `raw` is not a frame.
            raw: Argument of `decode`: bytes or numbers.
            size: Number of bytes that are dropped if `raw` is not a frame.

        Returns:
            A list with the frame; an empty list if `raw` is not a frame.
        """
        try:
            frame = decode(raw)
        except (ValueError, OverflowError) as error:
            self.counts.count_rejected(size, wrong_checksum=isinstance(error, ChecksumError))
            return []
        self.counts.count_frame()
        return [frame]


class DelimitedParser(Parser):
    """Base class of parsers for pieces between delimiters of one byte. Pieces longer than any frame are dropped.

    Args:
        delimiter: The byte after each piece.
        max_length: Length of the longest piece that is decoded, bytes.
        parser_arguments: Arguments of `Parser`.
    """

    def __init__(self, delimiter: bytes, max_length: int, *parser_arguments: Any) -> None:
        """Begin without bytes. The class describes the arguments."""
        super().__init__(*parser_arguments)
        self._delimiter = delimiter
        self._max_length = max_length
        self._is_overlong = False

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that end within `data`.

        Bytes after the last delimiter are stored for the next call. If the stored bytes are longer than any frame, they
        are dropped together with all bytes up to the next delimiter.
        """
        *pieces, tail = (self._tail + data).split(self._delimiter)
        frames = []
        for piece in pieces:
            # The first piece may be the end of overlong bytes, whose beginning was dropped by an earlier call.
            if self._is_overlong or len(piece) > self._max_length:
                self._is_overlong = False
                self.counts.count_rejected(len(piece) + 1)  # with the delimiter
            else:
                frames += self._parse_piece(piece)
        self._tail = tail
        if self._is_overlong or len(tail) > self._max_length:
            self._is_overlong = True
            super().reset()  # drops the tail
        return frames

    def reset(self) -> None:
        """Drop the bytes of an unfinished piece, because the next bytes come from another connection."""
        super().reset()
        self._is_overlong = False

    @abstractmethod
    def _parse_piece(self, piece: bytes) -> list[Frame]:
        """Return the frames that a piece completes. A piece that is rejected must be counted."""


class StuffedParser(DelimitedParser):
    """Parser of frames with byte stuffing. Every piece is a frame. Empty pieces are ignored.

    Args:
        delimiter: The byte after each frame.
        max_length: Length of the longest stuffed frame, bytes.
        decode: Function from the bytes of a piece to its frame. It raises ValueError if the piece is not a frame.
        parser_arguments: Arguments of `Parser`.
    """

    def __init__(
        self, delimiter: bytes, max_length: int, decode: Callable[[bytes], Frame], *parser_arguments: Any
    ) -> None:
        """Begin without bytes. The class describes the arguments."""
        super().__init__(delimiter, max_length, *parser_arguments)
        self._decode = decode

    def _parse_piece(self, piece: bytes) -> list[Frame]:
        if not piece:
            return []
        return self._attempt(self._decode, piece, len(piece) + 1)
