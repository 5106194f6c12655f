"""Whitened input features of a network, fitted to the charges of presses."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.charge_features import ChargeFeatures
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE

CLIPPING_MARGIN = 1.0
"""Distance of the clipping limits from the extreme charges of the presses, relative to the range of these charges.
Charges of both signs are clipped. Distance and range are differences of asinh(Q / typical charge)."""

MIN_SINGULAR_VALUE = 1e-12
"""Singular value below which the whitening does not enlarge a direction further."""


@dataclass(frozen=True)
class WhitenedFeatures:
    """Features with zero mean and unit covariance: (features of the charges - mean) @ matrix.

    Attributes:
        charge_features: Logarithms or inverse hyperbolic sines of the charges.
        mean: Mean of these features over the presses, shape (n_electrode,).
        matrix: Whitening matrix, shape (n_electrode, n_electrode).
    """

    charge_features: ChargeFeatures
    mean: Array
    matrix: Array

    @classmethod
    def fit_logarithms(cls, charge: Array) -> "WhitenedFeatures":
        """Fit whitened logarithms to positive charges without noise, shape (n, n_electrode), pC."""
        clipped = np.clip(charge, LOWEST_CHARGE, HIGHEST_CHARGE)
        return cls._fit(logarithmic_features(np.log(clipped).mean(axis=0)), charge)

    @classmethod
    def fit_signed(cls, charge: Array, typical: Array) -> "WhitenedFeatures":
        """Fit whitened inverse hyperbolic sines to charges of both signs.

        Args:
            charge: Charges of presses, shape (n, n_electrode), pC.
            typical: Charge above which the noise is proportional to the charge, shape (n_electrode,), pC.
        """
        return cls._fit(signed_features(charge, typical), charge)

    @classmethod
    def _fit(cls, charge_features: ChargeFeatures, charge: Array) -> "WhitenedFeatures":
        """Fit mean and whitening matrix to the features of charges, shape (n, n_electrode), pC."""
        mean, matrix = whitening(charge_features.evaluate(charge))
        return cls(charge_features, mean, matrix)


def logarithmic_features(mean_logarithm: Array) -> ChargeFeatures:
    """Return features for positive charges.

    The typical charge is the power of two that is nearest to the geometric mean. The division by a power of two is
    exact in float32, and the logarithms are then small enough to keep their digits.

    Args:
        mean_logarithm: Mean of the logarithms of the charges in pC, shape (n_electrode,).
    """
    return ChargeFeatures(
        typical_pC=2.0 ** np.round(mean_logarithm / np.log(2.0)),
        low_pC=np.array(LOWEST_CHARGE),
        high_pC=np.array(HIGHEST_CHARGE),
    )


def signed_features(charge: Array, typical: Array) -> ChargeFeatures:
    """Return features for charges of both signs: inverse hyperbolic sines of the charges divided by typical charges.

    Charges are limited to the range of the given charges, enlarged by a margin on both sides.

    Args:
        charge: Charges of presses, shape (n, n_electrode), pC.
        typical: Charge by which each charge is divided, shape (n_electrode,), pC.
    """
    levels = np.arcsinh(charge / typical)
    lowest = levels.min(axis=0)
    highest = levels.max(axis=0)
    margin = CLIPPING_MARGIN * (highest - lowest)
    return ChargeFeatures(
        typical_pC=typical,
        low_pC=np.sinh(lowest - margin) * typical,
        high_pC=np.sinh(highest + margin) * typical,
        mean=levels.mean(axis=0),
    )


def whitening(values: Array, min_relative_std: float = 0.0) -> tuple[Array, Array]:
    """Compute the whitening transform of values by a principal component analysis.

    Args:
        values: Values, shape (n, k).
        min_relative_std: Smallest standard deviation of a principal component, relative to the largest one, for which
            the component is scaled to unit variance. A smaller component is scaled as if it had this standard
            deviation.

    Returns:
        Mean, shape (k,), and matrix M, shape (k, k): (values - mean) @ M has unit covariance.
    """
    # The principal axes are the rows of `axes`, and the singular values are the standard deviations along them times
    # the root of the number of values.
    mean = values.mean(axis=0)
    _, singular_values, axes = np.linalg.svd(values - mean, full_matrices=False)
    largest_singular_value = singular_values[0]
    smallest_used = max(MIN_SINGULAR_VALUE, min_relative_std * largest_singular_value)
    inverse_std = np.sqrt(len(values)) / np.maximum(singular_values, smallest_used)
    return mean, axes.T * inverse_std
