"""The least-squares problem of Gauss-Newton: residuals of a contact, their derivatives, and one damped step within the
prior's disk and forces."""

from dataclasses import dataclass

import numpy as np

from isocharge.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.data.charge_field import ChargeField

STIFF = 1e6
"""Weight of the edge's tangent over that of the charges."""


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


def within(unit: Array) -> Array:
    """The nearest contacts in the domain."""
    held = unit.copy()
    radius = np.sqrt(unit[..., 0] ** 2 + unit[..., 1] ** 2)
    held[..., :2] /= np.maximum(radius, 1.0)[..., None]
    held[..., 2] = np.minimum(np.maximum(unit[..., 2], -1.0), 1.0)
    return held


def damped_step(unit: Array, residual: Array, slopes: Array, damping: Array) -> Array:
    """Where a Levenberg-Marquardt step (Marquardt 1963) ends, kept in the domain.

    Args:
        unit: Where it begins, shape (..., 3).
        residual: There, shape (..., n_electrode).
        slopes: Derivatives, shape (..., 3, n_electrode).
        damping: Relative to the diagonal, shape (...).
    """
    normal: Array = slopes @ slopes.swapaxes(-1, -2)
    normal = normal * (1.0 + damping[..., None, None] * np.eye(3))
    gradient = slopes @ residual[..., None]
    end: Array = unit + np.linalg.solve(normal, -gradient)[..., 0]
    outside = (end[..., 0] ** 2 + end[..., 1] ** 2 > 1.0) | (np.abs(end[..., 2]) > 1.0)
    if not outside.any():
        return end
    tangents, gap = _tangents(end, unit)
    stiff = STIFF / 3.0 * np.trace(normal, axis1=-2, axis2=-1)[..., None, None]
    normal = normal + stiff * (tangents.swapaxes(-1, -2) @ tangents)
    gradient = gradient + stiff * (tangents.swapaxes(-1, -2) @ gap[..., None])
    held: Array = unit + np.linalg.solve(normal, -gradient)[..., 0]
    return within(np.where(outside[..., None], held, end))


def _tangents(end: Array, unit: Array) -> tuple[Array, Array]:
    """Outward normals of the edges that a step's end lies beyond, (..., 2, 3), and how far beyond them `unit` is."""
    radius = np.sqrt(end[..., 0] ** 2 + end[..., 1] ** 2)
    tangents = np.zeros((*end.shape[:-1], 2, 3))
    tangents[..., 0, :2] = end[..., :2] * ((radius > 1.0) / np.maximum(radius, 1.0))[..., None]
    tangents[..., 1, 2] = np.sign(end[..., 2]) * (np.abs(end[..., 2]) > 1.0)
    there = (tangents != 0.0).any(axis=-1)
    return tangents, (tangents @ unit[..., None])[..., 0] - there
