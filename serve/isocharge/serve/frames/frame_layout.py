"""Frames whose layout is described in a device file.

A frame consists of an optional sync pattern, fields of fixed size, and an optional checksum. The section `[frames]` of
the device file contains the following keys.

    [frames]
    format = "described"
    framing = "sync"               # or "cobs", "slip", "hdlc", "datagram"; optional
    sync = "20 4E"                 # hexadecimal; optional with another framing
    length = 8                     # of the whole frame, bytes, without stuffing; checked against the fields
    byte_order = "little"          # or "big"; optional
    checksum = "crc-16/modbus"     # a name of `isocharge.serve.frames.transmission`
    checksum_from = 0              # first byte that it covers; optional
    checksum_order = "little"      # optional; the default is the byte order of the fields
    fields = [                     # in their order, from after the sync to before the checksum
        {name = "Fx", type = "i16", scale = 0.01},
        {name = "Fy", type = "i16", scale = 0.01},
    ]

The types of the fields are u8, u16, u24, u32, i8, i16, i24, i32, i64, f32, f64 and `pad`. Padding (`pad`) has either a
`count` or a `value`. The `count` is a number of bytes without a meaning. The `value` is a constant in hexadecimal that
every frame must contain, for example the length of the frame. The field `seq` is the frame counter. A field with the
name `t_us`, `t_ms` or `t_s` is the clock. The field `flags` contains bits such as `SATURATED_BIT`
(`isocharge.serve.frames.frame`). All other fields are channels.

If a frame with a sync pattern is damaged, the parser searches for the next sync pattern, beginning one byte later. The
parser does not skip the length of a whole frame, because an intact frame may begin only a few bytes later. This is the
case if the first pattern was not the beginning of a frame, but occurred by chance inside another frame. In a stream
with byte stuffing, all bytes between two delimiters are dropped if they are not an intact frame. In a datagram, only
the damaged frames are dropped, unless the length of the datagram is wrong.
"""

import re
import struct
from functools import cached_property
from typing import Annotated, Final, Literal

from msgspec import Meta, field

from isocharge.common.structs import Finite, Positive, Settings, WrongKey
from isocharge.serve.frames.frame import (
    FLAGS,
    ChecksumError,
    Columns,
    Frame,
    Parser,
    StuffedParser,
)
from isocharge.serve.frames.transmission import CHECKSUMS, STUFFINGS, SUMS, Checksum

FieldType = Literal["pad", "u8", "u16", "u24", "u32", "i8", "i16", "i24", "i32", "i64", "f32", "f64"]

STRUCT_FORMATS: dict[FieldType, str] = {
    "u8": "B",
    "i8": "b",
    "u16": "H",
    "i16": "h",
    "u24": "3s",
    "i24": "3s",
    "u32": "I",
    "i32": "i",
    "i64": "q",
    "f32": "f",
    "f64": "d",
}
"""For each type of field: its format in the notation of the module `struct`.

A number of three bytes is read as bytes, because `struct` has no format for such numbers.
"""

PADDING: Final = "pad"
"""Type of a field whose bytes are not read."""

MAX_PADDING = 4096
"""Largest number of bytes of padding. The limit prevents a typing error from requesting a gigabyte."""

ByteOrder = Literal["little", "big"]
Hexadecimal = Annotated[
    str, Meta(pattern=r"^[ \t\r\n]*([0-9A-Fa-f]{2}[ \t\r\n]*)+$", description="bytes in hexadecimal, as in '20 4E'")
]


class Field(Settings, frozen=True, kw_only=True, omit_defaults=True):
    """A field of a frame.

    Attributes:
        name: Name of the channel, or a name with a meaning, such as `seq`; empty for padding.
        type_name: Type of the field.
        scale: Factor that converts the number in the field to the unit of the channel or of the clock.
        count: Number of bytes of padding.
        value: Bytes that the padding must have in every frame, in hexadecimal; None if any bytes are allowed.
    """

    name: Annotated[str, Meta(max_length=1000)] = ""
    type_name: FieldType = field(name="type")
    scale: Finite = 1.0
    count: Annotated[int, Meta(ge=1, le=MAX_PADDING)] = 1
    value: Hexadecimal | None = None

    def __post_init__(self) -> None:
        """Check the keys of the field.

        Padding may have a count or a value, but needs no name. All other fields need a name, and may have neither a
        count nor a value.

        Raises:
            WrongKey: For the first key that is missing or not valid.
        """
        if self.scale == 0.0:
            raise WrongKey("scale", "a finite number that is not 0", self.scale)
        if self.type_name == PADDING:
            return
        if not self.name:
            raise WrongKey("name")  # without an expected value, the error states that the key is missing
        expected_none = f"none, because only the type {PADDING} may have one"
        if self.count != 1:  # 1 is the default, which means that no count is given
            raise WrongKey("count", expected_none, self.count)
        if self.value is not None:
            raise WrongKey("value", expected_none, self.value)

    @property
    def struct_format(self) -> str:
        """Format of the field in the notation of the module `struct`.

        For example, four bytes of padding have the format `4x`.
        """
        if self.type_name != PADDING:
            return STRUCT_FORMATS[self.type_name]
        padding_size = len(bytes.fromhex(self.value)) if self.value else self.count
        return f"{padding_size}x"

    @property
    def size(self) -> int:
        """Number of bytes."""
        return struct.calcsize(f"<{self.struct_format}")

    @property
    def modulus(self) -> int:
        """Number of different values of an integer of this size. An unsigned counter wraps to 0 at this number."""
        return 1 << 8 * self.size


SYNC: Final = "sync"
"""Name of the framing in which every frame begins with a sync pattern."""

DATAGRAM: Final = "datagram"
"""Name of the framing in which every datagram contains one or more whole frames."""

Framing = Literal["sync", "cobs", "slip", "hdlc", "datagram"]


class FrameSection(Settings, frozen=True, tag_field="format"):
    """Keys of the section `[frames]` that all formats share. The keys describe how to request frames from the board.

    Attributes:
        request: Bytes that request one frame, in hexadecimal; None for a board that sends frames without a request.
        request_Hz: Largest number of requests per second.
    """

    request: Hexadecimal | None = None
    request_Hz: Positive = 100.0


class FrameLayout(FrameSection, frozen=True, tag="described", dict=True, kw_only=True, omit_defaults=True):
    """Layout of a frame. The attributes are the keys of the section `[frames]` in a device file.

    Attributes:
        framing: Method by which the beginning of each frame is found in the stream.
        sync_bytes: Bytes with which every frame begins, in hexadecimal.
        length: Length of the whole frame without stuffing, bytes.
        byte_order: Byte order of the fields.
        checksum: Name of the checksum.
        checksum_from: First byte that the checksum covers.
        checksum_order: Byte order of the checksum; None means the byte order of the fields.
        fields_and_padding: Fields of the frame, including padding.
    """

    framing: Framing = "sync"
    sync_bytes: Hexadecimal | None = field(name="sync", default=None)
    length: int
    byte_order: ByteOrder = "little"
    checksum: str = "none"
    checksum_from: Annotated[int, Meta(ge=0)] = 0
    checksum_order: ByteOrder | None = None
    fields_and_padding: tuple[Field, ...] = field(name="fields")

    def __post_init__(self) -> None:
        """Check that the keys of the layout are valid and consistent with each other.

        Raises:
            WrongKey: For the first key that is missing or not valid.
        """
        if self.checksum not in CHECKSUMS:
            # `CHECKSUMS` contains the `SUMS`, which are listed, and the CRCs of the catalogue, which are too many.
            expected = f"one of {', '.join(SUMS)}, or a CRC of the catalogue, such as crc-16/modbus"
            raise WrongKey("checksum", expected, self.checksum)
        if self.framing == SYNC and self.sync_bytes is None:
            raise WrongKey("sync")  # without an expected value, the error states that the key is missing

        names = [field.name for field in self.fields]
        has_duplicate_names = len(set(names)) < len(names)
        if has_duplicate_names:
            raise WrongKey("fields", "names that differ", names)
        if not self.columns.channels:
            raise WrongKey("fields", "one or more that are channels", names)
        if self.t_us_modulus < 1:  # the clock would wrap at 0 us or less, because its scale is negative or too small
            raise WrongKey("fields", "a clock with a positive scale that counts microseconds or more", names)

        checksum_start = len(self.sync) + self.body.size  # position of the checksum, which is at the end of the frame
        expected_length = checksum_start + self.selected_checksum.size
        if self.length != expected_length:
            raise WrongKey("length", f"{expected_length} for these fields", self.length)
        if self.checksum_from >= checksum_start:
            raise WrongKey("checksum_from", f"less than {checksum_start}, inside the frame", self.checksum_from)

    @cached_property
    def sync(self) -> bytes:
        """The bytes with which every frame begins."""
        return bytes.fromhex(self.sync_bytes or "")

    @cached_property
    def body(self) -> struct.Struct:
        """Format of the bytes between the sync pattern and the checksum."""
        byte_order = "<" if self.byte_order == "little" else ">"
        formats = [field.struct_format for field in self.fields_and_padding]
        return struct.Struct(byte_order + "".join(formats))

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """Fields of the frame without padding, in their order."""
        return tuple(field for field in self.fields_and_padding if field.type_name != PADDING)

    @cached_property
    def selected_checksum(self) -> Checksum:
        """The checksum that the key `checksum` selects."""
        return CHECKSUMS[self.checksum]

    @cached_property
    def columns(self) -> Columns:
        """Meanings of the fields. Each field is the frame counter, a clock, the flags or a channel."""
        names = [field.name for field in self.fields]
        scales = [field.scale for field in self.fields]
        flags_column = names.index(FLAGS) if FLAGS in names else None
        return Columns(names, scales, flags_column)

    @cached_property
    def pattern(self) -> re.Pattern[bytes]:
        """Regular expression of a whole frame.

        A frame begins with the sync pattern. Padding for which the device file states a `value` must have this value.
        All other bytes are arbitrary.
        """
        patterns = [
            re.escape(bytes.fromhex(field.value)) if field.value else b".{%d}" % field.size
            for field in self.fields_and_padding
        ]
        checksum_pattern = b".{%d}" % self.selected_checksum.size
        return re.compile(re.escape(self.sync) + b"".join(patterns) + checksum_pattern, re.DOTALL)

    def compute_checksum(self, frame_without_checksum: bytes) -> bytes:
        """Return the checksum of a frame as bytes in the order in which they are sent.

        Args:
            frame_without_checksum: All bytes of the frame before the checksum. The first `checksum_from` bytes are not
                covered by the checksum.
        """
        covered_bytes = frame_without_checksum[self.checksum_from :]
        value = self.selected_checksum.compute(covered_bytes)
        byte_order = self.checksum_order or self.byte_order
        return value.to_bytes(self.selected_checksum.size, byte_order)

    def decode(self, data: bytes) -> Frame:
        """Decode one frame.

        Args:
            data: Exactly the bytes of the frame, without stuffing.

        Raises:
            ChecksumError: If the checksum is wrong.
            ValueError: If the length, the sync pattern or a constant byte is wrong, or if the frame counter or the
                clock is not a number.
            OverflowError: If the frame counter or the clock is infinite.
        """
        if not self.pattern.fullmatch(data):
            raise ValueError("the length, the sync pattern or a constant byte is wrong")
        checksum_start = self.length - self.selected_checksum.size
        if self.compute_checksum(data[:checksum_start]) != data[checksum_start:]:
            raise ChecksumError("the checksum is wrong")
        # Integers of three bytes are converted here, because `struct` can only return their bytes. All other fields are
        # numbers already.
        numbers = [
            int.from_bytes(number, self.byte_order, signed=field.type_name == "i24")
            if isinstance(number, bytes)
            else number
            for field, number in zip(self.fields, self.body.unpack_from(data, len(self.sync)), strict=True)
        ]
        return self.columns.frame(numbers)

    @property
    def description(self) -> str:
        """Description of the format, for the user."""
        names = ", ".join(field.name for field in self.fields)
        return f"described frames of {self.length} bytes: {names}"

    @property
    def t_us_modulus(self) -> int:
        """Time at which the clock wraps to 0, us. The value has no meaning for frames without a clock."""
        return round(self.fields[self.columns.clock_column or 0].modulus * self.columns.clock_unit_us)

    def parser(self) -> Parser:
        """Create a parser for frames with this layout and this framing."""
        if self.framing == SYNC:
            parser: Parser = SyncParser(self)
        elif self.framing == DATAGRAM:
            parser = DatagramParser(self)
        else:
            stuffing = STUFFINGS[self.framing]
            # SLIP and HDLC at most double the length. COBS adds 1 byte, and 1 more for every 254 bytes. The limit need
            # not be exact, because it only prevents the parser from storing an endless piece without a delimiter.
            parser = StuffedParser(
                self.description,
                stuffing.delimiter,
                2 * self.length + 2,
                lambda stuffed_frame: self.decode(stuffing.decode(stuffed_frame)),
            )
        # Without a counter, the modulus of the first field takes the place of the modulus, which is then never used.
        parser.seq_modulus = self.fields[self.columns.seq_column or 0].modulus
        parser.t_us_modulus = self.t_us_modulus
        return parser


class SyncParser(Parser):
    """Parser for a layout whose frames begin with a sync pattern."""

    def __init__(self, layout: FrameLayout) -> None:
        """Begin without stored bytes."""
        super().__init__(layout.description)
        self.layout = layout

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that end within `data`.

        A frame may begin at every occurrence of the sync pattern. If the bytes from the pattern onwards are not a
        frame, the parser continues to search for the pattern one byte later. Bytes of an unfinished frame are stored
        for the next call.
        """
        sync = self.layout.sync
        length = self.layout.length
        unparsed = self._tail + data
        frames: list[Frame] = []
        parsed_end = 0  # all bytes before this position have been parsed
        while True:
            start = unparsed.find(sync, parsed_end)
            if start < 0:  # no sync pattern was found, but the end of the data may contain the beginning of the pattern
                start = max(parsed_end, len(unparsed) - len(sync) + 1)
            self.counts.bytes_dropped += start - parsed_end  # bytes between the previous frame and the pattern
            candidate = unparsed[start : start + length]
            if len(candidate) < length:  # an unfinished frame
                self._tail = candidate
                return frames
            # If the bytes are not a frame, the list is empty, and one byte is dropped, because a frame may begin at the
            # next byte.
            decoded = self._try_decode(self.layout.decode, candidate, dropped_size=1)
            frames += decoded
            parsed_end = start + (length if decoded else 1)


class DatagramParser(SyncParser):
    """Parser for datagrams, each of which contains one or more whole frames."""

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that one datagram contains.

        If the length of the datagram is not a multiple of the length of a frame, the whole datagram is rejected. A line
        feed behind the frames is ignored, because a UDP socket adds a line feed to a datagram in which all bytes are
        printable.
        """
        length = self.layout.length
        if len(data) % length == 1:
            data = data.removesuffix(b"\n")
        if len(data) % length != 0:
            self.counts.count_rejected(len(data))
            return []
        # Of each piece, `_try_decode` returns a list with its frame, or an empty list if it is damaged.
        pieces = (data[start : start + length] for start in range(0, len(data), length))
        return [frame for piece in pieces for frame in self._try_decode(self.layout.decode, piece, dropped_size=length)]
