"""What a network sees of charges: whitened logarithms, or what stands for them where charges may have any sign."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE

MISFIT_UNIT = 5.0
"""Standard deviations up to which the misfit is learned about linearly; beyond, its logarithm is."""

WIDER = 1.0
"""How far signed charges may lie beyond those of presses, over the width of these, in asinh: farther ones count as just
so far. What is absurd still gives a finite answer."""


@dataclass(frozen=True)
class SignedCharges:
    """Charges of any sign: asinh(clip(Q) / typical) - mean stands for the logarithm.

    Attributes:
        low, high: Charges are brought between these, shape (n_electrode,), pC.
        mean: Shape (n_electrode,): numbers about 0 keep the digits of a float32.
    """

    low: Array
    high: Array
    mean: Array

    @classmethod
    def of(cls, charge: Array, typical: Array) -> "SignedCharges":
        """From charges of presses, shape (n, n_electrode), and the typical ones, pC."""
        levels = np.arcsinh(charge / typical)
        low, high = levels.min(axis=0), levels.max(axis=0)
        beyond = WIDER * (high - low)
        return cls(np.sinh(low - beyond) * typical, np.sinh(high + beyond) * typical, levels.mean(axis=0))


@dataclass(frozen=True)
class Features:
    """Whitened logarithms of the charges: x = (ln(clip(Q) / typical) - mean) @ matrix.

    Attributes:
        typical: The power of two nearest to each charge's geometric mean, shape (n_electrode,), pC: dividing by it
            costs a float32 no digit, and the logarithms are small enough to keep theirs. For signed charges the size
            from which noise grows with the charge.
        mean: Of the logarithms, shape (n_electrode,).
        matrix: Shape (n_electrode, n_electrode).
        signed: What stands for the logarithm if charges may have any sign.
    """

    typical: Array
    mean: Array
    matrix: Array
    signed: SignedCharges | None = None

    @classmethod
    def fit(cls, charge: Array) -> "Features":
        """From clean positive charges, shape (n, n_electrode): zero mean, unit covariance along the principal axes."""
        within = np.clip(charge, LOWEST_CHARGE, HIGHEST_CHARGE)
        typical = 2.0 ** np.round(np.log2(within).mean(axis=0))
        return cls(typical, *whitening(np.log(within / typical)))

    @classmethod
    def of_signed(cls, charge: Array, typical: Array) -> "Features":
        """From charges of any sign, shape (n, n_electrode), and the size from which noise grows with them, pC."""
        signed = SignedCharges.of(charge, typical)
        return cls(typical, *whitening(bent(charge, typical, signed)), signed)


def bent(charge: Array, typical: Array, signed: SignedCharges | None) -> Array:
    """What features are linear in, shape (n, n_electrode): ln(Q / typical), or what stands for it."""
    if signed:
        return np.asarray(np.arcsinh(np.clip(charge, signed.low, signed.high) / typical) - signed.mean)
    return np.asarray(np.log(np.clip(charge, LOWEST_CHARGE, HIGHEST_CHARGE) / typical))


def whitening(values: Array, least: float = 0.0) -> tuple[Array, Array]:
    """Mean and matrix M of values (n, k): (values - mean) @ M has unit covariance along its principal axes.

    Where the deviation along an axis is less than `least` of the largest, it stays below 1.
    """
    mean = values.mean(axis=0)
    _, singular, axes = np.linalg.svd(values - mean, full_matrices=False)
    return mean, axes.T * (np.sqrt(len(values)) / np.maximum(singular, max(1e-12, least * singular[0])))
