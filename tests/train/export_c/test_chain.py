"""Tests of the signal chain and of the binary frame in C against those in Python."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from isocharge.common.errors import DeviceError, TareError
from isocharge.serve import BinaryParser, Predictor, device_from_table, encode_frame
from isocharge.serve.flags import BLIND, DRIFT, GAP, INVALID, NEGATIVE, SATURATED, TARE, THERMAL
from isocharge.serve.frames.device_clock import DeviceClock
from isocharge.serve.frames.frame import T_US_MODULUS, Frame
from isocharge.serve.port.file_source import Chunk
from isocharge.serve.signal_chain.channels import Gain
from isocharge.serve.signal_chain.hum import Hum
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.signal_chain.thermal import ThermalRule
from isocharge.train.export_c.folder import device_header
from stage_runner import StageRunner

BITS = {TARE: 1, SATURATED: 2, NEGATIVE: 4, THERMAL: 8, BLIND: 16, INVALID: 32, DRIFT: 128, GAP: 4096}
"""Bit of each flag in C."""

TARE_FAILED = 64
"""Bit for a tare that failed."""

ALL_BITS = 255 | BITS[GAP]
WARMING_BITS = BITS[THERMAL] | BITS[BLIND]
"""Bits of the flags that depend on the estimated warming."""

GAIN = {"A": 0.5, "B": -0.5, "C": 0.25, "D": 1.0}

BOARDS = {
    "any board": {},
    "leak": {"leak": {"tau_s": {"A": 10.0, "B": 7.5, "C": 9.9, "D": 2.0}}},
    "drift": {"leak": {}},
    "leak, not learned": {"leak": {"tau_s": 3.0, "learn": False}},
    "offset, gain and limit": {
        "gain": {"pC_per_unit": GAIN, "offset": {"A": 8388608.0, "B": -3.5, "C": 0.0, "D": 2048.0}},
        "saturation": {"limit_pC": 900.0},
    },
    "hum": {"hum": {"frequency_Hz": 60.0, "settle_s": 0.3}, "leak": {"tau_s": 10.0}},
    "hum of which a period has many frames": {"hum": {"frequency_Hz": 3.0}},
    "no tare": {"tare": {"on": False}},
    "short tare": {"tare": {"frames": 7, "noise_limit_pC": 3.0}, "touch": {"sigmas": 4.0, "floor_pC": 5.0}},
    "warming": {"common_mode": {}},
    "warming that is always told": {"common_mode": {"tell_pC": 0.0}},
    "warming and leak": {"common_mode": {"every_s": 0.02, "tell_pC": 3.0}, "leak": {"tau_s": 5.0}, "hum": {}},
}

SINGLE_PRECISION = ("-DISOCHARGE_CHAIN_FLOAT", "-Wdouble-promotion")
"""Options of the compiler, of which the second refuses double precision, which small processors would emulate."""

FOUR = "four-25um-biaxial-student"
ELECTRODES = ("A", "B", "C", "D")
RATE_Hz = 200.0
HUM_Hz = 60.0
T_OF_HOLD_s = np.arange(0.0, 30.0, 1.0 / RATE_Hz)


def device(board):
    """Return the device of a board by its name in `BOARDS`."""
    return device_from_table(BOARDS[board], board)


class Frames(NamedTuple):
    """Frames of a board.

    Attributes:
        values: Values, shape (n, 4), in the unit of the board.
        t_s: Times, shape (n,), s.
        dt_s: Times since the previous frame, shape (n,), s.
        limited: Whether each frame is limited, shape (n,).
        tare: Whether the tare is measured again at each frame, shape (n,).
    """

    values: np.ndarray
    t_s: np.ndarray
    dt_s: np.ndarray
    limited: np.ndarray
    tare: np.ndarray


def draw_frames(board, seed):
    """Draw the frames of a board: presses with noise, hum, drift and spikes, lost frames, and invalid values."""
    rng = np.random.default_rng(seed)
    n_electrode = len(ELECTRODES)
    count = 2400
    dt_s = rng.uniform(0.5, 1.5, count) / RATE_Hz
    dt_s[rng.random(count) < 0.01] *= 20.0  # frames were lost
    dt_s[0] = 0.0
    t_s = 5.0 + np.cumsum(dt_s)

    # Every second of these intervals is a press.
    press_pC = np.repeat(rng.uniform(20.0, 1500.0, 40) * (np.arange(40) % 2), rng.integers(100, 400, 40))[:count]
    hum_pC = rng.uniform(0.0, 1.0) * np.sin(2 * np.pi * HUM_Hz * t_s)
    drift_pC = rng.uniform(-0.1, 0.1) * t_s
    charge = np.outer(press_pC, rng.uniform(0.6, 1.4, n_electrode)) + (hum_pC + drift_pC)[:, None]
    charge += 0.3 * rng.standard_normal(charge.shape) + rng.uniform(-20.0, 20.0, n_electrode)
    charge[rng.choice(np.flatnonzero(press_pC), 3)] *= 40.0  # spikes, which are not peaks of a press

    gain = Gain(Setup(ELECTRODES, device(board)))
    values = charge / gain.gain_pC + gain.offset
    for invalid in (np.nan, np.inf, -np.inf, 3e9, 1e300):
        values[rng.integers(0, count, 2), rng.integers(0, n_electrode, 2)] = invalid
    limited = rng.random(count) < 0.003
    tare = np.arange(count) == rng.integers(count // 2, count)
    return Frames(values, t_s, dt_s, limited, tare)


def regular_frames(values):
    """Return frames of which none is limited or begins a tare."""
    dt_s = np.full(len(values), 1.0 / RATE_Hz)
    never = np.zeros(len(values), dtype=bool)
    return Frames(values, np.cumsum(dt_s), dt_s, limited=never, tare=never)


def python_chain(device, frames, misfit):
    """Process frames with the signal chain in Python, and return arrays like those of `Exported.chain`.

    Args:
        device: The board.
        frames: The frames.
        misfit: Function from charges to misfits, for the estimate of the warming.
    """
    n_electrode = frames.values.shape[1]
    signal_chain = StageRunner(n_electrode, misfit, device=device)
    charge = np.zeros_like(frames.values)
    tare_charge = np.zeros_like(frames.values)
    contact = []
    flags = []
    for index, values in enumerate(frames.values):
        if frames.tare[index]:
            signal_chain.reset_tare()
        is_limited = bool(frames.limited[index])
        reading = signal_chain.advance(values, float(frames.t_s[index]), float(frames.dt_s[index]), limited=is_limited)
        if reading.charge_pC is not None:
            charge[index] = reading.charge_pC
        if reading.tare_pC is not None:
            tare_charge[index] = reading.tare_pC
        contact.append(reading.is_contact)
        flags.append(sum(BITS[flag] for flag in reading.flags))
    return charge, tare_charge, np.array(contact), np.array(flags)


def compare_chains(exported, frames, misfit=None, *, tolerance_pC):
    """Check that C and Python give the same states and flags, and the same charges and tares within a tolerance.

    The flags of an estimated warming may differ in two of a thousand frames.

    Returns:
        Contact states and flags in C, shape (n,) each.
    """
    expected_charge, expected_tare, expected_contact, expected_flags = python_chain(exported.device, frames, misfit)
    charge, tare, contact, flags = exported.chain(*frames)
    np.testing.assert_array_equal(contact, expected_contact)
    other_bits = ALL_BITS - WARMING_BITS
    np.testing.assert_array_equal(flags & other_bits, expected_flags & other_bits)
    assert np.mean(flags != expected_flags) <= (0.002 if exported.device.rule(ThermalRule) else 0.0)
    np.testing.assert_allclose(charge, expected_charge, rtol=0, atol=tolerance_pC)
    np.testing.assert_allclose(tare, expected_tare, rtol=0, atol=tolerance_pC)
    return contact, flags


@pytest.fixture(scope="module")
def misfit():
    predictor = Predictor(FOUR)
    return lambda charge_pC: predictor.predict_batch(charge_pC).misfit


@pytest.mark.parametrize("board", BOARDS)
def test_c_and_python_give_the_same_charges_and_states_for_each_frame(board, build, misfit):
    """The estimated warming depends on the network, whose values in C have other rounding errors."""
    exported = build(FOUR, device(board))
    tolerance_pC = 0.2 if exported.device.rule(ThermalRule) else 1e-9
    frames = draw_frames(board, seed=0)
    compare_chains(exported, frames, misfit, tolerance_pC=tolerance_pC)


@pytest.mark.parametrize("board", ["any board", "hum"])
def test_single_precision_changes_charges_by_less_than_a_twentieth_of_a_picocoulomb(board, build, misfit):
    exported = build(FOUR, device(board), options=SINGLE_PRECISION)
    frames = draw_frames(board, seed=4)
    frames.values[np.abs(frames.values) > 1e30] = np.inf
    compare_chains(exported, frames, misfit, tolerance_pC=0.05)


@pytest.mark.parametrize(("tau_s", "learn"), [(10.1, True), (1000.0, False)])
def test_single_precision_does_not_add_up_its_errors_in_a_held_press(tau_s, learn, build):
    """The sampling interval is constant, so that the errors of all frames have the same sign."""
    board = device_from_table({"leak": {"tau_s": tau_s, "learn": learn}}, "board")
    held_pC = np.where(T_OF_HOLD_s < 2.0, 0.0, 850.0 * np.exp(-(T_OF_HOLD_s - 2.0) / tau_s))
    frames = regular_frames(held_pC[:, None] + np.random.default_rng(1).standard_normal((len(held_pC), 4)))
    exported = build(FOUR, board, options=SINGLE_PRECISION)
    compare_chains(exported, frames, tolerance_pC=0.2)


def test_single_precision_learns_the_leak_from_the_same_frames_after_a_release(build):
    """Many sampling intervals add up to the hold-off after a touch, from which the inflow is learned again."""
    board = device_from_table({"leak": {"tau_s": 10.0, "settle_s": 2.5}}, "board")
    t_s = np.arange(0.0, 40.0, 1.0 / RATE_Hz)
    pressed_pC = np.where((t_s > 2.0) & (t_s % 3.7 < 2.0), 850.0, 0.0)
    decay = np.exp(-0.1 / RATE_Hz)
    leaking_pC = lfilter([1.0, -1.0], [1.0, -decay], pressed_pC)  # output of an amplifier that leaks
    frames = regular_frames(leaking_pC[:, None] + np.random.default_rng(1).standard_normal((len(t_s), 4)))
    exported = build(FOUR, board, options=SINGLE_PRECISION)
    compare_chains(exported, frames, tolerance_pC=0.1)


def test_contact_that_a_drift_begins_has_the_flag_drift_in_c_as_in_python(build):
    """The zero of the board drifts by 6 pC/s, which the tare cannot follow, and is negative before a press."""
    drift_pC = np.interp(np.arange(1400), [0, 1000, 1001, 1300, 1320], [0.0, 30.0, -300.0, -300.0, 300.0])
    frames = regular_frames(np.random.default_rng(0).standard_normal((1400, 4)) + drift_pC[:, None])
    exported = build(FOUR, device("any board"))
    contact, flags = compare_chains(exported, frames, tolerance_pC=1e-9)
    np.testing.assert_array_equal((flags & BITS[DRIFT]) != 0, contact)
    assert contact[-1]


IMPATIENT_BOARD = device_from_table({"tare": {"frames": 20, "patience": 50}}, "board")
"""Board whose tare fails after 50 frames."""


def test_failed_first_tare_is_reported_after_the_patience_of_the_board(build):
    """The film is never at rest."""
    restless_frames = regular_frames(100.0 * np.random.default_rng(0).standard_normal((70, 3)))
    with pytest.raises(TareError):
        python_chain(IMPATIENT_BOARD, restless_frames, None)
    exported = build("three-25um-biaxial-student", IMPATIENT_BOARD)
    _, _, _, flags = exported.chain(*restless_frames)
    first_failed, *_ = np.flatnonzero(flags & TARE_FAILED)
    assert first_failed == 49
    with_second_tare = restless_frames._replace(tare=np.arange(70) == 10)
    _, _, _, flags = exported.chain(*with_second_tare)
    assert not (flags & TARE_FAILED).any()


def test_stage_without_code_in_c_is_refused_by_its_name(monkeypatch):
    monkeypatch.setattr(Hum, "section", "notch")
    board = device_from_table({"hum": {}}, "board")
    with pytest.raises(DeviceError, match="board: notch: this stage does not exist"):
        device_header(board, ELECTRODES)


def test_sections_that_only_the_host_executes_are_named_in_a_warning(caplog):
    device_header(device_from_table({"track": {}, "follow": {}}, "board"), ELECTRODES)
    assert "board: follow, track: not exported" in caplog.text


FLOAT32 = st.floats(width=32, allow_nan=False)
FRAMES = st.builds(
    Frame,
    seq=st.integers(0, 65535),
    t_us=st.integers(0, T_US_MODULUS - 1),
    values=st.lists(FLOAT32, max_size=255).map(tuple),
    bits=st.integers(0, 255),
)
TOO_LONG = st.binary(min_size=1050, max_size=1100)
PIECES = st.one_of(FRAMES.map(encode_frame), st.binary(max_size=40), st.just(b"\0"), TOO_LONG)
DAMAGE = st.lists(st.tuples(st.integers(0, 3000), st.integers(0, 255)), max_size=3)
"""Positions of damaged bytes and their values."""


@pytest.fixture(scope="module")
def exported(build):
    return build("three-25um-biaxial-student")


@given(pieces=st.lists(PIECES, max_size=6), damage=DAMAGE)
def test_c_and_python_parse_any_bytes_into_the_same_frames_and_counters(exported, pieces, damage):
    data = bytearray(b"".join(pieces) + b"\0")
    for position, value in damage:
        data[position % len(data)] = value
    data += b"\0"
    parser = BinaryParser()
    expected_frames = [(frame.seq, frame.t_us, frame.bits, frame.values) for frame in parser.feed(bytes(data))]
    expected = parser.counts
    frames, counts = exported.frames(bytes(data))
    np.testing.assert_equal(frames, expected_frames)
    assert counts == (expected.frames, expected.crc_errors, expected.malformed, expected.bytes_dropped)


@given(frame=FRAMES)
def test_c_and_python_write_the_same_frames(exported, frame):
    assert exported.encode(frame) == encode_frame(frame)


@pytest.mark.parametrize("n_value", [0, 1, 60, 61, 62, 63, 124, 125, 126, 255])
def test_frames_without_a_zero_byte_are_divided_after_254_bytes(exported, n_value):
    values = np.frombuffer(b"\1\1\1\1" * n_value, np.float32).tolist()
    frame = Frame(0x0101, 0x01010101, values, 1)
    assert exported.encode(frame) == encode_frame(frame)
    frames, _ = exported.frames(encode_frame(frame))
    assert frames == [(frame.seq, frame.t_us, 1, tuple(frame.values))]


def test_clock_overflows_and_restarts_in_c_as_in_python(exported):
    """A time stamp that is more than half of the range ahead counts as a step back."""
    t_us = (4_294_000_000 + np.cumsum(np.random.default_rng(0).integers(0, 20_000, 500))) % T_US_MODULUS
    t_us[[250, 251]] = t_us[[251, 250]]  # these frames were swapped
    t_us[300:] = (t_us[300:] - t_us[300] + 17) % T_US_MODULUS  # the board was reset
    t_us[400:] = (t_us[400:] + (1 << 31) + 500_000) % T_US_MODULUS
    clock = DeviceClock()
    frames = [Frame(None, device_us, ()) for device_us in t_us.tolist()]
    clock.stamp(Chunk(b"", 0.0, 0), frames, T_US_MODULUS)
    t_s, dt_s = exported.clock(t_us)
    np.testing.assert_allclose(t_s, [frame.clock_s for frame in frames], rtol=1e-15)
    np.testing.assert_allclose(dt_s, [frame.dt_s for frame in frames], rtol=1e-15)
    assert dt_s[300] == dt_s[400] == 0.0
