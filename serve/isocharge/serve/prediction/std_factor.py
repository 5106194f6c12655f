"""Factor for the standard deviations of a model, with a guarantee that held-out presses provide.

The factor is an order statistic of the presses (split conformal prediction, Vovk 2012, proposition 2a). For n presses
that were not used for the training or the calibration, the share of contacts that the k-th smallest score covers has
the distribution Beta(k, n + 1 - k), whatever the distribution of the errors.
"""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.prediction.agreement import binomial_distribution

COVERAGE = 0.9
"""Share of contacts that the 95 % regions contain at least, after the factor is applied."""

CONFIDENCE = 0.9
"""Probability that the statement about the coverage is true."""

REGION_QUANTILES = (3.841, 5.991, 7.815)
"""Quantiles 95 % of chi-squared with one, two and three degrees of freedom."""


class StdFactor(NamedTuple):
    """Factor by which the standard deviations of a model must be multiplied on this film.

    Attributes:
        factor: The factor, dimensionless. It may be smaller than 1.
        presses: Number of presses from which the factor was computed.
    """

    factor: float
    presses: int

    @property
    def statement(self) -> str:
        """Sentence that states the guarantee."""
        return (
            f"from {self.presses} presses: multiply the standard deviations by {self.factor:.3g}; the 95 % regions "
            f"then hold for at least {100.0 * COVERAGE:.0f} % of such contacts, with probability {CONFIDENCE:g}, if "
            "the presses were not used for the model"
        )

    @classmethod
    def from_errors(cls, error: Array, std: Array) -> "StdFactor | None":
        """Compute the factor from the errors of held-out presses.

        The score of a press is the factor with which its 95 % region just contains the measured values.

        Args:
            error: Errors of x, y and the force, shape (n, 3); NaN if unknown.
            std: Standard deviations that the model states, in the units of `error`, shape (n, 3).

        Returns:
            The factor; None if there are fewer than 22 presses, from which no such statement follows.
        """
        is_known = np.isfinite(error)
        degrees = is_known.sum(axis=1)
        squared_size = np.sum(np.where(is_known, error / std, 0.0) ** 2, axis=1)[degrees > 0]
        scores = np.sort(np.sqrt(squared_size / np.take(REGION_QUANTILES, degrees[degrees > 0] - 1)))
        # The k-th smallest score covers at least the share p of all contacts if at most k - 1 of n independent scores
        # lie below the quantile p.
        ranks = np.flatnonzero(binomial_distribution(len(scores), COVERAGE)[:-1] >= CONFIDENCE)
        return cls(float(scores[ranks[0]]), len(scores)) if ranks.size else None
