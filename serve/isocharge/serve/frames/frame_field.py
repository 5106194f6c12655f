"""Definition of a single field of a frame whose layout is described in a device file."""

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
"""Format of each type of a field in the notation of the module `struct`.

A number of three bytes is read as bytes, because `struct` has no format for such numbers.
"""

LARGEST_FLOATS = {"f32": (2.0 - 2.0**-23) * 2.0**127, "f64": sys.float_info.max}
"""Largest number that each floating-point type of a field can represent (IEEE 754)."""

PADDING = "pad"
"""Type of a field whose bytes are not read."""

MAX_PADDING = 4096
"""Largest number of bytes of padding. Because of this limit, a typing error cannot request a gigabyte."""

ByteOrder = Literal["little", "big"]
Hexadecimal = Annotated[
    str, Meta(pattern=r"^\s*([0-9A-Fa-f]{2}\s*)+$", description="bytes in hexadecimal, as in '20 4E'")
]


class Field(Settings, frozen=True):
    """A field of a frame.

    Attributes:
        kind: Type of the field.
        name: Name of the channel, or a name with a meaning, such as `seq`; empty for padding.
        scale: Value of one count, in the unit of the channel or of the clock.
        count: Number of bytes of padding.
        value: Bytes that the padding must have in every frame, in hexadecimal; None if any bytes are allowed.
    """

    kind: Literal["pad", "u8", "u16", "u24", "u32", "i8", "i16", "i24", "i32", "f32", "f64"] = field(name="type")
    name: Annotated[str, Meta(max_length=1000)] = ""
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
        if self.kind == PADDING:
            return
        if not self.name:
            raise WrongKey("name")
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
        if self.kind != PADDING:
            return STRUCT_FORMATS[self.kind]
        padding_size = self.count
        if self.value:  # the bytes that the padding must have, in hexadecimal
            padding_size = len(bytes.fromhex(self.value))
        return f"{padding_size}x"

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
        if self.is_signed:
            return self.modulus // 2 - 1
        return self.modulus - 1

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
        """Return whether the field can contain a given value in the unit of the channel."""
        return self.smallest_count <= value / self.scale <= self.largest_count

    def nearest_value(self, value: float) -> float:
        """Return the value in the range of the field that is nearest to a given value.

        Both values are in the unit of the channel.
        """
        return self._nearest_count(value / self.scale) * self.scale

    def _nearest_count(self, count: float) -> float:
        """Return the number in the range of the field that is nearest to a given number."""
        return min(max(count, self.smallest_count), self.largest_count)

    def pack(self, value: float, byte_order: ByteOrder) -> float | bytes:
        """Convert a value to a form that the module `struct` can pack.

        The field contains the count, which is the value divided by the scale of the field. A counter or clock in an
        integer field wraps around if its count exceeds the range of the field. Every other count is limited to the
        range of the field. The result is the count as a number, or as bytes for a field of three bytes.

        Args:
            value: Value in the unit of the channel or of the clock.
            byte_order: Byte order of the frame. It is used only for fields of three bytes.

        Raises:
            ValueError: If the value of an integer field is not a number.
        """
        count = value
        if self.name not in (SEQ, FLAGS):  # a parser reads the frame counter and the flags without a scale
            count = value / self.scale
        is_float = self.kind in LARGEST_FLOATS
        wraps = self.name in (SEQ, *TIMES_US) and not is_float
        if wraps:  # the result is between the smallest and the largest count of the field
            count = (round(count) - self.smallest_count) % self.modulus + self.smallest_count
        limited_count = self._nearest_count(count)
        if is_float:
            return limited_count
        whole_count = round(limited_count)
        if self.size == 3:  # struct has no format for three bytes
            return whole_count.to_bytes(3, byte_order, signed=self.is_signed)
        return whole_count
