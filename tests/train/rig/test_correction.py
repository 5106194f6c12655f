"""The smooth correction: a planted one comes back, noise alone gives none, and beyond the presses it stays."""

import numpy as np
import pytest
from tests.train.rig.conftest import systematic

from isocharge.simulate.forward.charge_map import Domain
from isocharge.train.data.presses import draw_contacts
from isocharge.train.rig.rig_film import Residuals, fit_correction


def contacts(rng, count, radius=8.0):
    return draw_contacts(rng, Domain(radius, (0.05, 2.0)), count)


def residuals(seed, count, truth, std=0.004):
    """Log ratios with correlated errors, as a rig that misreads places makes them."""
    rng = np.random.default_rng(seed)
    contact = contacts(rng, count)
    slopes = rng.normal(size=(count, 4, 2))
    covariance = std**2 * (np.eye(4) + 4.0 * slopes @ slopes.transpose(0, 2, 1))
    noise = np.einsum("nef,nf->ne", np.linalg.cholesky(covariance), rng.normal(size=(count, 4)))
    return Residuals(contact, truth(contact) + noise, covariance)


@pytest.mark.parametrize("seed", range(2))
def test_a_planted_correction_comes_back(seed):
    correction = fit_correction(residuals(seed, 200, systematic))
    fresh = contacts(np.random.default_rng(100 + seed), 1000, 7.5)
    left = correction.log_factor(fresh) - systematic(fresh)
    assert np.sqrt(np.mean(left**2)) < 0.25 * np.sqrt(np.mean(systematic(fresh) ** 2))
    assert 4.0 < correction.freedom < 200.0


def test_noise_alone_is_not_corrected():
    """At two standard errors, at most one of six draws may look like a correction; then a tiny one."""
    corrections = [fit_correction(residuals(seed, 60, lambda contact: 0.0 * systematic(contact))) for seed in range(6)]
    real = [correction for correction in corrections if not correction.nothing]
    assert len(real) <= 1
    fresh = contacts(np.random.default_rng(5), 500)
    assert all(np.sqrt(np.mean(each.log_factor(fresh) ** 2)) < 0.004 for each in real)


def test_beyond_the_presses_it_stays():
    correction = fit_correction(residuals(0, 200, systematic))
    far = np.array([[12.0, 5.0, 1.0], [3.0, 4.0, 50.0]])
    nearest = far.copy()
    nearest[0, :2] *= correction.domain.radius / np.hypot(*far[0, :2])
    nearest[1, 2] = correction.domain.force_range[1]
    np.testing.assert_allclose(correction.log_factor(far), correction.log_factor(nearest), rtol=1e-12)


def test_without_a_prior_it_is_weighted_least_squares():
    """Many presses and a wide prior: the same as NumPy's own least squares on whitened equations."""
    data = residuals(3, 2100, systematic)
    correction = fit_correction(data)
    x, y, _ = data.contact.T
    low, high = np.log(correction.domain.force_range)
    unit = (
        x / correction.domain.radius,
        y / correction.domain.radius,
        (2 * np.log(data.contact[:, 2]) - low - high) / (high - low),
    )
    chebyshev = np.polynomial.chebyshev.Chebyshev
    degree = correction.degree
    terms = [
        np.prod([chebyshev.basis(k)(u) for k, u in zip(ks, unit, strict=True)], axis=0)
        for ks in np.ndindex(degree + 1, degree + 1, min(degree, 2) + 1)
        if sum(ks) <= degree
    ]
    whiten = np.linalg.inv(np.linalg.cholesky(data.covariance))
    design = np.einsum("tn,nge->ngte", np.array(terms), whiten).reshape(len(x) * 4, -1)
    target = np.einsum("nge,ne->ng", whiten, data.log_ratio).ravel()
    weights, *_ = np.linalg.lstsq(design, target)
    fitted = np.array(terms).T @ weights.reshape(len(terms), 4)
    assert np.sqrt(np.mean((correction.log_factor(data.contact) - fitted) ** 2)) < 5e-4
