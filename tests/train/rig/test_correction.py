"""The smooth correction: a planted one comes back, noise alone gives none, and beyond the presses it stays."""

import numpy as np
import pytest

from isocharge.train.rig.correction import Residuals, fit_correction

RNG_SEEDS = range(4)


def contacts(rng, count, radius_mm=8.0):
    radius, angle = radius_mm * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    return np.column_stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.exp(rng.uniform(np.log(0.05), np.log(2.0), count))]
    )


def planted(contact):
    """3 % times smooth functions of place, another for each electrode."""
    x, y, _ = contact.T
    return 0.03 * np.column_stack([np.sin(x / 4 + k) * np.cos(y / 5) for k in range(4)])


def residuals(seed, count, truth, std=0.004):
    """Log ratios with correlated errors, as a rig that misreads places makes them."""
    rng = np.random.default_rng(seed)
    contact = contacts(rng, count)
    slopes = rng.normal(size=(count, 4, 2))
    covariance = std**2 * (np.eye(4) + 4.0 * slopes @ slopes.transpose(0, 2, 1))
    noise = np.einsum("nef,nf->ne", np.linalg.cholesky(covariance), rng.normal(size=(count, 4)))
    return Residuals(contact, truth(contact) + noise, covariance)


@pytest.mark.parametrize("seed", RNG_SEEDS)
def test_a_planted_correction_comes_back(seed):
    correction = fit_correction(residuals(seed, 200, planted))
    fresh = contacts(np.random.default_rng(100 + seed), 1000, 7.5)
    left = correction.log_factor(fresh) - planted(fresh)
    assert np.sqrt(np.mean(left**2)) < 0.25 * np.sqrt(np.mean(planted(fresh) ** 2))
    assert 4.0 < correction.freedom < 200.0


def test_noise_alone_is_not_corrected():
    """At two standard errors, at most one of ten draws may look like a correction; then a tiny one."""
    corrections = [fit_correction(residuals(seed, 60, lambda contact: 0.0 * planted(contact))) for seed in range(10)]
    real = [correction for correction in corrections if not correction.nothing]
    assert len(real) <= 1
    fresh = contacts(np.random.default_rng(5), 500)
    assert all(np.sqrt(np.mean(each.log_factor(fresh) ** 2)) < 0.004 for each in real)


def test_beyond_the_presses_it_stays():
    correction = fit_correction(residuals(0, 200, planted))
    far = np.array([[12.0, 5.0, 1.0], [3.0, 4.0, 50.0]])
    nearest = far.copy()
    nearest[0, :2] *= correction.radius_mm / np.hypot(*far[0, :2])
    nearest[1, 2] = correction.force_range_N[1]
    np.testing.assert_allclose(correction.log_factor(far), correction.log_factor(nearest), rtol=1e-12)


def test_without_a_prior_it_is_weighted_least_squares():
    """Many presses and a wide prior: the same as NumPy's own least squares on whitened equations."""
    data = residuals(3, 3000, planted)
    correction = fit_correction(data)
    x, y, _ = data.contact.T
    low, high = np.log(correction.force_range_N)
    unit = (
        x / correction.radius_mm,
        y / correction.radius_mm,
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
