"""Statistical tests of whether noise and rig explain the errors of a model on measured presses.

A factor for the standard deviations of the model has a guarantee that held-out presses provide. The factor is an order
statistic of the presses (split conformal prediction, Vovk 2012, proposition 2a). For n presses that were not used for
the training or the calibration, the share of contacts that the k-th smallest score covers has the distribution
Beta(k, n + 1 - k), whatever the distribution of the errors.

The rig is the machine that sets the position and the force of each press. One test uses the sum of the squared errors,
and the other test uses the mean errors.
"""

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.prediction.press_errors import PressErrors

SIGNIFICANCE = 0.01
"""Probability that a model that fits is rejected. Each of the three tests has a third of this probability."""

TEST_SIGNIFICANCE = SIGNIFICANCE / 3.0
"""Probability that one test rejects a model that fits."""

MAX_ACCEPTED_CHI_SQUARED = 1.1
"""Chi-squared per degree of freedom up to which the scatter is always accepted, dimensionless.

The limit is above 1, because the standard deviations are known to 5 % at best.
"""

COMMON_RATIO = 0.2
"""Error of the rig that may be equal in all presses, relative to the standard deviation of the rig, dimensionless.

For example, the positions of a stage may have a common offset, and the forces of a load cell a common scale error.
"""


class CommonError(NamedTuple):
    """Estimates of the errors of x, y and the force that are common to all presses, such as a shift of all positions.

    Attributes:
        mean: Weighted means of the errors, shape (3,), mm, and relative to the force; NaN if no error is known.
        std: Standard errors of the means, shape (3,). They are larger if the errors scatter more than noise and rig
            explain.
        significance: Means divided by standard errors that include a constant error of the rig, shape (3,).
    """

    mean: Array
    std: Array
    significance: Array


@np.errstate(divide="ignore", invalid="ignore")
def common_error(error: Array, variance: Array, rig_std: Array) -> CommonError:
    """Estimate the errors that are common to all presses, such as a shift of all positions.

    The estimates are the means of the errors, weighted with the inverse of their expected variances. If the errors
    scatter more than their expected variances, the standard errors are increased. For the significance, they include an
    error of the rig that is equal in all presses, so that averaging does not reduce it.

    Args:
        error: Errors of x, y and the force, shape (n, 3); NaN where unknown.
        variance: Expected variance of each error, shape (n, 3).
        rig_std: Part of the standard deviation of each error that the rig causes, shape (n, 3).
    """
    is_known = ~np.isnan(error)
    weight = np.where(is_known, 1.0 / variance, 0.0)
    total_weight = weight.sum(axis=0)
    mean = np.nansum(weight * error, axis=0) / total_weight
    chi_squared = np.nansum(weight * (error - mean) ** 2, axis=0)
    chi_squared_per_degree = chi_squared / np.maximum(is_known.sum(axis=0) - 1, 1)  # the mean uses one degree
    std = np.sqrt(np.maximum(chi_squared_per_degree, 1.0) / total_weight)
    common_rig_std = COMMON_RATIO * np.nansum(weight * rig_std, axis=0) / total_weight
    return CommonError(mean, std, mean / np.hypot(std, common_rig_std))


@dataclass(frozen=True)
class Agreement:
    """Results of two statistical tests of whether noise and rig explain the errors of the selected presses.

    Attributes:
        chi_squared: Sum of the squared errors divided by their expected variances.
        degrees: Number of degrees of freedom of the sum, which is the number of known errors.
        p_value: Probability that noise and rig alone cause a larger sum; NaN without presses.
        common: Errors that are common to all presses.
        common_p_value: Probability that noise and rig alone cause larger common errors; NaN without presses.
    """

    chi_squared: float
    degrees: int
    p_value: float
    common: CommonError
    common_p_value: float

    @classmethod
    def from_errors(cls, errors: PressErrors, is_selected: Booleans) -> "Agreement":
        """Test whether noise and rig explain the errors of the selected presses.

        The statistic of the first test is the sum of all squared errors divided by their expected variances. The
        statistic of the second test is the sum of the squared significances of the common errors. Both statistics have
        a chi-squared distribution if noise and rig explain the errors.

        Args:
            errors: Errors of all presses; NaN where a measured value is unknown.
            is_selected: Whether each press is selected, shape (n,).
        """
        error = errors.error[is_selected]
        common = common_error(error, errors.variance[is_selected], errors.rig_std[is_selected])
        chi_squared = float(np.nansum(errors.squared_ratio[is_selected]))
        degrees = int(np.count_nonzero(~np.isnan(error)))
        common_chi_squared = float(np.nansum(common.significance**2))
        common_degrees = int(np.count_nonzero(~np.isnan(common.mean)))
        return cls(
            chi_squared=chi_squared,
            degrees=degrees,
            p_value=chi_squared_survival(chi_squared, degrees),
            common=common,
            common_p_value=chi_squared_survival(common_chi_squared, common_degrees),
        )

    @property
    def acceptable(self) -> bool:
        """Whether the noise of the charges and the uncertainty of the rig explain the errors.

        The first test rejects a large scatter of the errors, and the second test rejects large common errors. Each test
        rejects good presses with a probability of `TEST_SIGNIFICANCE`.

        The expected variances are not known exactly, and for many presses even a small error of these variances would
        be significant. The scatter is therefore also accepted if `chi_squared` exceeds its expected value `degrees` by
        only a few percent.
        """
        max_accepted_chi_squared = MAX_ACCEPTED_CHI_SQUARED * self.degrees
        is_scatter_large = self.p_value < TEST_SIGNIFICANCE and self.chi_squared > max_accepted_chi_squared
        is_common_error_large = self.common_p_value < TEST_SIGNIFICANCE
        return not is_scatter_large and not is_common_error_large


def chi_squared_deviate(statistic: ArrayLike, degrees: ArrayLike) -> Array:
    """Convert chi-squared variables to variables with a standard normal distribution, shape (n,).

    The cube root of a chi-squared variable is approximately normal (Wilson and Hilferty 1931).

    Args:
        statistic: The chi-squared variables, shape (n,), not negative.
        degrees: Their degrees of freedom, shape (n,), 1 or more.
    """
    variance = 2.0 / (9.0 * np.asarray(degrees, dtype=float))
    cube_root = np.cbrt(np.asarray(statistic, dtype=float) / degrees)
    return np.asarray((cube_root - (1.0 - variance)) / np.sqrt(variance))


def chi_squared_survival(statistic: float, degrees: int) -> float:
    """Compute the probability that a chi-squared variable exceeds a value.

    The error of a probability is below 0.03 with one degree of freedom, below 0.006 with more, and below a fifth of a
    probability of 0.02 or less.

    Args:
        statistic: The value, not negative.
        degrees: Degrees of freedom of the variable. Without a degree of freedom, the result is NaN.
    """
    if degrees == 0:
        return math.nan
    return NormalDist().cdf(-float(chi_squared_deviate(statistic, degrees)))


def binomial_distribution(count: int, probability: float) -> Array:
    """Compute the probabilities that at most 0, 1, ... `count` of `count` trials succeed, shape (count + 1,).

    The terms are computed from their logarithms, because the binomial coefficients would overflow.

    Args:
        count: Number of trials.
        probability: Probability that a trial succeeds.
    """
    successes = np.arange(1, count + 1)
    log_ratios = np.log((count + 1 - successes) / successes * (probability / (1.0 - probability)))
    log_terms = count * math.log1p(-probability) + np.append(0.0, np.cumsum(log_ratios))
    return np.cumsum(np.exp(log_terms))


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
