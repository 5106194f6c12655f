"""The blocks of the mesh: one topology for all positions, thicknesses and forces.

Seen from the probe, the mesh is a footprint's worth of blocks inside a circle and rings from that circle to the rim:

    a polygon of n corners  is split into n quadrilaterals about its hub,
    2 n blocks              lie between the polygon's half edges and the circle,
    rings of 2 n sectors    carry on to the rim, the last ones thin where bending needs it.

A circular footprint is the same with a virtual square as its polygon and the circle as its edge; since it is
symmetric about the line through the film's centre, only the upper half is meshed if the film is, too. Each block may
be subdivided.
`Placement` says where the blocks lie, `Template` numbers their nodes.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.numerics.interpolation import lobatto_nodes

SQUARE = 4
"""Corners of the virtual polygon inside a circular footprint."""


@dataclass(frozen=True)
class Resolution:
    """How fine the mesh is.

    Attributes:
        order: Polynomial order of the elements.
        around: Elements round the circle; a polygon of n corners takes the nearest multiple of 2 n.
        rings: Rings between the circle and the rim, in equal steps of the logarithm.
        rim: Thin rings at the rim, for bending's boundary layer.
    """

    order: int = 4
    around: int = 8
    rings: int = 5
    rim: int = 0

    @property
    def description(self) -> str:
        """The four numbers as a dataset's manifest names them: "order 4, around 8, rings 5, rim 0"."""
        return ", ".join(f"{name} {value}" for name, value in asdict(self).items())

    def __post_init__(self) -> None:
        if self.order < 2 or self.around < 4 or self.rings < 1 or self.rim < 0:
            raise ValueError(
                f"expected order >= 2, around >= 4, rings >= 1 and rim >= 0, got {self.order}, {self.around}, "
                f"{self.rings}, {self.rim}"
            )


class Blocks:
    """The elements and how they join; nothing in it depends on where the probe is.

    Element e has (order + 1)^2 nodes in tensor order (xi fast, outwards; eta anticlockwise); local coordinates lie in
    [-1, 1]^2. Elements come as quadrilaterals of the polygon, blocks up to the circle, rings from the inside out.

    Attributes:
        resolution: How fine.
        corners: Corners of the probe's polygon, or 0 for a circle.
        half: Whether only the upper half is meshed.
        n_corner: Corners of the polygon, the virtual one of a circle included.
        split: Elements along half an edge of the polygon.
        n_meshed: Corners of the polygon that are meshed.
        n_sector: Elements round the circle.
        n_quad: Elements of the polygon.
        n_inner: Elements inside the circle.
        n_ring: Rings between the circle and the rim.
        n_element: All elements.
        xi: Local coordinate of an element's nodes, shape ((order + 1)^2,).
        eta: Local coordinate of an element's nodes, shape ((order + 1)^2,).
    """

    def __init__(self, resolution: Resolution, corners: int, whole: bool = False) -> None:
        self.resolution = resolution
        self.corners = corners
        self.half = corners == 0 and not whole
        self.n_corner = corners or SQUARE
        self.split = max(1, round(resolution.around / (2 * self.n_corner)))
        self.n_meshed = self.n_corner // 2 if self.half else self.n_corner
        self.n_sector = 2 * self.n_meshed * self.split
        self.n_quad = self.n_meshed * self.split**2
        self.n_inner = self.n_quad + self.n_sector
        self.n_ring = resolution.rings + resolution.rim
        self.n_element = self.n_inner + self.n_sector * self.n_ring
        line = lobatto_nodes(resolution.order)
        xi, eta = np.meshgrid(line, line, indexing="xy")
        self.xi, self.eta = xi.ravel(), eta.ravel()

    @property
    def footprint(self) -> slice | Integers:
        """The elements that fill the footprint."""
        return slice(0, self.n_quad if self.corners else self.n_inner)

    @property
    def copies(self) -> int:
        """How many copies of the template make up the film."""
        return 2 if self.half else 1

    @cached_property
    def boundary(self) -> Array:
        """Points along the polygon's boundary as weights of its corners and hub, shape (n_sector + 1, n_corner + 1).

        From the middle of the edge before the first corner, anticlockwise.
        """
        unit = np.eye(self.n_corner + 1)[:-1]
        middle = 0.5 * (unit + np.roll(unit, -1, axis=0))
        stops = [middle[-1]]
        for i in range(self.n_meshed):
            stops += [unit[i], middle[i]]
        share = np.arange(self.split)[:, None] / self.split
        parts = [a + share * (b - a) for a, b in pairwise(stops)]
        return np.concatenate([*parts, stops[-1][None]])

    @cached_property
    def straight(self) -> Array:
        """Corners (a, b, c, d) of the elements inside the circle as weights of the polygon's corners and its hub.

        The element is (1 - v) (a + t (b - a)) + v (c + t (d - c)); blocks up to the circle have their outer side on it
        and no c and d of their own: zeros stand for them. Shape (n_inner, 4, n_corner + 1).
        """
        k, hub = self.split, np.eye(self.n_corner + 1)[-1]
        parts = []
        for i in range(self.n_meshed):
            before, corner, after = (
                self.boundary[2 * k * i],
                self.boundary[2 * k * i + k],
                self.boundary[2 * k * (i + 1)],
            )
            grid = np.array(
                [[_bilinear(hub, after, before, corner, v / k, t / k) for t in range(k + 1)] for v in range(k + 1)]
            )
            parts += [
                [grid[v, t], grid[v, t + 1], grid[v + 1, t], grid[v + 1, t + 1]] for v in range(k) for t in range(k)
            ]
        void = np.zeros(self.n_corner + 1)
        parts += [[a, b, void, void] for a, b in pairwise(self.boundary)]
        return np.array(parts)

    def rotated(self, fold: int, folds: int) -> Integers:
        """For each element, the one that takes its place when the probe is rotated by fold / folds of a full turn."""
        shift = fold * self.n_corner // folds
        quads = np.arange(self.n_quad).reshape(self.n_meshed, -1)
        sectors = np.arange(self.n_quad, self.n_element).reshape(-1, self.n_sector)
        return np.concatenate(
            [np.roll(quads, -shift, axis=0).ravel(), np.roll(sectors, -2 * self.split * shift, axis=1).ravel()]
        )

    def into_meshed_half(self, film: Complexes) -> tuple[Complexes, Booleans]:
        """Film points where they lie in the meshed part, and which of them were mirrored to get there."""
        mirrored = (film.imag < 0.0) & self.half
        return np.where(self.half, film.real + 1j * np.abs(film.imag), film), mirrored


def _bilinear(a: Array, b: Array, c: Array, d: Array, v: float, t: float) -> Array:
    return (1.0 - v) * (a + t * (b - a)) + v * (c + t * (d - c))
