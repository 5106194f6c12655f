"""The contact whose charges are nearest to given ones, in standard deviations of the noise.

min over contacts c of the domain of |(Q - Q(c)) / sigma|
"""

from collections.abc import Callable

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.forward.charge_map import ChargeMap, linearised
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import INNER_RADIUS
from isocharge.simulate.numerics.disk_least_squares import MAX_STEPS, minimise

STEPS = 8
"""Steps from a start that is near: most charges need five."""

CANDIDATES = 4096
"""Contacts among which starts are chosen: spread over the domain, and a quarter as many along its rim."""

CHUNK = 2048
"""Charges compared with all candidates at once."""


def nearest_contact(charge_map: ChargeMap, noise: NoiseModel, charge: Array, start: Array) -> tuple[Array, Array]:
    """Contacts that explain charges best, by least squares from a start that is near.

    Args:
        charge_map: The charges of contacts.
        noise: Of the readings.
        charge: To be explained, shape (n, n_electrode), pC.
        start: Contacts (x, y, F) to start from, shape (n, 3), mm and N.

    Returns:
        Contacts within the map's domain, shape (n, 3), and how far their charges are from those given, in standard
        deviations, shape (n,).
    """
    contact, residual = _descent(charge_map, charge, lambda _, known: noise.sigma(known), start, STEPS)
    return contact, np.linalg.norm(residual, axis=1)


def explain(charge_map: ChargeMap, charge: Array, sigma: Array, start: Array) -> tuple[Array, Array]:
    """The contacts that descent from a start leads to.

    Args:
        charge_map: The charges of contacts.
        charge: To be explained, shape (n, n_electrode), pC.
        sigma: The unit of distance, shape (n, n_electrode), pC.
        start: Contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        Contacts within the map's domain, shape (n, 3), and residuals (Q - Q(c)) / sigma, shape (n, n_electrode).
    """
    return _descent(charge_map, charge, lambda rows, _: sigma[rows], start, MAX_STEPS)


def _descent(
    charge_map: ChargeMap, charge: Array, sigma_of: Callable[[Integers, Array], Array], start: Array, steps: int
) -> tuple[Array, Array]:
    """As `explain`; the unit of distance is a function of the rows of charges and of the charges that explain them."""
    radius, force_range = INNER_RADIUS * charge_map.domain.radius, charge_map.domain.force_range
    low, high = np.log(force_range)
    centre, scale = charge_map.domain.centre, np.array([radius, radius, 0.5 * (high - low)])  # one force: no width

    def to_contact(unit: Array) -> Array:
        logs = unit * scale + centre
        return np.column_stack([logs[:, :2], np.clip(np.exp(logs[:, 2]), *force_range)])

    def residuals(rows: Integers, unit: Array) -> tuple[Array, Array]:
        known, slopes = linearised(charge_map, to_contact(unit))
        sigma = sigma_of(rows, known)
        return (charge[rows] - known) / sigma, -(slopes * scale / sigma[..., None]).swapaxes(1, 2)

    logs = np.column_stack([start[:, :2], np.log(start[:, 2])])
    unit, residual = minimise(residuals, (logs - centre) / np.where(scale > 0.0, scale, 1.0), steps)
    return to_contact(unit), residual


def search(
    charge_map: ChargeMap, charge: Array, sigma: Array, *, starts: int = 2, candidates: int = CANDIDATES
) -> tuple[Array, Array]:
    """The nearest contacts from the best few of many starts; other arguments and result as `explain`."""
    spread = charge_map.domain.to_contact(INNER_RADIUS * _spread(candidates))
    known = charge_map.charges(spread)
    chunks = range(0, max(len(charge), 1), CHUNK)
    nearest = [_nearest_rows(charge[k : k + CHUNK], sigma[k : k + CHUNK], known, starts) for k in chunks]
    answers = [explain(charge_map, charge, sigma, spread[rows]) for rows in np.concatenate(nearest).T]
    squares = np.stack([(residual**2).sum(axis=1) for _, residual in answers])
    best = squares.argmin(axis=0), np.arange(len(charge))
    return np.stack([contact for contact, _ in answers])[best], np.stack([residual for _, residual in answers])[best]


def _spread(count: int) -> Array:
    """Contacts in unit coordinates, shape (count, 3)."""
    sobol = scipy.stats.qmc.Sobol(3, scramble=False).random(count)
    radius, angle = np.sqrt(sobol[:, 0]), 2.0 * np.pi * sobol[:, 1]
    radius[::4] = 1.0
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 2.0 * sobol[:, 2] - 1.0], axis=1)


def _nearest_rows(charge: Array, sigma: Array, known: Array, count: int) -> Integers:
    """Numbers of the nearest candidates, shape (n, count): |Q - K|^2 multiplied out, one matrix product each."""
    weight = sigma**-2.0
    square = weight @ (known**2).T - 2.0 * (charge * weight) @ known.T
    return np.asarray(np.argpartition(square, count - 1, axis=1)[:, :count])
