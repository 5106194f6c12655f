"""Candidates for the meeting of contours, and the grid of positions at which the search for them starts.

The module `triangulation` improves several candidates for each of many presses at once.
"""

from dataclasses import dataclass, fields

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.numerics.disk import INNER_RADIUS, onto_disk

NODE_SPACING = 0.6
"""Distance between neighbouring nodes of the grid, mm. Contours are almost straight on this scale."""

FORCES = 24
"""Number of forces at which the charges of each node are tabulated, equally spaced in ln F."""

MIN_SLOPE = 0.02
"""Lower bound for the slope of a charge, relative to the median slope of the electrode, dimensionless. It keeps the
distance = difference / slope finite where the charge has an extremum."""

RANGE_MARGIN = 0.02
"""Margin by which a charge may exceed the range of the charges of all nodes, relative to the range, dimensionless."""


@dataclass(frozen=True)
class Candidates:
    """Possible positions of presses, any number for each press.

    Attributes:
        press: Number of the press, shape (n,).
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        spread: Spread of the contours at the contact, shape (n,), mm; infinite before the search.
    """

    press: Integers
    contact: Array
    spread: Array

    @classmethod
    def begin(cls, press: Integers, contact: Array) -> "Candidates":
        """Create candidates from the starting points of a search."""
        return cls(press, contact, np.full(press.size, np.inf))

    def __getitem__(self, part: np.ndarray) -> "Candidates":
        """Return the candidates of a mask or of row numbers."""
        return Candidates(*(getattr(self, column.name)[part] for column in fields(self)))

    def joined(self, other: "Candidates") -> "Candidates":
        """Return these candidates followed by other candidates."""
        pairs = ((getattr(self, column.name), getattr(other, column.name)) for column in fields(self))
        return Candidates(*(np.concatenate(pair) for pair in pairs))

    def improved(self, contact: Array, spread: Array) -> "Candidates":
        """Replace the contacts of those candidates for which the new contact has a smaller spread.

        Args:
            contact: New contact of each candidate, shape (n, 3), mm and N.
            spread: Spread of the contours at the new contact, shape (n,), mm.
        """
        is_better = spread < self.spread
        contact = np.where(is_better[:, None], contact, self.contact)
        return Candidates(self.press, contact, np.where(is_better, spread, self.spread))

    def distinct(self, tolerance: float) -> "Candidates":
        """Sort the candidates by press and spread, and remove duplicates.

        Args:
            tolerance: Distance from a better candidate of the same press below which a candidate is removed, mm.

        Returns:
            The remaining candidates.
        """
        ordered = self[np.lexsort((self.spread, self.press))]
        first_row_of_press = np.searchsorted(ordered.press, ordered.press)
        rank = np.arange(ordered.press.size) - first_row_of_press  # 0 for the best candidate of a press
        is_distinct = np.ones(rank.size, dtype=bool)
        for candidate_rank in range(1, int(rank.max(initial=0)) + 1):
            # Compare the candidates of this rank, of all presses together, with those of each better rank.
            rows = np.flatnonzero(rank == candidate_rank)
            for better_rows in rows - 1 - np.arange(candidate_rank)[:, None]:
                offset = (ordered.contact[rows] - ordered.contact[better_rows])[:, :2]
                is_near = np.linalg.norm(offset, axis=1) <= tolerance
                is_distinct[rows] &= ~(is_near & is_distinct[better_rows])
        return ordered[np.flatnonzero(is_distinct)]


@dataclass(frozen=True)
class SeedGrid:
    """Charges on the nodes of a square grid over the disk, at forces that are equally spaced in the logarithm.

    Attributes:
        position: Positions of the nodes, shape (n_node, 2), mm.
        index: Index of each node in the flattened square grid, shape (n_node,).
        side: Number of nodes along a side of the square grid.
        logs: Logarithms of the forces (N), ascending, shape (n_force,).
        nodal: Charges, shape (n_force, n_node, n_electrode), pC.
        slope: Magnitude of the gradient of each charge with respect to the position at the middle force, bounded below
            by `MIN_SLOPE`, shape (n_node, n_electrode), pC/mm.
        size: Root mean square of all charges at each force relative to that at the middle force, shape (n_force,).
    """

    position: Array
    index: Integers
    side: int
    logs: Array
    nodal: Array
    slope: Array
    size: Array

    @classmethod
    def of(cls, charge_map: ChargeMap) -> "SeedGrid":
        """Create the grid over the domain of a charge map, including the edge of the disk."""
        # The nodes of a square grid that lie on the disk or slightly outside; the latter are moved onto its edge.
        radius = charge_map.domain.radius
        side = 2 * max(4, int(np.ceil(radius / NODE_SPACING))) + 1
        line = np.linspace(-radius, radius, side)
        square_grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
        index = np.flatnonzero(np.hypot(*square_grid.T) <= radius * (1.0 + 1.0 / side))
        position = onto_disk(square_grid[index], INNER_RADIUS * radius)

        min_force, max_force = charge_map.domain.force_range
        n_force = FORCES if max_force > min_force else 1
        logs = np.linspace(np.log(min_force), np.log(max_force), n_force)
        forces = np.clip(np.exp(logs), min_force, max_force)
        contacts = [np.column_stack([position, np.full(len(position), force)]) for force in forces]
        nodal = np.stack([charge_map.charges(contact) for contact in contacts])

        middle = forces.size // 2
        position_derivatives = charge_map.derivatives(contacts[middle])[..., :2]
        slope = np.linalg.norm(position_derivatives, axis=2)
        slope = np.maximum(slope, MIN_SLOPE * np.median(slope, axis=0))
        rms_charge = np.sqrt(np.mean(nodal**2, axis=(1, 2)))
        return cls(position, index, side, logs, nodal, slope, rms_charge / rms_charge[middle])

    def growth(self, force: Array) -> Array:
        """Interpolate the relative size of the charges at forces (N) of any shape; the result is dimensionless."""
        return np.interp(np.log(force), self.logs, self.size)

    def charge(self, force: Array) -> Array:
        """Interpolate the charges at all nodes.

        Args:
            force: Forces, shape (n, 1) or (n, n_node), N.

        Returns:
            Charges, shape (n, n_node, n_electrode), pC.
        """
        # Linear interpolation in ln F between the tabulated forces below and above
        fractional_index = np.interp(np.log(force), self.logs, np.arange(self.logs.size))
        index_below = np.minimum(fractional_index.astype(int), max(self.logs.size - 2, 0))
        index_above = np.minimum(index_below + 1, self.logs.size - 1)
        node = np.arange(len(self.position))
        weight_above = (fractional_index - index_below)[..., None]
        charge_below = self.nodal[index_below, node]
        charge_above = self.nodal[index_above, node]
        return np.asarray((1.0 - weight_above) * charge_below + weight_above * charge_above)

    def matching_force(self, charge: Array) -> Array:
        """Find the force at which the total charge of each node is equal to the total of given charges.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Forces, shape (n, n_node), N.
        """
        nodal_total = self.nodal.sum(axis=2)
        total = charge.sum(axis=1)
        sign = np.sign(nodal_total.sum())  # with negative coefficients the charges decrease with the force
        columns = [np.interp(sign * total, sign * column, self.logs) for column in nodal_total.T]
        return np.asarray(np.exp(np.stack(columns, axis=1)))

    def distance(self, charge: Array, force: Array) -> Array:
        """Estimate the root mean square distance of each node from the contours of given charges.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            force: Forces, shape (n, 1) or (n, n_node), N.

        Returns:
            Distances, shape (n, n_node), mm.
        """
        slope = self.growth(force)[..., None] * self.slope
        distance = (self.charge(force) - charge[:, None]) / slope
        return np.asarray(np.sqrt(np.mean(distance**2, axis=2)))

    def lowest(self, distance: Array, max_count: int) -> tuple[Integers, Integers]:
        """Select the nodes that have a smaller distance than their neighbours.

        Args:
            distance: Distance of each node for each press, shape (n, n_node), mm.
            max_count: Largest number of nodes for each press.

        Returns:
            Numbers of the presses and numbers of the nodes, each of shape (m,).
        """
        flat = np.full((len(distance), self.side**2), np.inf)
        flat[:, self.index] = distance
        square = flat.reshape(-1, self.side, self.side)
        neighbourhood_minimum = scipy.ndimage.minimum_filter(square, (1, 3, 3), mode="constant", cval=np.inf)
        is_minimum = (square == neighbourhood_minimum).reshape(len(distance), -1)[:, self.index]
        ranked = np.where(is_minimum, distance, np.inf)
        node = np.argpartition(ranked, max_count, axis=1)[:, :max_count]
        press, column = np.nonzero(np.isfinite(np.take_along_axis(ranked, node, axis=1)))
        return press, node[press, column]

    def is_out_of_range(self, charge: Array, force: Array | None) -> Booleans:
        """Return whether presses have a charge that no node has.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N. If it is None, the charges are compared with those of all forces.

        Returns:
            Shape (n,).
        """
        nodal = self.nodal.reshape(1, -1, charge.shape[1]) if force is None else self.charge(force[:, None])
        low = nodal.min(axis=1)
        high = nodal.max(axis=1)
        margin = RANGE_MARGIN * (high - low)
        return np.asarray(((charge < low - margin) | (charge > high + margin)).any(axis=1))
