"""The mesh of one press: a template, its position on the film, and the integration rules of its elements."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.coating import Coating
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.point_location import locate_points
from isocharge.simulate.mesh.template import Template, template_for
from isocharge.simulate.numerics.interpolation import (
    gauss_reference_square,
    lobatto_nodes,
    lobatto_quadrature,
    tensor_basis,
    tensor_values,
)
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe

UNDEFORMED_RADIUS = 0.5
"""Radius within which the mesh of an oval film equals that of a circular film, in film radii."""

PRESSURE_POINTS = 32
"""Number of integration points in each direction of an element for a pressure that is not uniform."""

Pressure = Callable[[Complexes], Array]
"""Function that returns the pressure at film points."""

INVERSE_STEPS = 8
"""Number of Newton steps of `from_oval`. With these steps, the error is of the order of rounding errors up to
e = 0.05."""


@dataclass(frozen=True)
class Geometry:
    """Integration rules for the elements of a mesh on the film.

    Attributes:
        nodes: Node numbers, shape (n_element, n_local).
        gradient: Derivatives of the basis with respect to (X1, X2) at the quadrature points, shape
            (n_element, n_point, 2, n_local).
        weights: Integration weights, shape (n_element, n_point). Their sum is the meshed area.
        load: Share of the load on the deflection W of each node, shape (n_node,). The sum is one over the number of
            copies of the mesh.
        mass: Lumped area of the nodes of each element, shape (n_element, n_local).
        constraint: Matrix for hanging nodes; see `Template.constraint`.
        coat: Indices of the coated elements, shape (n,). Contribution of the coat to the elasticity matrix C / E at the
            quadrature points of these elements, shape (n, n_point, 3, 3). None if there is no coat.
    """

    nodes: Integers
    gradient: Array
    weights: Array
    load: Array
    mass: Array
    constraint: csr_array | None = None
    coat: tuple[Integers, Array] | None = None

    @classmethod
    def build(cls, template: Template, points: Complexes, pressure: Pressure | None = None) -> "Geometry":
        """Compute the integration rules of a mesh, and the forces of a unit load at its nodes.

        Args:
            template: Template of the mesh.
            points: Film points of the nodes of every element, shape (n_element, n_local), in film radii.
            pressure: Function that returns the pressure at film points (in film radii), in any unit. None if the
                pressure is uniform over the footprint.

        Returns:
            The integration rules.
        """
        # Weights of the Gauss points and of the nodes: reference weights times the determinant of the Jacobian
        rule = _quadrature(template.resolution.order)
        gradient, determinant = _film_gradient(rule.derivatives[:, None], points)
        weights = determinant * rule.weights
        node_jacobian = _jacobian(rule.node_derivatives[:, None], points)
        mass = node_jacobian.determinant * rule.node_weights

        # Forces of the pressure at the nodes of the footprint, relative to the force on the whole film. The mesh covers
        # only one of several equal copies of the film, so its forces sum to 1 / copies.
        footprint = template.footprint
        if pressure is None:
            footprint_weights = weights[footprint]  # shape (n_footprint_element, n_point)
            element_load = footprint_weights @ rule.values  # shape (n_footprint_element, n_local)
            total_load = footprint_weights.sum()
        else:
            element_load = _integrated_pressure(template.resolution.order, points[footprint], pressure)
            total_load = element_load.sum()
        node_load = np.bincount(template.nodes[footprint].ravel(), element_load.ravel(), template.n_node)
        load = node_load / (template.copies * total_load)
        if template.constraint is not None:
            load = template.constraint.T @ load
        return cls(template.nodes, gradient, weights, load, mass, template.constraint)

    @property
    def stacked(self) -> Array:
        """Gradient with a common axis for the points and both derivatives, shape (n_element, n_point * 2, n_local)."""
        return self.gradient.reshape(len(self.gradient), -1, self.gradient.shape[-1])

    def gather(self, local: Array) -> Array:
        """Sum the contributions of the elements at the nodes.

        The contributions at a hanging node are distributed to the nodes that determine its value.

        Args:
            local: Contributions, shape (n_element, n_local).

        Returns:
            Sums, shape (n_node,).
        """
        sums = np.bincount(self.nodes.ravel(), local.ravel(), self.load.size).astype(np.float64)
        if self.constraint is None:
            return np.asarray(sums)
        return np.asarray(self.constraint.T @ sums)


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """The mesh of one press, which is rotated onto the positive x axis.

    Attributes:
        template: Template of the mesh.
        placement: Position of the template on a circular film.
        layer: Width of the thin rings at the rim, in film radii.
        oval: Shape of the clamp as the complex number e exp(2 i alpha). In the direction `angle`, the rim of the film
            lies at the distance 1 + e cos(2 (angle - alpha)) from the centre, in film radii. 0 for a circular clamp.
        coat: Coat on parts of the film, in film radii and rotated with the press; None if there is no coat.
    """

    template: Template
    placement: Placement
    layer: float
    oval: complex = 0.0
    coat: Coating | None = None

    @property
    def resolution(self) -> Resolution:
        """Fineness of the mesh."""
        return self.template.resolution

    @cached_property
    def points(self) -> Complexes:
        """Positions of the nodes of every element on the film, x + iy, shape (n_element, n_local), in film radii."""
        return self.template.from_base(to_oval(self.placement.element_points(self.template), self.oval))

    @property
    def node_points(self) -> Complexes:
        """Positions of the nodes on the film, x + iy, shape (n_node,), in film radii."""
        return np.asarray(self.points.ravel()[self.template.first_seen])

    @cached_property
    def geometry(self) -> Geometry:
        """Integration rules of the elements."""
        is_uniform = self.placement.probe.has_uniform_pressure
        geometry = Geometry.build(self.template, self.points, None if is_uniform else self._pressure)
        if self.coat is None:
            return geometry

        # Add the stiffness of the coat at the integration points of the elements that it may cover.
        xi, eta, _ = gauss_reference_square(self.resolution.order + 1)
        basis_values = tensor_values(self.resolution.order, xi, eta)  # shape (n_point, n_local)
        quadrature_points = self.points @ basis_values.T  # shape (n_element, n_point)
        coated_elements = np.flatnonzero(self.coat.near(quadrature_points).any(axis=1))
        added_stiffness = self.coat.moduli(quadrature_points[coated_elements])
        return replace(geometry, coat=(coated_elements, added_stiffness))

    def _pressure(self, points: Complexes) -> Array:
        """Return the pressure of the probe at film points, shape (..., n), relative to the mean pressure.

        Args:
            points: Film points rotated with the press, in film radii.
        """
        centroid = self.placement.corners[-1]
        points_of_probe = (from_oval(points, self.oval) - centroid) / self.placement.rotation_and_scale
        return self.placement.probe.pressure(points_of_probe)

    def locate(self, points: Complexes) -> tuple[Integers, Array, Array, Booleans]:
        """Find the elements that contain film points.

        Args:
            points: Film points rotated with the press, shape (n,), in film radii.

        Returns:
            Index of the element, xi, eta, and whether the point was reflected into the meshed half, each of shape (n,).
        """
        circular_points = from_oval(points, self.oval)
        meshed_points, is_reflected = self.template.into_meshed_half(circular_points)
        # `locate_points` expects one row of points for each placement. Here, there is a single placement.
        (base_element,), (base_xi,), (base_eta,) = locate_points(
            self.placement.batch(), self.template, meshed_points[None]
        )
        element, xi, eta = self.template.within(base_element, base_xi, base_eta)  # after splits of elements
        return element, xi, eta, is_reflected

    def gradient(self, element: Integers, xi: Array, eta: Array) -> Array:
        """Compute the derivatives of the basis with respect to (X1, X2) at points of elements.

        Args:
            element: Index of the element of each point, shape (n,).
            xi: First local coordinate, shape (n,).
            eta: Second local coordinate, shape (n,).

        Returns:
            Derivatives, shape (n, 2, n_local).
        """
        _, derivatives = tensor_basis(self.resolution.order, xi, eta)
        gradient, _ = _film_gradient(derivatives[:, :, None, :], self.points[element])
        return gradient[:, 0]

    def node_derivatives(self, values: Array) -> Array:
        """Compute the derivatives of nodal values with respect to (X1, X2) at the nodes of every element.

        Args:
            values: Values at the nodes, shape (n_element, n_local, k).

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
        """Derivatives of the basis with respect to (X1, X2) at the nodes, shape (n_element, n_local, 2, n_local)."""
        _, derivatives = tensor_basis(self.resolution.order, self.template.xi, self.template.eta)
        gradient, _ = _film_gradient(derivatives[:, None], self.points)
        return gradient


def place(
    film: Film, probe: Probe, at: tuple[float, float], resolution: Resolution, layer: float, *, whole: bool = False
) -> PlacedMesh:
    """Place the template of a probe under a press.

    Args:
        film: The film.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.
        resolution: Fineness of the mesh.
        layer: Width of the thin rings at the rim, in film radii.
        whole: Whether to mesh the whole film although film and footprint are symmetric, as a load that is not symmetric
            requires.

    Returns:
        The mesh, which is rotated so that the press lies on the positive x axis.
    """
    needs_whole_mesh = whole or not film.is_axisymmetric
    template = template_for(probe, resolution, whole=needs_whole_mesh)

    # Rotate the press, the probe and the axis of an oval film so that the press lies on the positive x axis.
    x, y = at
    direction = float(np.arctan2(y, x))
    distance = np.array(np.hypot(x, y))
    placement = Placement.of(template, probe.rotated(-direction), distance, film.radius, layer)
    oval = film.oval * np.exp(2j * (film.oval_axis - direction))
    return PlacedMesh(template, placement, layer, oval)


def to_oval(points: Complexes, oval: complex) -> Complexes:
    """Map points of a circular film to an oval film. Points within `UNDEFORMED_RADIUS` remain unchanged.

    Each point is displaced in the radial direction. At the rim, the relative displacement is e cos(2 (angle - alpha)).

    Args:
        points: Points x + iy, any shape, in film radii.
        oval: e exp(2 i alpha) of the clamp; see `PlacedMesh`.

    Returns:
        Points of the oval film, same shape, in film radii.
    """
    if oval == 0.0:
        return points
    radius = np.maximum(np.abs(points), UNDEFORMED_RADIUS)
    rim_displacement = (np.conj(oval) * (points / radius) ** 2).real
    return np.asarray(points * (1.0 + _relative_displacement(radius) * rim_displacement))


def from_oval(points: Complexes, oval: complex) -> Complexes:
    """Map points of an oval film to a circular film. This is the inverse of `to_oval`.

    The radius is found by Newton's method with an approximate slope.

    Args:
        points: Points x + iy, any shape, in film radii.
        oval: e exp(2 i alpha) of the clamp; see `PlacedMesh`.

    Returns:
        Points of the circular film, same shape, in film radii.
    """
    if oval == 0.0:
        return points
    oval_radius = np.maximum(np.abs(points), UNDEFORMED_RADIUS)
    rim_displacement = (np.conj(oval) * (points / oval_radius) ** 2).real
    radius = oval_radius
    for _ in range(INVERSE_STEPS):
        relative_displacement = _relative_displacement(radius)
        residual = radius * (1.0 + relative_displacement * rim_displacement) - oval_radius
        # With the cubic relative displacement d(r), the derivative of r d(r) is d + r d' = 7 d at the rim. The same
        # ratio is used for all radii, which is sufficient for the convergence.
        slope = 1.0 + 7.0 * rim_displacement * relative_displacement
        radius = radius - residual / slope
    return np.asarray(points * (radius / oval_radius))


def _relative_displacement(radius: Array) -> Array:
    """Return the ratio of the displacement at a radius to the displacement of the rim.

    The ratio is 0 at `UNDEFORMED_RADIUS` and 1 at the rim.
    """
    return np.asarray(((radius - UNDEFORMED_RADIUS) / (1.0 - UNDEFORMED_RADIUS)) ** 3)


class _Quadrature(NamedTuple):
    """Integration rules on the reference element.

    Attributes:
        values: Basis at the Gauss points, shape (n_point, n_local).
        derivatives: Derivatives of the basis with respect to (xi, eta) at the Gauss points, shape (2, n_point,
            n_local).
        weights: Weights of the Gauss points, shape (n_point,).
        node_derivatives: Derivatives of the basis with respect to (xi, eta) at the nodes, shape (2, n_local, n_local).
        node_weights: Gauss-Lobatto weights of the nodes, shape (n_local,).
    """

    values: Array
    derivatives: Array
    weights: Array
    node_derivatives: Array
    node_weights: Array


def _integrated_pressure(order: int, points: Complexes, pressure: Pressure) -> Array:
    """Integrate the pressure times each basis function over elements.

    Args:
        order: Order of the elements.
        points: Film points of the nodes of every element, shape (n_element, n_local), in film radii.
        pressure: Function that returns the pressure at film points.

    Returns:
        Integrals, shape (n_element, n_local).
    """
    xi, eta, weights = gauss_reference_square(PRESSURE_POINTS)
    values, derivatives = tensor_basis(order, xi, eta)
    weights_on_film = _jacobian(derivatives[:, None], points).determinant * weights
    film_points = points @ values.T  # the integration points, shape (n_element, n_point)
    force_at_points = pressure(film_points) * weights_on_film
    return np.asarray(force_at_points @ values)


class _Jacobian(NamedTuple):
    """Derivatives of the film coordinates (x, y) with respect to (xi, eta), each of shape (n_element, n_point)."""

    x_xi: Array
    x_eta: Array
    y_xi: Array
    y_eta: Array
    determinant: Array


@lru_cache(maxsize=16)
def _quadrature(order: int) -> _Quadrature:
    """Return the integration rules for elements of an order: at Gauss points, and at the nodes (Lobatto)."""
    xi, eta, weights = gauss_reference_square(order + 1)
    values, derivatives = tensor_basis(order, xi, eta)
    nodes = lobatto_nodes(order)
    node_xi, node_eta = np.meshgrid(nodes, nodes)
    _, node_derivatives = tensor_basis(order, node_xi.ravel(), node_eta.ravel())
    line_weights = lobatto_quadrature(order)
    node_weights = np.outer(line_weights, line_weights).ravel()
    return _Quadrature(values, derivatives, weights, node_derivatives, node_weights)


def _film_gradient(derivatives: Array, points: np.ndarray) -> tuple[Array, Array]:
    """Compute the derivatives of the basis with respect to the film coordinates.

    Args:
        derivatives: Derivatives of the basis with respect to (xi, eta), shape (2, n_element or 1, n_point, n_local).
        points: Film points of the nodes of every element, shape (n_element, n_local), in film radii.

    Returns:
        Derivatives with respect to (X1, X2), shape (n_element, n_point, 2, n_local). Determinant of the Jacobian, shape
        (n_element, n_point).
    """
    # Inverse of the 2 x 2 Jacobian: row X1 is (y_eta, -y_xi), and row X2 is (-x_eta, x_xi), over the determinant.
    jacobian = _jacobian(derivatives, points)
    determinant = jacobian.determinant
    adjugate = np.stack([jacobian.y_eta, -jacobian.y_xi, -jacobian.x_eta, jacobian.x_xi], axis=-1)
    inverse = (adjugate / determinant[..., None]).reshape(*determinant.shape, 2, 2)
    # Sum over the local derivative b, for each element e, point p, film derivative a and node n.
    gradient = np.einsum("epab,bepn->epan", inverse, derivatives)
    return gradient, determinant


def _jacobian(derivatives: Array, points: np.ndarray) -> _Jacobian:
    """Compute the Jacobian of the map from the reference element to the film.

    Args:
        derivatives: Derivatives of the basis with respect to (xi, eta); see `_film_gradient`.
        points: Film points x + iy of the nodes of every element, shape (n_element, n_local), in film radii.

    Returns:
        Derivatives of x and y with respect to xi and eta, and their determinant.
    """
    # Sum over the nodes n, for each local derivative k (xi or eta), element e and point p. The result is complex, like
    # the points.
    tangent = np.einsum("kepn,en->kep", derivatives, points)
    x_xi, x_eta = tangent.real
    y_xi, y_eta = tangent.imag
    determinant = x_xi * y_eta - x_eta * y_xi
    return _Jacobian(x_xi, x_eta, y_xi, y_eta, determinant)
