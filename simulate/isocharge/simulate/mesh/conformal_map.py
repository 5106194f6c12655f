"""Parameters of the conformal map of `placement`, which is a disk automorphism, and the grading of sectors and rings.

All lengths are in film radii. All angles are in radians.
"""

from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.mesh.blocks import Blocks, Resolution

CLEARANCE = 0.4
"""Gap between the farthest point of a footprint and the enclosing circle, in units of the distance of this point from
the centre of the circle."""

MAX_TURN = 0.2
"""Largest angle between the side of a sector and the ray through its corner, rad. With larger angles, elements at
corners that lie close together would fold."""

INNER_GAP_SHARE = 0.25
"""Largest gap between the footprint and the enclosing circle, in units of the gap between the footprint and the rim."""

OUTER_GAP_SHARE = 0.35
"""Smallest gap between the enclosing circle and the rim, in units of the gap between the footprint and the rim."""

GRADING = 0.65
"""Share of the stretching of the conformal map along the rim that the sectors compensate, from 0 (nothing) to 1
(everything)."""

BISECTION_STEPS = 40
"""Number of bisection steps for the centre of the enclosing circle."""


def automorphism_onto(centre: Array, radius: Array) -> tuple[Array, Array]:
    """Compute the conformal map of the unit disk that maps a circle about the origin onto a given circle.

    The conformal map is (z + c) / (1 + c z); see `placement`. The circle about the origin has the radius rho. For
    points on the x axis, the map adds arctanh(c) to arctanh(z). It must map -rho and rho to the two points at which the
    given circle intersects the x axis. These two conditions determine c and rho.

    Args:
        centre: Centre of the circle on the x axis, any shape, in film radii.
        radius: Radius of the circle, same shape, in film radii.

    Returns:
        The parameter c of the map and rho, each of the shape of `centre`.
    """
    # The conditions are right_end = arctanh(c) + arctanh(rho) and left_end = arctanh(c) - arctanh(rho).
    right_end = np.arctanh(centre + radius)
    left_end = np.arctanh(centre - radius)
    c = np.tanh(0.5 * (right_end + left_end))
    rho = np.tanh(0.5 * (right_end - left_end))
    return c, rho


def distance_coordinate(distance: Array | float) -> Any:
    """Return the coordinate in which fields are interpolated by polynomials between presses at different distances.

    If a press is near the clamp, the fields change over the short distance from the press to the clamp. The coordinate
    stretches this distance. The conformal map of `placement` is a translation along this coordinate.

    Args:
        distance: Distances from the centre of the film, in film radii.

    Returns:
        The inverse hyperbolic tangent, of the shape and type of `distance`.
    """
    return np.arctanh(distance)


def enclosing_circle(outline: Complexes, centroid: Array) -> tuple[Array, Array]:
    """Compute a circle on the film that encloses each footprint with a gap.

    The centre of the circle is the centroid of the footprint, unless the circle would be too close to the rim. In this
    case, the centre of the circle is shifted towards the centre of the film as far as necessary. The shift is found by
    bisection.

    Args:
        outline: Points along the boundary of each footprint, shape (..., n), in film radii.
        centroid: Distance of the centroid from the centre of the film, on the x axis, shape (...), in film radii.

    Returns:
        Centre (on the x axis) and radius of the circles, each of shape (...), in film radii.
    """
    rim_gap = 1.0 - np.abs(outline).max(axis=-1)
    largest_extent = 1.0 - OUTER_GAP_SHARE * rim_gap  # largest allowed distance of the circle from the centre
    centroid_radius = _enclosing_radius(outline, centroid)
    centroid_fits = centroid + centroid_radius <= largest_extent
    if np.all(centroid_fits):
        return centroid, centroid_radius

    # Bisection for the largest position of the centre at which the circle fits
    lower_bound = np.zeros(centroid.shape)
    upper_bound = centroid.copy()
    for _ in range(BISECTION_STEPS):
        middle = 0.5 * (lower_bound + upper_bound)
        middle_fits = middle + _enclosing_radius(outline, middle) <= largest_extent
        lower_bound = np.where(middle_fits, middle, lower_bound)
        upper_bound = np.where(middle_fits, upper_bound, middle)
    centre = np.where(centroid_fits, centroid, lower_bound)
    return centre, _enclosing_radius(outline, centre)


def _enclosing_radius(outline: Complexes, centre: Array) -> Array:
    """Return the radius of the circle about a centre on the x axis that encloses a footprint with a gap.

    Args:
        outline: Points along the boundary of each footprint, shape (..., n), in film radii.
        centre: Position of the centre of each circle, shape (...), in film radii.

    Returns:
        Radius, shape (...), in film radii.
    """
    rim_gap = 1.0 - np.abs(outline).max(axis=-1)
    reach = np.abs(outline - centre[..., None]).max(axis=-1)
    gap = np.minimum(CLEARANCE * reach, INNER_GAP_SHARE * rim_gap)
    return np.asarray(reach + gap)


def sector_angles(
    blocks: Blocks, stops: Complexes, reach: Array, centroid: Array, centre: Array, radius: Array, c_rho: Array
) -> Array:
    """Compute the angles of the sides of the sectors on the innermost circle.

    The sides begin where rays from the centroid of the footprint meet the circle. The directions of the rays are a
    compromise between the directions of the stops and equal angles. If the gap between the footprint and the circle is
    narrow, the rays pass close to the stops. Otherwise elements would fold.

    Args:
        blocks: The elements.
        stops: Points on the inner side of the outermost layer of blocks: at the corners of the footprint and half-way
            between them, shape (..., 2 * n_meshed + 1), in film radii.
        reach: Distance of the farthest point of the inner side from the centre of the circle, shape (...), in film
            radii.
        centroid: Position of the centroid on the x axis, shape (...), in film radii.
        centre: Centre of the circle on the x axis, shape (...), in film radii.
        radius: Radius of the circle, shape (...), in film radii.
        c_rho: Product of the parameters c and rho of the conformal map, shape (...).

    Returns:
        Angles in the template plane, increasing, shape (..., n_sector + 1).
    """
    origin = centroid[..., None] + 0j  # common origin of the rays
    ray_angle = _ray_angles(blocks, stops - origin, radius / reach)
    ray: Complexes = np.exp(1j * ray_angle)  # unit vectors, shape (..., n_sector + 1)
    offset: Complexes = np.asarray(origin - centre[..., None], dtype=complex)
    intersection = _intersections_with_circle(offset, ray, radius[..., None])

    # Angles on the circle, which increase from one ray to the next
    first_angle = np.angle(intersection[..., :1])
    step = np.mod(np.angle(intersection[..., 1:] / intersection[..., :-1]), 2.0 * np.pi)
    film_angle = np.concatenate([first_angle, first_angle + np.cumsum(step, axis=-1)], axis=-1)
    stretch = (1.0 + c_rho) / (1.0 - c_rho)  # of the conformal map along the circle
    return stretch_angles(film_angle, stretch)


def _intersections_with_circle(origin: Complexes, ray: Complexes, radius: Array) -> Complexes:
    """Return the points at which rays from inside a circle meet the circle. The centre of the circle is 0.

    Args:
        origin: Origins of the rays, x + iy.
        ray: Unit vectors of the rays as complex numbers. The shapes of all arguments broadcast.
        radius: Radii of the circles.
    """
    # The length t of a ray is the positive solution of |origin + t ray|^2 = radius^2.
    projection = (origin * np.conj(ray)).real
    length = np.sqrt(projection**2 + radius**2 - np.abs(origin) ** 2) - projection
    return np.asarray(origin + ray * length)


def _ray_angles(blocks: Blocks, stops: Complexes, radius_ratio: Array) -> Array:
    """Compute the directions of the rays from the centroid of the footprint along the sides of the sectors.

    Args:
        blocks: The elements.
        stops: The stops of `sector_angles` relative to the centroid, shape (..., n_stop).
        radius_ratio: Radius of the circle over the distance of the farthest point of the inner side, shape (...).

    Returns:
        Angles, shape (..., n_sector + 1), rad.
    """
    # Equal angles that have the same mean as the angles of the stops
    stop_angle = np.unwrap(np.angle(stops), axis=-1)
    angle_from_first = np.linspace(0.0, 2.0 * np.pi / blocks.copies, stop_angle.shape[-1])
    mean_difference = np.mean(stop_angle[..., :-1] - angle_from_first[:-1], axis=-1)
    even_angle = angle_from_first + mean_difference[..., None]

    # Turn each ray from its stop towards the equal angles. `tanh` limits the turn to `MAX_TURN`.
    evenness = 0.5 * np.minimum((radius_ratio - 1.0) / CLEARANCE, 1.0)[..., None]
    turn = MAX_TURN * np.tanh(evenness * (even_angle - stop_angle) / MAX_TURN)
    mixed_angle = stop_angle + turn

    # Divide each interval between two stops into `blocks.split` equal parts.
    fraction = np.arange(blocks.split) / blocks.split
    interval = np.diff(mixed_angle, axis=-1)[..., None]
    angles_in_intervals = mixed_angle[..., :-1, None] + fraction * interval  # shape (..., n_stop - 1, split)
    angles = angles_in_intervals.reshape(*mixed_angle.shape[:-1], -1)
    return np.concatenate([angles, mixed_angle[..., -1:]], axis=-1)


def rim_angles(angle: Array, c: Array, rho: Array) -> Array:
    """Compute the angles of the sides of the sectors on the rim.

    The conformal map compresses the far side of the film, which lies at the angle pi. The sides of the sectors are
    therefore shifted towards this angle. The equal spacing on the innermost circle already contains a part of the
    shift.

    Args:
        angle: Angles on the innermost circle, in the template plane, shape (..., n_sector + 1).
        c: Parameter of the conformal map, shape (...).
        rho: Radius of the innermost circle in the template plane, shape (...).

    Returns:
        Angles in the template plane, shape (..., n_sector + 1).
    """
    rim_stretch = ((1.0 + c) / (1.0 - c)) ** GRADING
    circle_stretch = (1.0 + c * rho) / (1.0 - c * rho)
    stretch = rim_stretch / circle_stretch
    return stretch_angles(angle, np.maximum(stretch, 1.0))


def stretch_angles(angle: Array, factor: Array) -> Array:
    """Multiply the tangent of half of each angle by a factor.

    The conformal map changes the angles on the circle |z| = rho with the factor (1 - c rho) / (1 + c rho). For the rim,
    rho is 1.

    Args:
        angle: Angles, shape (..., n).
        factor: Factor, shape (...).

    Returns:
        Angles in the same turn as the given ones, shape (..., n).
    """
    full_turns = 2.0 * np.pi * np.round(angle / (2.0 * np.pi))
    return np.asarray(full_turns + 2.0 * np.arctan(factor[..., None] * np.tan(0.5 * (angle - full_turns))))


def ring_edges(resolution: Resolution, rho: Array, layer: Array) -> Array:
    """Compute the depths of the edges of the rings: 0 on the innermost circle, 1 on the rim.

    The depth of a point is ln(r / rho) / ln(1 / rho), where r is its radius in the template plane. The rings have equal
    depths, except for the thin rings at the rim. Each thin ring is a third as wide as the previous thin ring.

    Args:
        resolution: Fineness of the mesh.
        rho: Radius of the innermost circle in the template plane, shape (...).
        layer: Width of all thin rings together, in the template plane, shape (...).

    Returns:
        Depths, shape (..., n_ring + 1).
    """
    even_edges = np.linspace(0.0, 1.0, resolution.rings + 1)
    if resolution.rim == 0:
        return np.broadcast_to(even_edges, (*rho.shape, even_edges.size))

    # The width of the thin rings is about a step of ln r, because r is about 1 there. Divided by ln(1 / rho), it is a
    # step of the depth.
    depth_of_layer = -layer / np.log(rho)
    thin_depth = np.minimum(depth_of_layer, _max_thin_depth(resolution))[..., None]  # of all thin rings together
    edges_of_even_rings = even_edges * (1.0 - thin_depth)
    edges_of_thin_rings = 1.0 - thin_depth * 3.0 ** -np.arange(1.0, resolution.rim + 1)
    edges_of_thin_rings[..., -1] = 1.0  # the last ring extends to the rim
    return np.concatenate([edges_of_even_rings, edges_of_thin_rings], axis=-1)


def widest_layer(resolution: Resolution, c: Array, rho: Array) -> Array:
    """Return the width of the thin rings above which `ring_edges` limits their depth, in film radii.

    Args:
        resolution: Fineness of the mesh.
        c: Parameter of the conformal map, shape (...).
        rho: Radius of the innermost circle in the template plane, shape (...).

    Returns:
        Widths, shape (...).
    """
    return np.asarray(-np.log(rho) * _max_thin_depth(resolution) * (1.0 - c) / (1.0 + c))


def _max_thin_depth(resolution: Resolution) -> float:
    """Return the largest total depth of the thin rings.

    If the thin rings counted as a single ring and all rings had equal depths, each ring would have this depth.
    """
    return 1.0 / (resolution.rings + 1)
