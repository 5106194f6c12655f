"""Lagrange polynomials on Gauss-Lobatto nodes: values and derivatives anywhere on the reference interval [-1, 1].

Everything goes through the barycentric form, which is stable at any order (Berrut and Trefethen 2004).
"""

from functools import lru_cache

import numpy as np
from scipy.special import eval_legendre, roots_jacobi

from isocharge.common.arrays import Array


@lru_cache(maxsize=32)
def lobatto_nodes(order: int) -> Array:
    """Gauss-Lobatto-Legendre nodes, shape (order + 1,), ascending from -1 to 1: the extrema of P_order and the ends."""
    interior = roots_jacobi(order - 1, 1.0, 1.0)[0] if order > 1 else np.empty(0)
    nodes = np.concatenate([[-1.0], interior, [1.0]])
    nodes.flags.writeable = False
    return nodes


@lru_cache(maxsize=32)
def lobatto_weights(order: int) -> Array:
    """Barycentric weights of `lobatto_nodes`, shape (order + 1,): proportional to 1 / P_order(x_j).

    Wang, Huybrechs and Vandewalle (2014): the square root of the quadrature weight, with alternating sign.
    """
    nodes = lobatto_nodes(order)
    weights: Array = 1.0 / eval_legendre(order, nodes)
    weights /= np.abs(weights).max()
    weights.flags.writeable = False
    return weights


@lru_cache(maxsize=32)
def lobatto_quadrature(order: int) -> Array:
    """Weights of the Gauss-Lobatto rule on `lobatto_nodes`, shape (order + 1,): exact up to degree 2 order - 1."""
    weights: Array = np.asarray(2.0 / (order * (order + 1) * eval_legendre(order, lobatto_nodes(order)) ** 2))
    weights.flags.writeable = False
    return weights


@lru_cache(maxsize=32)
def modal_matrix(order: int) -> Array:
    """Matrix from values on `lobatto_nodes` to Legendre coefficients, shape (order + 1, order + 1)."""
    matrix: Array = np.linalg.inv(np.polynomial.legendre.legvander(lobatto_nodes(order), order)).astype(np.float64)
    matrix.flags.writeable = False
    return matrix


def chebyshev_nodes(count: int, low: float, high: float) -> Array:
    """Chebyshev nodes of the first kind on [low, high], ascending, shape (count,)."""
    angle = (2.0 * np.arange(count, 0, -1) - 1.0) * np.pi / (2.0 * count)
    nodes: Array = 0.5 * (low + high) + 0.5 * (high - low) * np.cos(angle)
    return nodes


def barycentric_weights(nodes: Array) -> Array:
    """Barycentric weights of any distinct nodes, shape (n,), scaled by the interval so that they do not overflow."""
    scale = 4.0 / np.ptp(nodes) if nodes.size > 1 else 1.0
    difference = (nodes[:, None] - nodes[None, :]) * scale
    np.fill_diagonal(difference, 1.0)
    weights: Array = 1.0 / difference.prod(axis=1)
    return weights


def lagrange_values(nodes: Array, weights: Array, at: Array) -> Array:
    """Values of the Lagrange polynomials.

    Args:
        nodes: Interpolation nodes, shape (n,).
        weights: Their barycentric weights, shape (n,).
        at: Where to evaluate, shape (m,).

    Returns:
        Shape (m, n); each row adds up to one.
    """
    difference = at[:, None] - nodes[None, :]
    hit = np.abs(difference) < 1e-200  # closer, the quotient below would overflow
    terms = weights / np.where(hit, 1.0, difference)
    values: Array = terms / terms.sum(axis=1, keepdims=True)
    on_node = hit.any(axis=1)
    values[on_node] = hit[on_node]
    return values


@lru_cache(maxsize=32)
def derivative_matrix(order: int) -> Array:
    """Matrix D of shape (order + 1, order + 1): (D f)_i is the derivative at node i of the interpolant of f."""
    nodes, weights = lobatto_nodes(order), lobatto_weights(order)
    difference = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(difference, 1.0)
    matrix = weights[None, :] / weights[:, None] / difference
    np.fill_diagonal(matrix, 0.0)
    np.fill_diagonal(matrix, -matrix.sum(axis=1))
    matrix.flags.writeable = False
    return matrix


def basis(order: int, at: Array) -> tuple[Array, Array]:
    """Values and derivatives, each of shape (m, order + 1), of the Lobatto basis at points `at` of shape (m,)."""
    values = lagrange_values(lobatto_nodes(order), lobatto_weights(order), at)
    return values, values @ derivative_matrix(order)


def tensor_values(order: int, xi: Array, eta: Array) -> Array:
    """Basis on the square [-1, 1]^2, nodes in tensor order (xi fast), at points of shape (n,): (n, (order + 1)^2)."""
    nodes, weights = lobatto_nodes(order), lobatto_weights(order)
    return _product(lagrange_values(nodes, weights, xi), lagrange_values(nodes, weights, eta))


def tensor_basis(order: int, xi: Array, eta: Array) -> tuple[Array, Array]:
    """Values as `tensor_values` and derivatives by xi and eta, shape (2, n, (order + 1)^2)."""
    in_xi, d_xi = basis(order, xi)
    in_eta, d_eta = basis(order, eta)
    return _product(in_xi, in_eta), np.stack([_product(d_xi, in_eta), _product(in_xi, d_eta)])


def _product(a: Array, b: Array) -> Array:
    return (b[:, :, None] * a[:, None, :]).reshape(len(a), b.shape[1] * a.shape[1])
