"""Polynomial interpolation on Gauss-Lobatto nodes and Chebyshev nodes, and Gauss quadrature rules."""

from functools import lru_cache

import numpy as np
from numpy.polynomial.legendre import legder, leggauss, legvander
from scipy.special import eval_legendre, roots_jacobi

from isocharge.common.arrays import Array


@lru_cache(maxsize=32)
def lobatto_nodes(order: int) -> Array:
    """Return the Gauss-Lobatto-Legendre nodes on the interval [-1, 1].

    The nodes are the two ends of the interval, and the points between the ends at which the Legendre polynomial of the
    given order has an extremum.

    Args:
        order: Order of the Legendre polynomial. Polynomials of this order are determined by their values at the nodes.

    Returns:
        Nodes in ascending order, shape (order + 1,).
    """
    interior = roots_jacobi(order - 1, 1.0, 1.0)[0] if order > 1 else np.empty(0)
    return _read_only(np.concatenate([[-1.0], interior, [1.0]]))


@lru_cache(maxsize=32)
def lobatto_quadrature(order: int) -> Array:
    """Return the quadrature weights of the nodes that `lobatto_nodes` returns, shape (order + 1,).

    The Gauss-Lobatto rule with n + 1 nodes integrates every polynomial of degree 2 n - 1 or less exactly.
    """
    return _read_only(np.asarray(2.0 / (order * (order + 1) * eval_legendre(order, lobatto_nodes(order)) ** 2)))


@lru_cache(maxsize=32)
def modal_matrix(order: int) -> Array:
    """Return the matrix that converts the values of a polynomial at the Gauss-Lobatto nodes into Legendre coefficients.

    The function `lobatto_nodes` returns the nodes. The matrix has the shape (order + 1, order + 1).
    """
    return _read_only(np.linalg.inv(legvander(lobatto_nodes(order), order)).astype(np.float64))


def _read_only(values: Array) -> Array:
    """Mark an array as read-only and return it, because several callers share the cached array."""
    values.flags.writeable = False
    return values


def chebyshev_nodes(count: int, low: float, high: float) -> Array:
    """Return the Chebyshev nodes of the first kind on the interval [low, high].

    The nodes are the cosines of the angles (2 k - 1) pi / (2 count) for k = 1, ..., count, scaled from the interval
    [-1, 1] to the interval [low, high].

    Args:
        count: Number of nodes.
        low: Lower end of the interval.
        high: Upper end of the interval.

    Returns:
        Nodes in ascending order, shape (count,). The nodes do not include the ends of the interval.
    """
    descending_numbers = np.arange(count, 0, -1)  # the cosine decreases with the angle, so the nodes are ascending
    angles = (2.0 * descending_numbers - 1.0) * np.pi / (2.0 * count)
    middle = 0.5 * (low + high)
    half_width = 0.5 * (high - low)
    return np.asarray(middle + half_width * np.cos(angles))


def lagrange_values(nodes: Array, points: Array) -> Array:
    """Evaluate the Lagrange polynomials of given nodes.

    The polynomial of a node is 1 at this node and 0 at all other nodes. It is the product of (x - y) / (node - y) over
    all other nodes y.

    Args:
        nodes: Interpolation nodes, shape (n,).
        points: Points of evaluation, shape (m,).

    Returns:
        Value of each polynomial at each point, shape (m, n). Each row adds up to one.
    """
    values = np.ones((points.size, nodes.size))
    for index, node in enumerate(nodes):
        is_other = np.arange(nodes.size) != index
        factors = (points[:, None] - node) / (nodes[is_other] - node)
        values[:, is_other] *= factors
    return values


def basis(order: int, points: Array) -> tuple[Array, Array]:
    """Evaluate the Lagrange polynomials of the Gauss-Lobatto nodes and the derivatives of these polynomials.

    Args:
        order: Order of the polynomials.
        points: Points of evaluation in [-1, 1], shape (m,).

    Returns:
        Values and derivatives, each of shape (m, order + 1).
    """
    coefficients = modal_matrix(order)  # one column of Legendre coefficients for each polynomial
    legendre_values = legvander(points, order)
    return legendre_values @ coefficients, legendre_values[:, :-1] @ legder(coefficients)


def tensor_values(order: int, xi: Array, eta: Array) -> Array:
    """Evaluate the tensor products of Lagrange polynomials at points of the square [-1, 1]^2.

    Args:
        order: Order of the polynomials in each direction.
        xi: First coordinate of the points, shape (n,).
        eta: Second coordinate of the points, shape (n,).

    Returns:
        Values of the products, shape (n, (order + 1)^2). The polynomial in xi changes fastest from column to column.
    """
    coefficients = modal_matrix(order)
    return _tensor_product(legvander(xi, order) @ coefficients, legvander(eta, order) @ coefficients)


def tensor_basis(order: int, xi: Array, eta: Array) -> tuple[Array, Array]:
    """Evaluate the tensor products of Lagrange polynomials and their derivatives at points of the square [-1, 1]^2.

    Args:
        order: Order of the polynomials in each direction.
        xi: First coordinate of the points, shape (n,).
        eta: Second coordinate of the points, shape (n,).

    Returns:
        Values of the products, shape (n, (order + 1)^2). The polynomial in xi changes fastest from column to column.
        Derivatives of the products with respect to xi and eta, shape (2, n, (order + 1)^2).
    """
    xi_values, xi_slopes = basis(order, xi)
    eta_values, eta_slopes = basis(order, eta)
    values = _tensor_product(xi_values, eta_values)
    xi_derivative = _tensor_product(xi_slopes, eta_values)
    eta_derivative = _tensor_product(xi_values, eta_slopes)
    return values, np.stack([xi_derivative, eta_derivative])


def _tensor_product(xi_values: Array, eta_values: Array) -> Array:
    """Multiply the value of each basis function in xi by the value of each basis function in eta.

    Args:
        xi_values: Values of the basis functions in xi at n points, shape (n, p).
        eta_values: Values of the basis functions in eta at the same points, shape (n, q).

    Returns:
        Products, shape (n, q * p). The function in xi changes fastest from column to column.
    """
    products = eta_values[:, :, None] * xi_values[:, None, :]  # shape (n, q, p)
    return products.reshape(len(xi_values), eta_values.shape[1] * xi_values.shape[1])


@lru_cache(maxsize=32)
def gauss_line(count: int) -> tuple[Array, Array]:
    """Return the points and weights of the Gauss-Legendre rule on the interval [0, 1].

    Args:
        count: Number of points.

    Returns:
        Points and weights, each of shape (count,). The weights add up to one.
    """
    points, weights = leggauss(count)  # on the interval [-1, 1]
    return _read_only(0.5 * (points + 1.0)), _read_only(0.5 * weights)


@lru_cache(maxsize=32)
def gauss_reference_square(count: int) -> tuple[Array, Array, Array]:
    """Return the points and weights of the Gauss-Legendre rule on the square [-1, 1]^2.

    Args:
        count: Number of points in each direction.

    Returns:
        Coordinates xi and eta of the points, and the weights of the points, each of shape (count^2,). The coordinate xi
        varies fastest. The weights add up to 4.
    """
    line_points, line_weights = leggauss(count)
    xi, eta = np.meshgrid(line_points, line_points)
    weights = np.outer(line_weights, line_weights)
    return _read_only(xi.ravel()), _read_only(eta.ravel()), _read_only(weights.ravel())
