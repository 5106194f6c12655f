"""Candidates for the meeting of contours: a grid of starting points, their bookkeeping, and the Gauss-Newton step.

`triangulation` follows several candidates for each of many presses at once.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import minimum_filter

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.numerics.disk import onto_disk

NODE_SPACING = 0.6e-3
"""Distance of the grid's nodes, m: contours bend little on this scale."""

FORCES = 24
"""Number of forces at which the total charge of each node is tabulated, evenly spaced in ln F."""

FLAT = 0.02
"""Lower bound for the slope of a charge, relative to the electrode's median slope, dimensionless: where the charge map
is flat, distance = misfit / slope would be infinite."""

LARGEST_STEP, DAMPING = 1e-3, 1e-10
"""Largest length of a Gauss-Newton step, m; damping that keeps it finite where contours touch, dimensionless."""


@dataclass(frozen=True)
class Candidates:
    """Possible positions, any number for each press.

    Attributes:
        press: Number of the press, shape (n,).
        at: Position (x, y), shape (n, 2), m.
        force: Force, shape (n,), N.
        spread: Distance from a meeting of the contours, shape (n,), m.
        triples: Number of triples of electrodes that the position is the average of, shape (n,).
    """

    press: Integers
    at: Array
    force: Array
    spread: Array
    triples: Integers

    def __getitem__(self, part: np.ndarray) -> "Candidates":
        return Candidates(self.press[part], self.at[part], self.force[part], self.spread[part], self.triples[part])

    @classmethod
    def begin(cls, press: Integers, at: Array, force: Array) -> "Candidates":
        """Candidates to start from: their distance from a meeting counts as infinite."""
        return cls(press, at, force, np.full(press.size, np.inf), np.zeros(press.size, dtype=np.intp))

    def joined(self, others: "Candidates") -> "Candidates":
        """These candidates and others."""
        return Candidates(*(np.concatenate([getattr(self, n), getattr(others, n)]) for n in self.__dataclass_fields__))

    def improved(self, at: Array, force: Array, spread: Array) -> "Candidates":
        """These candidates, moved where the new position is nearer to a meeting."""
        nearer = spread < self.spread
        return Candidates(
            self.press,
            np.where(nearer[:, None], at, self.at),
            np.where(nearer, force, self.force),
            np.where(nearer, spread, self.spread),
            self.triples,
        )

    def within(self, tolerance: float) -> "Candidates":
        """Candidates at most `tolerance` (m) from a meeting."""
        return self[np.flatnonzero(self.spread <= tolerance)]

    def distinct(self, tolerance: float) -> "Candidates":
        """Candidates sorted by press and spread, without those within `tolerance` (m) of a better one."""
        ordered = self[np.lexsort((self.spread, self.press))]
        rank = np.arange(ordered.press.size) - np.searchsorted(ordered.press, ordered.press)
        keep = np.ones(rank.size, dtype=bool)
        for worse in range(1, int(rank.max(initial=0)) + 1):
            row = np.flatnonzero(rank == worse)
            for better in row - 1 - np.arange(worse)[:, None]:
                near = np.linalg.norm(ordered.at[row] - ordered.at[better], axis=1) <= tolerance
                keep[row] &= ~(near & keep[better])
        return ordered[np.flatnonzero(keep)]


@dataclass(frozen=True)
class SeedGrid:
    """Charges on the nodes of a square grid over the disk, where the search for a meeting starts.

    Attributes:
        table: The charges.
        at: Positions of the nodes on the disk, shape (n_node, 2), m.
        place: Their index in the grid, shape (n_node,).
        side: Number of nodes along the grid's side.
    """

    table: ChargeSpline
    at: Array
    place: Integers
    side: int

    @classmethod
    def of(cls, table: ChargeSpline) -> "SeedGrid":
        """Grid over a table's disk, edge included."""
        side = 2 * max(4, int(np.ceil(table.radius / NODE_SPACING))) + 1
        line = np.linspace(-1.0, 1.0, side) * table.radius
        grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
        place = np.flatnonzero(np.hypot(*grid.T) <= table.radius * (1.0 + 1.0 / side))
        return cls(table, onto_disk(grid[place], table.radius), place, side)

    @cached_property
    def nodal(self) -> Array:
        """Scaled charges at the nodes, shape (n_force, n_node, n_electrode)."""
        nodal: Array = np.moveaxis(self.table.terms(self.at), 1, 0)
        return nodal

    @cached_property
    def gauge(self) -> Array:
        """Length of the slopes at the middle force over `table.scale`, bounded by FLAT; (n_node, n_electrode), 1/m."""
        middle = np.sqrt(np.prod(self.table.force_range))
        _, slope, _ = self.table.first_order(self.at, middle)
        gauge: Array = np.linalg.norm(slope, axis=2) / self.table.scale(middle)
        return np.maximum(gauge, FLAT * np.median(gauge, axis=0))

    def charge(self, force: Array) -> Array:
        """Charges at all nodes for forces of shape (n, 1) or (n, n_node), N: shape (n, n_node, n_electrode), C."""
        n_force, n_node, n_electrode = self.nodal.shape
        weights = self.table.by_force(np.log(force))
        if force.shape[1] == 1:
            return (weights[:, 0] @ self.nodal.reshape(n_force, -1)).reshape(-1, n_node, n_electrode)
        charge: Array = np.einsum("pnf,fne->pne", weights, self.nodal)
        return charge

    def matching_force(self, charge: Array) -> Array:
        """Force within the table at which each node has the total of the charges, shape (n, n_node), N."""
        low, high = np.log(self.table.force_range)
        logs = np.linspace(low, high, FORCES)
        totals, total = self.charge(np.exp(logs)[:, None]).sum(axis=2), charge.sum(axis=1)
        sign = np.sign(totals.sum())  # with negative coefficients the charges fall with the force
        matching = [np.interp(sign * total, sign * totals[:, node], logs) for node in range(len(self.at))]
        force: Array = np.exp(np.stack(matching, axis=1))
        return force

    def distance(self, charge: Array, force: Array) -> Array:
        """Root mean square distance from each node to the contours of charges (n, n_electrode); (n, n_node), m."""
        away = self.charge(force) - charge[:, None]
        gauge = self.table.scale(force)[..., None] * self.gauge
        distance: Array = np.sqrt(np.mean((away / gauge) ** 2, axis=2))
        return distance

    def lowest(self, distance: Array, most: int) -> tuple[Integers, Integers]:
        """Nodes with a smaller distance than their neighbours, at most `most` per press: (press, node), each (n,)."""
        grid = np.full((len(distance), self.side**2), np.inf)
        grid[:, self.place] = distance
        square = grid.reshape(-1, self.side, self.side)
        low = (square == minimum_filter(square, (1, 3, 3), mode="constant", cval=np.inf)).reshape(len(distance), -1)
        ranked = np.where(low[:, self.place], distance, np.inf)
        node = np.argpartition(ranked, most, axis=1)[:, :most]
        press, column = np.nonzero(np.isfinite(np.take_along_axis(ranked, node, axis=1)))
        return press, node[press, column]

    def reach(self, force: Array) -> tuple[Array, Array]:
        """Smallest and largest charge of each electrode at forces of shape (n,), N; each (n, n_electrode), C."""
        charge = self.charge(force[:, None])
        return charge.min(axis=1), charge.max(axis=1)


def gauss_newton_step(slope: Array, away: Array) -> Array:
    """The step of Gauss and Newton towards the least sum of squared distances.

    Args:
        slope: Derivatives of the distances by the unknowns, shape (n, n_distance, n_unknown), of order one.
        away: Distances, shape (n, n_distance), m.

    Returns:
        Step, shape (n, n_unknown), m, no longer than LARGEST_STEP.
    """
    square = np.einsum("nij,nik->njk", slope, slope) + DAMPING * np.eye(slope.shape[2])
    step: Array = -np.linalg.solve(square, np.einsum("nij,ni->nj", slope, away)[..., None])[..., 0]
    step *= np.minimum(1.0, LARGEST_STEP / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
    return step
