"""Byte stuffing: encodings in which the byte that separates frames never occurs inside a frame.

- COBS, Consistent Overhead Byte Stuffing (Cheshire and Baker 1999), ends a frame with a zero. Each zero in the data is
  replaced by the distance to the next zero, and the first byte is the distance to the first one. A distance of 255
  stands for 254 bytes that no zero follows.
- SLIP (RFC 1055) and the asynchronous framing of HDLC (RFC 1662) separate frames by a byte of their own. Where this
  byte occurs in the data, they send two other bytes instead.
"""

from collections.abc import Callable
from typing import NamedTuple

MAX_BLOCK = 254
"""Largest number of bytes without a zero that one distance of COBS can cover."""


class Stuffing(NamedTuple):
    """A kind of byte stuffing.

    Attributes:
        delimiter: The byte between frames.
        decode: Function from the bytes between two delimiters to the bytes of the frame. It raises ValueError for bytes
            that no encoder produces.
    """

    delimiter: bytes
    decode: Callable[[bytes], bytes]


def cobs_encode(data: bytes) -> bytes:
    """Encode bytes so that the result holds no zero. It is at most 1 + len(data) // 254 bytes longer than `data`."""
    *blocks, last = data.split(b"\0")
    encoded = [_encode_block(block, ends_in_zero=True) for block in blocks]
    return b"".join([*encoded, _encode_block(last, ends_in_zero=False)])


def _encode_block(block: bytes, *, ends_in_zero: bool) -> bytes:
    """Encode bytes without zeros, and the zero that follows them if there is one.

    Each piece of at most `MAX_BLOCK` bytes follows a byte with the distance to the next such byte. A distance of
    `MAX_BLOCK` + 1 means that no zero follows the piece.

    Args:
        block: The bytes.
        ends_in_zero: Whether a zero follows the bytes.
    """
    encoded = bytearray()
    rest = block
    while len(rest) > MAX_BLOCK or (len(rest) == MAX_BLOCK and ends_in_zero):
        encoded.append(MAX_BLOCK + 1)
        encoded += rest[:MAX_BLOCK]
        rest = rest[MAX_BLOCK:]
    encoded.append(len(rest) + 1)
    return bytes(encoded + rest)


def cobs_decode(data: bytes) -> bytes:
    """Return the bytes from which `cobs_encode` made `data`.

    Raises:
        ValueError: If a distance points beyond the end, or `data` contains a zero.
    """
    decoded = bytearray()
    position = 0
    while position < len(data):
        distance = data[position]  # distance to the next such byte, which stands for a zero
        block = data[position + 1 : position + distance]
        if len(block) != distance - 1 or 0 in block:
            raise ValueError(f"byte {position} is {distance}, but {len(data) - position - 1} bytes or a zero follow")
        decoded += block
        position += distance
        zero_follows = distance <= MAX_BLOCK and position < len(data)
        if zero_follows:
            decoded.append(0)
    return bytes(decoded)


def _slip_decode(piece: bytes) -> bytes:
    decoded = piece.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")
    if piece.count(b"\xdb") != piece.count(b"\xdb\xdc") + piece.count(b"\xdb\xdd"):
        raise ValueError("expected DC or DD after the byte DB")
    return decoded


def _hdlc_decode(piece: bytes) -> bytes:
    first, *escaped = piece.split(b"\x7d")
    if not all(escaped):
        raise ValueError("expected a byte after 7D")
    return first + b"".join(bytes([part[0] ^ 0x20]) + part[1:] for part in escaped)


STUFFINGS = {
    "cobs": Stuffing(b"\x00", cobs_decode),
    "slip": Stuffing(b"\xc0", _slip_decode),
    "hdlc": Stuffing(b"\x7e", _hdlc_decode),
}
"""Every kind of byte stuffing, by its name in a device file."""
