"""The binary frame of isocharge, encoded by COBS.

The fields are (version u8, seq u16, t_us u32, n u8, flags u8, n x f32 pC, CRC u16). All numbers are little-endian. The
CRC is CRC-16/CCITT-FALSE over all bytes before it. A zero byte ends each frame and occurs nowhere else. After damaged
bytes, the parser therefore continues with the frame after the next zero. A damaged frame does not affect its
neighbours.
"""

import binascii
import struct

from isocharge.serve.frames.frame import ChecksumError, Frame, StuffedParser
from isocharge.serve.frames.stuffing import MAX_BLOCK, cobs_decode, cobs_encode

FORMAT = "binary frames of isocharge"
"""Description of the format, for the user."""

FRAME_VERSION = 1
"""Version of the layout, which is the first byte of a frame."""

DELIMITER = b"\0"
"""The byte that ends a frame."""

HEADER = struct.Struct("<BHIBB")
"""Version, frame counter, clock in us, number of charges, flags."""

CRC = struct.Struct("<H")
"""The checksum."""

MAX_CHARGES = 255
"""Largest number of charges in a frame, because one byte contains the number."""

MAX_FRAME_LENGTH = HEADER.size + MAX_CHARGES * 4 + CRC.size
"""Length of the longest frame before byte stuffing, bytes."""

MAX_STUFFED_LENGTH = MAX_FRAME_LENGTH + 1 + MAX_FRAME_LENGTH // MAX_BLOCK
"""Length of the longest frame after byte stuffing, without its delimiter, bytes."""


def encode_frame(frame: Frame) -> bytes:
    """Return the bytes of a frame with its delimiter. A missing counter or clock is encoded as zero.

    Raises:
        struct.error: If a number does not fit its field.
    """
    count = len(frame.values)
    body = HEADER.pack(FRAME_VERSION, frame.seq or 0, frame.t_us or 0, count, frame.flags)
    body += struct.pack(f"<{count}f", *frame.values)
    return cobs_encode(body + CRC.pack(crc16(body))) + DELIMITER


def decode_frame(piece: bytes) -> Frame:
    """Decode a frame and check its CRC.

    Args:
        piece: Bytes of the frame with byte stuffing, without the delimiter.

    Raises:
        ChecksumError: If the CRC is wrong.
        ValueError: If the bytes are not a frame.
    """
    data = cobs_decode(piece)
    if len(data) < HEADER.size + CRC.size:
        raise ValueError("the frame is shorter than a frame without charges")
    body = data[: -CRC.size]  # header and charges
    stated_crc = data[-CRC.size :]
    if CRC.pack(crc16(body)) != stated_crc:
        raise ChecksumError("the CRC is wrong")
    version, seq, t_us, count, flags = HEADER.unpack_from(body)
    if version != FRAME_VERSION or len(body) != HEADER.size + 4 * count:  # a charge has 4 bytes
        raise ValueError("the frame has another version, or another number of charges than it states")
    charges = struct.unpack_from(f"<{count}f", body, HEADER.size)
    return Frame(seq, t_us, charges, flags)


def crc16(data: bytes) -> int:
    """Compute the checksum CRC-16/CCITT-FALSE, which has the polynomial 0x1021 and the initial value 0xFFFF."""
    return binascii.crc_hqx(data, 0xFFFF)


class BinaryParser(StuffedParser):
    """Parser of the binary frame."""

    def __init__(self) -> None:
        super().__init__(DELIMITER, MAX_STUFFED_LENGTH, decode_frame, FORMAT)
