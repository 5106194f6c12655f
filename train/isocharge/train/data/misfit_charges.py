"""Training charges of the misfit network: charges at all distances from those of presses.

The distances are multiples of the standard deviation of the noise. The charges of any number of electrodes are moved,
so that the examples contain wrong gains, dead electrodes, and charges that no press causes.
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate import NoiseModel, noise_model
from isocharge.train.data.channel_noise import ChannelNoise

LOG_DISTANCES = (-1.0, 3.0)
"""Decimal logarithms of the smallest and the largest distance from a press, in standard deviations of the noise."""


def misfit_noise(noise: NoiseModel) -> NoiseModel:
    """Return the noise whose standard deviation is the unit of the misfit.

    The result is the noise of the training or, if the training has no noise, the noise `reference`.
    """
    has_noise = noise.white > 0.0
    return noise if has_noise else noise_model("reference")


def draw_charges(rng: np.random.Generator, charge: Array, noise: ChannelNoise, count: int) -> Array:
    """Draw charges at all distances from the charges of presses.

    All electrodes have the noise of the press. For each press, some electrodes are chosen at random, and their charges
    are moved by normally distributed distances. The standard deviation of these distances is log-uniform within
    `LOG_DISTANCES`. The distances are added to the levels of the charges, whose noise has the standard deviation 1.

    Args:
        rng: Random number generator.
        charge: Charges of presses, shape (n, n_electrode), pC, from which presses are chosen at random.
        noise: Noise of good presses.
        count: Number of sets of charges to draw.

    Returns:
        Charges, shape (count, n_electrode), pC.
    """
    level = noise.level(charge[rng.integers(len(charge), size=count)])
    is_moved = rng.random(level.shape) < rng.random((count, 1))
    distance = 10.0 ** rng.uniform(*LOG_DISTANCES, (count, 1))
    std = np.where(is_moved, distance, 1.0)
    return noise.charge(level + std * rng.standard_normal(level.shape))
