"""Input features of a network: logarithms of the charges, or inverse hyperbolic sines of charges of both signs."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array


@dataclass(frozen=True)
class ChargeFeatures:
    """Function that computes the inputs of the first layer of a network from charges Q.

    For positive charges the function is ln(clip(Q) / typical). If charges can have both signs, the function is
    asinh(clip(Q) / typical) - mean. This function is linear for small charges and logarithmic for large charges.

    Attributes:
        typical_pC: Charge by which each charge is divided, shape (n_electrode,), pC, positive.
        low_pC: Smallest charge, to which smaller ones are clipped, shape () or (n_electrode,), pC.
        high_pC: Largest charge, to which larger ones are clipped, shape () or (n_electrode,), pC.
        mean: Mean of the inverse hyperbolic sines, shape (n_electrode,), or None for positive charges.
    """

    typical_pC: Array
    low_pC: Array
    high_pC: Array
    mean: Array | None = None

    @property
    def n_electrode(self) -> int:
        """Number of charges of a press."""
        return self.typical_pC.size

    def evaluate(self, charge_pC: Array) -> Array:
        """Compute the features of charges (pC) of shape (..., n_electrode). The features have the same shape."""
        ratio = np.clip(charge_pC, self.low_pC, self.high_pC) / self.typical_pC
        if self.mean is None:
            return np.asarray(np.log(ratio))
        return np.asarray(np.arcsinh(ratio) - self.mean)
