"""Contacts far apart with the same charges.

A map without folds may still give two distant contacts the same charges, as a sheet may lie on itself without a crease.
The search for such pairs covers the whole film at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.forward.charge_model import ChargeModel
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.force_profile import ForceProfile
from isocharge.simulate.identifiability.nearest_contact import nearest_contact
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import lattice
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values

INDISTINGUISHABLE_SIGMAS = 3.0
"""Largest difference of the charges at which two contacts count as the same, standard deviations of the noise."""

APART, WIDTHS = 1e-3, 6.0
"""Smallest distance of an ambiguous pair: APART, m, and WIDTHS standard deviations of the position. Nearer contacts are
one uncertain contact."""

FORCES = 8
"""Number of forces at which the charges of the second contact are tabulated."""

EXPONENT = 2.0 / 3.0
"""Exponent of the force in the charge of a slack membrane, dimensionless; the ratio of the charge to this power of the
force is tabulated, because it varies little."""


@dataclass(frozen=True)
class AmbiguousPairs:
    """Pairs of contacts with the same charges, the nearest to the centre first.

    Attributes:
        first: (x, y, F), shape (n, 3), m and N.
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

    @classmethod
    def joined(cls, pairs: Sequence["AmbiguousPairs"]) -> "AmbiguousPairs":
        """All pairs of several searches."""
        every = [cls.none(), *pairs]
        joined = cls(
            np.concatenate([each.first for each in every]),
            np.concatenate([each.second for each in every]),
            np.concatenate([each.distance for each in every]),
        )
        order = np.argsort(joined.reach, kind="stable")
        return cls(joined.first[order], joined.second[order], joined.distance[order])

    def __len__(self) -> int:
        return len(self.first)

    @property
    def reach(self) -> Array:
        """Distance of the outer contact of each pair from the centre, shape (n,), m."""
        reach: Array = np.maximum(np.hypot(*self.first[:, :2].T), np.hypot(*self.second[:, :2].T))
        return reach

    @property
    def words(self) -> str:
        """The pair nearest to the centre, in a sentence; nothing without pairs."""
        if not len(self):
            return ""
        (x, y, force), (other_x, other_y, other_force) = self.first[0], self.second[0]
        return (
            f"Contacts far apart can have the same charges: {force:.3g} N at ({1e3 * x:.1f}, {1e3 * y:.1f}) mm and "
            f"{other_force:.3g} N at ({1e3 * other_x:.1f}, {1e3 * other_y:.1f}) mm are alike within "
            f"{self.distance[0]:.1f} standard deviations."
        )


def find_ambiguous_pairs(model: ChargeModel, noise: NoiseModel, force: float, places: int = 1000) -> AmbiguousPairs:
    """Pairs of contacts far apart whose charges differ by less than the noise.

    For each position of a square lattice, pressed with `force`, every other position is tried with the force that fits
    best; the best two are improved by least squares.

    Args:
        model: The charges.
        noise: Noise of the readings.
        force: Force of the first contact of each pair, N; the second may have any.
        places: Number of positions of the lattice: 1,000 take some 3 s with splines.
    """
    unit = lattice(places)
    position = model.radius * (1.0 - 1e-9) * np.stack([unit.real, unit.imag], axis=1)
    first = np.concatenate([position, np.full((len(position), 1), force)], axis=1)
    charge = model.charge(first)
    apart = np.maximum(APART, WIDTHS * limits_at(model, first, noise).position)
    pairs, start = _candidates(model, noise, position, charge, apart)
    if not pairs.size:
        return AmbiguousPairs.none()
    second, distance = nearest_contact(model, noise, charge[pairs], start)
    far = np.hypot(*(second - first[pairs])[:, :2].T) > apart[pairs]
    ambiguous = np.flatnonzero(far & (distance < INDISTINGUISHABLE_SIGMAS))
    return AmbiguousPairs.joined([AmbiguousPairs(first[pairs[ambiguous]], second[ambiguous], distance[ambiguous])])


def _candidates(
    model: ChargeModel, noise: NoiseModel, position: Array, charge: Array, apart: Array
) -> tuple[Integers, Array]:
    """Numbers of first contacts, and for each a contact (x, y, F) far away that may have the same charges."""
    curve, terms = _tabulate(model, position)
    near = cKDTree(position)
    neighbours = near.query(position, min(9, len(position)))[1]
    numbers, contacts = [], []
    for i, row in enumerate(charge):
        observed = np.broadcast_to(row, charge.shape)
        logs = curve.best(terms, observed, noise)
        known = curve.charge(logs, terms)
        chi2 = ((observed - known) ** 2 / noise.variance(known)).sum(axis=1)
        lowest = chi2 <= chi2[neighbours].min(axis=1)
        elsewhere = np.flatnonzero(lowest & (np.hypot(*(position - position[i]).T) > apart[i]))
        best = elsewhere[np.argsort(chi2[elsewhere])[:2]]
        numbers.append(np.full(best.size, i))
        contacts.append(np.concatenate([position[best], np.exp(logs[best])[:, None]], axis=1))
    return np.concatenate(numbers), np.concatenate(contacts)


def _tabulate(model: ChargeModel, position: Array) -> tuple[ForceProfile, Array]:
    """Charges at every position as a function of the force."""
    low, high = np.log(model.force_range)
    nodes = chebyshev_nodes(FORCES, low, high) if high > low else np.array([low])
    rows = [
        model.charge(np.concatenate([position, np.full((len(position), 1), np.exp(node))], axis=1)) for node in nodes
    ]
    terms = np.stack([row / np.exp(EXPONENT * node) for row, node in zip(rows, nodes, strict=True)], axis=1)
    barycentric = barycentric_weights(nodes)

    def weights(logs: Array) -> Array:
        by_force: Array = lagrange_values(nodes, barycentric, logs) * np.exp(EXPONENT * logs)[:, None]
        return by_force

    return ForceProfile.of(weights, model.force_range), terms
