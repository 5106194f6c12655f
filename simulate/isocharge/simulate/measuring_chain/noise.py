"""Noise model of the measuring chain. Training, Cramer-Rao limits and the virtual sensor use this model.

The noise is independent between channels and readings, with the variance

    sigma^2 = white^2 + (gain * Q)^2.

The module `measuring_chain.amplifier` simulates leak, hum, drift, temperature, mismatch and clipping.
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
        white: Standard deviation that does not depend on the charge, pC.
        gain: Standard deviation proportional to the charge, divided by the charge, dimensionless.
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
        """Compute the standard deviation (pC) for charges (pC) of any shape; the result has the same shape."""
        return np.hypot(self.white, self.gain * np.asarray(charge))

    def variance(self, charge: Array) -> Array:
        """Compute the variance (pC^2) for charges (pC) of any shape. This is faster than squaring `sigma`."""
        return self.white**2 + (self.gain * np.asarray(charge)) ** 2

    def information(self, charge: Array) -> Array:
        """Compute the Fisher information that one reading provides about its charge.

        For a Gaussian whose mean and standard deviation both depend on the charge, the information is (1 + 2 (d sigma /
        dQ)^2) / sigma^2 (Kay 1993, equation 3.31). The inverse of the information is the smallest variance of an
        unbiased estimate of the charge.

        Args:
            charge: Charges of any shape, pC.

        Returns:
            Information, 1/pC^2, of the same shape.
        """
        variance = self.variance(charge)
        return (1.0 + 2.0 * (self.gain**2 * np.asarray(charge)) ** 2 / variance) / variance

    def add(self, charge: Array, rng: np.random.Generator) -> Array:
        """Add noise to charges (pC) of any shape."""
        return charge + self.sigma(charge) * rng.standard_normal(np.shape(charge))

    def to_dict(self) -> dict[str, float | str]:
        """Return name and parameters for metadata."""
        return {"name": self.name, "white_pC": self.white, "gain": self.gain}
