"""Kalman update of the linear unknowns of a film with the misfit vector of a touch (see `film_filter`)."""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array


class KalmanUpdate(NamedTuple):
    """Changes of the estimates of the linear unknowns by a good touch.

    There is one estimate for each level and each pretension.

    Attributes:
        mean_change: Change of the mean, shape (n_level, n_pretension, n_unknown).
        covariance_reduction: Reduction of the covariance, shape (n_level, n_pretension, n_unknown, n_unknown).
        density: Probability density of the misfit vector without its constant factor, shape (n_level, n_pretension).
    """

    mean_change: Array
    covariance_reduction: Array
    density: Array


class TouchResiduals(NamedTuple):
    """Squared misfits of a touch after the touch is corrected with the most likely offset level.

    All values are relative to the mean squared misfit of good touches.

    Attributes:
        filtered: Squared misfit after the correction by all linear unknowns, at each pretension, shape (n_pretension,).
        without_gains: Squared misfit after the correction by the offset and the directions, but not by the gains, at
            each pretension, shape (n_pretension,).
        offset_variance: Variance that the unknown offset of this touch adds to its misfit.
    """

    filtered: Array
    without_gains: Array
    offset_variance: float


def kalman_update(
    misfit: Array, jacobian: Array, noise_covariance: Array, mean: Array, covariance: Array
) -> KalmanUpdate:
    """Compute how the charges of a touch that is not an outlier change the estimates of the linear unknowns.

    There is one estimate for each level and each pretension.

    Args:
        misfit: Misfit vectors of the touch, shape (n_pretension, n_electrode).
        jacobian: Jacobian of the misfit vectors for the linear unknowns, shape (n_level, n_pretension, n_electrode,
            n_unknown).
        noise_covariance: Covariance of the misfit vectors if the linear unknowns are known, shape (n_level,
            n_pretension, n_electrode, n_electrode).
        mean: Means of the linear unknowns, shape (n_level, n_pretension, n_unknown).
        covariance: Covariances of the linear unknowns, shape (n_level, n_pretension, n_unknown, n_unknown).

    Returns:
        The changes of the estimates, and the probability density of the misfit vector.
    """
    # The first two axes of all arrays are level and pretension. The matrix products use the last two axes.
    cross_covariance = jacobian @ covariance
    transposed = cross_covariance.swapaxes(-1, -2)
    innovation_covariance = noise_covariance + cross_covariance @ jacobian.swapaxes(-1, -2)
    innovation = misfit - multiply_stacks(jacobian, mean)
    innovation_column = innovation[..., None]

    # One call solves the systems for the innovation and for the columns of the cross covariance.
    right_sides = np.concatenate([innovation_column, cross_covariance], axis=-1)
    solutions = np.linalg.solve(innovation_covariance, right_sides)
    weighted_innovation = solutions[..., :1]
    weighted_covariance = solutions[..., 1:]
    squared_distance = (innovation_column * weighted_innovation).sum(axis=(-1, -2))
    return KalmanUpdate(
        mean_change=(transposed @ weighted_innovation)[..., 0],
        covariance_reduction=transposed @ weighted_covariance,
        density=np.exp(-0.5 * squared_distance) / np.sqrt(np.linalg.det(innovation_covariance)),
    )


def multiply_stacks(matrices: Array, vectors: Array) -> Array:
    """Multiply each matrix of a stack by the vector at the same position of another stack.

    Args:
        matrices: Matrices, shape (..., m, n).
        vectors: Vectors, shape (..., n).

    Returns:
        Products, shape (..., m).
    """
    columns = vectors[..., None]
    return np.asarray((matrices @ columns)[..., 0])
