"""Mesh of a press.

The mesh consists of a template, the position of the template on the film, and integration rules for the elements.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.template import Template, locate_points, template_for
from isocharge.simulate.numerics.interpolation import (
    gauss_reference_square,
    lobatto_nodes,
    lobatto_quadrature,
    tensor_basis,
    tensor_rule,
)
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.footprint import Probe

UNDEFORMED_RADIUS = 0.5
"""Radius within which the mesh of an oval film is the same as the mesh of a circular film, in film radii."""

Pressure = Callable[[Complexes], Array]
"""Function that returns the pressure at film points x + iy, in the shape of the points."""


@dataclass(frozen=True)
class Geometry:
    """Integration rules for the elements of a mesh on the film.

    Attributes:
        nodes: Number of each node of each element, shape (n_element, n_local).
        gradient: Derivatives of the basis functions with respect to (X1, X2) at the quadrature points, shape
            (n_element, n_point, 2, n_local).
        weights: Integration weights of the quadrature points, shape (n_element, n_point). The sum of all weights is the
            meshed area.
        load: Share of the force of the probe that acts on each node, shape (n_node,). The sum of all shares is one over
            the number of copies of the mesh that cover the film.
        mass: Integration weights of the nodes of each element, shape (n_element, n_local).
    """

    nodes: Integers
    gradient: Array
    weights: Array
    load: Array
    mass: Array

    @classmethod
    def build(cls, template: Template, points: Complexes, pressure: Pressure | None = None) -> "Geometry":
        """Compute the integration rules of a mesh, and the share of the probe's force that acts on each node.

        Args:
            template: Template of the mesh.
            points: Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii.
            pressure: Function that returns the pressure at film points (in film radii), in any unit. None if the
                pressure is uniform over the footprint.

        Returns:
            The integration rules.
        """
        # The weights of the quadrature points and of the nodes on the film are the weights on the reference element
        # multiplied by the determinant of the Jacobian.
        rule = _quadrature(template.resolution.order)
        gradient, determinant = _film_gradient(rule.derivatives[:, None], points)
        weights = determinant * rule.weights
        mass = _determinant(rule.node_derivatives[:, None], points) * rule.node_weights

        # Integrate the pressure times each basis function over the elements of the footprint.
        footprint = template.footprint
        if pressure is None:
            footprint_weights = weights[footprint]  # shape (n_footprint_element, n_point)
            element_load = footprint_weights @ rule.values  # shape (n_footprint_element, n_local)
            total_load = footprint_weights.sum()
        else:
            element_load = _integrate_pressure(template.resolution.order, points[footprint], pressure)
            total_load = element_load.sum()

        # Divide the forces by the force on the whole film. The mesh covers one of several equal copies, so the shares
        # of its nodes add up to 1 / copies.
        node_load = np.bincount(template.nodes[footprint].ravel(), element_load.ravel(), template.n_node)
        load = node_load / (template.copies * total_load)
        return cls(template.nodes, gradient, weights, load, mass)

    @property
    def stacked(self) -> Array:
        """The array `gradient`, in which one axis contains all points and both derivatives at each point.

        The shape is (n_element, n_point * 2, n_local).
        """
        return self.gradient.reshape(len(self.gradient), -1, self.gradient.shape[-1])

    def gather(self, contributions: Array) -> Array:
        """Sum the contributions of all elements at each node.

        Args:
            contributions: Contribution of each element at each of its nodes, shape (n_element, n_local).

        Returns:
            Sums at the nodes, shape (n_node,).
        """
        return np.bincount(self.nodes.ravel(), contributions.ravel(), self.load.size).astype(np.float64)


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """Mesh of a press. The press and the film are rotated such that the press lies on the positive x axis.

    Attributes:
        template: Template of the mesh.
        placement: Position of the template on a circular film.
        layer: Total width of the thin rings at the rim, in film radii.
        oval: Shape of the clamp as the complex number e exp(2 i alpha). In the direction `angle`, the rim of the film
            lies at the distance 1 + e cos(2 (angle - alpha)) from the centre, in film radii. 0 for a circular clamp.
    """

    template: Template
    placement: Placement
    layer: float
    oval: complex = 0.0

    @property
    def resolution(self) -> Resolution:
        """Fineness of the mesh."""
        return self.template.resolution

    @cached_property
    def points(self) -> Complexes:
        """Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii."""
        circular_points = self.placement.element_points(self.template)
        return to_oval(circular_points, self.oval)

    @property
    def node_points(self) -> Complexes:
        """Film points x + iy of the nodes, shape (n_node,), in film radii."""
        return self.points.ravel()[self.template.first_occurrence]

    @cached_property
    def geometry(self) -> Geometry:
        """Integration rules of the elements."""
        is_uniform = self.placement.probe.has_uniform_pressure
        return Geometry.build(self.template, self.points, None if is_uniform else self._pressure)

    @property
    def shape_error(self) -> float:
        """Relative error of a charge, predicted from the shapes of the elements; infinite if an element is folded.

        The elements approximate the conformal map by polynomials, so the area of the mesh differs slightly from the
        area of the film. The predicted error is the square root of the relative difference between both areas. The
        largest error of a charge of random presses is about a third of the predicted error.
        """
        geometry = self.geometry
        is_folded = geometry.weights.min() <= 0.0 or geometry.mass.min() <= 0.0
        if is_folded:
            return np.inf
        film_area = np.pi * (1.0 + 0.5 * abs(self.oval) ** 2)  # in squared film radii
        mesh_area = self.template.copies * geometry.weights.sum()
        return float(np.sqrt(abs(mesh_area / film_area - 1.0)))

    def _pressure(self, points: Complexes) -> Array:
        """Compute the pressure of the probe at film points, divided by the mean pressure.

        Args:
            points: Film points x + iy rotated with the press, shape (..., n), in film radii.

        Returns:
            Relative pressure, same shape, dimensionless.
        """
        centroid = self.placement.corners[-1]
        circular_points = from_oval(points, self.oval)
        points_from_centroid_mm = (circular_points - centroid) / self.placement.rotation_and_scale
        return self.placement.probe.pressure(points_from_centroid_mm)

    def locate(self, points: Complexes) -> tuple[Integers, Array, Array, Booleans]:
        """Find the elements that contain film points.

        Args:
            points: Film points x + iy rotated with the press, shape (n,), in film radii.

        Returns:
            Index of the element, local coordinates xi and eta in the element, and whether the point was reflected into
            the meshed half, each of shape (n,).
        """
        circular_points = from_oval(points, self.oval)
        meshed_points, is_reflected = self.template.into_meshed_half(circular_points)

        # `locate_points` expects one row of points for each placement. Here, there is a single placement.
        (element,), (xi,), (eta,) = locate_points(self.placement[None], self.template, meshed_points[None])
        return element, xi, eta, is_reflected

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
        gradient, _ = _film_gradient(derivatives[:, :, None, :], self.points[element])
        return gradient[:, 0]

    def node_derivatives(self, values: Array) -> Array:
        """Compute the derivatives of a field with respect to (X1, X2) at the nodes of every element.

        Args:
            values: Values of the field at the nodes, shape (n_element, n_local, k).

        Returns:
            Derivatives, shape (n_element, n_local, 2, k).
        """
        gradient = self._node_gradient
        n_element, n_local, _, _ = gradient.shape
        stacked_gradient = gradient.reshape(n_element, n_local * 2, n_local)
        derivatives = stacked_gradient @ values  # shape (n_element, n_local * 2, k)
        return derivatives.reshape(n_element, n_local, 2, -1)

    @cached_property
    def _node_gradient(self) -> Array:
        """Derivatives of the basis functions with respect to (X1, X2) at the nodes of every element.

        The shape is (n_element, n_local, 2, n_local).
        """
        gradient, _ = _film_gradient(_quadrature(self.resolution.order).node_derivatives[:, None], self.points)
        return gradient


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
        whole: Whether to mesh the whole film although film and footprint are symmetric. A load that is not symmetric
            requires such a mesh.

    Returns:
        The mesh. It is rotated such that the press lies on the positive x axis.
    """
    needs_whole_mesh = whole or not film.is_axisymmetric
    template = template_for(resolution, probe.topology, needs_whole_mesh)

    # Rotate the press, the probe and the axis of an oval film such that the press lies on the positive x axis.
    x, y = at
    direction = float(np.arctan2(y, x))
    distance = distance_on_circular_film(film, np.array(np.hypot(x, y)), direction)
    placement = Placement.of(template, probe.rotated(-direction), distance, film.radius, layer)
    return PlacedMesh(template, placement, layer, complex(film_oval(film, direction)))


def film_oval(film: Film, direction: float | Array) -> Complexes:
    """Return the shape of the clamp in the frame of a press; see `PlacedMesh.oval`.

    Args:
        film: The film.
        direction: Direction from the centre of the film to the press, any shape, rad.
    """
    return np.asarray(film.oval * np.exp(2j * (film.oval_axis - direction)))


def distance_on_circular_film(film: Film, distance: Array, direction: float | Array) -> Array:
    """Convert distances from the centre of an oval film into distances on the circular film that `to_oval` deforms.

    Args:
        film: The film. If its clamp is circular, the distances do not change.
        distance: Distances from the centre, any shape, mm.
        direction: Directions from the centre, a number or of the shape of `distance`, rad.

    Returns:
        Distances, shape of `distance`, mm.
    """
    if not film.oval:
        return distance
    points_on_x_axis = np.asarray(distance / film.radius, dtype=complex)  # rotated, in film radii
    return film.radius * np.asarray(from_oval(points_on_x_axis, film_oval(film, direction)).real)


def to_oval(points: Complexes, oval: complex | Complexes) -> Complexes:
    """Convert points of a circular film into points of an oval film.

    Each point is displaced in the radial direction. Points within `UNDEFORMED_RADIUS` remain unchanged. The point of
    the rim in the direction `angle` is displaced by e cos(2 (angle - alpha)) film radii.

    Args:
        points: Points x + iy of the circular film, any shape, in film radii.
        oval: Shape e exp(2 i alpha) of the clamp; see `PlacedMesh`.

    Returns:
        Points x + iy of the oval film, same shape, in film radii.
    """
    if not np.any(oval):
        return points
    radius = np.maximum(np.abs(points), UNDEFORMED_RADIUS)  # the displacement ratio is zero at `UNDEFORMED_RADIUS`
    rim_displacement = (np.conj(oval) * (points / radius) ** 2).real  # e cos(2 (angle - alpha))
    return points * (1.0 + _displacement_ratio(radius) * rim_displacement)


def from_oval(points: Complexes, oval: complex | Complexes, newton_steps: int = 8) -> Complexes:
    """Convert points of an oval film into points of a circular film. This function is the inverse of `to_oval`.

    The radius of each point on the circular film is computed by Newton's method with an approximate slope.

    Args:
        points: Points x + iy of the oval film, any shape, in film radii.
        oval: Shape e exp(2 i alpha) of the clamp, a number or an array that broadcasts with the points; see
            `PlacedMesh`.
        newton_steps: Number of Newton steps of `from_oval`. After this number of steps, the error is of the order of
            rounding errors for oval parameters up to e = 0.05.

    Returns:
        Points x + iy of the circular film, same shape, in film radii.
    """
    if not np.any(oval):
        return points
    oval_radius = np.maximum(np.abs(points), UNDEFORMED_RADIUS)
    rim_displacement = (np.conj(oval) * (points / oval_radius) ** 2).real  # e cos(2 (angle - alpha))
    radius = oval_radius
    for _ in range(newton_steps):
        displacement_ratio = _displacement_ratio(radius)
        residual = radius * (1.0 + displacement_ratio * rim_displacement) - oval_radius
        # If d(r) is the displacement ratio at the radius r, the derivative of r d(r) is d + r d', which is 7 d at the
        # rim. The factor 7 is used for all radii, because an approximate slope is sufficient for the convergence.
        slope = 1.0 + 7.0 * rim_displacement * displacement_ratio
        radius = radius - residual / slope
    return points * (radius / oval_radius)


def _displacement_ratio(radius: Array) -> Array:
    """Compute the relative displacement at a radius, divided by the relative displacement of the rim.

    A relative displacement is a displacement divided by the radius of the displaced point.
    The ratio increases with the third power of the distance from `UNDEFORMED_RADIUS`, and is 1 at the rim.

    Args:
        radius: Radii of at least `UNDEFORMED_RADIUS`, any shape, in film radii.
    """
    return ((radius - UNDEFORMED_RADIUS) / (1.0 - UNDEFORMED_RADIUS)) ** 3


class _Quadrature(NamedTuple):
    """Integration rules on the reference element.

    Attributes:
        values: Basis functions at the Gauss points, shape (n_point, n_local).
        derivatives: Derivatives of the basis functions with respect to (xi, eta) at the Gauss points, shape
            (2, n_point, n_local).
        weights: Weights of the Gauss points, shape (n_point,).
        node_derivatives: Derivatives of the basis functions with respect to (xi, eta) at the nodes, shape
            (2, n_local, n_local).
        node_weights: Gauss-Lobatto weights of the nodes, shape (n_local,).
    """

    values: Array
    derivatives: Array
    weights: Array
    node_derivatives: Array
    node_weights: Array


def _integrate_pressure(order: int, points: Complexes, pressure: Pressure, points_per_side: int = 32) -> Array:
    """Integrate the product of the pressure and each basis function over each element.

    Args:
        order: Order of the elements.
        points: Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii.
        pressure: Function that returns the pressure at film points.
        points_per_side: Number of integration points in each direction of an element for a pressure that is not
            uniform.

    Returns:
        Integrals, shape (n_element, n_local).
    """
    xi, eta, reference_weights = gauss_reference_square(points_per_side)
    values, derivatives = tensor_basis(order, xi, eta)
    film_weights = _determinant(derivatives[:, None], points) * reference_weights
    quadrature_points = points @ values.T  # film points, shape (n_element, n_point)
    force_at_points = pressure(quadrature_points) * film_weights
    return force_at_points @ values


@lru_cache(maxsize=16)
def _quadrature(order: int) -> _Quadrature:
    """Return the integration rules for elements of a given polynomial order.

    The first rule uses the Gauss points of an element, and the second rule uses its nodes (Gauss-Lobatto rule).

    Args:
        order: Order of the elements.
    """
    # Gauss rule
    xi, eta, weights = gauss_reference_square(order + 1)
    values, derivatives = tensor_basis(order, xi, eta)

    # Gauss-Lobatto rule
    node_xi, node_eta, node_weights = tensor_rule(lobatto_nodes(order), lobatto_quadrature(order))
    _, node_derivatives = tensor_basis(order, node_xi, node_eta)
    return _Quadrature(values, derivatives, weights, node_derivatives, node_weights)


def _film_gradient(derivatives: Array, points: Complexes) -> tuple[Array, Array]:
    """Compute the derivatives of the basis functions with respect to the film coordinates.

    Args:
        derivatives: Derivatives of the basis functions with respect to (xi, eta), shape
            (2, n_element, n_point, n_local). The second axis may have the length 1 if the derivatives are the same for
            all elements.
        points: Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii.

    Returns:
        Derivatives with respect to (X1, X2), shape (n_element, n_point, 2, n_local). Determinant of the Jacobian, shape
        (n_element, n_point).
    """
    # With the derivatives z_xi and z_eta of the film points z = x + iy, the determinant is the imaginary part of
    # conj(z_xi) z_eta. The derivatives of a function f are f_x + i f_y = i (z_xi f_eta - z_eta f_xi) / determinant.
    z_xi, z_eta = _point_derivatives(derivatives, points)
    determinant = (np.conj(z_xi) * z_eta).imag
    f_xi, f_eta = derivatives
    complex_gradient = 1j * (z_xi[..., None] * f_eta - z_eta[..., None] * f_xi) / determinant[..., None]
    return np.stack([complex_gradient.real, complex_gradient.imag], axis=2), determinant


def _determinant(derivatives: Array, points: Complexes) -> Array:
    """Compute the determinant of the Jacobian of the map from the reference element to the film.

    Args:
        derivatives: Derivatives of the basis functions; see `_film_gradient`.
        points: Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii.

    Returns:
        Determinants, shape (n_element, n_point).
    """
    z_xi, z_eta = _point_derivatives(derivatives, points)
    return np.asarray((np.conj(z_xi) * z_eta).imag)


def _point_derivatives(derivatives: Array, points: Complexes) -> Complexes:
    """Compute the derivatives of film points with respect to (xi, eta), shape (2, n_element, n_point).

    Args:
        derivatives: Derivatives of the basis functions; see `_film_gradient`.
        points: Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii.
    """
    # Sum over the nodes n, for each local coordinate k (xi or eta), element e and point p.
    return np.asarray(np.einsum("kepn,en->kep", derivatives, points))
