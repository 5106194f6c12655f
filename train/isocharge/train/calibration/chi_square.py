"""Functions of the chi-square distribution, used to test the residuals of presses.

`scipy.stats` has the same functions, but importing it is slow.
"""

import numpy as np
import scipy.special

from isocharge.common.arrays import Array


def probability_above(chi2: Array | float, degrees_of_freedom: Array | float) -> Array:
    """Compute the probability that a chi-square variable exceeds a given value.

    Args:
        chi2: The given value, at least 0.
        degrees_of_freedom: Degrees of freedom, more than 0. An array must have the shape of `chi2`.

    Returns:
        Probability, with the shape of the arguments.
    """
    return np.asarray(scipy.special.chdtrc(degrees_of_freedom, chi2))


def value_exceeded_with(probability: float, degrees_of_freedom: Array) -> Array:
    """Compute the value that a chi-square variable exceeds with a given probability (the upper quantile).

    Args:
        probability: Probability between 0 and 1.
        degrees_of_freedom: Degrees of freedom, more than 0, shape (n,).

    Returns:
        Value, shape (n,).
    """
    return np.asarray(scipy.special.chdtri(degrees_of_freedom, probability))
