"""Gauss rules on a line, a square and a convex polygon."""

from itertools import pairwise

import numpy as np

from isocharge.arrays import Array


def gauss_line(count: int) -> tuple[Array, Array]:
    """Gauss points and shares on [0, 1]."""
    at, weight = np.polynomial.legendre.leggauss(count)
    return 0.5 * (at + 1.0), 0.5 * weight


def gauss_square(count: int) -> tuple[Array, Array]:
    at, share = gauss_line(count)
    x, y = np.meshgrid(at, at)
    return np.stack([x.ravel(), y.ravel()], axis=1), np.outer(share, share).ravel()


def gauss_polygon(corners: Array, count: int) -> tuple[Array, Array]:
    """A fan of triangles from the first corner, each a square folded onto a triangle (Duffy 1982)."""
    unit, share = gauss_square(count)
    s, t = unit[:, :1], unit[:, 1:]
    points, shares = [], []
    for second, third in pairwise(corners[1:]):
        one, two = second - corners[0], third - corners[0]
        points.append(corners[0] + s * ((1.0 - t) * one + t * two))
        shares.append(share * s[:, 0] * (one[0] * two[1] - one[1] * two[0]))
    total = np.concatenate(shares)
    return np.concatenate(points), total / total.sum()
