"""Elements of a mesh, which depend neither on the film nor on the position of the probe.

The footprint of the probe contains a core polygon with n corners, and is enclosed by the innermost circle of the mesh.
The mesh consists of three parts:

    1. The core polygon is divided into n quadrilaterals that meet at its centroid.
    2. The area between the core polygon and the innermost circle is divided into one or two layers of 2 n blocks each.
    3. The area between the innermost circle and the rim of the film is divided into rings of 2 n sectors. If the film
       resists bending, the outermost rings are thin.

The core polygon of a polygonal footprint is the footprint itself. The core polygon of a circular footprint is a square
inside the footprint, and the innermost circle is the boundary of the footprint. The mesh of a curved footprint that is
not circular has two layers of blocks. The first layer ends at the boundary of the footprint, and the second layer ends
at the innermost circle. Each block can be divided into smaller elements.

A press with a circular probe is symmetric about the line from the centre of the film to the probe. If the film is
symmetric about the same line, only the upper half of the film is meshed. The class `Placement` computes the positions
of the elements, and the class `Template` numbers their nodes.
"""

import math
from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.numerics.interpolation import divide_intervals, lobatto_nodes
from isocharge.simulate.sensor.footprint import FootprintTopology


@dataclass(frozen=True)
class Resolution:
    """Fineness of the mesh.

    Attributes:
        order: Polynomial order of the elements.
        around: Number of elements around the innermost circle. The number is rounded to the nearest multiple of 2 n,
            where n is the number of corners of the core polygon.
        rings: Number of rings between the innermost circle and the rim, not counting the thin rings. The logarithm of
            the radius increases by the same step in each ring.
        rim: Number of thin rings at the rim, which resolve the boundary layer of bending.
    """

    order: int = 4
    around: int = 8
    rings: int = 5
    rim: int = 0

    @property
    def description(self) -> str:
        """Text with the four numbers of the resolution, for example "order 4, around 8, rings 5, rim 0"."""
        return ", ".join(f"{name} {value}" for name, value in asdict(self).items())

    def __post_init__(self) -> None:
        if self.order < 2 or self.around < 4 or self.rings < 1 or self.rim < 0:
            raise ValueError(
                f"expected order >= 2, around >= 4, rings >= 1 and rim >= 0, got {self.order}, {self.around}, "
                f"{self.rings}, {self.rim}"
            )


class Blocks:
    """Elements of a mesh for a given resolution and a given topology of the footprint.

    Each element has two local coordinates from -1 to 1. The coordinate xi increases outwards, and the coordinate eta
    increases anticlockwise. The (order + 1)^2 nodes of an element are ordered first by eta and then by xi. The elements
    are ordered from the inside of the mesh to the outside. The elements of the core polygon come first, followed by the
    elements of the layers and the elements of the rings.

    Attributes:
        resolution: Fineness of the mesh.
        topology: Number and kind of the blocks in and around the footprint.
        half: Whether only the upper half of the film is meshed.
        n_corner: Number of corners of the core polygon.
        n_half_edge: Number of elements along half an edge of the core polygon.
        n_meshed_corner: Number of corners of the core polygon in the meshed part of the film.
        n_sector: Number of elements around the innermost circle in the meshed part of the film.
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

        The mesh consists of the core polygon inside the footprint of the probe, of one or two layers up to a circle
        around the footprint, and of rings from this circle to the rim of the film. The layers and rings are divided
        into sectors.

        Args:
            resolution: Fineness of the mesh.
            topology: Number and kind of the blocks in and around the footprint.
            whole: Whether to mesh the whole film even if the footprint is symmetric.
        """
        self.resolution = resolution
        self.topology = topology
        # A footprint that fills the innermost circle is a circle. On an axisymmetric film, a press with a circular
        # footprint is symmetric about the line from the centre to the press, so a mesh of half of the film suffices.
        self.half = topology.fills_circle and not whole

        # The core polygon is divided into one quadrilateral for each corner. A quadrilateral consists of n_half_edge *
        # n_half_edge elements. At each corner, two half edges meet. Each element along the edges begins a sector
        # outside the core polygon. `around` is the requested number of sectors around the whole innermost circle. The
        # property `copies` is 2 if only half of the film is meshed, and 1 otherwise.
        self.n_corner = topology.n_corner
        self.n_half_edge = max(1, round(resolution.around / (2 * self.n_corner)))
        self.n_meshed_corner = self.n_corner // self.copies
        self.n_sector = 2 * self.n_meshed_corner * self.n_half_edge
        self.n_quad = self.n_meshed_corner * self.n_half_edge**2  # number of elements in the core polygon

        # Count the elements inside the innermost circle, and then all elements including the rings. There are two
        # layers if the boundary of the footprint is a curve between the core polygon and the innermost circle. The thin
        # rings at the rim (`rim`) are counted in addition to the other rings (`rings`).
        self.n_layer = 2 if topology.is_curved and not topology.fills_circle else 1
        self.n_inner = self.n_quad + self.n_layer * self.n_sector
        self.n_ring = resolution.rings + resolution.rim
        self.n_element = self.n_inner + self.n_sector * self.n_ring

        # The nodes of an element form a square grid. The coordinate xi varies fastest.
        line_nodes = lobatto_nodes(resolution.order)
        xi, eta = np.meshgrid(line_nodes, line_nodes)
        self.xi = xi.ravel()
        self.eta = eta.ravel()

    @property
    def footprint(self) -> slice:
        """Indices of the elements that fill the footprint.

        A polygonal footprint consists of the core polygon. A curved footprint also contains the first layer of elements
        around the core polygon.
        """
        if self.topology.is_curved:
            return slice(self.n_quad + self.n_sector)
        return slice(self.n_quad)

    @property
    def copies(self) -> int:
        """Number of copies of the mesh that cover the whole film."""
        return 2 if self.half else 1

    @cached_property
    def boundary_parameter(self) -> Array:
        """Boundary parameters of a curved footprint at the sides of the sectors, shape (n_sector + 1,)."""
        return np.linspace(0.0, math.tau / self.copies, self.n_sector + 1)

    @cached_property
    def half_edge_ends(self) -> Array:
        """Ends of all half edges of the core polygon in the meshed part, shape (2 * n_meshed_corner + 1, n_corner + 1).

        The array contains weights, from which the ends are computed. If only half of the film is meshed, half of the
        corners lie in the meshed part.

        The core polygon is the part of the footprint whose elements have straight sides. A half edge extends from a
        corner to the middle of an edge at this corner. The ends are listed anticlockwise along the boundary: the middle
        of the edge before the first corner, the first corner, the middle of the next edge, and so on. The last end is
        the middle of the edge after the last corner of the meshed part.

        The positions of the corners are not known here. Each end is therefore expressed as a weighted sum of the
        corners and the centroid. Each row of the array contains the weights for one end: first the weights of the
        corners, and then the weight of the centroid.
        """
        # The weights of a corner are 1 for the corner itself, and 0 for all other corners and for the centroid.
        corners = np.eye(self.n_corner, self.n_corner + 1)
        middles_before = 0.5 * (corners + np.roll(corners, 1, axis=0))  # of the edge before each corner
        alternating = np.stack([middles_before, corners], axis=1).reshape(-1, self.n_corner + 1)
        closed_boundary = np.append(alternating, middles_before[:1], axis=0)  # ends where it begins
        return closed_boundary[: 2 * self.n_meshed_corner + 1]

    @cached_property
    def core_outline(self) -> Array:
        """Points at equal distances along each half edge of the core polygon, shape (n_sector + 1, n_corner + 1).

        The points are the inner ends of the lines that separate the sectors. Each point is expressed by the weights of
        the corners and the centroid, as in `half_edge_ends`.
        """
        return divide_intervals(self.half_edge_ends.T, self.n_half_edge).T

    @cached_property
    def inner_corner_weights(self) -> Array:
        """Weights that describe the corners of the elements inside the innermost circle of the mesh.

        The shape is (n_inner, 4, n_corner + 1). The first axis contains the `n_quad` elements of the core polygon,
        followed by the elements of one or two layers around it, with `n_sector` elements in each layer. There are two
        layers if the boundary of the footprint is a curve between the core polygon and the innermost circle.

        The second axis contains the four corners of an element: the first and the last corner of its inner side, and
        the first and the last corner of its outer side. Each of them is a weighted sum of the corners and the centroid
        of the core polygon, whose weights are the last axis. The weights of a corner on a curved side are zero, because
        `Placement.sides` computes the curved sides.
        """
        weights = np.zeros((self.n_inner, 4, self.n_corner + 1))
        weights[: self.n_quad] = self._core_element_corners()

        # The first layer has a straight inner side on the core polygon, and an outer side that is curved. Both sides of
        # the second layer are curved. The weights of curved sides remain zero.
        first_layer = weights[self.n_quad : self.n_quad + self.n_sector]
        first_layer[:, 0] = self.core_outline[:-1]  # first corner of the inner side
        first_layer[:, 1] = self.core_outline[1:]  # last corner of the inner side
        return weights

    def _core_element_corners(self) -> Array:
        """Return the corners of the elements in the core polygon.

        The core polygon is divided into one quadrilateral for each of its corners. The vertices of a quadrilateral are
        the centroid of the core polygon, the middle of the edge after the corner, the middle of the edge before the
        corner, and the corner itself. Its inner side extends from the first vertex to the second vertex, and its outer
        side from the third vertex to the fourth vertex. A quadrilateral is divided into a square grid of
        n_half_edge * n_half_edge elements. Each point is a weighted sum of the corners and the centroid of the core
        polygon, and is expressed by the weights of this sum.

        Returns:
            First and last corner of the inner side, and first and last corner of the outer side of each element, shape
            (n_quad, 4, n_corner + 1), where n_quad is the number of elements in the core polygon. The last axis
            contains the weights. The elements are ordered quadrilateral by quadrilateral.
        """
        centroid = np.eye(self.n_corner + 1)[-1]  # has the weight 1 for itself
        # `half_edge_ends` alternates: middle of an edge, corner, middle, ..., corner, middle. Only the corners in the
        # meshed part of the film are included, whose number is n_meshed_corner.
        middles = self.half_edge_ends[::2]
        corners = self.half_edge_ends[1::2]

        # Divide the inner and the outer side of each quadrilateral into equal parts, shape (n_grid, n_meshed_corner,
        # n_corner + 1). The first axis is the position along the side, and the second axis is the quadrilateral.
        n_grid = self.n_half_edge + 1  # points along a side
        middles_before = middles[:-1]  # of the edge before each corner
        middles_after = middles[1:]
        inner_side = np.linspace(centroid, middles_after, n_grid)
        outer_side = np.linspace(middles_before, corners, n_grid)

        # Divide the lines between opposite points of both sides. The new first axis is the position along these lines.
        grid = np.linspace(inner_side, outer_side, n_grid)  # shape (n_grid, n_grid, n_meshed_corner, n_corner + 1)

        # Neighbouring points of the grid are the corners of an element.
        inner_first = grid[:-1, :-1]
        inner_last = grid[:-1, 1:]
        outer_first = grid[1:, :-1]
        outer_last = grid[1:, 1:]
        element_corners = np.stack([inner_first, inner_last, outer_first, outer_last], axis=3)
        by_quadrilateral = np.moveaxis(element_corners, 2, 0)  # the axis of the quadrilaterals becomes the first axis
        return by_quadrilateral.reshape(self.n_quad, 4, self.n_corner + 1)

    def rotated_elements(self, steps: int, steps_per_turn: int) -> Integers:
        """Return for each element the element whose place it takes after a rotation of the probe.

        The rotation must map the mesh onto itself. Such a mesh covers the whole film.
        The mesh consists of the core polygon under the probe, and of layers and rings around it, which are divided into
        sectors. In the core polygon, all elements at one corner are numbered before the elements at the next corner.
        The sectors are numbered layer by layer and ring by ring, and anticlockwise within each layer or ring.

        Args:
            steps: Number of steps by which the probe is rotated anticlockwise.
            steps_per_turn: Number of steps in a full turn.

        Returns:
            For each element, the index of the element that was at its new place before the rotation, shape
            (n_element,).
        """
        # The rotation maps corners onto corners, so it is a rotation by a whole number of corners. For example, a
        # quarter turn of a square shifts the corners by 1. At each corner, two half edges meet, and each of the
        # n_half_edge elements along a half edge begins a sector. All corners are meshed.
        corner_shift = steps * self.n_corner // steps_per_turn
        sector_shift = 2 * self.n_half_edge * corner_shift
        core_elements = np.arange(self.n_quad).reshape(self.n_meshed_corner, -1)  # one row for each corner
        sectors = np.arange(self.n_quad, self.n_element).reshape(-1, self.n_sector)  # one row for each layer and ring

        # Each element takes the place of the element that lies anticlockwise of it by the shift. This element comes
        # later in the order of the elements, so the numbers are moved backwards.
        rotated_core = np.roll(core_elements, -corner_shift, axis=0)
        rotated_sectors = np.roll(sectors, -sector_shift, axis=1)
        return np.concatenate([rotated_core.ravel(), rotated_sectors.ravel()])

    def into_meshed_half(self, points: Complexes) -> tuple[Complexes, Booleans]:
        """Reflect film points into the upper half of the film if only the upper half is meshed.

        Args:
            points: Film points x + iy, any shape.

        Returns:
            Points in the meshed part of the film, and whether each point was reflected. Both arrays have the shape of
            `points`.
        """
        if not self.half:
            return points, np.zeros(points.shape, dtype=bool)
        return points.real + 1j * np.abs(points.imag), points.imag < 0.0
