"""Lobatto basis against what numpy and scipy know of Legendre polynomials, and against polynomials themselves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from scipy.interpolate import BarycentricInterpolator
from scipy.special import legendre

from isocharge.simulate.numerics.interpolation import (
    barycentric_weights,
    basis,
    chebyshev_nodes,
    cubic_weights,
    lagrange_values,
    lobatto_nodes,
)

ORDERS = (1, 2, 3, 4, 7, 16)


@pytest.mark.parametrize("order", ORDERS)
def test_nodes_are_the_extrema_of_the_legendre_polynomial_and_the_ends(order):
    nodes = lobatto_nodes(order)
    assert nodes.shape == (order + 1,)
    assert np.all(np.diff(nodes) > 0.0)
    assert nodes[0] == -1.0
    assert nodes[-1] == 1.0
    assert legendre(order).deriv()(nodes[1:-1]) == pytest.approx(0.0, abs=1e-7 * order**4)
    np.testing.assert_allclose(nodes, -nodes[::-1], atol=1e-14)


@pytest.mark.parametrize("order", ORDERS)
def test_basis_reproduces_a_polynomial_and_its_derivative(order):
    rng = np.random.default_rng(order)
    polynomial, at = Polynomial(rng.standard_normal(order + 1)), rng.uniform(-1.0, 1.0, 50)
    values, derivatives = basis(order, at)
    nodal = polynomial(lobatto_nodes(order))
    np.testing.assert_allclose(values @ nodal, polynomial(at), atol=1e-12)
    np.testing.assert_allclose(derivatives @ nodal, polynomial.deriv()(at), atol=1e-11 * order**2)


@given(at=st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=8), order=st.integers(1, 12))
@settings(derandomize=True, deadline=None)
def test_values_add_up_to_one_everywhere(at, order):
    """Also one rounding step beside a node, where the barycentric terms are huge."""
    at = np.concatenate([at, np.nextafter(lobatto_nodes(order), 0.0)])
    np.testing.assert_allclose(basis(order, at)[0].sum(axis=1), 1.0, atol=1e-12)


def test_chebyshev_nodes_are_the_zeros_of_the_chebyshev_polynomial():
    nodes = chebyshev_nodes(7, -1.0, 1.0)
    expected = np.sort(np.polynomial.chebyshev.chebpts1(7))
    np.testing.assert_allclose(nodes, expected, atol=1e-15)
    np.testing.assert_allclose(chebyshev_nodes(7, 2.0, 5.0), 3.5 + 1.5 * expected, atol=1e-14)


@pytest.mark.parametrize("count", [2, 8, 15, 40])
def test_interpolation_on_chebyshev_nodes_is_scipys(count):
    nodes, at = chebyshev_nodes(count, 0.0, 8.0), np.linspace(0.0, 8.0, 33)
    values = np.random.default_rng(count).standard_normal(count)
    ours = lagrange_values(nodes, barycentric_weights(nodes), at) @ values
    np.testing.assert_allclose(ours, BarycentricInterpolator(nodes, values)(at), rtol=1e-9, atol=1e-9)


def test_interpolation_on_one_node_is_a_constant():
    nodes = chebyshev_nodes(1, 2.0, 5.0)
    np.testing.assert_array_equal(nodes, [3.5])
    np.testing.assert_array_equal(
        lagrange_values(nodes, barycentric_weights(nodes), np.array([2.0, 3.5])), [[1.0], [1.0]]
    )


# Local cubics


def test_cubics_are_exact_everywhere():
    polynomial = np.polynomial.Polynomial([1.0, -2.0, 0.3, 0.05])
    at = np.array([-0.5, 0.0, 0.2, 1.7, 3.0, 5.9, 7.0, 7.4])
    number, weights = cubic_weights(at, 8)
    assert number.min() == 0
    assert number.max() == 7
    assert (weights * polynomial(number)).sum(axis=1) == pytest.approx(polynomial(at))


def test_cubics_go_round_the_circle():
    nodes = np.cos(2.0 * np.pi * np.arange(64) / 64)
    at = np.array([-3.3, 0.1, 63.5, 70.2])
    number, weights = cubic_weights(at, 64, periodic=True)
    assert (weights * nodes[number]).sum(axis=1) == pytest.approx(np.cos(2.0 * np.pi * at / 64), abs=1e-5)
