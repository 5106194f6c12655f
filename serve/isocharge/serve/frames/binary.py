"""The binary frame: COBS of (version u8, seq u16, t_us u32, n u8, flags u8, n x f32 pC, CRC u16), then a zero byte.

All little-endian. The CRC is CRC-16/CCITT-FALSE over everything before it. A zero occurs only as the end of a frame, so
a parser that is out of step is back in step at the next zero: a damaged frame costs itself and nothing else.
"""

import binascii
import struct

from isocharge.serve.frames.cobs import cobs_decode, cobs_encode
from isocharge.serve.frames.frame import T_US_MODULUS, Frame, FrameCounts, Splitter
from isocharge.serve.frames.sequence import SEQ_MODULUS

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


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, not reflected."""
    return binascii.crc_hqx(data, 0xFFFF)


class CrcError(ValueError):
    """The checksum does not fit; only the parser sees it, and counts it."""


def decode_piece(piece: bytes) -> Frame:
    """The frame between two delimiters.

    Raises:
        CrcError: If its checksum does not fit.
        ValueError: If it is not a frame for another reason.
    """
    payload = cobs_decode(piece)
    if len(payload) < HEAD.size + CRC.size:
        raise ValueError(f"expected at least {HEAD.size + CRC.size} bytes, got {len(payload)}")
    body = payload[: -CRC.size]
    if CRC.pack(crc16(body)) != payload[-CRC.size :]:
        raise CrcError(f"expected CRC {CRC.pack(crc16(body)).hex()}, got {payload[-CRC.size :].hex()}")
    version, seq, t_us, n, flags = HEAD.unpack_from(body)
    if version != FRAME_VERSION or len(body) != HEAD.size + 4 * n:
        raise ValueError(f"expected version {FRAME_VERSION} and {4 * n} bytes of charges, got {body.hex()}")
    return Frame(seq, t_us, struct.unpack_from(f"<{n}f", body, HEAD.size), flags)


class BinaryParser:
    """Bytes in, frames out; `counts` says what was lost. Memory is bounded by the longest possible frame."""

    seq_modulus = SEQ_MODULUS
    t_us_modulus = T_US_MODULUS
    format = "binary frames of isocharge"

    def __init__(self) -> None:
        self.counts = FrameCounts()
        self._pieces = Splitter(DELIMITER, LONGEST_PIECE, self.counts)

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`; the bytes after the last delimiter wait for the next call."""
        return [frame for piece in self._pieces.feed(data) if (frame := self._take(piece)) is not None]

    def forget(self) -> None:
        """Drop what is unfinished: what comes next is from another connection."""
        self._pieces.forget()

    def _take(self, piece: bytes) -> Frame | None:
        """The frame in a piece, or None if it is damaged, which is counted, or empty, which is an idle line."""
        if not piece:
            return None
        try:
            frame = decode_piece(piece)
        except ValueError as error:
            self.counts.refuse(len(piece) + len(DELIMITER), damaged=isinstance(error, CrcError))
            return None
        self.counts.accept()
        return frame
