"""Noise of channels that is estimated from presses at repeated contacts, against the noise that was added."""

import numpy as np
import pytest

from isocharge.train.data.channel_noise import ChannelNoise


@pytest.mark.parametrize("repetitions", [2, 3, 10])
@pytest.mark.parametrize("gain", [0.002, 0.015])
def test_noise_of_repeated_contacts_is_estimated_within_ten_percent(repetitions, gain):
    """The charges depend on the contact by a strongly curved function, which planes do not describe."""
    ratios = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        contact = np.repeat(rng.uniform(-1.0, 1.0, (600 // repetitions, 3)), repetitions, axis=0)
        shape = np.exp(-2.0 * (contact[:, :1] - [-0.7, 0.0, 0.7]) ** 2 - contact[:, 1:2] ** 2)
        charge = 2000.0 * shape * np.exp(1.2 * contact[:, 2:])
        noisy = charge + rng.standard_normal(charge.shape) * np.hypot(1.0, gain * charge)
        size = np.median(charge, axis=0)
        ratios.append(ChannelNoise.estimate(noisy, contact).sigma(size[None])[0] / np.hypot(1.0, gain * size))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.03)
    assert np.std(ratios) < 0.1


def test_copies_of_presses_show_no_noise():
    rng = np.random.default_rng(0)
    contact = rng.uniform(-1.0, 1.0, (300, 3))
    charge = 300.0 + contact @ rng.uniform(-30.0, 30.0, (3, 4)) + rng.standard_normal((300, 4))
    sigma = ChannelNoise.estimate(np.tile(charge, (2, 1)), np.tile(contact, (2, 1))).sigma(charge[:1])
    np.testing.assert_allclose(sigma, 1.0, rtol=0.2)
