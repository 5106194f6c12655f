"""Areas, centroids and overlaps of polygons in the plane, and Gauss quadrature rules for polygons.

The library shapely (GEOS) computes centroids, overlaps and intersections of polygons. The function `area_in_disk` does
not use shapely, because shapely would replace the disk by a polygon.
"""

from typing import TypeVar

import numpy as np
import shapely

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.interpolation import gauss_line

Points = TypeVar("Points", Array, Complexes)


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
    """Return whether a polygon is strictly convex and has its corners in anticlockwise order.

    Args:
        corners: Corners (x, y), shape (n, 2).
    """
    polygon = shapely.Polygon(corners)
    if not (polygon.is_valid and polygon.exterior.is_ccw):
        return False
    # The convex hull of a polygon contains only the corners at which the polygon is strictly convex.
    n_hull_corner = len(shapely.get_coordinates(polygon.convex_hull)) - 1  # the first corner is repeated
    return bool(n_hull_corner == len(corners))


def to_complex(corners: Array) -> Complexes:
    """Convert corners (x, y), shape (n, 2), into complex numbers x + iy, shape (n,)."""
    return np.asarray(corners @ np.array([1.0, 1j]))


def to_corners(z: Complexes) -> Array:
    """Convert complex numbers x + iy, shape (n,), into corners (x, y), shape (n, 2)."""
    return np.stack([z.real, z.imag], axis=1)


def area_in_disk(corners: Complexes, centre: complex, radius: Array | float) -> Array:
    """Compute the area that a polygon has in common with each of several concentric disks.

    Each edge of the polygon forms a triangle with the centre of the disk. The signed areas that the triangles and the
    disk have in common add up to the common area of the polygon and the disk. The part of an edge inside the circle
    contributes the area of a triangle. Each part of an edge outside the circle contributes the area of a circular
    sector.

    Args:
        corners: Corners x + iy, anticlockwise, shape (n,).
        centre: Centre of the disks, x + iy.
        radius: Radii of the disks, any shape.

    Returns:
        Common area for each disk, in the shape of `radius`.
    """
    # Start and end point of each edge relative to the centre, and their coordinates along the edge and across it. The
    # coordinate across the edge is the same for both points. The shape of these arrays is (n,).
    start = corners - centre
    end = np.roll(start, -1)
    direction = (end - start) / np.abs(end - start)  # unit vector x + iy
    start_along = (start * np.conj(direction)).real
    end_along = (end * np.conj(direction)).real
    across = (start * np.conj(direction)).imag  # negative if the centre lies on the left of the edge

    # The chord is the part of the edge within the circle. If the edge does not meet the circle, the length of the chord
    # is zero.
    squared_radius = np.asarray(radius)[..., None] ** 2  # shape (..., 1)
    half_chord = np.sqrt(np.maximum(squared_radius - across**2, 0.0))
    chord_start_along = np.clip(start_along, -half_chord, half_chord)
    chord_end_along = np.clip(end_along, -half_chord, half_chord)
    chord_start = (chord_start_along + 1j * across) * direction
    chord_end = (chord_end_along + 1j * across) * direction

    # Signed areas of the triangle between the centre and the chord, and of the sectors before and after the chord
    triangle_area = -0.5 * across * (chord_end_along - chord_start_along)
    angle_before_chord = np.angle(chord_start * np.conj(start))
    angle_after_chord = np.angle(end * np.conj(chord_end))
    sector_area = 0.5 * squared_radius * (angle_before_chord + angle_after_chord)
    return np.asarray((triangle_area + sector_area).sum(axis=-1))


def bilinear(corners: Points, s: Array, t: Array) -> Points:
    """Map points (s, t) of the unit square into a quadrilateral or a triangle by a bilinear function.

    Args:
        corners: Corners of a quadrilateral or of a triangle: x + iy, shape (4,) or (3,), or (x, y), shape (4, 2) or
            (3, 2). The corners of a quadrilateral are the images of (0, 0), (1, 0), (1, 1) and (0, 1). The last corner
            of a triangle is the image of both (1, 1) and (0, 1).
        s: First coordinate in the unit square. For corners (x, y), the last axis has the length 1.
        t: Second coordinate in the unit square. The shapes of `s` and `t` can be broadcast.

    Returns:
        Points of the same kind as the corners, in the common shape of `s` and `t`.
    """
    z00, z10, z11, z01 = _four_corners(corners)  # the digits are the coordinates s and t of each corner
    points: Points = z00 + (z10 - z00) * s + (z01 - z00) * t + (z00 - z10 + z11 - z01) * s * t
    return points


def gauss_quadrilateral(corners: Array, max_count: int, reference_length: float) -> tuple[Array, Array]:
    """Compute the points and weights of a Gauss rule for a quadrilateral or a triangle.

    A bilinear function maps the rule of the unit square into the polygon.

    Args:
        corners: Corners (x, y), anticlockwise, shape (4, 2) or (3, 2).
        max_count: Number of points along a side of the reference length or longer. Shorter sides have proportionally
            fewer points, but at least two.
        reference_length: Length of the shortest side that has `max_count` points, in the unit of the corners.

    Returns:
        Points (x, y), shape (n, 2), and weights, shape (n,). The weights add up to the area of the polygon.
    """
    # The polygon is the image of the unit square with the coordinates s and t. The digits in the name of a corner are
    # the values of s and t at this corner.
    complex_corners = to_complex(corners)
    z00, z10, z11, z01 = _four_corners(complex_corners)
    s_side = max(abs(z10 - z00), abs(z11 - z01))  # length of the longer side in the direction of s
    t_side = max(abs(z01 - z00), abs(z11 - z10))
    s_points, s_weights = _gauss_line_for(s_side, max_count, reference_length)
    t, t_weights = _gauss_line_for(t_side, max_count, reference_length)
    s = s_points[:, None]  # shape (n_s, 1), to be combined with each t

    points = bilinear(complex_corners, s, t)  # shape (n_s, n_t)
    # The determinant of the Jacobian is the cross product of the derivatives of the points.
    s_derivative = (z10 - z00) * (1.0 - t) + (z11 - z01) * t
    t_derivative = (z01 - z00) * (1.0 - s) + (z11 - z10) * s
    determinant = (np.conj(s_derivative) * t_derivative).imag
    weights = np.outer(s_weights, t_weights) * determinant
    return to_corners(points.ravel()), weights.ravel()


def _four_corners(corners: Points) -> Points:
    """Return four corners for a quadrilateral or a triangle. The last corner of a triangle is returned twice.

    Args:
        corners: Corners x + iy, shape (4,) or (3,), or corners (x, y), shape (4, 2) or (3, 2).
    """
    return corners if len(corners) == 4 else np.append(corners, corners[-1:], axis=0)


def _gauss_line_for(side: float, max_count: int, reference_length: float) -> tuple[Array, Array]:
    """Return a Gauss rule on the interval [0, 1] whose number of points is proportional to the length of a side.

    Args:
        side: Length of the side.
        max_count: Largest number of points. The smallest number is two.
        reference_length: Length of the shortest side that has `max_count` points, in the unit of `side`.

    Returns:
        Points and weights, each of shape (n,).
    """
    proportional_count = max(2, int(np.ceil(max_count * side / reference_length)))
    return gauss_line(min(max_count, proportional_count))
