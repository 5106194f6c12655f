"""The noise model on charges in pC, and on presses."""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.train.data.presses import LabelledPresses

PC, C = 1e12, 1e-12
"""Factors from C to pC, and from pC to C."""


def sigma_pC(noise: NoiseModel, charge_pC: Array) -> Array:
    """Standard deviation of charges of any shape, pC."""
    sigma: Array = PC * noise.sigma(C * charge_pC)
    return sigma


def with_noise(charge_pC: Array, noise: NoiseModel, rng: np.random.Generator) -> Array:
    """Noisy readings of charges of any shape, pC."""
    noisy: Array = PC * noise.add(C * charge_pC, rng)
    return noisy


def noisy_charges(presses: LabelledPresses, noise: NoiseModel, seed: int) -> Array:
    """The presses' charges with noise, pC, shape (n, n_electrode)."""
    return with_noise(presses.charge_pC, noise, np.random.default_rng(seed))


def misfit_noise(noise: NoiseModel) -> NoiseModel:
    """The unit of the misfit: the training's noise, or `reference` where that is none."""
    return noise if noise.white > 0.0 else noise_model("reference")
