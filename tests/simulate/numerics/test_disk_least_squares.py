"""Least squares over the unit disk times [-1, 1], compared with SciPy, and distribution of the starting points."""

import numpy as np
import pytest
from scipy.optimize import minimize

from isocharge.common.contact_domain import into_unit_domain
from isocharge.simulate.identifiability.nearest_contact import _unit_candidates, minimise

RNG = np.random.default_rng(0)
MATRIX = RNG.normal(size=(4, 3))


def sine_residuals(rows, unit):
    """Four nonlinear residuals, which grow with the number of the problem."""
    angle = unit @ MATRIX.T + 0.1 * rows[:, None]
    slopes = 2.0 * np.cos(angle)[:, None, :] * MATRIX.T
    return 2.0 * np.sin(angle) - 1.5 - 0.1 * rows[:, None], slopes


def test_minimise_is_not_worse_than_scipy_with_constraints():
    starts = into_unit_domain(RNG.uniform(-0.7, 0.7, (12, 3)))
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


def test_starting_points_are_evenly_distributed_over_the_disk_and_its_edge():
    """The mean of the squared distance from the centre is 1/2 over the disk, and 1 on the edge."""
    unit, _ = _unit_candidates(512)
    assert np.sum(unit[:, :2] ** 2) / 512 == pytest.approx(0.75 * 0.5 + 0.25, abs=0.01)
