"""The noise model compared with the statistics of the noise that it draws."""

import numpy as np
import pytest
from scipy import stats

from isocharge.common.errors import InputError
from isocharge.simulate import NoiseModel, noise_model


@pytest.mark.parametrize(("charge", "sigma"), [(0.0, 1.0), (500.0, np.sqrt(2.0)), (3000.0, 6.0827625)])
def test_sigma_of_the_reference_level(charge, sigma):
    """The variance is (1 pC)^2 + (0.002 Q)^2. It does not depend on the sign of the charge."""
    model = noise_model("reference")
    charges = np.array([charge, -charge])
    np.testing.assert_allclose(model.sigma(charges), sigma, rtol=1e-7)
    np.testing.assert_allclose(model.variance(charges), sigma**2, rtol=1e-7)


@pytest.mark.parametrize("charge", [0.0, 848.0, -2000.0])
def test_added_noise_is_gaussian_with_sigma(charge):
    model = noise_model("reference")
    rng = np.random.default_rng(0)
    drawn = (model.add(np.full(20_000, charge), rng) - charge) / model.sigma(np.array(charge))
    assert stats.kstest(drawn, "norm").pvalue > 0.01


@pytest.mark.parametrize(("white", "gain"), [(np.inf, 0.0), (np.nan, 0.0), (-1.0, 0.0), (0.0, -1.0)])
def test_noise_that_is_negative_or_not_finite_raises_input_error(white, gain):
    with pytest.raises(InputError, match="expected a finite number from 0"):
        NoiseModel("mine", white, gain)
