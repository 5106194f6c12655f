"""Frame formats that a device file can select with the key `format` of its section `[frames]`.

Each format has a section class, which declares the keys of the format and creates the parser.

The binary frames of isocharge use the byte stuffing COBS. The fields of a frame are, in this order: version (u8), frame
counter (u16), clock in us (u32), number n of charges (u8), flags (u8), n charges in pC (f32), and checksum (u16). All
numbers are little-endian. The checksum is the CRC-16/CCITT-FALSE of all bytes before the checksum. Each frame ends with
a zero byte, and COBS ensures that no other byte of a frame is zero. If bytes are damaged, the parser therefore
continues with the frame that begins after the next zero byte.
"""

import binascii
import struct
from collections.abc import Mapping

from cobs import cobs

from isocharge.serve.frames.frame import SEQ, TIMES_US, ChecksumError, Frame, Parser, StuffedParser
from isocharge.serve.frames.frame_layout import FrameLayout, FrameSection
from isocharge.serve.frames.text import TextParser

BINARY_FORMAT = "binary frames of isocharge"
"""Description of the binary format, for the user."""

FRAME_VERSION = 1
"""Version of the binary frame, which is its first byte."""

DELIMITER = b"\0"
"""The byte that ends a binary frame."""

HEADER = struct.Struct("<BHIBB")
"""Format of the fields before the charges: version, frame counter, clock in us, number of charges, and flags."""

CRC = struct.Struct("<H")
"""Format of the checksum CRC-16/CCITT-FALSE, which has the polynomial 0x1021 and the initial value 0xFFFF."""

MAX_STUFFED_LENGTH = len(cobs.encode(b"\x01" * (HEADER.size + 255 * 4 + CRC.size)))
"""Length of the longest frame after byte stuffing, without its delimiter, bytes.

The frame contains 255 charges, because one byte states the number of charges. Byte stuffing adds the most bytes to a
frame without a zero byte.
"""


def encode_frame(frame: Frame) -> bytes:
    """Encode a binary frame with COBS, and append the delimiter. A missing counter or clock is encoded as zero.

    Raises:
        struct.error, OverflowError: If a number does not fit into its field.
    """
    charge_count = len(frame.values)
    header = HEADER.pack(FRAME_VERSION, frame.seq or 0, frame.t_us or 0, charge_count, frame.bits)
    charges = struct.pack(f"<{charge_count}f", *frame.values)
    body = header + charges
    crc = CRC.pack(binascii.crc_hqx(body, 0xFFFF))
    stuffed: bytes = cobs.encode(body + crc)
    return stuffed + DELIMITER


def decode_frame(stuffed_frame: bytes) -> Frame:
    """Decode a binary frame and check its CRC.

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
        super().__init__(BINARY_FORMAT, DELIMITER, MAX_STUFFED_LENGTH, decode_frame)


class AutoParser(Parser):
    """Parser that recognises whether a board sends the binary frames of isocharge or lines of text.

    Bytes that arrive before the format is recognised are dropped.

    Args:
        columns: Names for the columns of a CSV; see `TextParser`.
        meanings: Meaning (`seq`, `t_us`, `t_ms` or `t_s`) of each name that the board uses; see `TextParser`.
    """

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Begin without a recognised format. The class describes the arguments."""
        super().__init__("nothing recognised yet")
        self._parsers: list[Parser] = [BinaryParser(), TextParser(columns, meanings)]  # of all possible formats

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames whose last byte is in `data`.

        Until the format is recognised, the data are passed to the parsers of all formats. The first parser that finds a
        frame receives all further data. This parser may determine the description of its format, and the values at
        which the counter and the clock wrap to 0 (the moduli), only after many frames. They are therefore copied from
        the parser with each frame.
        """
        for parser in self._parsers:
            frames = parser.feed(data)
            if frames:
                self._parsers = [parser]
                self.recognised = parser
                self.counts = parser.counts
                self.format = parser.format
                self.seq_modulus = parser.seq_modulus
                self.t_us_modulus = parser.t_us_modulus
                return frames
            self.unread_line = parser.unread_line or self.unread_line  # for messages to the user
        if self.recognised is None:  # a recognised parser counts its bytes itself
            self.counts.bytes_dropped += len(data)
        return []

    def reset(self) -> None:
        """Drop the bytes of an unfinished frame, because the next bytes come from another connection.

        A recognised format is kept.
        """
        super().reset()
        for parser in self._parsers:
            parser.reset()


class TextFrames(FrameSection, tag="text", frozen=True):
    """Section for a board that sends lines of text.

    Attributes:
        columns: Names of the columns of a CSV.
        seq: Name that the board uses for its frame counter.
        t_us: Name that the board uses for a clock in us.
        t_ms: Name that the board uses for a clock in ms.
        t_s: Name that the board uses for a clock in s.
    """

    columns: tuple[str, ...] = ()
    seq: str | None = None
    t_us: str | None = None
    t_ms: str | None = None
    t_s: str | None = None

    @property
    def meanings(self) -> Mapping[str, str]:
        """Meaning (`seq`, `t_us`, `t_ms` or `t_s`) of each name that the board uses for its counter or a clock."""
        return {name: meaning for meaning in (SEQ, *TIMES_US) if (name := getattr(self, meaning))}

    def parser(self) -> Parser:
        """Create a parser."""
        return TextParser(self.columns, self.meanings)


class AutoFrames(TextFrames, tag="auto", frozen=True):
    """Section for a board that sends either the binary frames of isocharge or lines of text.

    The parser recognises which of the two formats the board sends.
    """

    def parser(self) -> Parser:
        """Create a parser."""
        return AutoParser(self.columns, self.meanings)


class BinaryFrames(FrameSection, tag="binary", frozen=True):
    """Section for a board that sends the binary frames of isocharge."""

    def parser(self) -> Parser:
        """Create a parser."""
        return BinaryParser()


Frames = AutoFrames | TextFrames | BinaryFrames | FrameLayout
"""The section `[frames]` of a device file."""
