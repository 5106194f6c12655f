"""The posterior against a closed form and against weighted draws from the prior."""

import numpy as np
import pytest
from bayes.posterior import Posterior

from function_map import FunctionMap
from isocharge.simulate import Domain, NoiseModel


def test_the_posterior_of_linear_charges_with_white_noise_is_a_gaussian():
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(2, 4))
    disk = Domain(1.0, (1.0, 1.0 + 1e-9))  # and practically one force
    charges = FunctionMap(lambda contact: 100.0 + contact[:, :2] @ slopes, tuple("ABCD"), disk)
    white_pC = 0.01
    noisy = 100.0 + np.array([[0.2, -0.3]]) @ slopes + white_pC * rng.normal(size=(1, 4))
    mean, std = Posterior(charges, NoiseModel("white", white_pC, 0.0), 1.0, population=4_000).mean_and_std(noisy)
    covariance = white_pC**2 * np.linalg.inv(slopes @ slopes.T)
    expected = np.linalg.lstsq(slopes.T, (noisy - 100.0)[0])[0]
    assert (np.abs(mean[0, :2] - expected) < 0.05 * std[0, :2]).all()
    assert std[0, :2] == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.04)
