"""Search for pairs of distant contacts that have the same charges.

Even if a charge map has no folds, two distant contacts may have the same charges. The search for such pairs covers the
whole domain of the map.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.nearest_contact import explain, starting_contacts
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import INNER_RADIUS, lattice

INDISTINGUISHABLE_SIGMAS = 3.0
"""Difference of the charges below which two contacts are indistinguishable, in standard deviations of the noise."""

MIN_DISTANCE = 1.0
"""Smallest distance between the contacts of an ambiguous pair, mm."""

MIN_DISTANCE_SIGMAS = 6.0
"""Smallest distance between the contacts of an ambiguous pair, in standard deviations of the position.

If the distance is smaller, the two contacts count as a single contact with a large uncertainty.
"""

STARTS = 3
"""Number of searches for a second contact of each first contact. Most often, one of them finds the first contact."""


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
    contact, the search for the nearest contact starts at distant contacts with similar charges.

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
    sigma = noise.sigma(charge)
    start = starting_contacts(charge_map, charge, sigma, starts=STARTS)

    # Search for the second contacts. A search that finds the first contact again is discarded below. Then select the
    # pairs whose contacts are still distant, and whose charges agree within the noise.
    first_index = np.repeat(np.arange(len(charge)), start.shape[1])
    first_contact = contact[first_index]
    second_contact, residual = explain(
        charge_map,
        charge[first_index],
        sigma[first_index],
        start.reshape(-1, 3),
        min_change=1e-4,  # one digit of the difference of the charges is sufficient
    )
    charge_difference = np.linalg.norm(residual, axis=1)
    x_difference, y_difference, _ = (second_contact - first_contact).T
    is_distant = np.hypot(x_difference, y_difference) > min_distance[first_index]
    is_ambiguous = is_distant & (charge_difference < INDISTINGUISHABLE_SIGMAS)
    pairs = AmbiguousPairs(first_contact[is_ambiguous], second_contact[is_ambiguous], charge_difference[is_ambiguous])
    order = np.argsort(pairs.outer_radius, kind="stable")
    return AmbiguousPairs(pairs.first[order], pairs.second[order], pairs.distance[order])
