"""Tests of the device file: its settings, their effects, and files that are refused."""

import tomllib
from typing import get_args

import numpy as np
import pytest

from boards import encoded_frames
from isocharge.common.errors import ChargeError, DeviceError, TareError
from isocharge.serve import (
    AutoParser,
    Chunk,
    Frame,
    ReadingStream,
    device_from_table,
    load_device,
)
from isocharge.serve.frames.formats import Frames
from isocharge.serve.frames.text import TextParser
from isocharge.serve.live.device import ANY_BOARD
from isocharge.serve.port.serial_line import Request
from isocharge.serve.signal_chain.channels import Channels, Gain, GainRule, SaturationRule
from isocharge.serve.signal_chain.hum import HumRule
from isocharge.serve.signal_chain.leak import Leak, LeakRule
from isocharge.serve.signal_chain.stage import Device, Setup
from isocharge.serve.signal_chain.tare import TareRule
from isocharge.serve.signal_chain.thermal import ThermalRule
from isocharge.serve.signal_chain.touch import TouchRule
from stage_runner import StageRunner

ELECTRODES = ("A", "B", "C")
FORMATS = ", ".join(sorted(section.__struct_config__.tag for section in get_args(Frames)))
"""Names of all frame formats, as messages list them."""

FULL = """
name = "bench board 3"
[frames]
format = "text"
columns = ["seq", "adc0", "adc1", "adc2"]
[channels]
A = "adc1"
B = "adc0"
C = "adc2"
[gain]
pC_per_unit = {A = 0.5, B = -0.25, C = 0.5}
[saturation]
limit_pC = 1500
[hum]
frequency_Hz = 60.0
settle_s = 1.0
[tare]
frames = 50
[leak]
tau_s = {A = 10.0, B = 10.2, C = 9.9}
settle_s = 5.0
[touch]
floor_pC = 20.0
"""


@pytest.fixture
def device(tmp_path):
    def load(text):
        path = tmp_path / "device.toml"
        path.write_text(text)
        return load_device(path)

    return load


def test_device_file_with_all_sections(device):
    board = device(FULL)
    assert (board.name, board.channels["A"]) == ("bench board 3", "adc1")
    rules = [
        GainRule(pC_per_unit={"A": 0.5, "B": -0.25, "C": 0.5}),
        SaturationRule(limit_pC=1500),
        HumRule(frequency_Hz=60.0, settle_s=1.0),
        TareRule(frames=50),
        LeakRule(tau_s={"A": 10.0, "B": 10.2, "C": 9.9}, settle_s=5.0),
        TouchRule(floor_pC=20.0),
    ]
    assert board.rules == {type(rule): rule for rule in rules}
    assert Leak.c_settings(Setup(ELECTRODES, board))["tau_s"].tolist() == [10.0, 10.2, 9.9]
    assert isinstance(board.parser(), TextParser)


def test_device_without_a_file_has_tare_and_touch(device):
    assert device("").rules == ANY_BOARD.rules == {TareRule: TareRule(), TouchRule: TouchRule()}
    assert isinstance(ANY_BOARD.parser(), AutoParser)


@pytest.mark.parametrize(("offset", "zero"), [("8388608", [8388608] * 3), ("{A = 1, B = 2, C = 3}", [1, 2, 3])])
def test_offset_is_subtracted_before_the_gain(device, offset, zero):
    """The offset is one number, such as half of the range of a converter, or one number for each electrode."""
    board = device(f"[gain]\noffset = {offset}\npC_per_unit = {{A = 0.5, B = -0.5, C = 1}}\n")
    frame = Frame(None, None, tuple(value + 10.0 for value in zero))
    Gain(Setup(ELECTRODES, board)).step(frame)
    assert frame.charge_pC.tolist() == [5.0, -5.0, 10.0]


def test_device_file_with_a_request(device):
    assert device("[frames]\n").request is None
    assert device('[frames]\nrequest = "3F 0A"\nrequest_Hz = 50\n').request == Request(b"?\n", 50.0)
    described = 'sync = "55"\nlength = 5\nfields = [{name = "A", type = "f32"}]'
    assert device(f'[frames]\nformat = "described"\nrequest = "01"\n{described}').request.data == b"\x01"


WRONG = [
    ('[frames]\nrequest = "hello"\n', r"frames\.request: expected bytes in hexadecimal, as in '20 4E', got 'hello'"),
    ('[frames]\nrequest = "3F"\nrequest_Hz = 0\n', r"frames\.request_Hz: expected a positive number"),
    ("[gain]\noffset = 1\n", "key 'gain.pC_per_unit' is missing"),
    ("[gane]\n", r"unknown key 'gane'; did you mean 'gain'\? Known are name, front_end, frames, channels, gain"),
    ("[tare]\nframe = 50\n", r"unknown key 'tare.frame'; did you mean 'frames'\? Known are on, frames, noise_limit_pC"),
    ("[tare]\nframes = 50.5\n", r"tare\.frames: expected a whole number from 1 to 1000000000, got 50\.5"),
    ("[track]\nlasting = 1\n", r"track\.lasting: expected a number from 0 to below 1, got 1"),
    ("[tare]\nframes = 0\n", r"tare\.frames: expected a whole number from 1 to 1000000000, got 0"),
    ("[tare]\non = 1\n", r"tare\.on: expected true or false, got 1"),
    ("[touch]\nfloor_pC = -3\n", r"touch\.floor_pC: expected a number from 0 to .*, got -3"),
    ("[touch]\nrelease_share = 5\n", r"touch\.release_share: expected a number from 0 to below 1, got 5"),
    ("[hum]\nsettle_s = 0\n", r"hum\.settle_s: expected a number from 0\.001 to 1"),
    ("[hum]\nfrequency_Hz = 0\n", r"hum\.frequency_Hz: expected a number from 0\.001 to 1"),
    ("[common_mode]\nnoise = 0\n", r"common_mode\.noise: expected a number from 0\.001 to 1"),
    ("[leak]\ntau_s = 1.0\nrelax_s = 1e-300\n", r"leak\.relax_s: expected a number from 0\.001 to 1"),
    (
        "[gain]\npC_per_unit = 0\n",
        r"gain\.pC_per_unit: expected a finite number that is not 0, or one for each electrode, got 0",
    ),
    ("[gain]\npC_per_unit = {A = 1.0, B = inf}\n", r"gain\.pC_per_unit\.B: expected a finite number, got inf"),
    ("[gain]\npC_per_unit = 1.0\nlearn = true\n", r"unknown key 'gain\.learn'; known are on, pC_per_unit"),
    ("[leak]\ntau_s = {A = -1.0}\n", r"leak\.tau_s\.A: expected a positive number, got -1\.0"),
    ('[leak]\ntau_s = 1.0\nlearn = "no"\n', r"leak\.learn: expected true or false, got 'no'"),
    ("[leak]\non = false\ntau_s = 0\n", r"leak\.tau_s: expected a positive number"),
    ("[saturation]\n", "key 'saturation.limit_pC' is missing"),
    ('[frames]\nformat = "morse"\n', rf"frames\.format: expected one of {FORMATS}, got 'morse'"),
    ('[frames]\nformat = "binary"\ncolumns = ["A"]\n', r"unknown key 'frames\.columns'; known are format"),
    ('[frames]\nformat = "text"\ncolumns = ["A", 2]\n', r"frames\.columns\[1\]: expected a text, got 2"),
    ('[frames]\nformat = "described"\nsync = "55"\n', r"key 'frames\.length' is missing"),
    ("[common_mode]\nevery = 1\n", r"unknown key 'common_mode.every'; did you mean 'every_s'\? Known are on, every_s"),
    ("[channels]\nA = 0\n", r"channels\.A: expected a text, got 0"),
    ("channels = 3\n", "channels: expected a table, got 3"),
    ("frames =", "not a TOML file"),
]


@pytest.mark.parametrize(("text", "message"), WRONG)
def test_device_file_that_is_refused(device, text, message):
    with pytest.raises(DeviceError, match=rf"device\.toml: .*{message}"):
        device(text)


CHANNELS = {
    "": "123",
    "C,A,B": "231",
    "C_pC,A_pC,B_pC": "231",
    "x,y,z": "123",
    "C [pC],a_pC,charge.b": "231",
    "ch0,ch1,ch2": "123",
    "Q_C,Q_A,Q_B": "231",
    "electrode B,electrode C,electrode A": "312",
    "chC,chA,chB": "231",
    "qc_pC,qa_pC,qb_pC": "231",
    "A0,A1,A2": "123",
    "bat_V,A,B,C": "234",  # the unit of a channel that is no electrode does not matter
    "C,B,A,t_mV": "321",
    "temp_C,A,B,C": "234",  # the name of a channel may be exactly that of its electrode
}
"""Numbers of the channels of the electrodes A, B and C, by the names of the channels in a header."""


def charges_sent(names, channels):
    """Return the charges of the electrodes A, B and C if the channels with these names send 1, 2, 3 and so on, pC."""
    header = tuple(names.split(",")) if names else ()
    frame = Frame(0, 0, tuple(range(1, 1 + (len(header) or 3))), names=header)
    Gain(Setup(ELECTRODES, Device(channels=channels, where="board.toml"))).step(frame)
    return frame.sent.tolist()


@pytest.mark.parametrize(
    ("names", "channels", "picked"),
    [
        *((names, {}, picked) for names, picked in CHANNELS.items()),
        ("x,y,z", {"A": "z", "B": "y", "C": "x"}, "321"),
        ("", {"A": "3", "B": "ch2", "C": "ch1"}, "321"),
        ("ch3,2,z", {"A": "2", "B": "ch3", "C": "3"}, "213"),
    ],
)
def test_channel_of_each_electrode(names, channels, picked):
    assert charges_sent(names, channels) == [*map(int, picked)]


@pytest.mark.parametrize(
    ("names", "channels", "message"),
    [
        *(
            (names, {}, r"\[channels\] A = ")
            for names in (
                "x,y",
                "A_mean,A_std,B_mean,B_std,C_mean,C_std",
                "A,B,z",
                "ch3_v1,ch2_v1,ch1_v1",
                "adc1 in2,adc1 in10,adc1 in1",
            )
        ),
        ("ch3,ch2,ch1", {}, r"ch3'.*\[channels\] A = "),
        *(
            (",".join(name + unit for name in "ABC"), {}, f"A{unit}' is in {unit.strip('_')}: convert it to pC")
            for unit in ("_nC", "nC", "_coulomb")
        ),
        ("", {"A": "ch2"}, "two electrodes the same channel"),
        ("", {"front_end": "current"}, r"^board\.toml: channels\.front_end: expected one of the electrodes \('A', "),
        ("x,y,z", {"A": "zz"}, r'^board\.toml: \[channels\] A = "zz": no channel .* have x, y, z, or 1 to'),
        *(
            ("", {"A": name}, "no channel is called that; the frames have 1, 2, 3, or 1 to 3")
            for name in ("0", "4", "ch0", "ch4", "ch", "", "-1", "1.0", "99999", "²")
        ),
    ],
)
def test_unknown_channels_are_refused(names, channels, message):
    with pytest.raises((ChargeError, DeviceError), match=message):
        charges_sent(names, channels and {"A": "1", "B": "2", "C": "3"} | channels)


def test_advice_for_the_channels_is_a_valid_device_file():
    electrodes = ("Pad 1", "Pad/2", "ü", "A")
    with pytest.raises(ChargeError) as error:
        Channels(Setup(electrodes)).channel_indices(Frame(0, 0, (1.0, 2.0)))
    advice = str(error.value).partition("[channels] ")[2]
    assert tuple(tomllib.loads(advice.replace(", ", "\n"))) == electrodes


def test_tare_error_states_the_offset_for_the_device_file():
    stream = ReadingStream(
        ("A", "Pad 1", "C"), device_from_table({"tare": {"frames": 5, "patience": 10}}, "board.toml")
    )
    data = b"".join(encoded_frames([(2048.0, 2050.5, 2047.0)] * 20))
    with pytest.raises(TareError, match=r'below pC_per_unit: offset = \{A = 2048, "Pad 1" = 2050.5, C = 2047\}'):
        list(stream.frames(Chunk(data, 1e9, 0)))


def test_saturation_is_flagged_until_the_press_is_over(device):
    chain = StageRunner(device=device("[saturation]\nlimit_pC = 1500.0\n[tare]\nframes = 5\n"))
    charges_pC = [0.0] * 6 + [800.0, 1500.0, 800.0, 800.0, 0.0, 0.0, 800.0]
    readings = chain.run(np.tile(np.array(charges_pC)[:, None], 3), 200.0)
    assert ["saturated" in reading.flags for reading in readings] == [False] * 7 + [True] * 3 + [False] * 3


def test_warming_needs_four_electrodes(device):
    board = device("[common_mode]\nevery_s = 0.1\n")
    assert board.rule(ThermalRule).every_s == 0.1
    with pytest.raises(DeviceError, match=r"device\.toml: common_mode: expected four electrodes or more"):
        StageRunner(3, lambda _: None, device=board)
    ReadingStream(ELECTRODES, board)  # estimates no warming, because it has no model
    assert device("[common_mode]\non = false\n").rule(ThermalRule) is None
