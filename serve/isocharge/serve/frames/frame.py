"""Classes that all frame formats share, such as the frame and the base classes of the parsers.

A parser converts bytes to frames, and is independent of the source of the bytes. Except for datagrams, the frames and
counters do not depend on the division of the bytes into chunks. A parser stores only a limited number of bytes, even if
it never finds a frame.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from cobs import cobs

from isocharge.common.arrays import Array
from isocharge.serve.flags import GAP, REPEAT, RESTART
from isocharge.serve.model.contact import Contact, Validity
from isocharge.serve.record.record import FollowedFilm, OtherContact, TrackedContact

SMALLEST_RESTART = 128
"""Smallest increase of a frame counter beyond the end of its range that is taken for a restart instead of a gap.

The value is half of the range of a counter of one byte. If the counter has more bytes, a gap of so many frames rarely
coincides with the end of the range. A restart while the counter is in the upper half of its range is more frequent.
"""

MAX_LATE_FRAMES = 8
"""Largest decrease of the frame counter at a late frame, for example if datagrams arrive in another order."""

SEQ_MODULUS = 1 << 16
"""Value at which a 16-bit frame counter wraps to 0."""

T_US_MODULUS = 1 << 32
"""Time at which a 32-bit clock in microseconds wraps to 0, us."""

SATURATED_BIT = 0x01
"""Bit in the flags of a frame that reports an amplifier at its limit. All other bits are reserved and sent as zero."""

SEQ = "seq"
"""Name of the field with the frame counter."""

FLAGS = "flags"
"""Name of the field with the flags of a frame."""

TIMES_US = {"t_us": 1.0, "t_ms": 1e3, "t_s": 1e6}
"""For each name of a clock field: duration of one count of the clock, us."""

OTHER_CHARGE_UNITS = ("fC", "nC", "µC", "μC", "uC", "C", "coulomb", "V", "mV", "uV", "µV", "μV", "volt", "volts")
"""Units other than pC that the names of channels and lines of text may state."""

Raw = TypeVar("Raw")
"""Type of the data from which a frame is decoded: bytes, or the numbers of a row."""


@dataclass(slots=True)
class Frame:
    """One reading of a sensor, on its way from the bytes to its record.

    A parser creates the frame. The clock of the stream sets some of the other attributes, and each later stage sets
    further attributes.

    Attributes:
        seq: Frame counter, modulo the `seq_modulus` of the parser; None if the format has no counter.
        t_us: Clock of the device, us, modulo the `t_us_modulus` of the parser; None if the format has no clock.
        values: One value for each channel, in the unit of the device. In the binary frame of isocharge, the unit is pC.
        bits: Flags that the device sends; see `SATURATED_BIT`.
        names: Names of the channels; empty if the format has no names.
        words: Words in the line of text, in their order; empty for other formats.
        host_s: Time of the host, unix seconds. The time is computed from the clock of the device, or from the arrival
            time if the device sends no clock. The time decreases only if a clock was set.
        device_us: Clock of the device after the wraps were removed, us; None if the device sends no clock.
        is_clock_reset: Whether the clock of the device jumped back by more than a second before this frame.
        dt_s: Time since the previous valid frame, s; 0 for the first frame of a device with a clock. This time does not
            depend on the wall clock of the host.
        intervals: Number of sampling intervals since the previous valid frame: 1 without a gap, and more if frames are
            missing or invalid. The number is 0 for a copy of the previous frame, and also for a late frame, because the
            late frame was already counted as missing. If the frames have no counter, no frame counts as missing.
        clock_s: Time of the frame on the clock of the device, s. If the device sends no clock, this is a time of the
            host that does not jump when the wall clock is set.
        sent: Values of the electrodes in their order, shape (n_electrode,), in the unit of the device.
        is_valid: Whether all values of the electrodes can be charges.
        raw_pC: Charges as the device sent them, shape (n_electrode,), pC.
        charge_pC: Charges after the stages that the frame has passed, shape (n_electrode,), pC. After all stages, they
            are the touch charges. None while there is no tare, and for an invalid frame.
        tare_pC: Charge at rest that was subtracted, shape (n_electrode,), pC; None without touch charges.
        noise_pC: Measured noise of the charges as a standard deviation, shape (n_electrode,), pC. It is the noise at
            rest, and grows during a touch if the board sends currents. It is set only if there is a tare.
        is_contact: Whether something touches the film.
        warming_pC: Part of the charges that is due to a warming of the film since the previous frame, shape
            (n_electrode,) or one number for all electrodes, pC. This part was subtracted from `charge_pC`.
        warming_error_pC: Charges that one standard deviation of the estimated warming adds, shape (n_electrode,), pC;
            None if no warming is estimated.
        base_relax_s: Time constant with which the charge out of contact decays to zero, s.
        is_base_held: Whether the tare follows the charge at rest and the warming. If so, the base of the touch
            detection does not decay as long as the base is the charge that remains of the latest touch.
        contact: The computed contact; None if nothing touches the film, or if the frame is invalid.
        contact_flags: Flags that state why the contact may be wrong.
        film: Estimated film; None if the film is not followed.
        tracked: The tracked contact; None if nothing touches the film, or if contacts are not tracked.
        event: Event that begins with the frame, such as `press` or `release`; None if no event begins.
        other: Another contact with the same charges, or None.
        flags: Flags of `isocharge.serve.flags` that do not depend on the contact.
    """

    seq: int | None
    t_us: int | None
    values: tuple[float, ...]
    bits: int = 0
    names: tuple[str, ...] = ()
    words: tuple[str, ...] = field(default=(), repr=False, compare=False)
    host_s: float = 0.0
    device_us: int | None = None
    is_clock_reset: bool = False
    dt_s: float = 0.0
    intervals: int = 1
    clock_s: float = 0.0
    sent: Array = field(init=False, repr=False, compare=False)
    is_valid: bool = True
    raw_pC: Array = field(init=False, repr=False, compare=False)
    charge_pC: Array | None = None
    tare_pC: Array | None = None
    noise_pC: Array = field(init=False, repr=False, compare=False)
    is_contact: bool = False
    warming_pC: Array | float = 0.0
    warming_error_pC: Array | None = None
    base_relax_s: float = math.inf
    is_base_held: bool = False
    contact: Contact | None = None
    contact_flags: tuple[str, ...] = ()
    film: FollowedFilm | None = None
    tracked: TrackedContact | None = None
    event: str | None = None
    other: OtherContact | None = None
    flags: list[str] = field(default_factory=list)

    def set_contact(self, contact: Contact, validity: Validity) -> None:
        """Set the contact, and the flags of the contact.

        Args:
            contact: The contact.
            validity: Domain in which the contact is valid.
        """
        self.contact = contact
        self.contact_flags = validity.flags(contact)


@dataclass(slots=True)
class FrameCounts:
    """Counters of a parser.

    A piece is a sequence of bytes that the parser expects to be one frame, such as a line of text.

    Attributes:
        frames: Number of intact frames.
        lost: Number of frames that are missing between received frames.
        repeated: Number of frames with the same counter as the previous frame.
        restarts: Number of times that the counter decreased without a wrap, for example after a reset of the device.
            If the format has no counter, the clock of the device is used instead. Frames that were lost during a
            restart are not counted.
        crc_errors: Number of pieces with a wrong checksum.
        malformed: Number of pieces that were rejected for another reason, such as a wrong length.
        bytes_dropped: Number of bytes in the rejected pieces, including their delimiters.
        reconnects: Number of outages of the port after which the stream has continued.
    """

    frames: int = 0
    lost: int = 0
    repeated: int = 0
    restarts: int = 0
    crc_errors: int = 0
    malformed: int = 0
    bytes_dropped: int = 0
    reconnects: int = 0

    def count_rejected(self, size: int, error: Exception | None = None) -> None:
        """Count bytes that the parser expected to be one frame, but has rejected.

        Args:
            size: Number of rejected bytes, including the delimiter.
            error: Error that the attempt to decode the bytes has raised.
        """
        if isinstance(error, ChecksumError):
            self.crc_errors += 1
        else:
            self.malformed += 1
        self.bytes_dropped += size


class ChecksumError(ValueError):
    """The checksum of a piece is wrong. The parser counts this error and continues."""


class Columns:
    """Meanings of the numbers in a row. Each number is the frame counter, a clock, the flags or a channel.

    Args:
        names: Names of all columns; an empty text for a column without a name.
        scales: Factor by which the numbers of each column are multiplied.
        flags_column: Index of the column with the flags; None if there is no such column.
        words: Words in the line of text.

    Attributes:
        seq_column: Index of the column with the frame counter; None if there is no such column.
        clock_column: Index of the column with the clock; None if there is no such column.
        clock_unit_us: Duration of one count of the clock, us.
        channels: For each channel, the index of its column and the factor by which its numbers are multiplied.
        names: Names of the channels; empty if they have no names.
    """

    def __init__(
        self,
        names: Sequence[str],
        scales: Sequence[float],
        flags_column: int | None = None,
        words: tuple[str, ...] = (),
    ) -> None:
        """Use the column names to find the columns of the frame counter, the clock and the channels.

        If there are several clocks, the first clock in the order of `TIMES_US` is used, and the other clocks are
        ignored. A column is a channel if it contains neither the counter, nor a clock, nor the flags.

        Args:
            names: Names of all columns; an empty text for a column without a name.
            scales: Factor by which the numbers of each column are multiplied.
            flags_column: Index of the column with the flags; None if there is no such column.
            words: Words in the line of text.
        """
        self._words = words
        self.seq_column = names.index(SEQ) if SEQ in names else None
        self.flags_column = flags_column

        # `TIMES_US` contains the unit of each clock, us, by the name of the clock, such as "t_ms".
        self.clock_column = next((names.index(name) for name in TIMES_US if name in names), None)
        self.clock_unit_us = 1.0
        if self.clock_column is not None:
            self.clock_unit_us = TIMES_US[names[self.clock_column]] * scales[self.clock_column]

        # All other columns are channels.
        self.channels = [
            (column, scale)
            for column, scale in enumerate(scales)
            if names[column] not in (SEQ, *TIMES_US) and column != flags_column
        ]
        channel_names = tuple(names[column] for column, _ in self.channels)
        self.names = channel_names if any(channel_names) else ()  # empty if no channel has a name

    def frame(self, numbers: Sequence[Any]) -> Frame:
        """Convert a row of numbers to a frame.

        Args:
            numbers: One number for each column.

        Raises:
            ValueError, OverflowError: If the frame counter, the clock or the flags are not a finite number, or if the
                row has no channel.
        """
        if not self.channels:
            raise ValueError("expected a channel")
        return Frame(
            seq=None if self.seq_column is None else round(numbers[self.seq_column]),
            t_us=None if self.clock_column is None else round(numbers[self.clock_column] * self.clock_unit_us),
            values=tuple([numbers[column] * scale for column, scale in self.channels]),  # faster than a generator
            bits=0 if self.flags_column is None else int(numbers[self.flags_column]),
            names=self.names,
            words=self._words,
        )


class Parser(ABC):
    """Base class of all parsers, which convert bytes to frames.

    Attributes:
        format: Description of the format, for the user.
        seq_modulus: Value at which the `seq` of a frame wraps to 0.
        t_us_modulus: Time at which the `t_us` of a frame wraps to 0, us.
        counts: Counters since the parser was created.
        recognised: Parser that has recognised the format, and can take the place of this parser; None without such a
            parser.
        unread_line: Latest line of text that does not have the layout of the frames; empty without such a line.
    """

    def __init__(self, format: str) -> None:
        """Set the counters to 0, and begin without bytes of an unfinished frame.

        Args:
            format: Description of the format, for the user.
        """
        self.format = format
        self.seq_modulus = SEQ_MODULUS  # value at which the frame counter of the board wraps to 0
        self.t_us_modulus = T_US_MODULUS  # time at which the clock of the board wraps to 0, us
        self.counts = FrameCounts()
        self.recognised: Parser | None = None  # parser of the format that this parser has recognised
        self.unread_line = ""  # latest line of text that is no frame, for messages to the user
        self._tail = b""  # bytes of an unfinished frame
        self._previous_seq: int | None = None  # counter of the latest frame of the connection

    @abstractmethod
    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that end within `data`. Bytes of an unfinished frame are stored for the next call."""

    def reset(self) -> None:
        """Drop the bytes of an unfinished frame, because the next bytes come from another connection.

        Frames that are lost between the two connections are not counted.
        """
        self.counts.bytes_dropped += len(self._tail)
        self._tail = b""
        self._previous_seq = None

    def sequence_flags(self, seq: int | None, *, is_clock_reset: bool = False) -> tuple[str, ...]:
        """Compare the counter of a frame with the counter of the previous frame, and return the flags of the frame.

        The flags depend on the increase of the counter since the previous frame. An increase of 1 means that no frame
        was lost. If the counter has not changed, the frame is a repetition. Any other small increase means that frames
        were lost. A small decrease means that the frame is late. Any other change means that the device has restarted.
        Lost frames, repeated frames and restarts are added to `counts`.

        Args:
            seq: Counter of the frame; None if the format has no counter.
            is_clock_reset: Whether the clock of the device was reset before this frame. If the counter also
                decreases, or the format has no counter, the device has restarted.

        Returns:
            Flags of the frame: empty, or one of `gap`, `repeat` and `restart` (see `isocharge.serve.flags`). A late
            frame has the flag `gap`.
        """
        if seq is None:
            self.counts.restarts += is_clock_reset
            return (RESTART,) if is_clock_reset else ()
        previous_seq = self._previous_seq
        self._previous_seq = seq
        if previous_seq is None:  # this is the first frame of a connection
            return ()
        increase = (seq - previous_seq) % self.seq_modulus  # from 0, also if the counter has wrapped
        if increase == 1:
            return ()
        if increase == 0:
            self.counts.repeated += 1
            return (REPEAT,)
        # An increase below `gap_limit` means that frames were lost.
        gap_limit = self.seq_modulus // 2
        if seq < previous_seq:  # the counter has wrapped, the device has restarted, or the frame is late
            # The counter has not wrapped if the clock was reset at the same time. It has not wrapped either if it had
            # reached `seq_modulus`, because the modulus is then wrong. In both cases, no increase counts as a gap. In
            # all other cases, a large increase across the end of the range is more probably a restart than a gap.
            cannot_wrap = is_clock_reset or previous_seq >= self.seq_modulus
            gap_limit = 0 if cannot_wrap else min(gap_limit, SMALLEST_RESTART)
        if increase < gap_limit:
            self.counts.lost += increase - 1
            return (GAP,)
        # A late frame was overtaken by a few others, and was counted as lost. Its counter is a little lower than the
        # previous counter. The first frames after a restart, which have low counters, are never taken for late frames.
        decrease = (previous_seq - seq) % self.seq_modulus
        if decrease <= MAX_LATE_FRAMES and seq > MAX_LATE_FRAMES and not is_clock_reset:
            self._previous_seq = previous_seq  # a late frame does not change the counter of the latest frame
            self.counts.lost = max(0, self.counts.lost - 1)
            return (GAP,)
        self.counts.restarts += 1
        return (RESTART,)

    def _try_decode(self, decode: Callable[[Raw], Frame], raw: Raw, dropped_size: int) -> list[Frame]:
        """Try to decode one frame, and count either an intact frame or rejected bytes.

        Args:
            decode: Function that decodes a frame. It raises ValueError or OverflowError if `raw` is not a frame.
            raw: Bytes or numbers that are passed to `decode`.
            dropped_size: Number of bytes that are counted as dropped if `raw` is not a frame.

        Returns:
            A list with the frame, to which callers add other frames; an empty list if `raw` is not a frame.
        """
        try:
            frame = decode(raw)
        except (ValueError, OverflowError) as error:
            self.counts.count_rejected(dropped_size, error)
            return []
        self.counts.frames += 1
        return [frame]


class DelimitedParser(Parser):
    """Base class of parsers that divide the bytes into pieces at a delimiter of one byte.

    A piece is a frame or a part of a frame, such as a line of text. Pieces that are too long are dropped.

    Args:
        format: Description of the format, for the user.
        delimiter: The byte after each piece.
        max_length: Length of the longest piece that is not dropped, bytes.
    """

    def __init__(self, format: str, delimiter: bytes, max_length: int) -> None:
        """Begin without bytes. The class describes the arguments."""
        super().__init__(format)
        self._delimiter = delimiter
        self._max_length = max_length

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that end within `data`.

        The bytes are divided into pieces at the delimiters. Pieces that are longer than `max_length` are dropped.

        The bytes after the last delimiter are an unfinished piece, the tail, which is stored for the next call. If the
        tail is longer than `max_length`, only its first `max_length + 1` bytes are stored, and its other bytes are
        dropped. The piece is therefore still too long when its end arrives.
        """
        *pieces, tail = (self._tail + data).split(self._delimiter)
        frames = []
        for piece in pieces:
            try:
                if len(piece) > self._max_length:
                    raise ValueError("the piece is too long")
                frames += self._parse_piece(piece)
            except (ValueError, OverflowError, cobs.DecodeError) as error:
                self.counts.count_rejected(len(piece) + 1, error)  # with the delimiter
        self._tail = tail[: self._max_length + 1]
        self.counts.bytes_dropped += len(tail) - len(self._tail)
        return frames

    @abstractmethod
    def _parse_piece(self, piece: bytes) -> list[Frame]:
        """Return the frames that the next piece completes, and count them.

        Args:
            piece: The bytes between two delimiters.

        Raises:
            ValueError, OverflowError, cobs.DecodeError: If the piece is rejected. The caller counts the rejected piece.
        """


class StuffedParser(DelimitedParser):
    """Parser of frames with byte stuffing. Between two delimiters, one frame or no bytes are expected.

    Args:
        format: Description of the format, for the user.
        delimiter: The byte after each frame.
        max_length: Length of the longest stuffed frame, bytes.
        decode: Function that decodes the bytes between two delimiters. It raises ValueError or `cobs.DecodeError` if
            they are not a frame.
    """

    def __init__(self, format: str, delimiter: bytes, max_length: int, decode: Callable[[bytes], Frame]) -> None:
        """Begin without bytes. The class describes the arguments."""
        super().__init__(format, delimiter, max_length)
        self._decode = decode

    def _parse_piece(self, piece: bytes) -> list[Frame]:
        """Decode the bytes between two delimiters, and return the frame in a list. Without bytes, the list is empty."""
        if not piece:
            return []
        frame = self._decode(piece)
        self.counts.frames += 1
        return [frame]
