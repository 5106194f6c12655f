"""Local refinement of the mesh along the edges of a coat.

An element is split into halves or quarters that have the same size in its local coordinates. Therefore the refined mesh
can represent every field of the original mesh. If a small element is adjacent to a larger element, the nodes of the
small element on the common side are called hanging nodes. The values at the hanging nodes are determined by the
polynomial of the larger element (Ainsworth and Senior 1997). Therefore the fields are continuous.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.mesh.coating import Coating
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.mesh.template import Template, sample_points
from isocharge.simulate.numerics.interpolation import lagrange_values, lobatto_nodes, lobatto_weights, tensor_values
from isocharge.simulate.numerics.polygon import area_of, min_edge_cross_product, to_corners

GRADING = 1.0
"""Largest distance between an edge of the coat and the middle of an element at which the element is split.

The unit is the longest side of the element.
"""

MIN_SIDE_RATIO = 0.5
"""Smallest ratio of a side to the longest side of its element at which the side is halved, dimensionless.

Because of this limit, thin elements at the rim are halved only along their length.
"""

MAX_SPLITS = 12
"""Largest number of successive splits of an element."""

NODE_TOLERANCE = 1e-8
"""Distance below which two nodes under the sample press are treated as the same node, in film radii."""


EDGE_ELEMENT_SIZE = 0.35
"""Longest allowed side of an element at an edge of the coat.

The unit is the square root of the area of the largest part of the coat.
"""

BAND = 0.6
"""Width of the band along an edge in which the bare and the coated film form a laminate.

The unit is the longest side of an element at the edge.
"""


class _HangingNodeSource(NamedTuple):
    """Nodes of a larger element that determine the value at a hanging node.

    Attributes:
        nodes: Numbers of the nodes on the side of the larger element, shape (order + 1,).
        weights: Weights of these nodes, shape (order + 1,).
    """

    nodes: Integers
    weights: Array


class RefinedTemplate(Template):
    """Template of a whole film in which some elements are split.

    Attributes:
        base: The original template.
        parent: Index of the original element in which each element lies, shape (n_element,).
        low: Lower left corner (xi, eta) of each element in the local coordinates of its original element, shape
            (n_element, 2).
        size: Lengths of the sides of each element in the local coordinates of its original element, shape
            (n_element, 2). The possible lengths are 2, 1, 1/2, and so on.
        splits: The arrays `parent`, `low` and `size` as columns, shape (n_element, 5), by which templates are compared.
    """

    def __init__(self, base: Template, parent: Integers, low: Array, size: Array) -> None:
        """Number the nodes of the split elements.

        Args:
            base: The original template.
            parent: Index of the original element in which each element lies, shape (n_element,).
            low: Lower left corner (xi, eta) of each element in the local coordinates of its original element, shape
                (n_element, 2).
            size: Lengths of the sides of each element in the local coordinates of its original element, shape
                (n_element, 2).
        """
        is_whole = not base.half
        super().__init__(base.resolution, base.topology, is_whole)
        self.base = base
        self.parent = parent
        self.low = low
        self.size = size
        self.n_element = parent.size
        self.splits = np.column_stack([parent, low, size])

        # Nodes of different elements are the same node if they have the same position on the film. The positions are
        # computed for an arbitrary press, the sample press, because the result is the same for all presses.
        points = self.from_base(sample_points(base)).ravel()
        self.n_node, node_number = _number_points(points)
        self.nodes: Integers = node_number.reshape(self.n_element, -1)
        _, self.first_occurrence = np.unique(node_number, return_index=True)  # index in `points` for each node number

        # The rim consists of the outer sides (xi = 1) of the original elements of the last ring, which have the highest
        # indices.
        is_in_last_ring = parent >= base.n_element - base.n_sector
        parent_xi, _ = self._into_parent(self.xi, self.eta)
        is_on_outer_side = parent_xi > 1.0 - 1e-12
        self.on_rim = np.zeros(self.n_node, dtype=bool)
        self.on_rim[self.nodes[is_in_last_ring[:, None] & is_on_outer_side]] = True
        self.on_axis = np.zeros(self.n_node, dtype=bool)  # the mesh of a whole film has no line of symmetry
        self.constraint = self._hanging_node_matrix(points)

    @property
    def footprint(self) -> Integers:
        """Indices of the elements that fill the footprint."""
        parents_in_footprint = np.arange(self.base.n_element)[self.base.footprint]
        return np.flatnonzero(np.isin(self.parent, parents_in_footprint))

    def from_base(self, values: Array | Complexes) -> np.ndarray:
        """Interpolate values from the nodes of the original elements to the nodes of the split elements.

        Args:
            values: Values at the nodes of the original elements, shape (n_original_element, n_local, ...).

        Returns:
            Values at the nodes of the split elements, shape (n_element, n_local, ...).
        """
        xi, eta = self._into_parent(self.xi, self.eta)  # each of shape (n_element, n_local)
        weights = tensor_values(self.resolution.order, xi.ravel(), eta.ravel())
        weights_of_element = weights.reshape(self.n_element, self.xi.size, -1)
        # Sum over the nodes m of the original element, for each split element e and its node n.
        return np.asarray(np.einsum("enm,em...->en...", weights_of_element, values[self.parent]))

    def to_split_elements(self, element: Integers, xi: Array, eta: Array) -> tuple[Integers, Array, Array]:
        """Convert positions in the original elements into positions in the split elements.

        The split elements have different sizes. For each size, the original elements can be divided into a regular grid
        of cells of this size. Every split element of this size is one of the cells. Each cell is identified by a code.
        The method computes the code of the cell that contains a point, and searches for a split element with this code.

        Args:
            element: Index of the original element of each point, shape (n,).
            xi: First local coordinate in the original element, from -1 to 1, shape (n,).
            eta: Second local coordinate in the original element, from -1 to 1, shape (n,).

        Returns:
            Index of the split element, and local coordinates xi and eta in the split element, each of shape (n,).
        """
        split_element = np.zeros_like(element)
        position = np.stack([xi, eta])  # shape (2, n)
        for size in np.unique(self.size, axis=0):
            candidates, candidate_codes = self._elements_of_size(size)  # ordered by their codes

            # Compute the codes of the cells that contain the points. Points on the upper edge of the original element,
            # where a local coordinate is 1, belong to the last cell.
            cell_size = size[:, None]
            point_cells = np.floor((position + 1.0) / cell_size).astype(np.intp)
            last_cell = np.rint(2.0 / cell_size).astype(np.intp) - 1
            point_codes = self._cell_codes(element, np.clip(point_cells, 0, last_cell))

            # For each point, find the first candidate whose code is not smaller than the code of the point. If there is
            # no such candidate, the last candidate is used. The candidate contains the point if the codes are equal.
            first_not_smaller = np.searchsorted(candidate_codes, point_codes)
            candidate_index = np.minimum(first_not_smaller, candidates.size - 1)
            is_match = candidate_codes[candidate_index] == point_codes
            split_element[is_match] = candidates[candidate_index[is_match]]

        # Convert the positions into local coordinates of the split elements, from -1 to 1.
        low = self.low[split_element].T
        half_size = 0.5 * self.size[split_element].T
        split_xi, split_eta = (position - low) / half_size - 1.0
        return split_element, split_xi, split_eta

    def _cell_codes(self, parent: Integers, cell: Integers) -> Integers:
        """Return a unique number for each cell of the original elements.

        The number is (parent * m + column) * m + row, where m is the largest number of cells along a side.

        Args:
            parent: Index of the original element of each cell, shape (n,).
            cell: Column along xi and row along eta of each cell in its original element, shape (2, n).

        Returns:
            Numbers, shape (n,).
        """
        # A side of an original element has the length 2 in local coordinates.
        max_cells_per_side = 2 ** round(1.0 - np.log2(self.size.min()))
        column, row = cell
        return np.asarray((parent * max_cells_per_side + column) * max_cells_per_side + row)

    def _into_parent(self, xi: Array, eta: Array) -> Array:
        """Convert local coordinates of all split elements into local coordinates of their original elements.

        Args:
            xi: First local coordinates, the same for all elements, shape (n,).
            eta: Second local coordinates, the same for all elements, shape (n,).

        Returns:
            Local coordinates xi and eta in the original elements, shape (2, n_element, n).
        """
        local = np.stack([xi, eta])[:, None]  # shape (2, 1, n)
        low = self.low.T[:, :, None]  # shape (2, n_element, 1)
        size = self.size.T[:, :, None]
        return low + 0.5 * size * (local + 1.0)

    def _elements_of_size(self, size: Array) -> tuple[Integers, Integers]:
        """Return the split elements of a given size, sorted by the codes of their cells.

        Args:
            size: Lengths of the sides in the local coordinates of the original element, shape (2,).

        Returns:
            Indices of the elements, and codes of their cells in ascending order, each of shape (n,).
        """
        elements = np.flatnonzero((self.size == size).all(axis=1))
        cells = np.rint((self.low[elements].T + 1.0) / size[:, None]).astype(np.intp)
        codes = self._cell_codes(self.parent[elements], cells)
        order = np.argsort(codes)
        return elements[order], codes[order]

    def _hanging_node_matrix(self, points: Complexes) -> csr_array:
        """Compute the matrix that converts the values at the regular nodes into the values at all nodes.

        A hanging node is a node of a small element that lies on the side of a larger element without being a node of
        the larger element. The polynomial of the larger element determines the value at the hanging node. All other
        nodes are called regular nodes.

        Args:
            points: Film points x + iy of the nodes of all elements, shape (n_element * n_local,).

        Returns:
            Matrix, shape (n_node, n_node). The columns of hanging nodes are zero.
        """
        order = self.resolution.order
        sources = self._hanging_node_sources(points)
        hanging_nodes = np.array(list(sources), dtype=np.intp)
        regular_nodes = np.setdiff1d(np.arange(self.n_node), hanging_nodes)

        # The row of a regular node has a single weight of 1. The row of a hanging node has order + 1 weights, one for
        # each node on the side of the larger element.
        row = np.concatenate([regular_nodes, np.repeat(hanging_nodes, order + 1)])
        column = np.concatenate([regular_nodes, *(source.nodes for source in sources.values())])
        weight = np.concatenate([np.ones(regular_nodes.size), *(source.weights for source in sources.values())])
        direct_dependence = csr_array((weight, (row, column)), shape=(self.n_node, self.n_node))

        # A hanging node may depend on another hanging node. Substitute the dependence until all columns that are used
        # belong to regular nodes.
        constraint = direct_dependence
        while np.isin(constraint.indices, hanging_nodes).any():
            constraint = direct_dependence @ constraint
            constraint.eliminate_zeros()
        return constraint

    def _hanging_node_sources(self, points: Complexes) -> dict[int, _HangingNodeSource]:
        """Find the hanging nodes, and the nodes that determine the values at the hanging nodes.

        A hanging node is a node of a small element that lies on the side of a larger element without being a node of
        the larger element. A side of a large element may be adjacent to 2, 4, 8 or more smaller elements. For each
        possible number of smaller elements, the method computes the positions on the side at which the smaller elements
        would have nodes. A node at such a position is a hanging node, unless the node belongs to the large element.

        Args:
            points: Film points x + iy of the nodes of all elements, shape (n_element * n_local,).

        Returns:
            Dictionary with the number of each hanging node as key, and the nodes that determine its value.
        """
        order = self.resolution.order
        line_nodes = lobatto_nodes(order)

        # Local indices of the nodes on the four sides of an element, eta = -1, eta = 1, xi = -1 and xi = 1
        local_index = np.arange((order + 1) ** 2).reshape(order + 1, -1)  # one row for each eta, one column for each xi
        sides = np.stack([local_index[0], local_index[-1], local_index[:, 0], local_index[:, -1]])

        # Nodes on the sides of all elements that may be adjacent to smaller elements. Elements
        # both of whose sides have the smallest length are omitted.
        large_elements = np.flatnonzero(self.size.max(axis=1) > self.size.min())
        nodes_on_sides = self.nodes[large_elements][:, sides]  # shape (n_large, 4, order + 1)
        points_on_sides = points.reshape(self.nodes.shape)[large_elements][:, sides]

        node_tree = _tree(points[self.first_occurrence])  # finds the node at a film point
        max_halvings = round(np.log2(self.size.max() / self.size.min()))  # of a side of the largest element
        sources: dict[int, _HangingNodeSource] = {}
        for halvings in range(1, max_halvings + 1):
            # Compute the film points at which smaller elements would have nodes, if the side is divided into equal
            # parts. The local coordinate along the side ranges from -1 to 1.
            n_part = 2**halvings
            part_centre = (2.0 * np.arange(n_part) + 1.0) / n_part - 1.0
            position_on_side = (part_centre[:, None] + line_nodes / n_part).ravel()  # shape (n_part * (order + 1),)
            weights = lagrange_values(line_nodes, lobatto_weights(order), position_on_side)
            candidate_points = points_on_sides @ weights.T  # shape (n_large, 4, n_part * (order + 1))

            # Find the nodes at these film points. The returned distance is infinite where there is no node.
            coordinates = np.stack([candidate_points.real, candidate_points.imag], axis=-1)
            distance, nearest_node = node_tree.query(coordinates, distance_upper_bound=NODE_TOLERANCE)
            for element_index, side_index, candidate_index in np.argwhere(np.isfinite(distance)):
                node = int(nearest_node[element_index, side_index, candidate_index])
                side_nodes = nodes_on_sides[element_index, side_index]
                is_node_of_large_element = node in side_nodes
                if not is_node_of_large_element:
                    sources[node] = _HangingNodeSource(side_nodes, weights[candidate_index])
        return sources


def _tree(points: Complexes) -> cKDTree:
    """Create a tree that finds the nearest neighbours among points x + iy, shape (n,)."""
    return cKDTree(np.stack([points.real, points.imag], axis=1))


def _number_points(points: Complexes) -> tuple[int, Integers]:
    """Assign a number to each point. Points within `NODE_TOLERANCE` of each other get the same number.

    Args:
        points: Points x + iy, shape (n,), in film radii.

    Returns:
        Count of distinct points, and the number of each point, shape (n,).
    """
    pairs = _tree(points).query_pairs(NODE_TOLERANCE, output_type="ndarray")
    is_same_point = csr_array((np.ones(len(pairs)), pairs.T), shape=(points.size, points.size))
    count, number = connected_components(is_same_point, directed=False)
    return int(count), np.asarray(number, dtype=np.intp)


def refine(mesh: PlacedMesh, lines: Complexes, max_side: float) -> PlacedMesh:
    """Split the elements of a mesh along lines, until the elements on the lines are small enough.

    An element is split if the longest side exceeds `max_side` and the middle of the element is close to a line
    (`GRADING`). Each long side of the element is halved. Short sides are not halved (`MIN_SIDE_RATIO`).

    Args:
        mesh: Mesh of a whole film.
        lines: Closely spaced points x + iy on the lines, rotated with the press, shape (n,), in film radii. The
            distance between neighbouring points is less than half of `max_side`.
        max_side: Longest allowed side of an element on a line, in film radii.

    Returns:
        The mesh with split elements.
    """
    # Describe each element by the original element that contains it (`parent`), and by its lower left corner (`low`)
    # and its side lengths (`size`) in the local coordinates of the original element, which range from -1 to 1. At
    # first, each element is an original element.
    base = mesh.template
    parent = np.arange(base.n_element)
    low = np.full((base.n_element, 2), -1.0)
    size = np.full((base.n_element, 2), 2.0)
    line_tree = _tree(lines)
    for _ in range(MAX_SPLITS):
        # Compute the lengths of the sides of each element on the film.
        corners, middle = _corners_and_middle(mesh, parent, low, size)
        side_length = np.abs(np.roll(corners, -1, axis=1) - corners)  # along xi, eta, xi and eta, shape (n_element, 4)
        length = np.maximum(side_length[:, :2], side_length[:, 2:])  # along xi and along eta, shape (n_element, 2)
        longest_side = length.max(axis=1)

        # Select the elements to be split, and the directions in which they are halved, shape (n_element, 2).
        distance, _ = line_tree.query(np.stack([middle.real, middle.imag], axis=1))
        is_too_large = (longest_side > max_side) & (distance < GRADING * longest_side)
        is_split = is_too_large[:, None] & (length > MIN_SIDE_RATIO * longest_side[:, None])
        if not is_split.any():
            break

        # Halve elements along xi first, which appends the second halves to the elements. Then halve elements along eta.
        # If an element is halved along eta, its appended second half is halved as well.
        is_split_along_xi = is_split[:, 0]
        parent, low, size = _halve(parent, low, size, is_split_along_xi, axis=0)
        is_split_along_eta = np.concatenate([is_split[:, 1], is_split[is_split_along_xi, 1]])
        parent, low, size = _halve(parent, low, size, is_split_along_eta, axis=1)
    return replace(mesh, template=RefinedTemplate(base, parent, low, size))


def _halve(parent: Integers, low: Array, size: Array, is_halved: Booleans, axis: int) -> tuple[Integers, Array, Array]:
    """Halve some elements along one local coordinate.

    The first half of an element replaces the element. The second halves of all elements are appended to the arrays.

    Args:
        parent: Index of the original element in which each element lies, shape (n_element,).
        low: Lower left corner of each element in the local coordinates of its original element, shape (n_element, 2).
        size: Lengths of the sides of each element in the local coordinates of its original element, shape
            (n_element, 2).
        is_halved: Whether each element is halved, shape (n_element,).
        axis: Local coordinate along which the elements are halved, 0 for xi and 1 for eta.

    Returns:
        The arrays `parent`, `low` and `size` of the new elements.
    """
    # The first half of an element has the same lower left corner as the element, and half of its size.
    size_of_first = size.copy()
    size_of_first[is_halved, axis] *= 0.5

    # The lower left corner of the second half lies at the end of the first half.
    size_of_second = size_of_first[is_halved]
    low_of_second = low[is_halved]
    low_of_second[:, axis] += size_of_second[:, axis]

    new_parent = np.concatenate([parent, parent[is_halved]])
    new_low = np.concatenate([low, low_of_second])
    new_size = np.concatenate([size_of_first, size_of_second])
    return new_parent, new_low, new_size


def _corners_and_middle(mesh: PlacedMesh, parent: Integers, low: Array, size: Array) -> tuple[Complexes, Complexes]:
    """Compute the film points of the corners and of the middle of each split element.

    Args:
        mesh: Mesh of the original elements.
        parent: Index of the original element in which each split element lies, shape (n_element,).
        low: Lower left corner of each split element in the local coordinates of its original element, shape
            (n_element, 2).
        size: Lengths of the sides of each split element in the local coordinates of its original element, shape
            (n_element, 2).

    Returns:
        Corners x + iy in anticlockwise order, shape (n_element, 4), and middles, shape (n_element,), in film radii.
    """
    # Positions of the corners and of the middle, relative to the lower left corner and in units of the sides
    corners_and_middle = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5]])
    local = low[:, None] + size[:, None] * corners_and_middle  # (xi, eta) in the original element, (n_element, 5, 2)
    xi, eta = local.reshape(-1, 2).T
    basis_values = tensor_values(mesh.template.resolution.order, xi, eta).reshape(len(parent), 5, -1)
    # Sum over the nodes n of the original element, for each element e and each of its five points p.
    points = np.einsum("epn,en->ep", basis_values, mesh.points[parent])
    return points[:, :4], points[:, 4]


def coated(
    mesh: PlacedMesh, layers: tuple[tuple[Complexes, ...], ...], film_moduli: Array, layer_moduli: Array
) -> PlacedMesh:
    """Return the mesh of a film with a coat. The elements of the mesh are refined along the edges of the coat.

    Args:
        mesh: Mesh of the whole film without a coat.
        layers: Area with at least one layer of the coat, area with at least two layers, and so on; see `Coating`.
        film_moduli: Elasticity matrix C / E of the film without a coat, shape (3, 3).
        layer_moduli: Matrix that each layer of the coat adds to `film_moduli`, shape (3, 3).
    """
    largest_part_area = max(area_of(to_corners(part)) for part in layers[0])
    max_side = EDGE_ELEMENT_SIZE * float(np.sqrt(largest_part_area))
    lines = np.concatenate([_edge_points(layer, 0.5 * max_side) for layer in layers])
    refined_mesh = refine(mesh, lines, max_side)
    return replace(refined_mesh, coat=Coating(layers, BAND * max_side, film_moduli, layer_moduli))


def _edge_points(parts: tuple[Complexes, ...], max_spacing: float) -> Complexes:
    """Return closely spaced points on the edges of the union of several polygons.

    The common edge of two adjacent polygons is not an edge of the union. The points on a common edge are recognised
    because another polygon covers the points just outside the edge.

    Args:
        parts: Corners x + iy of convex polygons in anticlockwise order.
        max_spacing: Largest distance between neighbouring points, in the unit of the corners.

    Returns:
        Points x + iy, shape (n,), in the unit of the corners.
    """
    outside_distance = 2e-3 * max_spacing  # from an edge to the points just outside the edge
    points = []
    outside_points = []
    for part in parts:
        for start, end in zip(part, np.roll(part, -1), strict=True):
            length = abs(end - start)
            n_point = 2 + int(1.5 * length / max_spacing)
            fraction_of_length = (np.arange(n_point) + 0.5) / n_point
            edge_points = start + fraction_of_length * (end - start)
            outward_normal = -1j * (end - start) / length  # to the right of an anticlockwise edge
            points.append(edge_points)
            outside_points.append(edge_points + outside_distance * outward_normal)

    # Omit the points on common edges.
    all_outside_points = np.concatenate(outside_points)
    is_on_common_edge = np.any([min_edge_cross_product(part, all_outside_points) > 0.0 for part in parts], axis=0)
    return np.asarray(np.concatenate(points)[~is_on_common_edge])
