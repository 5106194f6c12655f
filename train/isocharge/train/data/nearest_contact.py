"""The contact nearest to any charges: what the misfit measures.

min over contacts c of the domain of |(Q - Q(c)) / sigma|,   sigma of the charges Q.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from scipy.stats import qmc

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.numerics.disk_least_squares import minimise

CANDIDATES = 4096
"""Contacts among which starts are chosen: spread over the domain, and a quarter as many along its rim."""

CHUNK = 2048
"""Charges compared with all candidates at once."""


@runtime_checkable
class LinearisedMap(ChargeMap, Protocol):
    """A charge map that has charges and derivatives at once."""

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """What `charges` and `derivatives` give."""


def linearised(charge_map: ChargeMap, contact: Array) -> tuple[Array, Array]:
    """Charges and derivatives of contacts; see `ChargeMap`."""
    if isinstance(charge_map, LinearisedMap):
        return charge_map.linearised(contact)
    return charge_map.charges(contact), charge_map.derivatives(contact)


def nearest_contact(charge_map: ChargeMap, charge: Array, sigma: Array, start: Array) -> tuple[Array, Array]:
    """The contact that descent from a start leads to.

    Args:
        charge_map: What is known.
        charge: Shape (n, n_electrode), pC.
        sigma: The unit of distance, shape (n, n_electrode), pC.
        start: Contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        Contacts within the map's domain, shape (n, 3), and residuals (Q - Q(c)) / sigma, shape (n, n_electrode).
    """
    domain = charge_map.domain

    def residuals(rows: Integers, unit: Array) -> tuple[Array, Array]:
        known, slopes = linearised(charge_map, domain.to_contact(unit))
        by_unit = slopes * domain.scale / sigma[rows][:, :, None]
        return (charge[rows] - known) / sigma[rows], -by_unit.swapaxes(1, 2)

    unit, residual = minimise(residuals, domain.to_unit(start))
    return domain.to_contact(unit), residual


def search_contact(
    charge_map: ChargeMap, charge: Array, sigma: Array, starts: int = 2, candidates: int = CANDIDATES
) -> tuple[Array, Array]:
    """The nearest contact from the best few of many starts; arguments and result as `nearest_contact`."""
    spread = charge_map.domain.to_contact(_spread(candidates))
    known = charge_map.charges(spread)
    chunks = range(0, max(len(charge), 1), CHUNK)
    nearest = [_nearest_rows(charge[k : k + CHUNK], sigma[k : k + CHUNK], known, starts) for k in chunks]
    answers = [nearest_contact(charge_map, charge, sigma, spread[rows]) for rows in np.concatenate(nearest).T]
    squares = np.stack([(residual**2).sum(axis=1) for _, residual in answers])
    best = squares.argmin(axis=0), np.arange(len(charge))
    return np.stack([contact for contact, _ in answers])[best], np.stack([residual for _, residual in answers])[best]


def _spread(count: int) -> Array:
    """Contacts in unit coordinates, shape (count, 3)."""
    sobol = qmc.Sobol(3, scramble=False).random(count)
    radius, angle = np.sqrt(sobol[:, 0]), 2.0 * np.pi * sobol[:, 1]
    radius[::4] = 1.0
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 2.0 * sobol[:, 2] - 1.0], axis=1)


def _nearest_rows(charge: Array, sigma: Array, known: Array, count: int) -> Integers:
    """Numbers of the nearest candidates, shape (n, count): |Q - K|^2 multiplied out, one matrix product each."""
    weight = sigma**-2.0
    square = weight @ (known**2).T - 2.0 * (charge * weight) @ known.T
    rows: Integers = np.argpartition(square, count - 1, axis=1)[:, :count]
    return rows
