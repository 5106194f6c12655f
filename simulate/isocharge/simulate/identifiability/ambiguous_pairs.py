"""Pairs of distant contacts that have the same charges.

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
"""Largest difference of the charges of two contacts that count as indistinguishable, in standard deviations of the
noise."""

MIN_DISTANCE = 1.0
"""Smallest distance between the contacts of an ambiguous pair, mm."""

MIN_DISTANCE_SIGMAS = 6.0
"""Smallest distance between the contacts of an ambiguous pair, in standard deviations of the position.

If the distance is smaller, the two contacts count as a single contact with a large uncertainty.
"""

FORCES = 8
"""Number of forces at which the charges of the second contact are tabulated."""

EXPONENT = 2.0 / 3.0
"""Exponent of the force in the charge of a membrane without pretension, dimensionless.

The ratio of the charge to this power of the force is tabulated, because the ratio depends only weakly on the force.
"""

NEIGHBOURS = 9
"""Number of lattice points, including the point itself, among which a candidate must have the smallest difference."""

MAX_CANDIDATES = 2
"""Largest number of candidates for the second contact of each first contact."""


@dataclass(frozen=True)
class AmbiguousPairs:
    """Pairs of contacts with the same charges.

    The outer contact of a pair is the contact that is farther from the centre of the film.

    The pairs are ordered by the distance of the outer contact from the centre.

    Attributes:
        first: First contact (x, y, F) of each pair, shape (n, 3), mm and N.
        second: Second contact (x, y, F) of each pair, shape (n, 3), mm and N.
        distance: Difference of the charges of each pair, shape (n,), in standard deviations of the noise.
    """

    first: Array
    second: Array
    distance: Array

    @classmethod
    def none(cls) -> "AmbiguousPairs":
        """Return an empty result."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))

    def __len__(self) -> int:
        return len(self.first)

    @property
    def outer_radius(self) -> Array:
        """Distance of the outer contact of each pair from the centre, shape (n,), mm."""
        first_radius = np.hypot(*self.first[:, :2].T)
        second_radius = np.hypot(*self.second[:, :2].T)
        return np.asarray(np.maximum(first_radius, second_radius))

    @property
    def radius(self) -> float:
        """Radius of the smallest centred disk that contains both contacts of a pair, mm; infinite without pairs."""
        return float(self.outer_radius.min(initial=np.inf))

    @property
    def summary(self) -> str:
        """Sentence about the pair whose outer contact is nearest to the centre, which is the first pair.

        The text is empty if there are no pairs.
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
    """Find pairs of distant contacts whose charges differ by less than the noise.

    The first contacts are presses with the force `force` at the positions of a square lattice. For each first contact,
    all other positions of the lattice are candidates for the second contact. Each candidate has the force that fits
    best. The best candidates are then improved by least squares.

    Args:
        charge_map: Charges as a function of the contact.
        noise: Noise of the readings.
        force: Force of the first contact of each pair, N. The second contact may have any force of the map.
        places: Number of positions of the lattice.

    Returns:
        The pairs, ordered by the distance of the outer contact from the centre.
    """
    # First contacts, and the distance from which on a second contact counts as distant
    unit_lattice = lattice(places)  # x + iy
    position = INNER_RADIUS * charge_map.domain.radius * np.stack([unit_lattice.real, unit_lattice.imag], axis=1)
    contact = np.column_stack([position, np.full(len(position), force)])
    charge = charge_map.charges(contact)
    position_std = limits_at(charge_map, contact, noise).position
    min_distance = np.maximum(MIN_DISTANCE, MIN_DISTANCE_SIGMAS * position_std)
    first_index, start = _candidates(charge_map, noise, position, charge, min_distance)
    if not first_index.size:
        return AmbiguousPairs.none()

    # Improve the candidates for the second contacts, and select the pairs that are distant and have the same charges.
    first = contact[first_index]
    second, charge_difference = nearest_contact(charge_map, noise, charge[first_index], start)
    x_difference, y_difference, _ = (second - first).T
    is_distant = np.hypot(x_difference, y_difference) > min_distance[first_index]
    is_ambiguous = is_distant & (charge_difference < INDISTINGUISHABLE_SIGMAS)
    pairs = AmbiguousPairs(first[is_ambiguous], second[is_ambiguous], charge_difference[is_ambiguous])
    order = np.argsort(pairs.outer_radius, kind="stable")
    return AmbiguousPairs(pairs.first[order], pairs.second[order], pairs.distance[order])


def _candidates(
    charge_map: ChargeMap, noise: NoiseModel, position: Array, charge: Array, min_distance: Array
) -> tuple[Integers, Array]:
    """Find candidates for the second contacts of pairs on the lattice.

    A position of the lattice is a candidate if its charges fit better than those of its neighbours. Each first contact
    has at most `MAX_CANDIDATES` candidates.

    Args:
        charge_map: Charges as a function of the contact.
        noise: Noise of the readings.
        position: Positions of the lattice, shape (n, 2), mm.
        charge: Charges of the first contacts at these positions, shape (n, n_electrode), pC.
        min_distance: Smallest distance of the second contact from each first contact, shape (n,), mm.

    Returns:
        Indices of first contacts, shape (m,). A candidate (x, y, F) for each first contact, shape (m, 3), mm and N. A
        first contact with two candidates occurs twice.
    """
    # The charges at each position of the lattice are weights(ln F) @ ratios, with the weights of the profile.
    profile, ratios = _tabulate(charge_map, position)
    _, neighbours = cKDTree(position).query(position, min(NEIGHBOURS, len(position)))  # indices, including itself
    first_indices = []
    second_contacts = []
    for first_index, first_charge in enumerate(charge):
        # At every position of the lattice, find the force that explains the charges of the first contact best.
        observed = np.broadcast_to(first_charge, charge.shape)
        log_force = profile.best(ratios, observed, noise)
        predicted = profile.charge(log_force, ratios)
        chi2 = ((observed - predicted) ** 2 / noise.variance(predicted)).sum(axis=1)  # shape (n,)

        is_local_minimum = chi2 <= chi2[neighbours].min(axis=1)
        x_difference, y_difference = (position - position[first_index]).T
        is_distant = np.hypot(x_difference, y_difference) > min_distance[first_index]
        candidates = np.flatnonzero(is_local_minimum & is_distant)
        best_candidates = candidates[np.argsort(chi2[candidates])[:MAX_CANDIDATES]]
        first_indices.append(np.full(best_candidates.size, first_index))
        second_contacts.append(np.column_stack([position[best_candidates], np.exp(log_force[best_candidates])]))
    return np.concatenate(first_indices), np.concatenate(second_contacts)


def _tabulate(charge_map: ChargeMap, position: Array) -> tuple[ForceProfile, Array]:
    """Tabulate the charges at every position as a function of the force.

    The ratio Q / F^EXPONENT is interpolated by a polynomial in ln F, because the ratio depends only weakly on F.

    Args:
        charge_map: Charges as a function of the contact.
        position: Positions (x, y), shape (n, 2), mm.

    Returns:
        The interpolation as a function of the force, and the ratios Q / F^EXPONENT at the nodes, shape (n, n_node,
        n_electrode).
    """
    force_range = charge_map.domain.force_range
    min_log_force, max_log_force = np.log(force_range)
    if max_log_force > min_log_force:
        log_nodes = chebyshev_nodes(FORCES, min_log_force, max_log_force)
    else:
        log_nodes = np.array([min_log_force])
    force_nodes = np.clip(np.exp(log_nodes), *force_range)  # rounding may lead out of the range

    # Ratios at the nodes of the interpolation, one array of shape (n, n_electrode) for each force
    nodal_ratios = []
    for force in force_nodes:
        contact = np.column_stack([position, np.full(len(position), force)])
        nodal_ratios.append(charge_map.charges(contact) / force**EXPONENT)
    barycentric = barycentric_weights(log_nodes)

    def weights(log_force: Array) -> Array:
        """Compute the weights with which the ratios at the nodes are summed to give the charge.

        Args:
            log_force: Values of ln F, shape (n,).

        Returns:
            Weights for each force, shape (n, n_node), N^EXPONENT.
        """
        interpolation_weights = lagrange_values(log_nodes, barycentric, log_force)
        force_power = np.exp(EXPONENT * log_force)
        return np.asarray(interpolation_weights * force_power[:, None])

    return ForceProfile.of(weights, force_range), np.stack(nodal_ratios, axis=1)
