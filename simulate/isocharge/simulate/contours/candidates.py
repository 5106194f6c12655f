"""Candidates for the position at which contours meet, and a grid of possible starting points for their search.

Each press has several candidates, and the module `triangulation` improves the candidates of many presses at once.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.numerics.disk import INNER_RADIUS, onto_disk

NODE_SPACING = 0.6
"""Distance between neighbouring nodes of the grid, mm. Contours are almost straight over this distance."""

FORCES = 24
"""Number of forces at which the charges of each node are tabulated. Their logarithms are equally spaced."""

MIN_SLOPE = 0.02
"""Lower bound of the slope of a charge, relative to the median slope of the electrode, dimensionless.

The distance from a contour is estimated as a difference of charges divided by the slope. The bound keeps this distance
finite where the charge has an extremum.
"""

RANGE_MARGIN = 0.02
"""Margin by which a charge may lie outside the range of the charges at all nodes, divided by the width of the range."""


@dataclass(frozen=True)
class Candidates:
    """Possible contacts (candidates) of several presses. Each press may have any number of candidates.

    The spread of a candidate is a length. It is zero if all contours of the press meet at the candidate, and it is
    larger if the contours pass the candidate at some distance.

    Attributes:
        press: Index of the press to which each candidate belongs, shape (n,).
        contact: Contact (x, y, F) of each candidate, shape (n, 3), mm and N.
        spread: Spread of each candidate, shape (n,), mm; infinite if it has not been computed yet.
    """

    press: Integers
    contact: Array
    spread: Array

    @classmethod
    def from_starting_points(cls, press: Integers, contact: Array) -> "Candidates":
        """Convert starting points into candidates with an infinite spread, because no spread has been computed yet.

        Args:
            press: Index of the press to which each starting point belongs, shape (n,).
            contact: Starting points (x, y, F), shape (n, 3), mm and N.
        """
        return cls(press, contact, np.full(press.size, np.inf))

    def __getitem__(self, rows: np.ndarray) -> "Candidates":
        """Return the candidates that a mask or an array of indices selects."""
        return Candidates(self.press[rows], self.contact[rows], self.spread[rows])

    def joined_with(self, other: "Candidates") -> "Candidates":
        """Return these candidates, followed by the candidates of another object."""
        return Candidates(
            press=np.concatenate([self.press, other.press]),
            contact=np.concatenate([self.contact, other.contact]),
            spread=np.concatenate([self.spread, other.spread]),
        )

    def replaced_where_better(self, contact: Array, spread: Array) -> "Candidates":
        """Replace the contact of each candidate by a new contact if the new contact has a smaller spread.

        Args:
            contact: New contact (x, y, F) for each candidate, shape (n, 3), mm and N.
            spread: Spread at each new contact, shape (n,), mm.
        """
        is_better = spread < self.spread
        better_contact = np.where(is_better[:, None], contact, self.contact)
        smaller_spread = np.where(is_better, spread, self.spread)
        return Candidates(self.press, better_contact, smaller_spread)

    def without_duplicates(self, tolerance: float) -> "Candidates":
        """Sort the candidates by press and by spread, and remove duplicates.

        A candidate is a duplicate if it is near a candidate of the same press that has a smaller spread and is not a
        duplicate itself. The forces of the candidates are not compared.

        Args:
            tolerance: Largest distance between the positions of two candidates that are near to each other, mm.

        Returns:
            The remaining candidates in the new order.
        """
        ordered = self[np.lexsort((self.spread, self.press))]
        first_row_of_press = np.searchsorted(ordered.press, ordered.press)
        rank = np.arange(ordered.press.size) - first_row_of_press  # 0 for the best candidate of a press
        is_distinct = np.ones(rank.size, dtype=bool)
        worst_rank = int(rank.max(initial=0))

        # Compare the candidates of each rank with the better candidates of their press, for all presses at once. The
        # candidates of a press are in consecutive rows, in the order of their ranks. A better candidate is therefore
        # `rank_difference` rows earlier.
        for candidate_rank in range(1, worst_rank + 1):
            rows = np.flatnonzero(rank == candidate_rank)
            for rank_difference in range(1, candidate_rank + 1):
                better_rows = rows - rank_difference
                position_difference = (ordered.contact[rows] - ordered.contact[better_rows])[:, :2]
                is_near = np.linalg.norm(position_difference, axis=1) <= tolerance
                is_distinct[rows] &= ~(is_near & is_distinct[better_rows])
        return ordered[np.flatnonzero(is_distinct)]


@dataclass(frozen=True)
class SeedGrid:
    """Charges at the nodes of a square grid over a disk.

    The search for the contacts at which contours meet starts at some of the nodes.

    Attributes:
        position: Positions (x, y) of the nodes, shape (n_node, 2), mm.
        index: Index of each node in the flattened square grid, shape (n_node,).
        side: Number of nodes along a side of the square grid.
        log_forces: Natural logarithms of the tabulated forces in N, equally spaced and ascending, shape (n_force,).
        node_charges: Charges at each node for each force, shape (n_force, n_node, n_electrode), pC.
        slope: Magnitude of the gradient of each charge with respect to the position at the middle force, shape (n_node,
            n_electrode), pC/mm. It is at least `MIN_SLOPE` times its median over the nodes.
        relative_rms_charge: Root mean square of all charges at each force, divided by that at the middle force, shape
            (n_force,), dimensionless.
    """

    position: Array
    index: Integers
    side: int
    log_forces: Array
    node_charges: Array
    slope: Array
    relative_rms_charge: Array

    @classmethod
    def from_charge_map(cls, charge_map: ChargeMap) -> "SeedGrid":
        """Create a grid over the domain of a charge map, and compute the charges at its nodes.

        The forces are equally spaced in ln F. There is a single force if the domain of the map has a single force.

        Args:
            charge_map: Map that computes the charges of contacts.
        """
        side, index, position = _nodes_on_disk(charge_map.domain.radius)

        # Compute the charges of the nodes for each force, shape (n_force, n_node, n_electrode).
        min_force, max_force = charge_map.domain.force_range
        n_force = FORCES if max_force > min_force else 1
        log_forces = np.linspace(np.log(min_force), np.log(max_force), n_force)
        forces = np.clip(np.exp(log_forces), min_force, max_force)  # otherwise rounding may leave the domain
        contacts = [np.column_stack([position, np.full(len(position), force)]) for force in forces]
        node_charges = np.stack([charge_map.charges(contact) for contact in contacts])

        # Compute the slopes at the middle force, and the root mean square of all charges at each force.
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
            relative_rms_charge=rms_charge / rms_charge[middle],
        )

    def relative_rms_charge_at(self, force: Array) -> Array:
        """Interpolate the ratio of the root mean square charge at given forces to that at the middle force.

        Args:
            force: Forces, any shape, N.

        Returns:
            Ratios, of the shape of `force`, dimensionless.
        """
        return np.interp(np.log(force), self.log_forces, self.relative_rms_charge)

    def charge(self, force: Array) -> Array:
        """Interpolate the charges at all nodes for given forces, linearly in ln F.

        Args:
            force: One force for each of n presses, shape (n, 1), or one for each press and node, shape (n, n_node), N.

        Returns:
            Charges, shape (n, n_node, n_electrode), pC.
        """
        # Find the tabulated forces below and above each force. The index below is at most `n_force - 2`, so that there
        # is a tabulated force above it. In a grid with a single force, both indices are 0.
        n_force = self.log_forces.size
        fractional_index = np.interp(np.log(force), self.log_forces, np.arange(n_force))
        index_below = np.minimum(fractional_index.astype(int), max(n_force - 2, 0))
        index_above = np.minimum(index_below + 1, n_force - 1)
        node = np.arange(len(self.position))
        weight_above = (fractional_index - index_below)[..., None]

        # The two index arrays are broadcast to the shape (n, n_node), so the charges have the shape (n, n_node,
        # n_electrode).
        charge_below = self.node_charges[index_below, node]
        charge_above = self.node_charges[index_above, node]
        return np.asarray((1.0 - weight_above) * charge_below + weight_above * charge_above)

    def matching_force(self, charge: Array) -> Array:
        """Find the force at which the total charge of each node is equal to the total charge of each press.

        The total charge is the sum of the charges of all electrodes. If no tabulated force is small or large enough,
        the smallest or the largest one is returned.

        Args:
            charge: Charges of the presses, shape (n, n_electrode), pC.

        Returns:
            Force for each press and node, shape (n, n_node), N.
        """
        total = charge.sum(axis=1)  # shape (n,)
        node_totals = self.node_charges.sum(axis=2)  # shape (n_force, n_node)

        # `np.interp` needs ascending totals. If the piezoelectric coefficients are negative, the totals decrease with
        # the force, so their sign is reversed.
        sign = np.sign(node_totals.sum())
        ascending_totals = sign * node_totals.T  # shape (n_node, n_force)
        log_forces = [np.interp(sign * total, node_total, self.log_forces) for node_total in ascending_totals]
        return np.asarray(np.exp(np.stack(log_forces, axis=1)))

    def distance(self, charge: Array, force: Array) -> Array:
        """Estimate the distance of each node from the contours of each press (root mean square over the contours).

        Args:
            charge: Charges of the presses, shape (n, n_electrode), pC.
            force: One force for each press, shape (n, 1), or one for each press and node, shape (n, n_node), N.

        Returns:
            Distances, shape (n, n_node), mm.
        """
        # To first order, the distance from a contour is the difference of the charges divided by the slope. The slope
        # increases with the force like the charges.
        slope = self.relative_rms_charge_at(force)[..., None] * self.slope
        distance = (self.charge(force) - charge[:, None]) / slope
        return np.asarray(np.sqrt(np.mean(distance**2, axis=2)))

    def local_minima(self, distance: Array, max_count: int) -> tuple[Integers, Integers]:
        """Select the nodes at which the distance from the contours of a press has its smallest local minima.

        A node is a local minimum if none of its eight neighbours on the grid has a smaller distance.

        Args:
            distance: Distance of each node from the contours of each press, shape (n, n_node), mm.
            max_count: Largest number of selected nodes for each press.

        Returns:
            Index of the press and index of the node for each selected node, each of shape (m,).
        """
        # Arrange the distances on the square grid, in which nodes outside the disk have an infinite distance. The
        # filter returns the smallest distance among each node and its neighbours.
        n_press = len(distance)
        flat_grid = np.full((n_press, self.side**2), np.inf)
        flat_grid[:, self.index] = distance
        square_grid = flat_grid.reshape(-1, self.side, self.side)  # one grid for each press
        neighbourhood_minimum = scipy.ndimage.minimum_filter(square_grid, (1, 3, 3), mode="constant", cval=np.inf)
        is_minimum = (square_grid == neighbourhood_minimum).reshape(n_press, -1)[:, self.index]

        # Select `max_count` nodes of each press: the local minima with the smallest distances. All other nodes get an
        # infinite distance.
        distance_of_minimum = np.where(is_minimum, distance, np.inf)
        selected_nodes = np.argpartition(distance_of_minimum, max_count, axis=1)[:, :max_count]  # (n, max_count)

        # If a press has fewer than `max_count` local minima, remove the selected nodes that are not local minima.
        selected_distance = np.take_along_axis(distance_of_minimum, selected_nodes, axis=1)
        press, column = np.nonzero(np.isfinite(selected_distance))
        return press, selected_nodes[press, column]

    def is_out_of_range(self, charge: Array, force: Array | None) -> Booleans:
        """Return for each press whether at least one of its charges lies outside the range of the charges at the nodes.

        Args:
            charge: Charges of the presses, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N. If it is None, the range includes the charges at all forces.

        Returns:
            Whether a charge of each press lies outside the range, shape (n,).
        """
        if force is None:
            # All presses share the charges at all nodes and forces, shape (1, n_force * n_node, n_electrode).
            node_charges = self.node_charges.reshape(1, -1, charge.shape[1])
        else:
            node_charges = self.charge(force[:, None])
        smallest_charge = node_charges.min(axis=1)
        largest_charge = node_charges.max(axis=1)
        margin = RANGE_MARGIN * (largest_charge - smallest_charge)
        is_too_small = charge < smallest_charge - margin
        is_too_large = charge > largest_charge + margin
        return np.asarray((is_too_small | is_too_large).any(axis=1))


def _nodes_on_disk(radius: float) -> tuple[int, Integers, Array]:
    """Select the nodes of a square grid that lie in a disk or slightly outside it.

    The nodes slightly outside the disk are moved to its edge.

    Args:
        radius: Radius of the disk, mm.

    Returns:
        Number of nodes along a side of the square grid. Index of each selected node in the flattened square grid, shape
        (n_node,). Positions (x, y) of the selected nodes, shape (n_node, 2), mm.
    """
    side = 2 * max(4, int(np.ceil(radius / NODE_SPACING))) + 1  # odd, so that the centre of the disk is a node
    coordinates = np.linspace(-radius, radius, side)
    square_grid = np.stack(np.meshgrid(coordinates, coordinates, indexing="ij"), axis=-1).reshape(-1, 2)
    grid_x, grid_y = square_grid.T
    margin = radius / side  # about half of the distance between neighbouring nodes
    index = np.flatnonzero(np.hypot(grid_x, grid_y) <= radius + margin)
    position = onto_disk(square_grid[index], INNER_RADIUS * radius)
    return side, index, position
