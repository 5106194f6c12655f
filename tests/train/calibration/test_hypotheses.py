"""Hypotheses about a film: the evidence of a linear model, its posterior, and the mixture of several hypotheses."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from isocharge.train.calibration import hypotheses


def test_evidence_and_posterior_of_a_linear_model():
    """The evidence is SciPy's density of the residuals; the posterior is that of Gaussian conditioning on them."""
    rng = np.random.default_rng(2)
    jacobian = rng.normal(size=(12, 5))
    residual = rng.normal(size=12)
    prior_covariance = np.diag([1.0, 0.25, 4.0, 1.0, 0.0])  # the last unknown is excluded
    model = hypotheses.LinearModel.from_residuals(jacobian, residual, np.zeros(5))
    mean, covariance = model.posterior(prior_covariance)

    residual_covariance = np.eye(12) + jacobian @ prior_covariance @ jacobian.T
    log_density = multivariate_normal(np.zeros(12), residual_covariance).logpdf(residual) + 6.0 * np.log(2.0 * np.pi)
    assert model.log_evidence(prior_covariance) == pytest.approx(log_density, rel=1e-9)
    gain = prior_covariance @ jacobian.T @ np.linalg.inv(residual_covariance)
    np.testing.assert_allclose(mean, -gain @ residual, rtol=1e-9)
    np.testing.assert_allclose(covariance, prior_covariance - gain @ jacobian @ prior_covariance, atol=1e-12)


def test_mixture_has_the_mean_and_second_moments_of_its_hypotheses():
    """Each hypothesis is weighted by the product of its evidence and its prior probability."""
    rng = np.random.default_rng(4)
    model = hypotheses.LinearModel.from_residuals(rng.normal(size=(12, 3)), rng.normal(size=12), np.zeros(3))
    prior_covariances = {
        hypotheses.Hypothesis(prior_probability=0.7): np.eye(3),
        hypotheses.Hypothesis(discrepancy=1.0, prior_probability=0.3): np.eye(3) / 4,
    }
    log_evidences = [model.log_evidence(each) for each in prior_covariances.values()]
    posteriors = [model.posterior(each) for each in prior_covariances.values()]
    weights = np.exp(log_evidences) * [0.7, 0.3]
    weights /= weights.sum()
    second_moments = [covariance + np.outer(mean, mean) for mean, covariance in posteriors]

    mixture = hypotheses.mix_hypotheses({0.0: model}, prior_covariances.get, prior_covariances)
    np.testing.assert_allclose(mixture.mean_change, weights @ [mean for mean, _ in posteriors])
    found_second_moment = mixture.covariance + np.outer(mixture.mean_change, mixture.mean_change)
    np.testing.assert_allclose(found_second_moment, np.einsum("h,hij->ij", weights, second_moments))
    assert list(mixture.probabilities.values()) == pytest.approx(weights)


def test_scatter_of_forces_is_noise_along_one_direction_of_each_press():
    """Three presses of four residuals, compared with SciPy's density for the full covariance of the residuals."""
    rng = np.random.default_rng(5)
    jacobian = rng.normal(size=(3, 4, 2))
    residual = rng.normal(size=(3, 4))
    direction = rng.normal(size=(3, 4))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    noise_variance = np.array([0.0, 0.5, 9.0])
    at_mean = np.zeros(2)

    jacobian_along = np.einsum("nk,nku->nu", direction, jacobian)
    residual_along = (direction * residual).sum(axis=1)
    model = hypotheses.LinearModel.from_residuals(jacobian.reshape(12, 2), residual.ravel(), at_mean)
    noisy_model = model.with_added_noise(jacobian_along, residual_along, at_mean, noise_variance)

    press_noises = [
        np.eye(4) + variance * np.outer(unit_vector, unit_vector)
        for variance, unit_vector in zip(noise_variance, direction, strict=True)
    ]
    residual_covariance = block_diag(*press_noises) + jacobian.reshape(12, 2) @ jacobian.reshape(12, 2).T
    distribution = multivariate_normal(np.zeros(12), residual_covariance)
    log_density = distribution.logpdf(residual.ravel()) + 6.0 * np.log(2.0 * np.pi)
    assert noisy_model.log_evidence(np.eye(2)) == pytest.approx(log_density, rel=1e-9)
