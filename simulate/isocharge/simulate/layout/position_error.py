"""The least position error that a layout allows, with what nobody knows as nuisances.

With A = d(charge) / d(x, y, ln F, nuisances) of all electrodes and W what one reading tells about its charge, the
information about everything is A' W A + P, P what is known beforehand. The position's part of its inverse is the
Cramer-Rao limit; that is the Schur complement in which the nuisances are marginalised. Electrodes add up in it, so one
more changes the inverse B by a product of vectors (Sherman and Morrison 1950): with a = sqrt(w) of its row of A

    tr_xy (B^-1 + a a')^-1 = tr_xy B - |(B a)_xy|^2 / (1 + a' B a).
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.layout.case import Nuisances
from isocharge.simulate.measuring_chain.noise import NoiseModel

PRIOR = (50.0, 50.0, 10.0)
"""Standard deviation of x and y (mm) and ln F before anything is read: errors stay finite where charges say nothing."""


@dataclass(frozen=True)
class ErrorModel:
    """From rows of a `ChargeTable` to squared position errors.

    Attributes:
        noise: Noise of the readings, with what is unknown of the gains.
        scale: Standard deviation of x, y, ln F and the nuisances before anything is read, shape (5,).
    """

    noise: NoiseModel
    scale: Array

    @classmethod
    def of(cls, noise: NoiseModel, nuisances: Nuisances) -> "ErrorModel":
        """Errors with these nuisances."""
        gain = float(np.hypot(noise.gain, nuisances.gain))
        return cls(replace(noise, gain=gain), np.array([*PRIOR, nuisances.probe_radius, nuisances.pretension]))

    def sensitivity(self, rows: Array) -> Array:
        """Rows (..., 6) to sqrt(W) A in units of the scale, shape (..., 5): how much each reading tells."""
        weight = np.sqrt(self.noise.information(rows[..., 0]))
        return np.asarray(rows[..., 1:] * self.scale * weight[..., None])

    def squared(self, rows: Array) -> Array:
        """Squared position errors, shape (n_press,), mm^2, from rows of shape (n_press, n_electrode, 6)."""
        return position_variance(inverse_information(self.sensitivity(rows)))


def inverse_information(sensitivity: Array) -> Array:
    """Inverse of the information of electrodes, (n_press, n_electrode, 5) to (n_press, 5, 5), in units of the scale."""
    return np.asarray(np.linalg.inv(np.matmul(sensitivity.swapaxes(1, 2), sensitivity) + np.eye(sensitivity.shape[2])))


def position_variance(inverse: Array) -> Array:
    """Squared position error from the inverse information, shape (n_press,), mm^2."""
    return np.asarray(PRIOR[0] ** 2 * (inverse[:, 0, 0] + inverse[:, 1, 1]))


def with_one_more(sensitivity: Array, candidates: Array) -> Array:
    """Squared errors with each of many candidates beside given electrodes.

    Args:
        sensitivity: Of the electrodes, shape (n_press, n_electrode, 5).
        candidates: Of one more, shape (n_press, 5, n_candidate).

    Returns:
        Shape (n_press, n_candidate), mm^2.
    """
    inverse = inverse_information(sensitivity)
    moved = inverse @ candidates
    gain = (moved[:, :2] ** 2).sum(axis=1) / (1.0 + (moved * candidates).sum(axis=1))
    return np.asarray(position_variance(inverse)[:, None] - PRIOR[0] ** 2 * gain)
