"""Described frames: the documented layouts of three sensors that are sold, their bytes packed by hand, and damage.

The layouts, as their makers document them, are in tests/data/frames.
"""

import binascii
import math
import struct
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve import DescribedParser, Frame, frame_layout

FOLDER = Path(__file__).parents[2] / "data" / "frames"
LAYOUTS = {path.stem: frame_layout(tomllib.loads(path.read_text("utf-8")), path.name) for path in FOLDER.glob("*.toml")}


def modbus_crc(data):
    """Bit by bit, as the Modbus over serial line specification (V1.02, 6.2.2) puts it in words."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


def test_robotiq():
    data = bytes.fromhex("20 4E") + struct.pack("<6h", 1234, -567, 89, 1000, -2000, 3)
    (frame,) = DescribedParser(LAYOUTS["robotiq_ft300"]).feed(data + modbus_crc(data))
    assert frame.values == pytest.approx((12.34, -5.67, 0.89, 1.0, -2.0, 0.003))
    assert (frame.names, frame.seq, frame.t_us) == (("Fx", "Fy", "Fz", "Mx", "My", "Mz"), None, None)


def test_optoforce():
    data = bytes((170, 7, 8, 10)) + struct.pack(">HHhhh", 65535, 0, 100, -200, 16037)
    (frame,) = DescribedParser(LAYOUTS["optoforce_omd"]).feed(data + struct.pack(">H", sum(data) & 0xFFFF))
    assert (frame.seq, frame.values) == (65535, (100.0, -200.0, 16037.0))


def test_bota():
    body = struct.pack("<H6fIf", 0, 1.5, -2.5, 3.5, 0.125, 0.25, -0.5, 123456, 23.5)
    reflected = int(f"{binary_crc_of_reflected(body):016b}"[::-1], 2) ^ 0xFFFF
    (frame,) = DescribedParser(LAYOUTS["bota_sensone"]).feed(b"\xaa" + body + struct.pack("<H", reflected))
    assert (frame.t_us, frame.values) == (123456, (1.5, -2.5, 3.5, 0.125, 0.25, -0.5, 23.5))


def binary_crc_of_reflected(data):
    """X-25 is CCITT-FALSE of the bit-reversed bytes, reversed and inverted: from the standard library's crc_hqx."""
    return binascii.crc_hqx(bytes(int(f"{byte:08b}"[::-1], 2) for byte in data), 0xFFFF)


COUNTS = st.lists(st.integers(-32768, 32767), min_size=7, max_size=7)


def encoded(name, counts):
    """The bytes of a frame whose channels have these counts."""
    layout = LAYOUTS[name]
    values = [count * field.scale for count, field in zip(counts, layout.channels, strict=False)]
    return layout.encode(Frame(abs(counts[0]), abs(counts[1]), tuple(values)))


@settings(derandomize=True)
@given(st.sampled_from(sorted(LAYOUTS)), COUNTS, st.data())
def test_every_flipped_bit_is_noticed(name, counts, data):
    good = encoded(name, counts)
    at, bit = data.draw(st.integers(0, len(good) - 1)), data.draw(st.integers(0, 7))
    if name == "bota_sensone" and at == 0:
        return  # its header is not covered by the checksum, but without it there is no frame
    bad = good[:at] + bytes([good[at] ^ 1 << bit]) + good[at + 1 :]
    parser = DescribedParser(LAYOUTS[name])
    assert parser.feed(bad + good + bytes(len(good))) == DescribedParser(LAYOUTS[name]).feed(good)


def test_memory_is_bounded():
    parser = DescribedParser(LAYOUTS["optoforce_omd"])
    for _ in range(100):
        parser.feed(b"\xaa\x07\x08" * 400)
        assert len(parser._tail) < 16
    assert parser.counts.bytes_dropped + len(parser._tail) == 120_000


@pytest.mark.parametrize("name", ["seq", "t_us", "t_s"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_or_clock_that_is_no_number_costs_its_frame_only(name, value):
    """Without a checksum nothing else tells that the line was damaged."""
    fields = f'fields = [{{name = "{name}", type = "f32"}}, {{name = "A", type = "f32"}}]'
    layout = frame_layout(tomllib.loads(f'sync = "20 4E"\nlength = 10\n{fields}'), "test")
    good, bad = (b"\x20\x4e" + struct.pack("<ff", number, 1.0) for number in (2.0, value))
    parser = DescribedParser(layout)
    assert [frame.values for frame in parser.feed(good + bad + good)] == [(1.0,), (1.0,)]
    assert (parser.counts.frames, parser.counts.malformed, parser.counts.bytes_dropped) == (2, 1, 10)
