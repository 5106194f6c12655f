"""Definition of one field of a frame. A device file describes the layout of such frames field by field."""

import struct
from typing import Annotated, Literal

from msgspec import Meta, field

from isocharge.common.structs import Finite, Settings, WrongKey

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

PADDING = "pad"
"""Type of a field whose bytes are not read."""

MAX_PADDING = 4096
"""Largest number of bytes of padding. The limit prevents that a typing error requests a gigabyte."""

ByteOrder = Literal["little", "big"]
Hexadecimal = Annotated[
    str, Meta(pattern=r"^[ \t\r\n]*([0-9A-Fa-f]{2}[ \t\r\n]*)+$", description="bytes in hexadecimal, as in '20 4E'")
]


class Field(Settings, frozen=True):
    """A field of a frame.

    Attributes:
        type_name: Type of the field.
        name: Name of the channel, or a name with a meaning, such as `seq`; empty for padding.
        scale: Factor that converts the number in the field to the unit of the channel or of the clock.
        count: Number of bytes of padding.
        value: Bytes that the padding must have in every frame, in hexadecimal; None if any bytes are allowed.
    """

    type_name: Literal["pad", "u8", "u16", "u24", "u32", "i8", "i16", "i24", "i32", "f32", "f64"] = field(name="type")
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
        if self.type_name == PADDING:
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
        if self.type_name != PADDING:
            return STRUCT_FORMATS[self.type_name]
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
        """Number of different values of an integer of this size, at which an unsigned counter wraps to 0."""
        return 1 << 8 * self.size

    @property
    def is_signed(self) -> bool:
        """Whether the field contains signed integers."""
        return self.type_name.startswith("i")
