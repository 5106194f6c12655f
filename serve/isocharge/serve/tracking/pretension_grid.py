"""Distributions of a pretension on a grid of evenly spaced values."""

import numpy as np

from isocharge.common.arrays import Array, Reals

GRID_STEP_MPa = 0.02
"""Distance between neighbouring pretensions of the grid, MPa."""


def evenly_spaced(low: float, high: float, step: float) -> Array:
    """Return evenly spaced numbers from `low` to `high`. Their distance is as close to `step` as possible."""
    interval_count = max(round((high - low) / step), 1)
    return np.linspace(low, high, interval_count + 1)


def normal_probabilities(deviation: Reals, std: float) -> Array:
    """Return the probabilities of evenly spaced deviations from the mean. The distribution is normal.

    The probabilities add up to 1.
    """
    density = np.exp(-0.5 * (deviation / std) ** 2)
    return np.asarray(density / density.sum())


def smooth_moments(moments: Array, std: float) -> Array:
    """Smooth moments over the pretensions by a normal distribution.

    Args:
        moments: Moments at each pretension of the grid, shape (n_level, n_pretension, n_moment). Beyond the ends of the
            grid, the moments are assumed to be constant.
        std: Standard deviation of the normal distribution, MPa.

    Returns:
        The smoothed moments, of the same shape.
    """
    grid_size = moments.shape[1]
    reach = min(round(4.0 * std / GRID_STEP_MPa), grid_size)
    kernel = normal_probabilities(GRID_STEP_MPa * np.arange(-reach, reach + 1.0), std)
    padded = np.pad(moments, ((0, 0), (reach, reach), (0, 0)), mode="edge")
    smoothed = np.zeros_like(moments)
    for start, weight in enumerate(kernel):
        smoothed += weight * padded[:, start : start + grid_size]
    return smoothed
