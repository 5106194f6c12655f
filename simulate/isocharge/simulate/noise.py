"""Noise of charges that is independent for each channel and each reading.

The noise of a charge Q has the variance

    sigma^2 = white^2 + (gain * Q)^2,

where `white` is the standard deviation for a charge of zero, and `gain` is the relative noise of large charges.
"""

import math
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, SceneError


class GaussianNoise:
    """Base class of Gaussian noise that is independent for each reading.

    Each attribute is either a number or an array. Arrays are broadcast with the charges.

    Attributes:
        white: Standard deviation of the part of the noise that does not depend on the charge, pC.
        gain: Standard deviation of the part of the noise that is proportional to the charge, divided by the charge,
            dimensionless.
    """

    white: float | Array
    gain: float | Array

    def sigma(self, charge: Array) -> Array:
        """Compute the standard deviation of the noise for given charges.

        Args:
            charge: Charges of any shape, pC.

        Returns:
            Standard deviations of the same shape, pC.
        """
        return np.hypot(self.white, self.gain * np.asarray(charge))

    def add(self, charge: Array, rng: np.random.Generator) -> Array:
        """Add random noise to charges.

        Args:
            charge: Charges without noise, any shape, pC.
            rng: Random number generator for the noise.

        Returns:
            Charges with noise, same shape, pC.
        """
        return charge + self.sigma(charge) * rng.standard_normal(np.shape(charge))


@dataclass(frozen=True)
class NoiseModel(GaussianNoise):
    """Gaussian noise with the same parameters for all channels.

    Attributes:
        name: Name of the noise level.
        white: Standard deviation of the part of the noise that does not depend on the charge, pC.
        gain: Standard deviation of the part of the noise that is proportional to the charge, divided by the charge,
            dimensionless.
    """

    name: str
    white: float
    gain: float

    def __post_init__(self) -> None:
        for name in ("white", "gain"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"noise {self.name!r}: {name}: expected a finite number from 0, got {value}")

    def variance(self, charge: Array) -> Array:
        """Compute the variance of the noise for given charges.

        This method is faster than squaring the result of `sigma`.

        Args:
            charge: Charges of any shape, pC.

        Returns:
            Variances of the same shape, pC^2.
        """
        return self.white**2 + (self.gain * np.asarray(charge)) ** 2

    def information(self, charge: Array) -> Array:
        """Compute the Fisher information that one reading provides about its charge.

        A reading is Gaussian, and both its mean and its standard deviation sigma depend on the charge Q. The
        information of the reading is therefore (1 + 2 (d sigma / dQ)^2) / sigma^2 (Kay 1993, equation 3.31). The
        inverse of the information is the smallest variance that an unbiased estimate of the charge can have.

        Args:
            charge: Charges of any shape, pC.

        Returns:
            Information, 1/pC^2, of the same shape.
        """
        variance = self.variance(charge)
        return (1.0 + 2.0 * (self.gain**2 * np.asarray(charge)) ** 2 / variance) / variance

    def check_white(self) -> None:
        """Raise an error if there is no white noise.

        Raises:
            SceneError: If the white noise is zero.
        """
        if self.white == 0.0:
            raise SceneError(
                f"noise: expected white noise above 0 pC, got that of {self.name!r}: without noise the errors have no "
                "lower limit"
            )

    def to_dict(self) -> dict[str, float | str]:
        """Return the name and the parameters of the noise as a dictionary for the metadata of a model."""
        return {"name": self.name, "white_pC": self.white, "gain": self.gain}


NOISE_LEVELS = {
    "clean": NoiseModel("clean", 0.0, 0.0),
    "reference": NoiseModel("reference", 1.0, 2e-3),
    "measured": NoiseModel("measured", 1.0, 1.5e-2),
    "bench": NoiseModel("bench", 0.3, 0.0),
    "surgery": NoiseModel("surgery", 1.0, 0.0),
}
"""Noise model of each noise level.

The level `reference` is an assumption. The proportional noise of the level `measured` comes from the data set
Tactile_Heatmaps of the University of Genoa: in 1,171 recordings, the charge of a PVDF channel varies by about 2 % at
equal force. For the levels `bench` and `surgery`, the noise model is the part of the disturbances that does not depend
on earlier readings.
"""
