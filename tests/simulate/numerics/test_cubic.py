"""Local cubics reproduce cubics."""

import numpy as np
import pytest

from isocharge.simulate.numerics.cubic import cubic_weights


def test_cubics_are_exact_everywhere():
    polynomial = np.polynomial.Polynomial([1.0, -2.0, 0.3, 0.05])
    at = np.array([-0.5, 0.0, 0.2, 1.7, 3.0, 5.9, 7.0, 7.4])
    number, weights = cubic_weights(at, 8)
    assert number.min() == 0
    assert number.max() == 7
    assert (weights * polynomial(number)).sum(axis=1) == pytest.approx(polynomial(at))


def test_round_the_circle():
    nodes = np.cos(2.0 * np.pi * np.arange(64) / 64)
    at = np.array([-3.3, 0.1, 63.5, 70.2])
    number, weights = cubic_weights(at, 64, periodic=True)
    assert (weights * nodes[number]).sum(axis=1) == pytest.approx(np.cos(2.0 * np.pi * at / 64), abs=1e-5)
