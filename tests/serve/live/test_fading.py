"""Held presses that fade: a leak and creep are told apart, and what is too short or too noisy is not told."""

import re

import numpy as np
import pytest

from isocharge.serve.live.fading import cause_of_fading

RATE_HZ = 200.0
LEAK, CREEP, UNTOLD = (
    r"put \[leak\] tau_s = ",
    r"creeps, by .* % in each decade .* set no \[leak\]",
    "cannot be told apart",
)


def held(law, seconds, seed, noise_share):
    """Means over windows of half a second, every 50 ms, of a press of 500 pC that a hand of 9 Hz and noise shake."""
    t, rng = np.arange(1, round(seconds * RATE_HZ)) / RATE_HZ, np.random.default_rng(seed)
    tremble = np.sqrt(2.0) * np.sin(2.0 * np.pi * 9.0 * t + rng.uniform(0.0, 2.0 * np.pi)) + rng.standard_normal(t.size)
    charge = 500.0 * law(t) * (1.0 + noise_share * tremble)
    return [(t[k] + 0.25, float(charge[k : k + 100].mean())) for k in range(99, t.size - 100, 10)]


@pytest.mark.parametrize(
    ("law", "said"),
    [
        (lambda t: np.exp(-t / 3.0), LEAK + r"(2\.9|3|3\.1) "),
        (lambda t: np.exp(-t / 40.0), LEAK + r"(3[6-9]|4[0-4]) "),
        (lambda t: 1.0 - 0.08 * np.log10(t), CREEP.replace(".*", r"[6-9](\.\d)?", 1)),
        (lambda t: t**-0.06, CREEP.replace(".*", r"1[1-5]", 1)),  # 1 - 10^-0.06 is 13 %
    ],
)
def test_a_leak_and_creep_are_told_apart(law, said):
    for seed in range(20):
        assert re.search(said, cause_of_fading(held(law, 6.0, seed, 0.007)))


@pytest.mark.parametrize("law", [lambda t: np.exp(-t / 20.0), lambda t: 1.0 - 0.04 * np.log10(t), lambda _: 1.0])
@pytest.mark.parametrize(("seconds", "noise_share"), [(1.2, 0.007), (6.0, 0.1)])
def test_what_cannot_be_told_is_not(law, seconds, noise_share):
    for seed in range(20):
        assert UNTOLD in cause_of_fading(held(law, seconds, seed, noise_share))


def test_a_press_that_rises_first_has_no_time_constant():
    assert UNTOLD in cause_of_fading([(1.0, 500.0), (2.0, 530.0), (3.0, 560.0), (4.0, 590.0), (5.0, 585.0)])
