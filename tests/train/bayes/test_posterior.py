"""The posterior against closed forms and against summation over a grid."""

import numpy as np
import pytest
from bayes.posterior import Posterior
from scipy import stats

from isocharge.simulate import Domain, FunctionMap, NoiseModel, noise_model

REFERENCE = noise_model("reference")

ONE_FORCE = Domain(1.0, (1.0, 1.0 + 1e-9))
"""Disk with a radius of 1 mm and practically one force."""


@pytest.mark.parametrize("seed", range(2))
def test_the_posterior_of_linear_charges_with_white_noise_is_a_gaussian(seed):
    rng = np.random.default_rng(seed)
    slopes = rng.normal(size=(2, 4))
    charges = FunctionMap(lambda contact: 100.0 + contact[:, :2] @ slopes, tuple("ABCD"), ONE_FORCE)
    white_pC = 0.01
    noisy = 100.0 + np.array([[0.2, -0.3]]) @ slopes + white_pC * rng.normal(size=(1, 4))
    mean, std = Posterior(charges, NoiseModel("white", white_pC, 0.0), 1.0, population=4_000).mean_and_std(noisy)
    covariance = white_pC**2 * np.linalg.inv(slopes @ slopes.T)
    expected, *_ = np.linalg.lstsq(slopes.T, (noisy - 100.0)[0], rcond=None)
    assert (np.abs(mean[0, :2] - expected) < 0.05 * std[0, :2]).all()
    assert std[0, :2] == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.04)


def test_two_positions_with_the_same_charges_are_both_found():
    """The charges are even in x, so the posterior has two maxima, and its mean lies between them."""

    def even_charges(contact):
        return 100.0 + np.stack([contact[:, 0] ** 2, contact[:, 1]], axis=1)

    charges = FunctionMap(even_charges, ("A", "B"), ONE_FORCE)
    noisy = even_charges(np.array([[0.6, 0.1, 1.0]]))
    mean, std = Posterior(charges, NoiseModel("white", 0.001, 0.0), 1.0, population=4_000).mean_and_std(noisy)
    assert mean[0, :2] == pytest.approx([0.0, 0.1], abs=0.05)
    assert std[0, 0] == pytest.approx(0.6, rel=0.01)


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
        (NoiseModel("loud", 1.0, 0.05), (1.0, 2.0, 0.4)),  # the factor 1 / sigma shifts the mean
    ],
)
def test_the_posterior_is_a_sum_over_a_grid(spline, noise, contact):
    charge = spline.charges(np.array([contact]))
    if noise is REFERENCE:
        charge += np.array([[0.5, -1.0, 0.3]])
    mean, std = Posterior(spline, noise, spline.domain.radius, population=4_000).mean_and_std(charge)
    x, y, force = mean[0]
    x_std, y_std, force_std = std[0]
    centre = np.array([x, y, np.log(force)])
    half_width = 6.5 * np.array([x_std, y_std, force_std / force])
    expected_mean, expected_std = sum_over_grid(spline, noise, charge[0], centre, half_width, (100, 100, 20))
    assert std[0] == pytest.approx(expected_std, rel=0.1)  # drawn contacts of one posterior are correlated
    assert (np.abs(mean[0] - expected_mean) < 0.15 * expected_std).all()
