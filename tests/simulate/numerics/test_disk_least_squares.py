"""Least squares over the unit disk times [-1, 1], compared with nearest points in closed form and with SciPy."""

import numpy as np
from scipy.optimize import minimize

from isocharge.simulate.numerics.disk_least_squares import into_domain, minimise

RNG = np.random.default_rng(0)
TARGETS = np.concatenate([RNG.uniform(-1.0, 1.0, (60, 3)), 30.0 * RNG.normal(size=(60, 3)), [[0.0, 0.0, 5.0]]])
MATRIX = RNG.normal(size=(4, 3))


def distances(rows, unit):
    """Residuals whose minimum is the point of the domain that is nearest to the target."""
    return unit - TARGETS[rows], np.broadcast_to(np.eye(3), (len(unit), 3, 3))


def sine_residuals(rows, unit):
    """Four nonlinear residuals, which grow with the number of the problem."""
    angle = unit @ MATRIX.T + 0.1 * rows[:, None]
    slopes = 2.0 * np.cos(angle)[:, None, :] * MATRIX.T
    return 2.0 * np.sin(angle) - 1.5 - 0.1 * rows[:, None], slopes


def test_minimise_finds_the_nearest_point_of_the_domain():
    unit, residual = minimise(distances, np.zeros_like(TARGETS))
    np.testing.assert_allclose(unit, into_domain(TARGETS), atol=1e-6)
    np.testing.assert_allclose(residual, unit - TARGETS, rtol=1e-12, atol=1e-12)


def test_minimise_is_not_worse_than_scipy_with_constraints():
    starts = into_domain(RNG.uniform(-0.7, 0.7, (12, 3)))
    unit, residual = minimise(sine_residuals, starts)
    inside = {"type": "ineq", "fun": lambda at: 1.0 - at[0] ** 2 - at[1] ** 2}
    for row, start in enumerate(unit):
        solution = minimize(
            lambda at, row=row: float((sine_residuals(np.array([row]), at[None])[0] ** 2).sum()),
            start,
            bounds=[(-1, 1)] * 3,
            constraints=inside,
            options={"ftol": 1e-13},
        )
        assert (residual[row] ** 2).sum() <= solution.fun + 2e-6 * (1.0 + solution.fun)
