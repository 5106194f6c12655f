"""Kalman update of the linear unknowns of a film with the misfit vector of a touch.

The module `film_filter` explains the linear unknowns and the misfit vector.
"""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array


class KalmanUpdate(NamedTuple):
    """Changes of the estimates of the linear unknowns after a touch that is not an outlier.

    The linear unknowns are estimated separately for each offset level and each pretension.

    Attributes:
        mean_change: Change of the mean, shape (n_level, n_pretension, n_unknown).
        covariance_reduction: Covariance before the touch minus covariance after the touch, shape (n_level,
            n_pretension, n_unknown, n_unknown).
        density: Probability density of the misfit vector before the touch, without the constant factor of the normal
            distribution, shape (n_level, n_pretension).
    """

    mean_change: Array
    covariance_reduction: Array
    density: Array


class TouchResiduals(NamedTuple):
    """Squared misfits of a touch after a correction with the estimates at the most likely offset level.

    All values are relative to the mean squared misfit of good touches.

    Attributes:
        with_gains: Squared misfit at each pretension after a correction for the gains, the offset and the directions,
            shape (n_pretension,).
        without_gains: Squared misfit at each pretension after a correction for the offset and the directions, but not
            for the gains, shape (n_pretension,).
        offset_variance: Variance of the misfit that is caused by the deviation of the offset of this touch from the
            mean offset.
    """

    with_gains: Array
    without_gains: Array
    offset_variance: float


def kalman_update(
    misfit: Array, jacobian: Array, noise_covariance: Array, mean: Array, covariance: Array
) -> KalmanUpdate:
    """Compute how a touch changes the estimates of the linear unknowns if the touch is not an outlier.

    The linear unknowns are estimated separately for each offset level and each pretension.

    Args:
        misfit: Misfit vectors of the touch, shape (n_pretension, n_electrode).
        jacobian: Jacobian of the misfit vectors with respect to the linear unknowns, shape (n_level, n_pretension,
            n_electrode, n_unknown).
        noise_covariance: Covariance of the misfit vectors if the linear unknowns are known, shape (n_level,
            n_pretension, n_electrode, n_electrode).
        mean: Means of the linear unknowns, shape (n_level, n_pretension, n_unknown).
        covariance: Covariances of the linear unknowns, shape (n_level, n_pretension, n_unknown, n_unknown).

    Returns:
        The changes of the estimates, and the probability density of the misfit vector.
    """
    # The first two axes of all arrays are level and pretension. The matrix products use the last two axes.
    cross_covariance = jacobian @ covariance
    transposed_cross_covariance = cross_covariance.swapaxes(-1, -2)
    innovation_covariance = noise_covariance + cross_covariance @ jacobian.swapaxes(-1, -2)
    innovation = misfit - multiply_stacks(jacobian, mean)
    innovation_column = innovation[..., None]

    # One call solves the linear systems for the innovation, which is the first column, and for the cross covariance.
    right_sides = np.concatenate([innovation_column, cross_covariance], axis=-1)
    solutions = np.linalg.solve(innovation_covariance, right_sides)
    weighted_innovation = solutions[..., :1]
    weighted_cross_covariance = solutions[..., 1:]
    squared_distance = (innovation_column * weighted_innovation).sum(axis=(-1, -2))
    return KalmanUpdate(
        mean_change=(transposed_cross_covariance @ weighted_innovation)[..., 0],
        covariance_reduction=transposed_cross_covariance @ weighted_cross_covariance,
        density=np.exp(-0.5 * squared_distance) / np.sqrt(np.linalg.det(innovation_covariance)),
    )


def multiply_stacks(matrices: Array, vectors: Array) -> Array:
    """Multiply each matrix in a stack of matrices by the corresponding vector in a stack of vectors.

    Args:
        matrices: Matrices, shape (..., m, n).
        vectors: Vectors, shape (..., n).

    Returns:
        Products, shape (..., m).
    """
    columns = vectors[..., None]
    return np.asarray((matrices @ columns)[..., 0])
