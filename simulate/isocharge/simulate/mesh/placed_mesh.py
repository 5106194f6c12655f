"""Mesh of a press.

The mesh consists of a template and the position of the template on the film. The integration rules for the elements are
computed only when they are first needed.
"""

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.oval import film_oval
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.template import Template, template_for
from isocharge.simulate.numerics.interpolation import (
    gauss_reference_square,
    lobatto_nodes,
    lobatto_quadrature,
    tensor_basis,
    tensor_rule,
)
from isocharge.simulate.numerics.polygon import cross_product
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.footprint import Probe

PRESSURE_POINTS = 32
"""Number of integration points in each direction of an element if the pressure of the probe is not uniform."""


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """Mesh of a press. The press and the film are rotated such that the press lies on the positive x axis.

    Attributes:
        template: Template of the mesh.
        placement: Position of the template on the film.
        layer: Total width of the thin rings at the rim, in film radii.
    """

    template: Template
    placement: Placement
    layer: float

    @property
    def resolution(self) -> Resolution:
        """Fineness of the mesh."""
        return self.template.resolution

    @cached_property
    def points(self) -> Complexes:
        """Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii."""
        return self.placement.element_points(self.template)

    @property
    def node_points(self) -> Complexes:
        """Film points x + iy of the nodes, shape (n_node,), in film radii."""
        return self.points.ravel()[self.template.first_occurrence]

    @cached_property
    def gauss_gradient(self) -> Array:
        """Derivatives of the basis functions with respect to (X1, X2) at the quadrature points.

        The shape is (n_element, n_point, 2, n_local).
        """
        return _film_gradient(self._element_rule.derivatives, self.points)

    @property
    def stacked_gradient(self) -> Array:
        """Array `gauss_gradient` with the axes of the points and of the two coordinates joined into one axis.

        The shape is (n_element, n_point * 2, n_local).
        """
        gradient = self.gauss_gradient
        return gradient.reshape(len(gradient), -1, gradient.shape[-1])

    @cached_property
    def weights(self) -> Array:
        """Integration weights of the quadrature points, shape (n_element, n_point). Their sum is the meshed area."""
        return self._element_rule.film_weights(self.points)

    @cached_property
    def laplace(self) -> Array:
        """Integrals of dot(grad p, grad q) for all pairs (p, q) of basis functions of each element.

        The shape is (n_element, n_local, n_local).
        """
        weights = np.repeat(self.weights, 2, axis=1)[..., None]  # for both derivatives at each quadrature point
        return self.stacked_gradient.transpose(0, 2, 1) @ (weights * self.stacked_gradient)

    @cached_property
    def node_weights(self) -> Array:
        """Integration weights of the nodes of each element, shape (n_element, n_local)."""
        return _lobatto_rule(self.resolution.order).film_weights(self.points)

    @cached_property
    def load(self) -> Array:
        """Share of the force of the probe that acts on each node, shape (n_node,).

        The shares add up to one if the whole film is meshed, and to one half if only half of the film is meshed.
        """
        template = self.template
        placement = self.placement
        rule = self._element_rule
        # A pressure that is not uniform needs more integration points.
        if not placement.probe.has_uniform_pressure:
            rule = _gauss_rule(self.resolution.order, PRESSURE_POINTS)

        # Compute the pressure at the quadrature points of the elements of the footprint.
        nodal_points = self.points[template.footprint]
        quadrature_points = nodal_points @ rule.values.T
        # The last entry of `corners` is the centroid of the footprint on a circular film. If the clamp is oval, the
        # footprint is displaced.
        centroid = placement.corners[-1] + placement.footprint_displacement
        # The factor `rotation_and_scale` converts points of the footprint, in mm, into points on the film, so the
        # division converts them back.
        points_from_centroid_mm = (quadrature_points - centroid) / placement.rotation_and_scale
        pressure = placement.probe.pressure(points_from_centroid_mm)  # divided by the mean pressure

        # Integrate the pressure times each basis function over each element.
        force_at_points = pressure * rule.film_weights(nodal_points)
        element_load = force_at_points @ rule.values  # shape (n_footprint_element, n_local)

        # Add the contributions of all elements at each node, and divide the sums by the force on the whole film, which
        # several equal copies of the mesh cover.
        node_load = np.bincount(template.nodes[template.footprint].ravel(), element_load.ravel(), template.n_node)
        total_force = template.copies * element_load.sum()
        return np.asarray(node_load / total_force)

    def gather(self, contributions: Array) -> Array:
        """Sum the contributions of all elements at each node.

        Args:
            contributions: Contribution of each element at each of its nodes, shape (n_element, n_local).

        Returns:
            Sums at the nodes, shape (n_node,).
        """
        template = self.template
        return np.bincount(template.nodes.ravel(), contributions.ravel(), template.n_node).astype(np.float64)

    @property
    def _element_rule(self) -> "_ElementRule":
        """Integration rule on the reference element, which defines the quadrature points."""
        order = self.resolution.order
        return _gauss_rule(order, order + 1)

    @property
    def shape_error(self) -> float:
        """Relative error of a charge, predicted from the shapes of the elements; infinite if an element is folded.

        The elements approximate the conformal map by polynomials, so the area of the mesh differs slightly from the
        area of the film. The predicted error is the square root of the relative difference between both areas. In tests
        with random presses, the true errors of the charges were at most about a third of the predicted errors.
        """
        # A folded element has a negative area around some of its points.
        is_folded = self.weights.min() <= 0.0 or self.node_weights.min() <= 0.0
        if is_folded:
            return np.inf

        # In film radii, the rim lies at the distance 1 + e cos(2 t) from the centre, where e is the magnitude of
        # `oval`, and t is the angle from its longer axis. The area is the integral of half of the squared distance over
        # all angles, which is pi (1 + e^2 / 2), because the mean of cos(2 t)^2 is one half.
        film_area = np.pi * (1.0 + 0.5 * abs(self.placement.oval) ** 2)
        # `copies` is 2 if only half of the film is meshed, and 1 otherwise.
        mesh_area = self.template.copies * self.weights.sum()
        return math.sqrt(abs(mesh_area / film_area - 1.0))

    def gradient(self, element: Integers, xi: Array, eta: Array) -> Array:
        """Compute the derivatives of the basis functions with respect to (X1, X2) at given points of elements.

        Args:
            element: Index of the element of each point, shape (n,).
            xi: First local coordinate of each point, shape (n,).
            eta: Second local coordinate of each point, shape (n,).

        Returns:
            Derivatives, shape (n, 2, n_local).
        """
        _, derivatives = tensor_basis(self.resolution.order, xi, eta)
        # The axis of length one is for the points of an element, of which there is one.
        gradient = _film_gradient(derivatives[:, :, None, :], self.points[element])  # shape (n, 1, 2, n_local)
        return gradient[:, 0]

    def node_derivatives(self, values: Array) -> Array:
        """Compute the derivatives of a field with respect to (X1, X2) at the nodes of every element.

        Args:
            values: Values of the field at the nodes, shape (n_element, n_local, k).

        Returns:
            Derivatives, shape (n_element, n_local, 2, k).
        """
        gradient = self._node_gradient  # of the basis functions, shape (n_element, n_local, 2, n_local)
        n_element, n_local, _, _ = gradient.shape
        stacked_gradient = gradient.reshape(n_element, n_local * 2, n_local)
        derivatives = stacked_gradient @ values  # shape (n_element, n_local * 2, k)
        return derivatives.reshape(n_element, n_local, 2, -1)

    @cached_property
    def _node_gradient(self) -> Array:
        """Derivatives of the basis functions with respect to (X1, X2) at the nodes of every element.

        The shape is (n_element, n_local, 2, n_local).
        """
        rule = _lobatto_rule(self.resolution.order)  # its points are the nodes
        return _film_gradient(rule.derivatives, self.points)


def place(
    film: Film, probe: Probe, at: tuple[float, float], resolution: Resolution, layer: float, *, whole: bool = False
) -> PlacedMesh:
    """Create the mesh of a press by placing the template of the probe on the film.

    Args:
        film: The film.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.
        resolution: Fineness of the mesh.
        layer: Total width of the thin rings at the rim, in film radii.
        whole: Whether to mesh the whole film even if the film and the footprint are symmetric. A load that is not
            symmetric requires a mesh of the whole film.

    Returns:
        The mesh, rotated such that the press lies on the positive x axis.
    """
    needs_whole_mesh = whole or not film.is_axisymmetric
    template = template_for(resolution, probe.topology, needs_whole_mesh)

    # Rotate the press, the probe and the axis of an oval film such that the press lies on the positive x axis. The
    # complex number `oval` describes the rotated clamp, and is zero for a circular clamp.
    x, y = at
    direction = math.atan2(y, x)
    distance = np.hypot(x, y)
    oval = film_oval(film, direction)
    placement = Placement.of(template, probe.rotated(-direction), distance, film.radius, layer, oval=oval)
    return PlacedMesh(template, placement, layer)


class _ElementRule(NamedTuple):
    """Integration rule on the reference element.

    Attributes:
        values: Basis functions at the points, shape (n_point, n_local).
        derivatives: Derivatives of the basis functions with respect to (xi, eta) at the points, shape
            (2, 1, n_point, n_local). The second axis has the length 1, because the derivatives are the same for all
            elements.
        weights: Weights of the points, shape (n_point,).
    """

    values: Array
    derivatives: Array
    weights: Array

    @classmethod
    def of(cls, order: int, xi: Array, eta: Array, weights: Array) -> "_ElementRule":
        """Create the rule for elements of the given order from the points and weights of a quadrature rule.

        The coordinates xi and eta and the weights of the points each have the shape (n_point,).
        """
        values, derivatives = tensor_basis(order, xi, eta)
        return cls(values, derivatives[:, None], weights)  # one axis is added for the elements

    def film_weights(self, points: Complexes) -> Array:
        """Compute the integration weights of the rule for the elements on the film.

        Args:
            points: Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii.

        Returns:
            Weights of the points of the rule, shape (n_element, n_point), in squared film radii.
        """
        z_xi, z_eta = _point_derivatives(self.derivatives, points)
        determinant = cross_product(z_xi, z_eta)  # ratio of areas on the film to areas on the reference element
        return determinant * self.weights


@cache
def _gauss_rule(order: int, points_per_side: int) -> _ElementRule:
    """Return the Gauss rule for elements of a given order, with the given number of points in each direction."""
    return _ElementRule.of(order, *gauss_reference_square(points_per_side))


@cache
def _lobatto_rule(order: int) -> _ElementRule:
    """Return the Gauss-Lobatto rule, whose points are the nodes, for elements of a given order."""
    return _ElementRule.of(order, *tensor_rule(lobatto_nodes(order), lobatto_quadrature(order)))


def _film_gradient(derivatives: Array, points: Complexes) -> Array:
    """Compute the derivatives of the basis functions with respect to the film coordinates.

    Args:
        derivatives: Derivatives of the basis functions with respect to (xi, eta), shape
            (2, n_element, n_point, n_local). The second axis may have the length 1 if the derivatives are the same for
            all elements.
        points: Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii.

    Returns:
        Derivatives with respect to (X1, X2), shape (n_element, n_point, 2, n_local).
    """
    # The film points z = x + iy and a basis function f are functions of xi and eta. According to the chain rule,
    #   f_xi = x_xi f_x + y_xi f_y   and   f_eta = x_eta f_x + y_eta f_y.
    # The solution of both equations, in complex numbers, is
    #   f_x + i f_y = i (z_xi f_eta - z_eta f_xi) / determinant   with   determinant = x_xi y_eta - y_xi x_eta.
    z_xi, z_eta = _point_derivatives(derivatives, points)
    determinant = cross_product(z_xi, z_eta)  # of the Jacobian matrix of (x, y)
    f_xi, f_eta = derivatives
    complex_gradient = 1j * (z_xi[..., None] * f_eta - z_eta[..., None] * f_xi) / determinant[..., None]
    return np.stack([complex_gradient.real, complex_gradient.imag], axis=2)


def _point_derivatives(derivatives: Array, points: Complexes) -> Complexes:
    """Compute the derivatives of film points with respect to (xi, eta), shape (2, n_element, n_point).

    Args:
        derivatives: Derivatives of the basis functions; see `_film_gradient`.
        points: Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii.
    """
    # Sum over the nodes, which are the last axis of `derivatives` and the column of points of each element.
    return (derivatives @ points[..., None])[..., 0]
