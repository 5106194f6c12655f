"""The mesh of one press: a template, where it lies on the film, and its geometry there."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.mesh.elements import Geometry, film_gradient
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.mesh.template import Template, template_for
from isocharge.simulate.numerics.interpolation import tensor_basis
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """A template where it lies under one press, the press rotated onto the positive x axis.

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

    def locate(self, points: Complexes) -> tuple[Integers, Array, Array, Booleans]:
        """Element, xi and eta of film points, shape (n,), in film radii, the press rotated onto the x axis.

        And which points were mirrored into the half that is meshed.
        """
        position, mirrored = self.template.into_meshed_half(points)
        element, xi, eta = self.placement.batch().locate(self.template, position[None])
        return element[0], xi[0], eta[0], mirrored

    def gradient(self, element: Integers, xi: Array, eta: Array) -> Array:
        """d(basis)/d(X1, X2) at points of elements, shape (n, 2, n_local)."""
        _, by_local = tensor_basis(self.resolution.order, xi, eta)
        return film_gradient(by_local[:, :, None, :], self.points[element])[0][:, 0]

    def node_derivatives(self, values: Array) -> Array:
        """Derivatives by (X1, X2) at the nodes of every element, of values at those nodes.

        Args:
            values: Shape (n_element, n_local, k).

        Returns:
            Shape (n_element, n_local, 2, k).
        """
        gradient = self._node_gradient
        flat = gradient.reshape(len(gradient), -1, gradient.shape[-1])
        return (flat @ values).reshape(*gradient.shape[:3], -1)

    @cached_property
    def _node_gradient(self) -> Array:
        """d(basis)/d(X1, X2) at the nodes of every element, shape (n_element, n_local, 2, n_local)."""
        _, by_local = tensor_basis(self.resolution.order, self.template.xi, self.template.eta)
        return film_gradient(by_local[:, None], self.points)[0]


def place(film: Film, probe: Probe, at: tuple[float, float], resolution: Resolution, layer: float) -> PlacedMesh:
    """Place the template of a probe under a press; `layer` is the width of the thin rings over the film's radius."""
    template = template_for(probe, resolution)
    rotated = probe.rotated(-float(np.arctan2(at[1], at[0])))
    return PlacedMesh(template, Placement.of(template, rotated, np.array(np.hypot(*at)), film.radius, layer), layer)
