"""The signal chain: what is tared, what counts as touch."""

import numpy as np
import pytest

from isocharge.common.errors import TareError
from isocharge.serve import Chain
from isocharge.serve.signal_chain.chain import SignalChain
from isocharge.serve.signal_chain.contact import Touch, TouchRule, update_contact
from isocharge.serve.signal_chain.leak import LeakRule
from isocharge.serve.signal_chain.tare import TareRule, measure_tare

RULE, OFFSET = TareRule(), np.array([12.0, -7.0, 3.0])
RATE_HZ = 200.0
ONE_PC = np.ones(3)


def rest(n, seed=0, sigma=1.0):
    return OFFSET + sigma * np.random.default_rng(seed).standard_normal((n, 3))


def run(frames, chain=None):
    """All readings of raw frames, shape (n, 3)."""
    running = SignalChain(chain or Chain(), 3)
    return [running.advance(raw, k / RATE_HZ, 1 / RATE_HZ) for k, raw in enumerate(frames)]


def test_tare_is_mean_and_noise():
    tare = measure_tare(RULE, rest(10_000))
    np.testing.assert_allclose(tare.charge_pC, OFFSET, atol=0.05)
    np.testing.assert_allclose(tare.noise_pC, 1.0, rtol=0.03)
    assert tare.frames == 10_000


def test_tare_under_a_resting_weight_is_refused():
    with pytest.raises(TareError, match=r"rests at 81\d.* pC, expected at most 100 pC; take off"):
        measure_tare(RULE, rest(100) + 800.0)


def test_tare_takes_the_first_hundred_frames():
    readings = run(rest(150))
    assert [r.tare is None for r in readings] == [True] * 100 + [False] * 50
    assert {r.flags for r in readings[:100]} == {("tare",)}
    np.testing.assert_allclose(readings[100].tare.charge_pC, rest(150)[:100].mean(axis=0))
    np.testing.assert_allclose(np.mean([r.charge_pC for r in readings[100:]], axis=0), 0.0, atol=0.5)


def test_tare_waits_for_quiet():
    frames = rest(400)
    frames[:220] += np.linspace(900.0, 300.0, 220)[:, None]  # a finger that leaves after 220 frames
    readings = run(frames)
    assert 300 < next(i for i, r in enumerate(readings) if r.tare is not None) <= 321
    np.testing.assert_allclose(readings[-1].tare.charge_pC, OFFSET, atol=2.0)


def test_tare_gives_up_with_the_reason():
    with pytest.raises(TareError, match="varies by"):
        run(rest(300, sigma=50.0), Chain(tare=TareRule(patience=250)))


def test_second_tare_never_gives_up():
    """In the middle of a live run, a finger that rests on the film is no reason to stop."""
    chain = SignalChain(Chain(tare=TareRule(frames=20, patience=50)), 3)
    for k, raw in enumerate(rest(60)):
        chain.advance(raw, k / RATE_HZ, 1 / RATE_HZ)
    chain.reset_tare()
    tared = []
    for k, raw in enumerate(np.concatenate([rest(200, sigma=100.0), rest(30)])):
        reading = chain.advance(raw, k / RATE_HZ, 1 / RATE_HZ)
        tared.append(reading.tare is not None)
    assert tared.index(True) == 220


THRESHOLD_PC = 10.0 + 6.0 * np.sqrt(3.0)


@pytest.mark.parametrize(
    ("totals", "noise", "expected"),
    [
        ([THRESHOLD_PC - 0.1, THRESHOLD_PC + 0.1], ONE_PC, [0, 1]),
        ([9.9, 10.1], 0.0 * ONE_PC, [0, 1]),
        ([15.0, 25.0, 15.0, 11.0, 9.0, 15.0], ONE_PC, [0, 1, 1, 1, 0, 0]),
        ([1000.0, 4000.0, 4000.0, 201.0, 199.0], ONE_PC, [1, 1, 1, 1, 0]),
        # an absolute release threshold under the drift of 60 pC never would release
        ([2060.0, 2060.0, 60.0, 62.0, 58.0, 60.0, 75.0, 79.0], ONE_PC, [1, 1, 0, 0, 0, 0, 0, 1]),
        # one absurd frame, at the first touch too, neither releases the press nor hides it
        *(([*before, 3e38, *[850.0] * 4], ONE_PC, [1] * (len(before) + 5)) for before in ([], [850.0], [850.0] * 5)),
    ],
    ids=["floor and noise", "floor", "hysteresis", "share of the peak", "drifted base", *["spike"] * 3],
)
def test_touches_begin_and_end(totals, noise, expected):
    touch, seen = Touch(), []
    for total in totals:
        touch = update_contact(TouchRule(), touch, total, noise)
        seen.append(touch.contact)
    assert seen == expected


def test_smallest_press_is_detected_at_once():
    frames = rest(400)
    frames[200:300] += 340.0 / 3.0
    assert [r.contact for r in run(frames)] == [False] * 200 + [True] * 100 + [False] * 100


def test_negative_charges_are_no_touch_and_are_flagged():
    """A press stretches the film: charges that fall say that an amplifier inverts, which the device file can mend."""
    frames = rest(200)
    frames[150:] -= 200.0
    readings = run(frames)
    assert not any(r.contact for r in readings)
    assert [r.flags for r in readings[100:]] == [()] * 50 + [("negative",)] * 50
    inverted = run(frames, Chain(gain_pC=-ONE_PC))
    assert [r.contact for r in inverted] == [False] * 150 + [True] * 50


def test_noise_of_a_minute_gives_no_touch():
    assert not any(r.contact for r in run(rest(12_000, seed=3)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.01e9, 1.7e308])
@pytest.mark.parametrize("gain", [None, 0.5, 2.0])
def test_invalid_frame_passes_no_stage(value, gain):
    """The frames after it give the same readings as without it."""
    settings = Chain(gain_pC=None if gain is None else np.full(3, gain))
    chain, undisturbed = SignalChain(settings, 3), SignalChain(settings, 3)
    for k, raw in enumerate(rest(150)):
        chain.advance(raw, k / RATE_HZ, 1 / RATE_HZ)
        undisturbed.advance(raw, k / RATE_HZ, 1 / RATE_HZ)
    bad = np.array([1.0, value / (gain or 1.0), 2.0])
    reading = chain.advance(bad, 150 / RATE_HZ, 0.25, flags=("gap",))
    for k, raw in enumerate(rest(20, seed=1)):
        after = chain.advance(raw, 151 / RATE_HZ, 1 / RATE_HZ)
        expected = undisturbed.advance(raw, 151 / RATE_HZ, 1 / RATE_HZ + (0.25 if k == 0 else 0.0))
        np.testing.assert_array_equal(after.charge_pC, expected.charge_pC)
    assert (reading.charge_pC, reading.tare, reading.contact, reading.flags) == (None, None, False, ("gap", "invalid"))


def test_time_of_invalid_frames_counts_for_the_next():
    """A leak is undone over all the time since the last valid frame: exp(-0.5 s / 1 s) of the output is left."""
    chain = SignalChain(Chain(tare=None, touch=None, tau_s=np.ones(3), leak=LeakRule(learn=False)), 3)
    for charge_pC, dt_s in ((0.0, 0.1), (0.0, 0.1), (100.0, 0.1), (np.nan, 0.05), (np.inf, 0.15)):
        chain.advance(np.full(3, charge_pC), 0.0, dt_s)
    reading = chain.advance(100.0 * np.exp(np.full(3, -0.5)), 0.0, 0.3)
    np.testing.assert_allclose(reading.charge_pC, 100.0)


def test_flags_of_the_frame_come_before_those_of_the_chain():
    reading = SignalChain(Chain(), 3).advance(OFFSET, 0.0, 0.0, limited=True, flags=("gap",))
    assert reading.flags == ("gap", "tare", "saturated")


def test_base_that_relaxes_to_zero_is_no_touch():
    """A long press may leave the charge below zero; as it relaxes, so does the base that a touch is measured from."""
    totals, decay = -100.0 * np.exp(-np.arange(1000) / 200.0), float(np.exp(-1.0 / 200.0))

    def contacts(decay):
        touch, seen = Touch(last_pC=-100.0, base_pC=-100.0), False
        for total in totals.tolist():
            touch = update_contact(TouchRule(), touch, total, ONE_PC, decay)
            seen |= touch.contact
        return seen

    assert not contacts(decay)
    assert contacts(1.0)
