"""Search for pairs of distant contacts that have the same charges.

Even if a charge map has no folds, two distant contacts may have the same charges. The search for such pairs covers the
whole domain of the map.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.force_profile import ForceProfile
from isocharge.simulate.identifiability.nearest_contact import nearest_contact
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import INNER_RADIUS, lattice
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values

INDISTINGUISHABLE_SIGMAS = 3.0
"""Difference of the charges below which two contacts are indistinguishable, in standard deviations of the noise."""

MIN_DISTANCE = 1.0
"""Smallest distance between the contacts of an ambiguous pair, mm."""

MIN_DISTANCE_SIGMAS = 6.0
"""Smallest distance between the contacts of an ambiguous pair, in standard deviations of the position.

If the distance is smaller, the two contacts count as a single contact with a large uncertainty.
"""

FORCES = 8
"""Number of forces at which the charges at each position are tabulated."""

EXPONENT = 2.0 / 3.0
"""Exponent of the force in the charge of a membrane without pretension, dimensionless.

The tables contain the ratio of the charge to this power of the force. This ratio depends only weakly on the force.
"""

NEIGHBOURS = 9
"""Number of nearest lattice points that are compared, including the point itself.

A candidate must have charges that fit better than the charges at all these points.
"""

MAX_CANDIDATES = 2
"""Largest number of candidates for the second contact of each first contact."""


@dataclass(frozen=True)
class AmbiguousPairs:
    """Pairs of distant contacts that have the same charges.

    The outer contact of a pair is the contact that is farther from the centre of the film. The pairs are ordered by the
    distance of the outer contact from the centre.

    Attributes:
        first: First contact (x, y, F) of each pair, shape (n, 3), mm and N.
        second: Second contact (x, y, F) of each pair, shape (n, 3), mm and N.
        distance: Distance between the charges of the two contacts of each pair, shape (n,), in standard deviations of
            the noise.
    """

    first: Array
    second: Array
    distance: Array

    @classmethod
    def none(cls) -> "AmbiguousPairs":
        """Return a result without any pair."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))

    def __len__(self) -> int:
        return len(self.first)

    @property
    def outer_radius(self) -> Array:
        """Distance between the centre of the film and the outer contact of each pair, shape (n,), mm."""
        first_radius = np.hypot(*self.first[:, :2].T)
        second_radius = np.hypot(*self.second[:, :2].T)
        return np.asarray(np.maximum(first_radius, second_radius))

    @property
    def radius(self) -> float:
        """Radius of the smallest disk around the centre that contains both contacts of a pair, mm.

        The radius is infinite if there are no pairs.
        """
        return float(self.outer_radius.min(initial=np.inf))

    @property
    def summary(self) -> str:
        """Sentence about the pair whose outer contact is nearest to the centre of the film.

        If there are no pairs, the property is an empty text.
        """
        if not len(self):
            return ""
        x, y, force = self.first[0]
        other_x, other_y, other_force = self.second[0]
        return (
            f"Contacts far apart can have the same charges: the charges of {force:.3g} N at ({x:.1f}, {y:.1f}) mm and "
            f"of {other_force:.3g} N at ({other_x:.1f}, {other_y:.1f}) mm differ by {self.distance[0]:.1f} standard "
            "deviations."
        )


def find_ambiguous_pairs(charge_map: ChargeMap, noise: NoiseModel, force: float, places: int = 1000) -> AmbiguousPairs:
    """Find pairs of distant contacts whose charges cannot be distinguished because of the noise.

    The first contact of a pair is a press with the given force at a position of a square lattice. For each first
    contact, the other positions of the lattice are candidates for the second contact. At each position, the function
    determines the force whose charges fit the charges of the first contact best. It improves the best candidates by a
    least-squares fit.

    Args:
        charge_map: Map that computes the charges of contacts.
        noise: Noise of the readings.
        force: Force of the first contact of each pair, N. The second contact may have any force of the map.
        places: Number of positions of the lattice.

    Returns:
        The pairs, ordered by the distance of the outer contact from the centre.
    """
    # Choose the first contacts, and compute the distance above which a second contact counts as distant.
    unit_lattice = lattice(places)  # positions x + iy in the unit disk
    position = INNER_RADIUS * charge_map.domain.radius * np.stack([unit_lattice.real, unit_lattice.imag], axis=1)
    contact = np.column_stack([position, np.full(len(position), force)])
    charge = charge_map.charges(contact)
    position_std = limits_at(charge_map, contact, noise).position
    min_distance = np.maximum(MIN_DISTANCE, MIN_DISTANCE_SIGMAS * position_std)
    first_index, candidates = _candidates(charge_map, noise, position, charge, min_distance)
    if not first_index.size:
        return AmbiguousPairs.none()

    # Improve the candidates for the second contacts. Then select the pairs whose contacts are still distant, and whose
    # charges agree within the noise.
    first_contact = contact[first_index]
    second_contact, charge_difference = nearest_contact(charge_map, noise, charge[first_index], candidates)
    x_difference, y_difference, _ = (second_contact - first_contact).T
    is_distant = np.hypot(x_difference, y_difference) > min_distance[first_index]
    is_ambiguous = is_distant & (charge_difference < INDISTINGUISHABLE_SIGMAS)
    pairs = AmbiguousPairs(first_contact[is_ambiguous], second_contact[is_ambiguous], charge_difference[is_ambiguous])
    order = np.argsort(pairs.outer_radius, kind="stable")
    return AmbiguousPairs(pairs.first[order], pairs.second[order], pairs.distance[order])


def _candidates(
    charge_map: ChargeMap, noise: NoiseModel, position: Array, charge: Array, min_distance: Array
) -> tuple[Integers, Array]:
    """Find contacts on the lattice that may be the second contacts of ambiguous pairs.

    The charges at a candidate fit the charges of the first contact at least as well as the charges at all neighbouring
    positions. A candidate must also be far from the first contact. Each first contact has at most `MAX_CANDIDATES`
    candidates.

    Args:
        charge_map: Map that computes the charges of contacts.
        noise: Noise of the readings.
        position: Positions (x, y) of the lattice, shape (n, 2), mm.
        charge: Charges of the first contact at each of these positions, shape (n, n_electrode), pC.
        min_distance: Smallest distance of a second contact from the first contact at each position, shape (n,), mm.

    Returns:
        Indices of the first contacts, shape (m,). Candidates (x, y, F) for their second contacts, shape (m, 3), mm and
        N. A first contact with two candidates occurs twice.
    """
    # The profile computes the charges at every position for any force from tabulated values (`ratios`). This is faster
    # than the charge map.
    profile, ratios = _tabulate(charge_map, position)

    # Find the indices of the nearest positions of each position, shape (n, n_neighbour).
    _, neighbours = cKDTree(position).query(position, min(NEIGHBOURS, len(position)))
    first_indices = []
    second_contacts = []
    for first_index, first_charge in enumerate(charge):
        # At every position of the lattice, find the force whose charges fit those of the first contact best.
        observed = np.broadcast_to(first_charge, charge.shape)
        log_force = profile.best_log_force(ratios, observed, noise)
        predicted = profile.charge(log_force, ratios)

        # Compute the squared distance of the charges in standard deviations of the noise, shape (n,). Then select the
        # best distant positions at which the squared distance is a local minimum.
        squared_distance = ((observed - predicted) ** 2 / noise.variance(predicted)).sum(axis=1)
        is_local_minimum = squared_distance <= squared_distance[neighbours].min(axis=1)
        x_difference, y_difference = (position - position[first_index]).T
        is_distant = np.hypot(x_difference, y_difference) > min_distance[first_index]
        candidates = np.flatnonzero(is_local_minimum & is_distant)
        best_candidates = candidates[np.argsort(squared_distance[candidates])[:MAX_CANDIDATES]]
        first_indices.append(np.full(best_candidates.size, first_index))
        second_contacts.append(np.column_stack([position[best_candidates], np.exp(log_force[best_candidates])]))
    return np.concatenate(first_indices), np.concatenate(second_contacts)


def _tabulate(charge_map: ChargeMap, position: Array) -> tuple[ForceProfile, Array]:
    """Tabulate the charges at every position for a few forces, and create a profile that interpolates between them.

    If Q is a charge and F is the force, the ratio Q / F^EXPONENT depends only weakly on F. The ratio is therefore
    tabulated at a few forces (the nodes), and is interpolated by a polynomial in ln F.

    Args:
        charge_map: Map that computes the charges of contacts.
        position: Positions (x, y), shape (n, 2), mm.

    Returns:
        Profile that computes the charges for any force; the terms of the profile are the tabulated ratios. Tabulated
        ratios Q / F^EXPONENT at the nodes, shape (n, n_node, n_electrode), pC/N^EXPONENT.
    """
    # Choose the nodes. If the map has a single force, this force is the only node.
    force_range = charge_map.domain.force_range
    min_log_force, max_log_force = np.log(force_range)
    if max_log_force > min_log_force:
        log_nodes = chebyshev_nodes(FORCES, min_log_force, max_log_force)
    else:
        log_nodes = np.array([min_log_force])
    force_nodes = np.clip(np.exp(log_nodes), *force_range)  # rounding must not move a force out of the range

    # Compute the ratios at the nodes: one array of shape (n, n_electrode) for each force.
    nodal_ratios = []
    for force in force_nodes:
        contact = np.column_stack([position, np.full(len(position), force)])
        nodal_ratios.append(charge_map.charges(contact) / force**EXPONENT)
    barycentric = barycentric_weights(log_nodes)

    def weights(log_force: Array) -> Array:
        """Compute weights of the nodes. The weighted sum of the ratios at the nodes is the charge.

        Args:
            log_force: Natural logarithms of the forces in N, shape (n,).

        Returns:
            Weights of the nodes for each force, shape (n, n_node), N^EXPONENT.
        """
        # The interpolation weights lead to the ratio Q / F^EXPONENT, and the factor F^EXPONENT leads to the charge Q.
        interpolation_weights = lagrange_values(log_nodes, barycentric, log_force)
        force_power = np.exp(EXPONENT * log_force)
        return np.asarray(interpolation_weights * force_power[:, None])

    return ForceProfile.of(weights, force_range), np.stack(nodal_ratios, axis=1)
