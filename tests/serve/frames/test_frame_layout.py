"""Descriptions of frames: what is read, what is refused, and the bytes of a frame."""

import tomllib
from pathlib import Path

import pytest

from isocharge.common.errors import DeviceError
from isocharge.serve import Frame
from isocharge.serve.frames.formats import frame_layout
from isocharge.serve.frames.layout_parser import DescribedParser

ROBOTIQ = (Path(__file__).parents[2] / "data" / "frames" / "robotiq_ft300.toml").read_text("utf-8")


def layout(text):
    return frame_layout(tomllib.loads(text), "device.toml")


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


WRONG = [
    ("length = 16", "length = 17", r"length: expected 16 for these fields, got 17"),
    ('sync = "20 4E"', 'sync = "hello"', r"sync: expected bytes in hexadecimal, as in '20 4E', got 'hello'"),
    ('sync = "20 4E"', "sync = 204", r"sync: expected bytes in hexadecimal, as in '20 4E', got 204"),
    ('sync = "20 4E"', "", r"sync' is missing"),
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
    ('type = "i16"', 'type = "i48"', r"fields\[1\]\.type: expected one of pad, u8.*, got 'i48'"),
    (
        'type = "i16"',
        'type = "i16", count = 2',
        r"fields\[1\]\.count: expected none, because only .* pad .*, got 2",
    ),
    (
        'type = "i16"',
        'type = "pad", count = 5000',
        r"fields\[1\]\.count: expected a whole number from 1 to 4096",
    ),
    ('name = "Fy"', 'name = "Fx"', r"fields: expected names that differ, got \['Fx', 'Fx'"),
    ('name = "Fy"', 'label = "Fy"', r"fields\[2\]\.label'"),
    ('name = "Fy", ', "", r"fields\[2\]\.name' is missing"),
    ("scale = 0.01", "scale = 0", r"fields\[1\]\.scale: expected a finite number that is not 0, got 0"),
    ("scale = 0.01", "scale = nan", r"fields\[1\]\.scale: expected a finite number, got nan"),
    ("length = 16", 'length = 16\nbyte_order = "middle"', r"byte_order: expected one of little, big, got 'middle'"),
    (
        "length = 16",
        "length = 16\nchecksum_from = 14",
        r"checksum_from: expected less than 14, inside the frame, got 14",
    ),
    ("length = 16", "length = 16\nchecksum_from = -1", r"checksum_from: expected a whole number from 0, got -1"),
]


@pytest.mark.parametrize(("good", "bad", "said"), WRONG)
def test_wrong_descriptions(good, bad, said):
    with pytest.raises(DeviceError, match=rf"^device\.toml: (unknown key |key )?\'?{said}"):
        layout(ROBOTIQ.replace(good, bad, 1))


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ("[]", r"fields: expected one or more that are channels, got \[\]"),
        ('[{name = "seq", type = "u8"}]', r"fields: expected one or more that are channels, got \['seq'\]"),
        ("3", r"fields: expected a list of tables, got 3"),
        ("[3]", r"fields\[1\]: expected a table, got 3"),
    ],
)
def test_fields_that_make_no_frame(fields, said):
    with pytest.raises(DeviceError, match=said):
        layout(f'sync = "55"\nlength = 2\nfields = {fields}')


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"width": 12}, "width: expected one of 8, 16, 24, 32"),
        ({"polynomial": "11021"}, "polynomial: expected a number of 16 bits in hexadecimal"),
        ({"polynomial": "x"}, "polynomial: expected a number in hexadecimal"),
        ({"poly": "1021"}, "unknown key 'checksum.poly'"),
        ({"reflected": 1}, "reflected: expected true or false"),
    ],
)
def test_wrong_parameters_of_a_check(change, said):
    check = {"width": 16, "polynomial": "1021"} | change
    fields = [{"name": "A", "type": "u8"}]
    with pytest.raises(DeviceError, match=said):
        frame_layout({"sync": "55", "length": 4, "checksum": check, "fields": fields}, "device.toml")
