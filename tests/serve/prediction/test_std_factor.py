"""Guarantee of the factor for standard deviations, on simulated presses whose errors do not follow the model."""

import numpy as np
import pytest
from scipy.stats import chi2

from isocharge.serve.prediction.press_errors import REGION_QUANTILES, StdFactor


def draw(rng, count, scale, degrees_of_freedom):
    """Return errors with heavy tails and stated standard deviations that are wrong by a factor, both (count, 3)."""
    std = rng.uniform(0.5, 2.0, (count, 3))
    return scale * std * rng.standard_t(degrees_of_freedom, (count, 3)), std


def coverage(factor, error, std):
    return np.mean(np.sum((error / (factor * std)) ** 2, axis=1) <= chi2.ppf(0.95, 3))


@pytest.mark.parametrize("count", [22, 30, 100])
def test_regions_hold_for_at_least_ninety_percent_of_contacts_on_ninety_percent_of_films(count):
    rng = np.random.default_rng(count)
    holds = []
    for _ in range(1000):
        scale, degrees_of_freedom = rng.uniform(0.3, 4.0), rng.integers(3, 30)
        factor = StdFactor.from_errors(*draw(rng, count, scale, degrees_of_freedom)).factor
        holds.append(coverage(factor, *draw(rng, 2000, scale, degrees_of_freedom)) >= 0.9)
    assert 0.88 < np.mean(holds) < 0.98


def test_too_few_presses_have_no_guarantee():
    assert StdFactor.from_errors(*draw(np.random.default_rng(0), 21, 1.0, 30)) is None
    assert StdFactor.from_errors(np.full((30, 3), np.nan), np.ones((30, 3))) is None


def test_unknown_values_do_not_count():
    np.testing.assert_allclose(REGION_QUANTILES, chi2.ppf(0.95, [1, 2, 3]), atol=1e-3)
    error = np.full((30, 3), np.nan)
    error[:, 2] = 2.0 * np.sqrt(REGION_QUANTILES[0])
    assert StdFactor.from_errors(error, np.ones((30, 3))).factor == pytest.approx(2.0)
    assert "multiply the standard deviations by 2; the 95 %" in StdFactor(2.0, 30).statement
