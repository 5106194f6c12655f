"""The layout of a frame as TOML describes it: sync, fields, checksum."""

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isocharge.errors import DeviceError
from isocharge.serve.frames.checksums import Checksum, checksum
from isocharge.serve.frames.frame import Frame
from isocharge.serve.frames.text_lines import SEQ, TIMES_US

FLAGS = "flags"

TYPES = {"u8": "B", "u16": "H", "u32": "I", "i8": "b", "i16": "h", "i32": "i", "f32": "f", "f64": "d"}

BYTE_ORDERS = {"little": "<", "big": ">"}


@dataclass(frozen=True)
class Field:
    """A field of a frame: its type in `struct`'s letters, and what one count is in the unit that is wanted."""

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
        sync: What it begins with.
        body: From after the sync to before the checksum.
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
    known = {"sync", "length", "byte_order", "checksum", "checksum_from", "fields"}
    _expect(set(table) <= known, where, f"only the keys {sorted(known)}", sorted(set(table) - known))
    _expect({"sync", "length", "fields"} <= set(table), where, "the keys sync, length and fields", sorted(table))
    order = table.get("byte_order", "little")
    _expect(order in BYTE_ORDERS, where, "byte_order little or big", order)
    entries = table["fields"]
    _expect(isinstance(entries, list) and len(entries) > 0, where, "a list of fields", entries)
    letters = "".join(_letters(entry, where) for entry in entries)
    fields = tuple(_field(entry, where) for entry in entries if entry["type"] != "pad")
    check = checksum(table.get("checksum", "none"))
    start = table.get("checksum_from", 0)
    layout = FrameLayout(
        _sync(table["sync"], where), struct.Struct(BYTE_ORDERS[order] + letters), fields, check, start, order
    )
    _check(layout, table, where)
    return layout


def _check(layout: FrameLayout, table: Mapping[str, Any], where: str) -> None:
    names = [field.name for field in layout.fields]
    _expect(len(set(names)) == len(names), where, "field names that differ", names)
    _expect(len(layout.channels) > 0, where, "a field that is a channel", names)
    _expect(layout.length == table["length"], where, f"length = {layout.length} for these fields", table["length"])
    covered = isinstance(layout.check_from, int) and 0 <= layout.check_from < layout.length - layout.check.size
    _expect(covered, where, "checksum_from inside the frame", layout.check_from)


def _expect(holds: bool, where: str, expected: str, value: object) -> None:
    if not holds:
        raise DeviceError(f"{where}: frames: expected {expected}, got {value!r}")


def _sync(text: Any, where: str) -> bytes:
    try:
        sync = bytes.fromhex(text)
    except (TypeError, ValueError):
        sync = b""
    _expect(len(sync) > 0, where, "sync in hexadecimal, as in '20 4E'", text)
    return sync


def _letters(entry: Any, where: str) -> str:
    _expect(isinstance(entry, dict) and set(entry) <= {"name", "type", "scale", "count"}, where, "a field", entry)
    kind, count = entry.get("type"), entry.get("count", 1)
    _expect(kind == "pad" or kind in TYPES, where, f"a field's type pad, {', '.join(TYPES)}", kind)
    _expect(isinstance(count, int) and 1 <= count <= 4096, where, "count from 1 to 4096", count)
    _expect(kind == "pad" or count == 1, where, "count with the type pad only", entry)
    return f"{count}x" if kind == "pad" else TYPES[kind]


def _field(entry: Mapping[str, Any], where: str) -> Field:
    name, scale = entry.get("name"), entry.get("scale", 1.0)
    _expect(isinstance(name, str) and name != "", where, "a name for each field", entry)
    _expect(
        isinstance(scale, int | float) and not isinstance(scale, bool) and scale != 0 and math.isfinite(scale),
        where,
        "a finite scale that is not 0",
        scale,
    )
    return Field(str(name), TYPES[entry["type"]], float(scale))
