"""The layout of a described frame: a sync pattern, fields of fixed size, a checksum.

    [frames]
    format = "described"
    sync = "20 4E"                 # hexadecimal
    length = 16                    # of the whole frame, bytes; checked against the fields
    byte_order = "little"          # or "big"; optional
    checksum = "crc-16/modbus"     # a name of `isocharge.serve.frames.checksums`; optional, "none"
    checksum_from = 0              # first byte that it covers; optional
    fields = [                     # in their order, from after the sync to before the checksum
        {name = "Fx", type = "i16", scale = 0.01},
        ...
    ]

Types are u8, u16, u32, i8, i16, i32, f32, f64, and `pad` with `count` bytes. A field named `seq` is the frame's number,
`t_us`, `t_ms` or `t_s` its clock, `flags` the bits of `isocharge.serve.frames.frame`; all others are channels.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isocharge.errors import DeviceError
from isocharge.serve.frames.checksums import CHECKSUMS, Checksum
from isocharge.serve.frames.frame import Frame
from isocharge.serve.frames.text_lines import SEQ, TIMES_US
from isocharge.tables import Table

FLAGS = "flags"
"""Name of the field that holds a frame's flags."""

TYPES = {"u8": "B", "u16": "H", "u32": "I", "i8": "b", "i16": "h", "i32": "i", "f32": "f", "f64": "d"}
"""Types of a field, with the letters of `struct`."""

PADDING = "pad"
"""Type of bytes that say nothing."""

MOST_PADDING = 4096
"""Largest padding, bytes: what no real frame has, so that a typing error cannot ask for a gigabyte."""

BYTE_ORDERS = {"little": "<", "big": ">"}


@dataclass(frozen=True)
class Field:
    """A field of a frame.

    Attributes:
        name: Its meaning, or the channel's name.
        letter: Its type as a letter of `struct`.
        scale: Value of one count in the unit of the channel or clock.
    """

    name: str
    letter: str
    scale: float = 1.0

    @property
    def modulus(self) -> int:
        """The number at which an unsigned counter of this size begins again."""
        return 1 << 8 * struct.calcsize(f"<{self.letter}")


@dataclass(frozen=True)
class FrameLayout:
    """A described frame.

    Attributes:
        sync: The bytes with which it begins.
        body: The bytes between sync and checksum.
        fields: In the order of `body`, padding left out.
        check: The checksum.
        check_from: First byte that it covers.
        byte_order: "little" or "big".
    """

    sync: bytes
    body: struct.Struct
    fields: tuple[Field, ...]
    check: Checksum
    check_from: int
    byte_order: str

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
        return value.to_bytes(self.check.size, "big" if self.byte_order == "big" else "little")

    def encode(self, frame: Frame) -> bytes:
        """The bytes of a frame; its values go into the channels in their order.

        Raises:
            struct.error: If a number does not fit its field.
        """
        counts = iter([value / field.scale for field, value in zip(self.channels, frame.values, strict=True)])
        known: dict[str, float] = {SEQ: frame.seq or 0, FLAGS: frame.flags}
        known |= {name: (frame.t_us or 0) / us for name, us in TIMES_US.items()}
        values = [known[field.name] / field.scale if field.name in known else next(counts) for field in self.fields]
        rounded = [
            value if field.letter in "fd" else _wrapped(round(value), field)
            for field, value in zip(self.fields, values, strict=True)
        ]
        data = self.sync + self.body.pack(*rounded)
        return data + self.checked(data)


def _wrapped(value: int, field: Field) -> int:
    """Counters and clocks wrap; a channel at its limit stays there, as a converter does."""
    if field.name in {SEQ, *TIMES_US}:
        return value % field.modulus
    low, high = (0, field.modulus - 1) if field.letter.isupper() else (-field.modulus // 2, field.modulus // 2 - 1)
    return min(max(value, low), high)


def frame_layout(table: Mapping[str, Any], where: str) -> FrameLayout:
    """Read the description of a frame.

    Args:
        table: The keys above, without `format`.
        where: The file, for messages.

    Raises:
        DeviceError: If a key is missing, unknown or wrong, or the length is not that of the fields.
    """
    frames = Table(table, where, DeviceError, "frames")
    frames.only("sync", "length", "byte_order", "checksum", "checksum_from", "fields")
    order = frames.choice("byte_order", tuple(BYTE_ORDERS), "little")
    entries = frames.tables("fields")
    letters = BYTE_ORDERS[order] + "".join(map(_letter, entries))
    layout = FrameLayout(
        sync=_sync(frames),
        body=struct.Struct(letters),
        fields=tuple(_field(entry) for entry in entries if entry.get("type") != PADDING),
        check=CHECKSUMS[frames.choice("checksum", tuple(CHECKSUMS), "none")],
        check_from=frames.whole("checksum_from", 0, least=0),
        byte_order=order,
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


def _sync(frames: Table) -> bytes:
    text = frames.text("sync")
    try:
        sync = bytes.fromhex(text)
    except ValueError:
        sync = b""
    if not sync:
        frames.refuse("sync", "bytes in hexadecimal, as in '20 4E'")
    return sync


def _letter(entry: Table) -> str:
    """A field's type, or its padding, as `struct` writes it."""
    kind = entry.only("name", "type", "scale", "count").choice("type", (PADDING, *TYPES))
    if kind == PADDING:
        return f"{entry.whole('count', 1, least=1, most=MOST_PADDING)}x"
    if entry.get("count", 1) != 1:
        entry.refuse("count", f"1, because only the type {PADDING} may have more")
    return TYPES[kind]


def _field(entry: Table) -> Field:
    return Field(entry.text("name"), TYPES[entry.text("type")], entry.number("scale", 1.0, not_zero=True))
