"""Offset, noise, drift and hum of channels against the values that they were computed from."""

import numpy as np
import pytest

from isocharge.serve.examination.channel_health import channel_health


def test_offset_drift_hum_and_noise_of_a_channel():
    t, rng = np.arange(0.0, 4.0, 0.002), np.random.default_rng(0)
    charge = 12.0 + 3.0 * t + 2.0 * np.sin(2 * np.pi * 50 * t + 1) + 0.5 * np.sin(2 * np.pi * 60 * t)
    health = channel_health("A", charge + rng.normal(0, 0.3, t.size), t, 500.0)
    assert health.offset_pC == pytest.approx(12.0 + 6.0, abs=0.1)
    assert health.drift_pC_per_s == pytest.approx(3.0, abs=0.05)
    assert health.hum_pC == pytest.approx((2.0, 0.5), abs=0.05)
    assert health.noise_pC == pytest.approx(0.3, rel=0.05)


def test_hum_above_half_the_rate_is_not_estimated():
    t = np.arange(0.0, 4.0, 0.01)
    assert channel_health("A", np.sin(t), t, 100.0).hum_pC == (None, None)


def test_values_that_are_no_charges_are_counted_and_left_out():
    t = np.arange(0.0, 4.0, 0.01)
    charge = 7.0 + np.random.default_rng(0).normal(0.0, 0.3, t.size)
    charge[[3, 90, 200]] = np.nan, 1e300, -np.inf
    health = channel_health("A", charge, t, 100.0)
    assert health.offset_pC == pytest.approx(7.0, abs=0.05)
    assert (health.unusable, health.noise_pC) == (3, pytest.approx(0.3, rel=0.1))
