"""Candidates for the meeting of contours, and the grid of positions where the search for them starts.

`triangulation` follows several candidates for each of many presses at once.
"""

from dataclasses import dataclass, fields

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.numerics.disk import INNER_RADIUS, onto_disk

NODE_SPACING = 0.6
"""Distance of the grid's nodes, mm: contours bend little on this scale."""

FORCES = 24
"""Number of forces at which the charges of each node are tabulated, evenly spaced in ln F."""

FLAT = 0.02
"""Lower bound for the slope of a charge, relative to the electrode's median slope, dimensionless: where the charge map
is flat, distance = difference / slope would be infinite."""


@dataclass(frozen=True)
class Candidates:
    """Possible positions, any number for each press.

    Attributes:
        press: Number of the press, shape (n,).
        contact: (x, y, F), shape (n, 3), mm and N.
        spread: Distance from a meeting of the contours, shape (n,), mm; infinite before the search.
    """

    press: Integers
    contact: Array
    spread: Array

    @classmethod
    def begin(cls, press: Integers, contact: Array) -> "Candidates":
        """Candidates to start from."""
        return cls(press, contact, np.full(press.size, np.inf))

    def __getitem__(self, part: np.ndarray) -> "Candidates":
        return Candidates(*(getattr(self, column.name)[part] for column in fields(self)))

    def joined(self, other: "Candidates") -> "Candidates":
        """These candidates and others."""
        pairs = ((getattr(self, column.name), getattr(other, column.name)) for column in fields(self))
        return Candidates(*(np.concatenate(pair) for pair in pairs))

    def improved(self, contact: Array, spread: Array) -> "Candidates":
        """These candidates, moved where the new contact is nearer to a meeting."""
        nearer = spread < self.spread
        contact = np.where(nearer[:, None], contact, self.contact)
        return Candidates(self.press, contact, np.where(nearer, spread, self.spread))

    def distinct(self, tolerance: float) -> "Candidates":
        """Candidates sorted by press and spread, without those within `tolerance` (mm) of a better one."""
        ordered = self[np.lexsort((self.spread, self.press))]
        rank = np.arange(ordered.press.size) - np.searchsorted(ordered.press, ordered.press)
        keep = np.ones(rank.size, dtype=bool)
        for worse in range(1, int(rank.max(initial=0)) + 1):
            row = np.flatnonzero(rank == worse)
            for better in row - 1 - np.arange(worse)[:, None]:
                near = np.linalg.norm((ordered.contact[row] - ordered.contact[better])[:, :2], axis=1) <= tolerance
                keep[row] &= ~(near & keep[better])
        return ordered[np.flatnonzero(keep)]


@dataclass(frozen=True)
class SeedGrid:
    """Charges on the nodes of a square grid over the disk, at forces evenly spaced in the logarithm.

    Attributes:
        at: Positions of the nodes, shape (n_node, 2), mm.
        place: Their index in the grid, shape (n_node,).
        side: Number of nodes along the grid's side.
        logs: Logarithms of the forces (N), shape (n_force,).
        nodal: Charges, shape (n_force, n_node, n_electrode), pC.
        slope: Length of the charges' slopes at the middle force, at least FLAT of the electrode's median; shape
            (n_node, n_electrode), pC/mm.
        size: Root mean square of all charges at each force relative to that at the middle force, shape (n_force,).
    """

    at: Array
    place: Integers
    side: int
    logs: Array
    nodal: Array
    slope: Array
    size: Array

    @classmethod
    def of(cls, charge_map: ChargeMap) -> "SeedGrid":
        """Grid over a map's disk, edge included."""
        radius, (low, high) = charge_map.domain.radius, charge_map.domain.force_range
        side = 2 * max(4, int(np.ceil(radius / NODE_SPACING))) + 1
        line = np.linspace(-radius, radius, side)
        grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
        place = np.flatnonzero(np.hypot(*grid.T) <= radius * (1.0 + 1.0 / side))
        at = onto_disk(grid[place], INNER_RADIUS * radius)
        logs = np.linspace(np.log(low), np.log(high), FORCES if high > low else 1)
        forces = np.clip(np.exp(logs), low, high)
        nodal = np.stack([charge_map.charges(np.column_stack([at, np.full(len(at), force)])) for force in forces])
        middle = np.column_stack([at, np.full(len(at), forces[forces.size // 2])])
        slope = np.linalg.norm(charge_map.derivatives(middle)[..., :2], axis=2)
        size = np.sqrt(np.mean(nodal**2, axis=(1, 2)))
        slope = np.maximum(slope, FLAT * np.median(slope, axis=0))
        return cls(at, place, side, logs, nodal, slope, size / size[size.size // 2])

    def growth(self, force: Array) -> Array:
        """Size of the charges at forces (N) of any shape, relative to that at the middle force."""
        return np.interp(np.log(force), self.logs, self.size)

    def charge(self, force: Array) -> Array:
        """Charges at all nodes for forces of shape (n, 1) or (n, n_node), N: shape (n, n_node, n_electrode), pC."""
        share = np.interp(np.log(force), self.logs, np.arange(self.logs.size))
        below = np.minimum(share.astype(int), max(self.logs.size - 2, 0))
        above, node = np.minimum(below + 1, self.logs.size - 1), np.arange(len(self.at))
        weight = (share - below)[..., None]
        return np.asarray((1.0 - weight) * self.nodal[below, node] + weight * self.nodal[above, node])

    def matching_force(self, charge: Array) -> Array:
        """Force at which each node has the total of the charges (n, n_electrode), shape (n, n_node), N."""
        totals, total = self.nodal.sum(axis=2), charge.sum(axis=1)
        sign = np.sign(totals.sum())  # with negative coefficients the charges fall with the force
        columns = [np.interp(sign * total, sign * column, self.logs) for column in totals.T]
        return np.asarray(np.exp(np.stack(columns, axis=1)))

    def distance(self, charge: Array, force: Array) -> Array:
        """Root mean square distance from each node to the contours of charges (n, n_electrode); (n, n_node), mm."""
        away = (self.charge(force) - charge[:, None]) / (self.growth(force)[..., None] * self.slope)
        return np.asarray(np.sqrt(np.mean(away**2, axis=2)))

    def lowest(self, distance: Array, most: int) -> tuple[Integers, Integers]:
        """Nodes with a smaller distance than their neighbours, at most `most` per press: (press, node), each (n,)."""
        grid = np.full((len(distance), self.side**2), np.inf)
        grid[:, self.place] = distance
        square = grid.reshape(-1, self.side, self.side)
        low = (square == scipy.ndimage.minimum_filter(square, (1, 3, 3), mode="constant", cval=np.inf)).reshape(
            len(distance), -1
        )
        ranked = np.where(low[:, self.place], distance, np.inf)
        node = np.argpartition(ranked, most, axis=1)[:, :most]
        press, column = np.nonzero(np.isfinite(np.take_along_axis(ranked, node, axis=1)))
        return press, node[press, column]

    def out_of_reach(self, charge: Array, force: Array | None) -> Booleans:
        """Whether presses have a charge that no node has, at the force (n,) or, if that is None, at any: shape (n,)."""
        nodal = self.nodal.reshape(1, -1, charge.shape[1]) if force is None else self.charge(force[:, None])
        low, high = nodal.min(axis=1), nodal.max(axis=1)
        slack = 0.02 * (high - low)
        return np.asarray(((charge < low - slack) | (charge > high + slack)).any(axis=1))
