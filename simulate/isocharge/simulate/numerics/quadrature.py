"""Gauss rules on a line, a square and a convex polygon."""

from itertools import pairwise

import numpy as np

from isocharge.common.arrays import Array


def gauss_line(count: int) -> tuple[Array, Array]:
    """Gauss points on [0, 1] and shares, which add up to one; each of shape (count,)."""
    at, weight = np.polynomial.legendre.leggauss(count)
    return 0.5 * (at + 1.0), 0.5 * weight


def gauss_reference_square(count: int) -> tuple[Array, Array, Array]:
    """Gauss points (xi, eta) on [-1, 1]^2, xi fast, and their weights, which add up to 4; each of shape (count^2,)."""
    line, weight = np.polynomial.legendre.leggauss(count)
    xi, eta = np.meshgrid(line, line)
    return xi.ravel(), eta.ravel(), np.outer(weight, weight).ravel()


def gauss_square(count: int) -> tuple[Array, Array]:
    """Gauss points on [0, 1]^2, shape (count^2, 2), and shares, which add up to one."""
    xi, eta, weights = gauss_reference_square(count)
    return 0.5 * (np.stack([xi, eta], axis=1) + 1.0), 0.25 * weights


def gauss_polygon(corners: Array, count: int) -> tuple[Array, Array]:
    """Gauss points of a convex polygon, shape (n, 2), and shares, which add up to one.

    A fan of triangles from the first corner, each a square folded onto a triangle (Duffy 1982).
    """
    unit, share = gauss_square(count)
    s, t = unit[:, :1], unit[:, 1:]
    points, shares = [], []
    for second, third in pairwise(corners[1:]):
        one, two = second - corners[0], third - corners[0]
        points.append(corners[0] + s * ((1.0 - t) * one + t * two))
        shares.append(share * s[:, 0] * (one[0] * two[1] - one[1] * two[0]))
    total = np.concatenate(shares)
    return np.concatenate(points), total / total.sum()
