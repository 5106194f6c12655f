"""The contact whose charges are nearest to given ones, in standard deviations of the noise."""

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk_least_squares import minimise

STEPS = 8
"""Steps from a start that is near: most charges need five."""

INSIDE = 1.0 - 1e-9
"""Radius that is searched, relative to the map's: rounding must not leave the disk."""


def nearest_contact(charge_map: ChargeMap, noise: NoiseModel, charge: Array, start: Array) -> tuple[Array, Array]:
    """Contacts that explain charges best, by least squares from a start.

    Args:
        charge_map: The charges of contacts.
        noise: Of the readings.
        charge: To be explained, shape (n, n_electrode), pC.
        start: Contacts (x, y, F) to start from, shape (n, 3), mm and N.

    Returns:
        Contacts within the map's domain, shape (n, 3), and how far their charges are from those given, in standard
        deviations, shape (n,).
    """
    radius, force_range = INSIDE * charge_map.domain.radius, charge_map.domain.force_range
    low, high = np.log(force_range)
    centre, scale = charge_map.domain.centre, np.array([radius, radius, 0.5 * (high - low)])  # one force: no width

    def to_contact(unit: Array) -> Array:
        logs = unit * scale + centre
        return np.column_stack([logs[:, :2], np.clip(np.exp(logs[:, 2]), *force_range)])

    def residuals(rows: Integers, unit: Array) -> tuple[Array, Array]:
        contact = to_contact(unit)
        known = charge_map.charges(contact)
        sigma = noise.sigma(known)
        slopes = charge_map.derivatives(contact) * scale / sigma[..., None]
        return (known - charge[rows]) / sigma, slopes.swapaxes(1, 2)

    logs = np.column_stack([start[:, :2], np.log(start[:, 2])])
    unit, residual = minimise(residuals, (logs - centre) / np.where(scale > 0.0, scale, 1.0), STEPS)
    return to_contact(unit), np.linalg.norm(residual, axis=1)
