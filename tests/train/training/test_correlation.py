"""The head for correlations: its angles against Cholesky factors, its loss against SciPy, a planted covariance."""

from dataclasses import replace

import numpy as np
from scipy.optimize import approx_fprime
from scipy.stats import multivariate_normal

from isocharge.simulate import noise_model
from isocharge.train import LabelledPresses
from isocharge.train.training.correlation import ANGLE_SUMS, correlation_loss, with_correlation
from isocharge.train.training.folded_network import COSINES_TO_CORRELATIONS
from isocharge.train.training.network import fold_network

RNG = np.random.default_rng(0)
ANGLES = RNG.uniform(-4.0, 4.0, (50, 3))


def matrices(correlation):
    """Correlations xy, xF, yF, shape (n, 3), as matrices."""
    whole = np.tile(np.eye(3), (len(correlation), 1, 1))
    for value, (row, column) in zip(correlation.T, ((0, 1), (0, 2), (1, 2)), strict=True):
        whole[:, row, column] = whole[:, column, row] = value
    return whole


def test_any_angles_give_the_gram_matrix_of_unit_vectors():
    (a, b, c), one, zero = ANGLES.T, np.ones(len(ANGLES)), np.zeros(len(ANGLES))
    rows = [[one, zero, zero], [np.cos(a), np.sin(a), zero]]
    rows.append([np.cos(b), np.sin(b) * np.cos(c), np.sin(b) * np.sin(c)])
    factor = np.moveaxis(np.array(rows), 2, 0)
    gram = factor @ factor.transpose(0, 2, 1)
    np.testing.assert_allclose(matrices(np.cos(ANGLES @ ANGLE_SUMS) @ COSINES_TO_CORRELATIONS), gram, atol=1e-14)


def test_the_loss_is_the_likelihood_of_a_gaussian():
    deviation, correlation = (
        RNG.standard_normal((50, 3)),
        matrices(np.cos(ANGLES @ ANGLE_SUMS) @ COSINES_TO_CORRELATIONS),
    )
    pairs = zip(deviation, correlation, strict=True)
    expected = -np.mean([multivariate_normal(cov=cov).logpdf(row) for row, cov in pairs])
    constant = 1.5 * np.log(2.0 * np.pi) + 0.5 * np.mean(deviation[:, 0] ** 2)
    np.testing.assert_allclose(correlation_loss(ANGLES.T, deviation.T)[0] + constant, expected, rtol=1e-7)


def test_the_derivatives_of_the_loss_are_its_differences():
    angles, deviation = RNG.uniform(0.5, 2.5, 15), RNG.standard_normal((3, 5))
    found, by_angle = (lambda at, part=part: correlation_loss(at.reshape(3, 5), deviation)[part] for part in (0, 1))
    np.testing.assert_allclose(by_angle(angles).ravel(), approx_fprime(angles, found), atol=1e-6)


def test_planted_correlations_are_found_and_other_answers_stay(trained, caplog):
    """Truths drawn about the network's own answers, with correlations that depend on the charges."""
    network, charge = fold_network(trained.network), trained.split.train.charge
    still = replace(noise_model("reference"), white=0.0, gain=0.0)
    contact, std, _ = network.predict(charge)
    turn = np.tanh(np.log(charge[:, 0] / charge[:, 1]))
    planted = np.stack([0.9 * turn, 0.5 * np.ones_like(turn), 0.4 * turn], axis=1)
    drawn = (np.linalg.cholesky(matrices(planted)) @ RNG.standard_normal((len(charge), 3, 1)))[..., 0] * std
    truth = np.column_stack([contact[:, :2] + drawn[:, :2], contact[:, 2] * np.exp(drawn[:, 2] / contact[:, 2])])
    turned = with_correlation(network, LabelledPresses(truth, charge), still, seed=0)
    *same, found, misfit = turned.outputs(charge)
    assert caplog.messages == []  # the search has ended
    assert np.sqrt(np.mean((found - planted) ** 2)) < 0.2 * np.sqrt(np.mean(planted**2))
    for mine, theirs in zip((*same, misfit), network.outputs(charge), strict=True):
        np.testing.assert_array_equal(mine, theirs)
