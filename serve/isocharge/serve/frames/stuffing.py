"""Byte stuffing: how frames are parted by a byte that occurs nowhere in them.

COBS (`isocharge.serve.frames.cobs`) ends a frame with a zero. SLIP (RFC 1055) and HDLC's asynchronous framing (RFC
1662) part frames by a byte of their own, and send another two for it where it stands in the data.
"""

from collections.abc import Callable
from dataclasses import dataclass

from isocharge.serve.frames.cobs import cobs_decode


@dataclass(frozen=True)
class Stuffing:
    """A kind of byte stuffing.

    Attributes:
        delimiter: The byte between frames.
        decode: From the bytes between two delimiters to those of the frame; raises ValueError.
    """

    delimiter: bytes
    decode: Callable[[bytes], bytes]


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
