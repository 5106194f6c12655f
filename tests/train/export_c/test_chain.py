"""The signal chain and the binary frame in C against ours, frame by frame and on any bytes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import DeviceError, TareError
from isocharge.serve import BinaryParser, Predictor, device_from_table, encode_frame
from isocharge.serve.flags import BLIND, INVALID, NEGATIVE, SATURATED, TARE, THERMAL
from isocharge.serve.frames.frame import T_US_MODULUS, Frame
from isocharge.serve.port.device_clock import DeviceClock
from isocharge.serve.signal_chain.chain import SignalChain
from isocharge.train.export_c.folder import device_header

BITS = {TARE: 1, SATURATED: 2, NEGATIVE: 4, THERMAL: 8, BLIND: 16, INVALID: 32}
TARE_FAILED = 64
WARMING = BITS[THERMAL] | BITS[BLIND]

GAIN = {"A": 0.5, "B": -0.5, "C": 0.25, "D": 1.0}

BOARDS = {
    "any board": {},
    "leak": {"leak": {"tau_s": {"A": 10.0, "B": 7.5, "C": 9.9, "D": 2.0}}},
    "leak, not learned": {"leak": {"tau_s": 3.0, "learn": False}},
    "offset, gain and limit": {
        "gain": {"pC_per_unit": GAIN, "offset": {"A": 8388608.0, "B": -3.5, "C": 0.0, "D": 2048.0}},
        "saturation": {"limit_pC": 900.0},
    },
    "gain and limit": {"gain": {"pC_per_unit": GAIN}, "saturation": {"limit_pC": 900.0}},
    "hum": {"hum": {"frequency_Hz": 60.0, "settle_s": 0.3}, "leak": {"tau_s": 10.0}},
    "no tare": {"tare": {"on": False}},
    "no touch": {"touch": {"on": False}, "leak": {"tau_s": 10.0}},
    "short tare": {"tare": {"frames": 7, "noise_limit_pC": 3.0}, "touch": {"sigmas": 4.0, "floor_pC": 5.0}},
    "warming": {"common_mode": {}},
    "warming and leak": {"common_mode": {"every_s": 0.02, "tell_pC": 3.0}, "leak": {"tau_s": 5.0}, "hum": {}},
}


def device(board):
    return device_from_table(BOARDS[board], board)


def recording(board, seed, electrodes=4, seconds=20.0):
    """What a board sends: rest, presses, leak, hum, drift, noise, a limit, and values that are no charges.

    Returns:
        Values, shape (n, electrodes), times and steps, shape (n,), s, and marks of limited frames and of new tares.
    """
    rng = np.random.default_rng(seed)
    n = int(200 * seconds)
    rate_Hz = 200.0
    dt_s = rng.uniform(0.5, 1.5, n) / rate_Hz
    dt_s[rng.random(n) < 0.01] *= 20.0  # frames were lost
    dt_s[0] = 0.0
    t_s = 5.0 + np.cumsum(dt_s)
    shape = rng.uniform(0.6, 1.4, electrodes)
    press = np.zeros(n)
    for begin in np.cumsum(rng.integers(200, 700, 8)):
        press[begin : begin + int(rng.integers(20, 400))] = rng.uniform(20.0, 1500.0)
    charge = press[:, None] * shape + 0.3 * rng.standard_normal((n, electrodes)) + rng.uniform(-20.0, 20.0, electrodes)
    charge += rng.uniform(0.0, 1.0) * np.sin(2 * np.pi * 60.0 * t_s)[:, None] + rng.uniform(-0.1, 0.1) * t_s[:, None]
    charge += np.where(press > 0, 30.0, 0.0)[:, None] * rng.random()
    charge[rng.choice(np.flatnonzero(press > 0), 3)] *= 40.0  # spikes are no peaks
    chain = device(board).chain(("A", "B", "C", "D")[:electrodes])
    values = charge if chain.gain_pC is None else charge / chain.gain_pC
    values += 0.0 if chain.zero is None else chain.zero
    for bad in (np.nan, np.inf, -np.inf, 3e9, 1e300):
        values[rng.integers(0, n, 2), rng.integers(0, electrodes, 2)] = bad
    return values, t_s, dt_s, rng.random(n) < 0.003, np.isin(np.arange(n), rng.integers(n // 2, n, 1))


def ours(chain, values, t_s, dt_s, limited, tare, misfit):
    """Readings of the chain in Python as arrays, as `Exported.chain` gives them."""
    running = SignalChain(chain, values.shape[1], misfit)
    rows = []
    for value, t, dt, at_limit, again in zip(values, t_s, dt_s, limited, tare, strict=True):
        if again:
            running.reset_tare()
        reading = running.advance(value, float(t), float(dt), limited=bool(at_limit))
        zero = np.zeros_like(value)
        rows.append(
            (
                zero if reading.charge_pC is None else reading.charge_pC,
                zero if reading.tare is None else reading.tare.charge_pC,
                reading.contact,
                sum(BITS[word] for word in reading.flags),
            )
        )
    return tuple(map(np.array, zip(*rows, strict=True)))


@pytest.fixture(scope="module")
def misfit():
    predictor = Predictor("four-25um-biaxial")
    return lambda charge_pC: predictor.predict_batch(charge_pC).misfit


@pytest.mark.parametrize("board", BOARDS)
def test_states_and_charges_are_ours_frame_by_frame(board, build, misfit):
    exported = build("four-25um-biaxial", device(board))
    chain = device(board).chain(("A", "B", "C", "D"))
    for seed in range(2):
        frames = recording(board, seed)
        mine = ours(chain, *frames, misfit)
        theirs = exported.chain(*frames)
        warming = chain.thermal is not None  # estimated with the network, so its rounding stands in it
        np.testing.assert_array_equal(theirs[2], mine[2])
        np.testing.assert_array_equal(theirs[3] & (127 - WARMING), mine[3] & (127 - WARMING))
        assert np.mean(theirs[3] != mine[3]) <= (0.002 if warming else 0.0)
        tolerance = 0.2 if warming else 1e-9
        np.testing.assert_allclose(theirs[0], mine[0], rtol=0, atol=tolerance)
        np.testing.assert_allclose(theirs[1], mine[1], rtol=0, atol=tolerance)
        assert mine[2].mean() > 0.05  # something touched
        assert np.count_nonzero(np.diff(mine[2].astype(int)) < 0) >= 3 or chain.touch is None


@pytest.mark.parametrize("board", ["any board", "leak", "gain and limit", "hum"])
def test_single_precision_is_within_a_twentieth_of_a_picocoulomb(board, build, misfit):
    """And nothing in it becomes a double on the way, which a small processor would have to emulate."""
    exported = build(
        "four-25um-biaxial", device(board), options=("-O2", "-DISOCHARGE_CHAIN_FLOAT", "-Wdouble-promotion")
    )
    values, t_s, dt_s, limited, tare = recording(board, seed=4)
    values[np.abs(values) > 1e30] = np.inf
    mine = ours(device(board).chain(("A", "B", "C", "D")), values, t_s, dt_s, limited, tare, misfit)
    theirs = exported.chain(values, t_s, dt_s, limited, tare)
    np.testing.assert_array_equal(theirs[2], mine[2])
    np.testing.assert_array_equal(theirs[3], mine[3])
    np.testing.assert_allclose(theirs[0], mine[0], rtol=0, atol=0.05)


def test_a_film_that_is_never_quiet_is_said_at_the_same_frame(build):
    board = device_from_table({"tare": {"frames": 20, "patience": 50}}, "board")
    values = 100.0 * np.random.default_rng(0).standard_normal((70, 3))
    steps = np.full(70, 0.005)
    with pytest.raises(TareError):
        ours(board.chain(("A", "B", "C")), values, np.cumsum(steps), steps, np.zeros(70), np.zeros(70), None)
    exported = build("three-25um-biaxial", board)
    flags = exported.chain(values, np.cumsum(steps), steps)[3]
    assert np.flatnonzero(flags & TARE_FAILED)[0] == 49
    again = np.arange(70) == 10  # a second tare never gives up
    flags = exported.chain(values, np.cumsum(steps), steps, tare=again)[3]
    assert not (flags & TARE_FAILED).any()


def test_a_tare_that_no_state_holds_is_refused():
    with pytest.raises(DeviceError, match=r"board: tare.frames: expected a whole number from 1 to 10000.*got 50000"):
        device_header(device_from_table({"tare": {"frames": 50_000}}, "board"), ("A", "B", "C"))


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


def test_the_clock_wraps_and_restarts_as_ours(exported):
    t_us = (4_294_000_000 + np.cumsum(np.random.default_rng(0).integers(0, 20_000, 500))) % T_US_MODULUS
    t_us[300:] = (t_us[300:] - t_us[300] + 17) % T_US_MODULUS  # the board was reset
    t_us[400:] = (t_us[400:] + (1 << 31) + 500_000) % T_US_MODULUS  # half its range ahead counts as back
    clock = DeviceClock()
    times = [clock.read(int(t), T_US_MODULUS, 0.0) for t in t_us]
    t_s, dt_s = exported.clock(t_us)
    np.testing.assert_allclose(t_s, [time.clock_s for time in times], rtol=1e-15)
    np.testing.assert_allclose(dt_s, [time.step_s for time in times], rtol=1e-15)
    assert clock.restarts == 2
