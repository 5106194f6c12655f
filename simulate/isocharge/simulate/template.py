"""The mesh that follows the probe: one template, carried onto the film by a conformal map of the disk.

The template is the unit disk in z, graded about its centre: a square core and four blocks fill the footprint, the disk
|z| <= rho; rings that are uniform in ln|z| and arg z fill the rest. The disk automorphism

    Z = (z + c) / (1 + c z),   0 <= c < 1,

carries it onto the film (Z in units of the film's radius), circles to circles, so that with

    al = (atanh(p + R) + atanh(p - R)) / 2,   be = (atanh(p + R) - atanh(p - R)) / 2,   c = tanh al,   rho = tanh be

the circle |z| = rho becomes the edge of a footprint of radius R at distance p from the centre, exactly. The
connectivity does not depend on the place, so everything symbolic is done once for a resolution, nodal fields are smooth
functions of p, and points of the film are found in the mesh by inverting two closed formulas.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from isocharge.simulate.arrays import Array, Complexes, Integers
from isocharge.simulate.spectral import basis, lobatto_nodes

CORE = 0.45
"""Half side of the square core over the footprint's radius in the template: corners at 0.64 of it."""

SIDES = 4
"""Blocks round the core."""


@dataclass(frozen=True)
class Resolution:
    """How fine the template is.

    Attributes:
        order: Polynomial order of the elements.
        around: Elements round the circle, a multiple of four.
        rings: Rings between the footprint and the rim.
    """

    order: int = 5
    around: int = 8
    rings: int = 5

    def __post_init__(self) -> None:
        if self.order < 2 or self.around < 8 or self.around % SIDES or self.rings < 1:
            raise ValueError(
                f"expected order >= 2, around a multiple of 4 from 8 on and rings >= 1, got {self.order}, "
                f"{self.around}, {self.rings}"
            )


@dataclass(frozen=True)
class Placement:
    """Where the template sits: the map's parameter c and the footprint's radius rho in the template, 0 <= c, rho < 1.

    Both may be arrays, one placement per press.
    """

    c: float | Array
    rho: float | Array

    @classmethod
    def of_circle(cls, distance: float | Array, radius: float) -> "Placement":
        """Placement for a circular footprint, distance and radius in units of the film's radius, their sum below 1."""
        outer, inner = np.arctanh(distance + radius), np.arctanh(distance - radius)
        return cls(c=np.tanh(0.5 * (outer + inner)), rho=np.tanh(0.5 * (outer - inner)))

    def to_film(self, z: Complexes) -> Complexes:
        """Template points to film points (unit radius)."""
        return (z + self.c) / (1.0 + self.c * z)

    def to_template(self, film: Complexes) -> Complexes:
        """Film points (unit radius) to template points."""
        return (film - self.c) / (1.0 - self.c * film)


class Template:
    """Elements, nodes and their numbering for one resolution; nothing in it depends on the scene.

    Element e has (order + 1)^2 nodes in tensor order (xi fast); local coordinates (xi, eta) lie in [-1, 1]^2. Elements
    come as core (m x m, m = around / 4), then four side blocks of m, then rings from the footprint outwards.

    Attributes:
        nodes: Node number of each element's nodes, shape (n_element, (order + 1)^2).
        n_node: Number of nodes; those on the rim come last.
        n_free: Number of nodes that are not on the rim.
    """

    def __init__(self, resolution: Resolution) -> None:
        self.resolution = resolution
        self.per_side = resolution.around // SIDES
        self.n_inner = self.per_side * (self.per_side + SIDES)
        self.n_element = self.n_inner + resolution.around * resolution.rings
        self.nodes, self.n_node, self.n_free = self._number()

    def _local_grid(self) -> tuple[Array, Array]:
        line = lobatto_nodes(self.resolution.order)
        xi, eta = np.meshgrid(line, line, indexing="xy")
        return xi.ravel(), eta.ravel()

    def element_points(self, rho: float | Array) -> Complexes:
        """Template coordinates z of every element's nodes, shape (n_element, (order + 1)^2)."""
        xi, eta = self._local_grid()
        m, around, rings = self.per_side, self.resolution.around, self.resolution.rings
        edge = np.linspace(-1.0, 1.0, m + 1)

        def stretch(local: Array, index: Integers, edges: Array) -> Array:
            low, high = edges[index][:, None], edges[index + 1][:, None]
            stretched: Array = low + 0.5 * (local + 1.0) * (high - low)
            return stretched

        row, column = np.divmod(np.arange(m * m), m)
        core = CORE * (stretch(xi, column, edge) + 1j * stretch(eta, row, edge))
        t = stretch(eta, np.arange(m), edge)
        right = _side_block(0.5 * (xi + 1.0), t)
        sides = np.concatenate([right * 1j**side for side in range(SIDES)])
        ring, sector = np.divmod(np.arange(rings * around), around)
        angle = stretch(eta, sector, -0.25 * np.pi + np.linspace(0.0, 2.0 * np.pi, around + 1))
        depth = stretch(xi, ring, np.linspace(1.0, 0.0, rings + 1))
        outside = np.exp(depth * np.log(rho) + 1j * angle)
        return np.concatenate([rho * core, rho * sides, outside])

    def _number(self) -> tuple[Integers, int, int]:
        """Give coincident nodes one number; nodes on the rim get the last ones."""
        z = self.element_points(0.1).ravel()
        _, first, number = np.unique(np.round(z, 9), return_index=True, return_inverse=True)
        rim = np.abs(z[first]) > 1.0 - 1e-9
        rank = np.empty(first.size, dtype=np.intp)
        rank[np.argsort(rim, kind="stable")] = np.arange(first.size)
        nodes = rank[number.ravel()].reshape(self.n_element, -1)
        return nodes, first.size, int(first.size - rim.sum())

    @cached_property
    def first_seen(self) -> Integers:
        """For each node one place, element * nodes per element + local node, where it stands; shape (n_node,)."""
        return np.unique(self.nodes, return_index=True)[1]

    def node_points(self, rho: float | Array) -> Complexes:
        """Template coordinates z of every node, shape (n_node,)."""
        return self.element_points(rho).ravel()[self.first_seen]

    @property
    def footprint(self) -> slice:
        """The elements that fill the footprint."""
        return slice(0, self.n_inner)

    def locate(self, z: Complexes, rho: float | Array) -> tuple[Integers, Array, Array]:
        """Find template points in the mesh.

        Args:
            z: Template coordinates, shape (n,), |z| <= 1.
            rho: Footprint radius in the template, one or one per point.

        Returns:
            Element, xi and eta, each of shape (n,).
        """
        rho = np.broadcast_to(rho, z.shape)
        outside = np.abs(z) > rho
        element = np.empty(z.shape, dtype=np.intp)
        xi, eta = np.empty(z.shape), np.empty(z.shape)
        element[outside], xi[outside], eta[outside] = self._locate_rings(z[outside], rho[outside])
        element[~outside], xi[~outside], eta[~outside] = self._locate_inner(z[~outside] / rho[~outside])
        return element, xi, eta

    def _locate_rings(self, z: Complexes, rho: Array) -> tuple[Integers, Array, Array]:
        around, rings = self.resolution.around, self.resolution.rings
        depth = (1.0 - np.log(np.abs(z)) / np.log(rho)) * rings
        turn = np.mod(np.angle(z) / (2.0 * np.pi) + 0.125, 1.0) * around
        ring, xi = _split(depth, rings)
        sector, eta = _split(turn, around)
        return self.n_inner + ring * around + sector, xi, eta

    def _locate_inner(self, z: Complexes) -> tuple[Integers, Array, Array]:
        """Points of the unit disk in the core and the four side blocks."""
        m = self.per_side
        quarter = np.mod(np.rint(np.angle(z) / (0.5 * np.pi)), SIDES).astype(np.intp)
        turned = z * (1j ** (-quarter))
        in_core = turned.real <= CORE
        column, xi = _split((z.real / CORE + 1.0) * 0.5 * m, m)
        row, eta = _split((z.imag / CORE + 1.0) * 0.5 * m, m)
        element = row * m + column
        v, t = _invert_side_block(turned[~in_core])
        along, eta[~in_core] = _split((t + 1.0) * 0.5 * m, m)
        element[~in_core] = m * m + quarter[~in_core] * m + along
        xi[~in_core] = 2.0 * v - 1.0
        return element, xi, eta

    def basis_at(self, xi: Array, eta: Array) -> tuple[Array, Array]:
        """Basis values (n, nodes) and derivatives by xi and eta (2, n, nodes) at local points of shape (n,)."""
        in_xi, d_xi = basis(self.resolution.order, xi)
        in_eta, d_eta = basis(self.resolution.order, eta)

        def product(a: Array, b: Array) -> Array:
            return (b[:, :, None] * a[:, None, :]).reshape(len(a), b.shape[1] * a.shape[1])

        values = product(in_xi, in_eta)
        return values, np.stack([product(d_xi, in_eta), product(in_xi, d_eta)])


def _side_block(v: Array, t: Array) -> Complexes:
    """The right-hand block in units of rho: from the core's side (v = 0) to the circle (v = 1), t from -1 to 1."""
    block: Complexes = (1.0 - v) * CORE * (1.0 + 1j * t) + v * np.exp(0.25j * np.pi * t)
    return block


def _invert_side_block(z: Complexes) -> tuple[Array, Array]:
    """(v, t) of points of the right-hand block: Newton on two equations, to round-off in a few steps."""
    t = np.angle(z) * 4.0 / np.pi
    v = np.clip((np.abs(z) - CORE) / (1.0 - CORE), 0.0, 1.0)
    for _ in range(8):
        arc = np.exp(0.25j * np.pi * t)
        miss = _side_block(v, t) - z
        by_v, by_t = arc - CORE * (1.0 + 1j * t), 1j * ((1.0 - v) * CORE + v * 0.25 * np.pi * arc)
        determinant = (np.conj(by_v) * by_t).imag
        v = v - (np.conj(miss) * by_t).imag / determinant
        t = t - (np.conj(by_v) * miss).imag / determinant
    return v, t


def _split(coordinate: Array, count: int) -> tuple[Integers, Array]:
    """Interval number and local coordinate in [-1, 1] of a coordinate that runs from 0 to count."""
    index = np.clip(np.floor(coordinate), 0, count - 1).astype(np.intp)
    return index, 2.0 * (coordinate - index) - 1.0


@lru_cache(maxsize=16)
def template(resolution: Resolution) -> Template:
    """The template of a resolution, made once."""
    return Template(resolution)
