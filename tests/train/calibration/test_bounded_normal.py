"""Most probable point of a normal distribution within bounds, compared with other solvers."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from isocharge.train.calibration.bounded_normal import most_probable_within


def random_problem(rng, size, excess):
    """Return bounds, mean and covariance of a random problem.

    Args:
        rng: Random generator.
        size: Number of unknowns. The last unknown has no bounds.
        excess: Standard deviation of the mean. The bounds are -1 and 1.
    """
    root = rng.standard_normal((size, size))
    lower = np.append(np.full(size - 1, -1.0), -np.inf)
    upper = np.append(np.full(size - 1, 1.0), np.inf)
    return (lower, upper), excess * rng.standard_normal(size), root @ root.T + 0.05 * np.eye(size)


@pytest.mark.parametrize("excess", [0.3, 3.0, 30.0])
@pytest.mark.parametrize("size", [2, 4, 8])
def test_most_probable_point_within_bounds_is_the_bounded_least_squares_solution(size, excess):
    """In some of these problems, an unknown that is first fixed at a bound must be released again."""
    rng = np.random.default_rng(size)
    for _ in range(50):
        bounds, mean, covariance = random_problem(rng, size, excess)
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        expected = lsq_linear(whitening, whitening @ mean, bounds, tol=1e-14, method="bvls").x
        np.testing.assert_allclose(most_probable_within(bounds, mean, covariance), expected, atol=1e-7)


def test_released_bound_of_two_strongly_correlated_unknowns():
    """The first unknown is farthest beyond its bound, but lies within it once the second unknown is at its bound.

    The conditional mean of the first unknown is 3 - 2 * (2.5 - 1) = 0 if the second unknown is 1.
    """
    mean = np.array([3.0, 2.5])
    covariance = np.array([[5.0, 2.0], [2.0, 1.0]])
    bounds = (np.full(2, -1.0), np.full(2, 1.0))
    np.testing.assert_allclose(most_probable_within(bounds, mean, covariance), [0.0, 1.0], atol=1e-12)


def test_mean_within_the_bounds_and_an_unknown_without_variance_are_not_changed():
    mean = np.array([0.5, 2.0, 0.25])
    covariance = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, 0.0], [0.0, 0.0, 0.0]])
    unbounded = (np.full(3, -np.inf), np.full(3, np.inf))
    np.testing.assert_array_equal(most_probable_within(unbounded, mean, covariance), mean)
    bounds = (np.full(3, -1.0), np.full(3, 1.0))
    np.testing.assert_allclose(most_probable_within(bounds, mean, covariance), [-0.1, 1.0, 0.25], atol=1e-12)
