"""Frames of the board of a device file, compared with frames that are built from their description, and read again."""

import struct
import tomllib
from pathlib import Path

import numpy as np
import pytest
from crcmod.predefined import mkPredefinedCrcFun

from isocharge.common.errors import ChargeError, DeviceError
from isocharge.serve import Chunk, Frame, ReadingStream, device_from_table, encode_frame
from isocharge.serve.live.board_encoder import BoardEncoder

ELECTRODES = ("A", "B", "C")
PAGE = Path(__file__).parents[3] / "serve" / "docs" / "device_file.md"
PAGE_EXAMPLE = tomllib.loads(PAGE.read_text("utf-8").split("```toml\n")[1].split("```")[0])


def with_frames(table=PAGE_EXAMPLE, **frames):
    """Return the device of the page with changes in the section `[frames]`."""
    return device_from_table({**table, "frames": {**table["frames"], **frames}}, "board.toml")


def read_charges(device, data):
    """Return the raw charges that `serve stream` reads from bytes, shape (frames, electrodes), pC."""
    frames = ReadingStream(ELECTRODES, device).frames(Chunk(data, 0.0, 0))
    return np.array([frame.raw_pC for frame in frames])


def test_example_of_the_page_sends_counts_in_the_fields_of_the_channels():
    """The field `status` is no channel of an electrode. B is inverted, and B and C are swapped."""
    charge_pC = (100.0, 200.0, -300.0)
    body = struct.pack("<HIHhhh", 7, 35_000, 0, round(100.0 / 0.0457), round(-300.0 / 0.0457), round(200.0 / -0.0459))
    checksum = struct.pack("<H", mkPredefinedCrcFun("x-25")(b"\xaa\x55" + body))
    encoder = BoardEncoder(with_frames(), ELECTRODES)
    assert encoder.encode(Frame(7, 35_000, charge_pC)) == b"\xaa\x55" + body + checksum
    assert encoder.clipped == 0


@pytest.mark.parametrize("framing", ["sync", "cobs", "slip", "hdlc"])
@pytest.mark.parametrize("byte_order", ["little", "big"])
def test_charges_of_every_framing_are_read_again(framing, byte_order):
    device = with_frames(framing=framing, byte_order=byte_order)
    encoder = BoardEncoder(device, ELECTRODES)
    charge_pC = np.random.default_rng(1).uniform(-1400.0, 1400.0, (300, 3))
    data = b"".join(encoder.encode(Frame(seq, 5000 * seq, tuple(row))) for seq, row in enumerate(charge_pC.tolist()))
    np.testing.assert_allclose(read_charges(device, data), charge_pC, atol=0.023)  # half a count


def test_scale_offset_voltage_and_numbers_of_channels_are_respected():
    """1 mV on 500 pF is 0.5 pC. The converter rests at half of its range, and channels are named by their numbers."""
    fields = [{"name": name, "type": "u24", "scale": 0.001} for name in ("w", "x", "y", "z")]
    table = {
        "frames": {"format": "described", "sync": "A5", "length": 13, "fields": fields},
        "channels": {"A": "4", "B": "ch2", "C": "1"},
        "gain": {"V_per_unit": {"A": 1.0, "B": -1.0, "C": 2.0}, "feedback_pF": 500.0, "offset": 8388.608},
    }
    device = device_from_table(table, "board.toml")
    charge_pC = np.array([[100.0, -250.0, 1000.0], [0.0, 0.5, -2.0]])
    encoder = BoardEncoder(device, ELECTRODES)
    data = b"".join(encoder.encode(Frame(None, None, tuple(row))) for row in charge_pC.tolist())
    counts = np.frombuffer(data, np.uint8).reshape(2, 13)[:, 1:].reshape(2, 4, 3) @ [1, 256, 65536]
    np.testing.assert_array_equal(counts[0], [8388608 + 1000, 8388608 + 500, 0, 8388608 + 200])
    np.testing.assert_allclose(read_charges(device, data), charge_pC, atol=1e-6)


def test_charge_beyond_the_converter_is_clipped_and_flagged():
    fields = [{"name": "flags", "type": "u8"}, *({"name": name, "type": "i16"} for name in ELECTRODES)]
    table = {
        "frames": {"format": "described", "sync": "A5", "length": 8, "fields": fields},
        "gain": {"pC_per_unit": {"A": 0.01, "B": -0.01, "C": 0.01}},
    }
    encoder = BoardEncoder(device_from_table(table, "board.toml"), ELECTRODES)
    assert encoder.encode(Frame(0, 0, (400.0, 400.0, -100.0))) == struct.pack("<BBhhh", 0xA5, 1, 32767, -32768, -10000)
    assert encoder.encode(Frame(0, 0, (100.0, 0.0, 0.0))) == struct.pack("<BBhhh", 0xA5, 0, 10000, 0, 0)
    assert encoder.clipped == 1


GAIN = {"pC_per_unit": {"A": 0.5, "B": -0.5, "C": 0.25}, "offset": {"A": 10.0, "B": 0.0, "C": -3.0}}


@pytest.mark.parametrize(
    ("frames", "channels", "notation", "line"),
    [
        ({"format": "text"}, {"A": "3", "B": "ch1", "C": "2"}, None, b"-400,397,210\n"),
        ({"format": "text"}, {"A": "x", "B": "y", "C": "z"}, None, b"seq:7,t_us:35000,x:210,y:-400,z:397\n"),
        ({"format": "text"}, {}, "json", b'{"seq": 7, "t_us": 35000, "A": 210, "B": -400, "C": 397}\n'),
        ({"format": "auto"}, {}, "csv", b"210,-400,397\n"),
        ({"columns": ["t_ms", "y", "seq", "x", "s", "z"]}, {"A": "x", "B": "y", "C": "z"}, None,
         b"35.0,-400,7,210,0,397\n"),
        ({"format": "binary"}, {"A": "1", "B": "4", "C": "2"}, None,
         encode_frame(Frame(7, 35_000, (210.0, 397.0, 0.0, -400.0)))),
        ({"format": "auto"}, {}, None, encode_frame(Frame(7, 35_000, (210.0, -400.0, 397.0)))),
    ],
)  # fmt: skip
def test_text_and_binary_frames_are_sent_with_gain_and_channels(frames, channels, notation, line):
    device = device_from_table({"frames": frames, "channels": channels, "gain": GAIN}, "board.toml")
    encoder = BoardEncoder(device, ELECTRODES, notation)
    assert encoder.encode(Frame(7, 35_000, (100.0, 200.0, 100.0))) == line
    charge_pC = np.random.default_rng(1).uniform(-1000.0, 1000.0, (20, 3))
    data = b"".join(encoder.encode(Frame(seq, 5000 * seq, tuple(row))) for seq, row in enumerate(charge_pC.tolist()))
    charges = read_charges(device, data)
    assert len(charges) >= 16  # a line is dropped, and a layout must repeat
    np.testing.assert_allclose(charges, charge_pC[-len(charges) :], atol=1e-3)


@pytest.mark.parametrize(
    ("frames", "notation", "message"),
    [
        ({"format": "binary"}, "csv", r"expected a notation that fits the device file \(binary\), got csv"),
        ({"format": "text"}, "binary", r"fits the device file \(csv, pairs, teleplot, json\), got binary"),
        ({"columns": ["A", "B", "C"]}, "json", r"fits the device file \(csv\), got json"),
        (PAGE_EXAMPLE["frames"], "csv", "expected no notation, because the file describes the frames, got csv"),
    ],
)
def test_notation_that_does_not_fit_the_device_file_is_refused(frames, notation, message):
    with pytest.raises(DeviceError, match=message):
        BoardEncoder(device_from_table({"frames": frames}, "board.toml"), ELECTRODES, notation)


@pytest.mark.parametrize(
    ("device", "error", "message"),
    [
        (
            device_from_table({"channels": {"A": "300", "B": "1", "C": "2"}}, "board.toml"),
            DeviceError,
            "channels: expected numbers from 1 to 255, got 300",
        ),
        (
            device_from_table({"frames": {"format": "binary"}, "channels": {"A": "x", "B": "y"}}, "board.toml"),
            ChargeError,
            'A = "x": no channel is called that',
        ),
        (with_frames(framing="datagram"), DeviceError, 'a pseudo-terminal has no datagrams, got "datagram"'),
        (with_frames(PAGE_EXAMPLE | {"channels": {"A": "adc7"}}), ChargeError, 'A = "adc7": no channel is called that'),
        (with_frames(PAGE_EXAMPLE | {"channels": {}}), ChargeError, "expects 3 charges .* has 4 .*'status'"),
        (
            with_frames(PAGE_EXAMPLE | {"gain": {"pC_per_unit": {"A": 1.0, "B": 1.0}}}),
            DeviceError,
            "one for each of the electrodes",
        ),
        (
            with_frames(PAGE_EXAMPLE | {"gain": {"pC_per_unit": 1.0, "offset": 8388608}}),
            DeviceError,
            "gain: without charge, electrode A has the value 8.38861e\\+06, which does not fit its channel adc0",
        ),
    ],
)
def test_device_file_that_cannot_be_played_is_refused(device, error, message):
    with pytest.raises(error, match=message):
        BoardEncoder(device, ELECTRODES)
