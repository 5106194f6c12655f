"""Factor by which the standard deviations of a model are multiplied to guarantee the coverage of its regions.

The factor is an order statistic of held-out presses (split conformal prediction, Vovk 2012, proposition 2a). Let n be
the number of presses that were not used for the training or the calibration. The share of future contacts whose score
does not exceed the k-th smallest score then has the distribution Beta(k, n + 1 - k). The errors may have any
distribution.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array

COVERAGE = 0.9
"""Smallest share of contacts that the 95 % regions contain after the factor is applied."""

CONFIDENCE = 0.9
"""Probability that the statement about the coverage is true."""

FEWEST_HELD_OUT = 22
"""Smallest number of presses that gives a factor. For a smaller number n, 1 - COVERAGE**n is below CONFIDENCE."""

REGION_QUANTILES = (3.841, 5.991, 7.815)
"""95 % quantiles of chi-squared with one, two and three degrees of freedom."""


class StdFactor(NamedTuple):
    """Factor by which the standard deviations of a model must be multiplied on this film.

    Attributes:
        factor: The factor, dimensionless. The factor may be smaller than 1.
        presses: Number of presses from which the factor was computed.
    """

    factor: float
    presses: int

    @property
    def statement(self) -> str:
        """Statement about the contacts of a model whose standard deviations were multiplied by the factor."""
        return (
            f"with standard deviations that are {self.factor:.3g} times as large, the 95 % regions (without "
            f"correlations) hold for at least {100.0 * COVERAGE:.0f} % of contacts like these {self.presses} presses, "
            f"with probability {CONFIDENCE:g}"
        )

    @classmethod
    def from_errors(cls, error: Array, std: Array) -> "StdFactor":
        """Compute the factor from the errors of held-out presses.

        The score of a press is the factor with which its 95 % region just contains the measured values. The region is
        an ellipsoid with axes along x, y and the force, without the correlations that the model states. The result is
        the smallest of the given scores that meets a condition: with the probability `CONFIDENCE`, it is not exceeded
        by the scores of at least the share `COVERAGE` of all future presses.

        Args:
            error: Errors of x, y and the force, shape (n, 3); NaN if unknown. A press without a known error is left
                out. At least `FEWEST_HELD_OUT` presses must have a known error.
            std: Standard deviations that the model states, in the units of `error`, shape (n, 3).

        Returns:
            The factor.
        """
        known_count = np.isfinite(error).sum(axis=1)  # number of known errors of each press
        is_known = known_count > 0
        chi_squared = np.nansum((error / std) ** 2, axis=1)[is_known]
        # Chi-squared on the surface of the region: the 95 % quantile for 1, 2 or 3 known errors
        region_chi_squared = np.take(REGION_QUANTILES, known_count[is_known] - 1)
        scores = np.sort(np.sqrt(chi_squared / region_chi_squared))

        # The wanted factor is at least the quantile `COVERAGE` of the scores of future presses. Each of the n sorted
        # scores lies below this unknown quantile with the probability `COVERAGE`. `binomial_distribution` returns, for
        # each k, the probability that at most k scores lie below it. In this case, `scores[k]` is not below the
        # quantile. `argmax` returns the smallest k whose probability is at least `CONFIDENCE`.
        index = np.argmax(binomial_distribution(len(scores), COVERAGE) >= CONFIDENCE)
        return cls(float(scores[index]), len(scores))


def binomial_distribution(count: int, probability: float) -> Array:
    """Compute the probabilities that at most 0, 1, ... `count` of `count` trials succeed, shape (count + 1,).

    The result is the cumulative binomial distribution.

    The logarithms of the probabilities are added up, because the binomial coefficients would overflow.

    Args:
        count: Number of trials.
        probability: Probability that a trial succeeds.
    """
    successes = np.arange(1, count + 1)
    # Ratio of the probability of k successes to the probability of k - 1 successes, for k = 1, ..., count
    ratios = (count + 1 - successes) / successes * (probability / (1.0 - probability))
    log_no_success = count * math.log1p(-probability)  # logarithm of the probability that no trial succeeds
    log_probabilities = log_no_success + np.append(0.0, np.cumsum(np.log(ratios)))
    return np.cumsum(np.exp(log_probabilities))
