"""Described frames: the documented layouts of sensors that are sold, damage, and wrong descriptions.

Layouts as their makers document them: Bota Systems SensONE (0xAA; status u16, six f32, time u32, temperature f32;
CRC-16/X-25 over all but the header), OptoForce OMD 3-axis (AA 07 08 0A; counter, status, three i16; sum of all bytes;
big-endian), Robotiq FT 300 (20 4E; six i16 in 0.01 N and 0.001 Nm; CRC-16/Modbus). Their bytes are packed by hand here.
"""

import math
import struct
import tomllib
from itertools import pairwise

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from isocharge.errors import DeviceError
from isocharge.serve import DescribedParser, Frame, frame_layout

ROBOTIQ = """
sync = "20 4E"
length = 16
checksum = "crc-16/modbus"
fields = [
  {name = "Fx", type = "i16", scale = 0.01}, {name = "Fy", type = "i16", scale = 0.01},
  {name = "Fz", type = "i16", scale = 0.01}, {name = "Mx", type = "i16", scale = 0.001},
  {name = "My", type = "i16", scale = 0.001}, {name = "Mz", type = "i16", scale = 0.001},
]
"""
OPTOFORCE = """
sync = "AA 07 08 0A"
length = 16
byte_order = "big"
checksum = "sum-16"
fields = [
  {name = "seq", type = "u16"}, {type = "pad", count = 2},
  {name = "Fx", type = "i16"}, {name = "Fy", type = "i16"}, {name = "Fz", type = "i16"},
]
"""
BOTA = """
sync = "AA"
length = 37
checksum = "crc-16/x-25"
checksum_from = 1
fields = [
  {type = "pad", count = 2},
  {name = "Fx", type = "f32"}, {name = "Fy", type = "f32"}, {name = "Fz", type = "f32"},
  {name = "Mx", type = "f32"}, {name = "My", type = "f32"}, {name = "Mz", type = "f32"},
  {name = "t_us", type = "u32"}, {name = "temperature", type = "f32"},
]
"""


def layout(text):
    return frame_layout(tomllib.loads(text), "device.toml")


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
    (frame,) = DescribedParser(layout(ROBOTIQ)).feed(data + modbus_crc(data))
    assert frame.values == pytest.approx((12.34, -5.67, 0.89, 1.0, -2.0, 0.003))
    assert (frame.names, frame.seq, frame.t_us) == (("Fx", "Fy", "Fz", "Mx", "My", "Mz"), None, None)


def test_optoforce():
    data = bytes((170, 7, 8, 10)) + struct.pack(">HHhhh", 65535, 0, 100, -200, 16037)
    (frame,) = DescribedParser(layout(OPTOFORCE)).feed(data + struct.pack(">H", sum(data) & 0xFFFF))
    assert (frame.seq, frame.values) == (65535, (100.0, -200.0, 16037.0))


def test_bota():
    body = struct.pack("<H6fIf", 0, 1.5, -2.5, 3.5, 0.125, 0.25, -0.5, 123456, 23.5)
    reflected = int(f"{binary_crc_of_reflected(body):016b}"[::-1], 2) ^ 0xFFFF
    (frame,) = DescribedParser(layout(BOTA)).feed(b"\xaa" + body + struct.pack("<H", reflected))
    assert (frame.t_us, frame.values) == (123456, (1.5, -2.5, 3.5, 0.125, 0.25, -0.5, 23.5))


def binary_crc_of_reflected(data):
    """X-25 is CCITT-FALSE of the bit-reversed bytes, reversed and inverted: from the standard library's crc_hqx."""
    import binascii

    return binascii.crc_hqx(bytes(int(f"{byte:08b}"[::-1], 2) for byte in data), 0xFFFF)


LAYOUTS = {"robotiq": layout(ROBOTIQ), "optoforce": layout(OPTOFORCE), "bota": layout(BOTA)}
COUNTS = st.lists(st.integers(-32768, 32767), min_size=7, max_size=7)


def encoded(name, counts):
    described = LAYOUTS[name]
    values = [count * field.scale for count, field in zip(counts, described.channels, strict=False)]
    return described.encode(Frame(abs(counts[0]), abs(counts[1]), tuple(values)))


def junk_for(name):
    """Noise, often with the sync pattern in it."""
    sync = LAYOUTS[name].sync
    return st.lists(st.one_of(st.just(sync), st.just(sync[:1]), st.binary(max_size=6)), min_size=1, max_size=5).map(
        b"".join
    )


STREAMS = st.sampled_from(sorted(LAYOUTS)).flatmap(
    lambda name: st.tuples(
        st.just(name), st.lists(st.tuples(COUNTS, st.none() | junk_for(name)), min_size=1, max_size=8)
    )
)


@settings(derandomize=True)
@given(STREAMS, st.lists(st.integers(0, 400), max_size=10))
def test_chunking_never_changes_the_frames(stream, cuts):
    name, pairs = stream
    data = b"".join(encoded(name, counts) + (junk or b"") for counts, junk in pairs)
    whole, cut, bytewise = (DescribedParser(LAYOUTS[name]) for _ in range(3))
    frames = whole.feed(data)
    edges = [0, *sorted(min(c, len(data)) for c in cuts), len(data)]
    assert [f for a, b in pairwise(edges) for f in cut.feed(data[a:b])] == frames
    assert [f for i in range(len(data)) for f in bytewise.feed(data[i : i + 1])] == frames
    assert whole.counts == cut.counts == bytewise.counts


class SkippingParser(DescribedParser):
    """The planted fault: where the checksum does not fit it goes on behind the frame instead of by one byte."""

    def feed(self, data):
        data, at, frames = self._tail + data, 0, []
        while (start := data.find(self.layout.sync, at)) >= 0 and start + self.layout.length <= len(data):
            at = start + self.layout.length
            frame = self._decode(data[start:at])
            frames += [] if frame is None else [frame]
        self._tail = data[start if start >= 0 else len(data) - len(self.layout.sync) + 1 :]
        return frames


def loses_no_intact_frame(parser_type):
    @settings(derandomize=True, database=None, phases=[Phase.generate])
    @given(STREAMS)
    def check(stream):
        name, pairs = stream
        data = b"".join((junk or b"") + encoded(name, counts) for counts, junk in pairs)
        one_by_one = [
            frame for counts, _ in pairs for frame in DescribedParser(LAYOUTS[name]).feed(encoded(name, counts))
        ]
        got = parser_type(LAYOUTS[name]).feed(data + bytes(LAYOUTS[name].length))
        assert len(one_by_one) == len(pairs)
        assert got == one_by_one

    check()


def test_no_intact_frame_is_lost():
    loses_no_intact_frame(DescribedParser)


def test_a_parser_that_skips_a_frame_is_caught():
    with pytest.raises(AssertionError):
        loses_no_intact_frame(SkippingParser)


@settings(derandomize=True)
@given(st.sampled_from(sorted(LAYOUTS)), COUNTS, st.data())
def test_every_flipped_bit_is_noticed(name, counts, data):
    good = encoded(name, counts)
    at, bit = data.draw(st.integers(0, len(good) - 1)), data.draw(st.integers(0, 7))
    if name == "bota" and at == 0:
        return  # its header is not covered by the checksum, but without it there is no frame
    bad = good[:at] + bytes([good[at] ^ 1 << bit]) + good[at + 1 :]
    parser = DescribedParser(LAYOUTS[name])
    assert parser.feed(bad + good + bytes(len(good))) == DescribedParser(LAYOUTS[name]).feed(good)


def test_memory_is_bounded():
    parser = DescribedParser(LAYOUTS["optoforce"])
    for _ in range(100):
        parser.feed(b"\xaa\x07\x08" * 400)
        assert len(parser._tail) < 16
    assert parser.counts.bytes_dropped + len(parser._tail) == 120_000


def test_counters_and_clocks_wrap_and_channels_stay_at_their_limit():
    text = """
sync = "55"
length = 5
fields = [{name = "seq", type = "u8"}, {name = "t_ms", type = "u8"}, {name = "A", type = "i16", scale = 0.5}]
"""
    described = layout(text)
    parser = DescribedParser(described)
    assert parser.feed(described.encode(Frame(257, 300_000, (1e6,)))) == [Frame(1, 44_000, (16383.5,), names=("A",))]
    assert (parser.seq_modulus, parser.t_us_modulus) == (256, 256_000)


@pytest.mark.parametrize("name", ["seq", "t_us", "t_s"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_or_clock_that_is_no_number_costs_its_frame_only(name, value):
    """Without a checksum nothing else tells that the line was damaged."""
    fields = f'fields = [{{name = "{name}", type = "f32"}}, {{name = "A", type = "f32"}}]'
    described = layout(f'sync = "20 4E"\nlength = 10\n{fields}')
    good, bad = (b"\x20\x4e" + struct.pack("<ff", number, 1.0) for number in (2.0, value))
    parser = DescribedParser(described)
    assert [frame.values for frame in parser.feed(good + bad + good)] == [(1.0,), (1.0,)]
    assert (parser.counts.frames, parser.counts.malformed, parser.counts.bytes_dropped) == (2, 1, 10)


WRONG = [
    ("length = 16", "length = 17", r"frames\.length: expected 16 for these fields, got 17"),
    ('sync = "20 4E"', 'sync = "hello"', r"frames\.sync: expected bytes in hexadecimal, as in '20 4E', got 'hello'"),
    ('sync = "20 4E"', "sync = 204", r"frames\.sync: expected a text, got 204"),
    ('sync = "20 4E"', "", r"key 'frames\.sync' is missing"),
    ('checksum = "crc-16/modbus"', 'checksum = "crc-99"', r"frames\.checksum: expected one of none, sum-8.*, got 'crc-99'"),
    ('checksum = "crc-16/modbus"', 'cheksum = "crc-16/modbus"', r"unknown key 'frames\.cheksum'; known are sync, length"),
    ('type = "i16"', 'type = "i24"', r"frames\.fields\[1\]\.type: expected one of pad, u8.*, got 'i24'"),
    ('type = "i16"', 'type = "i16", count = 2', r"frames\.fields\[1\]\.count: expected 1, because only .* pad .*, got 2"),
    ('type = "i16"', 'type = "pad", count = 5000', r"frames\.fields\[1\]\.count: expected a whole number from 1 to 4096"),
    ('name = "Fy"', 'name = "Fx"', r"frames\.fields: expected names that differ, got \['Fx', 'Fx'"),
    ('name = "Fy"', 'label = "Fy"', r"unknown key 'frames\.fields\[2\]\.label'"),
    ('name = "Fy", ', "", r"key 'frames\.fields\[2\]\.name' is missing"),
    ("scale = 0.01", "scale = 0", r"frames\.fields\[1\]\.scale: expected a finite number that is not 0, got 0"),
    ("scale = 0.01", "scale = nan", r"frames\.fields\[1\]\.scale: expected a finite number that is not 0, got nan"),
    ("length = 16", 'length = 16\nbyte_order = "middle"', r"byte_order: expected one of little, big, got 'middle'"),
    ("length = 16", "length = 16\nchecksum_from = 14", r"checksum_from: expected less than 14, inside the frame, got 14"),
    ("length = 16", "length = 16\nchecksum_from = -1", r"checksum_from: expected a whole number from 0, got -1"),
]


@pytest.mark.parametrize(("good", "bad", "said"), WRONG)
def test_wrong_descriptions(good, bad, said):
    with pytest.raises(DeviceError, match=rf"^device\.toml: .*{said}"):
        layout(ROBOTIQ.replace(good, bad, 1))


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ("[]", r"frames\.fields: expected one or more that are channels, got \[\]"),
        ('[{name = "seq", type = "u8"}]', r"frames\.fields: expected one or more that are channels, got \['seq'\]"),
        ("3", r"frames\.fields: expected a list of tables, got 3"),
        ("[3]", r"frames\.fields\[1\]: expected a table, got 3"),
    ],
)
def test_fields_that_make_no_frame(fields, said):
    with pytest.raises(DeviceError, match=said):
        layout(f'sync = "55"\nlength = 2\nfields = {fields}')
