"""The mesh of one press: a template, where it lies on the film, and its elements there, ready for integration."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.sparse import csr_array

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.coating import Coating
from isocharge.simulate.mesh.placement import Placement
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

ROUND = 0.5
"""Share of the film's radius within which the mesh of an oval film is that of a round one: probe and electrodes."""

INVERSE_STEPS = 8
"""Steps of Newton, with a slope that is right at the rim, to undo `to_oval`: to round-off up to e = 0.05."""


@dataclass(frozen=True)
class Geometry:
    """The elements of a template where it lies on the film, ready for integration.

    Attributes:
        nodes: Node numbers, shape (n_element, n_local).
        gradient: d(basis)/d(X1, X2) at the quadrature points, shape (n_element, n_point, 2, n_local).
        weights: Integration weights, shape (n_element, n_point); they add up to the meshed area.
        load: Share of the load on each node's W, shape (n_node,); adds up to one over the number of copies.
        mass: Lumped share of the area of each element's nodes, shape (n_element, n_local).
        constraint: As `Template.constraint`.
        coat: Elements that something stiffens, shape (n,), and what it adds there to C over E at the quadrature points,
            shape (n, n_point, 3, 3).
    """

    nodes: Integers
    gradient: Array
    weights: Array
    load: Array
    mass: Array
    constraint: csr_array | None = None
    coat: tuple[Integers, Array] | None = None

    @classmethod
    def build(cls, template: Template, points: Complexes) -> "Geometry":
        """Integrate over elements whose nodes lie at film points; a footprint's load is spread uniformly over it."""
        values, by_local, weights, at_nodes, node_weights = _quadrature(template.resolution.order)
        gradient, jacobian = _film_gradient(by_local[:, None], points)
        area = jacobian * weights
        inner = template.footprint
        share = area[inner] @ values
        load = np.bincount(template.nodes[inner].ravel(), share.ravel(), template.n_node)
        mass = _jacobian(at_nodes[:, None], points)[-1] * node_weights
        load = load / (template.copies * area[inner].sum())
        if template.constraint is not None:
            load = template.constraint.T @ load
        return cls(template.nodes, gradient, area, load, mass, template.constraint)

    @property
    def stacked(self) -> Array:
        """The gradient with points and derivatives along one axis, shape (n_element, n_point * 2, n_local)."""
        return self.gradient.reshape(len(self.gradient), -1, self.gradient.shape[-1])

    def gather(self, local: Array) -> Array:
        """Add up element contributions of shape (n_element, n_local) at the nodes, shape (n_node,).

        Those of a hanging node go to the nodes that it follows.
        """
        total = np.asarray(np.bincount(self.nodes.ravel(), local.ravel(), self.load.size).astype(np.float64))
        return total if self.constraint is None else np.asarray(self.constraint.T @ total)


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """A template where it lies under one press, the press rotated onto the positive x axis.

    Attributes:
        template: The template.
        placement: Where it lies.
        layer: Width of the thin rings at the rim over the film's radius.
        oval: e exp(2 i alpha) of a rim at 1 + e cos 2 (angle - alpha), in film radii.
        coat: What stiffens parts of the film, in film radii, the press rotated onto the x axis.
    """

    template: Template
    placement: Placement
    layer: float
    oval: complex = 0.0
    coat: Coating | None = None

    @property
    def resolution(self) -> Resolution:
        """How fine it is."""
        return self.template.resolution

    @cached_property
    def points(self) -> Complexes:
        """Film points of every element's nodes, shape (n_element, n_local), in film radii."""
        return self.template.from_base(to_oval(self.placement.element_points(self.template), self.oval))

    @property
    def node_points(self) -> Complexes:
        """Film points of the nodes, shape (n_node,), in film radii."""
        return np.asarray(self.points.ravel()[self.template.first_seen])

    @cached_property
    def geometry(self) -> Geometry:
        """The elements, ready for integration."""
        geometry = Geometry.build(self.template, self.points)
        if self.coat is None:
            return geometry
        xi, eta, _ = gauss_reference_square(self.resolution.order + 1)
        points = self.points @ tensor_values(self.resolution.order, xi, eta).T
        stiffened = np.flatnonzero(self.coat.near(points).any(axis=1))
        return replace(geometry, coat=(stiffened, self.coat.moduli(points[stiffened])))

    def locate(self, points: Complexes) -> tuple[Integers, Array, Array, Booleans]:
        """Element, xi and eta of film points, shape (n,), in film radii, the press rotated onto the x axis.

        And which points were mirrored into the half that is meshed.
        """
        position, mirrored = self.template.into_meshed_half(from_oval(points, self.oval))
        element, xi, eta = self.placement.batch().locate(self.template, position[None])
        return *self.template.within(element[0], xi[0], eta[0]), mirrored

    def gradient(self, element: Integers, xi: Array, eta: Array) -> Array:
        """d(basis)/d(X1, X2) at points of elements, shape (n, 2, n_local)."""
        _, by_local = tensor_basis(self.resolution.order, xi, eta)
        return _film_gradient(by_local[:, :, None, :], self.points[element])[0][:, 0]

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
        return _film_gradient(by_local[:, None], self.points)[0]


def place(film: Film, probe: Probe, at: tuple[float, float], resolution: Resolution, layer: float) -> PlacedMesh:
    """Place the template of a probe under a press; `layer` is the width of the thin rings over the film's radius."""
    template, angle = template_for(probe, resolution, not film.is_axisymmetric), float(np.arctan2(at[1], at[0]))
    placement = Placement.of(template, probe.rotated(-angle), np.array(np.hypot(*at)), film.radius, layer)
    return PlacedMesh(template, placement, layer, film.oval * np.exp(2j * (film.oval_axis - angle)))


def to_oval(points: Complexes, oval: complex) -> Complexes:
    """Points of the round film (unit radius) where they lie on an oval one: the inner half of it stays."""
    if oval == 0.0:
        return points
    radius = np.maximum(np.abs(points), ROUND)
    return np.asarray(points * (1.0 + _swell(radius) * (np.conj(oval) * (points / radius) ** 2).real))


def from_oval(points: Complexes, oval: complex) -> Complexes:
    """The inverse of `to_oval`."""
    if oval == 0.0:
        return points
    radius = start = np.maximum(np.abs(points), ROUND)
    along = (np.conj(oval) * (points / start) ** 2).real
    for _ in range(INVERSE_STEPS):
        radius = radius - (radius * (1.0 + _swell(radius) * along) - start) / (1.0 + 7.0 * along * _swell(radius))
    return np.asarray(points * (radius / start))


def _swell(radius: Array) -> Array:
    """How much of the rim's displacement a radius takes part in: none up to `ROUND`, all at 1."""
    return np.asarray(((radius - ROUND) / (1.0 - ROUND)) ** 3)


@lru_cache(maxsize=16)
def _quadrature(order: int) -> tuple[Array, Array, Array, Array, Array]:
    """Gauss points: basis (n_point, n_local), local derivatives (2, n_point, n_local), weights (n_point,).

    And for the nodes themselves: local derivatives (2, n_local, n_local), Gauss-Lobatto weights (n_local,).
    """
    xi, eta, weights = gauss_reference_square(order + 1)
    nodes, node_weight = lobatto_nodes(order), lobatto_quadrature(order)
    node_xi, node_eta = np.meshgrid(nodes, nodes)
    return (
        *tensor_basis(order, xi, eta),
        weights,
        tensor_basis(order, node_xi.ravel(), node_eta.ravel())[1],
        np.outer(node_weight, node_weight).ravel(),
    )


def _film_gradient(by_local: Array, points: np.ndarray) -> tuple[Array, Array]:
    """Gradients of the basis on the film.

    Args:
        by_local: d(basis)/d(xi, eta), shape (2, n_element or 1, n_point, n_local).
        points: Film positions of the nodes as complex numbers, shape (n_element, n_local).

    Returns:
        d(basis)/d(X1, X2), shape (n_element, n_point, 2, n_local), and the Jacobian determinant (n_element, n_point).
    """
    x_xi, x_eta, y_xi, y_eta, determinant = _jacobian(by_local, points)
    inverse = np.stack([y_eta, -y_xi, -x_eta, x_xi], axis=-1) / determinant[..., None]
    inverse = inverse.reshape(*determinant.shape, 2, 2)
    return np.einsum("epab,bepn->epan", inverse, by_local), determinant


def _jacobian(by_local: Array, points: np.ndarray) -> tuple[Array, Array, Array, Array, Array]:
    tangent = np.einsum("kepn,en->kep", by_local, points)
    (x_xi, x_eta), (y_xi, y_eta) = tangent.real, tangent.imag
    return x_xi, x_eta, y_xi, y_eta, x_xi * y_eta - x_eta * y_xi
