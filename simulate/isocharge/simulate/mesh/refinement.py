"""Local refinement of the mesh along the edges of a coat.

An element is split into halves or quarters of equal size in its local coordinates, so the refined mesh can represent
every field of the original mesh. If a small element is adjacent to a larger one, its nodes on their common side are
hanging nodes. Their values are those of the polynomial of the larger element (Ainsworth and Senior 1997), so fields are
continuous.
"""

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.simulate.mesh.coating import Coating
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.mesh.template import Template, sample_points
from isocharge.simulate.numerics.interpolation import lagrange_values, lobatto_nodes, lobatto_weights, tensor_values
from isocharge.simulate.numerics.polygon import area_of, min_edge_cross_product, to_corners

GRADING = 1.0
"""Distance of an edge of the coat from the middle of an element below which the element is split, in units of the
longest side of the element."""

MIN_SIDE_RATIO = 0.5
"""Ratio of a side to the longest side of its element above which the side is halved. Thin elements at the rim are
therefore split along their length only."""

MAX_SPLITS = 12
"""Largest number of successive splits of an element."""

NODE_TOLERANCE = 1e-8
"""Distance below which two nodes under the sample press are the same node, in film radii."""

EDGE_ELEMENT_SIZE = 0.35
"""Longest side of an element at an edge of the coat, over the square root of the area of the largest part of the
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
        super().__init__(base.resolution, base.topology, not base.half)
        self.base = base
        self.parent = parent
        self.low = low
        self.size = size
        self.n_element = parent.size
        self.splits = np.column_stack([parent, low, size])
        points = self.from_base(sample_points(base)).ravel()
        pairs = cKDTree(np.stack([points.real, points.imag], axis=1)).query_pairs(NODE_TOLERANCE, output_type="ndarray")
        same_node = csr_array((np.ones(len(pairs)), pairs.T), shape=(points.size, points.size))
        self.n_node, number = connected_components(same_node, directed=False)
        self.nodes: Integers = np.asarray(number, dtype=np.intp).reshape(self.n_element, -1)
        self.first_seen = np.unique(number, return_index=True)[1]
        outermost = parent >= base.n_element - base.n_sector
        is_outer_side = self._into_parent(self.xi, self.eta)[0] > 1.0 - 1e-12
        self.on_rim = np.zeros(self.n_node, dtype=bool)
        self.on_rim[self.nodes[outermost[:, None] & is_outer_side]] = True
        self.on_axis = np.zeros(self.n_node, dtype=bool)
        self.constraint = self._hanging_node_matrix(points)

    @property
    def footprint(self) -> Integers:
        """Indices of the elements that fill the footprint."""
        return np.flatnonzero(np.isin(self.parent, np.arange(self.base.n_element)[self.base.footprint]))

    def from_base(self, values: Array | Complexes) -> np.ndarray:
        """Interpolate values from the nodes of the original elements, shape (n_original_element, n_local, ...)."""
        xi, eta = self._into_parent(self.xi, self.eta)
        weights = tensor_values(self.resolution.order, xi.ravel(), eta.ravel())
        return np.asarray(
            np.einsum("enm,em...->en...", weights.reshape(self.n_element, self.xi.size, -1), values[self.parent])
        )

    def within(self, element: Integers, xi: Array, eta: Array) -> tuple[Integers, Array, Array]:
        """Convert positions in the original elements into positions in the elements; see `Template.within`.

        For each size of elements, an original element is a grid of cells. A cell has a unique code, and the element of
        this size that fills the cell is found by its code.
        """
        found = np.zeros_like(element)
        position = np.stack([xi, eta])
        max_cells = 2 ** round(1.0 - np.log2(self.size.min()))

        def cell_code(parent: Integers, cell: Integers) -> Integers:
            """Return a unique number for the cells, shape (2, n), of original elements, shape (n,)."""
            return np.asarray((parent * max_cells + cell[0]) * max_cells + cell[1])

        for size in np.unique(self.size, axis=0):
            candidates = np.flatnonzero((self.size == size).all(axis=1))
            side = size[:, None]
            candidate_cells = np.rint((self.low[candidates].T + 1.0) / side).astype(np.intp)
            codes = cell_code(self.parent[candidates], candidate_cells)
            order = np.argsort(codes)
            point_cells = np.clip(np.floor((position + 1.0) / side), 0, 2.0 / side - 1.0).astype(np.intp)
            point_codes = cell_code(element, point_cells)
            match = np.minimum(np.searchsorted(codes[order], point_codes), codes.size - 1)
            is_match = codes[order][match] == point_codes
            found[is_match] = candidates[order][match[is_match]]
        local = (position - self.low[found].T) / (0.5 * self.size[found].T) - 1.0
        return found, local[0], local[1]

    def _into_parent(self, xi: Array, eta: Array) -> Array:
        """Convert local coordinates, shape (n,), of all elements into those of the original elements.

        Returns:
            Shape (2, n_element, n).
        """
        return self.low.T[:, :, None] + 0.5 * self.size.T[:, :, None] * (np.stack([xi, eta])[:, None] + 1.0)

    def _hanging_node_matrix(self, points: Complexes) -> csr_array:
        """Compute the matrix from the values at the nodes that do not hang to the values at all nodes.

        Args:
            points: Film points of the nodes of all elements under the sample press, shape (n_element * n_local,).

        Returns:
            Shape (n_node, n_node). The columns of hanging nodes are zero.
        """
        order = self.resolution.order
        sources = self._hanging_node_sources(points)
        hanging = np.array(list(sources), dtype=np.intp)
        regular = np.setdiff1d(np.arange(self.n_node), hanging)
        row = np.concatenate([regular, np.repeat(hanging, order + 1)])
        column = np.concatenate([regular, *(side_nodes for side_nodes, _ in sources.values())])
        weight = np.concatenate([np.ones(regular.size), *(weights for _, weights in sources.values())])
        step = csr_array((weight, (row, column)), shape=(self.n_node, self.n_node))
        constraint = step
        while np.isin(constraint.indices, hanging).any():  # a hanging node may depend on another hanging node
            constraint = step @ constraint
            constraint.eliminate_zeros()
        return constraint

    def _hanging_node_sources(self, points: Complexes) -> dict[int, tuple[Integers, Array]]:
        """Find the hanging nodes, and the nodes that determine their values.

        Args:
            points: Film points of the nodes of all elements under the sample press, shape (n_element * n_local,).

        Returns:
            For each hanging node, the nodes on the side of the larger element and their weights, each of shape
            (order + 1,).
        """
        order = self.resolution.order
        line = lobatto_nodes(order)
        local_number = np.arange((order + 1) ** 2).reshape(order + 1, -1)
        sides = np.stack([local_number[0], local_number[-1], local_number[:, 0], local_number[:, -1]])
        node_points = points[self.first_seen]
        tree = cKDTree(np.stack([node_points.real, node_points.imag], axis=1))
        large = np.flatnonzero(self.size.max(axis=1) > self.size.min())
        nodes_on_sides = self.nodes[large][:, sides]
        points_on_sides = points.reshape(self.nodes.shape)[large][:, sides]
        max_level = round(np.log2(self.size.max() / self.size.min()))
        sources: dict[int, tuple[Integers, Array]] = {}
        for level in range(1, max_level + 1):
            parts = 2**level
            t = ((2.0 * np.arange(parts)[:, None] + 1.0 + line) / parts - 1.0).ravel()
            values = lagrange_values(line, lobatto_weights(order), t)
            at = points_on_sides @ values.T
            position = np.stack([at.real, at.imag], axis=-1)
            distance, nearest = tree.query(position, distance_upper_bound=NODE_TOLERANCE)
            for element, side, place in zip(*np.nonzero(np.isfinite(distance)), strict=True):
                node = int(nearest[element, side, place])
                side_nodes = nodes_on_sides[element, side]
                if node not in side_nodes:
                    sources[node] = side_nodes, values[place]
        return sources


def refine(mesh: PlacedMesh, lines: Complexes, finest: float) -> PlacedMesh:
    """Split the elements of a mesh along lines.

    Args:
        mesh: Mesh of a whole film.
        lines: Points on the lines at distances below half of `finest`, rotated with the press, shape (n,), in film
            radii.
        finest: Longest side of an element on a line, in film radii.
    """
    base = mesh.template
    parent = np.arange(base.n_element)
    low = np.full((base.n_element, 2), -1.0)
    size = np.full((base.n_element, 2), 2.0)
    tree = cKDTree(np.stack([lines.real, lines.imag], axis=1))
    corners_and_middle = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5]])
    for _ in range(MAX_SPLITS):
        at = low[:, None] + size[:, None] * corners_and_middle
        values = tensor_values(base.resolution.order, *at.reshape(-1, 2).T).reshape(*at.shape[:2], -1)
        z = np.einsum("ecn,en->ec", values, mesh.points[parent])
        corners = z[:, :4]
        middle = z[:, 4]
        side = np.abs(np.roll(corners, -1, axis=1) - corners)
        length = np.maximum(side[:, :2], side[:, 2:])  # along xi and along eta
        longest = length.max(axis=1)
        distance, _ = tree.query(np.stack([middle.real, middle.imag], axis=1))
        is_too_large = (longest > finest) & (distance < GRADING * longest)
        split = is_too_large[:, None] & (length > MIN_SIDE_RATIO * longest[:, None])
        if not split.any():
            break
        for axis in (0, 1):
            chosen = split[:, axis]
            size[chosen, axis] *= 0.5
            second = low[chosen] + np.eye(2)[axis] * size[chosen]
            parent = np.concatenate([parent, parent[chosen]])
            low = np.concatenate([low, second])
            size = np.concatenate([size, size[chosen]])
            split = np.concatenate([split, split[chosen]])
    return replace(mesh, template=RefinedTemplate(base, parent, low, size))


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
    """Return points on the edges of the area that parts cover together.

    Args:
        parts: Convex polygons with anticlockwise corners x + iy.
        finest: Twice the largest distance between points, in the unit of the corners.
    """
    points = []
    outside = []
    for part in parts:
        for start, end in zip(part, np.roll(part, -1), strict=True):
            count = 2 + int(3.0 * abs(end - start) / finest)
            along = (np.arange(count) + 0.5) / count
            edge_points = start + along * (end - start)
            points.append(edge_points)
            outside.append(edge_points - 1e-3j * finest * (end - start) / abs(end - start))
    just_outside = np.concatenate(outside)
    is_inner_edge = np.any([min_edge_cross_product(part, just_outside) > 0.0 for part in parts], axis=0)
    return np.asarray(np.concatenate(points)[~is_inner_edge])
