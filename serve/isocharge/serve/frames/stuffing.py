"""Byte stuffing, which ensures that the delimiter between frames never occurs inside a frame.

- COBS (Consistent Overhead Byte Stuffing, Cheshire and Baker 1999) ends each frame with a zero byte. The package `cobs`
  replaces each zero byte in the data by the distance to the next zero byte.
- SLIP (RFC 1055) and the asynchronous framing of HDLC (RFC 1662) separate frames by a reserved byte. If the reserved
  byte occurs in the data, two other bytes are sent in its place.
"""

from collections.abc import Callable
from typing import NamedTuple

from cobs import cobs


class Stuffing(NamedTuple):
    """A kind of byte stuffing.

    Attributes:
        delimiter: The byte between frames.
        decode: Function that converts the bytes between two delimiters to the bytes of the frame. It raises ValueError
            for bytes that no encoder produces.
    """

    delimiter: bytes
    decode: Callable[[bytes], bytes]


def cobs_decode(stuffed: bytes) -> bytes:
    """Decode bytes that are encoded with COBS.

    Raises:
        ValueError: If a distance points beyond the end, or `stuffed` contains a zero.
    """
    try:
        decoded: bytes = cobs.decode(stuffed)
    except cobs.DecodeError as error:
        raise ValueError(f"the bytes are not encoded with COBS: {error}") from error
    return decoded


def _slip_decode(stuffed: bytes) -> bytes:
    """Remove the byte stuffing of SLIP, which sends the byte C0 as DB DC and the byte DB as DB DD.

    Raises:
        ValueError: If the byte DB is not followed by DC or DD.
    """
    escape_count = stuffed.count(b"\xdb")
    valid_count = stuffed.count(b"\xdb\xdc") + stuffed.count(b"\xdb\xdd")
    if escape_count != valid_count:
        raise ValueError("expected DC or DD after the byte DB")
    # The sequence DB DD is replaced last, because a DB that results from it may stand before a byte DC of the data.
    return stuffed.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")


def _hdlc_decode(stuffed: bytes) -> bytes:
    """Remove the byte stuffing of HDLC.

    After the byte 7D, the encoder has inverted the bit 0x20 of the next byte. The decoder therefore drops the byte 7D,
    and inverts the bit 0x20 of the next byte again.

    Raises:
        ValueError: If the byte 7D is not followed by another byte.
    """
    first_part, *parts_after_7d = stuffed.split(b"\x7d")
    decoded = bytearray(first_part)
    for part in parts_after_7d:
        if not part:
            raise ValueError("expected a byte after 7D")
        decoded.append(part[0] ^ 0x20)
        decoded += part[1:]
    return bytes(decoded)


STUFFINGS = {
    "cobs": Stuffing(b"\x00", cobs_decode),
    "slip": Stuffing(b"\xc0", _slip_decode),
    "hdlc": Stuffing(b"\x7e", _hdlc_decode),
}
"""Every kind of byte stuffing, by its name in a device file."""
