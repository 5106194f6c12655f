"""Adjustment of the contacts of presses to measured charges and to measurements of the rig.

A rig measures the position and the force of a press with some uncertainty. The position or the force may also be
unknown. Each measured charge and each measurement of the rig has one residual. The residuals depend on the
contact and on the film. For a given film, the adjusted contact of a press is the contact with the smallest sum of
squared residuals. The residuals at the adjusted contact show how well the film explains the press.
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
"""Number of positions that are compared in order to choose the starts of the searches for an unknown position."""

UNKNOWN_POSITION_STARTS = 3
"""Number of searches for the contact of a press with an unknown position. The best result is used."""

START_DISTANCE = 0.15
"""Smallest distance between the starts of two searches for the same contact, relative to the radius of the domain."""

MIN_CHANGE = 1e-5
"""Smallest change of chi2, relative to 1 + chi2, for which the search for the contact of a press continues."""

MAX_SEARCHES = 5
"""Largest number of successive searches for the contact of a press.

Each search approximates the effect of imperfections by a linear function of the contact. The function is linearised
about the result of the previous search."""

LINEAR_DISTANCE = 0.02
"""Largest distance of a contact from the start of a search at which the linear function is accurate.

It is the largest difference of a coordinate, in the scaled coordinates of the domain."""


class AdjustedContacts(NamedTuple):
    """Contacts of presses after the adjustment to one film.

    Attributes:
        contact: Contacts (x, y, ln F), shape (n, 3).
        residual: Residuals of the charges and of the rig, as `PressData.residual` returns them, shape (n, n_electrode +
            3).
    """

    contact: Array
    residual: Array

    @property
    def chi2(self) -> Array:
        """Sum of squared residuals of each press, shape (n,)."""
        return np.asarray((self.residual**2).sum(axis=1))


def derivatives_with_adjusted_contacts(unknown_slopes: Array, contact_slopes: Array) -> Array:
    """Compute derivatives of residuals with respect to the unknowns, including the effect of adjusted contacts.

    If the unknowns change slightly, the adjusted contact moves to the new minimum of the sum of squared residuals. This
    movement compensates a part of the change of the residuals. Therefore, the compensated part of the derivatives is
    subtracted (variable projection, Golub and Pereyra 1973).

    Args:
        unknown_slopes: Derivatives of the residuals with respect to the unknowns at fixed contacts, shape (n,
            n_residual, n_unknown).
        contact_slopes: Derivatives of the residuals with respect to the contact, shape (n, n_residual, 3).

    Returns:
        Derivatives of the residuals with respect to the unknowns, shape (n, n_residual, n_unknown).
    """
    # The normal equations give the least-squares solution of contact_slopes @ contact_change = unknown_slopes. If an
    # unknown increases by one unit, the adjusted contact moves by minus `contact_change`, shape (n, 3, n_unknown).
    transposed_slopes = contact_slopes.swapaxes(1, 2)
    contact_change = np.linalg.solve(transposed_slopes @ contact_slopes, transposed_slopes @ unknown_slopes)
    return np.asarray(unknown_slopes - contact_slopes @ contact_change)


def from_log_contact(log_contact: Array) -> Array:
    """Convert contacts (x, y, ln F) into contacts (x, y, F), shape (n, 3)."""
    return np.column_stack([log_contact[:, :2], np.exp(log_contact[:, 2])])


def best_adjusted_contacts(charges: FilmCharges, unknowns: Array, data: PressData) -> AdjustedContacts:
    """Find the contacts that agree best with the measurements, by searches from all starts of `start_contacts`.

    For each press, the result of the search with the smallest sum of squared residuals is used.

    Args:
        charges: Model of the charges of all films.
        unknowns: Unknowns of the pressed film, as `FilmCharges.film` expects them.
        data: The measured presses.
    """
    first_start, *other_starts = start_contacts(charges, unknowns, data)
    best = adjust_contacts(charges, unknowns, data, first_start)
    for start in other_starts:
        other = adjust_contacts(charges, unknowns, data, start)
        is_better = (other.chi2 < best.chi2)[:, None]  # for each press
        contact = np.where(is_better, other.contact, best.contact)
        residual = np.where(is_better, other.residual, best.residual)
        best = AdjustedContacts(contact, residual)
    return best


def adjust_contacts(charges: FilmCharges, unknowns: Array, data: PressData, start: Array) -> AdjustedContacts:
    """Find the contacts that agree best with the measured charges and with the measurements of the rig.

    For each press, the sum of the squared residuals is minimised over the contact (x, y, ln F). The search uses scaled
    coordinates. In these coordinates, the positions of the domain fill the unit disk, and ln F lies in [-1, 1].

    The effect of imperfections on the charges is approximated by a linear function about the start of the search. If
    the film has imperfections and a search ends far from its start, the search is repeated from the contact that was
    found. There are at most `MAX_SEARCHES` searches.

    Args:
        charges: Model of the charges of all films.
        unknowns: Unknowns of the pressed film, as `FilmCharges.film` expects them.
        data: The measured presses.
        start: Contacts (x, y, ln F) at which the search begins, shape (n, 3).
    """
    domain = charges.domain
    scaled_contact = (start - domain.centre) / domain.scale
    residual = np.empty(data.measured.shape)
    # Without imperfections, nothing is linearised, and a single search suffices.
    has_imperfections = bool(unknowns[charges.layout.coefficients].any())
    max_searches = MAX_SEARCHES if has_imperfections else 1
    rows = np.arange(len(data))  # the presses whose contacts are searched for
    for _ in range(max_searches):
        scaled_start = scaled_contact[rows]
        search_start = scaled_start * domain.scale + domain.centre
        residuals = _ContactResiduals.linearised(charges, unknowns, data[rows], search_start)
        scaled_contact[rows], residual[rows] = minimise(
            residuals.values_and_slopes, scaled_start, min_change=MIN_CHANGE
        )
        distance = np.abs(scaled_contact[rows] - scaled_start).max(axis=1)
        rows = rows[distance > LINEAR_DISTANCE]
        if not rows.size:
            break
    return AdjustedContacts(scaled_contact * domain.scale + domain.centre, residual)


class _ContactResiduals(NamedTuple):
    """Residuals of presses on one film as a function of their contacts, in the form that `minimise` expects.

    The charge of a press is the product of a factor and the charge of the film without coefficients. The factor
    contains the effects of the coefficients, which describe imperfections and the discrepancy. The factor changes
    slowly with the contact, and its computation is slow. Therefore, the factor is approximated by a linear function of
    the contact. The charges and the factors are interpolated between copies of the film with several pretensions,
    because the pretension may differ from press to press.

    Attributes:
        domain: Range of contacts for which the charges of the films are known.
        data: The measured presses.
        forward_maps: Forward map of each of the k films between which the charges are interpolated.
        film_weights: Weight of each of the k films for each press, shape (n, k).
        start: Contacts (x, y, ln F) about which the factor is linearised, shape (n, 3).
        start_factor: Factors at the contacts `start`, shape (n, n_electrode).
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
    def linearised(cls, charges: FilmCharges, unknowns: Array, data: PressData, start: Array) -> "_ContactResiduals":
        """Compute all values that do not change during the search for the contacts, and return the residuals.

        The coefficients of the film, which describe its imperfections, multiply its charges by a factor that depends on
        the contact. This factor and its derivatives are computed only at the start of the search.

        Args:
            charges: Model of the charges of all films.
            unknowns: Unknowns of the pressed film, as `FilmCharges.film` expects them.
            data: The measured presses.
            start: Contacts (x, y, ln F) at which the search begins, shape (n, 3).
        """
        layout = charges.layout
        # The pretension may differ from press to press. Charges and factors are therefore interpolated between copies
        # of the film with several pretensions.
        films, film_weights = neighbouring_films(charges, unknowns, data)
        forward_maps = [charges.forward_map(film[layout.parameters]) for film in films]

        # Without imperfections, all coefficients are zero, and the factor is 1 at all contacts.
        start_factor = np.ones_like(data.charge)
        factor_slopes = np.zeros((*data.charge.shape, 3))
        if unknowns[layout.coefficients].any():
            film_factors = [
                _values_and_slopes(partial(charges.factor, film), from_log_contact(start)) for film in films
            ]
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

    def values_and_slopes(self, rows: Integers, scaled_contact: Array) -> tuple[Array, Array]:
        """Compute the residuals of selected presses, and their derivatives with respect to the contacts.

        Args:
            rows: Indices of the presses, shape (m,).
            scaled_contact: Contacts of these presses in scaled coordinates, shape (m, 3). In these coordinates, the
                positions of the domain fill the unit disk, and ln F lies in [-1, 1].

        Returns:
            Residuals, shape (m, n_electrode + 3), and their derivatives with respect to the scaled contact, shape (m,
            3, n_electrode + 3), with the order of the axes that `minimise` expects.
        """
        contact = scaled_contact * self.domain.scale + self.domain.centre  # (x, y, ln F)
        film_charges = [
            _values_and_slopes(forward_map.charges, from_log_contact(contact)) for forward_map in self.forward_maps
        ]
        charge, charge_slopes = _interpolated(film_charges, self.film_weights[rows])

        # Linear approximation of the factor about the start
        factor_slopes = self.factor_slopes[rows]  # shape (m, n_electrode, 3)
        displacement = (contact - self.start[rows])[:, None]  # shape (m, 1, 3)
        factor = self.start_factor[rows] + (factor_slopes * displacement).sum(axis=2)

        # Derivatives of factor * charge by the product rule, shape (m, n_electrode, 3)
        product_slopes = factor[:, :, None] * charge_slopes + charge[:, :, None] * factor_slopes
        presses = self.data[rows]
        residual_slopes = presses.residual_slopes(product_slopes) * self.domain.scale  # per unit of the scaled contact
        return presses.residual(factor * charge, contact), residual_slopes.swapaxes(1, 2)


def neighbouring_films(charges: FilmCharges, unknowns: Array, data: PressData) -> tuple[list[Array], Array]:
    """Return copies of a film with several pretensions, between which the charges of each press are interpolated.

    The pretension of a film may differ from press to press, for example because of the temperature. The returned copies
    of the film differ only in their pretension. If all presses have the same pretension, there is only one copy.

    Args:
        charges: Model of the charges of all films.
        unknowns: Unknowns of the film, as `FilmCharges.film` expects them.
        data: The presses, with the change of the pretension during each press.

    Returns:
        The unknowns of each of the k copies, and the weight of each copy for each press, shape (n, k). The charges of a
        press are the weighted sum of the charges of the copies.
    """
    pretension_index = charges.layout.parameter("pretension")
    lower, upper = charges.prior.bounds
    pretension_bounds = float(lower[pretension_index]), float(upper[pretension_index])
    node_pretensions, film_weights = data.pretension_nodes(float(unknowns[pretension_index]), pretension_bounds)

    films = []
    for node_pretension in node_pretensions:
        film = unknowns.copy()
        film[pretension_index] = node_pretension
        films.append(film)
    return films, film_weights


def _interpolated(film_values_and_slopes: list[tuple[Array, Array]], film_weights: Array) -> tuple[Array, Array]:
    """Interpolate the values and derivatives for each press between films with several pretensions.

    Args:
        film_values_and_slopes: Values and derivatives on each of the k films, as `_values_and_slopes` returns them.
        film_weights: Weight of each of the k films for each press, shape (n, k).

    Returns:
        Interpolated values, shape (n, n_electrode), and interpolated derivatives, shape (n, n_electrode, 3).
    """
    values = weighted_sum([film_values for film_values, _ in film_values_and_slopes], film_weights)
    slopes = weighted_sum([film_slopes for _, film_slopes in film_values_and_slopes], film_weights)
    return values, slopes


def weighted_sum(arrays: Sequence[Array], weights: Array) -> Array:
    """Compute the weighted sum of several arrays. Each row has its own weights.

    Args:
        arrays: The k arrays, each of shape (n, ...).
        weights: Weight of each of the k arrays in each row, shape (n, k).

    Returns:
        The sum, shape (n, ...).
    """
    total = np.zeros_like(arrays[0])
    for array, row_weights in zip(arrays, weights.T, strict=True):
        # NumPy would align the weights with the last axis. Further axes of length 1 align them with the first axis.
        trailing_axes = tuple(range(1, array.ndim))
        total = total + array * np.expand_dims(row_weights, trailing_axes)
    return total


def _values_and_slopes(function: Callable[[Array], Array], contact: Array) -> tuple[Array, Array]:
    """Evaluate a function at contacts, and compute its derivatives by one-sided finite differences.

    Args:
        function: Function that converts contacts (x, y, F), shape (n, 3), into an array of shape (n, n_electrode).
        contact: Contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        Values, shape (n, n_electrode). Derivatives with respect to (x, y, ln F), shape (n, n_electrode, 3).
    """
    x_step, y_step, log_force_step = CONTACT_STEPS
    # The contacts, and three copies that are displaced along x, y and ln F, shape (4, n, 3). A single call of the
    # function for all of them is faster than four calls.
    displaced = np.repeat(contact[None], 4, axis=0)
    displaced[1, :, 0] += x_step
    displaced[2, :, 1] += y_step
    displaced[3, :, 2] *= np.exp(log_force_step)
    displaced_values = function(displaced.reshape(-1, 3)).reshape(4, len(contact), -1)
    value, value_x, value_y, value_force = displaced_values  # each of shape (n, n_electrode)
    slopes = [
        (value_x - value) / x_step,
        (value_y - value) / y_step,
        (value_force - value) / log_force_step,
    ]
    return value, np.stack(slopes, axis=2)


def start_contacts(charges: FilmCharges, unknowns: Array, data: PressData) -> list[Array]:
    """Return the contacts at which searches for the adjusted contacts begin.

    If the rig measured the position of a press, all searches begin at this position. If the position of a press is
    unknown, each search begins at a different position where the ratios of the film's charges are similar to the ratios
    of the measured charges. All searches begin at the measured force. If the force is unknown, they begin at the middle
    of the logarithmic range of forces.

    Args:
        charges: Model of the charges of all films.
        unknowns: Unknowns of the film, as `FilmCharges.film` expects them.
        data: The measured presses.

    Returns:
        For each search, the contacts (x, y, ln F) of all presses at which it begins, shape (n, 3). There is one search
        if all positions were measured, and otherwise there are `UNKNOWN_POSITION_STARTS` searches.
    """
    is_position_unknown = ~data.has_place
    if not is_position_unknown.any():
        return [data.contact.copy()]
    starts = []
    for position in _similar_positions(charges, unknowns, data[is_position_unknown]):
        start = data.contact.copy()
        start[is_position_unknown, :2] = position
        starts.append(start)
    return starts


def _similar_positions(charges: FilmCharges, unknowns: Array, data: PressData) -> list[Array]:
    """Find positions where the ratios of a film's charges are similar to the ratios of the measured charges.

    For each press, `CANDIDATE_POSITIONS` positions are compared. The first result is the most similar position. Each
    further result is the most similar position whose distance from all previous results is at least `START_DISTANCE`
    times the radius of the domain.

    Ratios are compared, because they hardly depend on the stiffness and the piezoelectric coefficients of the film. The
    estimates of these properties may still be inaccurate at this stage of a calibration.

    Args:
        charges: Model of the charges of all films.
        unknowns: Unknowns of the film, as `FilmCharges.film` expects them.
        data: The presses whose positions are searched for.

    Returns:
        List of `UNKNOWN_POSITION_STARTS` arrays. Each array contains a position (x, y) for each press, shape (n, 2),
        mm.
    """
    # Candidates (x, y, F). Their positions are distributed evenly over the domain, and are first computed as complex
    # numbers x + i y. All candidates have the median force of the presses, because the ratios of the charges hardly
    # depend on the force.
    complex_positions = charges.domain.radius * sunflower(CANDIDATE_POSITIONS)
    median_force = np.exp(np.median(data.contact[:, 2]))
    forces = np.full(CANDIDATE_POSITIONS, median_force)
    candidates = np.column_stack([complex_positions.real, complex_positions.imag, forces])
    log_computed = np.log(charges.charges(unknowns, candidates))  # shape (n_candidate, n_electrode)

    log_charge = np.log(np.maximum(data.charge, 1.0))  # at least 1 pC, because charges may be zero or negative
    log_measured = np.where(data.has_charge, log_charge, np.nan)

    # If the ratios agree exactly, the logarithms of measured and computed charges differ by the same amount on all
    # electrodes. The variance of this difference over the electrodes is then zero.
    log_quotient = log_measured[:, None] - log_computed  # shape (n, n_candidate, n_electrode)
    dissimilarity = np.nanvar(log_quotient, axis=2)  # shape (n, n_candidate)
    # Distance of each candidate from each other candidate, shape (n_candidate, n_candidate)
    candidate_distance = np.abs(complex_positions[:, None] - complex_positions) / charges.domain.radius
    positions = []
    for _ in range(UNKNOWN_POSITION_STARTS):
        most_similar = dissimilarity.argmin(axis=1)
        positions.append(candidates[most_similar, :2])
        # Exclude the candidates near the chosen position from the next choices.
        is_near = candidate_distance[most_similar] < START_DISTANCE  # shape (n, n_candidate)
        dissimilarity = np.where(is_near, np.inf, dissimilarity)
    return positions
