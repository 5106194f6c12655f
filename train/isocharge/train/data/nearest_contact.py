"""The known contact nearest to any charges: what the misfit measures, searched for on the fitted forward map.

min over contacts c of the domain of |(Q - Q(c)) / sigma|,   sigma of the measured charges Q.
"""

from typing import Protocol

import numpy as np
from scipy.stats import qmc

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk_least_squares import minimise
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.noise import sigma_pC

CANDIDATES = 4096
"""Contacts among which starts are chosen: spread over the domain, and a quarter as many along its rim."""

CHUNK = 2048
"""Charges compared with all candidates at once."""


class NearestField(Protocol):
    """The forward map that is searched: a `ChargeField`, or another with the same two members."""

    @property
    def domain(self) -> ContactDomain:
        """Where contacts are searched for."""

    def log_charge(self, unit: Array) -> Array:
        """ln Q and its derivatives by the unit coordinates: contacts (n, 3) in them to (n, 4, n_electrode)."""


def nearest_in_field(
    field: NearestField, charge_pC: Array, noise: NoiseModel, start: Array, shift: Array | None = None
) -> tuple[Array, Array]:
    """The contact that descent from a start leads to.

    Args:
        field: The forward map.
        charge_pC: Charges, shape (n, n_electrode), pC.
        noise: For the unit of distance.
        start: Contacts in unit coordinates, shape (n, 3).
        shift: Added to ln Q of the field, shape (n, n_electrode): what a press's own charges are away from it.

    Returns:
        Unit coordinates (n, 3) and (Q - Q(c)) / sigma, (n, n_electrode).
    """
    sigma = sigma_pC(noise, charge_pC)
    shift = np.zeros_like(charge_pC) if shift is None else shift

    def residuals(rows: Integers, unit: Array) -> tuple[Array, Array]:
        logs = field.log_charge(unit)
        relative = np.exp(logs[:, 0] + shift[rows]) / sigma[rows]
        return charge_pC[rows] / sigma[rows] - relative, -relative[:, None, :] * logs[:, 1:]

    return minimise(residuals, start)


def search_field(
    field: NearestField, charge_pC: Array, noise: NoiseModel, starts: int = 2, candidates: int = CANDIDATES
) -> tuple[Array, Array]:
    """The nearest contact from the best few of many starts; arguments and result as `nearest_in_field`."""
    spread = _spread(candidates)
    charges = np.exp(field.log_charge(spread)[:, 0])
    nearest = np.concatenate([_nearest_rows(some, charges, noise, starts) for some in _chunks(charge_pC)])
    answers = [nearest_in_field(field, charge_pC, noise, spread[rows]) for rows in nearest.T]
    squares = np.stack([(miss**2).sum(axis=1) for _, miss in answers])
    best = squares.argmin(axis=0), np.arange(len(charge_pC))
    return np.stack([unit for unit, _ in answers])[best], np.stack([miss for _, miss in answers])[best]


def _chunks(charge_pC: Array) -> list[Array]:
    return np.array_split(charge_pC, len(charge_pC) // CHUNK + 1)


def _spread(count: int) -> Array:
    """Contacts in unit coordinates, shape (count, 3)."""
    sobol = qmc.Sobol(3, scramble=False).random(count)
    radius, angle = np.sqrt(sobol[:, 0]), 2.0 * np.pi * sobol[:, 1]
    radius[::4] = 1.0
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 2.0 * sobol[:, 2] - 1.0], axis=1)


def _nearest_rows(charge_pC: Array, known_pC: Array, noise: NoiseModel, count: int) -> Integers:
    """Numbers of the nearest candidates, shape (n, count): |Q - K|^2 multiplied out, one matrix product each."""
    weight = sigma_pC(noise, charge_pC) ** -2
    square = weight @ (known_pC**2).T - 2.0 * (charge_pC * weight) @ known_pC.T
    rows: Integers = np.argpartition(square, count - 1, axis=1)[:, :count]
    return rows
