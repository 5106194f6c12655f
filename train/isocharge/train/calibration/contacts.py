"""Contacts of the presses of a calibration, adjusted to both the statements of the rig and the charges.

A rig measures the position and the force of a press with its own uncertainty, or does not measure one of them at all.
For a given film, the adjusted contact is the one with the smallest sum of squared residuals of charges and rig. These
residuals show how well the film explains the press.
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

CANDIDATE_POSITIONS = 300
"""Number of positions among which the start is chosen for a press of unknown position."""

MIN_CHANGE = 1e-5
"""Smallest change of the chi2 of a press, relative to 1 + chi2, for which the search of its contact continues."""


class AdjustedContacts(NamedTuple):
    """Contacts adjusted to one film.

    Attributes:
        contact: (x, y, ln F), shape (n, 3).
        residual: Residuals of charges and rig as in `PressData.residual`, shape (n, n_electrode + 3).
    """

    contact: Array
    residual: Array

    @property
    def chi2(self) -> Array:
        """Sum of squared residuals of each press, shape (n,)."""
        return np.asarray((self.residual**2).sum(axis=1))


def derivatives_with_adjusted_contacts(by_unknowns: Array, by_contact: Array) -> Array:
    """Return the derivatives of the residuals with respect to unknowns if the contacts are adjusted to every film.

    A small change of the unknowns moves the contact such that the sum of squares stays minimal. The part of the
    derivatives that the contact can compensate disappears (Golub and Pereyra 1973).

    Args:
        by_unknowns: Derivatives at fixed contacts, shape (n, n_electrode + 3, n_unknown).
        by_contact: Derivatives with respect to the contacts, shape (n, n_electrode + 3, 3).

    Returns:
        Shape (n, n_electrode + 3, n_unknown).
    """
    transposed = by_contact.swapaxes(1, 2)
    contact_change = np.linalg.solve(transposed @ by_contact, transposed @ by_unknowns)
    return np.asarray(by_unknowns - by_contact @ contact_change)


def with_force(contact: Array) -> Array:
    """Return contacts (x, y, ln F) as (x, y, F), shape (n, 3)."""
    return np.column_stack([contact[:, :2], np.exp(contact[:, 2])])


def adjust_contacts(charges: FilmCharges, unknowns: Array, data: PressData, start: Array) -> AdjustedContacts:
    """Return the contacts that fit the measured charges and the contacts stated by the rig best on one film.

    Args:
        charges: The films.
        unknowns: Unknowns of the film, as `FilmCharges.film` takes them.
        data: The presses.
        start: Contacts (x, y, ln F) at which the search begins, shape (n, 3).
    """
    layout = charges.layout
    domain = charges.domain
    films, shares = neighbouring_films(charges, unknowns, data)
    forward_maps = [charges.forward_map(film[layout.parameters]) for film in films]

    # The factor of imperfections and discrepancy changes slowly with the contact. It takes long to compute, so it is
    # approximated as linear about the start.
    start_factor = np.ones_like(data.charge)
    factor_slopes = np.zeros((*data.charge.shape, 3))
    if unknowns[layout.coefficients].any():
        factors = [_values_and_slopes(partial(charges.factor, film), with_force(start)) for film in films]
        start_factor, factor_slopes = _interpolated(factors, shares)

    def residuals(rows: Integers, scaled_contact: Array) -> tuple[Array, Array]:
        """Return the residuals of some presses, and their derivatives with respect to the scaled contact.

        Args:
            rows: Indices of the presses, shape (k,).
            scaled_contact: Contacts in which the domain is the unit disk times [-1, 1], shape (k, 3).

        Returns:
            Residuals, shape (k, n_electrode + 3), and derivatives, shape (k, 3, n_electrode + 3).
        """
        contact = scaled_contact * domain.scale + domain.centre
        displacement = (contact - start[rows])[:, None]
        factor = start_factor[rows] + (factor_slopes[rows] * displacement).sum(axis=2)
        on_films = [_values_and_slopes(forward_map.charges, with_force(contact)) for forward_map in forward_maps]
        charge, charge_slopes = _interpolated(on_films, shares[rows])
        product_slopes = factor[:, :, None] * charge_slopes + charge[:, :, None] * factor_slopes[rows]
        presses = data[rows]
        slopes = presses.residual_slopes(product_slopes) * domain.scale
        return presses.residual(factor * charge, contact), slopes.swapaxes(1, 2)

    scaled_start = (start - domain.centre) / domain.scale
    scaled_contact, residual = minimise(residuals, scaled_start, min_change=MIN_CHANGE)
    return AdjustedContacts(scaled_contact * domain.scale + domain.centre, residual)


def neighbouring_films(charges: FilmCharges, unknowns: Array, data: PressData) -> tuple[list[Array], Array]:
    """Return films of different pretensions, between which the film under each press is interpolated.

    The pretension may differ from press to press, for example with the temperature.

    Args:
        charges: The films.
        unknowns: Unknowns of the film.
        data: The presses.

    Returns:
        The unknowns of k films, and their weights in each press, shape (n, k).
    """
    pretension = charges.layout.parameter("pretension")
    lower, upper = charges.prior.bounds
    bounds = float(lower[pretension]), float(upper[pretension])
    nodes, shares = data.pretension_nodes(float(unknowns[pretension]), bounds)
    films = []
    for node in nodes:
        film = unknowns.copy()
        film[pretension] = node
        films.append(film)
    return films, shares


def _interpolated(on_films: list[tuple[Array, Array]], shares: Array) -> tuple[Array, Array]:
    """Return values and derivatives of presses, interpolated between neighbouring films.

    Args:
        on_films: Values and derivatives on each of k films.
        shares: Weight of each film in each press, shape (n, k).
    """
    values = weighted_sum([value for value, _ in on_films], shares)
    slopes = weighted_sum([slope for _, slope in on_films], shares)
    return values, slopes


def weighted_sum(arrays: Sequence[Array], shares: Array) -> Array:
    """Return the sum of k arrays of shape (n, ...), row by row multiplied by their shares, shape (n, k)."""
    total = np.zeros_like(arrays[0])
    for array, share in zip(arrays, shares.T, strict=True):
        total = total + array * share.reshape(-1, *(1,) * (array.ndim - 1))
    return total


def _values_and_slopes(function: Callable[[Array], Array], contact: Array) -> tuple[Array, Array]:
    """Return values and derivatives of a function of the contact, by one-sided differences.

    Args:
        function: Function of contacts (x, y, F), shape (n, 3), that returns an array of shape (n, n_electrode).
        contact: Contacts (x, y, F), shape (n, 3).

    Returns:
        The values, shape (n, n_electrode), and the derivatives with respect to (x, y, ln F), shape (n, n_electrode, 3).
    """
    x_step, y_step, log_force_step = CONTACT_STEPS
    # One call for the contacts and for the three displaced copies of them.
    displaced = np.repeat(contact[None], 4, axis=0)
    displaced[1, :, 0] += x_step
    displaced[2, :, 1] += y_step
    displaced[3, :, 2] *= np.exp(log_force_step)
    value, value_x, value_y, value_force = function(displaced.reshape(-1, 3)).reshape(4, len(contact), -1)
    slopes = [
        (value_x - value) / x_step,
        (value_y - value) / y_step,
        (value_force - value) / log_force_step,
    ]
    return value, np.stack(slopes, axis=2)


def start_contacts(charges: FilmCharges, unknowns: Array, data: PressData) -> Array:
    """Return the contacts (x, y, ln F) at which the search begins, shape (n, 3).

    A press starts at the contact that the rig states. If its position is unknown, it starts at the position among
    `CANDIDATE_POSITIONS` at which the ratios of its charges are closest to those of the film. These ratios hardly
    depend on the stiffness and on the coefficients of the film, which are not known yet.

    Args:
        charges: The films.
        unknowns: Unknowns of the film.
        data: The presses.
    """
    start = data.contact.copy()
    is_position_unknown = ~data.has_place
    if not is_position_unknown.any():
        return start

    lattice = charges.domain.radius * sunflower(CANDIDATE_POSITIONS)
    force = np.exp(np.median(data.contact[is_position_unknown, 2]))
    candidates = np.column_stack([lattice.real, lattice.imag, np.full(CANDIDATE_POSITIONS, force)])
    log_charge = np.log(np.maximum(data.charge[is_position_unknown], 1.0))
    log_measured = np.where(data.has_charge[is_position_unknown], log_charge, np.nan)
    # The ratios agree if the logarithms of measured and computed charges differ by the same amount on all electrodes.
    log_quotient = log_measured[:, None] - np.log(charges.charges(unknowns, candidates))
    closest = np.nanvar(log_quotient, axis=2).argmin(axis=1)
    start[is_position_unknown, :2] = candidates[closest, :2]
    return start
