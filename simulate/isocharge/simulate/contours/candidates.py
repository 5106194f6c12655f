"""Where contours may meet: nodes to begin at, candidates on the way, the step between.

The bookkeeping of `triangulation`: many presses at once, several candidates for each.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import minimum_filter

from isocharge.arrays import Array, Integers
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.numerics.disk import onto_disk

NODE_SPACING = 0.6e-3
"""Distance of the nodes that are tried, m: contours bend little on this scale."""

FORCES = 24
"""Forces at which the nodes' total charges are tabled, evenly in the logarithm."""

FLAT = 0.02
"""Share of an electrode's median slope that slopes count as at least: on a hilltop a contour is not infinitely far."""

LARGEST_STEP, DAMPING = 1e-3, 1e-10
"""Of a Newton step: its length at most (m), and what keeps it finite where contours touch."""


@dataclass(frozen=True)
class Candidates:
    """Possible positions, any number for each press.

    Attributes:
        press: Whose, shape (n,).
        at: (x, y), shape (n, 2), m.
        force: Shape (n,), N.
        spread: How far from a meeting, shape (n,), m.
        triples: How many triples of electrodes it is the average of, shape (n,).
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
        """Infinitely far from a meeting as yet."""
        return cls(press, at, force, np.full(press.size, np.inf), np.zeros(press.size, dtype=np.intp))

    def joined(self, others: "Candidates") -> "Candidates":
        """These and others."""
        return Candidates(*(np.concatenate([getattr(self, n), getattr(others, n)]) for n in self.__dataclass_fields__))

    def improved(self, at: Array, force: Array, spread: Array) -> "Candidates":
        """These, moved where that brings them nearer to a meeting."""
        nearer = spread < self.spread
        return Candidates(
            self.press,
            np.where(nearer[:, None], at, self.at),
            np.where(nearer, force, self.force),
            np.where(nearer, spread, self.spread),
            self.triples,
        )

    def within(self, tolerance: float) -> "Candidates":
        """Those no farther than this from a meeting."""
        return self[np.flatnonzero(self.spread <= tolerance)]

    def distinct(self, tolerance: float) -> "Candidates":
        """Sorted by press and spread, without those that lie within `tolerance` (m) of a better one of their press."""
        ordered = self[np.lexsort((self.spread, self.press))]
        rank = np.arange(ordered.press.size) - np.searchsorted(ordered.press, ordered.press)
        keep = np.ones(rank.size, dtype=bool)
        for worse in range(1, int(rank.max(initial=0)) + 1):
            here = np.flatnonzero(rank == worse)
            for better in here - 1 - np.arange(worse)[:, None]:
                near = np.linalg.norm(ordered.at[here] - ordered.at[better], axis=1) <= tolerance
                keep[here] &= ~(near & keep[better])
        return ordered[np.flatnonzero(keep)]


@dataclass(frozen=True)
class SeedGrid:
    """A square grid over the disk with the charges there.

    Attributes:
        table: The charges.
        at: Nodes on the disk, shape (n_node, 2), m.
        place: Their index in the grid, shape (n_node,).
        side: Nodes along the grid's side.
    """

    table: ChargeSpline
    at: Array
    place: Integers
    side: int

    @classmethod
    def of(cls, table: ChargeSpline) -> "SeedGrid":
        """Over a table's disk, edge included."""
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
        """Length of the slopes at the middle force, over `table.scale`, shape (n_node, n_electrode), 1/m."""
        middle = np.sqrt(np.prod(self.table.force_range))
        _, slope, _ = self.table.first_order(self.at, middle)
        gauge: Array = np.linalg.norm(slope, axis=2) / self.table.scale(middle)
        return np.maximum(gauge, FLAT * np.median(gauge, axis=0))

    def charge(self, force: Array) -> Array:
        """Charges at all nodes, forces of shape (n, 1) or (n, n_node), N; (n, n_node, n_electrode), C."""
        n_force, n_node, n_electrode = self.nodal.shape
        weights = self.table.by_force(np.log(force))
        if force.shape[1] == 1:
            return (weights[:, 0] @ self.nodal.reshape(n_force, -1)).reshape(-1, n_node, n_electrode)
        charge: Array = np.einsum("pnf,fne->pne", weights, self.nodal)
        return charge

    def matching_force(self, charge: Array) -> Array:
        """Force at which each node has the total of the charges, as far as the table goes; (n, n_node), N."""
        low, high = np.log(self.table.force_range)
        logs = np.linspace(low, high, FORCES)
        totals, wanted = self.charge(np.exp(logs)[:, None]).sum(axis=2), charge.sum(axis=1)
        sign = np.sign(totals.sum())  # a film of negative coefficients gives ever more negative charges
        found = [np.interp(sign * wanted, sign * totals[:, node], logs) for node in range(len(self.at))]
        force: Array = np.exp(np.stack(found, axis=1))
        return force

    def distance(self, charge: Array, force: Array) -> Array:
        """Root mean square distance from each node to the contours of charges (n, n_electrode); (n, n_node), m."""
        away = self.charge(force) - charge[:, None]
        gauge = self.table.scale(force)[..., None] * self.gauge
        distance: Array = np.sqrt(np.mean((away / gauge) ** 2, axis=2))
        return distance

    def lowest(self, distance: Array, most: int) -> tuple[Integers, Integers]:
        """Nodes that lie lower than their neighbours, at most so many for each press: (press, node), each (n,)."""
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
    """The step that brings distances `away` to zero, or their squares to the least.

    Args:
        slope: Their derivatives by the unknowns, shape (n, n_distance, n_unknown), of order one.
        away: Shape (n, n_distance), m.

    Returns:
        Shape (n, n_unknown), m, no longer than LARGEST_STEP.
    """
    square = np.einsum("nij,nik->njk", slope, slope) + DAMPING * np.eye(slope.shape[2])
    step: Array = -np.linalg.solve(square, np.einsum("nij,ni->nj", slope, away)[..., None])[..., 0]
    step *= np.minimum(1.0, LARGEST_STEP / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
    return step
