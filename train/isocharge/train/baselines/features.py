"""What the learning methods look at: whitened logarithms of the charges.

They are a linear map of the log-ratios, which carry the position, and of the mean logarithm, which carries the force.
The first axis, along which charges vary most, is the force's; the next two are the position's; what is left in a fourth
charge is mostly noise. Methods that look for near neighbours may measure the axes with different rulers: along the
force the map hardly changes, so neighbours may be far apart there.
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.train.data.domain import LOWEST_PC
from isocharge.train.training.network import Features

RULERS = ((1.0, 1.0), (0.1, 0.03), (0.03, 0.03))
"""Candidates for the factors of the force's axis and of what is left after three axes."""


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

    def measured_by(self, ruler: tuple[float, float]) -> "LogFeatures":
        """The same with the first axis, and those after the third, times these factors."""
        factor = np.ones(self.shift.size)
        factor[0], factor[3:] = ruler
        return replace(self, matrix=self.matrix * factor, shift=self.shift * factor)

    def __call__(self, charge_pC: Array) -> Array:
        """Features of charges, shape (n, n_electrode) or (n_electrode,), of the same shape."""
        values: Array = np.log(np.maximum(charge_pC, LOWEST_PC)) @ self.matrix + self.shift
        return values


def with_one(features: Array) -> Array:
    """A column of ones behind the features, shape (n, n_electrode) to (n, n_electrode + 1)."""
    return np.column_stack([features, np.ones(len(features))])


def affine_fit(features: Array, unit: Array) -> Array:
    """Least squares from features and one to unit coordinates, shape (n_electrode + 1, 3)."""
    plane: Array = np.linalg.lstsq(with_one(features), unit, rcond=None)[0].astype(float)
    return plane
