"""Input features of a network, with a whitening that is fitted to the charges of presses."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE
from isocharge.train.training.charge_features import ChargeFeatures


@dataclass(frozen=True)
class WhitenedFeatures:
    """Input features (charge features - mean) @ matrix, which have zero mean and unit covariance.

    Attributes:
        charge_features: Charge features, which are logarithms or inverse hyperbolic sines of the charges.
        mean: Mean of the charge features over the presses, shape (n_electrode,).
        matrix: Whitening matrix, shape (n_electrode, n_electrode).
    """

    charge_features: ChargeFeatures
    mean: Array
    matrix: Array

    @classmethod
    def fit_logarithms(cls, charge: Array) -> "WhitenedFeatures":
        """Fit whitened logarithms to positive charges.

        Args:
            charge: Charges of presses without noise, shape (n, n_electrode), pC.
        """
        clipped_charge = np.clip(charge, LOWEST_CHARGE, HIGHEST_CHARGE)
        mean_logarithm = np.log(clipped_charge).mean(axis=0)
        return cls._fit(logarithmic_features(mean_logarithm), charge)

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
        """Fit the mean and the whitening matrix to the charge features of presses.

        Args:
            charge_features: Charge features before the whitening.
            charge: Charges of the presses, shape (n, n_electrode), pC.
        """
        mean, matrix = whitening(charge_features.evaluate(charge))
        return cls(charge_features, mean, matrix)


def logarithmic_features(mean_logarithm: Array) -> ChargeFeatures:
    """Return features for positive charges: the logarithms of charge / typical charge.

    The typical charge of an electrode is the power of two nearest to the geometric mean of its charges. A division by a
    power of two is exact in float32. The logarithms of the quotients are near 0, where float32 has the smallest errors.

    Args:
        mean_logarithm: Mean of the logarithms of the charges in pC, shape (n_electrode,).
    """
    return ChargeFeatures(
        typical_pC=2.0 ** np.round(mean_logarithm / np.log(2.0)),
        low_pC=np.array(LOWEST_CHARGE),
        high_pC=np.array(HIGHEST_CHARGE),
    )


def signed_features(charge: Array, typical: Array) -> ChargeFeatures:
    """Return features for charges of both signs: asinh(charge / typical charge) minus its mean over the given charges.

    Before the conversion, each charge is limited to three times the range of the given charges: the inverse hyperbolic
    sines may exceed their range by its width on both sides.

    Args:
        charge: Charges of presses, shape (n, n_electrode), pC.
        typical: Typical charge of each electrode, shape (n_electrode,), pC.
    """
    asinh_charge = np.arcsinh(charge / typical)
    lowest = asinh_charge.min(axis=0)
    highest = asinh_charge.max(axis=0)
    margin = highest - lowest
    return ChargeFeatures(
        typical_pC=typical,
        low_pC=np.sinh(lowest - margin) * typical,
        high_pC=np.sinh(highest + margin) * typical,
        mean=asinh_charge.mean(axis=0),
    )


def whitening(values: Array) -> tuple[Array, Array]:
    """Compute the whitening transform of values by a principal component analysis.

    The covariance of the transformed values (values - mean) @ matrix is the identity matrix.

    Args:
        values: Values, shape (n, k), where n is at least k.

    Returns:
        Mean, shape (k,), and matrix, shape (k, k).
    """
    # The rows of `axes` are the principal axes. The standard deviation of the values along an axis is its singular
    # value divided by the square root of the number of values.
    mean = values.mean(axis=0)
    _, singular_values, axes = np.linalg.svd(values - mean, full_matrices=False)
    inverse_std = np.sqrt(len(values)) / np.maximum(singular_values, np.finfo(float).eps)
    return mean, axes.T * inverse_std
