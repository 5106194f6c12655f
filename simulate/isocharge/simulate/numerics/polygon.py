"""Polygons and disks in the plane: areas, centroid, convexity, overlap, and Gauss rules.

Centroids, overlaps and intersections of polygons come from shapely (GEOS). The area within a disk is computed here,
because shapely replaces a disk by a polygon.
"""

from itertools import pairwise

import numpy as np
import shapely

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.interpolation import gauss_line, gauss_square


def area_of(corners: Array) -> float:
    """Compute the signed area of a polygon, which is positive if the corners are anticlockwise.

    Args:
        corners: Corners (x, y), shape (n, 2).
    """
    x, y = corners.T
    return float(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def centroid_of(corners: Array) -> Array:
    """Compute the centroid (x, y) of the area of a polygon, shape (2,).

    Args:
        corners: Corners (x, y), shape (n, 2).
    """
    return np.asarray(shapely.get_coordinates(shapely.centroid(shapely.Polygon(corners)))[0])


def is_convex(corners: Array) -> bool:
    """Return whether a polygon is convex and anticlockwise, with a left turn at every corner.

    A star polygon, which turns left at every corner but crosses itself, is not convex.

    Args:
        corners: Corners (x, y), shape (n, 2).
    """
    edge = np.roll(corners, -1, axis=0) - corners
    next_edge = np.roll(edge, -1, axis=0)
    turn = edge[:, 0] * next_edge[:, 1] - edge[:, 1] * next_edge[:, 0]
    offset = corners[None, :] - corners[:, None]
    side = edge[:, None, 0] * offset[..., 1] - edge[:, None, 1] * offset[..., 0]  # positive left of the edge
    return bool(np.all(turn > 0.0) and side.min() >= -1e-9 * side.max())


def overlap(first: Array, second: Array, within: float = 0.0) -> bool:
    """Return whether two polygons have common area, or are nearer to each other than a distance.

    Args:
        first: Corners (x, y), shape (n, 2).
        second: Corners (x, y), shape (m, 2).
        within: Distance, in the unit of the corners. If it is 0, polygons that only touch do not overlap.
    """
    first_polygon = shapely.Polygon(first)
    second_polygon = shapely.Polygon(second)
    if within > 0.0:
        return bool(shapely.distance(first_polygon, second_polygon) < within)
    return bool(shapely.relate_pattern(first_polygon, second_polygon, "T********"))  # the interiors intersect


def to_complex(corners: Array) -> Complexes:
    """Convert corners (x, y), shape (n, 2), into complex numbers x + iy, shape (n,)."""
    return np.asarray(corners @ np.array([1.0, 1j]))


def to_corners(z: Complexes) -> Array:
    """Convert complex numbers x + iy, shape (n,), into corners (x, y), shape (n, 2)."""
    return np.stack([z.real, z.imag], axis=1)


def min_edge_cross_product(corners: Complexes, points: Complexes) -> Array:
    """Compute the smallest cross product of an edge of a convex polygon with the vector from the edge to a point.

    The cross product is the length of the edge times the distance of the point from the line through the edge. It is
    positive on the left of the edge, so the smallest one is positive for points within the polygon.

    Args:
        corners: Corners x + iy, anticlockwise, shape (n,).
        points: Points x + iy, any shape.

    Returns:
        Smallest cross product of each point, in the shape of `points` and the square of their unit.
    """
    edge = np.roll(corners, -1) - corners
    return np.asarray((np.conj(edge) * (points[..., None] - corners)).imag.min(axis=-1))


def shared_area(first: Complexes, second: Complexes) -> float:
    """Compute the area that two polygons have in common.

    Args:
        first: Corners x + iy, shape (n,).
        second: Corners x + iy, shape (m,).
    """
    common = shapely.intersection(shapely.Polygon(to_corners(first)), shapely.Polygon(to_corners(second)))
    return float(common.area)


def area_in_disk(corners: Complexes, centre: Complexes | complex, radius: float) -> Array:
    """Compute the area that a polygon has in common with disks.

    The area is the sum over the edges of the area that the disk has in common with the triangle of the edge and the
    centre. The part of an edge inside the circle contributes a triangle; the parts outside contribute sectors.

    Args:
        corners: Corners x + iy, anticlockwise, shape (n,).
        centre: Centres of the disks, x + iy, any shape.
        radius: Radius of all disks.

    Returns:
        Common area for each disk, in the shape of `centre`.
    """
    start = corners - np.asarray(centre)[..., None]
    end = np.roll(start, -1, axis=-1)
    direction = (end - start) / np.abs(end - start)
    height = (start * np.conj(direction)).imag
    half_chord = np.sqrt(np.maximum(radius**2 - height**2, 0.0))
    first_inside = np.clip((start * np.conj(direction)).real, -half_chord, half_chord)
    last_inside = np.clip((end * np.conj(direction)).real, -half_chord, half_chord)
    first_point = (first_inside + 1j * height) * direction
    last_point = (last_inside + 1j * height) * direction
    sector_angle = np.angle(first_point * np.conj(start)) + np.angle(end * np.conj(last_point))
    triangle = -0.5 * height * (last_inside - first_inside)
    sectors = 0.5 * radius**2 * sector_angle
    return np.asarray((triangle + sectors).sum(axis=-1))


def gauss_polygon(corners: Array, count: int) -> tuple[Array, Array]:
    """Compute a Gauss rule for a convex polygon.

    The polygon is divided into triangles that share its first corner. The rule of a triangle is that of a square, of
    which one side is contracted to a point (Duffy 1982).

    Args:
        corners: Corners (x, y), anticlockwise, shape (n, 2).
        count: Number of points in each direction of a square.

    Returns:
        Points (x, y), shape (m, 2), and weights, shape (m,), which add up to one.
    """
    unit_points, unit_weights = gauss_square(count)
    s = unit_points[:, :1]
    t = unit_points[:, 1:]
    points = []
    weights = []
    for second, third in pairwise(corners[1:]):
        first_side = second - corners[0]
        second_side = third - corners[0]
        double_area = first_side[0] * second_side[1] - first_side[1] * second_side[0]
        points.append(corners[0] + s * ((1.0 - t) * first_side + t * second_side))
        weights.append(unit_weights * s[:, 0] * double_area)
    all_weights = np.concatenate(weights)
    return np.concatenate(points), all_weights / all_weights.sum()


def bilinear(z: Complexes, s: Array, t: Array) -> Complexes:
    """Map points of the unit square bilinearly into a quadrilateral, or into a triangle with a double last corner.

    Args:
        z: Corners x + iy of the images of (0, 0), (1, 0), (1, 1) and (0, 1), shape (4,); or of a triangle, shape (3,).
        s: First coordinate in the unit square.
        t: Second coordinate in the unit square, of a shape that can be broadcast with that of `s`.
    """
    a, b, c, d = _four_corners(z)
    return np.asarray(a + (b - a) * s + (d - a) * t + (a - b + c - d) * s * t)


def gauss_quadrilateral(corners: Array, count: int, length: float) -> tuple[Array, Array]:
    """Compute a Gauss rule for a quadrilateral or a triangle by mapping a square bilinearly.

    Args:
        corners: Corners (x, y), anticlockwise, shape (4, 2) or (3, 2).
        count: Number of points along a side of `length` or longer. Shorter sides have proportionally fewer, but at
            least two.
        length: Length of a side that has `count` points, in the unit of the corners.

    Returns:
        Points (x, y), shape (n, 2), and weights, shape (n,), which add up to the area of the polygon.
    """
    z = to_complex(corners)
    a, b, c, d = _four_corners(z)
    s, s_weights = _gauss_line_for(max(abs(b - a), abs(c - d)), count, length)
    t, t_weights = _gauss_line_for(max(abs(d - a), abs(c - b)), count, length)
    s = s[:, None]
    by_s = (b - a) * (1.0 - t) + (c - d) * t
    by_t = (d - a) * (1.0 - s) + (c - b) * s
    determinant = (np.conj(by_s) * by_t).imag
    return to_corners(bilinear(z, s, t).ravel()), (np.outer(s_weights, t_weights) * determinant).ravel()


def _four_corners(z: Complexes) -> Complexes:
    """Return the corners of a quadrilateral, or those of a triangle with the last one repeated."""
    return z if z.size == 4 else np.append(z, z[-1:])


def _gauss_line_for(side: float, count: int, length: float) -> tuple[Array, Array]:
    """Return the Gauss rule on [0, 1] with as many points as a side needs."""
    needed = max(2, int(np.ceil(count * side / length)))
    return gauss_line(min(count, needed))
