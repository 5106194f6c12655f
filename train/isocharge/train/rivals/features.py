"""What the learning methods look at: whitened logarithms of the charges.

They are a linear map of the log-ratios, which carry the position, and of the mean logarithm, which carries the force.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.simulate.arrays import Array
from isocharge.train.network import LOWEST_PC, Features


@dataclass(frozen=True)
class LogFeatures:
    """ln(max(Q, 1 pC)) @ matrix + shift.

    Attributes:
        matrix: Shape (n_electrode, n_electrode).
        shift: Shape (n_electrode,).
    """

    matrix: Array
    shift: Array

    @classmethod
    def fit(cls, charge_pC: Array) -> "LogFeatures":
        """Zero mean and unit covariance on these charges, shape (n, n_electrode), pC."""
        whitened = Features.fit(charge_pC)
        return cls(whitened.matrix, -np.log(whitened.typical) @ whitened.matrix)

    @classmethod
    def into_box(cls, charge_pC: Array) -> "LogFeatures":
        """Whitened, and then scaled so that these charges fill [-1, 1] along every axis."""
        whitened = cls.fit(charge_pC)
        values = whitened(charge_pC)
        low, high = values.min(axis=0), values.max(axis=0)
        scale = 2.0 / np.maximum(high - low, 1e-12)
        return cls(whitened.matrix * scale, (whitened.shift - low) * scale - 1.0)

    def __call__(self, charge_pC: Array) -> Array:
        """Features of charges, shape (n, n_electrode) or (n_electrode,), of the same shape."""
        values: Array = np.log(np.maximum(charge_pC, LOWEST_PC)) @ self.matrix + self.shift
        return values
