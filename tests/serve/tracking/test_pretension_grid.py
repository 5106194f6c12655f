"""Tests of distributions of a pretension on a grid."""

import numpy as np
import pytest
from scipy.stats import norm

from isocharge.serve.tracking.pretension_grid import GRID_STEP_MPa, normal_probabilities, odds_of_no_change

PRIOR_STD_MPa = 0.35


@pytest.mark.parametrize("error_std_MPa", [0.08, 0.2, 0.35])
@pytest.mark.parametrize("measured_MPa", [0.0, 0.1, -0.3, 0.6])
def test_odds_of_no_change_are_the_ratio_of_the_likelihoods(measured_MPa, error_std_MPa):
    """The change is measured once, with a normal error. The likelihoods of both hypotheses are then normal as well."""
    change_MPa = GRID_STEP_MPa * np.arange(-200.0, 201.0)
    likelihood = norm.pdf(measured_MPa, loc=change_MPa, scale=error_std_MPa)
    probability = normal_probabilities(change_MPa, PRIOR_STD_MPa) * likelihood
    probability /= probability.sum()
    odds = odds_of_no_change(change_MPa, probability, PRIOR_STD_MPa, additional_variance=0.0)

    likelihood_if_unchanged = norm.pdf(measured_MPa, scale=error_std_MPa)
    likelihood_if_changed = norm.pdf(measured_MPa, scale=np.hypot(error_std_MPa, PRIOR_STD_MPa))
    expected_probability = likelihood_if_changed / (likelihood_if_changed + likelihood_if_unchanged)
    assert 1.0 / (1.0 + odds) == pytest.approx(expected_probability, abs=0.01)


def test_odds_of_no_change_are_one_without_information():
    change_MPa = GRID_STEP_MPa * np.arange(-200.0, 201.0)
    probability = normal_probabilities(change_MPa, PRIOR_STD_MPa)
    odds = odds_of_no_change(change_MPa, probability, PRIOR_STD_MPa, additional_variance=0.01)
    assert odds == pytest.approx(1.0, rel=1e-3)
