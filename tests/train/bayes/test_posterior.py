"""The posterior against closed forms and against summation over a grid, and the Bayes limit."""

from dataclasses import dataclass

import numpy as np
import pytest
from bayes.posterior import Posterior
from scipy import stats

from isocharge.simulate import Domain, NoiseModel, noise_model
from isocharge.train.data.presses import draw_contacts

REFERENCE = noise_model("reference")

UNIT_DISK = Domain(1.0, (1.0, 1.0 + 1e-9))
"""Disk with a radius of 1 mm and practically one force."""


@dataclass(frozen=True)
class QuadraticCharges:
    """Map whose charges are a quadratic function of the position, for practically one force."""

    offset: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray
    domain: Domain = UNIT_DISK

    @property
    def electrodes(self):
        return tuple(map(str, range(self.offset.size)))

    def force_weights(self, logs):
        return np.exp(logs)[..., None]

    def scaled_charges(self, position):
        return (self.offset + position @ self.linear + position**2 @ self.quadratic)[:, None]

    def scaled_gradients(self, position):
        moved = self.linear.T + 2.0 * position[:, None, :] * self.quadratic.T
        return moved[:, None]


def linear_charges(seed: int, electrodes: int = 4) -> QuadraticCharges:
    rng = np.random.default_rng(seed)
    return QuadraticCharges(100.0 + rng.random(electrodes), rng.normal(size=(2, electrodes)), np.zeros((2, electrodes)))


def draw_presses(charges, count, seed):
    """Draw contacts from the prior, and their charges with noise."""
    rng = np.random.default_rng(seed)
    contact = draw_contacts(rng, charges.domain, count)
    return contact, REFERENCE.add(charges.charges(contact), rng)


@pytest.mark.parametrize("seed", range(2))
def test_the_posterior_of_linear_charges_with_white_noise_is_a_gaussian(seed):
    charges = linear_charges(seed)
    white_pC = 0.01
    noise = white_pC * np.random.default_rng(seed).normal(size=(1, 4))
    noisy = charges.scaled_charges(np.array([[0.2, -0.3]]))[:, 0] + noise
    mean, std = Posterior(charges, NoiseModel("white", white_pC, 0.0), 1.0).mean_and_std(noisy)
    covariance = white_pC**2 * np.linalg.inv(charges.linear @ charges.linear.T)
    expected, *_ = np.linalg.lstsq(charges.linear.T, (noisy - charges.offset)[0], rcond=None)
    assert (np.abs(mean[0, :2] - expected) < 0.01 * std[0, :2]).all()
    assert std[0, :2] == pytest.approx(np.sqrt(np.diag(covariance)), rel=5e-3)


def test_two_positions_with_the_same_charges_are_both_found():
    """The charges are even in x, so the posterior has two maxima, and its mean lies between them."""
    charges = QuadraticCharges(
        np.array([100.0, 100.0]), np.array([[0.0, 0.0], [0.0, 1.0]]), np.array([[1.0, 0.0], [0.0, 0.0]])
    )
    noisy = charges.scaled_charges(np.array([[0.6, 0.1]]))[:, 0]
    mean, std = Posterior(charges, NoiseModel("white", 0.001, 0.0), 1.0).mean_and_std(noisy)
    assert mean[0, :2] == pytest.approx([0.0, 0.1], abs=1e-4)
    assert std[0, 0] == pytest.approx(0.6, rel=1e-3)


def sum_over_grid(charges, noise, charge, centre, half_width, count):
    """Compute mean and standard deviation of (x, y, F) by a sum over a grid in a box, within the prior.

    The centre, the half width and the number of grid points are given for x, y and ln F.
    """
    smallest, largest = np.log(charges.domain.force_range)
    low = np.maximum(centre - half_width, [-np.inf, -np.inf, smallest])
    high = np.minimum(centre + half_width, [np.inf, np.inf, largest])
    axes = [a + (b - a) * (np.arange(n) + 0.5) / n for a, b, n in zip(low, high, count, strict=True)]
    x, y, log_force = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
    is_inside = np.hypot(x, y) <= charges.domain.radius
    contact = np.stack([x, y, np.exp(log_force)], axis=1)[is_inside]
    expected = charges.charges(contact)
    log_likelihood = stats.norm.logpdf(charge, expected, noise.sigma(expected)).sum(axis=1)
    weight = np.exp(log_likelihood - log_likelihood.max())
    weight /= weight.sum()
    mean = weight @ contact
    std = np.sqrt(weight @ (contact - mean) ** 2)
    force = contact[:, 2]
    mean[2] = (weight @ (1.0 / force)) / (weight @ (1.0 / force**2))
    return mean, std


@pytest.mark.parametrize(
    ("noise", "contact"),
    [
        (REFERENCE, (7.2, 3.4, 0.0503)),
        (REFERENCE, (0.1, 0.0, 1.995)),
        (
            NoiseModel("loud", 1.0, 0.05),
            (1.0, 2.0, 0.4),
        ),  # the factor 1 / sigma shifts the mean
    ],
)
def test_the_integrals_are_sums_over_a_grid(spline, noise, contact):
    charge = spline.charges(np.array([contact]))
    if noise is REFERENCE:
        charge += np.array([[0.5, -1.0, 0.3]])
    mean, std = Posterior(spline, noise, spline.domain.radius).mean_and_std(charge)
    x, y, force = mean[0]
    x_std, y_std, force_std = std[0]
    centre = np.array([x, y, np.log(force)])
    half_width = 6.5 * np.array([x_std, y_std, force_std / force])
    expected_mean, expected_std = sum_over_grid(spline, noise, charge[0], centre, half_width, (100, 100, 20))
    assert std[0] == pytest.approx(expected_std, rel=0.01)
    assert (np.abs(mean[0] - expected_mean) < 0.01 * expected_std).all()
