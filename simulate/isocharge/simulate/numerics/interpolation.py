"""Interpolation by polynomials and by a Fourier series of two angles, and Gauss quadrature rules."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial.chebyshev import chebpts1
from numpy.polynomial.legendre import legder, leggauss, legvander
from scipy.special import eval_legendre, roots_jacobi

from isocharge.common.arrays import Array, Integers


@cache
def lobatto_nodes(order: int) -> Array:
    """Return the Gauss-Lobatto-Legendre nodes on the interval [-1, 1].

    The nodes are the two ends of the interval, and the points between the ends at which the Legendre polynomial of the
    given order has an extremum.

    Args:
        order: Order of the Legendre polynomial, at least 2. Polynomials of this order are determined by their values at
            the nodes.

    Returns:
        Nodes in ascending order, shape (order + 1,).
    """
    interior, _ = roots_jacobi(order - 1, 1.0, 1.0)
    return _read_only(np.concatenate([[-1.0], interior, [1.0]]))


def lobatto_quadrature(order: int) -> Array:
    """Return the quadrature weights of the Gauss-Lobatto-Legendre nodes on the interval [-1, 1].

    The rule is exact for every polynomial up to the degree 2 * order - 1.

    Args:
        order: Order of the nodes that `lobatto_nodes` returns.

    Returns:
        Weights, shape (order + 1,). The weights add up to 2, the length of the interval.
    """
    return np.asarray(2.0 / (order * (order + 1) * eval_legendre(order, lobatto_nodes(order)) ** 2))


@cache
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
    return 0.5 * (low + high) + 0.5 * (high - low) * chebpts1(count)


def divide_intervals(ends: Array, count: int) -> Array:
    """Divide each of several adjacent intervals into equal parts.

    Args:
        ends: Ends of the intervals, shape (..., n).
        count: Number of parts of each interval.

    Returns:
        Ends of all parts, shape (..., (n - 1) * count + 1).
    """
    starts_of_parts = np.linspace(ends[..., :-1], ends[..., 1:], count, endpoint=False, axis=-1)
    return np.append(starts_of_parts.reshape(*ends.shape[:-1], -1), ends[..., -1:], axis=-1)


def lagrange_values(nodes: Array, points: Array) -> Array:
    """Evaluate the Lagrange polynomials of given nodes.

    The polynomial of a node z is 1 at this node and 0 at all other nodes. At a point x, the polynomial is the product
    of (x - y) / (z - y) over all other nodes y.

    Args:
        nodes: Interpolation nodes, shape (n,).
        points: Points of evaluation, shape (m,).

    Returns:
        Value of each polynomial at each point, shape (m, n). Each row adds up to one.
    """
    # Each node y contributes the factor (x - y) / (z - y) to the polynomials of all other nodes z.
    values = np.ones((points.size, nodes.size))
    for index, y in enumerate(nodes):
        is_other = np.arange(nodes.size) != index
        factors = (points[:, None] - y) / (nodes[is_other] - y)
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
    legendre_values = legvander(points, order)  # one column for each degree from 0 to `order`
    values = legendre_values @ coefficients
    derivatives = legendre_values[:, :-1] @ legder(coefficients)  # the degree of a derivative is lower by one
    return values, derivatives


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


@cache
def gauss_line(count: int) -> tuple[Array, Array]:
    """Return the points and weights of the Gauss-Legendre rule on the interval [0, 1].

    Args:
        count: Number of points.

    Returns:
        Points and weights, each of shape (count,). The weights add up to one.
    """
    points, weights = leggauss(count)  # on the interval [-1, 1]
    return _read_only(0.5 * (points + 1.0)), _read_only(0.5 * weights)


@cache
def gauss_reference_square(count: int) -> tuple[Array, Array, Array]:
    """Return the points and weights of the Gauss-Legendre rule on the square [-1, 1]^2.

    Args:
        count: Number of points in each direction.

    Returns:
        Coordinates xi and eta of the points, and the weights of the points, each of shape (count^2,). The coordinate xi
        varies fastest. The weights add up to 4.
    """
    return tensor_rule(*leggauss(count))


def tensor_rule(points: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Return the quadrature rule for a square that combines two equal rules for the interval along its sides.

    Args:
        points: Points of the rule for the interval, shape (n,).
        weights: Weights of the points, shape (n,).

    Returns:
        Coordinates xi and eta of the points, and the weights of the points, each of shape (n^2,). The coordinate xi
        varies fastest.
    """
    xi, eta = np.meshgrid(points, points)
    return _read_only(xi.ravel()), _read_only(eta.ravel()), _read_only(np.outer(weights, weights).ravel())


@dataclass(frozen=True)
class Turns:
    """Pairs of a press direction and a probe rotation for which presses are solved.

    On a film that is not axisymmetric, the stress depends on the direction from the centre of the film to the press.
    Under a probe that is not axisymmetric, the stress also depends on the rotation of the probe relative to this
    direction. A turn consists of a direction and a rotation. In a frame that rotates with the probe, the stress at a
    node of the mesh is the Fourier series

        sum c_mk exp(i (2 m d + k r)),

    where r is the rotation, and d is the direction plus the rotation. The film is the same after half a turn about its
    centre, so only the even harmonics of d occur. The coefficients decrease like u^|m| p^|k|, where u is the unevenness
    of the film, and p is the size of the probe divided by its distance from the rim. Both numbers are less than 1.
    Therefore the largest |k| in the series decreases if |m| increases.

    The presses are solved at the points of a lattice of rank one: the rotations r are evenly spaced over a full turn,
    and d increases by the same step from each rotation to the next. The step is chosen such that no two terms of the
    series have the same values at all points. The values at the points then determine all coefficients.

    Attributes:
        direction: Directions from the centre of the film to the presses, plus the rotation of a probe that is not
            axisymmetric, shape (n_turn,), rad. The directions are zero if the film is axisymmetric, or if the probe
            keeps its orientation on the film.
        rotation: Rotations of the probe relative to the direction of the press, evenly spaced over a full turn, shape
            (n_turn,), rad. The rotations are zero if the probe is axisymmetric.
        harmonics: Pairs (2 m, k) of the terms of the Fourier series, shape (n_term, 2).
        symmetry_order: Order of the rotational symmetry of the probe: the number of rotations within a full turn that
            map the probe onto itself. Only the first n_turn / symmetry_order turns are solved. The other turns describe
            the same presses, with the probe rotated by one or more periods of its symmetry.
    """

    direction: Array
    rotation: Array
    harmonics: Integers
    symmetry_order: int

    @classmethod
    def spread(cls, largest_harmonics: tuple[int, ...], period: float, *, has_directions: bool) -> "Turns":
        """Choose the smallest number of turns whose presses determine the coefficients of a Fourier series.

        A turn is a pair of two angles: the rotation r of the probe relative to the direction of a press, and the sum d
        of this direction and the rotation. The attribute `direction` contains the sum d. The term (m, k) of the series
        is proportional to exp(i (2 m d + k r)).

        Args:
            largest_harmonics: Largest |k| of the terms of the series for |m| = 0, 1, 2, and so on. If the direction
                does not vary, only m = 0 is used. For an axisymmetric probe, only k = 0 is used.
            period: Smallest rotation that maps the probe onto itself, rad; 0 if the probe is axisymmetric.
            has_directions: Whether the angle d varies. On an axisymmetric film, d has no effect and does not vary. If
                the probe keeps its orientation on the film, d is always zero.
        """
        # Choose the terms (m, k) of the series. A real function needs the term (-m, -k) for each term (m, k).
        has_rotations = period > 0.0
        largest_m = len(largest_harmonics) - 1 if has_directions else 0
        terms: list[tuple[int, int]] = []
        for m in range(-largest_m, largest_m + 1):
            largest_k = largest_harmonics[abs(m)] if has_rotations else 0
            terms.extend((m, k) for k in range(-largest_k, largest_k + 1))
        term_orders = np.array(terms)  # shape (n_term, 2)

        # Choose the smallest number of turns for which no two terms have the same values at all turns. From each turn
        # to the next, the rotation r increases by 2 pi / n_turn, and the sum d increases by step * pi / n_turn, where
        # `step` is an integer. The angle pi is the period of d, because only even harmonics occur.
        symmetry_order = round(math.tau / period) if has_rotations else 1
        n_turn, step = _smallest_lattice(term_orders, symmetry_order)
        turn = np.arange(n_turn)  # index of each turn
        return cls(
            direction=np.pi * step * turn / n_turn if has_directions else np.zeros(n_turn),
            rotation=math.tau * turn / n_turn if has_rotations else np.zeros(n_turn),
            harmonics=term_orders * np.array([2, 1]),  # (2 m, k)
            symmetry_order=symmetry_order,
        )

    @property
    def solved(self) -> list[tuple[float, float]]:
        """Direction and rotation of each turn at which presses are solved."""
        n_solved = self.rotation.size // self.symmetry_order
        return list(zip(self.direction[:n_solved].tolist(), self.rotation[:n_solved].tolist(), strict=True))

    def weights(self, direction: Array, rotation: Array) -> Array:
        """Compute the weights that interpolate a value from all turns to the angles of given presses.

        A turn is a pair of angles, a direction and a rotation, at which presses are solved. Let a be the angles of a
        press, and b_j the angles of the turn j. A value v depends on the angles like the Fourier series

            v(a) = sum over h of c_h exp(i h.a),

        where h is a pair of integers in `harmonics`. The turns are the points of a lattice on which the terms of the
        series are orthogonal. The coefficient c_h is therefore the mean of v(b_j) exp(-i h.b_j) over all turns. The
        value at the press follows as the sum of w_j v(b_j) with the weights

            w_j = (sum over h of exp(i h.a) exp(-i h.b_j)) / n_turn.

        The sum over h is real, because `harmonics` contains -h for each h.

        Args:
            direction: Directions from the centre of the film to the presses, plus the rotation of a probe that is not
                axisymmetric, shape (n,), rad.
            rotation: Rotations of the probe relative to the line from the centre to the press, shape (n,) or (1,), rad.

        Returns:
            Weights, shape (n, n_turn). The weights of each press sum to 1.
        """
        press_angles = np.stack(np.broadcast_arrays(direction, rotation), axis=1)  # a, shape (n, 2)
        turn_angles = np.stack([self.direction, self.rotation], axis=1)  # b, shape (n_turn, 2)
        press_phase = press_angles @ self.harmonics.T  # h.a, shape (n, n_term)
        turn_phase = turn_angles @ self.harmonics.T  # h.b, shape (n_turn, n_term)

        sum_over_terms = np.exp(1j * press_phase) @ np.exp(-1j * turn_phase).T  # shape (n, n_turn)
        n_turn = self.rotation.size
        return np.asarray(sum_over_terms.real / n_turn)


def _smallest_lattice(term_orders: Integers, symmetry_order: int) -> tuple[int, int]:
    """Find the smallest number of turns at which no two terms of a Fourier series have the same values.

    A turn is a pair of two angles: the rotation r of the probe relative to the direction of the press, and the sum d of
    this direction and the rotation. The n turns form a lattice with the step s. The turn j has the angles

        r = 2 pi j / n   and   d = pi s j / n   for j = 0, 1, ..., n - 1.

    The function returns the smallest n, and a step s, that satisfy two conditions:

    1. The remainders of m s + k modulo n are different for all terms (m, k).
    2. Both n and s - 2 are multiples of the symmetry order q of the probe.

    Reason for the first condition: at the turn j, the term (m, k) has the value

        exp(i (2 m d + k r)) = exp(2 pi i (m s + k) j / n).

    If two terms had the same remainder, they would have the same values at all turns, and their coefficients could not
    be distinguished.

    Reason for the second condition: presses are solved only at the turns within one period 2 pi / q of the probe. The
    turns of each further period must describe the same presses. Each period therefore contains the same number n / q of
    turns. From one period to the next, the direction d - r of the press increases by pi s / q - 2 pi / q, which is
    pi (s - 2) / q. This angle must be a multiple of half a turn (pi), because only half turns do not change the film.

    Args:
        term_orders: Pairs (m, k) of the terms, shape (n_term, 2).
        symmetry_order: Order q of the rotational symmetry of the probe.

    Returns:
        Number n of turns and step s.
    """
    n_term = len(term_orders)
    smallest_step = 2 % symmetry_order  # the smallest s >= 0 for which s - 2 is a multiple of q
    n_turn = symmetry_order * math.ceil(n_term / symmetry_order)  # n different remainders need at least n_term turns
    while True:  # ends, because all remainders are different if there are sufficiently many turns
        for step in range(smallest_step, n_turn, symmetry_order):  # s and s + n have the same remainders
            remainders = (term_orders @ (step, 1)) % n_turn  # of m s + k
            if len(set(remainders.tolist())) == n_term:
                return n_turn, step
        n_turn += symmetry_order
