"""The contact whose charges are nearest to given ones, in standard deviations of the noise."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.forward.charge_model import ChargeModel
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk_least_squares import minimise

STEPS = 8
"""Steps from a start that is near: most charges need five."""

INSIDE = 1.0 - 1e-9
"""Radius that is searched, relative to the model's: rounding must not leave its disk."""


def nearest_contact(model: ChargeModel, noise: NoiseModel, charge: Array, start: Array) -> tuple[Array, Array]:
    """Contacts that explain charges best, by least squares from a start.

    Args:
        model: The charges of contacts.
        noise: Of the readings.
        charge: To be explained, shape (n, n_electrode), C.
        start: Contacts (x, y, F) to start from, shape (n, 3), m and N.

    Returns:
        Contacts within the model's domain, shape (n, 3), and how far their charges are from those given, in standard
        deviations, shape (n,).
    """
    domain = _Domain.of(model)

    def residuals(rows: Integers, unit: Array) -> tuple[Array, Array]:
        contact = domain.to_contact(unit)
        known = model.charge(contact)
        sigma = noise.sigma(known)
        slopes = model.jacobian(contact) * domain.scale / sigma[..., None]
        return (known - charge[rows]) / sigma, slopes.swapaxes(1, 2)

    unit, residual = minimise(residuals, domain.to_unit(start), STEPS)
    return domain.to_contact(unit), np.linalg.norm(residual, axis=1)


@dataclass(frozen=True)
class _Domain:
    """A model's contacts as the unit disk times [-1, 1].

    Attributes:
        centre: Middle of (x, y, ln F), shape (3,).
        scale: Half width of (x, y, ln F), shape (3,); zero where the model knows one force only.
        force_range: N.
    """

    centre: Array
    scale: Array
    force_range: tuple[float, float]

    @classmethod
    def of(cls, model: ChargeModel) -> "_Domain":
        low, high = np.log(model.force_range)
        radius = INSIDE * model.radius
        return cls(
            np.array([0.0, 0.0, 0.5 * (low + high)]), np.array([radius, radius, 0.5 * (high - low)]), model.force_range
        )

    def to_unit(self, contact: Array) -> Array:
        logs = np.column_stack([contact[:, :2], np.log(contact[:, 2])])
        unit: Array = (logs - self.centre) / np.where(self.scale > 0.0, self.scale, 1.0)
        return unit

    def to_contact(self, unit: Array) -> Array:
        logs = unit * self.scale + self.centre
        return np.column_stack([logs[:, :2], np.clip(np.exp(logs[:, 2]), *self.force_range)])
