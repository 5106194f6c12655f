"""Tests of the correlations of a network against Cholesky factors, SciPy, and a known covariance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.stats import multivariate_normal

from isocharge.simulate import noise_model
from isocharge.train import LabelledPresses
from isocharge.train.training.correlation import ANGLES_TO_COSINE_ARGUMENTS, correlation_loss, with_correlation
from isocharge.train.training.folded_network import COSINES_TO_CORRELATIONS
from isocharge.train.training.network import fold_network


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def angles(rng):
    """Random angles a, b and c, shape (50, 3), rad."""
    return rng.uniform(-4.0, 4.0, (50, 3))


def correlation_matrices(correlations):
    """Return matrices, shape (n, 3, 3), from the correlations xy, xF and yF, shape (n, 3)."""
    matrices = np.tile(np.eye(3), (len(correlations), 1, 1))
    for values, (row, column) in zip(correlations.T, ((0, 1), (0, 2), (1, 2)), strict=True):
        matrices[:, row, column] = values
        matrices[:, column, row] = values
    return matrices


def matrices_of_angles(angles):
    """Return the correlation matrices, shape (n, 3, 3), of angles of shape (n, 3), rad."""
    return correlation_matrices(np.cos(angles @ ANGLES_TO_COSINE_ARGUMENTS) @ COSINES_TO_CORRELATIONS)


def test_any_angles_give_the_gram_matrix_of_unit_vectors(angles):
    a, b, c = angles.T
    one = np.ones(len(angles))
    zero = np.zeros(len(angles))
    rows = [
        [one, zero, zero],
        [np.cos(a), np.sin(a), zero],
        [np.cos(b), np.sin(b) * np.cos(c), np.sin(b) * np.sin(c)],
    ]
    factor = np.moveaxis(np.array(rows), 2, 0)
    gram_matrices = factor @ factor.transpose(0, 2, 1)
    np.testing.assert_allclose(matrices_of_angles(angles), gram_matrices, atol=1e-14)


def test_the_loss_is_the_likelihood_of_a_gaussian(angles, rng):
    deviation = rng.standard_normal((50, 3))
    log_densities = [
        multivariate_normal(cov=covariance).logpdf(row)
        for row, covariance in zip(deviation, matrices_of_angles(angles), strict=True)
    ]
    constant = 1.5 * np.log(2.0 * np.pi) + 0.5 * np.mean(deviation[:, 0] ** 2)
    loss, _ = correlation_loss(angles.T, deviation.T)
    np.testing.assert_allclose(loss + constant, -np.mean(log_densities), rtol=1e-7)


def test_the_gradient_of_the_loss_is_its_finite_difference(rng):
    angles = rng.uniform(0.5, 2.5, 15)
    deviation = rng.standard_normal((3, 5))

    def loss(flat_angles):
        value, _ = correlation_loss(flat_angles.reshape(3, 5), deviation)
        return value

    _, gradient = correlation_loss(angles.reshape(3, 5), deviation)
    np.testing.assert_allclose(gradient.ravel(), approx_fprime(angles, loss), atol=1e-6)


N_ERRORS_PER_PRESS = 6
"""Number of contacts that are drawn for each press in the test of known correlations."""


def test_known_correlations_are_found_and_the_other_outputs_do_not_change(trained, rng, caplog):
    """Draw true contacts around the contacts of a network, and compare the fitted correlations with those of the draw.

    The true correlations depend on the charges. The fit is a maximum-likelihood estimate, so the rms error of its
    correlations is known. From n Gaussian errors with known variances, an efficient estimate of one correlation r has
    the variance (1 - r^2)^2 / (1 + r^2) / n (Kendall and Stuart, The Advanced Theory of Statistics, chapter 18). If the
    correlation is a function with p coefficients, its mean variance over the n errors is about p times as large. The
    rms error of all three correlations has a relative scatter of about 1 / sqrt(2 * 3 * p), which is 7 %. The test
    allows three times this scatter.
    """
    network = fold_network(trained.network)
    charge = np.tile(trained.split.train.charge, (N_ERRORS_PER_PRESS, 1))
    no_noise = replace(noise_model("reference"), white=0.0, gain=0.0)
    contact, std, _ = network.predict(charge)
    charge_ratio = np.tanh(np.log(charge[:, 0] / charge[:, 1]))  # from -1 to 1
    true_correlations = np.stack([0.9 * charge_ratio, np.full_like(charge_ratio, 0.5), 0.4 * charge_ratio], axis=1)
    factor = np.linalg.cholesky(correlation_matrices(true_correlations))
    error = (factor @ rng.standard_normal((len(charge), 3, 1)))[..., 0] * std
    true_force = contact[:, 2] * np.exp(error[:, 2] / contact[:, 2])
    truth = np.column_stack([contact[:, :2] + error[:, :2], true_force])

    correlated = with_correlation(network, LabelledPresses(truth, charge), no_noise, seed=0)
    new_contact, new_std, correlations, new_misfit = correlated.outputs(charge)
    assert caplog.messages == []  # no warning that the minimisation has not converged

    *_, output_layer = trained.network.contact.linear_layers()
    n_coefficient = output_layer.in_features + charge.shape[1] + 1  # hidden units, input features and a bias
    variance_of_one_error = (1.0 - true_correlations**2) ** 2 / (1.0 + true_correlations**2)
    expected_rms = np.sqrt(n_coefficient / len(charge) * np.mean(variance_of_one_error))
    scatter = 1.0 / np.sqrt(2.0 * 3.0 * n_coefficient)
    rms_error = np.sqrt(np.mean((correlations - true_correlations) ** 2))
    assert rms_error == pytest.approx(expected_rms, rel=3.0 * scatter)
    for new, old in zip((new_contact, new_std, new_misfit), network.outputs(charge), strict=True):
        np.testing.assert_array_equal(new, old)
