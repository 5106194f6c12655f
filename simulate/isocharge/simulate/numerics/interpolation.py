"""Lagrange polynomials on Gauss-Lobatto and Chebyshev nodes, local cubics on even grids, and Gauss rules.

The polynomials go through the barycentric form, which is stable at any order (Berrut and Trefethen 2004).
"""

from functools import lru_cache

import numpy as np
from scipy.special import eval_legendre, roots_jacobi

from isocharge.common.arrays import Array, Integers


@lru_cache(maxsize=32)
def lobatto_nodes(order: int) -> Array:
    """Gauss-Lobatto-Legendre nodes, shape (order + 1,), ascending from -1 to 1: the extrema of P_order and the ends."""
    interior = roots_jacobi(order - 1, 1.0, 1.0)[0] if order > 1 else np.empty(0)
    return _frozen(np.concatenate([[-1.0], interior, [1.0]]))


@lru_cache(maxsize=32)
def lobatto_weights(order: int) -> Array:
    """Barycentric weights of `lobatto_nodes`, shape (order + 1,): proportional to 1 / P_order(x_j).

    Wang, Huybrechs and Vandewalle (2014): the square root of the quadrature weight, with alternating sign.
    """
    weights: Array = 1.0 / eval_legendre(order, lobatto_nodes(order))
    return _frozen(weights / np.abs(weights).max())


@lru_cache(maxsize=32)
def lobatto_quadrature(order: int) -> Array:
    """Weights of the Gauss-Lobatto rule on `lobatto_nodes`, shape (order + 1,): exact up to degree 2 order - 1."""
    return _frozen(np.asarray(2.0 / (order * (order + 1) * eval_legendre(order, lobatto_nodes(order)) ** 2)))


@lru_cache(maxsize=32)
def modal_matrix(order: int) -> Array:
    """Matrix from values on `lobatto_nodes` to Legendre coefficients, shape (order + 1, order + 1)."""
    return _frozen(np.linalg.inv(np.polynomial.legendre.legvander(lobatto_nodes(order), order)).astype(np.float64))


def _frozen(values: Array) -> Array:
    """The same array, which cannot be written to: it is cached."""
    values.flags.writeable = False
    return values


def chebyshev_nodes(count: int, low: float, high: float) -> Array:
    """Chebyshev nodes of the first kind on [low, high], ascending, shape (count,)."""
    angle = (2.0 * np.arange(count, 0, -1) - 1.0) * np.pi / (2.0 * count)
    return np.asarray(0.5 * (low + high) + 0.5 * (high - low) * np.cos(angle))


def barycentric_weights(nodes: Array) -> Array:
    """Barycentric weights of any distinct nodes, shape (n,), scaled by the interval so that they do not overflow."""
    scale = 4.0 / np.ptp(nodes) if nodes.size > 1 else 1.0
    difference = (nodes[:, None] - nodes[None, :]) * scale
    np.fill_diagonal(difference, 1.0)
    return np.asarray(1.0 / difference.prod(axis=1))


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
    row, node = np.nonzero(np.abs(difference) < 1e-200)  # closer, the quotient below would overflow
    difference[row, node] = 1.0
    terms = weights / difference
    values: Array = terms / (terms @ np.ones(nodes.size))[:, None]
    values[row] = nodes == nodes[node, None]
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
    return _frozen(matrix)


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


def cubic_weights(at: Array, count: int, periodic: bool = False) -> tuple[Integers, Array]:
    """Weights of the four neighbours of places between the nodes 0, 1, ..., count - 1.

    Args:
        at: Places in steps of the grid, any shape; beyond an end they are extrapolated.
        count: Number of nodes, at least four.
        periodic: Whether node `count` is node 0 again.

    Returns:
        Numbers of the neighbours and their weights, each of shape (..., 4).
    """
    first = np.floor(at).astype(np.intp) - 1
    if not periodic:
        first = np.clip(first, 0, count - 4)
    t = (at - first)[..., None]
    a, b, c, d = t, t - 1.0, t - 2.0, t - 3.0
    weights = np.concatenate([-b * c * d / 6.0, a * c * d / 2.0, -a * b * d / 2.0, a * b * c / 6.0], axis=-1)
    number = first[..., None] + np.arange(4)
    return number % count if periodic else number, weights


def gauss_line(count: int) -> tuple[Array, Array]:
    """Gauss points on [0, 1] and shares, which add up to one; each of shape (count,)."""
    at, weight = np.polynomial.legendre.leggauss(count)
    return 0.5 * (at + 1.0), 0.5 * weight


@lru_cache(maxsize=32)
def gauss_reference_square(count: int) -> tuple[Array, Array, Array]:
    """Gauss points (xi, eta) on [-1, 1]^2, xi fast, and their weights, which add up to 4; each of shape (count^2,)."""
    line, weight = np.polynomial.legendre.leggauss(count)
    xi, eta = np.meshgrid(line, line)
    return _frozen(xi.ravel()), _frozen(eta.ravel()), _frozen(np.outer(weight, weight).ravel())


@lru_cache(maxsize=32)
def gauss_square(count: int) -> tuple[Array, Array]:
    """Gauss points on [0, 1]^2, shape (count^2, 2), and shares, which add up to one."""
    xi, eta, weights = gauss_reference_square(count)
    return _frozen(0.5 * (np.stack([xi, eta], axis=1) + 1.0)), _frozen(0.25 * weights)
