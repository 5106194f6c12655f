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


def projected(by_parameter: Array, slopes: Array) -> Array:
    """Derivatives of the residual by the parameters once the contacts follow them (Golub and Pereyra 1973).

    Args:
        by_parameter: Derivatives at fixed contacts, shape (n, n_electrode + 3, n_parameter).
        slopes: Derivatives by the contacts, shape (n, n_electrode + 3, 3).
    """
    normal = np.einsum("nki,nkj->nij", slopes, slopes)
    moved = np.linalg.solve(normal, np.einsum("nki,nkp->nip", slopes, by_parameter))
    return np.asarray(by_parameter - np.einsum("nki,nip->nkp", slopes, moved))


def with_force(contact: Array) -> Array:
    """(x, y, ln F), shape (n, 3), to (x, y, F)."""
    return np.column_stack([contact[:, :2], np.exp(contact[:, 2])])


def adjust_contacts(charges: FilmCharges, parameters: Array, data: PressData, start: Array) -> AdjustedContacts:
    """The contacts that fit charges and rig best on one film.

    Args:
        charges: The films.
        parameters: The film, as `FilmCharges.film` takes it.
        data: The presses.
        start: Contacts (x, y, ln F), shape (n, 3).
    """
    count, domain, begin = len(charges.prior.names), charges.domain, with_force(start)
    films, shares = films_of(charges, parameters, data)
    maps = [charges.forward_map(film[:count]) for film in films]
    factor, steeper = np.ones_like(data.charge), np.zeros((*data.charge.shape, 3))
    if parameters[count:].any():  # what a film has besides its parameters is smooth: linear about the start
        factor, steeper = _between([_linearised(partial(charges.factor, film), begin) for film in films], shares)

    def residuals(rows: Integers, unit: Array) -> tuple[Array, Array]:
        contact, presses = unit * domain.scale + domain.centre, data[rows]
        at, change = with_force(contact), (contact - start[rows])[:, None]
        share = factor[rows] + (steeper[rows] * change).sum(axis=2)
        charge, by_contact = _between([_linearised(forward_map.charges, at) for forward_map in maps], shares[rows])
        slopes = presses.slopes(share[:, :, None] * by_contact + charge[:, :, None] * steeper[rows])
        return presses.residual(share * charge, contact), (slopes * domain.scale).swapaxes(1, 2)

    unit, residual = minimise(residuals, (start - domain.centre) / domain.scale, least=LEAST_CHANGE)
    return AdjustedContacts(unit * domain.scale + domain.centre, residual)


def films_of(charges: FilmCharges, parameters: Array, data: PressData) -> tuple[list[Array], Array]:
    """The films of other pretensions between which every press is, and the shares of each, shape (n, k)."""
    low, high = charges.prior.bounds
    nodes, shares = data.of_films(float(parameters[0]), (float(low[0]), float(high[0])))
    return [np.append(node, parameters[1:]) for node in nodes], shares


def _between(of_films: list[tuple[Array, Array]], shares: Array) -> tuple[Array, Array]:
    """Values (n, n_electrode) and derivatives of presses on their own films from those on the films beside them."""
    values, slopes = (sum_over(parts, shares) for parts in zip(*of_films, strict=True))
    return values, slopes


def sum_over(of_films: Sequence[Array], shares: Array) -> Array:
    """Weighted sum of arrays (n, ...) with shares (n, k)."""
    weighted = (
        part * share.reshape(-1, *(1,) * (part.ndim - 1)) for part, share in zip(of_films, shares.T, strict=True)
    )
    return np.asarray(sum(weighted))


def _linearised(function: Callable[[Array], Array], contact: Array) -> tuple[Array, Array]:
    """Values at contacts (x, y, F) and derivatives by (x, y, ln F): one-sided differences are enough for a search."""
    moved = contact + np.zeros((4, 1, 1))
    moved[1, :, 0] += CONTACT_STEPS[0]
    moved[2, :, 1] += CONTACT_STEPS[1]
    moved[3, :, 2] *= np.exp(CONTACT_STEPS[2])
    values = function(moved.reshape(-1, 3)).reshape(4, len(contact), -1)
    return values[0], np.stack([(values[i + 1] - values[0]) / CONTACT_STEPS[i] for i in range(3)], axis=2)


def search_places(charges: FilmCharges, parameters: Array, data: PressData) -> Array:
    """Where to start: (x, y, ln F), shape (n, 3); the place whose ratios of charges are nearest where unknown.

    Ratios hardly depend on the film's stiffness and coefficients, which are not known yet.
    """
    start, unknown = data.contact.copy(), ~data.known[:, -3:-1].all(axis=1)
    if unknown.any():
        lattice = charges.domain.radius * sunflower(PLACES)
        force = np.exp(np.median(data.contact[unknown, 2]))
        at = np.column_stack([lattice.real, lattice.imag, np.full(PLACES, force)])
        measured = np.where(data.known[unknown, :-3], np.log(np.maximum(data.charge[unknown], 1.0)), np.nan)
        logs = measured[:, None] - np.log(charges.charges(parameters, at))
        start[unknown, :2] = at[np.nanvar(logs, axis=2).argmin(axis=1), :2]
    return start
