"""Elements where they lie on the film, ready for integration."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.numerics.interpolation import lobatto_nodes, lobatto_quadrature, tensor_basis
from isocharge.simulate.numerics.quadrature import gauss_reference_square


@dataclass(frozen=True)
class Geometry:
    """The elements of a template where it lies on the film, ready for integration.

    Attributes:
        nodes: Node numbers, shape (n_element, n_local).
        gradient: d(basis)/d(X1, X2) at the quadrature points, shape (n_element, n_point, 2, n_local).
        weights: Integration weights, shape (n_element, n_point); they add up to the meshed area.
        load: Share of the load on each node's W, shape (n_node,); adds up to one over the number of copies.
        mass: Lumped share of the area of each element's nodes, shape (n_element, n_local).
    """

    nodes: Integers
    gradient: Array
    weights: Array
    load: Array
    mass: Array

    @classmethod
    def build(cls, template: Template, points: Complexes) -> "Geometry":
        """Integrate over elements whose nodes lie at film points; a footprint's load is spread uniformly over it."""
        values, by_local, weights, at_nodes, node_weights = _quadrature(template.resolution.order)
        gradient, jacobian = film_gradient(by_local[:, None], points)
        area = jacobian * weights
        inner = template.footprint
        share = area[inner] @ values
        load = np.bincount(template.nodes[inner].ravel(), share.ravel(), template.n_node)
        mass = jacobian_at(at_nodes[:, None], points) * node_weights
        return cls(template.nodes, gradient, area, load / (template.copies * area[inner].sum()), mass)

    def gather(self, local: Array) -> Array:
        """Add up element contributions of shape (n_element, n_local) at the nodes, shape (n_node,)."""
        gathered: Array = np.bincount(self.nodes.ravel(), local.ravel(), self.load.size).astype(np.float64)
        return gathered


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


def film_gradient(by_local: Array, points: np.ndarray) -> tuple[Array, Array]:
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


def jacobian_at(by_local: Array, points: np.ndarray) -> Array:
    """Jacobian determinant alone; see `film_gradient`."""
    return _jacobian(by_local, points)[-1]


def _jacobian(by_local: Array, points: np.ndarray) -> tuple[Array, Array, Array, Array, Array]:
    tangent = np.einsum("kepn,en->kep", by_local, points)
    (x_xi, x_eta), (y_xi, y_eta) = tangent.real, tangent.imag
    return x_xi, x_eta, y_xi, y_eta, x_xi * y_eta - x_eta * y_xi
