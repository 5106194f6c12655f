"""Polygons and disks in the plane: area, centroid, how much of one lies in another, convex parts, and integrals."""

from itertools import pairwise

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.interpolation import gauss_line, gauss_square


def area_of(corners: Array) -> float:
    """Signed area of a polygon with corners of shape (n, 2), positive for anticlockwise ones."""
    x, y = corners.T
    return float(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def centroid_of(corners: Array) -> Array:
    """Centroid (x, y) of a polygon's area; corners of shape (n, 2)."""
    origin = corners.mean(axis=0)
    at, following = corners - origin, np.roll(corners - origin, -1, axis=0)
    cross = at[:, 0] * following[:, 1] - at[:, 1] * following[:, 0]
    return np.asarray(origin + np.sum((at + following) * cross[:, None], axis=0) / (3.0 * cross.sum()))


def is_convex(corners: Array) -> bool:
    """Whether a polygon turns left at every corner and no corner lies to the right of any edge (a star's do)."""
    edge = np.roll(corners, -1, axis=0) - corners
    turn = edge[:, 0] * np.roll(edge[:, 1], -1) - edge[:, 1] * np.roll(edge[:, 0], -1)
    offset = corners[None, :] - corners[:, None]
    left = edge[:, None, 0] * offset[..., 1] - edge[:, None, 1] * offset[..., 0]
    return bool(np.all(turn > 0.0) and left.min() >= -1e-9 * left.max())


def overlap(first: Array, second: Array, within: float = 0.0) -> bool:
    """Whether two convex polygons share area, or are apart by less than `within`: no edge normal separates them."""
    for polygon in (first, second):
        edge = np.roll(polygon, -1, axis=0) - polygon
        for normal in np.stack([edge[:, 1], -edge[:, 0]], axis=1):
            one, other, gap = first @ normal, second @ normal, within * float(np.hypot(*normal))
            if one.max() + gap <= other.min() or other.max() + gap <= one.min():
                return False
    return True


def to_complex(corners: Array) -> Complexes:
    """Corners of shape (n, 2) as x + iy."""
    return np.asarray(corners @ np.array([1.0, 1j]))


def to_corners(z: Complexes) -> Array:
    """Corners x + iy as (x, y), shape (n, 2)."""
    return np.stack([z.real, z.imag], axis=1)


def spare(corners: Complexes, points: Complexes) -> Array:
    """How far points are inside a convex polygon, in its smallest product of a side and the distance from it.

    Corners are anticlockwise; negative outside; of the shape of `points`.
    """
    step = np.roll(corners, -1) - corners
    return np.asarray((np.conj(step) * (points[..., None] - corners)).imag.min(axis=-1))


def shared_area(first: Complexes, second: Complexes) -> float:
    """Area common to two convex polygons with anticlockwise corners x + iy (Sutherland and Hodgman 1974)."""
    clipped = first
    for start, end in zip(second, np.roll(second, -1), strict=True):
        side = ((clipped - start) * np.conj(end - start)).imag
        clipped = _left_of(clipped, side)
        if clipped.size < 3:
            return 0.0
    return area_of(to_corners(clipped))


def _left_of(corners: Complexes, side: Array) -> Complexes:
    """The part of a polygon where `side`, given at its corners and linear along its edges, is positive."""
    clipped = []
    for at, following, value, next_value in zip(corners, np.roll(corners, -1), side, np.roll(side, -1), strict=True):
        if value >= 0.0:
            clipped.append(at)
        if value * next_value < 0.0:
            clipped.append(at + (following - at) * value / (value - next_value))
    return np.array(clipped, dtype=complex)


def area_in_disk(corners: Complexes, centre: Complexes | complex, radius: float) -> Array:
    """Area of a polygon (anticlockwise corners x + iy) that lies in a disk about each centre, of the centres' shape.

    Edge by edge, the triangle with the centre: along an edge the part inside the circle spans a triangle, the parts
    outside span sectors.
    """
    start = corners - np.asarray(centre)[..., None]
    end = np.roll(start, -1, axis=-1)
    along = (end - start) / np.abs(end - start)
    height = (start * np.conj(along)).imag
    half = np.sqrt(np.maximum(radius**2 - height**2, 0.0))
    first, last = (np.clip((z * np.conj(along)).real, -half, half) for z in (start, end))
    points = np.stack([start, (first + 1j * height) * along, (last + 1j * height) * along, end])
    turns = np.angle(points[1:] * np.conj(points[:-1]))
    return np.asarray((-0.5 * height * (last - first) + 0.5 * radius**2 * (turns[0] + turns[2])).sum(axis=-1))


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


def bilinear(z: Complexes, s: Array, t: Array) -> Complexes:
    """Points of a quadrilateral, or a triangle, whose corners x + iy are those of the unit square (s, t)."""
    a, b, c, d = z[[0, 1, 2, -1]]
    return np.asarray(a + (b - a) * s + (d - a) * t + (a - b + c - d) * s * t)


def gauss_quadrilateral(corners: Array, count: int, length: float) -> tuple[Array, Array]:
    """Gauss points of a quadrilateral or triangle, shape (n, 2), and weights, which add up to its area.

    A square mapped bilinearly; `count` points along a side of `length`, fewer, but two, along a shorter one.
    """
    z = to_complex(corners)
    a, b, c, d = z[[0, 1, 2, -1]]
    sides = max(abs(b - a), abs(c - d)), max(abs(d - a), abs(c - b))
    (s, share_s), (t, share_t) = (gauss_line(min(count, max(2, int(np.ceil(count * side / length))))) for side in sides)
    s = s[:, None]
    turn = np.conj((b - a) * (1.0 - t) + (c - d) * t) * ((d - a) * (1.0 - s) + (c - b) * s)
    return to_corners(bilinear(z, s, t).ravel()), (np.outer(share_s, share_t) * turn.imag).ravel()
