"""Contacts far apart with the same charges.

A map without folds may still give two distant contacts the same charges, as a sheet may lie on itself without a crease.
The search for such pairs covers the whole film at once.
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
"""Largest difference of the charges at which two contacts count as the same, standard deviations of the noise."""

APART, WIDTHS = 1.0, 6.0
"""Smallest distance of an ambiguous pair: APART, mm, and WIDTHS standard deviations of the position. Nearer contacts
are one uncertain contact."""

FORCES = 8
"""Number of forces at which the charges of the second contact are tabulated."""

EXPONENT = 2.0 / 3.0
"""Exponent of the force in the charge of a slack membrane, dimensionless; the ratio of the charge to this power of the
force is tabulated, because it varies little."""


@dataclass(frozen=True)
class AmbiguousPairs:
    """Pairs of contacts with the same charges, the nearest to the centre first.

    Attributes:
        first: (x, y, F), shape (n, 3), mm and N.
        second: The other contact of each pair, likewise.
        distance: Difference of their charges, standard deviations of the noise, shape (n,).
    """

    first: Array
    second: Array
    distance: Array

    @classmethod
    def none(cls) -> "AmbiguousPairs":
        """No pair."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))

    def __len__(self) -> int:
        return len(self.first)

    @property
    def outer_radius(self) -> Array:
        """Distance of the outer contact of each pair from the centre, shape (n,), mm."""
        return np.asarray(np.maximum(np.hypot(*self.first[:, :2].T), np.hypot(*self.second[:, :2].T)))

    @property
    def radius(self) -> float:
        """Radius of the smallest disk that holds both contacts of a pair, mm; infinite if there are no pairs."""
        return float(self.outer_radius.min(initial=np.inf))

    @property
    def summary(self) -> str:
        """The pair nearest to the centre, in a sentence; nothing without pairs."""
        if not len(self):
            return ""
        (x, y, force), (other_x, other_y, other_force) = self.first[0], self.second[0]
        return (
            f"Contacts far apart can have the same charges: {force:.3g} N at ({x:.1f}, {y:.1f}) mm and "
            f"{other_force:.3g} N at ({other_x:.1f}, {other_y:.1f}) mm are alike within "
            f"{self.distance[0]:.1f} standard deviations."
        )


def find_ambiguous_pairs(charge_map: ChargeMap, noise: NoiseModel, force: float, places: int = 1000) -> AmbiguousPairs:
    """Pairs of contacts far apart whose charges differ by less than the noise.

    For each position of a square lattice, pressed with `force`, every other position is tried with the force that fits
    best; the best two are improved by least squares.

    Args:
        charge_map: The charges.
        noise: Noise of the readings.
        force: Force of the first contact of each pair, N; the second may have any.
        places: Number of positions of the lattice: 1,000 take some 3 s with splines.
    """
    unit = lattice(places)
    position = INNER_RADIUS * charge_map.domain.radius * np.stack([unit.real, unit.imag], axis=1)
    first = np.column_stack([position, np.full(len(position), force)])
    charge = charge_map.charges(first)
    apart = np.maximum(APART, WIDTHS * limits_at(charge_map, first, noise).position)
    pairs, start = _candidates(charge_map, noise, position, charge, apart)
    if not pairs.size:
        return AmbiguousPairs.none()
    second, distance = nearest_contact(charge_map, noise, charge[pairs], start)
    far = np.hypot(*(second - first[pairs])[:, :2].T) > apart[pairs]
    ambiguous = np.flatnonzero(far & (distance < INDISTINGUISHABLE_SIGMAS))
    found = AmbiguousPairs(first[pairs[ambiguous]], second[ambiguous], distance[ambiguous])
    order = np.argsort(found.outer_radius, kind="stable")
    return AmbiguousPairs(found.first[order], found.second[order], found.distance[order])


def _candidates(
    charge_map: ChargeMap, noise: NoiseModel, position: Array, charge: Array, apart: Array
) -> tuple[Integers, Array]:
    """Numbers of first contacts, and for each a contact (x, y, F) far away that may have the same charges."""
    profile, terms = _tabulate(charge_map, position)
    neighbours = cKDTree(position).query(position, min(9, len(position)))[1]
    numbers, contacts = [], []
    for i, row in enumerate(charge):
        observed = np.broadcast_to(row, charge.shape)
        logs = profile.best(terms, observed, noise)
        known = profile.charge(logs, terms)
        chi2 = ((observed - known) ** 2 / noise.variance(known)).sum(axis=1)
        lowest = chi2 <= chi2[neighbours].min(axis=1)
        elsewhere = np.flatnonzero(lowest & (np.hypot(*(position - position[i]).T) > apart[i]))
        best = elsewhere[np.argsort(chi2[elsewhere])[:2]]
        numbers.append(np.full(best.size, i))
        contacts.append(np.concatenate([position[best], np.exp(logs[best])[:, None]], axis=1))
    return np.concatenate(numbers), np.concatenate(contacts)


def _tabulate(charge_map: ChargeMap, position: Array) -> tuple[ForceProfile, Array]:
    """Charges at every position as a function of the force."""
    low, high = np.log(charge_map.domain.force_range)
    nodes = chebyshev_nodes(FORCES, low, high) if high > low else np.array([low])
    forces = np.clip(np.exp(nodes), *charge_map.domain.force_range)
    rows = [charge_map.charges(np.column_stack([position, np.full(len(position), force)])) for force in forces]
    terms = np.stack([row / force**EXPONENT for row, force in zip(rows, forces, strict=True)], axis=1)
    barycentric = barycentric_weights(nodes)

    def weights(logs: Array) -> Array:
        return np.asarray(lagrange_values(nodes, barycentric, logs) * np.exp(EXPONENT * logs)[:, None])

    return ForceProfile.of(weights, charge_map.domain.force_range), terms
