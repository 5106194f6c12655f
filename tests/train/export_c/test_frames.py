"""The binary frame in C against ours, on any bytes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve import BinaryParser
from isocharge.serve.frames.binary import encode_frame
from isocharge.serve.frames.frame import T_US_MODULUS, Frame
from isocharge.serve.port.device_clock import DeviceClock

SINGLE = st.floats(width=32, allow_nan=False)
FRAMES = st.builds(
    Frame,
    seq=st.integers(0, 65535),
    t_us=st.integers(0, T_US_MODULUS - 1),
    values=st.lists(SINGLE, max_size=255).map(tuple),
    flags=st.integers(0, 255),
)
LONG = st.binary(min_size=1050, max_size=1100)
PIECES = st.one_of(FRAMES.map(encode_frame), st.binary(max_size=40), st.just(b"\0"), LONG)
DAMAGE = st.lists(st.tuples(st.integers(0, 3000), st.integers(0, 255)), max_size=3)


@pytest.fixture(scope="module")
def exported(build):
    return build("three-25um-biaxial")


@given(pieces=st.lists(PIECES, max_size=6), damage=DAMAGE)
@settings(max_examples=300, deadline=None)
def test_any_bytes_give_the_frames_and_counters_of_ours(exported, pieces, damage):
    data = bytearray(b"".join(pieces) + b"\0")
    for place, value in damage:
        data[place % len(data)] = value
    data += b"\0"
    parser = BinaryParser()
    frames = [(frame.seq, frame.t_us, frame.flags, frame.values) for frame in parser.feed(bytes(data))]
    counts = parser.counts
    theirs, their_counts = exported.frames(bytes(data))
    np.testing.assert_equal(theirs, frames)
    assert their_counts == (counts.frames, counts.crc_errors, counts.malformed, counts.bytes_dropped)


@given(frame=FRAMES)
@settings(max_examples=200, deadline=None)
def test_frames_are_written_as_ours(exported, frame):
    assert exported.encode(frame.seq, frame.t_us, frame.flags, frame.values) == encode_frame(frame)


@pytest.mark.parametrize("n", [0, 1, 60, 61, 62, 63, 124, 125, 126, 255])
def test_frames_without_a_zero_are_cut_at_254_bytes(exported, n):
    frame = Frame(0x0101, 0x01010101, (np.frombuffer(b"\1\1\1\1" * n, np.float32)).tolist(), 1)
    assert exported.encode(frame.seq, frame.t_us, frame.flags, frame.values) == encode_frame(frame)
    assert exported.frames(encode_frame(frame))[0] == [(frame.seq, frame.t_us, 1, tuple(frame.values))]


def test_a_block_of_254_bytes_may_end_a_frame(exported):
    charges = bytearray(b"\1" * 4 * 124)
    charges[9 + 4 * 124 + 2 - 255 - 9] = 0
    frame = Frame(0x0101, 0x01010101, tuple(np.frombuffer(charges, np.float32).tolist()), 1)
    assert b"\xff" in encode_frame(frame)[-256:-254]
    assert exported.encode(frame.seq, frame.t_us, frame.flags, frame.values) == encode_frame(frame)


def test_the_clock_wraps_and_restarts_as_ours(exported):
    rng = np.random.default_rng(0)
    t_us = (4_294_000_000 + np.cumsum(rng.integers(0, 20_000, 500))) % T_US_MODULUS
    t_us[300:] = (t_us[300:] - t_us[300] + 17) % T_US_MODULUS  # the board was reset
    t_us[400:] = (t_us[400:] + (1 << 31) + 500_000) % T_US_MODULUS  # half its range ahead counts as back
    clock = DeviceClock()
    times = [clock.read(int(t), T_US_MODULUS, 0.0) for t in t_us]
    t_s, dt_s = exported.clock(t_us)
    np.testing.assert_allclose(t_s, [time.clock_s for time in times], rtol=1e-15)
    np.testing.assert_allclose(dt_s, [time.step_s for time in times], rtol=1e-15)
    assert clock.restarts == 2
