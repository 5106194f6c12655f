"""Search for the contact whose charges are nearest to given charges.

Let Q be the given charges, q(c) the charges of a contact c, and sigma the standard deviation of the noise of each
charge. The distance of q(c) from Q is |(Q - q(c)) / sigma|. The distance is minimised over the contacts of a domain.
"""

from collections.abc import Callable

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.simulate.forward.charge_map import ChargeMap, linearised
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import INNER_RADIUS
from isocharge.simulate.numerics.disk_least_squares import MAX_STEPS, MIN_CHANGE, minimise

STEPS = 8
"""Number of steps from a start near the solution. Most charges need five."""

CANDIDATES = 4096
"""Number of contacts among which the starting points of a search are chosen.

The contacts are distributed over the domain, and a quarter of them lie on the edge of the disk.
"""

START_SEPARATION = 0.25
"""Smallest distance between the starts of one search in unit coordinates, in which the radius of the domain is one.

Starts that are nearer to each other mostly lead to the same local minimum.
"""

CHUNK = 2048
"""Number of charges that are compared with all candidates at once, which limits the memory."""


def nearest_contact(charge_map: ChargeMap, noise: NoiseModel, charge: Array, start: Array) -> tuple[Array, Array]:
    """Find the contacts that explain charges best by a least-squares descent from starting points near the solution.

    Args:
        charge_map: Charges as a function of the contact.
        noise: Noise of the readings.
        charge: Charges to explain, shape (n, n_electrode), pC.
        start: Contacts (x, y, F) from which the search starts, shape (n, 3), mm and N.

    Returns:
        Contacts within the domain of the map, shape (n, 3). Distances of their charges from the given charges, in
        standard deviations of the noise, shape (n,).
    """

    def predicted_sigma(_: Integers, predicted: Array) -> Array:
        """Return the standard deviations of the noise of the predicted charges, pC."""
        return noise.sigma(predicted)

    contact, residual = _descend(charge_map, charge, predicted_sigma, start, STEPS)
    return contact, np.linalg.norm(residual, axis=1)


def explain(
    charge_map: ChargeMap, charge: Array, sigma: Array, start: Array, *, min_change: float = MIN_CHANGE
) -> tuple[Array, Array]:
    """Find the contacts that explain charges best by a least-squares descent from given starting points.

    Unlike in `nearest_contact`, the standard deviations of the charges are given, and the starting points need not be
    near the solution.

    Args:
        charge_map: Charges as a function of the contact.
        charge: Charges to explain, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        start: Contacts (x, y, F) from which the search starts, shape (n, 3), mm and N.
        min_change: Change of the squared distance below which the descent ends, relative to 1 + its value.

    Returns:
        Contacts within the domain of the map, shape (n, 3). Residuals (Q - Q(c)) / sigma, shape (n, n_electrode).
    """

    def given_sigma(rows: Integers, _: Array) -> Array:
        """Return the given standard deviations that belong to some rows of the charges, pC."""
        return np.asarray(sigma[rows])

    return _descend(charge_map, charge, given_sigma, start, MAX_STEPS, min_change)


def _descend(
    charge_map: ChargeMap,
    charge: Array,
    sigma_of: Callable[[Integers, Array], Array],
    start: Array,
    max_steps: int,
    min_change: float = MIN_CHANGE,
) -> tuple[Array, Array]:
    """Minimise the distance |(Q - Q(c)) / sigma| of the charges of contacts c from given charges Q.

    For each row of charges, a least-squares descent leads from the start to a local minimum.

    The unknowns are x, y and ln F in unit coordinates, in which the domain is the unit disk times [-1, 1].

    Args:
        charge_map: Charges as a function of the contact.
        charge: Charges to explain, shape (n, n_electrode), pC.
        sigma_of: Function from rows of the charges and the predicted charges to standard deviations, pC.
        start: Contacts (x, y, F), shape (n, 3), mm and N.
        max_steps: Largest number of steps.
        min_change: Change of the squared distance below which the descent ends, relative to 1 + its value.

    Returns:
        Contacts (x, y, F), shape (n, 3). Residuals (Q - Q(c)) / sigma, shape (n, n_electrode).
    """
    # Centre and half width of the domain in (x, y, ln F)
    radius = INNER_RADIUS * charge_map.domain.radius
    force_range = charge_map.domain.force_range
    min_log_force, max_log_force = np.log(force_range)
    centre = charge_map.domain.centre
    half_width = np.array([radius, radius, 0.5 * (max_log_force - min_log_force)])
    divisor = np.where(half_width > 0.0, half_width, 1.0)  # the half width of ln F is zero if there is a single force

    def to_contact(unit_coordinates: Array) -> Array:
        """Convert unit coordinates into contacts (x, y, F), both of shape (k, 3)."""
        log_contact = unit_coordinates * half_width + centre
        force = np.clip(np.exp(log_contact[:, 2]), *force_range)
        return np.column_stack([log_contact[:, :2], force])

    def residuals(rows: Integers, unit_coordinates: Array) -> tuple[Array, Array]:
        """Compute the residuals (Q - Q(c)) / sigma of some rows of the charges, and their derivatives.

        Args:
            rows: Indices of the rows, shape (k,).
            unit_coordinates: Contacts c in unit coordinates, shape (k, 3).

        Returns:
            Residuals, shape (k, n_electrode), and derivatives, shape (k, 3, n_electrode).
        """
        predicted, slopes = linearised(charge_map, to_contact(unit_coordinates))
        sigma = sigma_of(rows, predicted)
        derivatives = -slopes * half_width / sigma[..., None]  # sigma counts as constant
        return (charge[rows] - predicted) / sigma, derivatives.swapaxes(1, 2)

    log_start = np.column_stack([start[:, :2], np.log(start[:, 2])])  # (x, y, ln F)
    unit_start = (log_start - centre) / divisor
    unit_solution, residual = minimise(residuals, unit_start, max_steps, min_change)
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
    """Find the nearest contacts by descents from the best candidates among contacts distributed over the domain.

    Args:
        charge_map: Charges as a function of the contact.
        charge: Charges to explain, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        starts: Number of descents for each row of charges.
        candidates: Number of contacts among which the starts are chosen.
        min_change: Change of the squared distance below which a descent ends, relative to 1 + its value.

    Returns:
        Contacts and residuals of the best descent; see `explain`.
    """
    # Charges of the candidates, and pairs of candidates that lie close together
    unit_candidates = _unit_candidates(candidates)
    candidate_contacts = charge_map.domain.to_contact(INNER_RADIUS * unit_candidates)
    candidate_contacts[:, 2] = np.clip(candidate_contacts[:, 2], *charge_map.domain.force_range)
    candidate_charges = charge_map.charges(candidate_contacts)
    positions = unit_candidates[:, :2]
    is_neighbour = scipy.spatial.distance.cdist(positions, positions) < START_SEPARATION

    # For each row of charges, the candidates with the nearest charges
    nearest_candidates = []
    for chunk_start in range(0, max(len(charge), 1), CHUNK):  # without charges, there is one empty chunk
        chunk = slice(chunk_start, chunk_start + CHUNK)
        nearest_candidates.append(_nearest_rows(charge[chunk], sigma[chunk], candidate_charges, is_neighbour, starts))

    # One descent from the nearest candidate of each row of charges, one from the second nearest, and so on. They run
    # together, because the charge map is faster for many contacts at once.
    candidates_of_descents = np.concatenate(nearest_candidates).T  # shape (starts, n)
    contact, residual = explain(
        charge_map,
        np.tile(charge, (starts, 1)),
        np.tile(sigma, (starts, 1)),
        candidate_contacts[candidates_of_descents.ravel()],
        min_change=min_change,
    )

    # Choose the descent with the smallest residual for each row of charges.
    contacts = contact.reshape(starts, len(charge), 3)
    residuals = residual.reshape(starts, *charge.shape)
    best_start = (residuals**2).sum(axis=2).argmin(axis=0)
    row = np.arange(len(charge))
    return contacts[best_start, row], residuals[best_start, row]


def _unit_candidates(count: int) -> Array:
    """Return contacts that are evenly distributed over the domain (Sobol sequence), a quarter of them on the edge.

    Args:
        count: Number of contacts.

    Returns:
        Contacts in unit coordinates (x, y, ln F), in which the domain is the unit disk times [-1, 1], shape (count, 3).
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
    """Find the candidates with the nearest charges for each row of charges.

    Candidates that are neighbours of each other are not returned together. A few searches for the
    smallest distance are faster than sorting all distances.

    Args:
        charge: Charges, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        candidate_charges: Charges of the candidates, shape (n_candidate, n_electrode), pC.
        is_neighbour: Whether each pair of candidates lies close together, shape (n_candidate, n_candidate).
        count: Number of candidates to find for each row of charges.

    Returns:
        Indices of the candidates in ascending order of the distance, shape (n, count).
    """
    # sum((Q - Q_c)^2 / sigma^2) = sum(Q_c^2 / sigma^2 - 2 Q Q_c / sigma^2) + const., as one matrix product
    inverse_variance = sigma**-2.0
    weights = np.hstack([inverse_variance, -2.0 * charge * inverse_variance])
    powers = np.hstack([candidate_charges**2, candidate_charges])
    squared_distance = weights @ powers.T  # shape (n, n_candidate), without the constant
    nearest = np.empty((len(charge), count), dtype=np.intp)
    for rank in range(count):
        nearest_candidate = squared_distance.argmin(axis=1)
        nearest[:, rank] = nearest_candidate
        # Exclude this candidate and its neighbours from the following searches.
        squared_distance[is_neighbour[nearest_candidate]] = np.inf
    return nearest
