"""Hum is followed and taken out; touches are not."""

import numpy as np
import pytest

from isocharge.serve.signal_chain.hum import Hum, HumRule, remove_hum


def clean(raw_pC, rate_Hz, rule=None):
    hum, out = Hum.start(raw_pC.shape[1]), []
    for k, row in enumerate(raw_pC):
        hum, quiet = remove_hum(rule or HumRule(), hum, row, k / rate_Hz, 1 / rate_Hz)
        out.append(quiet)
    return np.array(out)


def mains(n, rate_Hz, amplitude_pC, frequency_Hz=50.0):
    t = np.arange(n)[:, None] / rate_Hz
    return amplitude_pC * np.sin(2 * np.pi * frequency_Hz * t + np.array([0.3, 1.9, 4.0]))


@pytest.mark.parametrize("rate_Hz", [200.0, 1000.0])
@pytest.mark.parametrize("frequency_Hz", [50.0, 50.05])
def test_hum_is_gone_after_two_seconds(rate_Hz, frequency_Hz):
    """The mains wander by 0.05 Hz; an eighth of the hum may then be left."""
    residual_pC = clean(mains(int(4 * rate_Hz), rate_Hz, 5.0, frequency_Hz), rate_Hz)[int(2 * rate_Hz) :]
    assert np.abs(residual_pC).max() < (0.1 if frequency_Hz == 50.0 else 1.0)


def test_touch_passes_hum_removal_without_delay_and_ringing():
    """A fixed notch of half a second rings with the step times its relative width, 850 * 2 / (50 pi): 11 pC."""
    rate_Hz, at = 1000.0, 3000
    step = np.where(np.arange(6000)[:, None] < at, 0.0, 850.0) * np.ones(3)
    assert np.abs(clean(step + mains(6000, rate_Hz, 1.0), rate_Hz)[at + 1 :] - 850.0).max() < 0.5


def test_noise_is_hardly_raised_by_hum_removal():
    assert clean(np.random.default_rng(0).normal(0.0, 0.3, (20_000, 3)), 1000.0)[2000:].std() < 1.05 * 0.3


def test_hum_that_does_not_turn_between_frames_is_left():
    raw = np.random.default_rng(0).normal(0.0, 1.0, (100, 3))
    np.testing.assert_array_equal(clean(raw, 50.0), raw)
