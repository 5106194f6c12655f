"""Frames whose layout a device file describes: a sync pattern, fields of fixed size, and a checksum.

    [frames]
    format = "described"
    framing = "sync"               # or "cobs", "slip", "hdlc", "datagram"; optional
    sync = "20 4E"                 # hexadecimal; optional with another framing
    length = 16                    # of the whole frame, bytes, without stuffing; checked against the fields
    byte_order = "little"          # or "big"; optional
    checksum = "crc-16/modbus"     # a name of `isocharge.serve.frames.checksums`, or the parameters of a CRC:
                                   # {width = 16, polynomial = "1021", start = "FFFF", reflected = false, final = "0"}
    checksum_from = 0              # first byte that it covers; optional
    checksum_order = "little"      # optional; the default is the byte order of the fields
    fields = [                     # in their order, from after the sync to before the checksum
        {name = "Fx", type = "i16", scale = 0.01},
        ...
    ]

The section above lists all keys of such a frame. The types of the fields are u8, u16, u24, u32, i8, i16, i24, i32, f32,
f64 and `pad`. Padding is either `count` bytes without a meaning, or a `value` in hexadecimal that every frame must
have, such as its length. A field named `seq` is the frame counter, `t_us`, `t_ms` or `t_s` is the clock, and `flags`
contains the bits of `isocharge.serve.frames.frame`. All other fields are channels.

If the checksum of a frame with a sync pattern is wrong, the parser searches for the pattern again from the next byte.
The pattern may have occurred by chance inside the data, and an intact frame may begin there. Stuffed frames end at
their delimiter, and a datagram contains only whole frames. If a piece or a datagram is damaged, all of it is dropped.
"""

import struct
from functools import cached_property
from typing import Annotated, Any, Literal

from msgspec import Meta, field

from isocharge.common.structs import Settings, WrongKey
from isocharge.serve.frames.checksums import CHECKSUMS, Checksum, Crc
from isocharge.serve.frames.frame import (
    FLAGS,
    SEQ,
    SEQ_MODULUS,
    T_US_MODULUS,
    TIMES_US,
    ChecksumError,
    Columns,
    Frame,
    Parser,
    StuffedParser,
)
from isocharge.serve.frames.frame_field import PADDING, ByteOrder, Field, Hexadecimal
from isocharge.serve.frames.stuffing import STUFFINGS

MAX_REQUEST_RATE_Hz = 100_000.0
"""Highest rate of requests, Hz."""

SYNC = "sync"
"""Framing in which a frame begins with its sync pattern."""

DATAGRAM = "datagram"
"""Framing in which a datagram contains one or more whole frames."""

Framing = Literal["sync", "cobs", "slip", "hdlc", "datagram"]
HexadecimalNumber = Annotated[
    str, Meta(pattern="^[0-9A-Fa-f]{1,8}$", description="a number in hexadecimal, as in '1021'")
]


class CrcParameters(Settings, frozen=True):
    """Parameters of a cyclic redundancy check that has no name; see `isocharge.serve.frames.checksums.Crc`."""

    width: Literal[8, 16, 24, 32]
    polynomial: HexadecimalNumber
    start: HexadecimalNumber = "0"
    reflected: bool = False
    final: HexadecimalNumber = "0"

    def __post_init__(self) -> None:
        for key in ("polynomial", "start", "final"):
            if int(getattr(self, key), 16) >> self.width:
                raise WrongKey(key, f"a number of {self.width} bits in hexadecimal, as in '1021'", getattr(self, key))

    @property
    def checksum(self) -> Checksum:
        """The checksum with these parameters."""
        crc = Crc(
            width=self.width,
            polynomial=int(self.polynomial, 16),
            start=int(self.start, 16),
            reflected=self.reflected,
            final=int(self.final, 16),
        )
        return Checksum(crc, self.width // 8)


class FrameSection(Settings, frozen=True, tag_field="format"):
    """Keys that the section `[frames]` has for every format. They describe requests to the board.

    Attributes:
        request: Bytes to send for each frame, in hexadecimal; None for a board that sends frames by itself.
        request_Hz: Largest number of requests per second.
        echo: Whether the line returns every byte that is sent, so that the request has to be removed from the answer.
    """

    request: Hexadecimal | None = None
    request_Hz: Annotated[float, Meta(gt=0, le=MAX_REQUEST_RATE_Hz)] = 100.0
    echo: bool = False


class FrameLayout(FrameSection, frozen=True, tag="described", dict=True, kw_only=True):
    """The layout of a frame. The attributes are keys of the section `[frames]`.

    Attributes:
        length: Length of the whole frame without stuffing, bytes.
        fields_and_padding: Fields of the frame, including padding.
        framing: How one frame is separated from the next.
        sync_bytes: Bytes with which every frame begins, in hexadecimal.
        byte_order: Byte order of the fields.
        checksum: Name of the checksum, or parameters of a CRC.
        checksum_from: First byte that the checksum covers.
        checksum_order: Byte order of the checksum; None means the byte order of the fields.
    """

    length: int
    fields_and_padding: tuple[Field, ...] = field(name="fields")
    framing: Framing = "sync"
    sync_bytes: Hexadecimal | None = field(name="sync", default=None)
    byte_order: ByteOrder = "little"
    checksum: str | CrcParameters = "none"
    checksum_from: Annotated[int, Meta(ge=0)] = 0
    checksum_order: ByteOrder | None = None

    def __post_init__(self) -> None:
        """Check that the fields form a frame, and that the length and the checksum fit the fields.

        Raises:
            WrongKey: For the first key that is missing or not valid.
        """
        names = [field.name for field in self.fields]
        if isinstance(self.checksum, str) and self.checksum not in CHECKSUMS:
            raise WrongKey("checksum", f"one of {', '.join(CHECKSUMS)}, or the parameters of a CRC", self.checksum)
        if self.framing == SYNC and self.sync_bytes is None:
            raise WrongKey("sync")
        if len(set(names)) < len(names):
            raise WrongKey("fields", "names that differ", names)
        if not self.channels:
            raise WrongKey("fields", "one or more that are channels", names)
        end = len(self.sync) + self.body.size
        if self.length != end + self.check.size:
            raise WrongKey("length", f"{end + self.check.size} for these fields", self.length)
        if self.checksum_from >= end:
            raise WrongKey("checksum_from", f"less than {end}, inside the frame", self.checksum_from)

    @cached_property
    def sync(self) -> bytes:
        """The bytes with which every frame begins."""
        return bytes.fromhex(self.sync_bytes or "")

    @cached_property
    def body(self) -> struct.Struct:
        """Format of the bytes between the sync pattern and the checksum."""
        byte_order = "<" if self.byte_order == "little" else ">"
        return struct.Struct(byte_order + "".join(field.struct_format for field in self.fields_and_padding))

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """Fields of the frame without padding, in their order."""
        return tuple(field for field in self.fields_and_padding if field.kind != PADDING)

    @cached_property
    def channels(self) -> tuple[Field, ...]:
        """The fields that are neither frame counter, clock nor flags."""
        return tuple(self.fields[position] for position, _ in self.columns.channels)

    @cached_property
    def check(self) -> Checksum:
        """The checksum given by the key `checksum`, which is a name or the parameters of a CRC."""
        if isinstance(self.checksum, str):
            return CHECKSUMS[self.checksum]
        return self.checksum.checksum

    @cached_property
    def columns(self) -> Columns:
        """Meaning of each field: frame counter, clock, flags or channel."""
        names = [field.name for field in self.fields]
        scales = [field.scale for field in self.fields]
        flags = names.index(FLAGS) if FLAGS in names else None
        return Columns(names, scales, flags)

    @property
    def seq_modulus(self) -> int:
        """Value at which the field `seq` wraps to 0."""
        position = self.columns.seq
        return SEQ_MODULUS if position is None else self.fields[position].modulus

    @property
    def t_us_modulus(self) -> int:
        """Time at which the field of the clock wraps to 0, us."""
        position = self.columns.time
        if position is None:
            return T_US_MODULUS
        return round(self.fields[position].modulus * self.columns.time_unit_us)

    @cached_property
    def three_byte_fields(self) -> tuple[tuple[int, bool], ...]:
        """Position of each field of three bytes, and whether the field is signed.

        The module `struct` cannot read such fields.
        """
        return tuple((position, field.kind == "i24") for position, field in enumerate(self.fields) if field.size == 3)

    @cached_property
    def constants(self) -> tuple[tuple[int, bytes], ...]:
        """Position and value of the bytes that are the same in every frame, except the sync pattern."""
        position = len(self.sync)
        constants = []
        for part in self.fields_and_padding:
            if part.value:
                constants.append((position, bytes.fromhex(part.value)))
            position += part.size
        return tuple(constants)

    def checksum_of(self, data: bytes) -> bytes:
        """Compute the checksum that follows `data`, which is a frame without its checksum."""
        value = self.check.compute(data[self.checksum_from :])
        return value.to_bytes(self.check.size, self.checksum_order or self.byte_order)

    def decode(self, data: bytes) -> Frame:
        """Decode one frame.

        Args:
            data: Exactly the bytes of the frame, without stuffing.

        Raises:
            ChecksumError: If the checksum is wrong.
            ValueError: If the length, the sync pattern or a constant byte is wrong, or the frame counter or the clock
                is not a number.
            OverflowError: If the frame counter or the clock is infinite.
        """
        if len(data) != self.length or not data.startswith(self.sync):
            raise ValueError("the length or the sync pattern is wrong")
        end = self.length - self.check.size
        if self.check.size and self.checksum_of(data[:end]) != data[end:]:
            raise ChecksumError("the checksum is wrong")
        for position, constant in self.constants:
            if not data.startswith(constant, position):
                raise ValueError(f"the constant at byte {position} is wrong")
        numbers = self.body.unpack_from(data, len(self.sync))
        if self.three_byte_fields:
            return self.columns.frame(self._convert_three_byte_fields(numbers))
        return self.columns.frame(numbers)

    def _convert_three_byte_fields(self, numbers: tuple[Any, ...]) -> list[Any]:
        """Convert the fields of three bytes to integers. The other numbers stay the same."""
        converted = list(numbers)
        for position, is_signed in self.three_byte_fields:
            converted[position] = int.from_bytes(numbers[position], self.byte_order, signed=is_signed)
        return converted

    def frame_of_zeros(self) -> Frame:
        """Return a frame whose channels are 0."""
        return self.columns.frame([0] * len(self.fields))

    def encode(self, frame: Frame) -> bytes:
        """Return the bytes that a board sends for a frame, with byte stuffing and delimiter.

        The first value of the frame belongs to the first channel, the second value to the second channel, and so on.

        Raises:
            ValueError: If the frame has another number of values than there are channels, or a value is not a number.
        """
        data = self.encode_unstuffed(frame)
        if self.framing not in STUFFINGS:
            return data
        stuffing = STUFFINGS[self.framing]
        return stuffing.encode(data) + stuffing.delimiter

    def encode_unstuffed(self, frame: Frame) -> bytes:
        """Return the bytes of a frame without byte stuffing and without delimiter.

        The first value of the frame belongs to the first channel, the second value to the second channel, and so on.

        Raises:
            ValueError: If the frame has another number of values than there are channels, or a value is not a number.
        """
        seq = 0 if frame.seq is None else frame.seq
        t_us = 0 if frame.t_us is None else frame.t_us
        values: dict[str, float] = {SEQ: seq, FLAGS: frame.flags}
        for clock_name, unit_us in TIMES_US.items():
            values[clock_name] = t_us / unit_us
        for channel, value in zip(self.channels, frame.values, strict=True):
            values[channel.name] = value
        packed = [field.pack(values[field.name], self.byte_order) for field in self.fields]
        data = bytearray(self.sync + self.body.pack(*packed))
        for position, constant in self.constants:
            data[position : position + len(constant)] = constant
        return bytes(data) + self.checksum_of(bytes(data))

    def parser(self) -> Parser:
        """Create a parser."""
        if self.framing == SYNC:
            return SyncParser(self)
        if self.framing == DATAGRAM:
            return DatagramParser(self)

        stuffing = STUFFINGS[self.framing]
        max_length = 2 * self.length + 2  # at worst, stuffing doubles the length

        def decode_stuffed(piece: bytes) -> Frame:
            return self.decode(stuffing.decode(piece))

        return StuffedParser(stuffing.delimiter, max_length, decode_stuffed, *_parser_arguments(self))


def _parser_arguments(layout: FrameLayout) -> tuple[str, int, int]:
    """Return the arguments of `Parser` for a layout, which are the description of the format and the two moduli."""
    names = ", ".join(field.name for field in layout.fields)
    return f"described frames of {layout.length} bytes: {names}", layout.seq_modulus, layout.t_us_modulus


class SyncParser(Parser):
    """Parser for a layout whose frames begin with a sync pattern."""

    def __init__(self, layout: FrameLayout) -> None:
        """Begin without bytes."""
        super().__init__(*_parser_arguments(layout))
        self.layout = layout

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that end within `data`.

        A frame may begin wherever the sync pattern occurs. If the bytes after the pattern are not a frame, the search
        continues one byte later. Bytes of an unfinished frame are stored for the next call.
        """
        sync = self.layout.sync
        length = self.layout.length
        unparsed = self._tail + data
        frames = []
        position = 0  # all bytes before this position have been parsed
        start = unparsed.find(sync)
        while 0 <= start <= len(unparsed) - length:
            if start > position:
                self.counts.count_dropped(start - position)
            # If the bytes are no frame, one byte is dropped, and a frame may begin at the next byte.
            decoded = self._attempt(self.layout.decode, unparsed[start : start + length], 1)
            frames += decoded
            position = start + length if decoded else start + 1
            start = unparsed.find(sync, position)

        tail_start = start
        if start < 0:  # no sync pattern was found, but the end of the data may contain its beginning
            tail_start = max(position, len(unparsed) - len(sync) + 1)
        self.counts.count_dropped(tail_start - position)
        self._tail = unparsed[tail_start:]
        return frames


class DatagramParser(Parser):
    """Parser for datagrams, each of which contains one or more whole frames."""

    def __init__(self, layout: FrameLayout) -> None:
        """Begin without bytes."""
        super().__init__(*_parser_arguments(layout))
        self.layout = layout

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames of one datagram, which contains one or several whole frames.

        A datagram whose length is not a multiple of the length of a frame is rejected as a whole.
        """
        length = self.layout.length
        if len(data) % length:
            self.counts.count_rejected(len(data))
            return []
        frames = []
        for start in range(0, len(data), length):
            frames += self._attempt(self.layout.decode, data[start : start + length], length)
        return frames
