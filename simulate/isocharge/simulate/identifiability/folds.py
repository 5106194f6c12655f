"""Folds of a charge map.

Charges determine a contact only where the map from (x, y, ln F) to the charges is one to one. Across a fold it is not:
its derivative J = d(Q)/d(x, y, ln F) loses rank and the map turns over. With three electrodes det J changes sign there,
and folds are lines. With more, J is not square and loses rank at points only; there the map crosses itself, and
contacts on both sides of the point have the same charges (Whitney 1944).

The map turns over between a and b if det(J(a)' W J(b)) < 0, with the weights W = 1 / sigma^2; for three electrodes this
is the sign of det J(a) det J(b). Between distant contacts that proves nothing with more than three electrodes: the map
may have turned by more than a right angle without losing rank, as it does beside an electrode. So what seems to turn
over is bisected until it does within FINEST, or until neither half does. In between, folds smaller than the grid are
reached by following the smallest singular value of J downhill.

Electrodes on one circle fold a biaxial film near this circle, however many they are: their charges hardly change if the
press moves to its mirror image in the circle.

Even without folds two contacts may have the same charges, see `ambiguous_pairs`.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.forward.charge_map import ChargeMap, linearised
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import INNER_RADIUS, Rings, onto_disk

FINEST = 0.02
"""Distance within which a map turns over at a fold, mm. Beside an electrode it may turn over within 0.1 mm and yet lose
nothing: at 1 N the charges still tell the sides apart. On a circle of four electrodes it takes some 0.01 mm."""

MOST_STEPS = 40
"""Steps downhill to a minimum at most: it takes 8 to 20, more where it creeps along a valley."""

COMPASS = np.stack([np.cos(np.pi * np.arange(8) / 4.0), np.sin(np.pi * np.arange(8) / 4.0)], axis=1)
"""Eight directions, shape (8, 2); a direction and the one four later are opposite."""


def turned_over(first: Array, second: Array) -> Booleans:
    """Whether the map turns over between neighbours, given J / sigma of both, shape (..., n_electrode, 3): (...)."""
    products = np.einsum("...ei,...ej->...ij", _unit_columns(first), _unit_columns(second))
    return np.asarray(np.linalg.det(products) < 0.0)


def _unit_columns(jacobian: Array) -> Array:
    """Columns of unit length: the sign of a determinant is then not lost in rounding."""
    return np.asarray(jacobian / np.maximum(np.linalg.norm(jacobian, axis=-2, keepdims=True), np.finfo(float).tiny))


def scaled_derivatives(charge_map: ChargeMap, contact: Array, noise: NoiseModel) -> Array:
    """J / sigma of contacts (x, y, F): shape (n, 3) to (n, n_electrode, 3), 1/mm, 1/mm and without unit."""
    charge, slopes = linearised(charge_map, contact)
    return np.asarray(slopes / noise.sigma(charge)[..., None])


def singular_values(scaled: Array) -> Array:
    """Singular values of J / sigma for the position with unknown force: (n, n_electrode, 3) to (n, 2), 1/mm.

    One over them are the smallest and the largest standard deviation of the position by direction; at a fold the second
    is zero.
    """
    toward = scaled[:, :, 2] / np.maximum(np.linalg.norm(scaled[:, :, 2], axis=1, keepdims=True), np.finfo(float).tiny)
    moved = scaled[:, :, :2]
    across = moved - toward[:, :, None] * np.einsum("ne,nei->ni", toward, moved)[:, None]
    return np.asarray(np.linalg.svd(across, compute_uv=False))


@dataclass(frozen=True)
class Folds:
    """Where a map folds under one force, and where it is nearest to folding.

    Attributes:
        points: Shape (n, 2), mm, the nearest to the centre first: on fold lines, with three electrodes; where rank is
            lost, with more.
        weakest: Local minima of the smallest singular value of J, shape (k, 2), mm: the position errors between the
            places of a grid are largest there.
    """

    points: Array
    weakest: Array


def find_folds(charge_map: ChargeMap, rings: Rings, force: float, noise: NoiseModel) -> Folds:
    """Folds and weakest places.

    Args:
        charge_map: The charges.
        rings: Positions between which folds are looked for; they need not be as fine as the folds.
        force: Force of the contacts, N.
        noise: Noise of the readings.
    """
    search = _FoldSearch(charge_map, noise, force)
    scaled = rings.per_ring(search.scaled(rings.position.reshape(-1, 2)))
    weakest = search.weakest_places(rings, scaled)
    points = np.concatenate([search.crossings(rings, scaled), search.folded(weakest)])
    return Folds(points[np.argsort(np.hypot(*points.T), kind="stable")], weakest)


class _FoldSearch:
    """The search under one force; positions have shape (n, 2), mm."""

    def __init__(self, charge_map: ChargeMap, noise: NoiseModel, force: float) -> None:
        self.charge_map, self.noise, self.force = charge_map, noise, force
        self.radius = INNER_RADIUS * charge_map.domain.radius

    def scaled(self, position: Array) -> Array:
        """J / sigma, shape (n, n_electrode, 3)."""
        at = onto_disk(position, self.radius)
        return scaled_derivatives(self.charge_map, np.column_stack([at, np.full(len(at), self.force)]), self.noise)

    def weakest(self, position: Array) -> Array:
        """Smallest singular value of J / sigma for the position, shape (n,), 1/mm."""
        return singular_values(self.scaled(position))[:, -1]

    def crossings(self, rings: Rings, scaled: Array) -> Array:
        """Folds between neighbours on the rings, with J / sigma of all, shape (n_ring, n_angle, n_electrode, 3)."""
        at = rings.position
        across = turned_over(scaled[:-1], scaled[1:])
        around = turned_over(scaled, np.roll(scaled, -1, axis=1))
        first = np.concatenate([at[:-1][across], at[around]])
        second = np.concatenate([at[1:][across], np.roll(at, -1, axis=1)[around]])
        return self._bisected(first, second)

    def _bisected(self, first: Array, second: Array) -> Array:
        """Middles of those segments, between whose ends the map turns over, that still do at a length of FINEST."""
        points = [np.empty((0, 2))]
        if len(first):
            start, end = self.scaled(first), self.scaled(second)
        while len(first):
            middle = 0.5 * (first + second)
            short = np.hypot(*(second - first).T) <= FINEST
            points.append(middle[short])
            between = self.scaled(middle)
            lower, upper = turned_over(start, between), turned_over(between, end)
            rest = ~short & (lower | upper)
            ahead = (upper & ~lower)[rest, None]
            first, second = np.where(ahead, middle[rest], first[rest]), np.where(ahead, second[rest], middle[rest])
            start = np.where(ahead[..., None], between[rest], start[rest])
            end = np.where(ahead[..., None], end[rest], between[rest])
        return np.concatenate(points)

    def weakest_places(self, rings: Rings, scaled: Array) -> Array:
        """Minima of the smallest singular value, followed downhill from those among the positions of the rings."""
        weakest = singular_values(scaled.reshape(-1, *scaled.shape[2:]))[:, -1].reshape(scaled.shape[:2])
        lowest = weakest == scipy.ndimage.minimum_filter(weakest, 3, mode=("nearest", "wrap"))
        step = np.maximum(rings.distance[0], rings.distance * 2.0 * np.pi / scaled.shape[1])
        ring, _ = np.nonzero(lowest)  # not empty: the lowest value of all is one
        return self._downhill(rings.position[lowest], weakest[lowest], step[ring])

    def folded(self, position: Array) -> Array:
        """Those positions about which the map turns over: folds that no two neighbours on the rings enclose."""
        around = self.scaled((position[:, None] + 0.5 * FINEST * COMPASS).reshape(-1, 2))
        around = around.reshape(len(position), 8, *around.shape[1:])
        return np.asarray(position[turned_over(around[:, :4], around[:, 4:]).any(axis=1)])

    def _downhill(self, position: Array, value: Array, step: Array) -> Array:
        """Minima of the smallest singular value near positions, by a compass search (Kolda, Lewis, Torczon 2003)."""
        active = np.flatnonzero(step > 0.1 * FINEST)
        for _ in range(MOST_STEPS):
            if not active.size:
                break
            tried = position[active, None] + step[active, None, None] * COMPASS
            tried = onto_disk(tried.reshape(-1, 2), self.radius)
            values = self.weakest(tried).reshape(-1, 8)
            best = values.argmin(axis=1)
            lowest = np.take_along_axis(values, best[:, None], axis=1)[:, 0]
            lower = lowest < value[active]
            moved = active[lower]
            position[moved], value[moved] = tried.reshape(-1, 8, 2)[lower, best[lower]], lowest[lower]
            step[active[~lower]] *= 0.5
            active = active[step[active] > 0.1 * FINEST]
        return position
