"""Noise of channels that is estimated from presses at repeated contacts, against the noise that was added."""

import numpy as np
import pytest

from isocharge.train.data.channel_noise import ChannelNoise


def estimated_over_true_noise(contacts, repetitions, gain, seed):
    """Estimate the noise of charges of a strongly curved function, and divide it by the true noise (rms)."""
    rng = np.random.default_rng(seed)
    contact = np.repeat(rng.uniform(-1.0, 1.0, (contacts, 3)), repetitions, axis=0)
    shape = np.exp(-2.0 * (contact[:, :1] - [-0.7, 0.0, 0.7]) ** 2 - contact[:, 1:2] ** 2)
    charge = 2000.0 * shape * np.exp(1.2 * contact[:, 2:])
    true_std = np.hypot(1.0, gain * charge)
    estimated = ChannelNoise.estimate(charge + rng.standard_normal(charge.shape) * true_std, contact)
    return np.sqrt(np.mean((estimated.sigma(charge) / true_std) ** 2, axis=0))


@pytest.mark.parametrize("repetitions", [2, 3, 10])
@pytest.mark.parametrize("gain", [0.002, 0.015])
def test_noise_of_repeated_contacts_is_estimated_within_ten_percent(repetitions, gain):
    ratios = [estimated_over_true_noise(600 // repetitions, repetitions, gain, seed) for seed in range(8)]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.03)
    assert np.std(ratios) < 0.1


def test_noise_of_thirty_presses_at_ten_contacts_is_estimated_within_fifteen_percent():
    ratios = [estimated_over_true_noise(10, 3, 0.014, seed) for seed in range(16)]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)
    assert np.std(np.mean(ratios, axis=1)) < 0.2  # of the mean over the channels


def test_noise_of_contacts_that_are_not_repeated_is_hardly_overestimated():
    """Planes instead of quadratic functions state 5.8 times the noise."""
    assert 0.9 < np.mean(estimated_over_true_noise(1000, 1, 0.014, seed=0)) < 1.5


def test_repeated_presses_at_one_reference_do_not_determine_the_noise_of_other_charges():
    rng = np.random.default_rng(0)
    contact = np.vstack([rng.uniform(-1.0, 1.0, (600, 3)), np.tile([0.9, 0.9, 0.9], (25, 1))])
    charge = np.exp(4.0 + contact @ rng.uniform(-1.0, 1.0, (3, 4)))
    noise = ChannelNoise.estimate(charge * (1.0 + 0.007 * rng.standard_normal(charge.shape)), contact)
    ratio = np.median(noise.sigma(0.2 * charge) / (0.2 * charge), axis=0)
    np.testing.assert_allclose(ratio, 0.007, rtol=0.4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_channels_that_are_silent_below_a_threshold_are_not_free_of_noise(sign):
    """With the negative sign, the first channel is silent at all repeated contacts."""
    rng = np.random.default_rng(0)
    repeated = np.repeat(rng.uniform(0.0, 1.0, (100, 3)), 3, axis=0)
    contact = np.vstack([rng.uniform(-1.0, 1.0, (600, 3)), repeated])
    reading = 100.0 * contact * [sign, 1.0, 1.0] + rng.normal(0.0, 2.0, contact.shape)
    noise = ChannelNoise.estimate(np.where(reading < 10.0, 0.0, reading), contact)
    np.testing.assert_allclose(noise.white, 2.0, rtol=0.35)


def test_copies_of_presses_show_no_noise():
    rng = np.random.default_rng(0)
    contact = rng.uniform(-1.0, 1.0, (300, 3))
    charge = 300.0 + contact @ rng.uniform(-30.0, 30.0, (3, 4)) + rng.standard_normal((300, 4))
    sigma = ChannelNoise.estimate(np.tile(charge, (2, 1)), np.tile(contact, (2, 1))).sigma(charge[:1])
    np.testing.assert_allclose(sigma, 1.0, rtol=0.2)
