"""Contacts of the presses of a calibration, adjusted to both the measurements of the rig and the charges.

A rig measures the position and the force of a press with some uncertainty, or does not measure one of them at all. For
a given film, the adjusted contact minimises the sum of the squared residuals. Each measured charge and each measurement
of the rig has a residual. These residuals show how well the film explains the press.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.simulate import Domain, ForwardMap
from isocharge.simulate.numerics.disk import sunflower
from isocharge.simulate.numerics.disk_least_squares import minimise
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_maps import CONTACT_STEPS
from isocharge.train.calibration.press_data import PressData

CANDIDATE_POSITIONS = 300
"""Number of positions among which the start is chosen for a press of unknown position."""

MIN_CHANGE = 1e-5
"""Smallest change of chi2 for which the search for the contact of a press continues, relative to 1 + chi2."""


class AdjustedContacts(NamedTuple):
    """Contacts adjusted to one film.

    Attributes:
        contact: Contacts (x, y, ln F), shape (n, 3).
        residual: Residuals of charges and rig as in `PressData.residual`, shape (n, n_electrode + 3).
    """

    contact: Array
    residual: Array

    @property
    def chi2(self) -> Array:
        """Sum of squared residuals of each press, shape (n,)."""
        return np.asarray((self.residual**2).sum(axis=1))


def derivatives_with_adjusted_contacts(by_unknowns: Array, by_contact: Array) -> Array:
    """Compute the derivatives of the residuals if the contacts are adjusted again after each change of the unknowns.

    A small change of the unknowns moves the adjusted contact, so that the sum of squared residuals stays minimal. The
    part of the derivatives that this movement compensates is subtracted (Golub and Pereyra 1973).

    Args:
        by_unknowns: Derivatives at fixed contacts, shape (n, n_electrode + 3, n_unknown).
        by_contact: Derivatives with respect to the contacts, shape (n, n_electrode + 3, 3).

    Returns:
        Derivatives of the residuals, shape (n, n_electrode + 3, n_unknown).
    """
    # Least-squares solution for the movement of the contact with each unknown, by the normal equations
    transposed = by_contact.swapaxes(1, 2)
    contact_change = np.linalg.solve(transposed @ by_contact, transposed @ by_unknowns)
    return np.asarray(by_unknowns - by_contact @ contact_change)


def with_force(contact: Array) -> Array:
    """Return contacts (x, y, ln F) as (x, y, F), shape (n, 3)."""
    return np.column_stack([contact[:, :2], np.exp(contact[:, 2])])


def adjust_contacts(charges: FilmCharges, unknowns: Array, data: PressData, start: Array) -> AdjustedContacts:
    """Find the contacts that agree best with both the measured charges and the contacts measured by the rig.

    The sum of squared residuals of each press is minimised over its contact (x, y, ln F). The search uses scaled
    contacts, in which the domain is the unit disk times [-1, 1].

    Args:
        charges: The films.
        unknowns: Unknowns of the film under the presses, as `FilmCharges.film` takes them.
        data: The presses.
        start: Contacts (x, y, ln F) at which the search begins, shape (n, 3).
    """
    residuals = _ContactResiduals.of(charges, unknowns, data, start)
    domain = charges.domain
    scaled_start = (start - domain.centre) / domain.scale
    scaled_contact, residual = minimise(residuals.at, scaled_start, min_change=MIN_CHANGE)
    return AdjustedContacts(scaled_contact * domain.scale + domain.centre, residual)


class _ContactResiduals(NamedTuple):
    """Residuals of presses on one film as a function of the contacts, in the form that `minimise` expects.

    The charge of a press is interpolated between films with neighbouring pretensions. It is the product of the charge
    without coefficients and of a factor by the coefficients (imperfections and discrepancy). The factor changes slowly
    with the contact and takes long to compute, so it is approximated as a linear function of the contact.

    Attributes:
        domain: Contacts for which the films have charges.
        data: The presses.
        forward_maps: Forward map of each of k films, between which the charges are interpolated.
        film_weights: Weight of each film in each press, shape (n, k).
        start: Contacts (x, y, ln F) about which the factor is linear, shape (n, 3).
        start_factor: Factors at these contacts, shape (n, n_electrode).
        factor_slopes: Derivatives of the factors with respect to (x, y, ln F), shape (n, n_electrode, 3).
    """

    domain: Domain
    data: PressData
    forward_maps: list[ForwardMap]
    film_weights: Array
    start: Array
    start_factor: Array
    factor_slopes: Array

    @classmethod
    def of(cls, charges: FilmCharges, unknowns: Array, data: PressData, start: Array) -> "_ContactResiduals":
        """Compute everything that does not depend on the contacts of the search.

        Args:
            charges: The films.
            unknowns: Unknowns of the film under the presses, as `FilmCharges.film` takes them.
            data: The presses.
            start: Contacts (x, y, ln F) at which the search begins, shape (n, 3).
        """
        layout = charges.layout
        films, film_weights = neighbouring_films(charges, unknowns, data)
        forward_maps = [charges.forward_map(film[layout.parameters]) for film in films]
        start_factor = np.ones_like(data.charge)
        factor_slopes = np.zeros((*data.charge.shape, 3))
        if unknowns[layout.coefficients].any():  # without coefficients, the factor is 1
            film_factors = [_values_and_slopes(partial(charges.factor, film), with_force(start)) for film in films]
            start_factor, factor_slopes = _interpolated(film_factors, film_weights)
        return cls(
            domain=charges.domain,
            data=data,
            forward_maps=forward_maps,
            film_weights=film_weights,
            start=start,
            start_factor=start_factor,
            factor_slopes=factor_slopes,
        )

    def at(self, rows: Integers, scaled_contact: Array) -> tuple[Array, Array]:
        """Compute the residuals of some presses, and their derivatives with respect to the scaled contact.

        Args:
            rows: Indices of the presses, shape (k,).
            scaled_contact: Contacts in which the domain is the unit disk times [-1, 1], shape (k, 3).

        Returns:
            Residuals, shape (k, n_electrode + 3), and derivatives, shape (k, 3, n_electrode + 3).
        """
        contact = scaled_contact * self.domain.scale + self.domain.centre  # (x, y, ln F)
        film_charges = [
            _values_and_slopes(forward_map.charges, with_force(contact)) for forward_map in self.forward_maps
        ]
        charge, charge_slopes = _interpolated(film_charges, self.film_weights[rows])

        # Linear approximation of the factor about the start
        factor_slopes = self.factor_slopes[rows]  # shape (k, n_electrode, 3)
        displacement = (contact - self.start[rows])[:, None]  # shape (k, 1, 3)
        factor = self.start_factor[rows] + (factor_slopes * displacement).sum(axis=2)

        # Derivatives of factor * charge by the product rule, shape (k, n_electrode, 3)
        product_slopes = factor[:, :, None] * charge_slopes + charge[:, :, None] * factor_slopes
        presses = self.data[rows]
        residual_slopes = presses.residual_slopes(product_slopes) * self.domain.scale  # per unit of the scaled contact
        return presses.residual(factor * charge, contact), residual_slopes.swapaxes(1, 2)


def neighbouring_films(charges: FilmCharges, unknowns: Array, data: PressData) -> tuple[list[Array], Array]:
    """Return films with different pretensions, between which the charges of each press are interpolated.

    The pretension of the film may differ from press to press, for example because of the temperature. The returned
    films are copies of the given film that differ only in their pretension.

    Args:
        charges: The films.
        unknowns: Unknowns of the film.
        data: The presses, with the change of the pretension during each press.

    Returns:
        The unknowns of k films, and their weights in each press, shape (n, k).
    """
    pretension = charges.layout.parameter("pretension")  # index in the vector of unknowns
    lower, upper = charges.prior.bounds
    pretension_bounds = float(lower[pretension]), float(upper[pretension])
    node_pretensions, film_weights = data.pretension_nodes(float(unknowns[pretension]), pretension_bounds)

    films = []
    for node_pretension in node_pretensions:
        film = unknowns.copy()
        film[pretension] = node_pretension
        films.append(film)
    return films, film_weights


def _interpolated(film_values_and_slopes: list[tuple[Array, Array]], film_weights: Array) -> tuple[Array, Array]:
    """Interpolate the values and derivatives at presses between neighbouring films.

    Args:
        film_values_and_slopes: Values and derivatives on each of k films, as `_values_and_slopes` returns them.
        film_weights: Weight of each film in each press, shape (n, k).

    Returns:
        Interpolated values, shape (n, n_electrode), and interpolated derivatives, shape (n, n_electrode, 3).
    """
    values = weighted_sum([film_values for film_values, _ in film_values_and_slopes], film_weights)
    slopes = weighted_sum([film_slopes for _, film_slopes in film_values_and_slopes], film_weights)
    return values, slopes


def weighted_sum(arrays: Sequence[Array], weights: Array) -> Array:
    """Return the weighted sum of arrays, with different weights for each row.

    Args:
        arrays: The k arrays, each of shape (n, ...).
        weights: Weight of each array in each row, shape (n, k).

    Returns:
        The sum, shape (n, ...).
    """
    total = np.zeros_like(arrays[0])
    for array, row_weights in zip(arrays, weights.T, strict=True):
        # The weights of the rows get axes of length 1, so that they are broadcast over the other axes of the array.
        trailing_axes = tuple(range(1, array.ndim))
        total = total + array * np.expand_dims(row_weights, trailing_axes)
    return total


def _values_and_slopes(function: Callable[[Array], Array], contact: Array) -> tuple[Array, Array]:
    """Compute a function of the contact, and its derivatives by one-sided differences.

    Args:
        function: Function of contacts (x, y, F), shape (n, 3), that returns an array of shape (n, n_electrode).
        contact: Contacts (x, y, F), shape (n, 3).

    Returns:
        Values, shape (n, n_electrode). Derivatives with respect to (x, y, ln F), shape (n, n_electrode, 3).
    """
    x_step, y_step, log_force_step = CONTACT_STEPS
    # One call for the contacts and for the three displaced copies of them, because this is faster than four calls.
    displaced = np.repeat(contact[None], 4, axis=0)
    displaced[1, :, 0] += x_step
    displaced[2, :, 1] += y_step
    displaced[3, :, 2] *= np.exp(log_force_step)
    displaced_values = function(displaced.reshape(-1, 3)).reshape(4, len(contact), -1)
    value, value_x, value_y, value_force = displaced_values
    slopes = [
        (value_x - value) / x_step,
        (value_y - value) / y_step,
        (value_force - value) / log_force_step,
    ]
    return value, np.stack(slopes, axis=2)


def start_contacts(charges: FilmCharges, unknowns: Array, data: PressData) -> Array:
    """Return the initial contacts of the search for the adjusted contacts.

    The search begins at the contact that the rig measured. If the position of a press is unknown, it begins at the
    position where the ratios between the charges of the film are most similar to the measured ratios.

    Args:
        charges: The films.
        unknowns: Unknowns of the film.
        data: The presses.

    Returns:
        Contacts (x, y, ln F), shape (n, 3).
    """
    start = data.contact.copy()
    is_position_unknown = ~data.has_place
    if is_position_unknown.any():
        start[is_position_unknown, :2] = _most_similar_positions(charges, unknowns, data[is_position_unknown])
    return start


def _most_similar_positions(charges: FilmCharges, unknowns: Array, data: PressData) -> Array:
    """Find the positions where the ratios between the charges of a film are most similar to the measured ratios.

    For each press, `CANDIDATE_POSITIONS` positions are compared. Ratios are used because they hardly depend on the
    stiffness and on the coefficients of the film, which are not known yet.

    Args:
        charges: The films.
        unknowns: Unknowns of the film.
        data: The presses.

    Returns:
        Positions (x, y), shape (n, 2), mm.
    """
    # Candidates (x, y, F) with a typical force, from positions x + i y that are distributed evenly over the domain
    complex_positions = charges.domain.radius * sunflower(CANDIDATE_POSITIONS)
    typical_force = np.exp(np.median(data.contact[:, 2]))
    forces = np.full(CANDIDATE_POSITIONS, typical_force)
    candidates = np.column_stack([complex_positions.real, complex_positions.imag, forces])
    log_computed = np.log(charges.charges(unknowns, candidates))  # shape (n_candidate, n_electrode)

    log_charge = np.log(np.maximum(data.charge, 1.0))  # limited to at least 1 pC, because charges may be negative
    log_measured = np.where(data.has_charge, log_charge, np.nan)

    # The ratios agree if the logarithms of measured and computed charges differ by the same amount on all electrodes,
    # so that the variance of these differences is zero.
    log_quotient = log_measured[:, None] - log_computed  # shape (n, n_candidate, n_electrode)
    most_similar = np.nanvar(log_quotient, axis=2).argmin(axis=1)
    return candidates[most_similar, :2]
