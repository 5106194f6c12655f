"""A field of a described frame, with its type, its name and its range."""

import struct
import sys
from typing import Annotated, Literal

from msgspec import Meta, field

from isocharge.common.structs import Finite, Settings, WrongKey
from isocharge.serve.frames.frame import FLAGS, SEQ, TIMES_US

STRUCT_FORMATS = {
    "u8": "B",
    "u16": "H",
    "u24": "3s",
    "u32": "I",
    "i8": "b",
    "i16": "h",
    "i24": "3s",
    "i32": "i",
    "f32": "f",
    "f64": "d",
}
"""Format of the module `struct` for each type of a field. Numbers of three bytes are read as bytes."""

LARGEST_FLOATS = {"f32": (2.0 - 2.0**-23) * 2.0**127, "f64": sys.float_info.max}
"""Largest number of each type of a field that is not an integer (IEEE 754)."""

PADDING = "pad"
"""Type of bytes that are not read."""

MAX_PADDING = 4096
"""Largest padding, bytes. The limit prevents that a typing error requests a gigabyte."""

ByteOrder = Literal["little", "big"]
Hexadecimal = Annotated[
    str, Meta(pattern=r"^\s*([0-9A-Fa-f]{2}\s*)+$", description="bytes in hexadecimal, as in '20 4E'")
]


class Field(Settings, frozen=True):
    """A field of a frame.

    Attributes:
        kind: Type of the field.
        name: Meaning of the field, or name of the channel; empty for padding.
        scale: Value of one count, in the unit of the channel or of the clock.
        count: Number of bytes of padding.
        value: Bytes that the padding of every frame must have, in hexadecimal.
    """

    kind: Literal["pad", "u8", "u16", "u24", "u32", "i8", "i16", "i24", "i32", "f32", "f64"] = field(name="type")
    name: Annotated[str, Meta(max_length=1000)] = ""
    scale: Finite = 1.0
    count: Annotated[int, Meta(ge=1, le=MAX_PADDING)] = 1
    value: Hexadecimal | None = None

    def __post_init__(self) -> None:
        """Check the keys of the field.

        Padding may have a count or a value, but needs no name. All other fields need a name, and may have neither.

        Raises:
            WrongKey: For the first key that is missing or not valid.
        """
        if self.scale == 0.0:
            raise WrongKey("scale", "a finite number that is not 0", self.scale)
        if self.kind == PADDING:
            return
        if not self.name:
            raise WrongKey("name")
        expected_none = f"none, because only the type {PADDING} may have one"
        if self.count != 1:
            raise WrongKey("count", expected_none, self.count)
        if self.value is not None:
            raise WrongKey("value", expected_none, self.value)

    @property
    def struct_format(self) -> str:
        """Format of the field for the module `struct`."""
        if self.kind != PADDING:
            return STRUCT_FORMATS[self.kind]
        if self.value:
            return f"{len(bytes.fromhex(self.value))}x"
        return f"{self.count}x"

    @property
    def size(self) -> int:
        """Number of bytes."""
        return struct.calcsize(f"<{self.struct_format}")

    @property
    def modulus(self) -> int:
        """Value at which an unsigned counter of this size wraps to 0."""
        return 1 << 8 * self.size

    @property
    def largest_count(self) -> float:
        """Largest number that the field can contain."""
        if self.kind in LARGEST_FLOATS:
            return LARGEST_FLOATS[self.kind]
        return self.modulus // 2 - 1 if self.is_signed else self.modulus - 1

    @property
    def smallest_count(self) -> float:
        """Smallest number that the field can contain."""
        if self.kind in LARGEST_FLOATS:
            return -LARGEST_FLOATS[self.kind]
        return -self.modulus // 2 if self.is_signed else 0

    @property
    def is_signed(self) -> bool:
        """Whether the field contains signed integers."""
        return self.kind.startswith("i")

    def holds(self, value: float) -> bool:
        """Return whether a value, in the unit of the channel, is inside the range of the field."""
        return self.smallest_count <= value / self.scale <= self.largest_count

    def limited(self, value: float) -> float:
        """Return the value that is nearest to `value`, in the unit of the channel, among those that the field holds."""
        return self._limited_count(value / self.scale) * self.scale

    def _limited_count(self, count: float) -> float:
        """Return the number that is nearest to `count` and inside the range of the field."""
        return min(max(count, self.smallest_count), self.largest_count)

    def pack(self, value: float, byte_order: ByteOrder) -> float | bytes:
        """Return a value in the form that `struct` packs.

        A counter or a clock that does not fit its field wraps. A channel that does not fit is set to its limit.

        Args:
            value: The value, in the unit of the field.
            byte_order: Byte order of the frame. Only fields of three bytes, which `struct` cannot pack, need it.

        Raises:
            ValueError: If the value of an integer field is not a number.
        """
        has_scale = self.name not in (SEQ, FLAGS)  # a parser reads the frame counter and the flags without a scale
        count = value / self.scale if has_scale else value
        is_float = self.kind in LARGEST_FLOATS
        if self.name in (SEQ, *TIMES_US) and not is_float:
            count = (round(count) - self.smallest_count) % self.modulus + self.smallest_count
        limited_count = self._limited_count(count)
        if is_float:
            return limited_count
        whole_count = round(limited_count)
        if self.size == 3:  # struct has no format for three bytes
            return whole_count.to_bytes(3, byte_order, signed=self.is_signed)
        return whole_count
