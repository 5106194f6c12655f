"""Candidates for the point at which contours meet, and the grid of positions at which the search for candidates starts.

The module `triangulation` improves several candidates for each of many presses at once.
"""

from dataclasses import dataclass

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
"""Lower bound for the slope of a charge, relative to the median slope of the electrode, dimensionless.

It keeps the distance = difference / slope finite where the charge has an extremum.
"""

RANGE_MARGIN = 0.02
"""Margin by which a charge may exceed the range of the charges of all nodes, relative to the range, dimensionless."""


@dataclass(frozen=True)
class Candidates:
    """Possible positions of presses. Each press may have any number of candidates.

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
        """Create candidates from the starting points of a search.

        Args:
            press: Number of the press of each starting point, shape (n,).
            contact: Starting points (x, y, F), shape (n, 3), mm and N.
        """
        return cls(press, contact, np.full(press.size, np.inf))

    def __getitem__(self, rows: np.ndarray) -> "Candidates":
        """Return the candidates that a mask or an array of row indices selects."""
        return Candidates(self.press[rows], self.contact[rows], self.spread[rows])

    def joined(self, other: "Candidates") -> "Candidates":
        """Return these candidates followed by other candidates."""
        return Candidates(
            press=np.concatenate([self.press, other.press]),
            contact=np.concatenate([self.contact, other.contact]),
            spread=np.concatenate([self.spread, other.spread]),
        )

    def improved(self, contact: Array, spread: Array) -> "Candidates":
        """Replace the contact of each candidate whose new contact has a smaller spread.

        Args:
            contact: New contact of each candidate, shape (n, 3), mm and N.
            spread: Spread of the contours at the new contact, shape (n,), mm.
        """
        is_better = spread < self.spread
        contact = np.where(is_better[:, None], contact, self.contact)
        return Candidates(self.press, contact, np.where(is_better, spread, self.spread))

    def distinct(self, tolerance: float) -> "Candidates":
        """Sort the candidates by press and spread, and remove duplicates.

        A candidate is a duplicate if a remaining candidate of the same press with a smaller spread is near.

        Args:
            tolerance: Distance from a better candidate of the same press below which a candidate is removed, mm.

        Returns:
            The remaining candidates.
        """
        ordered = self[np.lexsort((self.spread, self.press))]
        first_row_of_press = np.searchsorted(ordered.press, ordered.press)
        rank = np.arange(ordered.press.size) - first_row_of_press  # 0 for the best candidate of a press
        is_distinct = np.ones(rank.size, dtype=bool)
        worst_rank = int(rank.max(initial=0))
        for candidate_rank in range(1, worst_rank + 1):
            # Compare the candidates of this rank, of all presses together, with those of each better rank.
            rows = np.flatnonzero(rank == candidate_rank)
            for rank_difference in range(1, candidate_rank + 1):
                better_rows = rows - rank_difference  # the candidates of a press are in consecutive rows
                offset = (ordered.contact[rows] - ordered.contact[better_rows])[:, :2]
                is_near = np.linalg.norm(offset, axis=1) <= tolerance
                # A candidate remains if it is near a better candidate that is a duplicate itself.
                is_distinct[rows] &= ~(is_near & is_distinct[better_rows])
        return ordered[np.flatnonzero(is_distinct)]


@dataclass(frozen=True)
class SeedGrid:
    """Charges on the nodes of a square grid over the disk. The logarithms of the forces are equally spaced.

    Attributes:
        position: Positions of the nodes, shape (n_node, 2), mm.
        index: Index of each node in the flattened square grid, shape (n_node,).
        side: Number of nodes along a side of the square grid.
        log_forces: Logarithms of the forces (N), ascending, shape (n_force,).
        node_charges: Charges, shape (n_force, n_node, n_electrode), pC.
        slope: Magnitude of the gradient of each charge with respect to the position at the middle force, bounded below
            by `MIN_SLOPE`, shape (n_node, n_electrode), pC/mm.
        relative_size: Root mean square of all charges at each force, relative to that at the middle force, shape
            (n_force,), dimensionless.
    """

    position: Array
    index: Integers
    side: int
    log_forces: Array
    node_charges: Array
    slope: Array
    relative_size: Array

    @classmethod
    def of(cls, charge_map: ChargeMap) -> "SeedGrid":
        """Create the grid over the domain of a charge map, including the edge of the disk.

        Args:
            charge_map: Charges as a function of the contact.
        """
        side, index, position = _nodes_on_disk(charge_map.domain.radius)

        # Charges of the nodes for each force, shape (n_force, n_node, n_electrode)
        min_force, max_force = charge_map.domain.force_range
        n_force = FORCES if max_force > min_force else 1
        log_forces = np.linspace(np.log(min_force), np.log(max_force), n_force)
        forces = np.clip(np.exp(log_forces), min_force, max_force)
        contacts = [np.column_stack([position, np.full(len(position), force)]) for force in forces]
        node_charges = np.stack([charge_map.charges(contact) for contact in contacts])

        # Slopes at the middle force, with a lower bound, and root mean square of all charges at each force
        middle = forces.size // 2
        gradient = charge_map.derivatives(contacts[middle])[..., :2]  # with respect to x and y
        gradient_length = np.linalg.norm(gradient, axis=2)
        median_length = np.median(gradient_length, axis=0)
        rms_charge = np.sqrt(np.mean(node_charges**2, axis=(1, 2)))
        return cls(
            position=position,
            index=index,
            side=side,
            log_forces=log_forces,
            node_charges=node_charges,
            slope=np.maximum(gradient_length, MIN_SLOPE * median_length),
            relative_size=rms_charge / rms_charge[middle],
        )

    def growth(self, force: Array) -> Array:
        """Interpolate the relative size of the charges at forces (N) of any shape."""
        return np.interp(np.log(force), self.log_forces, self.relative_size)

    def charge(self, force: Array) -> Array:
        """Interpolate the charges at all nodes between the tabulated forces.

        Args:
            force: Forces, shape (n, 1) or (n, n_node), N.

        Returns:
            Charges, shape (n, n_node, n_electrode), pC.
        """
        # Linear interpolation in ln F between the tabulated forces below and above
        n_force = self.log_forces.size
        fractional_index = np.interp(np.log(force), self.log_forces, np.arange(n_force))
        index_below = np.minimum(fractional_index.astype(int), max(n_force - 2, 0))
        index_above = np.minimum(index_below + 1, n_force - 1)
        node = np.arange(len(self.position))
        weight_above = (fractional_index - index_below)[..., None]
        # The index of the node selects the second axis, so the results have the shape (n, n_node, n_electrode).
        charge_below = self.node_charges[index_below, node]
        charge_above = self.node_charges[index_above, node]
        return np.asarray((1.0 - weight_above) * charge_below + weight_above * charge_above)

    def matching_force(self, charge: Array) -> Array:
        """Find the force at which the total charge of each node is equal to the total of given charges.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Forces, shape (n, n_node), N.
        """
        total = charge.sum(axis=1)  # shape (n,)
        node_totals = self.node_charges.sum(axis=2)  # shape (n_force, n_node)

        # `np.interp` needs ascending totals. With negative coefficients, the charges decrease with the force.
        sign = np.sign(node_totals.sum())
        ascending_totals = sign * node_totals.T  # shape (n_node, n_force)
        log_forces = [np.interp(sign * total, node_total, self.log_forces) for node_total in ascending_totals]
        return np.asarray(np.exp(np.stack(log_forces, axis=1)))

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
            Indices of the presses and indices of the nodes, each of shape (m,).
        """
        # Compare each node with its neighbours on the square grid. Nodes outside the disk have an infinite distance.
        n_press = len(distance)
        flat_grid = np.full((n_press, self.side**2), np.inf)
        flat_grid[:, self.index] = distance
        square_grid = flat_grid.reshape(-1, self.side, self.side)  # one grid for each press
        neighbourhood_minimum = scipy.ndimage.minimum_filter(square_grid, (1, 3, 3), mode="constant", cval=np.inf)
        is_minimum = (square_grid == neighbourhood_minimum).reshape(n_press, -1)[:, self.index]

        # Take the `max_count` nodes with the smallest distances of each press, and remove those that are no minimum.
        distance_of_minimum = np.where(is_minimum, distance, np.inf)
        node = np.argpartition(distance_of_minimum, max_count, axis=1)[:, :max_count]
        selected_distance = np.take_along_axis(distance_of_minimum, node, axis=1)
        press, column = np.nonzero(np.isfinite(selected_distance))
        return press, node[press, column]

    def is_out_of_range(self, charge: Array, force: Array | None) -> Booleans:
        """Return whether each press has a charge outside the range of the charges at the nodes.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N. If it is None, the range includes the charges at all forces.

        Returns:
            Whether each press has such a charge, shape (n,).
        """
        if force is None:  # the charges at all nodes and forces, which are the same for all presses
            node_charges = self.node_charges.reshape(1, -1, charge.shape[1])
        else:
            node_charges = self.charge(force[:, None])
        low = node_charges.min(axis=1)
        high = node_charges.max(axis=1)
        margin = RANGE_MARGIN * (high - low)
        return np.asarray(((charge < low - margin) | (charge > high + margin)).any(axis=1))


def _nodes_on_disk(radius: float) -> tuple[int, Integers, Array]:
    """Select the nodes of a square grid that lie on a disk or slightly outside, and move the latter onto its edge.

    Args:
        radius: Radius of the disk, mm.

    Returns:
        Number of nodes along a side of the square grid. Index of each selected node in the flattened square grid, shape
        (n_node,). Positions (x, y) of the selected nodes, shape (n_node, 2), mm.
    """
    side = 2 * max(4, int(np.ceil(radius / NODE_SPACING))) + 1  # odd, so that the centre of the disk is a node
    line = np.linspace(-radius, radius, side)
    square_grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    grid_x, grid_y = square_grid.T
    index = np.flatnonzero(np.hypot(grid_x, grid_y) <= radius * (1.0 + 1.0 / side))
    position = onto_disk(square_grid[index], INNER_RADIUS * radius)
    return side, index, position
