"""Byte stuffing, which ensures that the delimiter between frames never occurs inside a frame.

- COBS (Consistent Overhead Byte Stuffing, Cheshire and Baker 1999) ends each frame with a zero byte. Each zero byte in
  the data is replaced by the distance to the next zero byte. An additional byte at the beginning contains the distance
  to the first zero byte. The distance 255 stands for 254 bytes of data that are not followed by a zero byte.
- SLIP (RFC 1055) and the asynchronous framing of HDLC (RFC 1662) separate frames by a reserved byte. If the reserved
  byte occurs in the data, two other bytes are sent in its place.
"""

from collections.abc import Callable
from typing import NamedTuple

MAX_BLOCK = 254
"""Largest number of data bytes that can follow one distance byte of COBS."""


class Stuffing(NamedTuple):
    """A kind of byte stuffing.

    Attributes:
        delimiter: The byte between frames.
        encode: Function that converts the bytes of a frame to the bytes that are sent before the delimiter.
        decode: Function that converts the bytes between two delimiters to the bytes of the frame. It raises ValueError
            for bytes that no encoder produces.
    """

    delimiter: bytes
    encode: Callable[[bytes], bytes]
    decode: Callable[[bytes], bytes]


def cobs_encode(data: bytes) -> bytes:
    """Encode bytes with COBS, so that the result contains no zero byte.

    The result is at most 1 + len(data) // 254 bytes longer than `data`.
    """
    *blocks_before_zeros, last_block = data.split(b"\0")
    encoded = [_encode_block(block, ends_in_zero=True) for block in blocks_before_zeros]
    encoded.append(_encode_block(last_block, ends_in_zero=False))
    return b"".join(encoded)


def _encode_block(block: bytes, *, ends_in_zero: bool) -> bytes:
    """Encode a block of bytes without zeros, and the zero that may follow the block, with COBS.

    The block is cut into pieces of at most `MAX_BLOCK` bytes. Before each piece, a distance byte contains the length of
    the piece plus 1. The zero itself is not sent. A decoder adds a zero after each piece that has fewer than
    `MAX_BLOCK` bytes, except after the last piece of a frame.

    Args:
        block: Bytes that contain no zero.
        ends_in_zero: Whether a zero follows the block. It is False only for the last block of a frame.
    """
    encoded = bytearray()
    rest = block
    # Encode pieces of `MAX_BLOCK` bytes, after which the decoder adds no zero. If a zero follows the block, the last
    # piece must be shorter, so that the decoder adds the zero. The last piece may be empty.
    while len(rest) > MAX_BLOCK or (len(rest) == MAX_BLOCK and ends_in_zero):
        encoded.append(MAX_BLOCK + 1)
        encoded += rest[:MAX_BLOCK]
        rest = rest[MAX_BLOCK:]
    encoded.append(len(rest) + 1)
    return bytes(encoded + rest)


def cobs_decode(data: bytes) -> bytes:
    """Decode bytes that `cobs_encode` has encoded.

    The data consist of blocks. Each block begins with a distance byte, which is followed by `distance - 1` decoded
    bytes. After the decoded bytes of each block, the decoder adds a zero. No zero is added after a block with the
    distance 255 or after the last block.

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
        is_last_block = position >= len(data)
        zero_follows = distance <= MAX_BLOCK and not is_last_block
        if zero_follows:
            decoded.append(0)
    return bytes(decoded)


def _slip_encode(data: bytes) -> bytes:
    """Apply the byte stuffing of SLIP, so that the result does not contain the byte C0."""
    # The byte DB is replaced first, because the second replacement inserts further bytes DB.
    return data.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc")


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


def _hdlc_encode(data: bytes) -> bytes:
    """Apply the byte stuffing of HDLC, so that the result does not contain the byte 7E."""
    # The byte 7D is replaced first, because the second replacement inserts further bytes 7D.
    return data.replace(b"\x7d", b"\x7d\x5d").replace(b"\x7e", b"\x7d\x5e")


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
    "cobs": Stuffing(b"\x00", cobs_encode, cobs_decode),
    "slip": Stuffing(b"\xc0", _slip_encode, _slip_decode),
    "hdlc": Stuffing(b"\x7e", _hdlc_encode, _hdlc_decode),
}
"""Every kind of byte stuffing, by its name in a device file."""
