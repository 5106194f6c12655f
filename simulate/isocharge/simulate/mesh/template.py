"""The mesh as a template: its blocks, and one number for each node."""

from functools import lru_cache

import numpy as np
from scipy.sparse import csr_array

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.simulate.mesh.blocks import Blocks, Resolution
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.sensor.probe import Circle, Polygon, Probe

SAMPLE_REACH, SAMPLE_DISTANCE, SAMPLE_LAYER = 0.1, 0.1, 0.05
"""A press that shows which nodes coincide, in film radii: any on which no elements fold would do."""


class Template(Blocks):
    """Blocks whose nodes are numbered: elements that touch share the nodes between them.

    Attributes:
        nodes: Node number of each element's nodes, shape (n_element, (order + 1)^2).
        n_node: Number of nodes.
        first_seen: Place of each node among all elements' nodes where it comes first, shape (n_node,).
        on_rim: Whether a node lies on the rim, shape (n_node,).
        on_axis: Whether a node lies on the line of symmetry of a half template, shape (n_node,).
        splits: Where the elements lie in the blocks if some are split, a row each; empty if none is.
        constraint: Values at all nodes from those that do not hang, shape (n_node, n_node); None if none hangs.
    """

    splits: Array = np.empty(0)
    constraint: csr_array | None = None

    def __init__(self, resolution: Resolution, corners: int, whole: bool = False) -> None:
        super().__init__(resolution, corners, whole)
        points = sample_points(self)
        z = points.ravel()
        _, self.first_seen, number = np.unique(np.round(z, 9), return_index=True, return_inverse=True)
        self.nodes: Integers = number.reshape(points.shape)
        self.n_node = self.first_seen.size
        self.on_rim = np.abs(z[self.first_seen]) > 1.0 - 1e-9
        self.on_axis = (np.abs(z[self.first_seen].imag) < 1e-9) & self.half

    def from_base(self, values: np.ndarray) -> np.ndarray:
        """Values at the elements' nodes, shape (n_element, n_local, ...), from those of the blocks'."""
        return values

    def within(self, element: Integers, xi: Array, eta: Array) -> tuple[Integers, Array, Array]:
        """Element, xi and eta of points that are given by those of the blocks."""
        return element, xi, eta


def sample_points(blocks: Blocks) -> Complexes:
    """Film points of every element's nodes under one press, shape (n_element, (order + 1)^2)."""
    turn = np.linspace(0.0, 2.0 * np.pi, max(blocks.corners, 3), endpoint=False)
    outline = SAMPLE_REACH * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    probe: Probe = Polygon.of(outline) if blocks.corners else Circle(SAMPLE_REACH)
    return Placement.of(blocks, probe, np.array(SAMPLE_DISTANCE), 1.0, SAMPLE_LAYER).element_points(blocks)


def corners_of(probe: Probe) -> int:
    """Corners of a probe's outline, 0 for a circle: all that a template has to know of the probe."""
    return len(probe.corners) if isinstance(probe, Polygon) else 0


@lru_cache(maxsize=16)
def template(resolution: Resolution, corners: int, whole: bool = False) -> Template:
    """The template of a resolution for a polygon with this number of corners, 0 for a circle; built once.

    `whole` meshes both halves under a circle, too.
    """
    return Template(resolution, corners, whole)


def template_for(probe: Probe, resolution: Resolution, whole: bool = False) -> Template:
    """The template that follows a probe's outline; `whole` as above."""
    return template(resolution, corners_of(probe), whole and corners_of(probe) == 0)
