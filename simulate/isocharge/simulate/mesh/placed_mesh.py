"""The mesh of one press: a template, where it lies on the film, and its geometry there."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Complexes
from isocharge.simulate.mesh.elements import Geometry
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.mesh.template import Template, template_for
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """A template where it lies under one press, the press turned onto the positive x axis.

    Attributes:
        template: The template.
        placement: Where it lies.
        layer: Width of the thin rings at the rim over the film's radius.
    """

    template: Template
    placement: Placement
    layer: float

    @property
    def resolution(self) -> Resolution:
        """How fine it is."""
        return self.template.resolution

    @cached_property
    def points(self) -> Complexes:
        """Film points of every element's nodes, shape (n_element, n_local), in film radii."""
        return self.placement.element_points(self.template)

    @property
    def node_points(self) -> Complexes:
        """Film points of the nodes, shape (n_node,), in film radii."""
        nodes: Complexes = self.points.ravel()[self.template.first_seen]
        return nodes

    @cached_property
    def geometry(self) -> Geometry:
        """The elements, ready for integration."""
        return Geometry.build(self.template, self.points)


def place(film: Film, probe: Probe, at: tuple[float, float], resolution: Resolution, layer: float) -> PlacedMesh:
    """Place the template of a probe under a press; `layer` is the width of the thin rings over the film's radius."""
    template = template_for(probe, resolution)
    turned = probe.turned(-float(np.arctan2(at[1], at[0])))
    return PlacedMesh(template, Placement.of(template, turned, np.array(np.hypot(*at)), film.radius, layer), layer)
