"""The layout of a described frame: a sync pattern, fields of fixed size, a checksum.

    [frames]
    format = "described"
    framing = "sync"               # or "cobs", "slip", "hdlc", "datagram"; optional
    sync = "20 4E"                 # hexadecimal; optional with another framing
    length = 16                    # of the whole frame, bytes, without stuffing; checked against the fields
    byte_order = "little"          # or "big"; optional
    checksum = "crc-16/modbus"     # a name of `isocharge.serve.frames.checksums`, or the parameters of a CRC:
                                   # {width = 16, polynomial = "1021", start = "FFFF", reflected = false, final = "0"}
    checksum_from = 0              # first byte that it covers; optional
    checksum_order = "little"      # optional; that of the fields
    fields = [                     # in their order, from after the sync to before the checksum
        {name = "Fx", type = "i16", scale = 0.01},
        ...
    ]

Types are u8, u16, u24, u32, i8, i16, i24, i32, f32, f64, and `pad`: `count` bytes that say nothing, or a `value` in
hexadecimal that a frame must have, such as its length. A field named `seq` is the frame's number, `t_us`, `t_ms` or
`t_s` its clock, `flags` the bits of `isocharge.serve.frames.frame`; all others are channels.

Where a checksum does not fit, the parser goes on by one byte, so a sync pattern inside the data costs no intact frame.
Stuffed frames end at their delimiter, and datagrams hold whole frames alone; there a wrong piece is dropped whole.
"""

import struct
from functools import cached_property
from typing import Annotated, Any, Literal

from msgspec import Meta, field

from isocharge.common.structs import Finite, Settings, WrongKey
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
from isocharge.serve.frames.stuffing import STUFFINGS

TYPES = {
    **{"u8": "B", "u16": "H", "u24": "3s", "u32": "I"},
    **{"i8": "b", "i16": "h", "i24": "3s", "i32": "i"},
    **{"f32": "f", "f64": "d"},
}
"""Types of a field, with the letters of `struct`, which has none for three bytes."""

PADDING = "pad"
"""Type of bytes that say nothing."""

MOST_PADDING = 4096
"""Largest padding, bytes: what no real frame has, so that a typing error cannot ask for a gigabyte."""

FASTEST_HZ = 100_000.0
"""Highest rate of requests, Hz."""

SYNC, DATAGRAM = "sync", "datagram"
"""Framings without byte stuffing: a frame begins with its sync pattern, or where a datagram begins."""

Framing = Literal["sync", "cobs", "slip", "hdlc", "datagram"]
ByteOrder = Literal["little", "big"]
Hexadecimal = Annotated[
    str, Meta(pattern=r"^\s*([0-9A-Fa-f]{2}\s*)+$", description="bytes in hexadecimal, as in '20 4E'")
]
HexadecimalNumber = Annotated[
    str, Meta(pattern="^[0-9A-Fa-f]{1,8}$", description="a number in hexadecimal, as in '1021'")
]


class Field(Settings, frozen=True):
    """A field of a frame.

    Attributes:
        kind: Its type.
        name: Its meaning, or the channel's name; empty for padding.
        scale: Value of one count in the unit of the channel or clock.
        count: Bytes of padding.
        value: Bytes that padding must have.
    """

    kind: Literal["pad", "u8", "u16", "u24", "u32", "i8", "i16", "i24", "i32", "f32", "f64"] = field(name="type")
    name: Annotated[str, Meta(max_length=1000)] = ""
    scale: Finite = 1.0
    count: Annotated[int, Meta(ge=1, le=MOST_PADDING)] = 1
    value: Hexadecimal | None = None

    def __post_init__(self) -> None:
        if self.scale == 0.0:
            raise WrongKey("scale", "a finite number that is not 0", self.scale)
        if self.kind == PADDING:
            return
        if not self.name:
            raise WrongKey("name")
        for key, value, default in (("count", self.count, 1), ("value", self.value, None)):
            if value != default:
                raise WrongKey(key, f"none, because only the type {PADDING} may have one", value)

    @property
    def letter(self) -> str:
        """The type as `struct` writes it."""
        if self.kind == PADDING:
            return f"{len(bytes.fromhex(self.value)) if self.value else self.count}x"
        return TYPES[self.kind]

    @property
    def size(self) -> int:
        """Bytes."""
        return struct.calcsize(f"<{self.letter}")

    @property
    def modulus(self) -> int:
        """The number at which an unsigned counter of this size begins again."""
        return 1 << 8 * self.size

    def packed(self, value: float, order: ByteOrder) -> float | bytes:
        """A value as `struct` takes it: counters and clocks wrap, a channel at its limit stays there."""
        count = value / self.scale
        if self.kind[0] == "f":
            return count
        if self.name in (SEQ, *TIMES_US):
            count = round(count) % self.modulus
        low = 0 if self.kind[0] == "u" else -self.modulus // 2
        count = min(max(round(count), low), low + self.modulus - 1)
        return count.to_bytes(3, order, signed=low < 0) if self.size == 3 else count


class CrcParameters(Settings, frozen=True):
    """A cyclic redundancy check without a name; see `isocharge.serve.frames.checksums.Crc`."""

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
        """How to compute it."""
        polynomial, start, final = (int(text, 16) for text in (self.polynomial, self.start, self.final))
        return Checksum(Crc(self.width, polynomial, start, self.reflected, final), self.width // 8)


class FrameSection(Settings, frozen=True, tag_field="format"):
    """Keys that the section `[frames]` has for every format: what the board has to be asked.

    Attributes:
        request: Bytes in hexadecimal; None for a board that sends unasked.
        request_Hz: Requests per second, at most.
        echo: Whether the line brings the request back.
    """

    request: Hexadecimal | None = None
    request_Hz: Annotated[float, Meta(gt=0, le=FASTEST_HZ)] = 100.0
    echo: bool = False


class FrameLayout(FrameSection, frozen=True, tag="described", dict=True, kw_only=True):
    """A described frame; the attributes are keys of the section `[frames]`.

    Attributes:
        length: Of the whole frame without stuffing, bytes.
        entries: Its fields, padding included.
        framing: How frames are told apart.
        sync_bytes: With which each begins, hexadecimal.
        byte_order: Of the fields.
        checksum: Its name, or its parameters.
        checksum_from: First byte that it covers.
        checksum_order: Its byte order; that of the fields if None.
    """

    length: int
    entries: tuple[Field, ...] = field(name="fields")
    framing: Framing = "sync"
    sync_bytes: Hexadecimal | None = field(name="sync", default=None)
    byte_order: ByteOrder = "little"
    checksum: str | CrcParameters = "none"
    checksum_from: Annotated[int, Meta(ge=0)] = 0
    checksum_order: ByteOrder | None = None

    def __post_init__(self) -> None:
        """Refuse fields that do not make a frame, and a length or checksum that does not fit them."""
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
        """The bytes with which a frame begins."""
        return bytes.fromhex(self.sync_bytes or "")

    @cached_property
    def body(self) -> struct.Struct:
        """The bytes between sync and checksum."""
        letters = "".join(entry.letter for entry in self.entries)
        return struct.Struct(("<" if self.byte_order == "little" else ">") + letters)

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """Fields in their order, padding left out."""
        return tuple(entry for entry in self.entries if entry.kind != PADDING)

    @cached_property
    def channels(self) -> tuple[Field, ...]:
        """The fields that are neither number, clock nor flags."""
        return tuple(self.fields[at] for at, _ in self.columns.channels)

    @cached_property
    def check(self) -> Checksum:
        """The checksum."""
        return CHECKSUMS[self.checksum] if isinstance(self.checksum, str) else self.checksum.checksum

    @cached_property
    def columns(self) -> Columns:
        """What the numbers of the fields are."""
        names, scales = [entry.name for entry in self.fields], [entry.scale for entry in self.fields]
        return Columns(names, scales, names.index(FLAGS) if FLAGS in names else None)

    @property
    def seq_modulus(self) -> int:
        """The number at which the field `seq` wraps to 0."""
        at = self.columns.seq
        return SEQ_MODULUS if at is None else self.fields[at].modulus

    @property
    def t_us_modulus(self) -> int:
        """The time at which the clock's field wraps to 0, us."""
        at = self.columns.time
        return T_US_MODULUS if at is None else round(self.fields[at].modulus * self.columns.us)

    @cached_property
    def triples(self) -> tuple[tuple[int, bool], ...]:
        """Positions of the fields of three bytes, which `struct` does not read, and whether each has a sign."""
        return tuple((at, entry.kind == "i24") for at, entry in enumerate(self.fields) if entry.size == 3)

    @cached_property
    def constants(self) -> tuple[tuple[int, bytes], ...]:
        """Positions and bytes that every frame has besides the sync."""
        at, constants = len(self.sync), []
        for entry in self.entries:
            constants += [(at, bytes.fromhex(entry.value))] if entry.value else []
            at += entry.size
        return tuple(constants)

    def checked(self, data: bytes) -> bytes:
        """What follows `data`, a frame without its checksum: the checksum."""
        value = self.check.compute(data[self.checksum_from :])
        return value.to_bytes(self.check.size, self.checksum_order or self.byte_order)

    def decode(self, data: bytes) -> Frame:
        """The frame in exactly these bytes, without stuffing.

        Raises:
            ChecksumError: If its checksum does not fit.
            ValueError: If length, sync or a constant byte is another one, or number or clock is none.
            OverflowError: If number or clock is infinite.
        """
        if len(data) != self.length or not data.startswith(self.sync):
            raise ValueError("another length or sync")
        end = self.length - self.check.size
        if self.check.size and self.checked(data[:end]) != data[end:]:
            raise ChecksumError("another checksum")
        if self.constants and any(not data.startswith(constant, at) for at, constant in self.constants):
            raise ValueError("other constant bytes than the layout's")
        counts = self.body.unpack_from(data, len(self.sync))
        return self.columns.frame(self._with_triples(counts) if self.triples else counts)

    def _with_triples(self, counts: tuple[Any, ...]) -> list[Any]:
        numbers = list(counts)
        for at, is_signed in self.triples:
            numbers[at] = int.from_bytes(numbers[at], self.byte_order, signed=is_signed)
        return numbers

    def encode(self, frame: Frame) -> bytes:
        """The bytes of a frame without stuffing; its values go into the channels in their order.

        Raises:
            struct.error: If a number does not fit its field.
        """
        values: dict[str, float] = {SEQ: frame.seq or 0, FLAGS: frame.flags}
        values |= {name: (frame.t_us or 0) / us for name, us in TIMES_US.items()}
        values |= {entry.name: value for entry, value in zip(self.channels, frame.values, strict=True)}
        data = self.sync + self.body.pack(*(entry.packed(values[entry.name], self.byte_order) for entry in self.fields))
        for at, constant in self.constants:
            data = data[:at] + constant + data[at + len(constant) :]
        return data + self.checked(data)

    def parser(self) -> Parser:
        """A new parser."""
        if self.framing in STUFFINGS:
            delimiter, unstuffed = STUFFINGS[self.framing]
            longest = 2 * self.length + 2
            return StuffedParser(delimiter, longest, lambda piece: self.decode(unstuffed(piece)), *_about(self))
        return DatagramParser(self) if self.framing == DATAGRAM else DescribedParser(self)


def _about(layout: FrameLayout) -> tuple[str, int, int]:
    """The format for people, and where number and clock wrap."""
    names = ", ".join(field.name for field in layout.fields)
    return f"described frames of {layout.length} bytes: {names}", layout.seq_modulus, layout.t_us_modulus


class DescribedParser(Parser):
    """Bytes in, frames out, for a layout whose frames begin with a sync pattern."""

    def __init__(self, layout: FrameLayout) -> None:
        super().__init__(*_about(layout))
        self.layout = layout

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`; an unfinished one waits for the next call."""
        sync, length, decode = self.layout.sync, self.layout.length, self.layout.decode
        data, at, frames = self._tail + data, 0, []
        while (start := data.find(sync, at)) >= 0 and start + length <= len(data):
            if start > at:
                self.counts.drop(start - at)
            read = self._attempt(decode, data[start : start + length], 1)
            at = start + (length if read else 1)
            frames += read
        unfinished = start if start >= 0 else max(at, len(data) - len(sync) + 1)
        self.counts.drop(unfinished - at)
        self._tail = data[unfinished:]
        return frames


class DatagramParser(DescribedParser):
    """Datagrams in, frames out: each chunk is a datagram, which holds one or more whole frames."""

    def feed(self, data: bytes) -> list[Frame]:
        """The frames of a datagram."""
        length = self.layout.length
        if len(data) % length:
            self.counts.refuse(len(data))
            return []
        pieces = [data[at : at + length] for at in range(0, len(data), length)]
        return [frame for piece in pieces for frame in self._attempt(self.layout.decode, piece, length)]
