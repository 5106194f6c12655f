"""Areas of polygons, Gauss quadrature rules for polygons, unions of polygons, and outlines of traces.

A polygon is an array of its corners in anticlockwise order. The library shapely (GEOS) computes centroids, unions and
intersections of polygons, but cannot divide a union into trapezoids for numerical integration. The function
`area_in_disk` does not use shapely, because shapely would replace the disk by a polygon.

The outline of a trace is computed without shapely. The function `shapely.buffer` silently cuts off sharp bends, and
converts a trace that crosses itself into a ring. The result of the function `trace_outline` allows callers to detect
sharp bends and crossings.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import TypeVar

import numpy as np
import shapely
from numpy.typing import ArrayLike

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.interpolation import gauss_line

MERGE_DISTANCE = 1e-9
"""Distance below which two corners or two y coordinates of corners are treated as equal, mm."""

MIN_BEND = 0.1
"""Smallest allowed value of 1 + cos(angle), where `angle` is the angle by which a trace bends, dimensionless.

The length of a mitre is proportional to 1 / (1 + cos(angle)). The largest allowed bend is 154 degrees.
"""

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


def is_simple(corners: Array) -> bool:
    """Return whether the corners of a polygon are in anticlockwise order and the polygon does not cross itself.

    The function compares the signed area of the polygon with the area that the polygon covers. The two areas differ if
    the polygon covers a region twice or encloses a region clockwise. A polygon that touches itself at a point or along
    an edge counts as simple.

    Args:
        corners: Corners (x, y), shape (n, 2), mm.
    """
    signed_area = area_of(corners)
    perimeter = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum()
    difference = _region([corners]).area - signed_area
    return signed_area > 0.0 and bool(abs(difference) < MERGE_DISTANCE * perimeter)


def union_parts(front: Sequence[ArrayLike], back: Sequence[ArrayLike] = ()) -> list[Array]:
    """Divide the union of simple polygons into trapezoids that do not overlap.

    Horizontal lines through every corner and through every crossing of two edges divide the plane into strips. Within
    each strip, the union consists of trapezoids. A triangle is represented as a trapezoid with two equal corners.

    Args:
        front: Simple polygons, each of shape (n, 2), mm.
        back: Further simple polygons, each of shape (n, 2), mm. If there are any, the function divides the intersection
            of the union of `front` and the union of `back`.

    Returns:
        Trapezoids, each of shape (4, 2), mm. The corners of each trapezoid are in the order lower left, lower right,
        upper right, upper left. The trapezoids are ordered from bottom to top, and from left to right within a strip.
    """
    region = _region(front)
    if back:
        region = shapely.intersection(region, _region(back))
    if region.area == 0.0:
        return []

    start, end = _edges(region)
    trapezoids = []
    for bottom, top in pairwise(_strip_ends([*front, *back])):
        # Find the edges that cross the strip. The start and the end of such an edge are on different sides of the
        # middle of the strip, because no edge ends within a strip.
        middle = 0.5 * (bottom + top)
        crosses_strip = (start[:, 1] < middle) != (end[:, 1] < middle)
        edge_start = start[crosses_strip]
        edge_end = end[crosses_strip]

        # Sort the edges from left to right. Edges do not cross each other within a strip.
        order = np.argsort(_x_at_height(edge_start, edge_end, middle))
        x_bottom = _x_at_height(edge_start, edge_end, bottom)[order]
        x_top = _x_at_height(edge_start, edge_end, top)[order]

        # The region begins at the first edge, ends at the second edge, begins again at the third edge, and so on.
        for left in range(0, order.size, 2):
            right = left + 1
            lower_corners = [(x_bottom[left], bottom), (x_bottom[right], bottom)]
            upper_corners = [(x_top[right], top), (x_top[left], top)]
            trapezoids.append(np.array(lower_corners + upper_corners))
    return trapezoids


def _x_at_height(start: Array, end: Array, y: float) -> Array:
    """Compute the x coordinate at which each straight line reaches the height y, shape (n,).

    Args:
        start: Points (x, y) at which the lines start, shape (n, 2).
        end: Points (x, y) at which the lines end, shape (n, 2).
        y: Height, which must be the same for all lines.
    """
    x_difference, y_difference = (end - start).T
    return np.asarray(start[:, 0] + x_difference / y_difference * (y - start[:, 1]))


def _region(polygons: Sequence[ArrayLike]) -> shapely.Geometry:
    """Compute the union of polygons.

    A polygon that touches or crosses itself is first converted into a valid region.
    """
    valid_regions = shapely.make_valid([shapely.Polygon(corners) for corners in polygons])
    return shapely.union_all(valid_regions)


def _strip_ends(polygons: Sequence[ArrayLike]) -> Array:
    """Return the y coordinates of all corners and of all crossings of edges in ascending order, shape (n,), mm.

    Coordinates that differ by less than `MERGE_DISTANCE` are returned only once.
    """
    outlines = [shapely.LinearRing(corners) for corners in polygons]
    lines = shapely.union_all(outlines)  # includes a point at each crossing of two edges
    y = np.unique(shapely.get_coordinates(lines)[:, 1])
    is_distinct = np.diff(y, prepend=-np.inf) > MERGE_DISTANCE  # from the previous coordinate; true for the first
    return np.asarray(y[is_distinct])


def _edges(region: shapely.Geometry) -> tuple[Array, Array]:
    """Return the start points and the end points of all edges of a region, including the edges of its holes.

    Returns:
        Start points and end points (x, y), each of shape (n, 2).
    """
    parts = shapely.get_parts(region)
    polygons = parts[shapely.get_dimensions(parts) == 2]  # removes points and lines at which polygons only touch
    rings = [shapely.get_coordinates(ring) for ring in shapely.get_rings(polygons)]
    # Each ring is closed, because its last point is the same as its first point.
    start = np.concatenate([ring[:-1] for ring in rings])
    end = np.concatenate([ring[1:] for ring in rings])
    return start, end


def subdivide(quadrilateral: Array, max_side: float) -> list[Array]:
    """Cut a quadrilateral into quadrilaterals and triangles whose sides do not exceed a given length.

    Args:
        quadrilateral: Corners of the quadrilateral, shape (4, 2), mm. Two of the corners may be equal.
        max_side: Largest length of a side of the returned polygons, mm.

    Returns:
        Corners of each polygon, shape (4, 2) for a quadrilateral or (3, 2) for a triangle, mm.
    """
    # The quadrilateral is the bilinear image of the unit square (s, t), which is divided into a grid of cells.
    side_lengths = np.linalg.norm(np.roll(quadrilateral, -1, axis=0) - quadrilateral, axis=1)
    first_s_side, first_t_side, second_s_side, second_t_side = side_lengths
    n_s = int(np.ceil(max(first_s_side, second_s_side) / max_side))
    n_t = int(np.ceil(max(first_t_side, second_t_side) / max_side))
    s = np.linspace(0.0, 1.0, n_s + 1)
    t = np.linspace(0.0, 1.0, n_t + 1)
    grid = bilinear(quadrilateral, s[:, None, None], t[:, None])  # shape (n_s + 1, n_t + 1, 2)
    corner_grids = [grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]]
    cells = []
    for corners in np.stack(corner_grids, axis=2).reshape(-1, 4, 2):
        # Omit corners that coincide with the previous corner. Omit cells with fewer than three distinct corners,
        # because their area is zero.
        is_distinct = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) > MERGE_DISTANCE
        if np.count_nonzero(is_distinct) > 2:
            cells.append(corners[is_distinct])
    return cells


def trace_outline(path: Complexes, width: float) -> Complexes:
    """Compute the outline of a trace that follows a path with a constant width.

    The outline has straight ends and mitred bends. At each point of the path, the outline has one corner on the left
    side and one corner on the right side. The displacement from a point of the path to the left corner is called the
    mitre. Between two sections with the unit normals n and m, the mitre is (width / 2) (n + m) / (1 + dot(n, m)). The
    product dot(n, m) is the cosine of the angle by which the path bends.

    Args:
        path: Points of the path x + iy, shape (n,), mm.
        width: Width of the trace, mm.

    Returns:
        Corners in anticlockwise order, shape (2 n,), mm. If two successive points are equal, or if a bend is sharper
        than `MIN_BEND` allows, the corners at these points are NaN.
    """
    # Repeated points and sharp bends result in NaN, for which NumPy would issue warnings.
    with np.errstate(divide="ignore", invalid="ignore"):
        sections = np.diff(path)
        normals = 1j * sections / np.abs(sections)  # to the left of each section, shape (n - 1,)
        # Normals of the sections before and after each point. At an end of the path, both are the same section.
        normal_before = np.append(normals[:1], normals)
        normal_after = np.append(normals, normals[-1:])
        one_plus_cosine = 1.0 + (normal_before * np.conj(normal_after)).real
        one_plus_cosine = np.where(one_plus_cosine < MIN_BEND, np.nan, one_plus_cosine)
        mitre = 0.5 * width * (normal_before + normal_after) / one_plus_cosine
    right_side = path - mitre
    left_side = path + mitre
    return np.append(right_side, left_side[::-1])
