"""The least-squares problem of Gauss-Newton: residuals of a contact and their derivatives."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.data.charge_field import ChargeField


@dataclass(frozen=True)
class Problem:
    """Charges as a function of the contact, and the prior.

    Attributes:
        series: ln Q and its derivatives, shape (degree + 1, degree + 1, force_degree + 1, 4 n_electrode).
        orders: 0 to degree, shape (degree + 1,).
        white_pC: Noise that every charge has.
        gain: Noise in proportion to the charge.
    """

    series: Array
    orders: Array
    white_pC: float
    gain: float

    @classmethod
    def of(cls, field: ChargeField, noise: NoiseModel) -> "Problem":
        """From a fitted forward map."""
        series = field.with_slopes()
        series = series.reshape(*series.shape[:3], -1)
        return cls(series, np.arange(float(len(series))), 1e12 * noise.white, noise.gain)

    def sigma(self, charge_pC: Array) -> Array:
        """Standard deviation of measured charges, pC."""
        sigma: Array = np.sqrt(self.white_pC**2 + (self.gain * charge_pC) ** 2)
        return sigma

    def known(self, unit: Array) -> tuple[Array, Array]:
        """Charges and their derivatives by the unit coordinates.

        Args:
            unit: Shape (3,) or (n, 3), within the domain.

        Returns:
            Shape (..., n_electrode), pC, and (..., 3, n_electrode).
        """
        in_x, in_y, in_force = self._polynomials(unit)
        count, _, forces, width = self.series.shape
        lead = unit.shape[:-1]
        sums = (in_x @ self.series.reshape(count, -1)).reshape(*lead, count, -1)
        sums = (in_y[..., None, :] @ sums).reshape(*lead, forces, width)
        values = (in_force[..., None, :forces] @ sums).reshape(*lead, 4, -1)
        charge = np.exp(values[..., 0, :])
        return charge, charge[..., None, :] * values[..., 1:, :]

    def _polynomials(self, unit: Array) -> Array:
        """T_k of every coordinate, shape (3, ..., degree + 1)."""
        angle = np.arccos(np.minimum(np.maximum(unit.T, -1.0), 1.0))
        values: Array = np.cos(angle[..., None] * self.orders)
        return values

    def residuals(self, unit: Array, charge_pC: Array, sigma_pC: Array) -> tuple[Array, Array]:
        """Residuals, shape (..., n_electrode), and their derivatives, shape (..., 3, n_electrode)."""
        known, slopes = self.known(unit)
        return (known - charge_pC) / sigma_pC, slopes / sigma_pC[..., None, :]
