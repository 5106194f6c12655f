"""Tests of the removal of mains hum, which must not change touches."""

import numpy as np
import pytest

from isocharge.serve import Frame
from isocharge.serve.signal_chain.hum import Hum
from isocharge.serve.signal_chain.stage import Setup


def without_hum(raw_pC, rate_Hz):
    """Return charges, shape (n, electrodes), pC, from which the hum is removed."""
    hum = Hum(Setup(tuple("ABC")))
    frames = [
        Frame(None, None, (), dt_s=1 / rate_Hz, clock_s=k / rate_Hz, charge_pC=row) for k, row in enumerate(raw_pC)
    ]
    for frame in frames:
        hum.step(frame)
    return np.array([frame.charge_pC for frame in frames])


def mains_hum(n, rate_Hz, amplitude_pC, frequency_Hz=50.0):
    """Return the hum of three electrodes with different phases, shape (n, 3), pC."""
    t = np.arange(n)[:, None] / rate_Hz
    phases = np.array([0.3, 1.9, 4.0])
    return amplitude_pC * np.sin(2 * np.pi * frequency_Hz * t + phases)


@pytest.mark.parametrize("rate_Hz", [60.0, 200.0, 1000.0, 2300.0, 10_000.0])
@pytest.mark.parametrize("frequency_Hz", [50.0, 50.05])
def test_hum_is_gone_after_two_seconds(rate_Hz, frequency_Hz):
    """If the frequency of the mains is wrong by 0.05 Hz, a fifth of the hum may remain."""
    hum_pC = mains_hum(int(4 * rate_Hz), rate_Hz, 5.0, frequency_Hz)
    settled_pC = without_hum(hum_pC, rate_Hz)[int(2 * rate_Hz) :]
    max_residual_pC = 0.1 if frequency_Hz == 50.0 else 1.0
    assert np.abs(settled_pC).max() < max_residual_pC


def test_noise_of_the_first_tare_contains_little_hum():
    """The tare is measured in the first half second."""
    raw_pC = np.random.default_rng(0).normal(0.0, 1.0, (100, 3)) + mains_hum(100, 200.0, 5.0)
    assert without_hum(raw_pC, 200.0).std(axis=0).max() < 1.4


def test_touch_passes_hum_removal_without_delay_and_ringing():
    """A fixed notch filter with a time constant of 0.5 s would ring with 11 pC after this step of 850 pC."""
    rate_Hz = 1000.0
    touch_frame = 3000
    step_pC = np.where(np.arange(6000)[:, None] < touch_frame, 0.0, 850.0)
    clean_pC = without_hum(step_pC + mains_hum(6000, rate_Hz, 1.0), rate_Hz)
    assert np.abs(clean_pC[touch_frame + 1 :] - 850.0).max() < 0.5


def test_noise_is_hardly_raised_by_hum_removal():
    noise_pC = np.random.default_rng(0).normal(0.0, 0.3, (20_000, 3))
    assert without_hum(noise_pC, 1000.0)[2000:].std() < 1.05 * 0.3


def test_hum_that_does_not_turn_between_frames_is_left():
    """At 50 frames per second, the hum of 50 Hz is the same in all frames."""
    raw_pC = np.random.default_rng(0).normal(0.0, 1.0, (100, 3))
    np.testing.assert_array_equal(without_hum(raw_pC, 50.0), raw_pC)
