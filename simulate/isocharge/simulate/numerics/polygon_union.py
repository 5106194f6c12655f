"""Unions of polygons, divided into trapezoids for integration. Polygons are arrays of corners x + iy, anticlockwise.

The library shapely (GEOS) computes unions and intersections. The library has no equivalent for two functions of this
module: the division into trapezoids, and the outline of a trace. The function `buffer` of shapely silently cuts off
sharp bends, and converts a trace that crosses itself into a ring. With `trace_outline`, both errors can be detected.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.polygon import area_of, bilinear, to_complex, to_corners

MERGE_DISTANCE = 1e-9
"""Distance below which two corners, or the y coordinates of two corners, are merged, mm."""

MIN_BEND = 0.1
"""Smallest allowed value of 1 + cos(angle) for the angle by which a trace bends, dimensionless.

The length of a mitre is proportional to 1 / (1 + cos(angle)). The largest allowed bend is 154 degrees.
"""


def is_simple(corners: Complexes) -> bool:
    """Return whether a polygon is anticlockwise and does not cross itself.

    The signed area of a polygon is compared with the area that the polygon covers. The two areas are different if the
    polygon covers some points twice, or some points clockwise. A polygon that touches itself at a point or along an
    edge counts as simple.

    Args:
        corners: Corners x + iy, shape (n,), mm.
    """
    signed_area = area_of(to_corners(corners))
    perimeter = np.abs(corners - np.roll(corners, 1)).sum()
    difference = _region([corners]).area - signed_area
    return signed_area > 0.0 and bool(abs(difference) < MERGE_DISTANCE * perimeter)


def union_parts(front: Sequence[Complexes], back: Sequence[Complexes] = ()) -> list[Complexes]:
    """Divide the union of simple polygons into trapezoids that do not overlap.

    The plane is cut into horizontal strips at every corner and at every crossing of two edges. The part of the union
    within a strip consists of trapezoids. A triangle is represented as a trapezoid with two equal corners.

    Args:
        front: Simple polygons, each of shape (n,), mm.
        back: Further simple polygons. If there are any, the intersection of both unions is divided.

    Returns:
        Trapezoids, each of shape (4,), mm: lower left, lower right, upper right and upper left corner. They are ordered
        from bottom to top, and from left to right within a strip.
    """
    region = _region(front)
    if back:
        region = shapely.intersection(region, _region(back))
    if region.area == 0.0:
        return []

    start, end = _edges(region)
    trapezoids = []
    for bottom, top in pairwise(_strip_ends([*front, *back])):
        # Edges that cross the strip, in the order from left to right
        middle = 0.5 * (bottom + top)
        crosses_strip = (start.imag < middle) != (end.imag < middle)
        edge_start = start[crosses_strip]
        edge_end = end[crosses_strip]
        order = np.argsort(_x_at_height(edge_start, edge_end, middle))
        x_bottom = _x_at_height(edge_start, edge_end, bottom)[order]
        x_top = _x_at_height(edge_start, edge_end, top)[order]

        # The region begins at the first edge, ends at the second edge, begins again at the third edge, and so on.
        for left in range(0, order.size, 2):
            right = left + 1
            lower_left = x_bottom[left] + 1j * bottom
            lower_right = x_bottom[right] + 1j * bottom
            upper_right = x_top[right] + 1j * top
            upper_left = x_top[left] + 1j * top
            trapezoids.append(np.array([lower_left, lower_right, upper_right, upper_left]))
    return trapezoids


def _x_at_height(start: Complexes, end: Complexes, y: float) -> Array:
    """Return the x coordinates at which lines have the height y, shape (n,).

    Args:
        start: Points x + iy at which the lines start, shape (n,).
        end: Points x + iy at which the lines end, shape (n,).
        y: The height.
    """
    slope = (end - start).real / (end - start).imag
    return np.asarray(start.real + slope * (y - start.imag))


def _region(polygons: Sequence[Complexes]) -> shapely.Geometry:
    """Return the union of polygons. Polygons that touch or cross themselves are made valid first."""
    valid = shapely.make_valid([shapely.Polygon(to_corners(corners)) for corners in polygons])
    return shapely.union_all(valid)


def _strip_ends(polygons: Sequence[Complexes]) -> Array:
    """Return the y coordinates (mm) of all corners and of all crossings of edges, sorted and without repetition."""
    outlines = [shapely.LinearRing(to_corners(corners)) for corners in polygons]
    lines = shapely.union_all(outlines)  # has a point at each crossing
    y = np.unique(shapely.get_coordinates(lines)[:, 1])
    return np.asarray(y[np.diff(y, prepend=-np.inf) > MERGE_DISTANCE])


def _edges(region: shapely.Geometry) -> tuple[Complexes, Complexes]:
    """Return the start and end points x + iy of all edges of a region, including the edges of its holes."""
    parts = shapely.get_parts(region)
    polygons = parts[shapely.get_dimensions(parts) == 2]  # without points and lines where polygons only touch
    rings = [to_complex(shapely.get_coordinates(ring)) for ring in shapely.get_rings(polygons)]  # closed
    start = np.concatenate([ring[:-1] for ring in rings])
    end = np.concatenate([ring[1:] for ring in rings])
    return start, end


def subdivide(part: Complexes, max_side: float) -> list[Complexes]:
    """Cut a quadrilateral into smaller quadrilaterals. If two corners of a part coincide, the part is a triangle.

    Args:
        part: Corners of the quadrilateral, shape (4,), mm.
        max_side: Largest length of a side of the returned polygons, mm.

    Returns:
        Polygons of shape (4,) or (3,), mm.
    """
    # The quadrilateral is the bilinear image of the unit square (s, t), which is divided into a grid of cells.
    first_s_side, first_t_side, second_s_side, second_t_side = np.abs(np.roll(part, -1) - part)
    n_s = int(np.ceil(max(first_s_side, second_s_side) / max_side))
    n_t = int(np.ceil(max(first_t_side, second_t_side) / max_side))
    s = np.linspace(0.0, 1.0, n_s + 1)
    t = np.linspace(0.0, 1.0, n_t + 1)
    grid = bilinear(part, s[:, None], t)  # shape (n_s + 1, n_t + 1)
    cells = []
    for i in range(n_s):
        for j in range(n_t):
            corners = np.array([grid[i, j], grid[i + 1, j], grid[i + 1, j + 1], grid[i, j + 1]])

            # Omit corners that coincide with the previous corner, and cells without an area.
            previous_corners = np.roll(corners, 1)
            is_distinct = np.abs(corners - previous_corners) > MERGE_DISTANCE
            has_area = np.count_nonzero(is_distinct) > 2
            if has_area:
                cells.append(corners[is_distinct])
    return cells


def trace_outline(path: Complexes, width: float) -> Complexes:
    """Compute the outline of a trace of constant width along a path, with straight ends and mitred bends.

    Args:
        path: Points of the path, shape (n,), mm.
        width: Width of the trace, mm.

    Returns:
        Corners, anticlockwise, shape (2 n,), mm. Corners of a bend sharper than `MIN_BEND` allows are NaN.
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # repeated points and sharp bends result in NaN
        sections = np.diff(path)
        normal = 1j * sections / np.abs(sections)  # to the left of each section
        normal_before = np.append(normal[:1], normal)  # at each point; the ends have a single section
        normal_after = np.append(normal, normal[-1:])

        # The mitre is the displacement of a corner from the path, along the bisector of the unit normals n and m before
        # and after the point. Its components along n and m are half of the width, so it is proportional to n + m with
        # the factor (width / 2) / (1 + cos(bend)), where the product n . m is the cosine of the bend.
        one_plus_cosine = 1.0 + (normal_before * np.conj(normal_after)).real
        one_plus_cosine = np.where(one_plus_cosine < MIN_BEND, np.nan, one_plus_cosine)
        mitre = 0.5 * width * (normal_before + normal_after) / one_plus_cosine
    right_side = path - mitre
    left_side = path + mitre
    return np.append(right_side, left_side[::-1])
