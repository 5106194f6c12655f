"""The device file: what it may say, what it does, what is refused."""

import numpy as np
import pytest

from isocharge.errors import ChargeError, DeviceError
from isocharge.serve import AutoParser, BinaryParser, DescribedParser, Frame, TextParser, load_device
from isocharge.serve.live.channels import ChannelPicker
from isocharge.serve.live.device_file import ANY_BOARD
from isocharge.serve.signal_chain.chain import ChainState, advance

ELECTRODES = ("A", "B", "C")
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


def test_a_full_file(device):
    board = device(FULL)
    chain = board.chain(ELECTRODES)
    assert (board.name, board.channels["A"]) == ("bench board 3", "adc1")
    np.testing.assert_array_equal(chain.gain_pC, [0.5, -0.25, 0.5])
    np.testing.assert_array_equal(chain.leak.tau_s, [10.0, 10.2, 9.9])
    assert (chain.limit_pC, chain.hum.frequency_Hz, chain.hum.settle_s) == (1500, 60.0, 1.0)
    assert (chain.tare.frames, chain.leak.settle_s, chain.touch.floor_pC) == (50, 5.0, 20.0)
    assert isinstance(board.parser(), TextParser)


def test_without_a_file_only_tare_and_touch_are_on():
    chain = ANY_BOARD.chain(ELECTRODES)
    assert (chain.gain_pC, chain.limit_pC, chain.hum, chain.leak) == (None, None, None, None)
    assert chain.tare is not None
    assert chain.touch is not None
    assert isinstance(ANY_BOARD.parser(), AutoParser)


@pytest.mark.parametrize("stage", ["gain", "saturation", "hum", "tare", "leak", "touch"])
def test_each_stage_can_be_switched_off(device, stage):
    chain = device(FULL.replace(f"[{stage}]", f"[{stage}]\non = false")).chain(ELECTRODES)
    attribute = {"gain": "gain_pC", "saturation": "limit_pC"}.get(stage, stage)
    assert getattr(chain, attribute) is None
    others = {"gain_pC", "limit_pC", "hum", "tare", "leak", "touch"} - {attribute}
    assert all(getattr(chain, other) is not None for other in others)


def test_one_number_for_all_channels(device):
    chain = device("[gain]\npC_per_unit = 2.0\n[leak]\ntau_s = 1.0\n").chain(ELECTRODES)
    np.testing.assert_array_equal(chain.gain_pC, [2.0] * 3)
    np.testing.assert_array_equal(chain.leak.tau_s, [1.0] * 3)


def test_formats(device):
    assert isinstance(device('[frames]\nformat = "binary"').parser(), BinaryParser)
    described = '[frames]\nformat = "described"\nsync = "55"\nlength = 5\nfields = [{name = "A", type = "f32"}]'
    assert isinstance(device(described).parser(), DescribedParser)


WRONG = [
    ("[gane]\n", r"expected the sections channels, common_mode, frames.*got \['gane'\]"),
    ("[tare]\nframe = 50\n", r"tare: expected the keys .*, got \['frame'\]"),
    ("[tare]\nframes = 50.5\n", "tare: frames: expected a whole number from 0 to .*, got 50.5"),
    ("[tare]\non = 1\n", "tare: on: expected true or false, got 1"),
    ("[touch]\nfloor_pC = -3\n", "touch: floor_pC: expected a number from 0 to .*, got -3"),
    ("[hum]\nsettle_s = 0\n", "hum: settle_s: expected a number from 0.001 to 1e"),
    ("[leak]\ntau_s = 1.0\nrelax_s = 1e-300\n", "leak: relax_s: expected a number from 0.001 to 1e"),
    ("[common_mode]\nblind_pC = 1e300\n", "blind_pC: expected a number from 0 to 1e"),
    ("[gain]\n", "gain: expected the key pC_per_unit"),
    ("[gain]\npC_per_unit = 0\n", "numbers that are not 0, got 0"),
    ("[leak]\ntau_s = {A = -1.0}\n", "positive numbers"),
    ('[leak]\ntau_s = 1.0\nlearn = "no"\n', "leak: learn: expected true or false"),
    ("[saturation]\n", "the key limit_pC"),
    ('[frames]\nformat = "morse"\n', "format auto, binary, text or described, got 'morse'"),
    ('[frames]\nformat = "binary"\ncolumns = ["A"]\n', r"expected the keys format, got \['columns'\]"),
    ('[frames]\nformat = "described"\nsync = "55"\n', "the keys sync, length and fields"),
    ("[common_mode]\nevery = 1\n", "common_mode: expected the keys blind_pC"),
    ("[channels]\nA = 0\n", "names of channels"),
    ("channels = 3\n", "expected a section, got 3"),
    ("frames =", "not TOML"),
]


@pytest.mark.parametrize(("text", "said"), WRONG)
def test_wrong_files(device, text, said):
    with pytest.raises(DeviceError, match=said) as caught:
        device(text)
    assert "device.toml" in str(caught.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(DeviceError, match=r"none\.toml: cannot be read"):
        load_device(tmp_path / "none.toml")


def test_other_electrodes_than_the_model(device):
    board = device("[gain]\npC_per_unit = {A = 1.0, B = 1.0}\n")
    with pytest.raises(
        DeviceError, match=r"one for each of the electrodes \('A', 'B', 'C'\), got \{'A': 1.0, 'B': 1.0\}"
    ):
        board.chain(ELECTRODES)


@pytest.mark.parametrize(
    ("names", "channels", "picked"),
    [
        ((), {}, [1, 2, 3]),
        (("C", "A", "B"), {}, [2, 3, 1]),
        (("C_pC", "A_pC", "B_pC"), {}, [2, 3, 1]),
        (("charge.C", "charge.A", "charge.B"), {}, [2, 3, 1]),
        (("x", "y", "z"), {}, [1, 2, 3]),
        (("x", "y", "z"), {"A": "z", "B": "y", "C": "x"}, [3, 2, 1]),
    ],
)
def test_which_channel_is_which_electrode(names, channels, picked):
    picker = ChannelPicker(ELECTRODES, channels, "linear/1")
    assert picker.pick(Frame(0, 0, (1.0, 2.0, 3.0), names=names)).tolist() == picked


@pytest.mark.parametrize(("names", "channels"), [(("x", "y"), {}), (("x", "y", "z"), {"A": "u", "B": "y", "C": "x"})])
def test_an_electrode_without_a_channel(names, channels):
    picker = ChannelPicker(ELECTRODES, channels, "linear/1")
    with pytest.raises(ChargeError, match=r"\[channels\] A = "):
        picker.pick(Frame(0, 0, tuple(range(len(names))), names=names))


def test_saturation_is_flagged_until_the_press_is_over(device):
    chain = device("[saturation]\nlimit_pC = 1500.0\n[tare]\nframes = 5\n").chain(ELECTRODES)
    totals = [0.0] * 6 + [800.0, 1500.0, 800.0, 800.0, 0.0, 0.0, 800.0]
    state, flags = ChainState.start(3), []
    for k, total in enumerate(totals):
        state, reading = advance(chain, state, np.full(3, total), 0.005 * k, 0.005)
        flags.append("saturated" in reading.flags)
    assert flags == [False] * 7 + [True] * 3 + [False] * 3


def test_warming_needs_four_electrodes(device):
    board = device("[common_mode]\nevery_s = 0.1\n")
    assert board.common_mode(("A", "B", "C", "D")).every_s == 0.1
    with pytest.raises(DeviceError, match="expected four electrodes or more"):
        board.common_mode(ELECTRODES)
    assert device("[common_mode]\non = false\n").common_mode(ELECTRODES) is None
