"""Where a charge map folds, and which contacts far apart give the same charges.

Charges tell a contact only where the map from (x, y, ln F) to the charges is one to one. It stops being so across a
fold, where J = d(Q)/d(x, y, ln F) loses rank and turns over. With three electrodes det J changes sign there. With more,
J spans a space of its own at each contact; between neighbours the map has turned over where
det(J(a)' W J(b)) < 0, W = 1 / sigma^2. For three electrodes that is the sign of det J(a) det J(b), so one rule does for
all. Electrodes on one circle fold a biaxial film near this circle, however many they are: what they collect hardly
changes if the press moves to its mirror image in the circle.

Without any fold two contacts may still be alike: `find_twins` looks for them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from isocharge.simulate.arrays import Array, Booleans, Integers
from isocharge.simulate.force_curve import ForceCurve
from isocharge.simulate.limits import ChargeModel, limits_at
from isocharge.simulate.noise import NoiseModel
from isocharge.simulate.sampling import lattice
from isocharge.simulate.spectral import barycentric_weights, chebyshev_nodes, lagrange_values

ALIKE = 3.0
"""Distance of the charges, in standard deviations, up to which two contacts count as alike."""

APART, WIDTHS = 1e-3, 6.0
"""Twins are farther from each other than this (m), and than so many standard deviations of the position."""

FORCES = 8
"""Forces at which a twin's charges are tabulated."""

POLISH, DAMPING = 8, 1e-3
"""Levenberg and Marquardt's steps for a twin, and their damping."""

EXPONENT = 2.0 / 3.0
"""Of the charge over the force, roughly: what is tabulated is what remains."""


@dataclass(frozen=True)
class Rings:
    """Positions on rings about the centre.

    Attributes:
        distance: From the centre, shape (n_ring,), m.
        position: x and y, shape (n_ring, n_angle, 2), m.
    """

    distance: Array
    position: Array

    @classmethod
    def spread(cls, radius: float, rings: int = 100, angles: int = 180) -> "Rings":
        """Evenly up to the radius, without the centre."""
        distance = radius * np.arange(1, rings + 1) / rings
        at = np.outer(distance, np.exp(2j * np.pi * np.arange(angles) / angles))
        return cls(distance, np.stack([at.real, at.imag], axis=-1))

    def contacts(self, force: float) -> Array:
        """(x, y, F) of every position, shape (n_ring * n_angle, 3)."""
        flat = self.position.reshape(-1, 2)
        return np.concatenate([flat, np.full((len(flat), 1), force)], axis=1)

    def per_ring(self, values: Array) -> Array:
        """Values of all contacts as (n_ring, n_angle, ...)."""
        return values.reshape(*self.position.shape[:2], *values.shape[1:])


def turned_over(first: Array, second: Array) -> Booleans:
    """Whether the map turns over between neighbours, given J / sigma of both, shape (..., n_electrode, 3): (...)."""
    products = np.einsum("...ei,...ej->...ij", _unit_columns(first), _unit_columns(second))
    over: Booleans = np.linalg.det(products) < 0.0
    return over


def _unit_columns(jacobian: Array) -> Array:
    """Scaled so that the sign of a determinant is not lost in rounding."""
    unit: Array = jacobian / np.maximum(np.linalg.norm(jacobian, axis=-2, keepdims=True), np.finfo(float).tiny)
    return unit


def fold_points(model: ChargeModel, rings: Rings, force: float, noise: NoiseModel) -> Array:
    """Positions between neighbouring places of the rings across which the map turns over, shape (n, 2), m."""
    contact = rings.contacts(force)
    scaled = rings.per_ring(model.jacobian(contact) / noise.sigma(model.charge(contact))[..., None])
    across, around = turned_over(scaled[:-1], scaled[1:]), turned_over(scaled, np.roll(scaled, -1, axis=1))
    at = rings.position
    points: Array = np.concatenate(
        [0.5 * (at[:-1] + at[1:])[across], 0.5 * (at + np.roll(at, -1, axis=1))[around]], axis=0
    )
    return points


@dataclass(frozen=True)
class Twins:
    """Pairs of contacts with the same charges, the nearest to the centre first.

    Attributes:
        first: (x, y, F), shape (n, 3), m and N.
        second: The same for its twin.
        distance: Between their charges, in standard deviations, shape (n,).
    """

    first: Array
    second: Array
    distance: Array

    @classmethod
    def none(cls) -> "Twins":
        """No pair."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))

    def __len__(self) -> int:
        return len(self.first)

    @property
    def reach(self) -> Array:
        """How far from the centre the outer one of each pair is, shape (n,), m."""
        reach: Array = np.maximum(np.hypot(*self.first[:, :2].T), np.hypot(*self.second[:, :2].T))
        return reach


def find_twins(model: ChargeModel, noise: NoiseModel, force: float, places: int = 1000) -> Twins:
    """Contacts far apart whose charges are alike within the noise.

    For each place of a square lattice, pressed with `force`, every other place is tried with the force that fits best
    there; the best two are improved by least squares.

    Args:
        model: The charges.
        noise: Of the readings.
        force: Of the first of each pair, N; the twin may have any.
        places: Of the lattice: 1,000 take some 3 s with splines.
    """
    unit = lattice(places)
    position = model.radius * (1.0 - 1e-9) * np.stack([unit.real, unit.imag], axis=1)
    first = np.concatenate([position, np.full((len(position), 1), force)], axis=1)
    charge = model.charge(first)
    apart = np.maximum(APART, WIDTHS * limits_at(model, first, noise).position)
    pairs, start = _candidates(model, noise, position, charge, apart)
    second, distance = _polish(model, noise, charge[pairs], start)
    far = np.hypot(*(second - first[pairs])[:, :2].T) > apart[pairs]
    kept = np.flatnonzero(far & (distance < ALIKE))
    found = Twins(first[pairs[kept]], second[kept], distance[kept])
    order = np.argsort(found.reach, kind="stable")
    return Twins(found.first[order], found.second[order], found.distance[order])


def _candidates(
    model: ChargeModel, noise: NoiseModel, position: Array, charge: Array, apart: Array
) -> tuple[Integers, Array]:
    """Numbers of places and contacts (x, y, F) elsewhere that may be their twins."""
    curve, terms = _tabulate(model, position)
    near = cKDTree(position)
    neighbours = near.query(position, min(9, len(position)))[1]
    numbers, contacts = [], []
    for i, own in enumerate(charge):
        both = np.broadcast_to(own, charge.shape)
        logs = curve.best(terms, both, noise)
        known = curve.charge(logs, terms)
        chi2 = ((both - known) ** 2 / noise.variance(known)).sum(axis=1)
        lowest = chi2 <= chi2[neighbours].min(axis=1)
        elsewhere = np.flatnonzero(lowest & (np.hypot(*(position - position[i]).T) > apart[i]))
        best = elsewhere[np.argsort(chi2[elsewhere])[:2]]
        numbers.append(np.full(best.size, i))
        contacts.append(np.concatenate([position[best], np.exp(logs[best])[:, None]], axis=1))
    return np.concatenate(numbers), np.concatenate(contacts)


def _tabulate(model: ChargeModel, position: Array) -> tuple[ForceCurve, Array]:
    """Charges at every place as a function of the force."""
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

    return ForceCurve.of(weights, model.force_range), terms


def _polish(model: ChargeModel, noise: NoiseModel, charge: Array, start: Array) -> tuple[Array, Array]:
    """Contacts whose charges are nearest to those given, and the distance in standard deviations."""
    contact, chi2 = start, _chi2(model, noise, charge, start)
    damping = np.full(len(start), DAMPING)
    for _ in range(POLISH):
        known = model.charge(contact)
        weighted = model.jacobian(contact) / noise.sigma(known)[..., None]
        normal = np.einsum("nei,nej->nij", weighted, weighted)
        diagonal = np.einsum("nii->ni", normal)
        pull = np.einsum("nei,ne->ni", weighted, (charge - known) / noise.sigma(known))
        held = normal + (damping[:, None] * diagonal)[:, :, None] * np.eye(3)
        step = np.linalg.solve(held, pull[..., None])[..., 0]
        tried = _inside(model, contact, step)
        fresh = _chi2(model, noise, charge, tried)
        better = fresh < chi2
        contact, chi2 = np.where(better[:, None], tried, contact), np.where(better, fresh, chi2)
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
    return contact, np.sqrt(chi2)


def _chi2(model: ChargeModel, noise: NoiseModel, charge: Array, contact: Array) -> Array:
    known = model.charge(contact)
    chi2: Array = ((charge - known) ** 2 / noise.variance(known)).sum(axis=1)
    return chi2


def _inside(model: ChargeModel, contact: Array, step: Array) -> Array:
    """Contacts moved by steps in (x, y, ln F) and brought back onto the disk and into the range of forces."""
    position = contact[:, :2] + step[:, :2]
    shrink = np.minimum(1.0, model.radius * (1.0 - 1e-9) / np.maximum(np.hypot(*position.T), 1e-300))
    force = np.clip(contact[:, 2] * np.exp(np.clip(step[:, 2], -1.0, 1.0)), *model.force_range)
    return np.concatenate([position * shrink[:, None], force[:, None]], axis=1)
