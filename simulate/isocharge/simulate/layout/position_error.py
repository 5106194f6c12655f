"""The least position error that a layout allows, with what nobody knows as nuisances, and its derivatives.

With A = d(charge) / d(x, y, ln F, nuisances) of all electrodes and W what one reading tells about its charge, the
information about everything is A' W A + P, P what is known about the nuisances beforehand. The position's part of its
inverse is the Cramer-Rao limit; that is the Schur complement in which the nuisances are marginalised.

The derivative of the squared error e = tr(E I^-1) by A and W follows from dI: with B = I^-1 E I^-1,

    de/dA = -2 W A B,   de/dW = -diag(A B A').
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.layout.scene import Nuisances
from isocharge.simulate.measuring_chain.noise import NoiseModel

PRIOR = (0.05, 0.05, 10.0)
"""Standard deviation of x and y (m) and ln F before anything is read: errors stay finite where charges say nothing."""


@dataclass(frozen=True)
class ErrorModel:
    """Squared position errors from rows.

    Attributes:
        noise: Noise of the readings, with what is unknown of the gains.
        used: Columns of the rows that are parameters: x, y, ln F and the nuisances.
        scale: One unit of each parameter, shape (n_parameter,): a prior standard deviation.
    """

    noise: NoiseModel
    used: tuple[int, ...]
    scale: Array

    @classmethod
    def of(cls, noise: NoiseModel, nuisances: Nuisances) -> "ErrorModel":
        """Errors with these nuisances."""
        unknown = [nuisances.probe_radius, nuisances.profile, nuisances.pretension]
        used = (1, 2, 3, *(4 + i for i, std in enumerate(unknown) if std > 0.0))
        scale = np.array([*PRIOR, *(std for std in unknown if std > 0.0)])
        gains = NoiseModel(noise.name, noise.white, float(np.hypot(noise.gain, nuisances.gain)))
        return cls(gains, used, scale)

    def squared(self, rows: Array) -> Array:
        """Squared position error, shape (n_press,), m^2, from rows of shape (n_press, n_electrode, 7)."""
        _, _, _, inverse = self._information(rows)
        squared: Array = PRIOR[0] ** 2 * (inverse[:, 0, 0] + inverse[:, 1, 1])
        return squared

    def gradient(self, rows: Array) -> tuple[Array, Array]:
        """Squared errors, and their derivatives by the rows, of the shape of the rows."""
        a, weight, slope, inverse = self._information(rows)
        squared = PRIOR[0] ** 2 * (inverse[:, 0, 0] + inverse[:, 1, 1])
        b = PRIOR[0] ** 2 * np.matmul(inverse[:, :, :2], inverse[:, :2, :])
        ab = np.matmul(a, b)
        by_rows = np.zeros_like(rows)
        by_rows[:, :, self.used] = -2.0 * weight[:, :, None] * ab * self.scale
        by_rows[:, :, 0] = -(ab * a).sum(axis=2) * slope
        return squared, by_rows

    def displacement(self, rows: Array) -> Array:
        """How a change of the charges moves the estimated position: shape (n_press, 2, n_electrode), m/C."""
        a, weight, _, inverse = self._information(rows)
        moved: Array = PRIOR[0] * np.matmul(inverse[:, :2], (a * weight[:, :, None]).swapaxes(1, 2))
        return moved

    def _information(self, rows: Array) -> tuple[Array, Array, Array, Array]:
        """A in units of the scale, W, dW/dQ and the inverse of the information in these units."""
        charge, a = rows[:, :, 0], rows[:, :, self.used] * self.scale
        weight, slope = _weight(charge, self.noise)
        information = np.matmul((a * weight[:, :, None]).swapaxes(1, 2), a) + np.eye(len(self.used))
        return a, weight, slope, np.linalg.inv(information)


def _weight(charge: Array, noise: NoiseModel) -> tuple[Array, Array]:
    """`NoiseModel.information` and its derivative by the charge."""
    g2 = noise.gain**2
    variance = noise.variance(charge)
    by_charge = 2.0 * g2 * charge
    term = 2.0 * (g2 * charge) ** 2 / variance
    term_slope = 4.0 * g2**2 * charge / variance - term * by_charge / variance
    weight = (1.0 + term) / variance
    return weight, term_slope / variance - weight * by_charge / variance
