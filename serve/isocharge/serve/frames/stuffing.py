"""Byte stuffing, which encodes frames so that the byte that separates frames never occurs inside a frame.

- COBS, Consistent Overhead Byte Stuffing (Cheshire and Baker 1999), ends a frame with a zero. Each zero in the data is
  replaced by the distance to the next zero. The first byte is the distance to the first zero. A distance of 255 stands
  for 254 bytes without a zero after them.
- SLIP (RFC 1055) and the asynchronous framing of HDLC (RFC 1662) separate frames by a special byte. If this byte occurs
  in the data, two other bytes are sent instead.
"""

from collections.abc import Callable
from typing import NamedTuple

MAX_BLOCK = 254
"""Largest number of bytes without a zero that one distance of COBS can cover."""


class Stuffing(NamedTuple):
    """A kind of byte stuffing.

    Attributes:
        delimiter: The byte between frames.
        encode: Function from the bytes of a frame to the bytes that are sent before the delimiter.
        decode: Function from the bytes between two delimiters to the bytes of the frame. It raises ValueError for bytes
            that no encoder produces.
    """

    delimiter: bytes
    encode: Callable[[bytes], bytes]
    decode: Callable[[bytes], bytes]


def cobs_encode(data: bytes) -> bytes:
    """Encode bytes so that the result contains no zero.

    The result is at most 1 + len(data) // 254 bytes longer than `data`.
    """
    *blocks, last = data.split(b"\0")
    encoded = [_encode_block(block, ends_in_zero=True) for block in blocks]
    return b"".join([*encoded, _encode_block(last, ends_in_zero=False)])


def _encode_block(block: bytes, *, ends_in_zero: bool) -> bytes:
    """Encode bytes without zeros, and the zero that follows them if there is one.

    The bytes are cut into pieces of at most `MAX_BLOCK` bytes. A distance byte is put before each piece: the length of
    the piece plus 1. A distance of `MAX_BLOCK` + 1 means that no zero follows the piece.

    Args:
        block: The bytes.
        ends_in_zero: Whether a zero follows the bytes.
    """
    encoded = bytearray()
    rest = block
    # A last piece of exactly `MAX_BLOCK` bytes gets this distance only if a zero follows the bytes.
    while len(rest) > MAX_BLOCK or (len(rest) == MAX_BLOCK and ends_in_zero):
        encoded.append(MAX_BLOCK + 1)
        encoded += rest[:MAX_BLOCK]
        rest = rest[MAX_BLOCK:]
    encoded.append(len(rest) + 1)
    return bytes(encoded + rest)


def cobs_decode(data: bytes) -> bytes:
    """Decode bytes that `cobs_encode` has encoded.

    The data consist of blocks. Each block begins with a distance byte, which is followed by distance - 1 bytes of the
    result. A zero is inserted between the contents of two blocks, unless the distance byte of the first block has its
    largest value.

    Raises:
        ValueError: If a distance points beyond the end, or `data` contains a zero.
    """
    decoded = bytearray()
    position = 0
    while position < len(data):
        distance = data[position]  # distance to the next distance byte
        block = data[position + 1 : position + distance]
        if len(block) != distance - 1 or 0 in block:
            raise ValueError(f"byte {position} is {distance}, but {len(data) - position - 1} bytes or a zero follow")
        decoded += block
        position += distance
        zero_follows = distance <= MAX_BLOCK and position < len(data)
        if zero_follows:
            decoded.append(0)
    return bytes(decoded)


def _slip_encode(data: bytes) -> bytes:
    """Encode bytes with the byte stuffing of SLIP, so that the result does not contain the byte C0."""
    return data.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc")


def _slip_decode(piece: bytes) -> bytes:
    """Decode bytes with the byte stuffing of SLIP; raise ValueError if no encoder produces them."""
    decoded = piece.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")
    if piece.count(b"\xdb") != piece.count(b"\xdb\xdc") + piece.count(b"\xdb\xdd"):
        raise ValueError("expected DC or DD after the byte DB")
    return decoded


def _hdlc_encode(data: bytes) -> bytes:
    """Encode bytes with the byte stuffing of HDLC, so that the result does not contain the byte 7E."""
    return data.replace(b"\x7d", b"\x7d\x5d").replace(b"\x7e", b"\x7d\x5e")


def _hdlc_decode(piece: bytes) -> bytes:
    """Decode bytes with the byte stuffing of HDLC; raise ValueError if no encoder produces them.

    The byte 7D is dropped, and the sixth bit of the byte after it is inverted.
    """
    first_part, *other_parts = piece.split(b"\x7d")
    decoded = bytearray(first_part)
    for part in other_parts:
        if not part:
            raise ValueError("expected a byte after 7D")
        decoded.append(part[0] ^ 0x20)
        decoded += part[1:]
    return bytes(decoded)


STUFFINGS = {
    "cobs": Stuffing(b"\x00", cobs_encode, cobs_decode),
    "slip": Stuffing(b"\xc0", _slip_encode, _slip_decode),
    "hdlc": Stuffing(b"\x7e", _hdlc_encode, _hdlc_decode),
}
"""Every kind of byte stuffing, by its name in a device file."""
