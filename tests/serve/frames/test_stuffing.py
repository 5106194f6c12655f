"""Byte stuffing, checksums and the binary frame, compared with their definitions and with other libraries.

Checksums are compared with crcmod, the standard library, and the check values of Cook's catalogue, which are the
checksums of b"123456789".
"""

import binascii
import struct
import zlib

import pytest
from cobs import cobs
from crcmod.predefined import mkPredefinedCrcFun

from isocharge.serve import BinaryParser, Frame, encode_frame
from isocharge.serve.frames.transmission import CHECKSUMS, STUFFINGS


@pytest.mark.parametrize(
    ("name", "stuffed", "reason"),
    [
        ("slip", "DB", "expected DC or DD after the byte DB"),
        ("slip", "DB 01", "expected DC or DD after the byte DB"),
        ("hdlc", "31 7D", "expected a byte after 7D"),
    ],
)
def test_damaged_stuffing_is_refused_with_the_reason(name, stuffed, reason):
    with pytest.raises(ValueError, match=reason):
        STUFFINGS[name].decode(bytes.fromhex(stuffed))


CHECK_VALUES = {
    "none": 0,
    "sum-8": 0xDD,
    "sum-16": 0x01DD,
    "xor-8": 0x31,
    "sum-8/negative": 0x23,
    "sum-8/inverted": 0x22,
    "fletcher-16": 0x1EDE,
}
"""Check values of checksums that no other library computes."""

OTHER_LIBRARIES = {
    "crc-8/maxim": mkPredefinedCrcFun("crc-8-maxim"),
    "crc-16/modbus": mkPredefinedCrcFun("modbus"),
    "crc-16/ccitt-false": lambda data: binascii.crc_hqx(data, 0xFFFF),
    "crc-24/openpgp": mkPredefinedCrcFun("crc-24"),
    "crc-32": zlib.crc32,
}
"""Functions of other libraries that compute the same checksums."""


def test_checksums_have_the_check_values_of_the_catalogue():
    for name, value in CHECK_VALUES.items():
        assert CHECKSUMS[name].compute(b"123456789") == value
    for name, compute in OTHER_LIBRARIES.items():
        for data in (b"", b"123456789", bytes(range(256)), b"\xff" * 31):
            assert CHECKSUMS[name].compute(data) == compute(data)


def piece(body):
    """Return a frame with a given content. Other libraries compute the CRC-16/CCITT-FALSE and the stuffing."""
    crc = struct.pack("<H", binascii.crc_hqx(body, 0xFFFF))
    return cobs.encode(body + crc) + b"\0"


@pytest.mark.parametrize(
    ("data", "counter"),
    [
        (piece(b"\x02" + bytes(8)), "malformed"),  # another version
        (piece(b"\x01" + bytes(6) + b"\x03\x00" + bytes(8)), "malformed"),  # three charges announced, two sent
        (piece(b"\x01"), "malformed"),
        (b"\x05ab\0", "malformed"),  # stuffing points beyond the end
        (encode_frame(Frame(1, 2, (3.0,)))[:-2] + b"\x77\0", "crc_errors"),
    ],
)
def test_piece_that_is_no_frame_is_counted(data, counter):
    parser = BinaryParser()
    assert parser.feed(data) == []
    assert (getattr(parser.counts, counter), parser.counts.bytes_dropped) == (1, len(data))


@pytest.mark.parametrize("step", [1, 700, 5000])
def test_overlong_piece_is_counted_once_and_the_next_frame_is_found(step):
    piece_of_zeros = b"\x01" * 20_000 + b"\0"  # valid stuffing, so that only the length is wrong
    frame = Frame(7, 8, (9.0,))
    data = piece_of_zeros + encode_frame(frame)
    parser = BinaryParser()
    parser.sequence_flags(5)
    frames = []
    for start in range(0, len(data), step):
        frames += parser.feed(data[start : start + step])
    assert frames == [frame]
    counts = parser.counts
    assert (counts.malformed, counts.crc_errors, counts.bytes_dropped) == (1, 0, len(piece_of_zeros))
    assert parser.sequence_flags(7) == ("gap",)  # the piece was frame 6
