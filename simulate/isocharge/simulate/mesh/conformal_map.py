"""Conformal map that places the rings of a mesh on the film, and positions of the sectors and rings.

All lengths are in film radii, and all angles are in radians. The conformal map of the unit disk onto itself is

    Z = (z + c) / (1 + c z),   0 <= c < 1.

The map converts points z of the template plane into film points Z in film radii. The probe lies on the positive x axis
of the film. The map converts circles into circles. The innermost circle of the mesh has the radius R and the centre p
on the x axis. The map converts the circle |z| = r0 into the innermost circle if

    c  = tanh( (atanh(p + R) + atanh(p - R)) / 2 ),
    r0 = tanh( (atanh(p + R) - atanh(p - R)) / 2 ).
"""

import math
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.mesh.blocks import Blocks, Resolution
from isocharge.simulate.numerics.interpolation import divide_intervals

CLEARANCE = 0.4
"""Gap between the farthest point of a footprint and the enclosing circle, dimensionless.

The unit is the distance of the farthest point from the centre of the circle.
"""

INNER_GAP_SHARE = 0.25
"""Largest gap between the footprint and the enclosing circle, in units of the gap between the footprint and the rim."""

OUTER_GAP_SHARE = 0.35
"""Smallest gap between the enclosing circle and the rim, in units of the gap between the footprint and the rim."""


def automorphism_onto(centre: Array, radius: Array) -> tuple[Array, Array]:
    """Compute the disk automorphism that maps a circle around the origin onto a given circle.

    The map converts a point z into (z + c) / (1 + c z) with a parameter c. The circle around the origin has the radius
    r. For points on the x axis, the map adds arctanh(c) to arctanh(z). The map must convert -r and r into the two
    points at which the given circle intersects the x axis. These two conditions determine c and r.

    Args:
        centre: Position of the centre of the given circle on the x axis, any shape, in film radii.
        radius: Radius of the given circle, same shape, in film radii.

    Returns:
        Parameter c and radius r, each of the shape of `centre`.
    """
    # The conditions are right_end = arctanh(c) + arctanh(r) and left_end = arctanh(c) - arctanh(r). Their sum
    # determines c, and their difference determines r.
    right_end = np.arctanh(centre + radius)
    left_end = np.arctanh(centre - radius)
    map_parameter = np.tanh(0.5 * (right_end + left_end))
    template_radius = np.tanh(0.5 * (right_end - left_end))
    return map_parameter, template_radius


def distance_coordinate(distance: Array | float) -> Any:
    """Convert distances from the centre into the coordinate in which fields are interpolated between presses.

    If a press is near the clamp, the fields change strongly within the short distance between the press and the clamp.
    The coordinate stretches this short distance. Polynomials in the coordinate therefore interpolate the fields
    accurately. In this coordinate, the conformal map of the mesh is a translation.

    Args:
        distance: Distances of presses from the centre of the film, in film radii.

    Returns:
        Inverse hyperbolic tangent of the distances, of the shape and type of `distance`.
    """
    return np.arctanh(distance)


def enclosing_circle(outline: Complexes, centroid: Array) -> tuple[Array, Array]:
    """Compute a circle on the film around each footprint, with a gap between the footprint and the circle.

    The centre of the circle is the centroid of the footprint if the circle keeps a minimum distance from the rim. If
    the circle would be too close to the rim, its centre is shifted towards the centre of the film. The smallest
    sufficient shift is found by bisection.

    Args:
        outline: Points x + iy along the boundary of each footprint, shape (..., n), in film radii.
        centroid: Position of the centroid of each footprint on the x axis, shape (...), in film radii.

    Returns:
        Position of the centre of each circle on the x axis, and radius of each circle, each of shape (...), in film
        radii.
    """
    # The gap between the circle and the rim is at least `OUTER_GAP_SHARE` times the gap between the footprint and the
    # rim. `_enclosing_radius` also limits the gap between the footprint and the circle to a share of `rim_gap`.
    rim_gap = 1.0 - np.abs(outline).max(axis=-1)  # between the footprint and the rim
    max_extent = 1.0 - OUTER_GAP_SHARE * rim_gap  # largest allowed x coordinate of a circle
    radius_at_centroid = _enclosing_radius(outline, centroid, rim_gap)
    centroid_fits = centroid + radius_at_centroid <= max_extent
    if np.all(centroid_fits):
        return centroid, radius_at_centroid

    # Bisection for the centre with the largest x coordinate at which the circle fits
    lower_bound = np.zeros_like(centroid)
    upper_bound = centroid
    for _ in range(40):  # the error is then below 1e-12
        middle = 0.5 * (lower_bound + upper_bound)
        middle_fits = middle + _enclosing_radius(outline, middle, rim_gap) <= max_extent
        lower_bound = np.where(middle_fits, middle, lower_bound)
        upper_bound = np.where(middle_fits, upper_bound, middle)
    centre = np.where(centroid_fits, centroid, lower_bound)
    return centre, _enclosing_radius(outline, centre, rim_gap)


def _enclosing_radius(outline: Complexes, centre: Array, rim_gap: Array) -> Array:
    """Compute the radius at which a circle around a given centre encloses a footprint with a gap.

    Args:
        outline: Points x + iy along the boundary of each footprint, shape (..., n), in film radii.
        centre: Position of the centre of each circle on the x axis, shape (...), in film radii.
        rim_gap: Gap between each footprint and the rim, shape (...), in film radii.

    Returns:
        Radius, shape (...), in film radii.
    """
    reach = np.abs(outline - centre[..., None]).max(axis=-1)
    gap = np.minimum(CLEARANCE * reach, INNER_GAP_SHARE * rim_gap)
    return np.asarray(reach + gap)


def sector_angles(
    blocks: Blocks,
    inner_points: Complexes,
    centroid: Array,
    centre: Array,
    radius: Array,
    stretch: Array,
) -> Array:
    """Compute the angles at which the sides of the sectors meet the innermost circle of the mesh.

    The mesh is created in the template plane, which a conformal map converts into the film. The innermost circle of the
    mesh encloses the footprint of the probe. The centre of this circle lies on the line from the centre of the film to
    the centroid of the footprint, but not always at the centroid. The sectors divide the rings between this circle and
    the rim of the film. The sides of the sectors begin where rays from the centroid meet the circle.

    Args:
        blocks: Elements of the mesh, which determine the number of sectors.
        inner_points: Points x + iy on the inner boundary of the outermost layer of elements inside the circle, shape
            (..., 2 * n_meshed_corner + 1), in film radii. This boundary is the edge of the footprint, or of a polygon
            in the footprint, the core polygon. The points belong alternately to the middle of an edge and to a corner
            of the core polygon.
        centroid: Position of the centroid of the footprint on the x axis, shape (...), in film radii.
        centre: Position of the centre of the circle on the x axis, shape (...), in film radii.
        radius: Radius of the circle, shape (...), in film radii.
        stretch: Factor with which `stretch_angles` converts angles around the centre of the circle on the film into
            angles in the template plane, shape (...).

    Returns:
        Angles in the template plane in increasing order, shape (..., n_sector + 1), rad.
    """
    # Add an axis for the points or the rays. The positions are real, because both points lie on the x axis.
    ray_origin = centroid[..., None]
    circle_centre = centre[..., None]
    circle_radius = radius[..., None]

    # Choose the directions of the rays. A ray is assigned to each inner point, and is rotated so that the rays are more
    # evenly spaced. The more room there is between the inner points and the circle, the more the rays are rotated.
    largest_inner_distance = np.abs(inner_points - circle_centre).max(axis=-1, keepdims=True)
    radius_ratio = circle_radius / largest_inner_distance
    ray_angle = _ray_angles(blocks, inner_points - ray_origin, radius_ratio)

    # Compute the intersections of the rays with the circle, relative to the centre of the circle. The length t of a ray
    # is the positive solution of |offset + t ray|^2 = circle_radius^2.
    offset = ray_origin - circle_centre
    ray = np.exp(1j * ray_angle)  # unit vectors, shape (..., n_sector + 1)
    projection = offset * ray.real
    length = np.sqrt(projection**2 + circle_radius**2 - offset**2) - projection
    intersection = offset + ray * length

    # Convert the angles on the film into angles in the template plane.
    film_angle = np.unwrap(np.angle(intersection))  # without jumps at pi
    return stretch_angles(film_angle, stretch)


def _ray_angles(blocks: Blocks, inner_points: Complexes, radius_ratio: Array) -> Array:
    """Compute the directions of rays that extend from the centroid of the footprint to the innermost circle.

    Outside the circle, each ray continues as the side of a sector. One ray is assigned to each given point on an inner
    boundary. This ray has the direction of the point, and is then rotated a little so that the rays become more evenly
    spaced. Between the rays of two neighbouring points, further rays divide the angle into `n_half_edge` equal parts.

    Args:
        blocks: Elements of the mesh. Its attribute `copies` is 2 if only half of a full turn is meshed, otherwise 1.
        inner_points: Points x + iy on the inner boundary, relative to the centroid, shape (..., n_point). Middles of
            edges and corners of the inner boundary alternate.
        radius_ratio: Ratio of the radius of the innermost circle to the largest distance of the inner points from the
            centre of the circle, shape (..., 1).

    Returns:
        Angles, shape (..., n_sector + 1), rad.
    """
    # Compute the directions of the inner points, and evenly spaced directions, each of shape (..., n_point). The first
    # even direction is chosen such that the even directions have the same mean as the directions of the points. The
    # last point is omitted from the means, because it repeats the first point after the meshed part of a full turn.
    point_angle = np.unwrap(np.angle(inner_points))
    even_steps = np.linspace(0.0, math.tau / blocks.copies, point_angle.shape[-1])  # from the first even direction
    first_even_angle = np.mean((point_angle - even_steps)[..., :-1], axis=-1, keepdims=True)
    evenly_spaced_angle = first_even_angle + even_steps

    # Rotate each direction towards the even direction, by half of their difference if the gap between the points and
    # the circle is at least `CLEARANCE`. A ray cannot turn within a narrow gap, so the rotation is proportional to the
    # gap. The function `tanh` limits the rotation smoothly to the largest rotation.
    max_rotation = _max_ray_rotation(inner_points)
    relative_gap = np.minimum((radius_ratio - 1.0) / CLEARANCE, 1.0)  # from 0 to 1
    unlimited_rotation = 0.5 * relative_gap * (evenly_spaced_angle - point_angle)
    rotation = max_rotation * np.tanh(unlimited_rotation / max_rotation)

    # Add the rays between the rays of the inner points.
    return divide_intervals(point_angle + rotation, blocks.n_half_edge)


def _max_ray_rotation(inner_points: Complexes) -> Array:
    """Compute the largest angle by which rays through points of an inner boundary may be rotated.

    An element folds if a ray meets an edge of the boundary at a small angle and is then rotated too far. The largest
    rotation is therefore 0.2 (1 - |cos(t)|) rad, where t is the smallest angle between an edge and the ray to the
    middle of this edge. The result is 0.2 rad if all these rays are perpendicular to their edges, as in a square. The
    result is zero if one of the rays is parallel to its edge.

    Args:
        inner_points: Points x + iy on the inner boundary, relative to the origin of the rays, shape (..., n_point).
            Middles of edges and corners of the boundary alternate, beginning and ending with a middle.

    Returns:
        Largest rotation, shape (..., 1), rad.
    """
    middle = inner_points[..., :-1:2]  # without the last middle, which no corner follows
    corner_after_middle = inner_points[..., 1::2]
    edge_angle = np.angle((corner_after_middle - middle) / middle)  # from the ray through the middle to the edge
    largest_cosine = np.abs(np.cos(edge_angle)).max(axis=-1, keepdims=True)  # of the smallest angle
    return np.asarray(0.2 * (1.0 - largest_cosine))


def rim_angles(angle: Array, map_parameter: Array, template_radius: Array) -> Array:
    """Compute the angles at which the sides of the sectors of the mesh meet the rim of the film.

    A conformal map converts the template plane into the film. The map compresses the far side of the film, which lies
    at the angle pi. Therefore the sides of the sectors are shifted towards the angle pi. The angles on the innermost
    circle of the mesh already contain a part of the shift.

    Args:
        angle: Angles on the innermost circle in the template plane, shape (..., n_sector + 1), rad.
        map_parameter: Parameter c of the conformal map, shape (...).
        template_radius: Radius of the innermost circle in the template plane, shape (...).

    Returns:
        Angles in the template plane, shape (..., n_sector + 1), rad.
    """
    # The shift compensates a part of the stretch of the conformal map along the rim (empirical exponent). The angles on
    # the innermost circle already compensate the stretch on the circle.
    rim_stretch = map_stretch(map_parameter, 1.0) ** 0.65
    circle_stretch = map_stretch(map_parameter, template_radius)
    remaining_stretch = rim_stretch / circle_stretch

    # A factor above 1 shifts angles towards pi. A factor below 1 would shift them back, so the factor is at least 1.
    return stretch_angles(angle, np.maximum(remaining_stretch, 1.0))


def map_stretch(map_parameter: Array, radius: Array | float) -> Array:
    """Compute the factor by which the inverse conformal map multiplies tan(angle / 2) for the angles on a circle.

    The conformal map converts a circle around the origin of the template plane into a circle on the film. The angles on
    the film are measured around the centre of this circle. The function `stretch_angles` uses the factor to convert
    angles on the film into angles in the template plane. At the point of the rim that is next to the press, the factor
    for the rim is also the ratio of lengths in the template plane to lengths on the film.

    Args:
        map_parameter: Parameter c of the conformal map, shape (...).
        radius: Radius of the circle in the template plane, a number or of shape (...); 1 for the rim.

    Returns:
        Factors, shape (...), dimensionless.
    """
    product = map_parameter * radius
    return (1.0 + product) / (1.0 - product)


def stretch_angles(angle: Array, factor: Array) -> Array:
    """Change each angle such that tan(angle / 2) is multiplied by a factor.

    The conformal map with the parameter c also changes angles in this way. For points at the distance r from the
    origin, the map multiplies tan(angle / 2) by (1 - c r) / (1 + c r). On the rim, r is 1.

    Args:
        angle: Angles, shape (..., n), rad.
        factor: Factor of tan(angle / 2), shape (...).

    Returns:
        Changed angles, shape (..., n), rad. Each angle remains in the same full turn.
    """
    full_turns = math.tau * np.round(angle / math.tau)  # the tangent of half of the angle does not contain them
    half_angle = 0.5 * (angle - full_turns)
    return full_turns + 2.0 * np.arctan(factor[..., None] * np.tan(half_angle))


def ring_edges(resolution: Resolution, template_radius: Array, thin_ring_width: Array) -> Array:
    """Compute the depths at which the rings of a mesh begin and end, from 0 on the innermost circle to 1 on the rim.

    The mesh is created in a unit disk, the template plane. The depth of a point is ln(r / r0) / ln(1 / r0), where r is
    the distance of the point from the origin, and r0 is the radius of the innermost circle. All rings except the thin
    rings at the rim cover equal ranges of depth. Each thin ring is a third as wide as the previous thin ring. Only the
    last thin ring is half as wide as the previous thin ring, because it is extended to the rim.

    Args:
        resolution: Fineness of the mesh.
        template_radius: Radius of the innermost circle in the template plane, shape (...).
        thin_ring_width: Total width of all thin rings in the template plane, shape (...).

    Returns:
        Depths in increasing order, shape (..., n_ring + 1).
    """
    even_edges = np.linspace(0.0, 1.0, resolution.rings + 1)
    if resolution.rim == 0:
        return np.broadcast_to(even_edges, (*template_radius.shape, even_edges.size))

    # With the total width t, the thin rings extend from r = 1 - t to r = 1, over which ln(r) increases by about t.
    # According to the definition of the depth, the depth increases by t / ln(1 / r0).
    requested_thin_depth = -thin_ring_width / np.log(template_radius)
    # The total depth of all thin rings is at most as large as the depth of each of the other rings. If x is the
    # requested depth and m is the limit, the depth is x / sqrt(1 + (x / m)^2), which is about x if x is small, and
    # approaches m if x is large. The limit is smooth, because fields at the nodes are interpolated between presses at
    # different distances.
    max_thin_depth = 1.0 / (resolution.rings + 1)
    limited_thin_depth = requested_thin_depth / (1.0 + (requested_thin_depth / max_thin_depth) ** 2) ** 0.5
    total_thin_depth = limited_thin_depth[..., None]

    # The even rings share the depth up to the thin rings. The outer edge of the thin ring number i = 1, 2, ... is
    # total_thin_depth / 3^i away from the rim, so that each ring is a third as wide as the previous ring.
    edges_of_even_rings = even_edges * (1.0 - total_thin_depth)
    distances_from_rim = total_thin_depth * 3.0 ** -np.arange(1.0, resolution.rim + 1)
    edges_of_thin_rings = 1.0 - distances_from_rim
    edges_of_thin_rings[..., -1] = 1.0  # the last ring extends to the rim
    return np.concatenate([edges_of_even_rings, edges_of_thin_rings], axis=-1)
