"""Most probable value of a normal distribution within bounds."""

import numpy as np

from isocharge.common.arrays import Array

BOUND_TOLERANCE = 1e-9
"""Distance beyond a bound that is ignored, in the unit of the unknowns."""


def most_probable_within(bounds: tuple[Array, Array], mean: Array, covariance: Array) -> Array:
    """Return the most probable unknowns of a normal distribution within bounds, shape (n_unknown,).

    The unknown that is farthest beyond its bound is moved onto the bound, and the others change by their correlation
    with it. These steps are repeated until no unknown is beyond its bound.

    Args:
        bounds: Lower and upper bounds, each of shape (n_unknown,).
        mean: Mean of the normal distribution, shape (n_unknown,).
        covariance: Covariance of the normal distribution, shape (n_unknown, n_unknown).
    """
    unknowns = mean
    for _ in range(len(mean)):  # each step fixes one unknown
        excess = unknowns - np.clip(unknowns, *bounds)
        farthest = int(np.abs(excess).argmax())
        if abs(excess[farthest]) < BOUND_TOLERANCE:
            break

        # Mean and covariance of all unknowns, given that the farthest unknown has the value of its bound
        regression = covariance[:, farthest] / covariance[farthest, farthest]  # change of each unknown per unit change
        unknowns = unknowns - excess[farthest] * regression
        covariance = covariance - np.outer(regression, covariance[farthest])

    # The steps may end a little beyond a bound, because of the tolerance and of rounding errors.
    return np.clip(unknowns, *bounds)
