"""Most probable point of a multivariate normal distribution within bounds."""

import numpy as np
from scipy.optimize import nnls

from isocharge.common.arrays import Array

BOUND_TOLERANCE = 1e-9
"""Distance beyond a bound that is ignored, in the unit of the unknowns."""


def most_probable_within(bounds: tuple[Array, Array], mean: Array, covariance: Array) -> Array:
    """Return the most probable point of a multivariate normal distribution within bounds.

    A point of the distribution is x = mean + R z, where R R' is the covariance, and z is a vector of independent
    standard normal numbers. The most probable point within the bounds therefore belongs to the shortest vector z that
    fulfils the inequalities G z >= h, with one inequality for each finite bound. This vector is found exactly by a
    non-negative least-squares problem (Lawson and Hanson 1974, chapter 23, section 4): if w >= 0 minimises |r| with
    r = (G' w, h' w - 1), then z is the first part of -r divided by the last element of r.

    Args:
        bounds: Lower and upper bounds, each of shape (n_unknown,).
        mean: Mean of the normal distribution, shape (n_unknown,).
        covariance: Covariance of the normal distribution, shape (n_unknown, n_unknown). An unknown without a variance
            must have its mean within its bounds.

    Returns:
        Values of the unknowns, shape (n_unknown,).
    """
    lower, upper = bounds
    excess = mean - np.clip(mean, lower, upper)  # signed distance beyond a bound; 0 within the bounds
    is_beyond = np.abs(excess) > BOUND_TOLERANCE
    if not is_beyond.any():
        return np.clip(mean, lower, upper)

    variances, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(variances, 0.0))  # rounding errors may make a variance negative

    # The inequalities of the finite bounds. They are divided by the largest excess in standard deviations, so that z
    # has a length of about 1, for which rounding errors are smallest.
    std = np.sqrt(covariance.diagonal())
    scale = np.abs(excess[is_beyond] / std[is_beyond]).max()
    has_lower = np.isfinite(lower)
    has_upper = np.isfinite(upper)
    inequality_matrix = np.concatenate([root[has_lower], -root[has_upper]])
    inequality_limit = np.concatenate([(lower - mean)[has_lower], (mean - upper)[has_upper]]) / scale

    matrix = np.vstack([inequality_matrix.T, inequality_limit])
    target = np.zeros(len(matrix))
    target[-1] = 1.0
    solution, _ = nnls(matrix, target)
    residual = matrix @ solution - target
    shortest = -residual[:-1] / residual[-1]

    # The point may lie slightly beyond a bound, because of rounding errors.
    return np.asarray(np.clip(mean + root @ (scale * shortest), lower, upper))
