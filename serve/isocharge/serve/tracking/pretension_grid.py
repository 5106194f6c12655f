"""Distributions of a pretension on a grid of evenly spaced values."""

import math

import numpy as np

from isocharge.common.arrays import Array, Reals

GRID_STEP_MPa = 0.02
"""Distance between neighbouring pretensions of the grid, MPa."""


def evenly_spaced(low: float, high: float, step: float) -> Array:
    """Return evenly spaced numbers from `low` to `high`.

    The distance between two numbers is as close to `step` as possible.
    """
    interval_count = max(round((high - low) / step), 1)
    return np.linspace(low, high, interval_count + 1)


def normal_probabilities(deviation: Reals, std: float) -> Array:
    """Return the probabilities of evenly spaced deviations from the mean. The distribution is normal.

    The probabilities add up to 1.
    """
    density = np.exp(-0.5 * (deviation / std) ** 2)
    return np.asarray(density / density.sum())


def odds_of_no_change(change_MPa: Array, probability: Array, prior_std_MPa: float, additional_variance: float) -> float:
    """Compute the odds that a pretension is unchanged, against a change with a normal prior distribution.

    Both hypotheses are assumed to have the same prior probability. The odds are then the ratio of two probability
    densities of the change at zero, after and before the measurements. Both densities belong to the hypothesis of a
    change (the Savage-Dickey density ratio, Dickey 1971).

    Args:
        change_MPa: Changes on an evenly spaced grid, shape (n,), MPa.
        probability: Probability of each change after the measurements if there was a change, shape (n,).
        prior_std_MPa: Standard deviation of the change before the measurements, MPa. The mean is zero.
        additional_variance: Variance of the errors that `probability` does not include, MPa^2.
    """
    # The grid cannot represent a density that is narrower than its step.
    kernel_variance = additional_variance + GRID_STEP_MPa**2
    kernel = np.exp(-0.5 * change_MPa**2 / kernel_variance) / math.sqrt(2.0 * math.pi * kernel_variance)
    posterior_density = float(probability @ kernel)
    prior_density = 1.0 / math.sqrt(2.0 * math.pi * (prior_std_MPa**2 + kernel_variance))
    return posterior_density / prior_density


def smooth_moments(moments: Array, std: float) -> Array:
    """Smooth moments over the pretensions by a normal distribution.

    Args:
        moments: Moments at each pretension of the grid, shape (n_level, n_pretension, n_moment). Beyond the ends of the
            grid, the moments are assumed to be constant.
        std: Standard deviation of the normal distribution, MPa.

    Returns:
        The smoothed moments, of the same shape.
    """
    # The kernel is the normal distribution on the grid, cut off at four standard deviations.
    grid_size = moments.shape[1]
    reach = min(round(4.0 * std / GRID_STEP_MPa), grid_size)  # number of grid steps to each side
    kernel = normal_probabilities(GRID_STEP_MPa * np.arange(-reach, reach + 1.0), std)
    padded = np.pad(moments, ((0, 0), (reach, reach), (0, 0)), mode="edge")

    # Convolve along the pretensions: add the moments, shifted by each step of the kernel.
    smoothed = np.zeros_like(moments)
    for start, weight in enumerate(kernel):
        smoothed += weight * padded[:, start : start + grid_size]
    return smoothed
