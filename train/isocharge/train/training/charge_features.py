"""Conversion of charges into the input features of a network.

The features are logarithms of positive charges. If the charges can have both signs, the features are inverse hyperbolic
sines of the charges.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array


@dataclass(frozen=True)
class ChargeFeatures:
    """Function that computes features from charges Q. The features are the inputs of a network's first layer.

    If all charges are positive, the features are ln(clip(Q) / typical). If the charges can have both signs, the
    features are asinh(clip(Q) / typical) - mean. The function asinh is linear for small arguments and logarithmic for
    large arguments.

    Attributes:
        typical_pC: Charge by which the charge of each electrode is divided, shape (n_electrode,), pC, positive.
        low_pC: Lower limit to which smaller charges are clipped, shape () or (n_electrode,), pC.
        high_pC: Upper limit to which larger charges are clipped, shape () or (n_electrode,), pC.
        mean: Mean of the inverse hyperbolic sines over the training presses, shape (n_electrode,); None if all charges
            are positive.
    """

    typical_pC: Array
    low_pC: Array
    high_pC: Array
    mean: Array | None = None

    @property
    def n_electrode(self) -> int:
        """Number of electrodes, which is also the number of charges of a press."""
        return self.typical_pC.size

    def evaluate(self, charge_pC: Array) -> Array:
        """Compute the features of charges.

        Args:
            charge_pC: Charges, shape (..., n_electrode), pC.

        Returns:
            Features, of the same shape, dimensionless.
        """
        ratio = np.clip(charge_pC, self.low_pC, self.high_pC) / self.typical_pC
        if self.mean is None:
            return np.asarray(np.log(ratio))
        return np.asarray(np.arcsinh(ratio) - self.mean)
