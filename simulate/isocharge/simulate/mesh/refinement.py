"""Elements split into four where the film needs smaller ones: along the edges of electrodes that stiffen it.

A split element hands its nodes to four elements of half its size in its own local coordinates, so the finer mesh holds
every field of the coarser one. Where a small element borders on a larger one, its nodes on their common edge hang: they
follow the larger one's polynomial (Ainsworth and Senior 1997), so that fields stay continuous.
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
"""An element is split if a line lies nearer to its middle than this multiple of its longest side."""

SLENDER = 0.5
"""A side is halved if it is longer than this multiple of the element's longest: thin elements at the rim stay wide."""

MOST_SPLITS = 12
"""Largest number of times that an element is split."""

SAME = 1e-8
"""Distance below which two nodes of the sample press are one, in film radii."""

FINEST = 0.35
"""Longest side of an element on the edge of a coat, over the square root of the area of the coat's largest part."""

BAND = 0.6
"""Width of the band along an edge within which film and coated film are mixed, in units of the longest side above."""


class RefinedTemplate(Template):
    """A whole template with some elements split.

    Attributes:
        base: The template that was split.
        parent: Element of the base in which each element lies, shape (n_element,).
        low: Its lower left corner (xi, eta) there, shape (n_element, 2).
        size: Its sides there, shape (n_element, 2): 2, 1, 1/2, ...
    """

    def __init__(self, base: Template, parent: Integers, low: Array, size: Array) -> None:
        super().__init__(base.resolution, base.topology, not base.half)
        self.base, self.parent, self.low, self.size = base, parent, low, size
        self.n_element, self.splits = parent.size, np.column_stack([parent, low, size])
        points = self.from_base(sample_points(base)).ravel()
        pairs = cKDTree(np.stack([points.real, points.imag], axis=1)).query_pairs(SAME, output_type="ndarray")
        joined = csr_array((np.ones(len(pairs)), pairs.T), shape=(points.size, points.size))
        self.n_node, number = connected_components(joined, directed=False)
        self.nodes: Integers = np.asarray(number, dtype=np.intp).reshape(self.n_element, -1)
        self.first_seen = np.unique(number, return_index=True)[1]
        outermost = parent >= base.n_element - base.n_sector
        reaches = self._into_parent(self.xi, self.eta)[0] > 1.0 - 1e-12
        self.on_rim = np.zeros(self.n_node, dtype=bool)
        self.on_rim[self.nodes[outermost[:, None] & reaches]] = True
        self.on_axis = np.zeros(self.n_node, dtype=bool)
        self.constraint = self._hanging(points)

    @property
    def footprint(self) -> Integers:
        """The elements that fill the footprint."""
        return np.flatnonzero(np.isin(self.parent, np.arange(self.base.n_element)[self.base.footprint]))

    def from_base(self, values: Array | Complexes) -> np.ndarray:
        """Values at the elements' nodes from those at the nodes of the base's, shape (n_base, n_local, ...)."""
        at = self._into_parent(self.xi, self.eta)
        weights = tensor_values(self.resolution.order, at[0].ravel(), at[1].ravel())
        return np.asarray(
            np.einsum("enm,em...->en...", weights.reshape(self.n_element, self.xi.size, -1), values[self.parent])
        )

    def within(self, element: Integers, xi: Array, eta: Array) -> tuple[Integers, Array, Array]:
        """Element, xi and eta of points that are given by those of the base."""
        found = np.zeros_like(element)
        deepest = 2 ** round(1.0 - np.log2(self.size.min()))

        def code(parent: Integers, place: Integers) -> Integers:
            return np.asarray((parent * deepest + place[0]) * deepest + place[1])

        for size in np.unique(self.size, axis=0):
            of_size, side = np.flatnonzero((self.size == size).all(axis=1)), size[:, None]
            codes = code(self.parent[of_size], np.rint((self.low[of_size].T + 1.0) / side).astype(np.intp))
            order = np.argsort(codes)
            place = np.clip(np.floor((np.stack([xi, eta]) + 1.0) / side), 0, 2.0 / side - 1.0).astype(np.intp)
            wanted = code(element, place)
            near = np.minimum(np.searchsorted(codes[order], wanted), codes.size - 1)
            hit = codes[order][near] == wanted
            found[hit] = of_size[order][near[hit]]
        at = (np.stack([xi, eta]) - self.low[found].T) / (0.5 * self.size[found].T) - 1.0
        return found, at[0], at[1]

    def _into_parent(self, xi: Array, eta: Array) -> Array:
        """Local coordinates of points of every element in its parent, shape (2, n_element, n)."""
        return self.low.T[:, :, None] + 0.5 * self.size.T[:, :, None] * (np.stack([xi, eta])[:, None] + 1.0)

    def _hanging(self, points: Complexes) -> csr_array:
        """Values at all nodes from those that do not hang, shape (n_node, n_node); `points` are those of a sample."""
        order = self.resolution.order
        line, grid = lobatto_nodes(order), np.arange((order + 1) ** 2).reshape(order + 1, -1)
        sides = np.stack([grid[0], grid[-1], grid[:, 0], grid[:, -1]])
        unique = points[self.first_seen]
        tree = cKDTree(np.stack([unique.real, unique.imag], axis=1))
        coarse = np.flatnonzero(self.size.max(axis=1) > self.size.min())
        on_side = self.nodes[coarse][:, sides]
        rows: dict[int, tuple[Integers, Array]] = {}
        for level in range(1, round(np.log2(self.size.max() / self.size.min())) + 1):
            parts = 2**level
            t = ((2.0 * np.arange(parts)[:, None] + 1.0 + line) / parts - 1.0).ravel()
            values = lagrange_values(line, lobatto_weights(order), t)
            at = points.reshape(self.nodes.shape)[coarse][:, sides] @ values.T
            away, nearest = tree.query(np.stack([at.real, at.imag], axis=-1), distance_upper_bound=SAME)
            for element, side, place in zip(*np.nonzero(np.isfinite(away)), strict=True):
                node, own = int(nearest[element, side, place]), on_side[element, side]
                if node not in own:
                    rows[node] = own, values[place]
        hanging = np.array(list(rows), dtype=np.intp)
        kept = np.setdiff1d(np.arange(self.n_node), hanging)
        row = np.concatenate([kept, np.repeat(hanging, order + 1)])
        column = np.concatenate([kept, *(own for own, _ in rows.values())])
        weight = np.concatenate([np.ones(kept.size), *(value for _, value in rows.values())])
        step = csr_array((weight, (row, column)), shape=(self.n_node, self.n_node))
        follow = step
        while np.isin(follow.indices, hanging).any():  # an end of a larger edge may hang on a still larger one
            follow = step @ follow
            follow.eliminate_zeros()
        return follow


def refine(mesh: PlacedMesh, lines: Complexes, finest: float) -> PlacedMesh:
    """The mesh with elements split along lines.

    Args:
        mesh: A mesh of a whole film.
        lines: Points of the lines, closer to each other than half of `finest`, in film radii, the press rotated onto
            the x axis.
        finest: Longest side of an element that is not split, in film radii.
    """
    base = mesh.template
    parent, (low, size) = np.arange(base.n_element), (np.full((base.n_element, 2), value) for value in (-1.0, 2.0))
    tree = cKDTree(np.stack([lines.real, lines.imag], axis=1))
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5]])
    for _ in range(MOST_SPLITS):
        at = low[:, None] + size[:, None] * corner
        values = tensor_values(base.resolution.order, *at.reshape(-1, 2).T).reshape(*at.shape[:2], -1)
        z = np.einsum("ecn,en->ec", values, mesh.points[parent])
        side = np.abs(np.roll(z[:, :4], -1, axis=1) - z[:, :4])
        length = np.maximum(side[:, :2], side[:, 2:])
        longest = length.max(axis=1)
        away = tree.query(np.stack([z[:, 4].real, z[:, 4].imag], axis=1))[0]
        split = ((longest > finest) & (away < GRADING * longest))[:, None] & (length > SLENDER * longest[:, None])
        if not split.any():
            break
        for axis in (0, 1):
            chosen = split[:, axis]
            size[chosen, axis] *= 0.5
            second = low[chosen] + np.eye(2)[axis] * size[chosen]
            parent, low = np.concatenate([parent, parent[chosen]]), np.concatenate([low, second])
            size, split = np.concatenate([size, size[chosen]]), np.concatenate([split, split[chosen]])
    return replace(mesh, template=RefinedTemplate(base, parent, low, size))


def coated(mesh: PlacedMesh, layers: tuple[tuple[Complexes, ...], ...], bare: Array, added: Array) -> PlacedMesh:
    """The mesh of a film with a coat: finer along the coat's edges, and with its stiffness; arguments as `Coating`."""
    finest = FINEST * float(np.sqrt(max(area_of(to_corners(part)) for part in layers[0])))
    lines = np.concatenate([_edges(layer, finest) for layer in layers])
    return replace(refine(mesh, lines, finest), coat=Coating(layers, BAND * finest, bare, added))


def _edges(parts: tuple[Complexes, ...], finest: float) -> Complexes:
    """Points along the edges of what parts cover together, closer to each other than half of `finest`."""
    points, outside = [], []
    for part in parts:
        for start, end in zip(part, np.roll(part, -1), strict=True):
            count = 2 + int(3.0 * abs(end - start) / finest)
            along = (np.arange(count) + 0.5) / count
            points.append(start + along * (end - start))
            outside.append(points[-1] - 1e-3j * finest * (end - start) / abs(end - start))
    beyond = np.concatenate(outside)
    inner = [min_edge_cross_product(part, beyond) > 0.0 for part in parts]
    return np.asarray(np.concatenate(points)[~np.any(inner, axis=0)])
