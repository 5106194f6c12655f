"""Encoding and decoding of the binary frames of isocharge, which use the byte stuffing COBS.

The fields of a frame are, in this order: version (u8), frame counter (u16), clock in us (u32), number n of charges
(u8), flags (u8), n charges in pC (f32), and checksum (u16). All numbers are little-endian. The checksum is the
CRC-16/CCITT-FALSE of all bytes before the checksum. Each frame ends with a zero byte, and COBS ensures that no other
byte of a frame is zero. If bytes are damaged, the parser therefore continues with the frame that begins after the next
zero byte.
"""

import binascii
import struct

from cobs import cobs

from isocharge.serve.frames.frame import ChecksumError, Frame, StuffedParser

FORMAT = "binary frames of isocharge"
"""Description of the format, for the user."""

FRAME_VERSION = 1
"""Version of the layout, which is the first byte of a frame."""

DELIMITER = b"\0"
"""The byte that ends a frame."""

HEADER = struct.Struct("<BHIBB")
"""Format of the fields before the charges: version, frame counter, clock in us, number of charges, and flags."""

CRC = struct.Struct("<H")
"""Format of the checksum CRC-16/CCITT-FALSE, which has the polynomial 0x1021 and the initial value 0xFFFF."""

MAX_STUFFED_LENGTH = len(cobs.encode(b"\x01" * (HEADER.size + 255 * 4 + CRC.size)))
"""Length of the longest frame after byte stuffing, without its delimiter, bytes.

The frame contains 255 charges, because one byte contains their number. Bytes without a zero become the longest.
"""


def encode_frame(frame: Frame) -> bytes:
    """Encode a frame with COBS, and append the delimiter. A missing counter or clock is encoded as zero.

    Raises:
        struct.error, OverflowError: If a number does not fit its field.
    """
    charge_count = len(frame.values)
    header = HEADER.pack(FRAME_VERSION, frame.seq or 0, frame.t_us or 0, charge_count, frame.bits)
    charges = struct.pack(f"<{charge_count}f", *frame.values)
    body = header + charges
    crc = CRC.pack(binascii.crc_hqx(body, 0xFFFF))
    stuffed: bytes = cobs.encode(body + crc)
    return stuffed + DELIMITER


def decode_frame(stuffed_frame: bytes) -> Frame:
    """Decode a frame and check its CRC.

    Args:
        stuffed_frame: Bytes of the frame as they are sent, encoded by COBS, without the delimiter.

    Raises:
        ChecksumError: If the CRC is wrong.
        ValueError, cobs.DecodeError: If the bytes are not a frame of this version.
    """
    data = cobs.decode(stuffed_frame)
    if len(data) < HEADER.size + CRC.size:
        raise ValueError("the frame is shorter than a frame without charges")
    body = data[: -CRC.size]  # header and charges
    sent_crc = data[-CRC.size :]
    computed_crc = CRC.pack(binascii.crc_hqx(body, 0xFFFF))
    if computed_crc != sent_crc:
        raise ChecksumError("the CRC is wrong")
    version, seq, t_us, charge_count, flags = HEADER.unpack_from(body)
    body_length = HEADER.size + 4 * charge_count  # each charge is a float of 4 bytes
    if version != FRAME_VERSION or len(body) != body_length:
        raise ValueError("the frame has another version, or another number of charges than it states")
    charges = struct.unpack_from(f"<{charge_count}f", body, HEADER.size)
    return Frame(seq, t_us, charges, flags)


class BinaryParser(StuffedParser):
    """Parser of the binary frame."""

    def __init__(self) -> None:
        super().__init__(FORMAT, DELIMITER, MAX_STUFFED_LENGTH, decode_frame)
