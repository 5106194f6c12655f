"""Local refinement of the mesh along the edges of a coat.

An element is split into halves or quarters of equal size in its local coordinates. The refined mesh can therefore
represent every field of the original mesh. If a small element is adjacent to a larger element, the nodes of the small
element on the common side are hanging nodes. The polynomial of the larger element determines the values at the hanging
nodes (Ainsworth and Senior 1997). The fields are therefore continuous.
"""

from dataclasses import replace

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
"""Largest distance between an edge of the coat and the middle of an element at which the element is split, in units of
the longest side of the element."""

MIN_SIDE_RATIO = 0.5
"""Smallest ratio of a side to the longest side of its element at which the side is halved. Thin elements at the rim are
therefore halved only along their length."""

MAX_SPLITS = 12
"""Largest number of successive splits of an element."""

NODE_TOLERANCE = 1e-8
"""Distance below which two nodes under the sample press are the same node, in film radii."""


EDGE_ELEMENT_SIZE = 0.35
"""Longest side of an element at an edge of the coat, in units of the square root of the area of the largest part of the
coat."""

BAND = 0.6
"""Width of the band along an edge in which the bare and the coated film form a laminate, in units of the longest side
of an element at the edge."""


class RefinedTemplate(Template):
    """A template of a whole film in which some elements are split.

    Attributes:
        base: The original template.
        parent: Index of the original element in which each element lies, shape (n_element,).
        low: Lower left corner (xi, eta) of each element in the original element, shape (n_element, 2).
        size: Lengths of the sides of each element in the original element, shape (n_element, 2): 2, 1, 1/2, ...
    """

    def __init__(self, base: Template, parent: Integers, low: Array, size: Array) -> None:
        """Number the nodes of the split elements.

        Args:
            base: The original template.
            parent: Index of the original element of each element, shape (n_element,).
            low: Lower left corner (xi, eta) of each element in the original element, shape (n_element, 2).
            size: Lengths of the sides of each element in the original element, shape (n_element, 2).
        """
        is_whole = not base.half
        super().__init__(base.resolution, base.topology, is_whole)
        self.base = base
        self.parent = parent
        self.low = low
        self.size = size
        self.n_element = parent.size
        self.splits = np.column_stack([parent, low, size])

        # Nodes of different elements at the same position under the sample press are the same node.
        points = self.from_base(sample_points(base)).ravel()
        self.n_node, node_number = _merge_coinciding(points)
        self.nodes: Integers = node_number.reshape(self.n_element, -1)
        _, self.first_seen = np.unique(node_number, return_index=True)

        # The rim consists of the outer sides of the elements of the last ring. A whole film has no line of symmetry.
        is_in_last_ring = parent >= base.n_element - base.n_sector
        parent_xi, _ = self._into_parent(self.xi, self.eta)
        is_on_outer_side = parent_xi > 1.0 - 1e-12
        self.on_rim = np.zeros(self.n_node, dtype=bool)
        self.on_rim[self.nodes[is_in_last_ring[:, None] & is_on_outer_side]] = True
        self.on_axis = np.zeros(self.n_node, dtype=bool)
        self.constraint = self._hanging_node_matrix(points)

    @property
    def footprint(self) -> Integers:
        """Indices of the elements that fill the footprint."""
        return np.flatnonzero(np.isin(self.parent, np.arange(self.base.n_element)[self.base.footprint]))

    def from_base(self, values: Array | Complexes) -> np.ndarray:
        """Interpolate values from the nodes of the original elements to the nodes of the split elements.

        Args:
            values: Values at the nodes of the original elements, shape (n_original_element, n_local, ...).

        Returns:
            Values at the nodes of the elements, shape (n_element, n_local, ...).
        """
        xi, eta = self._into_parent(self.xi, self.eta)
        weights = tensor_values(self.resolution.order, xi.ravel(), eta.ravel())
        weights_of_element = weights.reshape(self.n_element, self.xi.size, -1)
        # Sum over the nodes m of the original element, for each element e and node n.
        return np.asarray(np.einsum("enm,em...->en...", weights_of_element, values[self.parent]))

    def within(self, element: Integers, xi: Array, eta: Array) -> tuple[Integers, Array, Array]:
        """Convert positions in the original elements into positions in the elements; see `Template.within`.

        All elements of one size are cells of a regular grid in their original element. Each cell has a unique code. For
        each size, the code of the cell that contains a point is compared with the codes of the elements of this size.

        Args:
            element: Index of the original element of each point, shape (n,).
            xi: First local coordinate in the original element, from -1 to 1, shape (n,).
            eta: Second local coordinate in the original element, from -1 to 1, shape (n,).

        Returns:
            Index of the element, and its local coordinates xi and eta, each of shape (n,).
        """
        found_element = np.zeros_like(element)
        position = np.stack([xi, eta])  # shape (2, n_point)
        for size in np.unique(self.size, axis=0):
            candidates, candidate_codes = self._elements_of_size(size)

            # Codes of the cells that contain the points. The upper edge of an element, 1, belongs to its last cell.
            cell_size = size[:, None]
            point_cells = np.floor((position + 1.0) / cell_size).astype(np.intp)
            last_cell = np.rint(2.0 / cell_size).astype(np.intp) - 1
            point_codes = self._cell_codes(element, np.clip(point_cells, 0, last_cell))

            # Find equal codes; `searchsorted` may return the index after the last code.
            match = np.searchsorted(candidate_codes, point_codes)
            match = np.minimum(match, candidates.size - 1)
            is_match = candidate_codes[match] == point_codes
            found_element[is_match] = candidates[match[is_match]]

        # Local coordinates from -1 to 1 in the found elements
        low = self.low[found_element].T
        half_size = 0.5 * self.size[found_element].T
        local_xi, local_eta = (position - low) / half_size - 1.0
        return found_element, local_xi, local_eta

    def _cell_codes(self, parent: Integers, cell: Integers) -> Integers:
        """Return a unique code for each cell of the original elements.

        Args:
            parent: Index of the original element of each cell, shape (n,).
            cell: Position of each cell in its original element: column along xi and row along eta, shape (2, n).

        Returns:
            Codes, shape (n,).
        """
        max_cells_per_side = 2 ** round(1.0 - np.log2(self.size.min()))
        column, row = cell
        return np.asarray((parent * max_cells_per_side + column) * max_cells_per_side + row)

    def _into_parent(self, xi: Array, eta: Array) -> Array:
        """Convert local coordinates, shape (n,), of all elements into those of the original elements.

        Returns:
            Local coordinates xi and eta, shape (2, n_element, n).
        """
        local = np.stack([xi, eta])[:, None]  # shape (2, 1, n)
        low = self.low.T[:, :, None]  # shape (2, n_element, 1)
        size = self.size.T[:, :, None]
        return low + 0.5 * size * (local + 1.0)

    def _elements_of_size(self, size: Array) -> tuple[Integers, Integers]:
        """Return the elements of one size, and the codes of their cells in ascending order.

        Args:
            size: Lengths of the sides in the original element, shape (2,).

        Returns:
            Indices of the elements and their codes, each of shape (n,).
        """
        elements = np.flatnonzero((self.size == size).all(axis=1))
        cells = np.rint((self.low[elements].T + 1.0) / size[:, None]).astype(np.intp)
        codes = self._cell_codes(self.parent[elements], cells)
        order = np.argsort(codes)
        return elements[order], codes[order]

    def _hanging_node_matrix(self, points: Complexes) -> csr_array:
        """Compute the matrix that converts the values at the regular nodes into the values at all nodes.

        All nodes that are not hanging nodes are regular.

        Args:
            points: Film points of the nodes of all elements under the sample press, shape (n_element * n_local,).

        Returns:
            Matrix, shape (n_node, n_node). The columns of hanging nodes are zero.
        """
        order = self.resolution.order
        sources = self._hanging_node_sources(points)
        hanging = np.array(list(sources), dtype=np.intp)
        regular = np.setdiff1d(np.arange(self.n_node), hanging)

        # A regular node has the weight 1 in its own row. A hanging node has order + 1 weights in its row, one for each
        # node on the side of the larger element.
        source_nodes = [side_nodes for side_nodes, _ in sources.values()]
        source_weights = [weights for _, weights in sources.values()]
        row = np.concatenate([regular, np.repeat(hanging, order + 1)])
        column = np.concatenate([regular, *source_nodes])
        weight = np.concatenate([np.ones(regular.size), *source_weights])
        single_step = csr_array((weight, (row, column)), shape=(self.n_node, self.n_node))

        # A hanging node may depend on another hanging node. Substitute until only regular nodes remain.
        constraint = single_step
        while np.isin(constraint.indices, hanging).any():
            constraint = single_step @ constraint
            constraint.eliminate_zeros()
        return constraint

    def _hanging_node_sources(self, points: Complexes) -> dict[int, tuple[Integers, Array]]:
        """Find the hanging nodes, and the nodes that determine their values.

        A side of an element may be adjacent to 2, 4, 8 or more smaller elements. For each of these numbers, the
        positions that the nodes of the smaller elements have on the side are computed. A node at such a position is a
        hanging node, unless it is a node of the larger element.

        Args:
            points: Film points of the nodes of all elements under the sample press, shape (n_element * n_local,).

        Returns:
            For each hanging node, the nodes on the side of the larger element and their weights, each of shape
            (order + 1,).
        """
        order = self.resolution.order
        line = lobatto_nodes(order)

        # Nodes on the four sides of each element that is not of the smallest size
        local_index = np.arange((order + 1) ** 2).reshape(order + 1, -1)  # rows along eta, columns along xi
        sides = np.stack([local_index[0], local_index[-1], local_index[:, 0], local_index[:, -1]])
        large_elements = np.flatnonzero(self.size.max(axis=1) > self.size.min())
        nodes_on_sides = self.nodes[large_elements][:, sides]  # shape (n_large, 4, order + 1)
        points_on_sides = points.reshape(self.nodes.shape)[large_elements][:, sides]

        node_tree = _tree(points[self.first_seen])
        max_halvings = round(np.log2(self.size.max() / self.size.min()))
        sources: dict[int, tuple[Integers, Array]] = {}
        for halvings in range(1, max_halvings + 1):
            # Possible nodes of smaller elements, if the side from -1 to 1 is divided into equal parts
            n_part = 2**halvings
            part_centre = (2.0 * np.arange(n_part) + 1.0) / n_part - 1.0
            position_on_side = (part_centre[:, None] + line / n_part).ravel()  # shape (n_part * (order + 1),)
            weights = lagrange_values(line, lobatto_weights(order), position_on_side)
            candidate_points = points_on_sides @ weights.T  # shape (n_large, 4, n_part * (order + 1))

            # Nodes at these positions; the distance is infinite where there is no node.
            coordinates = np.stack([candidate_points.real, candidate_points.imag], axis=-1)
            distance, nearest_node = node_tree.query(coordinates, distance_upper_bound=NODE_TOLERANCE)
            for element, side, position in np.argwhere(np.isfinite(distance)):
                node = int(nearest_node[element, side, position])
                side_nodes = nodes_on_sides[element, side]
                is_node_of_large_element = node in side_nodes
                if not is_node_of_large_element:
                    sources[node] = side_nodes, weights[position]
        return sources


def _tree(points: Complexes) -> cKDTree:
    """Return a tree for the search of nearest neighbours among points x + iy, shape (n,)."""
    return cKDTree(np.stack([points.real, points.imag], axis=1))


def _merge_coinciding(points: Complexes) -> tuple[int, Integers]:
    """Assign the same number to all points that lie within `NODE_TOLERANCE` of each other.

    Args:
        points: Points x + iy, shape (n,), in film radii.

    Returns:
        Number of distinct points, and the number that is assigned to each point, shape (n,).
    """
    pairs = _tree(points).query_pairs(NODE_TOLERANCE, output_type="ndarray")
    is_same = csr_array((np.ones(len(pairs)), pairs.T), shape=(points.size, points.size))
    count, number = connected_components(is_same, directed=False)
    return int(count), np.asarray(number, dtype=np.intp)


def refine(mesh: PlacedMesh, lines: Complexes, finest: float) -> PlacedMesh:
    """Split the elements of a mesh along lines, until the elements on the lines are small enough.

    An element is split if its longest side exceeds `finest` and its middle is close to a line; see `GRADING`. Each of
    its sides is halved unless it is already short; see `MIN_SIDE_RATIO`.

    Args:
        mesh: Mesh of a whole film.
        lines: Points on the lines at distances below half of `finest`, rotated with the press, shape (n,), in film
            radii.
        finest: Longest side of an element on a line, in film radii.

    Returns:
        The mesh with split elements.
    """
    base = mesh.template
    parent = np.arange(base.n_element)
    low = np.full((base.n_element, 2), -1.0)
    size = np.full((base.n_element, 2), 2.0)
    line_tree = _tree(lines)
    for _ in range(MAX_SPLITS):
        corners, middle = _corners_and_middle(mesh, parent, low, size)
        side_length = np.abs(np.roll(corners, -1, axis=1) - corners)  # shape (n_element, 4)
        length = np.maximum(side_length[:, :2], side_length[:, 2:])  # along xi and along eta
        longest = length.max(axis=1)
        distance, _ = line_tree.query(np.stack([middle.real, middle.imag], axis=1))
        is_too_large = (longest > finest) & (distance < GRADING * longest)
        is_split = is_too_large[:, None] & (length > MIN_SIDE_RATIO * longest[:, None])
        if not is_split.any():
            break

        # Halve along xi first, then along eta. The second halves of the first step may be halved again.
        parent, low, size = _halve(parent, low, size, is_split[:, 0], axis=0)
        is_split_along_eta = np.concatenate([is_split[:, 1], is_split[is_split[:, 0], 1]])
        parent, low, size = _halve(parent, low, size, is_split_along_eta, axis=1)
    return replace(mesh, template=RefinedTemplate(base, parent, low, size))


def _halve(parent: Integers, low: Array, size: Array, is_halved: Booleans, axis: int) -> tuple[Integers, Array, Array]:
    """Halve some elements along one local coordinate. The first half replaces the element, the second is appended.

    Args:
        parent: Index of the original element of each element, shape (n_element,).
        low: Local coordinates of the lower corner of each element in its original element, shape (n_element, 2).
        size: Extents of each element in these local coordinates, shape (n_element, 2).
        is_halved: Whether each element is halved, shape (n_element,).
        axis: Local coordinate that is halved, 0 for xi and 1 for eta.

    Returns:
        The arrays `parent`, `low` and `size` of the new elements.
    """
    new_size = size.copy()
    new_size[is_halved, axis] *= 0.5
    size_of_half = new_size[is_halved]
    low_of_second_half = low[is_halved]
    low_of_second_half[:, axis] += size_of_half[:, axis]
    return (
        np.concatenate([parent, parent[is_halved]]),
        np.concatenate([low, low_of_second_half]),
        np.concatenate([new_size, size_of_half]),
    )


def _corners_and_middle(mesh: PlacedMesh, parent: Integers, low: Array, size: Array) -> tuple[Complexes, Complexes]:
    """Compute the film points of the corners and of the middle of split elements.

    Args:
        mesh: Mesh of the original elements.
        parent: Index of the original element of each split element, shape (n_element,).
        low: Local coordinates of the lower corner of each split element in its original element, shape (n_element, 2).
        size: Extents of each split element in these local coordinates, shape (n_element, 2).

    Returns:
        Corners, anticlockwise, shape (n_element, 4), and middles, shape (n_element,), in film radii.
    """
    corners_and_middle = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5]])
    local = low[:, None] + size[:, None] * corners_and_middle  # shape (n_element, 5, 2)
    xi, eta = local.reshape(-1, 2).T
    basis_values = tensor_values(mesh.template.resolution.order, xi, eta).reshape(len(parent), 5, -1)
    # Sum over the nodes n of the original element, for each element e and each of its five points p.
    points = np.einsum("epn,en->ep", basis_values, mesh.points[parent])
    return points[:, :4], points[:, 4]


def coated(mesh: PlacedMesh, layers: tuple[tuple[Complexes, ...], ...], bare: Array, added: Array) -> PlacedMesh:
    """Return the mesh of a film with a coat, which is refined along the edges of the coat.

    Args:
        mesh: Mesh of the film without a coat.
        layers: Areas with at least one layer of the coat, with two layers, and so on; see `Coating`.
        bare: Elasticity matrix C over E of the film, shape (3, 3).
        added: Addition of one layer of the coat to this matrix, shape (3, 3).
    """
    finest = EDGE_ELEMENT_SIZE * float(np.sqrt(max(area_of(to_corners(part)) for part in layers[0])))
    lines = np.concatenate([_edges(layer, finest) for layer in layers])
    return replace(refine(mesh, lines, finest), coat=Coating(layers, BAND * finest, bare, added))


def _edges(parts: tuple[Complexes, ...], finest: float) -> Complexes:
    """Return points on the edges of the union of several polygons.

    An edge between two adjacent polygons is not an edge of the union. Its points are recognised because another polygon
    covers the points just outside of the edge.

    Args:
        parts: Convex polygons with anticlockwise corners x + iy.
        finest: Twice the largest distance between points, in the unit of the corners.

    Returns:
        Points x + iy, shape (n,), in the unit of the corners.
    """
    edge_distance = 1e-3 * finest  # of a point just outside of an edge from this edge
    points = []
    points_just_outside = []
    for part in parts:
        for start, end in zip(part, np.roll(part, -1), strict=True):
            length = abs(end - start)
            n_point = 2 + int(3.0 * length / finest)
            fraction_of_length = (np.arange(n_point) + 0.5) / n_point
            edge_points = start + fraction_of_length * (end - start)
            outward_normal = -1j * (end - start) / length  # to the right of an anticlockwise edge
            points.append(edge_points)
            points_just_outside.append(edge_points + edge_distance * outward_normal)
    just_outside = np.concatenate(points_just_outside)
    is_inner_edge = np.any([min_edge_cross_product(part, just_outside) > 0.0 for part in parts], axis=0)
    return np.asarray(np.concatenate(points)[~is_inner_edge])
