"""The binary frame against others' code and figures, and its parser against damage."""

import binascii
import struct

import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve import BinaryParser, Frame, encode_frame
from isocharge.serve.frames.binary import LONGEST_PIECE

FRAMES = st.builds(
    Frame,
    seq=st.integers(0, 2**16 - 1),
    t_us=st.integers(0, 2**32 - 1),
    values=st.lists(st.floats(width=32, allow_nan=False), max_size=8).map(tuple),
    flags=st.integers(0, 255),
)


def piece(body):
    """The bytes of a frame around its content: CRC-16/CCITT-FALSE and COBS by others."""
    return cobs.encode(body + struct.pack("<H", binascii.crc_hqx(body, 0xFFFF))) + b"\0"


def test_layout_of_a_frame():
    """Against the layout of the design, packed by hand."""
    body = bytes([1]) + struct.pack("<H", 0x1234) + struct.pack("<I", 0x89ABCDEF) + bytes([3, 1])
    frame = Frame(seq=0x1234, t_us=0x89ABCDEF, values=(1.0, -2.5, 848.25), flags=1)
    assert encode_frame(frame) == piece(body + struct.pack("<fff", 1.0, -2.5, 848.25))


@pytest.mark.parametrize("n", [0, 1, 60, 61, 62, 255])
def test_round_trip_of_any_number_of_charges(n):
    frame = Frame(1, 2, tuple(k + 0.5 for k in range(n)))
    assert len(encode_frame(frame)) <= LONGEST_PIECE + 1
    assert BinaryParser().feed(encode_frame(frame)) == [frame]


@settings(derandomize=True)
@given(FRAMES, st.data())
def test_every_flipped_bit_is_noticed(frame, data):
    """A CRC catches every single error; one that makes or removes a zero shifts the frame's edges instead."""
    good = encode_frame(frame)
    at, bit = data.draw(st.integers(0, len(good) - 2)), data.draw(st.integers(0, 7))
    bad = good[:at] + bytes([good[at] ^ 1 << bit]) + good[at + 1 :]
    parser = BinaryParser()
    assert parser.feed(bad + b"\0" + good) == [frame]
    assert parser.counts.crc_errors + parser.counts.malformed >= 1


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
    assert getattr(parser.counts, counter) == 1
    assert parser.counts.bytes_dropped == len(data)


def test_a_piece_of_a_megabyte_is_counted_once_and_the_next_frame_found():
    parser, frame = BinaryParser(), Frame(7, 8, (9.0,))
    for _ in range(1000):
        assert parser.feed(b"\x55" * 1000) == []
    assert parser.feed(b"\0" + encode_frame(frame)) == [frame]
    assert (parser.counts.malformed, parser.counts.bytes_dropped) == (1, 1_000_001)


@pytest.mark.parametrize("step", [1, 700, 5000])
def test_overlong_piece_counts_the_same_however_it_is_cut(step):
    data = b"\x01" * 2 * LONGEST_PIECE + b"\0"  # sound stuffing of zeros, so that only its length is wrong
    parser = BinaryParser()
    for at in range(0, len(data), step):
        assert parser.feed(data[at : at + step]) == []
    assert (parser.counts.malformed, parser.counts.crc_errors, parser.counts.bytes_dropped) == (1, 0, len(data))
