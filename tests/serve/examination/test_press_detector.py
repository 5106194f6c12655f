"""Search for a touch at rest. Presses are found. Noise, drift and warming are not taken for presses."""

import re

import numpy as np
import pytest

from isocharge.serve.examination.press_detector import block_medians, touch_sentence
from isocharge.simulate import load_amplifier

RATE_HZ = 200.0
"""Number of frames per second, Hz."""

PRESS_PC = np.array([150.0, 90.0, 110.0])
"""Charges of a press of 0.05 N, pC."""


def measured(level, seed, press, seconds=5.0):
    """Simulate the output of an amplifier during a press.

    Args:
        level: Name of the amplifier.
        seed: Seed of the noise.
        press: Function that returns the force at some times, s, relative to the force of `PRESS_PC`.
        seconds: Length, s.

    Returns:
        The output, shape (n, 3), pC, and the times, s.
    """
    times_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    charges = np.multiply.outer(press(times_s), PRESS_PC)
    measure = load_amplifier(level).start(3, RATE_HZ, np.random.default_rng(seed))
    return measure(charges), times_s


def no_press(t):
    return np.zeros_like(t)


PRESSES = {
    "begins": lambda t: (t > 2.5).astype(float),
    "ends": lambda t: (t < 2.5).astype(float),
    "tap": lambda t: ((t > 2.0) & (t < 2.3)).astype(float),
    "wavers": lambda t: 1.0 + 0.3 * np.sin(3.0 * t),
}


@pytest.mark.parametrize("level", ["clean", "reference", "bench", "surgery"])
@pytest.mark.parametrize("seconds", [1.0, 20.0])
def test_noise_drift_and_warming_are_not_taken_for_a_touch(level, seconds):
    for seed in range(2):
        charges, times_s = measured(level, seed, no_press, seconds)
        assert not touch_sentence("ABC", charges, times_s, "pC")
        assert not touch_sentence("ABC", np.round(20.0 * charges), times_s, "counts")


def test_step_of_one_count_is_not_taken_for_a_touch():
    """A converter with a coarse step shows no noise, but a slow drift changes its whole numbers."""
    times_s = np.arange(1000) / RATE_HZ
    counts = np.column_stack([300.0 + np.floor(times_s), np.full(1000, 7.0), 40.0 - np.floor(times_s)])
    assert not touch_sentence("ABC", counts, times_s, "counts")


@pytest.mark.parametrize("level", ["reference", "bench"])
@pytest.mark.parametrize("press", PRESSES)
def test_press_of_0_05_N_is_found(level, press):
    for seed in range(3):
        charges, times_s = measured(level, seed, PRESSES[press])
        sentence = touch_sentence("ABC", charges, times_s, "pC")
        channel, change_pC, time_s = re.search(r"channel (.) changes by (.+) pC about (.+) s after", sentence).groups()
        if level == "reference":  # the amplifier `bench` leaks
            assert channel == "A"
            assert float(change_pC) == pytest.approx(150.0 * np.ptp(PRESSES[press](times_s)), abs=20.0)
        assert touch_sentence("ABC", np.round(20.0 * charges), times_s, "counts")
        if press in ("begins", "ends"):
            assert float(time_s) == pytest.approx(2.5, abs=0.3)


def test_damaged_value_is_not_taken_for_a_touch():
    charges, times_s = measured("reference", 0, no_press)
    charges[300] = 1e6
    charges[500, 1] = np.nan
    assert not touch_sentence("ABC", charges, times_s, "pC")


def test_hum_averages_out_of_block_medians():
    times_s = np.arange(0.0, 2.0, 0.001)
    hum = 100.0 * np.sin(2.0 * np.pi * 50.0 * times_s)
    assert np.abs(block_medians(hum[:, None], times_s)).max() < 1.0
