"""Mesh templates, which contain the elements of a mesh and the numbers of the nodes.

A template is the same for all positions of a probe.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isocharge.common.arrays import Complexes, Integers
from isocharge.simulate.mesh.blocks import Blocks, Resolution
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.sensor.footprint import FootprintTopology, Probe
from isocharge.simulate.sensor.probe import Circle, Polygon, RoundProbe

SAMPLE_REACH = 0.1
"""Reach of the footprint of the sample press, in film radii.

Nodes of different elements that coincide under the sample press are the same node.
"""

SAMPLE_DISTANCE = 0.1
"""Distance of the sample press from the centre of the film, in film radii."""

SAMPLE_LAYER = 0.05
"""Width of the thin rings at the rim under the sample press, in film radii."""


class Template(Blocks):
    """Elements with numbered nodes. Adjacent elements share the nodes on their common side.

    Attributes:
        nodes: Number of each node of each element, shape (n_element, (order + 1)^2).
        n_node: Number of nodes.
        first_occurrence: Index of the first occurrence of each node among the nodes of all elements, shape (n_node,).
        on_rim: Whether each node lies on the rim, shape (n_node,).
        on_axis: Whether each node lies on the line of symmetry of a half mesh, shape (n_node,).
    """

    def __init__(self, resolution: Resolution, topology: FootprintTopology, whole: bool = False) -> None:
        """Count the elements and number their nodes.

        Nodes of different elements count as one node if they have the same position under a sample press.

        Args:
            resolution: Fineness of the mesh.
            topology: Number and kind of the blocks in and around the footprint.
            whole: Whether to mesh the whole film although the footprint is symmetric.
        """
        super().__init__(resolution, topology, whole)
        element_points = sample_points(self)  # x + iy in film radii, shape (n_element, n_local)
        all_points = element_points.ravel()
        rounded_points = np.round(all_points, 9)  # positions of the same node may differ by rounding errors
        _, self.first_occurrence, node_number = np.unique(rounded_points, return_index=True, return_inverse=True)
        self.nodes: Integers = node_number.reshape(element_points.shape)
        self.n_node = self.first_occurrence.size

        # Find the nodes on the rim, and the nodes on the line of symmetry of a half mesh.
        node_points = all_points[self.first_occurrence]
        self.on_rim = np.abs(node_points) > 1.0 - 1e-9
        self.on_axis = (np.abs(node_points.imag) < 1e-9) & self.half


@dataclass(frozen=True)
class SampleCurve(RoundProbe):
    """Circular footprint that replaces another curved footprint in the sample press.

    Attributes:
        radius: Radius of the circle, mm.
        other_topology: Topology of the other footprint.
    """

    other_topology: FootprintTopology
    name = "sample"
    period = 2.0 * np.pi

    @property
    def topology(self) -> FootprintTopology:
        """Topology of the other footprint."""
        return self.other_topology


def sample_points(blocks: Blocks) -> Complexes:
    """Return the film points of the nodes of all elements under a sample press.

    No element is folded under the sample press. Therefore two nodes have the same position only if they are the same
    node.

    Args:
        blocks: The elements.

    Returns:
        Film points x + iy, shape (n_element, (order + 1)^2), in film radii.
    """
    probe = _sample_probe(blocks.topology)
    placement = Placement.of(blocks, probe, np.array(SAMPLE_DISTANCE), 1.0, SAMPLE_LAYER)
    return placement.element_points(blocks)


def _sample_probe(topology: FootprintTopology) -> Probe:
    """Create a probe whose footprint has a given topology. The sample press uses this probe on a film of radius 1 mm.

    Args:
        topology: Number and kind of the blocks in and around the footprint.
    """
    if topology.fills_circle:
        return Circle(SAMPLE_REACH)
    if topology.is_curved:
        return SampleCurve(SAMPLE_REACH, topology)
    angle = np.linspace(0.0, 2.0 * np.pi, topology.n_corner, endpoint=False)
    return Polygon.of(SAMPLE_REACH * np.stack([np.cos(angle), np.sin(angle)], axis=1))


@lru_cache(maxsize=16)
def template(resolution: Resolution, topology: FootprintTopology, whole: bool = False) -> Template:
    """Return the template for a given resolution and topology. Templates are cached.

    Args:
        resolution: Fineness of the mesh.
        topology: Number and kind of the blocks in and around the footprint.
        whole: Whether to mesh the whole film although the footprint is symmetric.
    """
    return Template(resolution, topology, whole)


def template_for(probe: Probe, resolution: Resolution, whole: bool = False) -> Template:
    """Return the template for the footprint of a probe.

    Args:
        probe: The probe.
        resolution: Fineness of the mesh.
        whole: Whether to mesh the whole film although the footprint is symmetric.
    """
    topology = probe.topology
    # Only the mesh of a circular footprint may be a half mesh. All other meshes are whole in any case. The arguments
    # are the same for all of them, so that the cache contains their template only once.
    is_whole_circular_mesh = whole and topology.fills_circle
    return template(resolution, topology, is_whole_circular_mesh)
