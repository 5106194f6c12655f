"""Frames against others' code and figures, and the parser against damage."""

import binascii
import struct

import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve import BinaryParser, Frame, encode_frame
from isocharge.serve.frames.binary import CRC, DELIMITER, LONGEST_PIECE, crc16
from isocharge.serve.frames.cobs import cobs_decode, cobs_encode

FLOATS = st.floats(width=32, allow_nan=False)
FRAMES = st.builds(
    Frame,
    seq=st.integers(0, 2**16 - 1),
    t_us=st.integers(0, 2**32 - 1),
    values=st.lists(FLOATS, max_size=8).map(tuple),
    flags=st.integers(0, 255),
)


def test_crc_has_the_published_check_value():
    assert crc16(b"123456789") == 0x29B1  # CRC-16/CCITT-FALSE (also IBM-3740) in Cook's catalogue


@settings(derandomize=True)
@given(st.one_of(st.binary(max_size=600), st.binary(min_size=240, max_size=270).map(lambda data: data * 2)))
def test_cobs_equals_the_cobs_package(data):
    assert cobs_encode(data) == cobs.encode(data)
    assert cobs_decode(cobs.encode(data)) == data


@pytest.mark.parametrize("n", [253, 254, 255, 507, 508, 509, 510])
@pytest.mark.parametrize("tail", [b"", b"\0", b"\0x", b"x\0"])
def test_cobs_about_the_block_length(n, tail):
    data = b"x" * n + tail
    assert cobs_encode(data) == cobs.encode(data)
    assert cobs_decode(cobs_encode(data)) == data


@settings(derandomize=True)
@given(st.binary(min_size=1, max_size=300))
def test_cobs_refuses_what_the_cobs_package_refuses(data):
    try:
        expected = cobs.decode(data)
    except cobs.DecodeError:
        with pytest.raises(ValueError, match="follow"):
            cobs_decode(data)
    else:
        assert cobs_decode(data) == expected


def test_layout_of_a_frame():
    """Against the layout of the design, packed by hand."""
    frame = Frame(seq=0x1234, t_us=0x89ABCDEF, values=(1.0, -2.5, 848.25), flags=1)
    body = bytes([1]) + struct.pack("<H", 0x1234) + struct.pack("<I", 0x89ABCDEF) + bytes([3, 1])
    body += struct.pack("<fff", 1.0, -2.5, 848.25)
    body += struct.pack("<H", binascii.crc_hqx(body, 0xFFFF))
    assert encode_frame(frame) == cobs.encode(body) + b"\0"


@settings(derandomize=True)
@given(FRAMES)
def test_round_trip(frame):
    assert BinaryParser().feed(encode_frame(frame)) == [frame]


def test_longest_frame_fits():
    frame = Frame(1, 2, (1.5,) * 255)
    parser = BinaryParser()
    assert len(encode_frame(frame)) <= LONGEST_PIECE + 1
    assert parser.feed(encode_frame(frame)) == [frame]


@settings(derandomize=True)
@given(FRAMES, st.data())
def test_every_flipped_bit_is_noticed(frame, data):
    """A CRC catches every single error; one that makes or removes a zero shifts the frame's edges instead."""
    good = encode_frame(frame)
    at, bit = data.draw(st.integers(0, len(good) - 2)), data.draw(st.integers(0, 7))
    bad = good[:at] + bytes([good[at] ^ 1 << bit]) + good[at + 1 :]
    parser = BinaryParser()
    assert parser.feed(bad + DELIMITER + good) == [frame]
    assert parser.counts.crc_errors + parser.counts.malformed >= 1


def payload(body):
    return cobs_encode(body + CRC.pack(crc16(body))) + DELIMITER


@pytest.mark.parametrize(
    ("data", "counter"),
    [
        (payload(b"\x02" + bytes(8)), "malformed"),  # another version
        (payload(b"\x01" + bytes(6) + b"\x03\x00" + bytes(8)), "malformed"),  # three charges announced, two sent
        (payload(b"\x01"), "malformed"),
        (b"\x05ab\0", "malformed"),  # stuffing points beyond the end
        (encode_frame(Frame(1, 2, (3.0,)))[:-2] + b"\x77\0", "crc_errors"),
    ],
)
def test_piece_that_is_no_frame_is_counted(data, counter):
    parser = BinaryParser()
    assert parser.feed(data) == []
    assert getattr(parser.counts, counter) == 1
    assert parser.counts.bytes_dropped == len(data)


def test_idle_delimiters_are_no_error():
    parser = BinaryParser()
    parser.feed(b"\0" * 100)
    assert (parser.counts.malformed, parser.counts.bytes_dropped) == (0, 0)


def test_memory_is_bounded_and_the_next_frame_found():
    parser, frame = BinaryParser(), Frame(7, 8, (9.0,))
    for _ in range(1000):
        assert parser.feed(b"\x55" * 1000) == []
        assert len(parser._pieces._tail) <= LONGEST_PIECE
    assert parser.feed(DELIMITER + encode_frame(frame)) == [frame]
    assert (parser.counts.malformed, parser.counts.bytes_dropped) == (1, 1_000_001)


def test_overlong_piece_counts_the_same_however_it_is_cut():
    data = b"\x01" * 2 * LONGEST_PIECE + DELIMITER  # sound stuffing of zeros, so that only its length is wrong
    whole, bytewise = BinaryParser(), BinaryParser()
    whole.feed(data)
    for i in range(len(data)):
        bytewise.feed(data[i : i + 1])
    assert whole.counts == bytewise.counts
    assert (whole.counts.malformed, whole.counts.bytes_dropped) == (1, len(data))
