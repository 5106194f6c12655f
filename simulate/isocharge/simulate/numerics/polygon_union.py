"""Division of a union of polygons into trapezoids for numerical integration, and computation of trace outlines.

A polygon is an array of its corners (x, y) in anticlockwise order. The library shapely (GEOS) computes unions and
intersections of polygons, but cannot divide a union into trapezoids.

The outline of a trace is computed without shapely. The function `shapely.buffer` silently cuts off sharp bends, and
converts a trace that crosses itself into a ring. The result of the function `trace_outline` allows callers to detect
sharp bends and crossings.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import ArrayLike

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.polygon import area_of, bilinear

MERGE_DISTANCE = 1e-9
"""Distance below which two corners or two y coordinates of corners are treated as equal, mm."""

MIN_BEND = 0.1
"""Smallest allowed value of 1 + cos(angle), where `angle` is the angle by which a trace bends, dimensionless.

The length of a mitre is proportional to 1 / (1 + cos(angle)). The largest allowed bend is 154 degrees.
"""


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
