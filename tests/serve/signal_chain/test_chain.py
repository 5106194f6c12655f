"""Tests of the signal chain: tare, detection of touches, and invalid frames."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from isocharge.common.errors import TareError
from isocharge.serve import Frame
from isocharge.serve.signal_chain.stage import Device, Setup
from isocharge.serve.signal_chain.touch import Touch, TouchRule
from stage_runner import StageRunner

OFFSET = np.array([12.0, -7.0, 3.0])
"""Charges at rest, shape (3,), pC."""

RATE_HZ = 200.0
"""Number of frames per second, Hz."""

ONE_PC = np.ones(3)
"""Standard deviation of the noise of each electrode, shape (3,), pC."""


def rest(n, std_pC=1.0):
    """Return noisy charges at rest, shape (n, 3), pC."""
    return OFFSET + std_pC * np.random.default_rng(0).standard_normal((n, 3))


def contacts_of(readings):
    """Return whether something touches in each reading."""
    return [reading.is_contact for reading in readings]


def run(frames_pC, **sections):
    """Return the readings of frames with charges of shape (n, 3), pC."""
    return StageRunner(**sections).run(frames_pC, RATE_HZ)


@pytest.mark.parametrize(
    ("charges_pC", "message"),
    [
        (rest(300) + 800.0, r"rests at 81\d.* pC, expected at most 100 pC; take off"),
        (rest(300, std_pC=50.0), r"varies by 5\d.* pC rms.* look for hum and noise with `isocharge serve doctor`"),
    ],
)
def test_tare_gives_up_with_the_reason(charges_pC, message):
    with pytest.raises(TareError, match=message):
        run(charges_pC, tare={"patience": 250})


@pytest.mark.parametrize("patience", [50, 0])
def test_second_tare_and_search_without_limit_never_give_up(patience):
    """A finger that rests on the film does not stop a live stream."""
    chain = StageRunner(tare={"frames": 20, "patience": patience})
    if patience > 0:
        chain.run(rest(60), RATE_HZ)
        chain.reset_tare()
    readings = chain.run(np.concatenate([rest(200, std_pC=100.0), rest(30)]), RATE_HZ)
    assert [reading.tare_pC is not None for reading in readings].index(True) == 220


THRESHOLD_PC = np.sqrt(3.0) + 6.0 / np.sqrt(2.0) + 10.0 / np.sqrt(3.0)
"""Touch threshold of a charge on one of three electrodes with a noise of 1 pC, pC."""


def touch_stage(*, has_any_sign=False):
    """Return a stage that detects touches, with its default settings."""
    return Touch(Setup(tuple("ABC"), Device(rules={TouchRule: TouchRule()}), has_any_sign=has_any_sign))


def detect(touch, charge_pC, noise_pC=ONE_PC, dt_s=1.0, **settings):
    """Return a frame in which a stage has looked for a touch.

    Args:
        touch: The stage.
        charge_pC: Charge of the first electrode, or of all electrodes, pC.
        noise_pC: Noise of each electrode, pC.
        dt_s: Time since the previous frame, s.
        settings: Other attributes of the frame.
    """
    frame = Frame(None, None, (), dt_s=dt_s, **settings)
    frame.charge_pC = charge_pC * np.array([1.0, 0.0, 0.0]) if np.ndim(charge_pC) == 0 else charge_pC
    frame.noise_pC = noise_pC
    touch.step(frame)
    return frame


@pytest.mark.parametrize(
    ("totals", "noise", "expected"),
    [
        ([THRESHOLD_PC - 0.1, THRESHOLD_PC + 0.1], ONE_PC, [0, 1]),  # floor and noise
        ([5.7, 5.8], 0.0 * ONE_PC, [0, 1]),  # floor
        ([11.0, 25.0, 15.0, 6.5, 5.0, 11.0], ONE_PC, [0, 1, 1, 1, 0, 0]),  # hysteresis
        ([1000.0, 4000.0, 4000.0, 201.0, 199.0], ONE_PC, [1, 1, 1, 1, 0]),  # share of the peak
        # The charge at rest has drifted to 60 pC, so that an absolute threshold would never release the press.
        ([2060.0, 2060.0, 60.0, 62.0, 58.0, 60.0, 69.0, 71.0], ONE_PC, [1, 1, 0, 0, 0, 0, 0, 1]),
        # One frame with an absurd charge does not release a press and does not prevent its detection.
        *(([*before, 3e38, *[850.0] * 4], ONE_PC, [1] * (len(before) + 5)) for before in ([], [850.0], [850.0] * 5)),
    ],
)
def test_touches_begin_and_end(totals, noise, expected):
    touch = touch_stage()
    assert [detect(touch, total_pC, noise).is_contact for total_pC in totals] == expected


@pytest.mark.parametrize("n_electrode", [1, 3, 32])
def test_noise_exceeds_the_touch_threshold_rarely_with_any_number_of_electrodes(n_electrode):
    """The sum of the squares of the noise has a chi-squared distribution. There is no floor."""
    threshold = TouchRule(floor_pC=0.0).threshold_pC(np.ones(n_electrode))[0]
    assert 1e-9 < chi2.sf(threshold**2, n_electrode) < 3e-7


@pytest.mark.parametrize("ratios", [(1.0, -1.0, 0.0), (-1.0, -1.0, -1.0)])
def test_touch_is_detected_from_charges_of_any_sign(ratios):
    """The charges of a sensor without a film may have any sign, and their sum may be zero or negative.

    The charge of the finger that leaves the film does not give the next touch the flag `drift`.
    """
    touch = touch_stage(has_any_sign=True)
    forces = (0.0, 1e3, 1e3, 40.0, 0.0, 0.0, -100.0, 0.0)
    frames = [detect(touch, force * np.array(ratios), dt_s=0.1) for force in forces]
    assert [(frame.is_contact, frame.flags) for frame in frames] == [(abs(force) > 40.0, []) for force in forces]


@pytest.mark.parametrize("has_any_sign", [False, True])
def test_end_of_a_long_press_with_a_leak_is_no_touch(has_any_sign):
    """A press of 5 s loses 39 % of its charge (tau = 10 s), and the release leaves the lost charge with a minus.

    The next press is detected when its charges exceed zero.
    """
    touch = touch_stage(has_any_sign=has_any_sign)
    force = np.interp(np.arange(4000), [199, 200, 1199, 1200, 2500, 2520], [0, 1, 1, 0, 0, 1])
    rows_pC = np.outer(lfilter([1.0, -1.0], [1.0, -np.exp(-0.1 / RATE_HZ)], force), [900.0, 300.0, 100.0])
    frames = [detect(touch, row_pC, dt_s=1.0 / RATE_HZ, base_relax_s=2.0, is_base_held=True) for row_pC in rows_pC]
    assert contacts_of(frames) == [200 <= number < 1200 or number >= 2505 for number in range(4000)]
    assert frames[1300].flags == ["negative"]


def test_negative_charges_are_no_touch_and_are_flagged():
    """A press increases the charges, because it stretches the film. With an inverting amplifier, they decrease."""
    frames_pC = rest(200)
    frames_pC[150:] -= 200.0
    readings = run(frames_pC)
    assert not any(contacts_of(readings))
    assert [reading.flags for reading in readings[100:]] == [()] * 50 + [("negative",)] * 50
    corrected = run(frames_pC, gain={"pC_per_unit": -1.0})
    assert contacts_of(corrected) == [False] * 150 + [True] * 50


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.01e9, 1.7e308])
@pytest.mark.parametrize("gain", [None, 0.5, 2.0])
def test_invalid_frame_passes_no_stage(value, gain):
    """The readings after the invalid frame are the same as in a chain that did not receive this frame."""
    sections = {}
    if gain is not None:
        sections = {"leak": {"tau_s": 1.0}, "hum": {"frequency_Hz": 50.0}, "gain": {"pC_per_unit": gain}}
    charges = []
    for invalid_values in ([], [np.array([1.0, value / (gain or 1.0), 2.0])]):
        chain = StageRunner(**sections)
        chain.run(rest(150), RATE_HZ)
        step_s = 0.25 + 1 / RATE_HZ
        for raw_pC in invalid_values:
            invalid = chain.advance(raw_pC, 150 / RATE_HZ, 0.25, flags=("gap",))
            assert (invalid.charge_pC, invalid.tare_pC, invalid.is_contact) == (None, None, False)
            assert invalid.flags == ("gap", "invalid")
            step_s = 1 / RATE_HZ
        readings = [chain.advance(rest(20)[0], 151 / RATE_HZ, step_s), *chain.run(rest(20), RATE_HZ)]
        charges.append([reading.charge_pC for reading in readings])
    np.testing.assert_array_equal(*charges)


@pytest.mark.parametrize("drift_pC_per_s", [-0.3, 1.0])
def test_tare_follows_a_slow_drift_of_an_untouched_film(drift_pC_per_s):
    """Without a leak, the zero of a board drifts for half a minute. A press after that has nearly no offset."""
    frames_pC = rest(6000) + drift_pC_per_s * np.arange(6000)[:, None] / RATE_HZ
    *readings, pressed = run([*frames_pC, frames_pC[-1] + 500.0])
    assert not any(contacts_of(readings))
    np.testing.assert_allclose(readings[-1].raw_pC - readings[-1].tare_pC, readings[-1].charge_pC)
    assert pressed.is_contact
    assert pressed.charge_pC == pytest.approx([500.0] * 3, abs=6.0)


def test_contact_that_a_fast_drift_begins_has_the_flag_drift():
    """The tare cannot follow the drift of an untouched film. A press that follows another press has no flag."""
    drifting_pC = rest(2000) + 4.0 * np.arange(2000)[:, None] / RATE_HZ
    readings = run(drifting_pC)
    assert readings[-1].is_contact
    assert contacts_of(readings) == ["drift" in reading.flags for reading in readings]

    press_pC = 1000.0 * np.interp(np.arange(800), [400, 800], [0.0, 1.0])  # 1.5 pC in a frame, 1500 pC/s in total
    pressed = run(rest(1600) + np.tile(press_pC, 2)[:, None])
    assert pressed[-1].is_contact
    assert not any("drift" in reading.flags for reading in pressed)


def test_tare_does_not_follow_a_finger():
    """A held press keeps its charge. A finger that is below the release threshold is not absorbed by the tare."""
    run_pC = [(400, 0.0), (2000, 1000.0), (400, 30.0), (200, 1000.0)]
    frames_pC = np.concatenate([rest(count) + press_pC for count, press_pC in run_pC])
    readings = run(frames_pC)
    offset_pC = readings[399].tare_pC
    assert readings[2399].charge_pC == pytest.approx(frames_pC[2399] - offset_pC, abs=0.1)
    assert not readings[2799].is_contact
    assert readings[-1].charge_pC == pytest.approx(1000.0 * ONE_PC, abs=10.0)
