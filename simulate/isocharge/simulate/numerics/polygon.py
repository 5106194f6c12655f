"""Areas of polygons, Gauss quadrature rules for polygons, unions of polygons, and outlines of traces.

A polygon is an array of its corners in anticlockwise order. The library shapely (GEOS) computes centroids, unions,
intersections and triangles of polygons. The function `area_in_disk` does not use shapely, because shapely would replace
the disk by a polygon.

The outline of a trace is computed without shapely. The function `shapely.buffer` silently cuts off sharp bends, and
converts a trace that crosses itself into a ring. The result of the function `trace_outline` allows callers to detect
sharp bends and crossings.
"""

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import ArrayLike

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.interpolation import gauss_line, tensor_rule

MERGE_DISTANCE = 1e-9
"""Width of a strip along a boundary whose area is neglected when areas are compared, mm."""

MIN_BEND = 0.1
"""Smallest allowed value of 1 + cos(angle), where `angle` is the angle by which a trace bends, dimensionless.

The length of a mitre is proportional to 1 / (1 + cos(angle)). The largest allowed bend is 154 degrees.
"""


def area_of(corners: Array) -> float:
    """Compute the signed area of a polygon by the shoelace formula; positive if the corners are anticlockwise.

    Args:
        corners: Corners (x, y), shape (n, 2).
    """
    # Coordinates relative to the first corner, because large coordinates would cause large rounding errors
    x, y = (corners - corners[0]).T
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
    return n_hull_corner == len(corners)


def to_complex(corners: Array) -> Complexes:
    """Convert corners (x, y), shape (..., n, 2), into complex numbers x + iy, shape (..., n)."""
    return np.asarray(corners @ np.array([1.0, 1j]))


def to_corners(z: Complexes) -> Array:
    """Convert complex numbers x + iy, shape (..., n), into corners (x, y), shape (..., n, 2)."""
    return np.stack([z.real, z.imag], axis=-1)


def cross_product(first: Complexes, second: Complexes) -> Array:
    """Compute the cross products of plane vectors x + iy; positive if `second` is anticlockwise of `first`."""
    return (np.conj(first) * second).imag


def area_in_disk(corners: Complexes, centre: complex, radius: Array | float) -> Array:
    """Compute the area that a polygon has in common with each of several concentric disks.

    Each edge of the polygon forms a triangle with the centre of the disk. The area of a triangle counts as positive if
    its edge runs anticlockwise around the centre, and as negative otherwise. The sum of the signed areas of all
    triangles is the area of the polygon. In the same way, the signed areas that the triangles share with the disk add
    up to the area that the polygon shares with the disk.

    The part of an edge inside the circle is a chord. Between the centre and the chord, the common area is a triangle.
    Before and after the chord, the edge lies outside the circle, and the common area is a circular sector.

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
    across = cross_product(direction, start)  # negative if the centre lies on the left of the edge

    # Compute the chords. If the edge does not meet the circle, the length of the chord is zero, and the edge is outside
    # the circle before and after this point.
    squared_radius = np.asarray(radius)[..., None] ** 2  # shape (..., 1)
    half_chord = np.sqrt(np.maximum(squared_radius - across**2, 0.0))
    chord_start_along = np.clip(start_along, -half_chord, half_chord)
    chord_end_along = np.clip(end_along, -half_chord, half_chord)
    chord_start = (chord_start_along + 1j * across) * direction
    chord_end = (chord_end_along + 1j * across) * direction

    # Compute the signed areas of the triangle between the centre and the chord, and of both sectors. The area of the
    # triangle is half of the length of the chord times the signed distance -across of the centre from the edge.
    triangle_area = -0.5 * across * (chord_end_along - chord_start_along)
    angle_before_chord = np.angle(chord_start * np.conj(start))
    angle_after_chord = np.angle(end * np.conj(chord_end))
    sector_area = 0.5 * squared_radius * (angle_before_chord + angle_after_chord)
    return np.asarray((triangle_area + sector_area).sum(axis=-1))


def gauss_quadrilaterals(corners: Complexes, line_area: Array, count: int) -> tuple[Complexes, Array]:
    """Compute the points and weights of a Gauss rule for each of several quadrilaterals, triangles and lines.

    A bilinear function maps the points of the rule for the unit square into each quadrilateral. The weights are
    multiplied by the determinant of the Jacobian of the bilinear function. For a line, the determinant is zero. The
    weights of a line are therefore multiplied by the area that the line represents. Lines occur if a mean over the
    edges of an electrode replaces the mean over its area.

    Args:
        corners: Corners x + iy, anticlockwise, shape (n, 4). The last two corners of a triangle are equal. In a line,
            the first corner equals the last corner, and the second corner equals the third corner.
        line_area: Area that a line represents, shape (n,); zero for a quadrilateral or a triangle.
        count: Number of points along a side.

    Returns:
        Points x + iy, and weights, each of shape (n, count^2). The weights add up to the area of the quadrilateral or
        to the area that the line represents.
    """
    # Coordinates t and s, and weights of the points in the unit square, each of shape (count^2,). The rule is symmetric
    # in both coordinates. The first coordinate of `tensor_rule`, which is t here, varies fastest.
    t, s, square_weights = tensor_rule(*gauss_line(count))

    # Map the points into the quadrilaterals. The digits in the name of a corner are its coordinates s and t.
    z00, z10, z11, z01 = corners.T[:, :, None]  # each of shape (n, 1)
    s_derivative = (z10 - z00) * (1.0 - t) + (z11 - z01) * t
    t_derivative = (z01 - z00) * (1.0 - s) + (z11 - z10) * s
    points = z00 * (1.0 - t) + z01 * t + s * s_derivative
    determinant = cross_product(s_derivative, t_derivative)  # of the Jacobian; zero for a line

    # One of the two summands is zero.
    area_factor = determinant + line_area[:, None]
    return points, square_weights * area_factor


def halve_quadrilaterals(corners: Complexes) -> Complexes:
    """Divide each quadrilateral by a line from the middle of its longest side to the middle of the opposite side.

    Args:
        corners: Corners x + iy, anticlockwise, shape (n, 4).

    Returns:
        Corners x + iy of the halves, shape (2 n, 4). The first n rows contain one half of each quadrilateral, and the
        last n rows contain the other half.
    """
    # Renumber the corners such that the longest side is the first side, between the first and the second corner, or the
    # third side, between the third and the fourth corner.
    next_corners = np.roll(corners, -1, axis=1)
    side_lengths = np.abs(next_corners - corners)  # of the sides that begin at the corners
    longer_of_first_and_third = side_lengths[:, ::2].max(axis=1)
    longer_of_second_and_fourth = side_lengths[:, 1::2].max(axis=1)
    must_renumber = longer_of_second_and_fourth > longer_of_first_and_third
    first, second, third, fourth = np.where(must_renumber[:, None], next_corners, corners).T

    # Divide the quadrilaterals between the middles of the two opposite sides.
    middle = 0.5 * (first + second)
    opposite_middle = 0.5 * (third + fourth)
    first_half = np.stack([first, middle, opposite_middle, fourth], axis=1)
    second_half = np.stack([middle, second, third, opposite_middle], axis=1)
    return np.concatenate([first_half, second_half])


def is_simple(corners: Array) -> bool:
    """Return whether a polygon does not cross itself and has its corners in anticlockwise order.

    The function compares the signed area of the polygon with the area that the polygon covers. The two areas differ if
    the polygon covers a region twice or encloses a region clockwise. A polygon that touches itself at a point or along
    an edge counts as simple.

    Args:
        corners: Corners (x, y), shape (n, 2), mm.
    """
    signed_area = area_of(corners)
    perimeter = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum()
    difference = region_of([corners]).area - signed_area
    return signed_area > 0.0 and bool(abs(difference) < MERGE_DISTANCE * perimeter)


def union_triangles(
    front: Sequence[ArrayLike], back: Sequence[ArrayLike] = (), max_side: float = np.inf
) -> list[Array]:
    """Divide the union of simple polygons into triangles that do not overlap.

    Args:
        front: Simple polygons, each of shape (n, 2), mm.
        back: Further simple polygons, each of shape (n, 2), mm. If `back` is not empty, the function divides only the
            region that `front` and `back` have in common.
        max_side: Largest length of the sides that lie on the outline of the divided region, mm. Longer sides of the
            outline are divided before the triangles are formed.

    Returns:
        Triangles with anticlockwise corners, each of shape (3, 2), mm.
    """
    region = region_of(front)
    if back:
        region = shapely.intersection(region, region_of(back))
    # Select the polygons of the region. Points and lines at which polygons only touch have less than two dimensions.
    parts = shapely.get_parts(region)
    polygons = shapely.multipolygons(parts[shapely.get_dimensions(parts) == 2])
    divided_outlines = shapely.segmentize(polygons, max_side)
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(divided_outlines))

    # The outline of a triangle repeats its first corner at the end.
    return [shapely.get_coordinates(triangle)[:3] for triangle in shapely.orient_polygons(triangles)]


def region_of(polygons: Sequence[ArrayLike]) -> shapely.Geometry:
    """Compute the union of polygons.

    A polygon that touches or crosses itself is first converted into a valid region.
    """
    valid_regions = shapely.make_valid([shapely.Polygon(corners) for corners in polygons])
    return shapely.union_all(valid_regions)


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
        # `MIN_BEND` is the smallest allowed value of 1 + cosine, because the mitre becomes very long at a sharp bend.
        one_plus_cosine = np.where(one_plus_cosine < MIN_BEND, np.nan, one_plus_cosine)
        mitre = 0.5 * width * (normal_before + normal_after) / one_plus_cosine
    right_side = path - mitre
    left_side = path + mitre
    return np.append(right_side, left_side[::-1])
