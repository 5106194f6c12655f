"""Byte stuffing: how frames are parted by a byte that occurs nowhere in them.

Consistent Overhead Byte Stuffing (Cheshire and Baker 1999) ends a frame with a zero: each zero in the data is replaced
by the distance to the next one, the first byte is the distance to the first, and a distance of 255 means 254 bytes
without a zero after them. SLIP (RFC 1055) and HDLC's asynchronous framing (RFC 1662) part frames by a byte of their
own, and send another two for it where it stands in the data.
"""

from collections.abc import Callable
from typing import NamedTuple

LONGEST_BLOCK = 254
"""Largest number of bytes without a zero after one distance of COBS."""


class Stuffing(NamedTuple):
    """A kind of byte stuffing.

    Attributes:
        delimiter: The byte between frames.
        decode: From the bytes between two delimiters to those of the frame; raises ValueError.
    """

    delimiter: bytes
    decode: Callable[[bytes], bytes]


def cobs_encode(data: bytes) -> bytes:
    """Bytes without zeros, longer than `data` by 1 + len(data) // 254 at most."""
    *blocks, last = data.split(b"\0")
    return b"".join(_stuff(block, ends_in_zero=True) for block in blocks) + _stuff(last, ends_in_zero=False)


def _stuff(block: bytes, *, ends_in_zero: bool) -> bytes:
    stuffed = bytearray()
    while len(block) > LONGEST_BLOCK or (len(block) == LONGEST_BLOCK and ends_in_zero):
        stuffed.append(LONGEST_BLOCK + 1)
        stuffed += block[:LONGEST_BLOCK]
        block = block[LONGEST_BLOCK:]
    stuffed.append(len(block) + 1)
    return bytes(stuffed + block)


def cobs_decode(data: bytes) -> bytes:
    """The bytes that `cobs_encode` was given.

    Raises:
        ValueError: If a distance points beyond the end, or there is a zero in `data`.
    """
    decoded, at = bytearray(), 0
    while at < len(data):
        code = data[at]
        block = data[at + 1 : at + code]
        if len(block) != code - 1 or 0 in block:
            raise ValueError(f"byte {at} is {code}, but {len(data) - at - 1} bytes or a zero follow")
        decoded += block
        at += code
        if code <= LONGEST_BLOCK and at < len(data):
            decoded.append(0)
    return bytes(decoded)


def _slip(piece: bytes) -> bytes:
    decoded = piece.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")
    if piece.count(b"\xdb") != piece.count(b"\xdb\xdc") + piece.count(b"\xdb\xdd"):
        raise ValueError("the byte DB stands alone: expected DC or DD after it")
    return decoded


def _hdlc(piece: bytes) -> bytes:
    first, *escaped = piece.split(b"\x7d")
    if not all(escaped):
        raise ValueError("expected a byte after 7D")
    return first + b"".join(bytes([part[0] ^ 0x20]) + part[1:] for part in escaped)


STUFFINGS = {
    "cobs": Stuffing(b"\x00", cobs_decode),
    "slip": Stuffing(b"\xc0", _slip),
    "hdlc": Stuffing(b"\x7e", _hdlc),
}
"""By name."""
