"""The binary frame: COBS of (version u8, seq u16, t_us u32, n u8, flags u8, n x f32 pC, CRC u16), then a zero byte.

All little-endian. The CRC is CRC-16/CCITT-FALSE over everything before it. A zero occurs only as the end of a frame, so
a parser that is out of step is back in step at the next zero: a damaged frame costs itself and nothing else.
"""

import binascii
import struct

from isocharge.serve.frames.frame import ChecksumError, Frame, StuffedParser
from isocharge.serve.frames.stuffing import cobs_decode, cobs_encode

FORMAT = "binary frames of isocharge"
"""The format, for people."""

FRAME_VERSION = 1
"""Version of the frame's layout, its first byte."""

DELIMITER = b"\0"
"""The byte that ends a frame."""

HEAD = struct.Struct("<BHIBB")
"""Version, number, clock in us, number of charges, flags."""

CRC = struct.Struct("<H")

LONGEST_PAYLOAD = HEAD.size + 255 * 4 + CRC.size
"""Length of a frame with as many charges as a byte can count, bytes."""

LONGEST_PIECE = LONGEST_PAYLOAD + 1 + LONGEST_PAYLOAD // 254
"""Its length after byte stuffing, bytes."""


def encode_frame(frame: Frame) -> bytes:
    """The bytes of a frame with its delimiter; a missing number or time is sent as zero.

    Raises:
        struct.error: If a number does not fit its field.
    """
    n = len(frame.values)
    payload = HEAD.pack(FRAME_VERSION, frame.seq or 0, frame.t_us or 0, n, frame.flags)
    payload += struct.pack(f"<{n}f", *frame.values)
    return cobs_encode(payload + CRC.pack(crc16(payload))) + DELIMITER


def decode_frame(piece: bytes) -> Frame:
    """The frame in these bytes, without delimiter.

    Raises:
        ChecksumError: If its CRC does not fit.
        ValueError: If they are no frame.
    """
    payload = cobs_decode(piece)
    if len(payload) < HEAD.size + CRC.size:
        raise ValueError("shorter than a frame without charges")
    body = payload[: -CRC.size]
    if CRC.pack(crc16(body)) != payload[-CRC.size :]:
        raise ChecksumError("another CRC")
    version, seq, t_us, n, flags = HEAD.unpack_from(body)
    if version != FRAME_VERSION or len(body) != HEAD.size + 4 * n:
        raise ValueError("another version, or another number of charges than announced")
    return Frame(seq, t_us, struct.unpack_from(f"<{n}f", body, HEAD.size), flags)


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, not reflected."""
    return binascii.crc_hqx(data, 0xFFFF)


class BinaryParser(StuffedParser):
    """Bytes in, frames out. Memory is bounded by the longest possible frame."""

    def __init__(self) -> None:
        """Begin without bytes."""
        super().__init__(DELIMITER, LONGEST_PIECE, decode_frame, FORMAT)
