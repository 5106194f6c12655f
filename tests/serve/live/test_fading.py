"""Tests of the cause of a decreasing charge, which is found if the press is long and has little noise."""

import re

import numpy as np
import pytest

from isocharge.serve.live.fading import cause_of_fading

RATE_HZ = 200.0
LEAK = r"put \[leak\] tau_s = "
CREEP = r"creeps by .* % in each decade .* set no \[leak\]"
UNDECIDED = "neither a leak .* nor creep"


def sizes_of_press(law, seconds, seed, relative_noise):
    """Return the mean charges of a press of 500 pC in windows of half a second, which begin every 50 ms.

    The force has white noise and a tremor of 9 Hz.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(1, round(seconds * RATE_HZ)) / RATE_HZ
    tremor = np.sqrt(2.0) * np.sin(2.0 * np.pi * 9.0 * t + rng.uniform(0.0, 2.0 * np.pi))
    charge_pC = 500.0 * law(t) * (1.0 + relative_noise * (tremor + rng.standard_normal(t.size)))
    sizes = []
    for first in range(99, t.size - 100, 10):
        middle_s = t[first] + 0.25
        sizes.append((middle_s, float(charge_pC[first : first + 100].mean())))
    return sizes


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (lambda t: np.exp(-t / 3.0), LEAK + r"(2\.9|3|3\.1) "),
        (lambda t: np.exp(-t / 40.0), LEAK + r"(3[6-9]|4[0-4]) "),
        (lambda t: 1.0 - 0.08 * np.log10(t), CREEP.replace(".*", r"[6-9](\.\d)?", 1)),
        (lambda t: t**-0.06, CREEP.replace(".*", r"1[1-5]", 1)),  # 1 - 10^-0.06 is 13 %
    ],
)
def test_leak_and_creep_of_a_long_press_are_distinguished(law, expected):
    for seed in range(20):
        assert re.search(expected, cause_of_fading(sizes_of_press(law, 6.0, seed, 0.007)).cause)


@pytest.mark.parametrize("law", [lambda t: np.exp(-t / 20.0), lambda t: 1.0 - 0.04 * np.log10(t), lambda _: 1.0])
@pytest.mark.parametrize(("seconds", "relative_noise"), [(1.2, 0.007), (6.0, 0.1)])
def test_cause_is_undecided_for_short_or_noisy_presses(law, seconds, relative_noise):
    for seed in range(20):
        assert re.search(UNDECIDED, cause_of_fading(sizes_of_press(law, seconds, seed, relative_noise)).cause)
