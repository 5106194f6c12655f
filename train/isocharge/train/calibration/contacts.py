"""Where the presses of a calibration really were: each contact adjusted between what the rig and the charges say.

A rig knows place and force of a press to its own uncertainty, or one of them not at all. For a given film the contact
is the one that fits charges and rig best; the residuals of both speak about the film.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.numerics.disk import sunflower
from isocharge.simulate.numerics.disk_least_squares import minimise
from isocharge.train.calibration.film_charges import CONTACT_STEPS, FilmCharges
from isocharge.train.calibration.press_data import PressData

PLACES = 300
"""Places among which the start of a press is chosen whose place is not known."""

LEAST_CHANGE = 1e-5
"""Least change of a press's chi2 that is worth another step of its contact, relative to 1 + chi2."""


class AdjustedContacts(NamedTuple):
    """Contacts adjusted to one film.

    Attributes:
        contact: (x, y, ln F), shape (n, 3).
        residual: As `PressData.residual`, shape (n, n_electrode + 3).
    """

    contact: Array
    residual: Array

    @property
    def chi2(self) -> Array:
        """Sum of squared residuals of each press, shape (n,)."""
        return np.asarray((self.residual**2).sum(axis=1))


def projected(parameter_slopes: Array, contact_slopes: Array) -> Array:
    """Return the derivatives of the residual by parameters once the contacts follow them (Golub and Pereyra 1973).

    Args:
        parameter_slopes: Derivatives at fixed contacts, shape (n, n_electrode + 3, n_parameter).
        contact_slopes: Derivatives by the contacts, shape (n, n_electrode + 3, 3).
    """
    normal = np.einsum("nki,nkj->nij", contact_slopes, contact_slopes)
    contact_change = np.linalg.solve(normal, np.einsum("nki,nkp->nip", contact_slopes, parameter_slopes))
    return np.asarray(parameter_slopes - np.einsum("nki,nip->nkp", contact_slopes, contact_change))


def with_force(contact: Array) -> Array:
    """Return (x, y, F) of contacts (x, y, ln F), shape (n, 3)."""
    return np.column_stack([contact[:, :2], np.exp(contact[:, 2])])


def adjust_contacts(charges: FilmCharges, unknowns: Array, data: PressData, start: Array) -> AdjustedContacts:
    """Return the contacts that fit charges and rig best on one film.

    Args:
        charges: The films.
        unknowns: The film, as `FilmCharges.film` takes it.
        data: The presses.
        start: Contacts (x, y, ln F), shape (n, 3).
    """
    layout = charges.layout
    domain = charges.domain
    films, shares = neighbouring_films(charges, unknowns, data)
    maps = [charges.forward_map(film[layout.parameters]) for film in films]
    factor = np.ones_like(data.charge)
    factor_slopes = np.zeros((*data.charge.shape, 3))
    if unknowns[layout.coefficients].any():  # what a film has besides is smooth, so it is linear about the start
        parts = [_linearised(partial(charges.factor, film), with_force(start)) for film in films]
        factor, factor_slopes = _interpolated(parts, shares)

    def residuals(rows: Integers, unit: Array) -> tuple[Array, Array]:
        contact = unit * domain.scale + domain.centre
        presses = data[rows]
        change = (contact - start[rows])[:, None]
        row_factor = factor[rows] + (factor_slopes[rows] * change).sum(axis=2)
        parts = [_linearised(forward_map.charges, with_force(contact)) for forward_map in maps]
        charge, by_contact = _interpolated(parts, shares[rows])
        charge_slopes = row_factor[:, :, None] * by_contact + charge[:, :, None] * factor_slopes[rows]
        slopes = presses.residual_slopes(charge_slopes)
        return presses.residual(row_factor * charge, contact), (slopes * domain.scale).swapaxes(1, 2)

    unit, residual = minimise(residuals, (start - domain.centre) / domain.scale, min_change=LEAST_CHANGE)
    return AdjustedContacts(unit * domain.scale + domain.centre, residual)


def neighbouring_films(charges: FilmCharges, unknowns: Array, data: PressData) -> tuple[list[Array], Array]:
    """Return films of other pretensions between which every press lies, and the weight of each, shape (n, k)."""
    pretension = charges.layout.parameter("pretension")
    low, high = charges.prior.bounds
    bounds = float(low[pretension]), float(high[pretension])
    nodes, shares = data.pretension_nodes(float(unknowns[pretension]), bounds)
    films = []
    for node in nodes:
        film = unknowns.copy()
        film[pretension] = node
        films.append(film)
    return films, shares


def _interpolated(parts: list[tuple[Array, Array]], shares: Array) -> tuple[Array, Array]:
    """Return values and derivatives of presses on their own films, from those on the neighbouring films."""
    values = weighted_sum([value for value, _ in parts], shares)
    slopes = weighted_sum([slope for _, slope in parts], shares)
    return values, slopes


def weighted_sum(parts: Sequence[Array], shares: Array) -> Array:
    """Return the sum of arrays of shape (n, ...), each times its column of shares, shape (n, k)."""
    total = np.zeros_like(parts[0])
    for part, share in zip(parts, shares.T, strict=True):
        total = total + part * share.reshape(-1, *(1,) * (part.ndim - 1))
    return total


def _linearised(function: Callable[[Array], Array], contact: Array) -> tuple[Array, Array]:
    """Return values at contacts (x, y, F), and derivatives by (x, y, ln F).

    One-sided differences are enough for a search.
    """
    x_step, y_step, log_force_step = CONTACT_STEPS
    stepped = contact + np.zeros((4, 1, 1))
    stepped[1, :, 0] += x_step
    stepped[2, :, 1] += y_step
    stepped[3, :, 2] *= np.exp(log_force_step)
    at_contact, at_x, at_y, at_force = function(stepped.reshape(-1, 3)).reshape(4, len(contact), -1)
    slopes = [
        (at_x - at_contact) / x_step,
        (at_y - at_contact) / y_step,
        (at_force - at_contact) / log_force_step,
    ]
    return at_contact, np.stack(slopes, axis=2)


def search_places(charges: FilmCharges, unknowns: Array, data: PressData) -> Array:
    """Return where to start the search of the contacts: (x, y, ln F), shape (n, 3).

    A place that was not measured starts where the ratios of the charges are nearest to those of the film. Ratios hardly
    depend on the film's stiffness and coefficients, which are not known yet.
    """
    start = data.contact.copy()
    unknown_place = ~data.has_place
    if unknown_place.any():
        lattice = charges.domain.radius * sunflower(PLACES)
        force = np.exp(np.median(data.contact[unknown_place, 2]))
        candidates = np.column_stack([lattice.real, lattice.imag, np.full(PLACES, force)])
        log_charge = np.log(np.maximum(data.charge[unknown_place], 1.0))
        log_measured = np.where(data.has_charge[unknown_place], log_charge, np.nan)
        log_ratio = log_measured[:, None] - np.log(charges.charges(unknowns, candidates))
        nearest = np.nanvar(log_ratio, axis=2).argmin(axis=1)
        start[unknown_place, :2] = candidates[nearest, :2]
    return start
