"""Search for the contact whose charges are nearest to given charges.

Let Q be the given charges, Q(c) the charges of a contact c, and sigma the standard deviation of the noise of each
charge. The distance between Q and Q(c) is the norm |(Q - Q(c)) / sigma|. The distance is minimised over the contacts of
a domain.
"""

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.simulate.forward.charge_map import ChargeMap, linearised
from isocharge.simulate.numerics.disk import INNER_RADIUS
from isocharge.simulate.numerics.disk_least_squares import MIN_CHANGE, minimise

CANDIDATES = 4096
"""Number of contacts among which the starting points of a search are chosen.

The contacts are distributed over the domain. A quarter of them lie on the edge of the disk.
"""

START_SEPARATION = 0.25
"""Smallest distance between the starting points of one search, in radii of the domain, dimensionless.

Starting points that are nearer to each other mostly lead to the same local minimum.
"""

CHUNK = 2048
"""Number of rows of charges that are compared with all candidates at once, which limits the required memory."""


def explain(
    charge_map: ChargeMap, charge: Array, sigma: Array, start: Array, *, min_change: float = MIN_CHANGE
) -> tuple[Array, Array]:
    """Find the contacts whose charges are nearest to given charges. The starting points may be anywhere.

    A least-squares descent leads from each starting point to a local minimum of the distance. The unknowns are x, y and
    ln F in unit coordinates. In these coordinates, the domain is the unit disk times the interval [-1, 1].

    Args:
        charge_map: Map that computes the charges of contacts.
        charge: Given charges, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        start: Contacts (x, y, F) from which the descents start, shape (n, 3), mm and N.
        min_change: A descent ends if the squared distance changes by less than `min_change` times 1 + its value.

    Returns:
        Contacts (x, y, F) within the domain of the map, shape (n, 3), mm and N. Residuals, which are the given charges
        minus the charges of the contacts, divided by `sigma`, shape (n, n_electrode), dimensionless.
    """
    force_range = charge_map.domain.force_range
    domain = charge_map.domain.within(INNER_RADIUS * charge_map.domain.radius)
    # With a single force, the charges do not depend on the third unit coordinate.
    half_width = domain.scale * [1.0, 1.0, force_range[1] > force_range[0]]

    def to_contact(unit_coordinates: Array) -> Array:
        """Convert unit coordinates, shape (k, 3), into contacts (x, y, F), shape (k, 3), mm and N."""
        contact = domain.to_contact(unit_coordinates)
        contact[:, 2] = np.clip(contact[:, 2], *force_range)  # rounding must not move it out of the range
        return contact

    def residuals(rows: Integers, unit_coordinates: Array) -> tuple[Array, Array]:
        """Compute the residuals (Q - Q(c)) / sigma for selected rows of charges, and the derivatives of the residuals.

        Args:
            rows: Indices of the rows, shape (k,).
            unit_coordinates: Contacts c in unit coordinates, one for each of these rows, shape (k, 3).

        Returns:
            Residuals, shape (k, n_electrode). Their derivatives with respect to the unit coordinates, shape (k, 3,
            n_electrode).
        """
        predicted, slopes = linearised(charge_map, to_contact(unit_coordinates))
        derivatives = -slopes * half_width / sigma[rows][..., None]
        return (charge[rows] - predicted) / sigma[rows], derivatives.swapaxes(1, 2)

    unit_solution, residual = minimise(residuals, domain.to_unit(start), min_change=min_change)
    return to_contact(unit_solution), residual


def search(
    charge_map: ChargeMap,
    charge: Array,
    sigma: Array,
    *,
    starts: int = 2,
    candidates: int = CANDIDATES,
    min_change: float = MIN_CHANGE,
) -> tuple[Array, Array]:
    """Find the contacts whose charges are nearest to given charges, without given starting points.

    For each row of charges, least-squares descents start from the contacts of `starting_contacts`. All descents run
    together, because the charge map is faster for many contacts at once.

    Args:
        charge_map: Map that computes the charges of contacts.
        charge: Given charges, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        starts: Number of descents for each row of charges.
        candidates: Number of candidates for the starting points.
        min_change: A descent ends if the squared distance changes by less than `min_change` times 1 + its value.

    Returns:
        Contacts (x, y, F), shape (n, 3), mm and N, and residuals, shape (n, n_electrode), of the best descent for each
        row; see `explain`.
    """
    start = starting_contacts(charge_map, charge, sigma, starts=starts, candidates=candidates)
    contact_of_descent, residual_of_descent = explain(
        charge_map,
        np.repeat(charge, starts, axis=0),
        np.repeat(sigma, starts, axis=0),
        start.reshape(-1, 3),
        min_change=min_change,
    )

    # Choose the descent with the smallest residual for each row of charges. The axes are (row, start, component).
    contact_by_start = contact_of_descent.reshape(len(charge), starts, 3)
    residual_by_start = residual_of_descent.reshape(len(charge), starts, charge.shape[1])
    best_start = (residual_by_start**2).sum(axis=2).argmin(axis=1)  # shape (n,)
    row = np.arange(len(charge))
    return contact_by_start[row, best_start], residual_by_start[row, best_start]


def starting_contacts(
    charge_map: ChargeMap,
    charge: Array,
    sigma: Array,
    *,
    starts: int = 2,
    candidates: int = CANDIDATES,
) -> Array:
    """Find starting points of descents for given charges.

    Candidates are contacts that are distributed over the domain. The function compares the given charges with the
    charges of the candidates.

    Args:
        charge_map: Map that computes the charges of contacts.
        charge: Given charges, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        starts: Number of starting points for each row of charges.
        candidates: Number of candidates.

    Returns:
        For each row of charges, the contacts (x, y, F) with the nearest charges, in ascending order of the distance of
        their charges, shape (n, starts, 3), mm and N. They do not lie close together.
    """
    # Compute the charges of the candidates, and find the pairs of candidates that lie close together.
    unit_candidates = _unit_candidates(candidates)
    contact = charge_map.domain.to_contact(INNER_RADIUS * unit_candidates)
    contact[:, 2] = np.clip(contact[:, 2], *charge_map.domain.force_range)
    candidate_charges = charge_map.charges(contact)
    positions = unit_candidates[:, :2]
    is_neighbour = scipy.spatial.distance.cdist(positions, positions) < START_SEPARATION

    start = np.empty((len(charge), starts, 3))
    for first_row in range(0, len(charge), CHUNK):
        chunk = slice(first_row, first_row + CHUNK)
        start[chunk] = contact[_nearest_rows(charge[chunk], sigma[chunk], candidate_charges, is_neighbour, starts)]
    return start


def _unit_candidates(count: int) -> Array:
    """Return contacts that are evenly distributed over a domain (Sobol sequence).

    A quarter of the contacts lie on the edge of the disk.

    Args:
        count: Number of contacts.

    Returns:
        Contacts in the coordinates (x, y, ln F), shape (count, 3). The coordinates are scaled such that the domain is
        the unit disk times the interval [-1, 1].
    """
    radius_sample, angle_sample, force_sample = scipy.stats.qmc.Sobol(3, scramble=False).random(count).T
    radius = np.sqrt(radius_sample)  # uniform over the area of the disk
    radius[::4] = 1.0  # every fourth contact lies on the edge
    angle = 2.0 * np.pi * angle_sample
    log_force = 2.0 * force_sample - 1.0
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), log_force], axis=1)


def _nearest_rows(
    charge: Array, sigma: Array, candidate_charges: Array, is_neighbour: Booleans, count: int
) -> Integers:
    """For each row of charges, find the candidates whose charges are nearest to this row.

    For each row, at most one of two neighbouring candidates is returned. The function searches for the smallest
    distance several times, because sorting all distances would be slower.

    Args:
        charge: Given charges, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        candidate_charges: Charges of the candidates, shape (n_candidate, n_electrode), pC.
        is_neighbour: Whether each pair of candidates lies close together, shape (n_candidate, n_candidate).
        count: Number of candidates to find for each row of charges.

    Returns:
        Indices of the candidates in ascending order of the distance of their charges, shape (n, count).
    """
    # The squared distance of the charges Q_c of a candidate from the given charges Q is
    #   sum((Q - Q_c)^2 / sigma^2) = sum(Q_c^2 / sigma^2 - 2 Q Q_c / sigma^2) + const.
    # Without the constant, the squared distances of all rows and candidates are one matrix product.
    inverse_variance = sigma**-2.0
    weights = np.hstack([inverse_variance, -2.0 * charge * inverse_variance])
    charge_powers = np.hstack([candidate_charges**2, candidate_charges])
    squared_distance = weights @ charge_powers.T  # shape (n, n_candidate)
    nearest = np.empty((len(charge), count), dtype=np.intp)
    for rank in range(count):
        nearest_candidate = squared_distance.argmin(axis=1)
        nearest[:, rank] = nearest_candidate
        # Exclude this candidate and its neighbours from the following searches.
        squared_distance[is_neighbour[nearest_candidate]] = np.inf
    return nearest
