"""Robust estimate of a state that presses share, compared with `scipy.optimize.least_squares`."""

import numpy as np
from scipy.optimize import least_squares

from isocharge.serve.model.robust_estimate import ModelValues, RobustProblem

DIRECTION = 0.2 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
STATE_EFFECT = np.array([[0.3, 0.1, 0.2, 0.15], [0.02, -0.05, 0.04, 0.01]])
NOISE = 2.0


def log_charge(contact, state):
    """Logarithms of the charges of contacts (x, y, ln F); the effect of the state depends on x and F."""
    shape = 1.0 + 0.2 * np.sin(contact[:, :1]) + 0.3 * contact[:, 2:]
    return 6.0 + contact[:, :2] @ DIRECTION.T + 0.7 * contact[:, 2:] + shape * (state @ STATE_EFFECT)


def model(contact, state):
    """Charges, and their derivatives by complex steps."""
    step = 1e-20
    by_contact = [np.exp(log_charge(contact + 1j * step * unit, state)).imag / step for unit in np.eye(3)]
    by_state = [np.exp(log_charge(contact, state + 1j * step * unit)).imag / step for unit in np.eye(2)]
    return ModelValues(np.exp(log_charge(contact, state)), np.stack(by_contact, axis=2), np.stack(by_state, axis=2))


def presses(rng, count, state):
    """Contacts (x, y, ln F) and charges with noise."""
    contact = rng.uniform(-1.0, 1.0, (count, 3)) * [4.0, 4.0, 1.0]
    return contact, np.exp(log_charge(contact, state)) + NOISE * rng.standard_normal((count, 4))


def estimate(charge, start, **options):
    covariance = np.tile(NOISE**2 * np.eye(4), (len(charge), 1, 1))
    problem = RobustProblem(model, charge, covariance, np.zeros(2), np.diag([0.5, 2.0]) ** 2, **options)
    point = problem.estimate(np.zeros(2), start, tolerance=1e-9)
    return point, problem.state_covariance(point)


def test_gaussian_estimate_is_that_of_scipy():
    """All unknowns are searched together there, and the covariance is the inverse of its normal matrix."""
    rng = np.random.default_rng(1)
    contact, charge = presses(rng, 12, np.array([0.4, -1.5]))
    result, result_covariance = estimate(charge, contact, freedom=1e9)

    def residuals(unknowns):
        state, contacts = unknowns[:2], unknowns[2:].reshape(-1, 3)
        return np.concatenate([np.ravel(np.exp(log_charge(contacts, state)) - charge) / NOISE, state / [0.5, 2.0]])

    found = least_squares(residuals, np.concatenate([np.zeros(2), contact.ravel()]), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(result.state, found.x[:2], atol=1e-4)
    np.testing.assert_allclose(result.contacts, found.x[2:].reshape(-1, 3), atol=1e-4)
    covariance = np.linalg.inv(found.jac.T @ found.jac)[:2, :2]
    np.testing.assert_allclose(result_covariance, covariance, rtol=1e-2)


def test_presses_that_no_contact_explains_hardly_count():
    rng = np.random.default_rng(2)
    state = np.array([0.4, -1.5])
    contact, charge = presses(rng, 30, state)
    charge[::6] *= rng.uniform(0.8, 1.3, (5, 4))
    robust, robust_covariance = estimate(charge, contact)
    assert np.median(robust.chi2[::6]) > 46.0  # a weight of (4 + 1) / (4 + 46) = 0.1
    assert (np.delete(robust.chi2, np.s_[::6]) < 8.5).all()
    deviation = robust.state - state
    assert deviation @ np.linalg.solve(robust_covariance, deviation) < 13.8  # 99.9 % of a chi-square of 2 degrees
