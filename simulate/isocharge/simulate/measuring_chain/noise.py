"""The noise model: what the measuring chain adds to the charges. Training, limits and the virtual sensor use this one.

This is its memoryless part, independent between channels and readings:

    sigma^2 = white^2 + (gain * Q)^2.

What has a memory - leak, hum, drift, temperature, mismatch, clipping - is `measuring_chain.amplifier`.
"""

import math
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError


@dataclass(frozen=True)
class NoiseModel:
    """Independent Gaussian noise of each reading.

    Attributes:
        name: Name of the level.
        white: Standard deviation that every reading has, pC.
        gain: Standard deviation in proportion to the charge, dimensionless.
    """

    name: str
    white: float
    gain: float

    def __post_init__(self) -> None:
        for name in ("white", "gain"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"noise {self.name!r}: {name}: expected a finite number from 0, got {value}")

    def sigma(self, charge: Array) -> Array:
        """Standard deviation for charges of any shape, pC; the same shape."""
        return np.hypot(self.white, self.gain * np.asarray(charge))

    def variance(self, charge: Array) -> Array:
        """Square of `sigma`, pC^2; faster where there are many."""
        return self.white**2 + (self.gain * np.asarray(charge)) ** 2

    def information(self, charge: Array) -> Array:
        """Fisher information of a reading, 1/pC^2: one over the variance of the best unbiased estimate of its charge.

        Of a Gaussian whose mean and standard deviation both depend on the charge (Kay 1993, eq. 3.31),
        (1 + 2 (d sigma / dQ)^2) / sigma^2.
        """
        variance = self.variance(charge)
        return (1.0 + 2.0 * (self.gain**2 * np.asarray(charge)) ** 2 / variance) / variance

    def add(self, charge: Array, rng: np.random.Generator) -> Array:
        """Noisy readings of charges of any shape, pC."""
        return charge + self.sigma(charge) * rng.standard_normal(np.shape(charge))

    def to_dict(self) -> dict[str, float | str]:
        """For metadata."""
        return {"name": self.name, "white_pC": self.white, "gain": self.gain}
