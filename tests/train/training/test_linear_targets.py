"""Targets of the contact network for sensors with many electrodes, compared with SciPy's least squares."""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from function_map import FunctionMap
from isocharge.simulate import Domain, NoiseModel
from isocharge.train import LabelledPresses
from isocharge.train.training.contact_training import LARGEST_LINEAR_STD, LinearTargets

DOMAIN = Domain(10.0, (0.1, 2.0))
ELECTRODE_PLACES = 8.0 * np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [0.2, 0.1], [0.9, 0.9]])
CONTACT = np.array([[3.0, -2.0, 1.0], [-6.0, 4.0, 0.3], [0.5, 0.0, 1.8]])


def bell_charges(contact):
    """Return charges that decrease with the distance from six electrodes, shape (n, 6), pC."""
    distance = np.linalg.norm(contact[:, None, :2] - ELECTRODE_PLACES, axis=2)
    return 1e4 * contact[:, 2:] ** 0.7 / (1.0 + (distance / 8.0) ** 2)


CHARGE_MAP = FunctionMap(bell_charges, tuple("ABCDEF"), DOMAIN)


def targets_of(noise, contact=CONTACT):
    """Return the targets of presses on the bell-shaped map."""
    return LinearTargets.compute(LabelledPresses(contact, bell_charges(contact)), CHARGE_MAP, noise)


def draw(targets, noise, rows, seed):
    """Return the enlarged noise of presses, pC, and the changes of their targets, in double precision."""
    charge = bell_charges(CONTACT)[rows]
    drawn = noise.sigma(charge) * np.random.default_rng(seed).standard_normal(charge.shape)
    enlarged, change, _ = targets.enlarge(torch.tensor(drawn).float(), rows)
    return enlarged.double().numpy(), change.double().numpy()


def nonlinear_estimate(charge, noise_std):
    """Return the contact in unit coordinates with the smallest sum of squared residuals, found by SciPy."""

    def residuals(unit):
        contact = DOMAIN.to_contact(unit[None])
        return (bell_charges(contact)[0] - charge) / noise_std

    return least_squares(residuals, np.zeros(3), xtol=1e-13, ftol=1e-13, gtol=1e-13).x


@pytest.mark.parametrize("gain", [0.0, 0.001], ids=["white noise", "white noise and noise of the gains"])
def test_targets_are_the_least_squares_estimates_of_the_charges_with_noise(gain):
    """The targets are linear in the noise. A quarter of the enlarged noise is small enough for the estimates, too."""
    noise = NoiseModel("small", white=1.0, gain=gain)
    targets = targets_of(noise)
    enlarged, target_change = draw(targets, noise, torch.arange(len(CONTACT)), seed=3)
    noise_std = noise.sigma(bell_charges(CONTACT))
    noisy = bell_charges(CONTACT) + 0.25 * enlarged
    estimates = [nonlinear_estimate(charge, std) for charge, std in zip(noisy, noise_std, strict=True)]
    change = np.array(estimates) - DOMAIN.to_unit(CONTACT)
    np.testing.assert_allclose(0.25 * target_change, change, rtol=0.05, atol=2e-5)


def test_the_noise_is_enlarged_until_the_contact_would_be_too_uncertain_for_a_linear_estimate():
    """The standard deviations of the enlarged noise are compared with many draws."""
    noise = NoiseModel("large", white=15.0, gain=0.002)
    targets = targets_of(noise)
    factor = targets.noise_factor.numpy()[:, 0]
    assert np.all(factor > 1.0)
    rows = torch.arange(len(CONTACT)).repeat(20_000)
    enlarged, target_change = draw(targets, noise, rows, seed=4)
    expected_std = factor[:, None] * noise.sigma(bell_charges(CONTACT))
    np.testing.assert_allclose(enlarged.reshape(-1, *expected_std.shape).std(axis=0), expected_std, rtol=0.02)

    largest_std = target_change.reshape(-1, len(CONTACT), 3).std(axis=0).max(axis=1)
    np.testing.assert_allclose(largest_std, LARGEST_LINEAR_STD, rtol=0.02)


def test_a_press_with_an_uncertain_contact_keeps_its_contact_as_the_target_and_its_noise():
    noise = NoiseModel("very large", white=2_000.0, gain=0.0)
    targets = targets_of(noise)
    assert torch.all(targets.noise_factor == 1.0)
    enlarged, target_change = draw(targets, noise, torch.tensor([2, 0]), seed=5)
    assert not target_change.any()
    assert enlarged.any()
