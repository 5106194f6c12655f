"""Probability distributions of a pretension on a grid of evenly spaced values."""

import math

import numpy as np

from isocharge.common.arrays import Array, Reals
from isocharge.serve.model.pretensions import Pretensions

GRID_STEP_MPa = 0.02
"""Distance between neighbouring pretensions of the grid, MPa."""


def evenly_spaced(low: float, high: float, step: float) -> Array:
    """Return evenly spaced numbers from `low` to `high`, including both limits.

    The range is divided into a whole number of equal intervals. Their length is as close to `step` as possible.
    """
    interval_count = max(round((high - low) / step), 1)
    return np.linspace(low, high, interval_count + 1)


def pretension_grid(pretensions: Pretensions) -> Array:
    """Return the evenly spaced pretensions at which a follower computes probabilities, MPa.

    Args:
        pretensions: Weights of the network, which define the range of the grid.
    """
    low_MPa, high_MPa = pretensions.range_MPa
    return evenly_spaced(low_MPa, high_MPa, GRID_STEP_MPa)


def normal_probabilities(deviation: Reals, std: float) -> Array:
    """Return the probabilities of evenly spaced deviations from the mean of a normal distribution.

    The probabilities add up to 1.

    Args:
        deviation: Evenly spaced deviations from the mean, shape (n,).
        std: Standard deviation of the normal distribution, in the unit of the deviations.
    """
    density = np.exp(-0.5 * (deviation / std) ** 2)
    return np.asarray(density / density.sum())


def odds_of_no_change(change_MPa: Array, probability: Array, prior_std_MPa: float, additional_variance: float) -> float:
    """Compute the odds of the hypothesis that a pretension has not changed, against the hypothesis that it has changed.

    If the pretension has changed, the prior distribution of the change is a normal distribution with the mean zero.
    Both hypotheses are assumed to have the same prior probability. The odds are the posterior density of a zero change
    divided by the prior density of a zero change (the Savage-Dickey density ratio, Dickey 1971). Both densities belong
    to the hypothesis that the pretension has changed.

    Args:
        change_MPa: Changes on an evenly spaced grid, shape (n,), MPa.
        probability: Posterior probability of each change if the pretension has changed, shape (n,).
        prior_std_MPa: Standard deviation of the prior distribution of the change, MPa.
        additional_variance: Variance of the errors that `probability` does not include, MPa^2.
    """
    # The posterior density of a zero change is the sum of the probabilities, each multiplied by the value of a normal
    # density (kernel) at the distance of the grid point from zero. The kernel describes the additional errors. The
    # kernel has at least the width of a grid step, because the grid cannot represent a narrower density.
    kernel_variance = additional_variance + GRID_STEP_MPa**2
    kernel = np.exp(-0.5 * change_MPa**2 / kernel_variance) / math.sqrt(2.0 * math.pi * kernel_variance)
    posterior_density = float(probability @ kernel)

    # The prior distribution is widened by the same kernel, so that the two densities can be compared.
    prior_density = 1.0 / math.sqrt(2.0 * math.pi * (prior_std_MPa**2 + kernel_variance))
    return posterior_density / prior_density


def smooth_moments(moments: Array, std_MPa: float) -> Array:
    """Smooth moments along the axis of the pretensions, by a convolution with a normal distribution.

    Args:
        moments: Moments at each pretension of the grid, shape (n_level, n_pretension, n_moment). Beyond the ends of the
            grid, the moments are assumed to be constant.
        std_MPa: Standard deviation of the normal distribution, MPa.

    Returns:
        The smoothed moments, of the same shape.
    """
    # The kernel is the normal distribution on the grid, cut off at four standard deviations or at the grid size.
    grid_size = moments.shape[1]
    kernel_reach = min(round(4.0 * std_MPa / GRID_STEP_MPa), grid_size)  # number of grid steps on each side
    deviation_MPa = GRID_STEP_MPa * np.arange(-kernel_reach, kernel_reach + 1.0)
    kernel = normal_probabilities(deviation_MPa, std_MPa)
    padded_moments = np.pad(moments, ((0, 0), (kernel_reach, kernel_reach), (0, 0)), mode="edge")

    # The convolution is the sum of the moments, shifted by each deviation and multiplied by its probability.
    smoothed_moments = np.zeros_like(moments)
    for start, weight in enumerate(kernel):
        smoothed_moments += weight * padded_moments[:, start : start + grid_size]
    return smoothed_moments
