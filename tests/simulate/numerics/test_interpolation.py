"""Lagrange interpolation, compared with exact polynomials and with SciPy."""

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.interpolate import BarycentricInterpolator

from isocharge.simulate.numerics.interpolation import (
    basis,
    chebyshev_nodes,
    lagrange_values,
    lobatto_nodes,
)

ORDERS = (2, 3, 4, 7, 16)


@pytest.mark.parametrize("order", ORDERS)
def test_basis_reproduces_a_polynomial_and_its_derivative(order):
    rng = np.random.default_rng(order)
    polynomial = Polynomial(rng.standard_normal(order + 1))
    at = rng.uniform(-1.0, 1.0, 50)
    values, derivatives = basis(order, at)
    nodal = polynomial(lobatto_nodes(order))
    np.testing.assert_allclose(values @ nodal, polynomial(at), atol=1e-12)
    np.testing.assert_allclose(derivatives @ nodal, polynomial.deriv()(at), atol=1e-11 * order**2)


@pytest.mark.parametrize("count", [2, 8, 15, 40])
def test_interpolation_on_chebyshev_nodes_agrees_with_scipy(count):
    nodes = chebyshev_nodes(count, 0.0, 8.0)
    at = np.linspace(0.0, 8.0, 33)
    values = np.random.default_rng(count).standard_normal(count)
    ours = lagrange_values(nodes, at) @ values
    np.testing.assert_allclose(ours, BarycentricInterpolator(nodes, values)(at), rtol=1e-9, atol=1e-9)
