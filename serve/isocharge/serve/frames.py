"""The binary frame: COBS of (version u8, seq u16, t_us u32, n u8, flags u8, n x f32 pC, CRC u16), then a zero byte.

All little-endian. The CRC is CRC-16/CCITT-FALSE over everything before it. A zero occurs only as the end of a frame, so
a parser that lost its way is back at the next zero: a damaged frame costs itself and nothing else.

The parser knows no port: bytes in, frames and counters out. However the bytes are cut into chunks, the frames are the
same.
"""

import binascii
import struct
from dataclasses import dataclass

from isocharge.serve.cobs import cobs_decode, cobs_encode
from isocharge.serve.flags import GAP, REPEAT, RESTART

FRAME_VERSION = 1
DELIMITER = b"\0"
SATURATED_BIT = 0x01
"""In a frame's flags: an amplifier is at its limit. The other bits are reserved and sent as zero."""

SEQ_MODULUS = 1 << 16
T_US_MODULUS = 1 << 32
HEAD = struct.Struct("<BHIBB")
CRC = struct.Struct("<H")
LONGEST_PAYLOAD = HEAD.size + 255 * 4 + CRC.size
LONGEST_PIECE = LONGEST_PAYLOAD + 1 + LONGEST_PAYLOAD // 254


@dataclass(frozen=True, slots=True)
class Frame:
    """One reading of a sensor.

    Attributes:
        seq: Counter of frames, 0 to 65535, then 0 again.
        t_us: The device's clock, us, modulo 2^32.
        charge_pC: A charge for each electrode, pC, as float32 carries it.
        flags: Bits; see `SATURATED_BIT`.
    """

    seq: int
    t_us: int
    charge_pC: tuple[float, ...]
    flags: int = 0


def encode_frame(frame: Frame) -> bytes:
    """The bytes of a frame, delimiter included.

    Raises:
        struct.error: If a number does not fit its field.
    """
    n = len(frame.charge_pC)
    payload = HEAD.pack(FRAME_VERSION, frame.seq, frame.t_us, n, frame.flags)
    payload += struct.pack(f"<{n}f", *frame.charge_pC)
    return cobs_encode(payload + CRC.pack(crc16(payload))) + DELIMITER


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, not reflected."""
    return binascii.crc_hqx(data, 0xFFFF)


class CrcError(ValueError):
    """The checksum does not fit; only the parser sees it, and counts it."""


def decode_piece(piece: bytes) -> Frame:
    """The frame that stands between two delimiters.

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


@dataclass(slots=True)
class FrameCounts:
    """What a parser has seen so far.

    Attributes:
        frames: Intact frames.
        crc_errors: Pieces whose checksum did not fit.
        malformed: Pieces that were no frame for another reason: stuffing, length, version.
        bytes_dropped: Bytes of those pieces, delimiters included.
    """

    frames: int = 0
    crc_errors: int = 0
    malformed: int = 0
    bytes_dropped: int = 0


class FrameParser:
    """Bytes in, frames out; `counts` says what was lost. Memory is bounded by the longest possible frame."""

    def __init__(self) -> None:
        self.counts = FrameCounts()
        self._tail = b""
        self._overlong = False

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`; what follows the last delimiter is kept for the next call."""
        *pieces, self._tail = (self._tail + data).split(DELIMITER)
        frames = [frame for piece in pieces if (frame := self._take(piece)) is not None]
        if self._overlong or len(self._tail) > LONGEST_PIECE:
            self._overlong = True
            self.counts.bytes_dropped += len(self._tail)
            self._tail = b""
        return frames

    def _take(self, piece: bytes) -> Frame | None:
        """The frame in a piece, or None, counted, if there is none; an empty piece is an idle line."""
        if not piece and not self._overlong:
            return None
        try:
            if self._overlong or len(piece) > LONGEST_PIECE:
                raise ValueError("longer than any frame")
            frame = decode_piece(piece)
        except ValueError as error:
            self._count_dropped(piece, error)
            return None
        finally:
            self._overlong = False
        self.counts.frames += 1
        return frame

    def _count_dropped(self, piece: bytes, error: ValueError) -> None:
        damaged = isinstance(error, CrcError)
        self.counts.crc_errors += damaged
        self.counts.malformed += not damaged
        self.counts.bytes_dropped += len(piece) + len(DELIMITER)


class SequenceGaps:
    """Follows the 16-bit frame numbers.

    Attributes:
        lost: Frames that are missing between those that came.
        repeated: Frames with the number of the one before.
        restarts: Times the numbers went back, as after a reset of the device; nothing is known about frames lost there.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.repeated = 0
        self.restarts = 0
        self._last: int | None = None

    def update(self, seq: int) -> tuple[str, ...]:
        """Count the next frame; the flags that its number earns it (see `isocharge.serve.flags`)."""
        step = 1 if self._last is None else (seq - self._last) % SEQ_MODULUS
        self._last = seq
        if step == 1:
            return ()
        if step == 0:
            self.repeated += 1
            return (REPEAT,)
        if step >= SEQ_MODULUS // 2:
            self.restarts += 1
            return (RESTART,)
        self.lost += step - 1
        return (GAP,)
