"""Energy, residual and tangent of the geometrically nonlinear membrane, dimensionless.

Lengths are in units of the film's radius a. With an amplitude A (deflection over radius, see `Groups`)

    w = a A W,   u = a A^2 U,   E = A^2 [ sym grad U + grad W (x) grad W / 2 + A^2 (grad U)^T grad U / 2 ],

the Green-Lagrange strain is A^2 times a number of order one whatever the force, and so is the stress: St. Venant-
Kirchhoff, plane stress, S = E_young A^2 (C : E' + tau I). The energy in units of E_young h a^2 A^4 is

    Pi = integral( E' : C : E' / 2 + tau tr E' ) - load * mean of W over the footprint.

A flat film without pretension thus looks the same at every force but for A^2, which is small: this is why neighbouring
forces start so well from each other. (Strain and stress: Bonet and Wood 2008, ch. 3 and 6; scaling: Schwerin 1929.)

Field values are (U1, U2, W) per node, shape (n_node, 3). F_ia = d_ia + A^2 U_i,a for i = 1, 2 and W,a for i = 3, so
that the variation of E' is sym(F_ia v_i,b) for all three components alike.
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.simulate.arrays import Array, Integers
from isocharge.simulate.template import Placement, Template

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Pairs of displacement components whose tangent blocks are different."""


@dataclass(frozen=True)
class Groups:
    """The dimensionless groups that fix the problem.

    Attributes:
        amplitude2: A^2, the square of the amplitude that scales deflection by film radius.
        load: Force over E_young h a A^3.
        tension: Pretension over E_young A^2.
        poisson: Poisson's ratio.
    """

    amplitude2: float
    load: float
    tension: float
    poisson: float

    def stiffened(self, tension: float) -> "Groups":
        """The same scene with more tension."""
        return replace(self, tension=self.tension + tension)


@dataclass(frozen=True)
class Geometry:
    """The elements of a template where it lies on the film, ready for integration.

    Attributes:
        nodes: Node numbers, shape (n_element, n_local).
        gradient: d(basis)/d(X1, X2) at the quadrature points, shape (n_element, n_point, 2, n_local).
        weights: Integration weights, shape (n_element, n_point); they add up to the film's area.
        load: Share of the load on each node's W, shape (n_node,); adds up to one.
    """

    nodes: Integers
    gradient: Array
    weights: Array
    load: Array

    @classmethod
    def build(cls, template: Template, placement: Placement) -> "Geometry":
        """Carry the template onto the film; a footprint's load is spread uniformly over its elements."""
        points = placement.to_film(template.element_points(placement.rho))
        values, by_local, weights = _quadrature(template)
        gradient, jacobian = film_gradient(by_local[:, None], points)
        area = jacobian * weights
        inner = template.footprint
        share = area[inner] @ values
        load = np.bincount(template.nodes[inner].ravel(), share.ravel(), template.n_node)
        return cls(template.nodes, gradient, area, load / area[inner].sum())


def _quadrature(template: Template) -> tuple[Array, Array, Array]:
    """Gauss points: basis (n_point, n_local), local derivatives (2, n_point, n_local), weights (n_point,)."""
    line, weight = np.polynomial.legendre.leggauss(template.resolution.order + 1)
    xi, eta = np.meshgrid(line, line)
    values, by_local = template.basis_at(xi.ravel(), eta.ravel())
    return values, by_local, np.outer(weight, weight).ravel()


def film_gradient(by_local: Array, points: np.ndarray) -> tuple[Array, Array]:
    """Gradients of the basis on the film.

    Args:
        by_local: d(basis)/d(xi, eta), shape (2, n_element or 1, n_point, n_local).
        points: Film positions of the nodes as complex numbers, shape (n_element, n_local).

    Returns:
        d(basis)/d(X1, X2), shape (n_element, n_point, 2, n_local), and the Jacobian determinant (n_element, n_point).
    """
    tangent = np.einsum("kepn,en->kep", by_local, points)
    (x_xi, x_eta), (y_xi, y_eta) = tangent.real, tangent.imag
    determinant = x_xi * y_eta - x_eta * y_xi
    inverse = np.stack([y_eta, -y_xi, -x_eta, x_xi], axis=-1) / determinant[..., None]
    inverse = inverse.reshape(*determinant.shape, 2, 2)
    return np.einsum("epab,bepn->epan", inverse, by_local), determinant


def strain(slope: Array, amplitude2: float) -> Array:
    """Scaled Green-Lagrange strain E' from grad (U1, U2, W).

    Args:
        slope: d(U1, U2, W)/d(X1, X2), shape (..., 2, 3): derivative first, component second.
        amplitude2: A^2.

    Returns:
        (E11, E22, 2 E12), shape (..., 3).
    """
    first, second = slope[..., 0, :], slope[..., 1, :]
    scale = np.array([amplitude2, amplitude2, 1.0])
    return np.stack(
        [
            first[..., 0] + 0.5 * (first**2) @ scale,
            second[..., 1] + 0.5 * (second**2) @ scale,
            second[..., 0] + first[..., 1] + (first * second) @ scale,
        ],
        axis=-1,
    )


def stress(strain: Array, poisson: float) -> Array:
    """C : E' in units of E_young A^2, plane stress; (S11, S22, S12), shape (..., 3), without pretension."""
    e11, e22, shear = strain[..., 0], strain[..., 1], strain[..., 2]
    plane = 1.0 / (1.0 - poisson**2)
    return np.stack(
        [plane * (e11 + poisson * e22), plane * (e22 + poisson * e11), 0.5 * shear / (1.0 + poisson)], axis=-1
    )


class Membrane:
    """The discrete membrane: functions of the nodal field for one geometry and one set of groups."""

    def __init__(self, geometry: Geometry, groups: Groups) -> None:
        self.geometry = geometry
        self.groups = groups

    def _slope(self, field: Array) -> Array:
        """d(U1, U2, W)/d(X1, X2) at the quadrature points, shape (n_element, n_point, 2, 3)."""
        gradient = self.geometry.gradient
        flat = gradient.reshape(gradient.shape[0], -1, gradient.shape[-1])
        return (flat @ field[self.geometry.nodes]).reshape(*gradient.shape[:3], 3)

    def _stretch_and_stress(self, field: Array) -> tuple[Array, Array]:
        """F with index (point, derivative, component) and the full stress (S11, S22, S12)."""
        slope = self._slope(field)
        total = stress(strain(slope, self.groups.amplitude2), self.groups.poisson)
        total[..., :2] += self.groups.tension
        stretch = slope * np.array([self.groups.amplitude2, self.groups.amplitude2, 1.0])
        stretch[..., 0, 0] += 1.0
        stretch[..., 1, 1] += 1.0
        return stretch, total

    def energy(self, field: Array) -> float:
        """Potential energy of a nodal field of shape (n_node, 3)."""
        elastic = strain(self._slope(field), self.groups.amplitude2)
        density = 0.5 * np.sum(elastic * stress(elastic, self.groups.poisson), axis=-1)
        density += self.groups.tension * (elastic[..., 0] + elastic[..., 1])
        return float(np.sum(density * self.geometry.weights) - self.groups.load * (self.geometry.load @ field[:, 2]))

    def residual(self, field: Array) -> Array:
        """Gradient of the energy: internal minus external force on every node, shape (n_node, 3)."""
        internal = self._internal(*self._stretch_and_stress(field))
        internal[:, 2] -= self.groups.load * self.geometry.load
        return internal

    def _internal(self, stretch: Array, total: Array) -> Array:
        geometry = self.geometry
        tensor = total[..., [0, 2, 2, 1]].reshape(*total.shape[:2], 2, 2) * geometry.weights[..., None, None]
        traction = tensor @ stretch
        flat = geometry.gradient.reshape(geometry.gradient.shape[0], -1, geometry.gradient.shape[-1])
        nodal = flat.transpose(0, 2, 1) @ traction.reshape(traction.shape[0], -1, 3)
        n_node, index = geometry.load.size, geometry.nodes.ravel()
        columns = [np.bincount(index, nodal[..., i].ravel(), n_node) for i in range(3)]
        return np.stack(columns, axis=1)

    def tangent(self, field: Array) -> Array:
        """Second derivative of the energy, element by element.

        Returns:
            Shape (n_element, n_local, 3, n_local, 3): symmetric under exchange of the two (node, component) pairs.
        """
        geometry, gradient = self.geometry, self.geometry.gradient
        stretch, total = self._stretch_and_stress(field)
        total = total * geometry.weights[..., None]
        n_element, _, _, n_local = gradient.shape
        left = np.ascontiguousarray(gradient.reshape(n_element, -1, n_local).transpose(0, 2, 1))
        matrix = np.empty((n_element, n_local, 3, n_local, 3))
        for i, j in PAIRS:
            block = self._moduli(stretch, i, j) * geometry.weights[..., None, None]
            if i == j:
                scale = 1.0 if i == 2 else self.groups.amplitude2
                block += scale * total[..., [0, 2, 2, 1]].reshape(block.shape)
            right = block[..., 0, None] * gradient[:, :, None, 0] + block[..., 1, None] * gradient[:, :, None, 1]
            matrix[:, :, i, :, j] = left @ right.reshape(n_element, -1, n_local)
            if i != j:
                matrix[:, :, j, :, i] = matrix[:, :, i, :, j].transpose(0, 2, 1)
        return matrix

    def _moduli(self, stretch: Array, i: int, j: int) -> Array:
        """Material part of d(traction_ia)/d(slope_jb) for one pair of components, shape (n_element, n_point, 2, 2)."""
        poisson = self.groups.poisson
        plane, shear = 1.0 / (1.0 - poisson**2), 0.5 / (1.0 + poisson)
        a, b = stretch[..., 0, i], stretch[..., 1, i]
        c, d = stretch[..., 0, j], stretch[..., 1, j]
        block = np.empty((*a.shape, 2, 2))
        block[..., 0, 0] = plane * a * c + shear * b * d
        block[..., 1, 1] = plane * b * d + shear * a * c
        block[..., 0, 1] = plane * poisson * a * d + shear * b * c
        block[..., 1, 0] = plane * poisson * b * c + shear * a * d
        return block
