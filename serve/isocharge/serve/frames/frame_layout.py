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
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

from isocharge.common.errors import DeviceError
from isocharge.common.tables import Table
from isocharge.serve.frames.checksums import CHECKSUMS, Checksum, Crc
from isocharge.serve.frames.frame import Frame
from isocharge.serve.frames.stuffing import STUFFINGS
from isocharge.serve.frames.text_lines import SEQ, TIMES_US

FLAGS = "flags"
"""Name of the field that holds a frame's flags."""

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

BYTE_ORDERS = {"little": "<", "big": ">"}

SYNC, DATAGRAM = "sync", "datagram"
"""Framings without byte stuffing: a frame begins with its sync pattern, or where a datagram begins."""

FRAMINGS = (SYNC, *STUFFINGS, DATAGRAM)

FRAME_KEYS = ("framing", "sync", "length", "byte_order", "checksum", "checksum_from", "checksum_order", "fields")
FIELD_KEYS = ("name", "type", "scale", "count", "value")
CRC_KEYS = ("width", "polynomial", "start", "reflected", "final")


@dataclass(frozen=True)
class Field:
    """A field of a frame.

    Attributes:
        name: Its meaning, or the channel's name.
        kind: Its type.
        scale: Value of one count in the unit of the channel or clock.
    """

    name: str
    kind: str
    scale: float = 1.0

    @property
    def size(self) -> int:
        """Bytes."""
        return struct.calcsize(f"<{TYPES[self.kind]}")

    @property
    def is_float(self) -> bool:
        """Whether it holds a number with a fraction."""
        return self.kind[0] == "f"

    @property
    def is_triple(self) -> bool:
        """Whether it has three bytes, which `struct` does not read."""
        return self.kind in ("u24", "i24")

    @property
    def modulus(self) -> int:
        """The number at which an unsigned counter of this size begins again."""
        return 1 << 8 * self.size


@dataclass(frozen=True)
class FrameLayout:
    """A described frame.

    Attributes:
        sync: The bytes with which it begins.
        body: The bytes between sync and checksum.
        fields: In the order of `body`, padding left out.
        check: The checksum.
        check_from: First byte that it covers.
        check_order: Byte order of the checksum, "little" or "big".
        byte_order: Of the fields.
        framing: One of `FRAMINGS`.
        constants: Positions and bytes that every frame has besides the sync.
    """

    sync: bytes
    body: struct.Struct
    fields: tuple[Field, ...]
    check: Checksum
    check_from: int
    check_order: str
    byte_order: str
    framing: str = SYNC
    constants: tuple[tuple[int, bytes], ...] = ()

    @property
    def length(self) -> int:
        """Bytes in a frame."""
        return len(self.sync) + self.body.size + self.check.size

    @property
    def channels(self) -> tuple[Field, ...]:
        """The fields that are neither number, clock nor flags."""
        return tuple(field for field in self.fields if field.name not in {SEQ, FLAGS, *TIMES_US})

    def checked(self, data: bytes) -> bytes:
        """What follows `data`, a frame without its checksum: the checksum."""
        value = self.check.compute(data[self.check_from :])
        return value.to_bytes(self.check.size, "big" if self.check_order == "big" else "little")

    def counts(self, data: bytes) -> Sequence[Any]:
        """The numbers in the fields of a frame, without their scales."""
        numbers = self.body.unpack_from(data, len(self.sync))
        if not any(field.is_triple for field in self.fields):
            return numbers
        return [self._of_three(field, number) for field, number in zip(self.fields, numbers, strict=True)]

    def _of_three(self, field: Field, number: Any) -> Any:
        if not field.is_triple:
            return number
        return int.from_bytes(number, "big" if self.byte_order == "big" else "little", signed=field.kind == "i24")

    def encode(self, frame: Frame) -> bytes:
        """The bytes of a frame without stuffing; its values go into the channels in their order.

        Raises:
            struct.error: If a number does not fit its field.
        """
        counts = iter([value / field.scale for field, value in zip(self.channels, frame.values, strict=True)])
        known: dict[str, float] = {SEQ: frame.seq or 0, FLAGS: frame.flags}
        known |= {name: (frame.t_us or 0) / us for name, us in TIMES_US.items()}
        values = [known[field.name] / field.scale if field.name in known else next(counts) for field in self.fields]
        packed = [self._packed(field, value) for field, value in zip(self.fields, values, strict=True)]
        data = bytearray(self.sync + self.body.pack(*packed))
        for at, constant in self.constants:
            data[at : at + len(constant)] = constant
        return bytes(data) + self.checked(bytes(data))

    def _packed(self, field: Field, value: float) -> float | bytes:
        if field.is_float:
            return value
        count = _wrapped(round(value), field)
        if not field.is_triple:
            return count
        return count.to_bytes(3, "big" if self.byte_order == "big" else "little", signed=field.kind == "i24")


def _wrapped(value: int, field: Field) -> int:
    """Counters and clocks wrap; a channel at its limit stays there, as a converter does."""
    if field.name in {SEQ, *TIMES_US}:
        return value % field.modulus
    unsigned = field.kind[0] == "u"
    low, high = (0, field.modulus - 1) if unsigned else (-field.modulus // 2, field.modulus // 2 - 1)
    return min(max(value, low), high)


def frame_layout(table: Mapping[str, Any], where: str) -> FrameLayout:
    """Read the description of a frame.

    Args:
        table: The keys above, without `format`.
        where: The file, for messages.

    Raises:
        DeviceError: If a key is missing, unknown or wrong, or the length is not that of the fields.
    """
    frames = Table(table, where, DeviceError, "frames").only(*FRAME_KEYS)
    framing = frames.choice("framing", FRAMINGS, SYNC)
    order = frames.choice("byte_order", tuple(BYTE_ORDERS), "little")
    entries = frames.tables("fields")
    letters = [_letter(entry) for entry in entries]
    sync = _hexadecimal(frames, "sync") if framing == SYNC or "sync" in frames else b""
    layout = FrameLayout(
        sync=sync,
        body=struct.Struct(BYTE_ORDERS[order] + "".join(letters)),
        fields=tuple(_field(entry) for entry in entries if entry.get("type") != PADDING),
        check=_checksum(frames),
        check_from=frames.whole("checksum_from", 0, least=0),
        check_order=frames.choice("checksum_order", tuple(BYTE_ORDERS), order),
        byte_order=order,
        framing=framing,
        constants=tuple(_constants(entries, letters, len(sync))),
    )
    _check(layout, frames)
    return layout


def _check(layout: FrameLayout, frames: Table) -> None:
    """Refuse fields that do not make a frame, and a length or checksum that does not fit them."""
    names = [field.name for field in layout.fields]
    if len(set(names)) < len(names):
        frames.refuse("fields", "names that differ", names)
    if not layout.channels:
        frames.refuse("fields", "one or more that are channels", names)
    if frames.whole("length") != layout.length:
        frames.refuse("length", f"{layout.length} for these fields")
    if layout.check_from >= layout.length - layout.check.size:
        frames.refuse("checksum_from", f"less than {layout.length - layout.check.size}, inside the frame")


def _checksum(frames: Table) -> Checksum:
    """A checksum by its name, or a cyclic one by its parameters."""
    if not isinstance(frames.get("checksum", "none"), Mapping):
        return CHECKSUMS[frames.choice("checksum", tuple(CHECKSUMS), "none")]
    table = frames.table("checksum").only(*CRC_KEYS)
    width = table.whole("width", least=8, most=32)
    if width % 8:
        table.refuse("width", "8, 16, 24 or 32")
    polynomial, start, final = (
        _of_width(table, key, width, default) for key, default in (("polynomial", None), ("start", "0"), ("final", "0"))
    )
    return Checksum(Crc(width, polynomial, start, table.flag("reflected", False), final), width // 8)


def _of_width(table: Table, key: str, width: int, default: str | None) -> int:
    """A number in hexadecimal that fits a register."""
    text = table.text(key) if default is None else table.text(key, default)
    try:
        number = int(text, 16) if text.isascii() and text.isalnum() else -1
    except ValueError:
        number = -1
    if not 0 <= number < 1 << width:
        table.refuse(key, f"a number of {width} bits in hexadecimal, as in '1021'")
    return number


def _hexadecimal(table: Table, key: str) -> bytes:
    text = table.text(key)
    try:
        data = bytes.fromhex(text)
    except ValueError:
        data = b""
    if not data:
        table.refuse(key, "bytes in hexadecimal, as in '20 4E'")
    return data


def _letter(entry: Table) -> str:
    """A field's type, or its padding, as `struct` writes it."""
    kind = entry.only(*FIELD_KEYS).choice("type", (PADDING, *TYPES))
    if kind == PADDING and "value" in entry:
        return f"{len(_hexadecimal(entry, 'value'))}x"
    if kind == PADDING:
        return f"{entry.whole('count', 1, least=1, most=MOST_PADDING)}x"
    for key, only in (("count", 1), ("value", None)):
        if entry.get(key, only) != only:
            entry.refuse(key, f"none, because only the type {PADDING} may have one")
    return TYPES[kind]


def _constants(entries: Sequence[Table], letters: Sequence[str], begin: int) -> list[tuple[int, bytes]]:
    """Positions and bytes of padding that has a value."""
    positions = accumulate((struct.calcsize(f"<{letter}") for letter in letters), initial=begin)
    return [
        (at, _hexadecimal(entry, "value")) for entry, at in zip(entries, positions, strict=False) if "value" in entry
    ]


def _field(entry: Table) -> Field:
    return Field(entry.text("name"), entry.text("type"), entry.number("scale", 1.0, not_zero=True))
