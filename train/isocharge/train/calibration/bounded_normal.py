"""Most probable point of a multivariate normal distribution within bounds."""

import numpy as np

from isocharge.common.arrays import Array

BOUND_TOLERANCE = 1e-9
"""Distance beyond a bound that is ignored, in the unit of the unknowns."""


def most_probable_within(bounds: tuple[Array, Array], mean: Array, covariance: Array) -> Array:
    """Return the most probable point of a multivariate normal distribution within bounds.

    The search begins at the mean. In each step, the unknown that is farthest beyond its bound is fixed at this bound.
    The other unknowns are set to their conditional mean, given all fixed unknowns. The steps are repeated until every
    unknown lies within its bounds. A fixed unknown is never released again. If several unknowns are fixed, the result
    may therefore differ slightly from the exact solution.

    Args:
        bounds: Lower and upper bounds, each of shape (n_unknown,).
        mean: Mean of the normal distribution, shape (n_unknown,).
        covariance: Covariance of the normal distribution, shape (n_unknown, n_unknown).

    Returns:
        Values of the unknowns, shape (n_unknown,).
    """
    unknowns = mean
    for _ in range(len(mean)):  # each step fixes one unknown, so there are at most as many steps as unknowns
        excess = unknowns - np.clip(unknowns, *bounds)  # signed distance beyond a bound; 0 within the bounds
        farthest = int(np.abs(excess).argmax())
        if abs(excess[farthest]) < BOUND_TOLERANCE:
            break

        # Conditional mean and covariance of all unknowns if the farthest unknown has the value of its bound. The
        # regression is the change of each unknown per unit change of the farthest unknown, shape (n_unknown,).
        regression = covariance[:, farthest] / covariance[farthest, farthest]
        unknowns = unknowns - excess[farthest] * regression
        covariance = covariance - np.outer(regression, covariance[farthest])

    # The last step may end slightly beyond a bound, because of the tolerance and of rounding errors.
    return np.clip(unknowns, *bounds)
