"""The elements of the mesh and their adjacency, which are the same for every position of the probe and every film.

The innermost circle of the mesh encloses the footprint. The mesh consists of three parts:

    1. The core polygon (n corners) is divided into n quadrilaterals that meet at its centroid.
    2. 2 n blocks, or two layers of 2 n blocks, lie between the core polygon and the innermost circle.
    3. Rings of 2 n sectors lie between the innermost circle and the rim of the film. The last rings are thin if the
       film resists bending.

A polygonal footprint is its own core polygon. A circular footprint has a virtual square as its core polygon, and its
boundary is the innermost circle. Any other curved footprint has a core polygon and two layers of blocks. The first
layer ends at the boundary of the footprint, and the second layer at the innermost circle. Each block can be subdivided.

A press by a circular probe is symmetric about the line from the centre of the film to the probe. If the film is
symmetric as well, only the upper half is meshed. `Placement` computes the positions of the elements, and `Template`
numbers their nodes.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.numerics.interpolation import lobatto_nodes
from isocharge.simulate.sensor.probe_shapes.base import FootprintTopology


@dataclass(frozen=True)
class Resolution:
    """Fineness of the mesh.

    Attributes:
        order: Polynomial order of the elements.
        around: Number of elements round the innermost circle. A core polygon of n corners takes the nearest multiple of
            2 n.
        rings: Number of rings between the innermost circle and the rim, in equal steps of the logarithm of the radius.
        rim: Number of thin rings at the rim, which resolve the boundary layer of bending.
    """

    order: int = 4
    around: int = 8
    rings: int = 5
    rim: int = 0

    @property
    def description(self) -> str:
        """Text with the four numbers of the resolution, such as "order 4, around 8, rings 5, rim 0"."""
        return ", ".join(f"{name} {value}" for name, value in asdict(self).items())

    def __post_init__(self) -> None:
        if self.order < 2 or self.around < 4 or self.rings < 1 or self.rim < 0:
            raise ValueError(
                f"expected order >= 2, around >= 4, rings >= 1 and rim >= 0, got {self.order}, {self.around}, "
                f"{self.rings}, {self.rim}"
            )


class Blocks:
    """The elements of the mesh for one resolution and one topology of the footprint.

    An element has the local coordinates xi, which points outwards, and eta, which points anticlockwise. Both lie in
    [-1, 1]. The (order + 1)^2 nodes of an element are ordered by eta and then by xi. The elements are ordered from the
    inside out. The quadrilaterals of the core polygon come first, then the layers up to the innermost circle, and then
    the rings.

    Attributes:
        resolution: Fineness of the mesh.
        topology: Number and kind of the blocks in and around the footprint.
        half: Whether only the upper half of the film is meshed.
        n_corner: Number of corners of the core polygon.
        split: Number of elements along half an edge of the core polygon.
        n_meshed: Number of corners of the core polygon in the meshed part of the film.
        n_sector: Number of elements round the innermost circle.
        n_quad: Number of elements in the core polygon.
        n_layer: Number of layers between the core polygon and the innermost circle.
        n_inner: Number of elements inside the innermost circle.
        n_ring: Number of rings between the innermost circle and the rim.
        n_element: Number of all elements.
        xi: Local coordinate xi of the nodes of an element, shape ((order + 1)^2,).
        eta: Local coordinate eta of the nodes of an element, shape ((order + 1)^2,).
    """

    def __init__(self, resolution: Resolution, topology: FootprintTopology, whole: bool = False) -> None:
        """Count the elements, and compute the local coordinates of their nodes.

        Args:
            resolution: Fineness of the mesh.
            topology: Number and kind of the blocks in and around the footprint.
            whole: Whether to mesh the whole film although the footprint is symmetric.
        """
        self.resolution = resolution
        self.topology = topology
        self.half = topology.fills_circle and not whole

        # Each corner of the core polygon belongs to a quadrilateral of split x split elements and to 2 x split sectors.
        self.n_corner = topology.n_corner
        self.split = max(1, round(resolution.around / (2 * self.n_corner)))
        self.n_meshed = self.n_corner // 2 if self.half else self.n_corner
        self.n_sector = 2 * self.n_meshed * self.split
        self.n_quad = self.n_meshed * self.split**2

        # Elements inside the innermost circle, then the rings from the circle to the rim
        self.n_layer = 2 if topology.is_curved and not topology.fills_circle else 1
        self.n_inner = self.n_quad + self.n_layer * self.n_sector
        self.n_ring = resolution.rings + resolution.rim
        self.n_element = self.n_inner + self.n_sector * self.n_ring

        # Local coordinates of the nodes of an element, on a square grid
        line = lobatto_nodes(resolution.order)
        xi, eta = np.meshgrid(line, line, indexing="xy")
        self.xi = xi.ravel()
        self.eta = eta.ravel()

    @property
    def footprint(self) -> slice | Integers:
        """Indices of the elements that fill the footprint."""
        if self.topology.is_curved:
            return slice(0, self.n_quad + self.n_sector)
        return slice(0, self.n_quad)

    @property
    def first_layer(self) -> slice:
        """Elements of the layer next to the core polygon."""
        return slice(self.n_quad, self.n_quad + self.n_sector)

    @property
    def last_layer(self) -> slice:
        """Elements of the layer next to the innermost circle, which is the first layer if there is only one."""
        return slice(self.n_inner - self.n_sector, self.n_inner)

    @property
    def copies(self) -> int:
        """Number of copies of the mesh that cover the whole film."""
        return 2 if self.half else 1

    @cached_property
    def boundary_parameter(self) -> Array:
        """Boundary parameters of a curved footprint at the sides of the sectors, shape (n_sector + 1,)."""
        return np.linspace(0.0, 2.0 * np.pi / self.copies, self.n_sector + 1)

    @cached_property
    def boundary(self) -> Array:
        """Points along the edges of the core polygon.

        Each point is described by weights of the corners and the centroid of the polygon. The shape is
        (n_sector + 1, n_corner + 1). The points follow anticlockwise from the middle of the edge before the
        first corner.
        """
        corners = np.eye(self.n_corner + 1)[:-1]  # the weights of a corner are zero except for its own
        middles = 0.5 * (corners + np.roll(corners, -1, axis=0))  # of the edges after the corners
        stops = [middles[-1]]  # middle, corner, middle, corner, ..., middle
        for corner, middle in zip(corners[: self.n_meshed], middles[: self.n_meshed], strict=True):
            stops += [corner, middle]

        # Divide the line between two stops into equal parts.
        fraction = np.arange(self.split)[:, None] / self.split
        points = [start + fraction * (end - start) for start, end in pairwise(stops)]
        points.append(stops[-1][None])
        return np.concatenate(points)

    @cached_property
    def straight(self) -> Array:
        """Corners (a, b, c, d) of the elements inside the innermost circle, shape (n_inner, 4, n_corner + 1).

        Each corner is described by weights of the corners of the core polygon and its centroid. The points of an
        element with straight sides are (1 - v) (a + t (b - a)) + v (c + t (d - c)) with v and t from 0 to 1. The
        weights of a corner on a curved side are zero, and `Placement` adds the curved side.
        """
        core_elements = [
            self._quad(corner, v_index, t_index)
            for corner in range(self.n_meshed)
            for v_index in range(self.split)
            for t_index in range(self.split)
        ]
        zero = np.zeros(self.n_corner + 1)

        # The first layer has a straight inner side on the core polygon. Its outer side may be curved. A second layer
        # has two curved sides.
        first_layer = [[first, second, zero, zero] for first, second in pairwise(self.boundary)]
        n_second_layer = self.n_sector * (self.n_layer - 1)
        second_layer = [[zero, zero, zero, zero] for _ in range(n_second_layer)]
        return np.array(core_elements + first_layer + second_layer)

    def _quad(self, corner: int, v_index: int, t_index: int) -> list[Array]:
        """Return the corners (a, b, c, d) of one element of the core polygon, each of shape (n_corner + 1,).

        The quadrilateral of a corner lies between the centroid, the middles of both adjacent edges, and the corner.
        Each quadrilateral consists of `split` times `split` elements.

        Args:
            corner: Index of the corner of the core polygon whose quadrilateral contains the element.
            v_index: Index of the element along the side from the centroid to the middle of the edge after the corner.
            t_index: Index of the element along the side from the centroid to the middle of the edge before the corner.
        """
        # Corners of the quadrilateral. A step from a middle to a corner, or back, is `split` points of the boundary.
        centroid = np.eye(self.n_corner + 1)[-1]
        start = 2 * self.split * corner
        middle_before = self.boundary[start]
        corner_point = self.boundary[start + self.split]
        middle_after = self.boundary[start + 2 * self.split]

        # Corners of the element in the coordinates v and t of the quadrilateral, from 0 to 1
        v_inner = v_index / self.split
        v_outer = (v_index + 1) / self.split
        t_first = t_index / self.split
        t_last = (t_index + 1) / self.split
        return [
            _bilinear(centroid, middle_after, middle_before, corner_point, v, t)
            for v, t in ((v_inner, t_first), (v_inner, t_last), (v_outer, t_first), (v_outer, t_last))
        ]

    def rotated(self, steps: int, steps_per_turn: int) -> Integers:
        """Return the indices of the elements after a rotation of the probe that maps the mesh onto itself.

        The quadrilaterals are numbered corner by corner. The sectors are numbered layer by layer, and in each layer
        anticlockwise.

        Args:
            steps: Number of steps by which the probe is rotated.
            steps_per_turn: Number of steps in a full turn.

        Returns:
            Index of the element that takes the place of each element, shape (n_element,).
        """
        corner_shift = steps * self.n_corner // steps_per_turn
        sector_shift = 2 * self.split * corner_shift
        quads = np.arange(self.n_quad).reshape(self.n_meshed, -1)
        sectors = np.arange(self.n_quad, self.n_element).reshape(-1, self.n_sector)
        # Element i is replaced by the element that follows it by the shift, anticlockwise.
        rotated_quads = np.roll(quads, -corner_shift, axis=0)
        rotated_sectors = np.roll(sectors, -sector_shift, axis=1)
        return np.concatenate([rotated_quads.ravel(), rotated_sectors.ravel()])

    def into_meshed_half(self, points: Complexes) -> tuple[Complexes, Booleans]:
        """Reflect film points into the upper half if only this half is meshed.

        Args:
            points: Film points x + iy, any shape.

        Returns:
            The points in the meshed part, and whether each of them was reflected. Both have the shape of `points`.
        """
        is_reflected = (points.imag < 0.0) & self.half
        meshed_points = points.real + 1j * np.abs(points.imag) if self.half else points
        return meshed_points, is_reflected


def _bilinear(a: Array, b: Array, c: Array, d: Array, v: float, t: float) -> Array:
    """Return the point of a quadrilateral with the corners a, b, c, d that has the local coordinates (v, t).

    Args:
        a: Corner at v = 0 and t = 0, as weights of the corners of the core polygon, shape (n_corner + 1,).
        b: Corner at v = 0 and t = 1.
        c: Corner at v = 1 and t = 0.
        d: Corner at v = 1 and t = 1.
        v: First local coordinate, from 0 to 1.
        t: Second local coordinate, from 0 to 1.
    """
    inner_point = a + t * (b - a)
    outer_point = c + t * (d - c)
    return (1.0 - v) * inner_point + v * outer_point
