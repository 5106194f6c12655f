"""Lagrange interpolation on Gauss-Lobatto and Chebyshev nodes, cubic interpolation on uniform grids, and Gauss rules.

The Lagrange polynomials are evaluated in barycentric form, which is stable at any order (Berrut and Trefethen 2004).
"""

from functools import lru_cache

import numpy as np
from scipy.special import eval_legendre, roots_jacobi

from isocharge.common.arrays import Array, Integers

MIN_DIFFERENCE = 1e-200
"""Distance below which a point is treated as equal to a node, because the barycentric formula would overflow."""


@lru_cache(maxsize=32)
def lobatto_nodes(order: int) -> Array:
    """Return the Gauss-Lobatto-Legendre nodes: the extrema of the Legendre polynomial P_order, and -1 and 1.

    Args:
        order: Order of the polynomials that the nodes determine.

    Returns:
        Nodes in ascending order, shape (order + 1,).
    """
    interior = roots_jacobi(order - 1, 1.0, 1.0)[0] if order > 1 else np.empty(0)
    return _read_only(np.concatenate([[-1.0], interior, [1.0]]))


@lru_cache(maxsize=32)
def lobatto_weights(order: int) -> Array:
    """Return the barycentric weights of `lobatto_nodes`, shape (order + 1,).

    The weight of the node x_j is proportional to 1 / P_order(x_j) with the Legendre polynomial P_order. The magnitudes
    of the weights are proportional to the square roots of the quadrature weights, and their signs alternate (Wang,
    Huybrechs and Vandewalle 2014).
    """
    weights: Array = 1.0 / eval_legendre(order, lobatto_nodes(order))
    return _read_only(weights / np.abs(weights).max())


@lru_cache(maxsize=32)
def lobatto_quadrature(order: int) -> Array:
    """Return the weights of the Gauss-Lobatto rule on `lobatto_nodes`, shape (order + 1,).

    The rule integrates polynomials up to the degree 2 order - 1 exactly.
    """
    return _read_only(np.asarray(2.0 / (order * (order + 1) * eval_legendre(order, lobatto_nodes(order)) ** 2)))


@lru_cache(maxsize=32)
def modal_matrix(order: int) -> Array:
    """Return the matrix that maps values on `lobatto_nodes` to Legendre coefficients, shape (order + 1, order + 1)."""
    return _read_only(np.linalg.inv(np.polynomial.legendre.legvander(lobatto_nodes(order), order)).astype(np.float64))


def _read_only(values: Array) -> Array:
    """Mark an array as read-only, because it is cached and returned to several callers."""
    values.flags.writeable = False
    return values


def chebyshev_nodes(count: int, low: float, high: float) -> Array:
    """Return the Chebyshev nodes of the first kind on the interval [low, high].

    Args:
        count: Number of nodes.
        low: Lower end of the interval.
        high: Upper end of the interval.

    Returns:
        Nodes, ascending, shape (count,). The ends of the interval are not among the nodes.
    """
    descending = np.arange(count, 0, -1)  # the cosine decreases with the angle, so the nodes are ascending
    angle = (2.0 * descending - 1.0) * np.pi / (2.0 * count)
    middle = 0.5 * (low + high)
    half_width = 0.5 * (high - low)
    return np.asarray(middle + half_width * np.cos(angle))


def barycentric_weights(nodes: Array) -> Array:
    """Compute the barycentric weights of distinct nodes.

    The weight of a node is the reciprocal of the product of its differences from all other nodes. The differences are
    scaled to an interval of the length 4, on which the products neither overflow nor underflow for many nodes.

    Args:
        nodes: Interpolation nodes, shape (n,).

    Returns:
        Weights, shape (n,). A common factor of all weights has no effect on the interpolation.
    """
    scale = 4.0 / np.ptp(nodes) if nodes.size > 1 else 1.0
    difference = (nodes[:, None] - nodes[None, :]) * scale
    np.fill_diagonal(difference, 1.0)  # the difference of a node from itself does not count
    return np.asarray(1.0 / difference.prod(axis=1))


def lagrange_values(nodes: Array, weights: Array, points: Array) -> Array:
    """Evaluate the Lagrange polynomials of given nodes by the barycentric formula (Berrut and Trefethen 2004).

    Args:
        nodes: Interpolation nodes, shape (n,).
        weights: Barycentric weights of the nodes, shape (n,).
        points: Points of evaluation, shape (m,).

    Returns:
        Value of each polynomial at each point, shape (m, n). Each row adds up to one.
    """
    difference = points[:, None] - nodes[None, :]  # shape (m, n)
    point_on_node, node_index = np.nonzero(np.abs(difference) < MIN_DIFFERENCE)
    difference[point_on_node, node_index] = 1.0  # avoids a division by zero; these rows are replaced below

    weighted_inverse = weights / difference
    row_sum = weighted_inverse @ np.ones(nodes.size)
    values: Array = weighted_inverse / row_sum[:, None]
    values[point_on_node] = nodes == nodes[node_index, None]  # 1 for the node itself, 0 for all others
    return values


@lru_cache(maxsize=32)
def derivative_matrix(order: int) -> Array:
    """Return the matrix that converts the values of a polynomial at the nodes into its derivatives at the nodes.

    Args:
        order: Order of the polynomials.

    Returns:
        Matrix for `lobatto_nodes`, shape (order + 1, order + 1).
    """
    nodes = lobatto_nodes(order)
    weights = lobatto_weights(order)
    difference = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(difference, 1.0)  # avoids a division by zero; the diagonal is replaced below

    # The derivative of a constant is zero, so each row adds up to zero (Berrut and Trefethen 2004).
    matrix = weights[None, :] / weights[:, None] / difference
    np.fill_diagonal(matrix, 0.0)
    np.fill_diagonal(matrix, -matrix.sum(axis=1))
    return _read_only(matrix)


def basis(order: int, points: Array) -> tuple[Array, Array]:
    """Evaluate the Lagrange basis on `lobatto_nodes`, and its derivatives.

    Args:
        order: Order of the polynomials.
        points: Points of evaluation in [-1, 1], shape (m,).

    Returns:
        Values and derivatives, each of shape (m, order + 1).
    """
    values = lagrange_values(lobatto_nodes(order), lobatto_weights(order), points)
    return values, values @ derivative_matrix(order)


def tensor_values(order: int, xi: Array, eta: Array) -> Array:
    """Evaluate the tensor-product basis on the square [-1, 1]^2.

    Args:
        order: Order of the polynomials in each direction.
        xi: First coordinate of the points, shape (n,).
        eta: Second coordinate of the points, shape (n,).

    Returns:
        Values, shape (n, (order + 1)^2). The nodes are numbered in tensor order, in which xi varies fastest.
    """
    nodes = lobatto_nodes(order)
    weights = lobatto_weights(order)
    return _tensor_product(lagrange_values(nodes, weights, xi), lagrange_values(nodes, weights, eta))


def tensor_basis(order: int, xi: Array, eta: Array) -> tuple[Array, Array]:
    """Evaluate the tensor-product basis and its derivatives at points of the reference element.

    Args:
        order: Order of the elements.
        xi: First local coordinate of the points, shape (n,).
        eta: Second local coordinate of the points, shape (n,).

    Returns:
        Values, shape (n, (order + 1)^2). Derivatives with respect to xi and eta, shape (2, n, (order + 1)^2).
    """
    xi_values, xi_slopes = basis(order, xi)
    eta_values, eta_slopes = basis(order, eta)
    values = _tensor_product(xi_values, eta_values)
    xi_derivative = _tensor_product(xi_slopes, eta_values)
    eta_derivative = _tensor_product(xi_values, eta_slopes)
    return values, np.stack([xi_derivative, eta_derivative])


def _tensor_product(xi_values: Array, eta_values: Array) -> Array:
    """Multiply every basis value in xi by every basis value in eta.

    Args:
        xi_values: Values of the basis functions in xi at n points, shape (n, p).
        eta_values: Values of the basis functions in eta at the same points, shape (n, q).

    Returns:
        Products, shape (n, q * p). The function in xi changes fastest.
    """
    products = eta_values[:, :, None] * xi_values[:, None, :]
    return products.reshape(len(xi_values), eta_values.shape[1] * xi_values.shape[1])


def cubic_weights(points: Array, count: int, periodic: bool = False) -> tuple[Integers, Array]:
    """Compute the weights of cubic interpolation between the four nearest nodes of a uniform grid.

    The weights are the Lagrange polynomials of four neighbouring nodes.

    Args:
        points: Points of evaluation in units of the spacing, any shape. The nodes are 0, 1, ..., count - 1, and points
            beyond the last node are extrapolated.
        count: Number of nodes, at least four.
        periodic: Whether the grid is periodic, so that node `count` is the same as node 0.

    Returns:
        Indices of the four nodes, and their weights, each of shape (..., 4).
    """
    # The point lies between the second and the third of the four nodes, except near the ends of the grid.
    first_node = np.floor(points).astype(np.intp) - 1
    if not periodic:
        first_node = np.clip(first_node, 0, count - 4)

    # Signed distances of the point from the four nodes. The weight of a node is the product of the distances from the
    # other three nodes, divided by its value at the node itself.
    from_0 = (points - first_node)[..., None]
    from_1 = from_0 - 1.0
    from_2 = from_0 - 2.0
    from_3 = from_0 - 3.0
    weight_0 = -from_1 * from_2 * from_3 / 6.0
    weight_1 = from_0 * from_2 * from_3 / 2.0
    weight_2 = -from_0 * from_1 * from_3 / 2.0
    weight_3 = from_0 * from_1 * from_2 / 6.0
    weights = np.concatenate([weight_0, weight_1, weight_2, weight_3], axis=-1)

    nodes = first_node[..., None] + np.arange(4)
    if periodic:
        nodes = nodes % count
    return nodes, weights


def gauss_line(count: int) -> tuple[Array, Array]:
    """Return the Gauss rule on [0, 1].

    Args:
        count: Number of points.

    Returns:
        Points, and weights, which add up to one, each of shape (count,).
    """
    points, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (points + 1.0), 0.5 * weights


@lru_cache(maxsize=32)
def gauss_reference_square(count: int) -> tuple[Array, Array, Array]:
    """Return the Gauss rule on the square [-1, 1]^2.

    Args:
        count: Number of points in each direction.

    Returns:
        Coordinates xi and eta of the points, and the weights of the points, each of shape (count^2,). The coordinate xi
        varies fastest. The weights add up to 4.
    """
    line, weight = np.polynomial.legendre.leggauss(count)
    xi, eta = np.meshgrid(line, line)
    return _read_only(xi.ravel()), _read_only(eta.ravel()), _read_only(np.outer(weight, weight).ravel())


@lru_cache(maxsize=32)
def gauss_square(count: int) -> tuple[Array, Array]:
    """Return the Gauss rule on the square [0, 1]^2.

    Args:
        count: Number of points in each direction.

    Returns:
        Points, shape (count^2, 2), and weights, shape (count^2,), which add up to one.
    """
    xi, eta, weights = gauss_reference_square(count)
    points = 0.5 * (np.stack([xi, eta], axis=1) + 1.0)
    return _read_only(points), _read_only(0.25 * weights)
