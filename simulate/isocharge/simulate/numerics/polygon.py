"""Polygons and disks in the plane: areas, centroid, convexity, overlap, and Gauss rules.

The library shapely (GEOS) computes centroids, overlaps and intersections of polygons. The area of a polygon within a
disk is computed here, because shapely would replace the disk by a polygon.
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
    turns_left = np.all(_cross(edge, next_edge) > 0.0)

    # All corners of a convex polygon lie on the left of each edge or on the edge.
    offset = corners[None, :] - corners[:, None]  # from the start of each edge to each corner
    side = _cross(edge[:, None], offset)  # positive for corners on the left of the edge
    is_on_left = side.min() >= -1e-9 * side.max()  # the tolerance is for rounding errors
    return bool(turns_left and is_on_left)


def _cross(first: Array, second: Array) -> Array:
    """Return the cross products x1 y2 - y1 x2 of plane vectors.

    Args:
        first: Vectors (x1, y1), shape (..., 2).
        second: Vectors (x2, y2), shape (..., 2).

    Returns:
        Cross products, shape (...). They are positive if the second vector points to the left of the first.
    """
    x1 = first[..., 0]
    y1 = first[..., 1]
    x2 = second[..., 0]
    y2 = second[..., 1]
    return np.asarray(x1 * y2 - y1 * x2)


def overlap(first: Array, second: Array, within: float = 0.0) -> bool:
    """Return whether two polygons overlap or are closer to each other than a given distance.

    Args:
        first: Corners (x, y), shape (n, 2).
        second: Corners (x, y), shape (m, 2).
        within: The distance, in the unit of the corners. If it is 0, polygons that only touch do not overlap.
    """
    first_polygon = shapely.Polygon(first)
    second_polygon = shapely.Polygon(second)
    if within > 0.0:
        return bool(shapely.distance(first_polygon, second_polygon) < within)
    interiors_intersect = "T********"  # pattern of the dimensionally extended nine-intersection model
    return bool(shapely.relate_pattern(first_polygon, second_polygon, interiors_intersect))


def to_complex(corners: Array) -> Complexes:
    """Convert corners (x, y), shape (n, 2), into complex numbers x + iy, shape (n,)."""
    return np.asarray(corners @ np.array([1.0, 1j]))


def to_corners(z: Complexes) -> Array:
    """Convert complex numbers x + iy, shape (n,), into corners (x, y), shape (n, 2)."""
    return np.stack([z.real, z.imag], axis=1)


def min_edge_cross_product(corners: Complexes, points: Complexes) -> Array:
    """Compute the smallest cross product over all edges of a convex polygon.

    The factors of each cross product are an edge and the vector from its start to the point. The cross product is the
    length of the edge times the signed distance of the point from the line through the edge. The cross product is
    positive if the point lies on the left of the edge. The smallest cross product is therefore positive for points
    within the polygon.

    Args:
        corners: Corners x + iy, anticlockwise, shape (n,).
        points: Points x + iy, any shape.

    Returns:
        Smallest cross product of each point, in the shape of `points` and the square of their unit.
    """
    edge = np.roll(corners, -1) - corners
    offset = points[..., None] - corners  # shape (..., n): from the start of each edge to the point
    cross_product = (np.conj(edge) * offset).imag
    return np.asarray(cross_product.min(axis=-1))


def shared_area(first: Complexes, second: Complexes) -> float:
    """Compute the area that two polygons have in common.

    Args:
        first: Corners x + iy, shape (n,).
        second: Corners x + iy, shape (m,).
    """
    common = shapely.intersection(shapely.Polygon(to_corners(first)), shapely.Polygon(to_corners(second)))
    return float(common.area)


def area_in_disk(corners: Complexes, centre: Complexes | complex, radius: float) -> Array:
    """Compute the area of the intersection of a polygon with each of several disks.

    Each edge of the polygon forms a triangle with the centre of the disk. The result is the sum of the signed areas
    that these triangles have in common with the disk. The part of an edge inside the circle contributes a triangle, and
    the parts outside contribute sectors.

    Args:
        corners: Corners x + iy, anticlockwise, shape (n,).
        centre: Centres of the disks, x + iy, any shape.
        radius: Radius of all disks.

    Returns:
        Common area for each disk, in the shape of `centre`.
    """
    # Ends of each edge relative to the centre, and their coordinates along and across the edge, shape (..., n)
    start = corners - np.asarray(centre)[..., None]
    end = np.roll(start, -1, axis=-1)
    direction = (end - start) / np.abs(end - start)
    start_along = (start * np.conj(direction)).real
    end_along = (end * np.conj(direction)).real
    across = (start * np.conj(direction)).imag  # negative if the centre lies on the left of the edge

    # Ends of the part of the edge within the circle. They coincide if the edge does not meet the circle.
    half_chord = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    chord_start_along = np.clip(start_along, -half_chord, half_chord)
    chord_end_along = np.clip(end_along, -half_chord, half_chord)
    chord_start = (chord_start_along + 1j * across) * direction
    chord_end = (chord_end_along + 1j * across) * direction

    # Signed areas of the triangle inside the circle and of the sectors before and after it
    triangle = -0.5 * across * (chord_end_along - chord_start_along)
    angle_before_chord = np.angle(chord_start * np.conj(start))
    angle_after_chord = np.angle(end * np.conj(chord_end))
    sectors = 0.5 * radius**2 * (angle_before_chord + angle_after_chord)
    return np.asarray((triangle + sectors).sum(axis=-1))


def gauss_polygon(corners: Array, count: int) -> tuple[Array, Array]:
    """Compute a Gauss rule for a convex polygon.

    The polygon is divided into triangles that share its first corner. The rule of a triangle is the rule of a square
    after one side of the square is contracted to a point (Duffy 1982).

    Args:
        corners: Corners (x, y), anticlockwise, shape (n, 2).
        count: Number of points in each direction of a square.

    Returns:
        Points (x, y), shape (m, 2), and weights, shape (m,), which add up to one.
    """
    unit_points, unit_weights = gauss_square(count)
    radial = unit_points[:, :1]  # 0 at the first corner of a triangle, 1 on the opposite side; shape (count^2, 1)
    angular = unit_points[:, 1:]  # 0 on the first side, 1 on the second side
    first_corner = corners[0]
    points = []
    weights = []
    for second_corner, third_corner in pairwise(corners[1:]):
        first_side = second_corner - first_corner
        second_side = third_corner - first_corner
        point_on_opposite_side = (1.0 - angular) * first_side + angular * second_side
        points.append(first_corner + radial * point_on_opposite_side)

        # The determinant of the Jacobian is the radial coordinate times twice the area of the triangle.
        double_area = float(_cross(first_side, second_side))
        weights.append(unit_weights * radial[:, 0] * double_area)
    all_weights = np.concatenate(weights)
    return np.concatenate(points), all_weights / all_weights.sum()


def bilinear(corners: Complexes, s: Array, t: Array) -> Complexes:
    """Map points (s, t) of the unit square bilinearly into a quadrilateral, or into a triangle.

    Args:
        corners: Corners x + iy, shape (4,): the images of (0, 0), (1, 0), (1, 1) and (0, 1). A triangle has the shape
            (3,), and its last corner is the image of both (1, 1) and (0, 1).
        s: First coordinate in the unit square.
        t: Second coordinate in the unit square, of a shape that can be broadcast with that of `s`.

    Returns:
        Points x + iy, in the common shape of `s` and `t`.
    """
    a, b, c, d = _four_corners(corners)
    return np.asarray(a + (b - a) * s + (d - a) * t + (a - b + c - d) * s * t)


def gauss_quadrilateral(corners: Array, count: int, length: float) -> tuple[Array, Array]:
    """Compute a Gauss rule for a quadrilateral or a triangle by mapping a square bilinearly.

    Args:
        corners: Corners (x, y), anticlockwise, shape (4, 2) or (3, 2).
        count: Number of points along a side of the length `length` or more. Shorter sides have proportionally fewer
            points, but at least two.
        length: Length of a side from which on it has `count` points, in the unit of the corners.

    Returns:
        Points (x, y), shape (n, 2), and weights, shape (n,), which add up to the area of the polygon.
    """
    # The corners (a, b, c, d) are the images of (0, 0), (1, 0), (1, 1) and (0, 1) in the coordinates (s, t).
    complex_corners = to_complex(corners)
    a, b, c, d = _four_corners(complex_corners)
    s_side = max(abs(b - a), abs(c - d))  # the longer one of the two sides along s
    t_side = max(abs(d - a), abs(c - b))
    s_line, s_weights = _gauss_line_for(s_side, count, length)
    t, t_weights = _gauss_line_for(t_side, count, length)
    s = s_line[:, None]

    points = bilinear(complex_corners, s, t)  # shape (n_s, n_t)
    # The determinant of the Jacobian is the cross product of the derivatives of the points.
    s_derivative = (b - a) * (1.0 - t) + (c - d) * t
    t_derivative = (d - a) * (1.0 - s) + (c - b) * s
    determinant = (np.conj(s_derivative) * t_derivative).imag
    weights = np.outer(s_weights, t_weights) * determinant
    return to_corners(points.ravel()), weights.ravel()


def _four_corners(corners: Complexes) -> Complexes:
    """Return the four corners of a quadrilateral, or the three corners of a triangle with the last corner repeated."""
    return corners if corners.size == 4 else np.append(corners, corners[-1:])


def _gauss_line_for(side: float, count: int, length: float) -> tuple[Array, Array]:
    """Return the Gauss rule on [0, 1] with a number of points that suits the length of a side.

    Args:
        side: Length of the side.
        count: Largest number of points.
        length: Length of a side from which on it has `count` points, in the unit of `side`.
    """
    proportional_count = max(2, int(np.ceil(count * side / length)))
    return gauss_line(min(count, proportional_count))
