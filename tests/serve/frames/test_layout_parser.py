"""Frames whose layout a device file describes: parsing, encoding, damaged frames, and wrong descriptions.

The folder tests/data/frames contains the layouts of three sensors, as their makers document them.
"""

import math
import struct
import tomllib
from pathlib import Path

import numpy as np
import pytest
from crcmod.predefined import mkPredefinedCrcFun
from hypothesis import given, settings
from hypothesis import strategies as st

from frame_formats import FORMATS, STUFFINGS
from isocharge.common.errors import DeviceError
from isocharge.serve import Frame, device_from_table
from isocharge.serve.frames.frame_layout import SyncParser
from layout_encoder import encode_layout

FOLDER = Path(__file__).parents[2] / "data/frames"


def layout(keys):
    """Return the layout with the given keys of the section `[frames]`, which are a table or TOML text."""
    table = tomllib.loads(keys) if isinstance(keys, str) else keys
    return device_from_table({"frames": {"format": "described"} | table}, "device.toml").frames


LAYOUTS = {path.stem: layout(path.read_text("utf-8")) for path in FOLDER.glob("*.toml")}


def with_crc(name, body):
    """Return a body and its checksum of 16 bits, which crcmod computes."""
    return body + struct.pack("<H", mkPredefinedCrcFun(name)(body))


ROBOTIQ_BODY = bytes.fromhex("20 4E") + struct.pack("<6h", 1234, -567, 89, 1000, -2000, 3)
OPTOFORCE_BODY = bytes((170, 7, 8, 10)) + struct.pack(">HHhhh", 65535, 0, 100, -200, 16037)
BOTA_BODY = struct.pack("<H6fIf", 0, 1.5, -2.5, 3.5, 0.125, 0.25, -0.5, 123456, 23.5)


@pytest.mark.parametrize(
    ("name", "data", "seq", "t_us", "values"),
    [
        ("robotiq_ft300", with_crc("modbus", ROBOTIQ_BODY), None, None, (12.34, -5.67, 0.89, 1.0, -2.0, 0.003)),
        (
            "optoforce_omd",
            OPTOFORCE_BODY + struct.pack(">H", sum(OPTOFORCE_BODY) & 0xFFFF),
            65535,
            None,
            (100.0, -200.0, 16037.0),
        ),
        (
            "bota_sensone",
            b"\xaa" + with_crc("x-25", BOTA_BODY),
            None,
            123456,
            (1.5, -2.5, 3.5, 0.125, 0.25, -0.5, 23.5),
        ),
    ],
)
def test_frames_of_sensors_as_their_makers_describe_them(name, data, seq, t_us, values):
    (frame,) = SyncParser(LAYOUTS[name]).feed(data)
    assert (frame.seq, frame.t_us) == (seq, t_us)
    assert frame.values == pytest.approx(values)
    assert frame.names == LAYOUTS[name].columns.names


@settings(derandomize=True)
@given(st.data(), st.integers(1, 50))
def test_every_byte_is_a_part_of_a_frame_or_counted_as_dropped(data, step):
    """After a reset, no byte is stored, and no byte has been counted twice."""
    form = FORMATS["described"]
    stream = b"".join(data.draw(st.lists(form.frames.map(form.encode) | form.junk, max_size=12)))
    parser = form.parser()
    for start in range(0, len(stream), step):
        parser.feed(stream[start : start + step])
    parser.reset()
    assert parser.counts.bytes_dropped == len(stream) - len(form.tail) * parser.counts.frames


@pytest.mark.parametrize("name", ["seq", "t_s"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_counter_or_clock_that_is_nan_drops_only_its_frame(name, value):
    """Without a checksum, only this value shows that the frame is damaged."""
    fields = [{"name": name, "type": "f32"}, {"name": "A", "type": "f32"}]
    parser = SyncParser(layout({"sync": "20 4E", "length": 10, "fields": fields}))
    data = b"".join(b"\x20\x4e" + struct.pack("<ff", number, 1.0) for number in (2.0, value, 2.0))
    assert [frame.values for frame in parser.feed(data)] == [(1.0,), (1.0,)]
    assert (parser.counts.frames, parser.counts.malformed, parser.counts.bytes_dropped) == (2, 1, 10)


TRIPLES = """
sync = "A5 5A"
length = 13
byte_order = "{order}"
checksum = "crc-16/xmodem"
checksum_from = 2
checksum_order = "little"
fields = [{{name = "A", type = "i24"}}, {{name = "B", type = "u24", scale = 0.5}}, {{name = "C", type = "i24"}}]
"""


@settings(derandomize=True)
@given(st.lists(st.integers(0, (1 << 24) - 1), min_size=3, max_size=3), st.sampled_from(["little", "big"]))
def test_numbers_of_three_bytes(numbers, order):
    """The checksum does not cover the sync, and has another byte order than the numbers."""
    described = layout(TRIPLES.format(order=order))
    data = b"\xa5\x5a" + with_crc("xmodem", b"".join(number.to_bytes(3, order) for number in numbers))
    (frame,) = SyncParser(described).feed(data)
    a, b, c = ((number ^ 0x800000) - 0x800000 for number in numbers)  # two's complement
    assert frame.values == (a, b % (1 << 24) / 2, c)
    assert encode_layout(described, frame) == data


def datagram_parser(**others):
    """Return the parser of datagrams whose frames have six bytes, with a counter and one channel."""
    fields = [{"name": "seq", "type": "u8"}, {"name": "A", "type": "f32"}]
    return layout({"framing": "datagram", "length": 6, "fields": fields} | others).parser()


def test_damaged_frame_in_a_datagram_makes_no_other_frame():
    parser = datagram_parser(checksum="sum-8")
    for value in np.random.default_rng(0).normal(size=200):
        datagram = bytearray()
        for seq in range(4):
            frame = struct.pack("<Bf", seq, value)
            datagram += frame + bytes([sum(frame) % 256])
        datagram[15] ^= 0x55
        assert [frame.seq for frame in parser.feed(bytes(datagram))] == [0, 1, 3]
    assert (parser.counts.crc_errors, parser.counts.bytes_dropped) == (200, 1200)


@pytest.mark.parametrize(("framing", "byte"), [("slip", 0xC0), ("slip", 0xDB), ("hdlc", 0x7E), ("hdlc", 0x7D)])
def test_frame_in_which_every_byte_is_stuffed_is_not_too_long(framing, byte):
    fields = [{"name": name, "type": "u8"} for name in "ABC"]
    delimiter, stuff = STUFFINGS[framing]
    layout = {"format": "described", "framing": framing, "length": 3, "fields": fields}
    parser = device_from_table({"frames": layout}, "board").frames.parser()
    frames = parser.feed(2 * (delimiter + stuff(bytes([byte] * 3))) + delimiter)
    assert [frame.values for frame in frames] == 2 * [(byte, byte, byte)]


def test_datagrams_contain_whole_frames():
    parser = datagram_parser(sync="A5")
    first, second = (struct.pack("<BBf", 0xA5, seq, seq) for seq in (1, 2))
    read = [
        (first + second, [1, 2]),
        (first + b"\n", [1]),  # as a UDP socket adds it to text
        (first[:3], []),
        (b"\x5a" + first[1:] + second, [2]),  # another sync
    ]
    for datagram, numbers in read:
        assert [frame.values[0] for frame in parser.feed(datagram)] == numbers
    assert (parser.counts.malformed, parser.counts.bytes_dropped) == (2, 9)


@pytest.mark.parametrize("framing", [{"sync": "A5", "length": 5}, {"framing": "cobs"}, {"framing": "datagram"}])
def test_counter_and_clock_wrap_at_the_ends_of_their_fields(framing):
    fields = [{"name": "seq", "type": "u8"}, {"name": "t_ms", "type": "u16"}, {"name": "A", "type": "i8"}]
    parser = layout({"length": 4, "fields": fields} | framing).parser()
    assert (parser.seq_modulus, parser.t_us_modulus) == (256, 65_536_000)


def test_constant_bytes_are_checked():
    """The byte after the counter is the length of the frame. Frames of another kind differ in this byte."""
    text = """
sync = "7E"
length = 5
fields = [{name = "seq", type = "u8"}, {type = "pad", value = "02"}, {name = "A", type = "i16"}]
"""
    described = layout(text)
    frames = SyncParser(described).feed(bytes.fromhex("7E 01 02 10 00  7E 02 09 11 22  7E 03 02 20 00"))
    assert [(frame.seq, frame.values) for frame in frames] == [(1, (16.0,)), (3, (32.0,))]
    assert encode_layout(described, Frame(1, 0, (16.0,))) == bytes.fromhex("7E 01 02 10 00")


ROBOTIQ = (FOLDER / "robotiq_ft300.toml").read_text("utf-8")


WRONG = [
    ("length = 16", "length = 17", r"length: expected 16 for these fields, got 17"),
    ('sync = "20 4E"', 'sync = "hello"', r"sync: expected bytes in hexadecimal, as in '20 4E', got 'hello'"),
    (
        'checksum = "crc-16/modbus"',
        'checksum = "crc-99"',
        r"checksum: expected one of none, sum-8.*, got 'crc-99'",
    ),
    (
        'checksum = "crc-16/modbus"',
        'cheksum = "crc-16/modbus"',
        r"cheksum'; did you mean 'checksum'\? Known are format, request",
    ),
    ('type = "i16"', 'type = "i48"', r"fields\[0\]\.type: expected one of f32, f64, i16.*, got 'i48'"),
    (
        'type = "i16"',
        'type = "i16", count = 2',
        r"fields\[0\]\.count: expected none, because only .* pad .*, got 2",
    ),
    (
        'type = "i16"',
        'type = "pad", count = 5000',
        r"fields\[0\]\.count: expected a whole number from 1 to 4096",
    ),
    ('name = "Fy"', 'name = "Fx"', r"fields: expected names that differ, got \['Fx', 'Fx'"),
    ('name = "Fy"', 'label = "Fy"', r"fields\[1\]\.label'"),
    ("scale = 0.01", "scale = 0", r"fields\[0\]\.scale: expected a finite number that is not 0, got 0"),
    (
        "length = 16",
        "length = 16\nchecksum_from = 14",
        r"checksum_from: expected less than 14, inside the frame, got 14",
    ),
]


@pytest.mark.parametrize(("good", "bad", "message"), WRONG)
def test_wrong_frame_descriptions_are_refused(good, bad, message):
    with pytest.raises(DeviceError, match=rf"^device\.toml: (unknown key |key )?\'?frames\.{message}"):
        layout(ROBOTIQ.replace(good, bad, 1))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ("[]", r"fields: expected one or more that are channels, got \[\]"),
        ('[{name = "seq", type = "u8"}]', r"fields: expected one or more that are channels, got \['seq'\]"),
        ('[{name = "t_us", type = "u8", scale = 0.001}, {name = "A", type = "u8"}]', "a clock with a positive scale"),
        ("3", r"fields: expected a list of tables, got 3"),
        ("[3]", r"fields\[0\]: expected a table, got 3"),
    ],
)
def test_device_file_with_wrong_fields_is_refused(fields, message):
    with pytest.raises(DeviceError, match=message):
        layout(f'sync = "55"\nlength = 2\nfields = {fields}')
