"""Search for the elements that contain film points.

Points outside the innermost circle are located by closed formulas, and points inside by Newton's method. The module
`placement` describes the positions of the elements. Each element has two local coordinates from 0 to 1. The radial
coordinate increases from the inner to the outer side. The angular coordinate increases anticlockwise along the sector.
"""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.simulate.mesh.blocks import Blocks
from isocharge.simulate.mesh.placement import Placement

NEWTON_STEPS = 20
"""Number of Newton steps to locate a point inside the innermost circle. Six suffice in well-shaped blocks."""

OVERSHOOT = 0.1
"""Largest amount by which the local coordinates of a point may leave the range from 0 to 1 in Newton's method."""

SECTOR_TOLERANCE = 1e-9
"""Amount by which a local coordinate must leave the range from 0 to 1 before a neighbouring sector is tried."""

PARAMETER_STEP = 1e-5
"""Step of the boundary parameter for the derivative of a curved boundary by central differences."""


class _Sides(NamedTuple):
    """Points of the inner and outer sides of elements, and their derivatives with respect to the angular coordinate.

    Attributes:
        inner: Points of the inner sides, shape (n,), in film radii.
        inner_derivative: Derivatives of `inner`, shape (n,).
        outer: Points of the outer sides, shape (n,), in film radii.
        outer_derivative: Derivatives of `outer`, shape (n,).
    """

    inner: Complexes
    inner_derivative: Complexes
    outer: Complexes
    outer_derivative: Complexes


class QuadCorners(NamedTuple):
    """Corners of quadrilateral elements as film points x + iy, in film radii.

    Attributes:
        a: First corner of the inner side.
        b: Second corner of the inner side, anticlockwise from a.
        c: First corner of the outer side.
        d: Second corner of the outer side, anticlockwise from c.
    """

    a: Complexes
    b: Complexes
    c: Complexes
    d: Complexes

    def of_elements(self, element: Integers) -> "QuadCorners":
        """Select the corners of one element for each point.

        Each field of this object has the shape (n_point, n_element), with one row of elements for each point.

        Args:
            element: Index of the element of each point, shape (n_point,).

        Returns:
            Corners of these elements, each of shape (n_point,).
        """
        row_of_point = np.arange(element.size)
        return QuadCorners(
            a=self.a[row_of_point, element],
            b=self.b[row_of_point, element],
            c=self.c[row_of_point, element],
            d=self.d[row_of_point, element],
        )


def locate_points(placement: Placement, blocks: Blocks, points: Complexes) -> tuple[Integers, Array, Array]:
    """Find the elements that contain film points. There are n points for each of k placements.

    Args:
        placement: One placement for each row of points.
        blocks: The elements.
        points: Film points, shape (k, n), in film radii. They lie in the upper half if only that half is meshed.

    Returns:
        Index of the element, xi and eta, each of shape (k, n).
    """
    # All points are first located as if they were in the rings. The points inside the circle are then located again.
    template_points = placement.to_template(points)
    element, radial, angular = _locate_in_rings(placement, blocks, template_points)
    is_inside = np.abs(template_points) <= placement.rho[:, None]
    if np.any(is_inside):
        placement_index, _ = np.nonzero(is_inside)
        placement_of_point = placement[placement_index]  # the placement of each inner point
        element[is_inside], radial[is_inside], angular[is_inside] = _locate_inside(
            placement_of_point, blocks, points[is_inside]
        )
    return element, 2.0 * radial - 1.0, 2.0 * angular - 1.0


def _locate_in_rings(placement: Placement, blocks: Blocks, template_points: Complexes) -> tuple[Integers, Array, Array]:
    """Locate points between the innermost circle and the rim.

    Args:
        placement: One placement for each row of points.
        blocks: The elements.
        template_points: Points of the template plane, shape (k, n).

    Returns:
        Index of the element and its radial and angular coordinate from 0 to 1, each of shape (k, n).
    """
    # Depth of each point: 0 on the innermost circle, 1 on the rim
    with np.errstate(divide="ignore"):  # the logarithm of the centre is infinite
        log_ratio = np.log(np.abs(template_points)) / np.log(placement.rho)[:, None]
    depth = np.clip(1.0 - log_ratio, 0.0, 1.0)

    # Ring of each point, from the number of ring edges that the point has passed
    edges_between_rings = placement.ring_depths[:, None, 1:-1]  # shape (k, 1, n_ring - 1)
    ring = np.sum(edges_between_rings <= depth[..., None], axis=-1)
    inner_edge = np.take_along_axis(placement.ring_depths, ring, axis=1)
    outer_edge = np.take_along_axis(placement.ring_depths, ring + 1, axis=1)
    radial = (depth - inner_edge) / (outer_edge - inner_edge)

    sector, angular = _locate_in_sectors(placement, blocks, np.angle(template_points), depth)
    element = blocks.n_inner + ring * blocks.n_sector + sector
    return element, radial, angular


def _locate_in_sectors(placement: Placement, blocks: Blocks, angle: Array, depth: Array) -> tuple[Integers, Array]:
    """Find the sectors of points between the innermost circle and the rim.

    Args:
        placement: One placement for each row of points.
        blocks: The elements.
        angle: Angles of the points in the template plane, shape (k, n), rad.
        depth: Depths of the points, from 0 on the innermost circle to 1 on the rim, shape (k, n).

    Returns:
        Index of the sector, and the angular coordinate in the sector from 0 to 1, each of shape (k, n).
    """
    if not blocks.half:  # count the angle from the first side, up to a full turn
        first_side = np.zeros(depth.shape, dtype=np.intp)
        angle_of_first_side = _side_angles(placement, first_side, depth)
        angle = angle_of_first_side + np.mod(angle - angle_of_first_side, 2.0 * np.pi)

    # The index of the sector is the number of sides between sectors that the angle of the point has passed.
    circle_angles = placement.circle_angles[:, None, 1:-1]  # shape (k, 1, n_sector - 1)
    rim_angles = placement.rim_angles[:, None, 1:-1]
    side_angles = circle_angles + depth[..., None] * (rim_angles - circle_angles)
    sector: Integers = np.sum(side_angles <= angle[..., None], axis=-1)
    side_before = _side_angles(placement, sector, depth)
    side_after = _side_angles(placement, sector + 1, depth)
    angular = (angle - side_before) / (side_after - side_before)
    return sector, angular


def _side_angles(placement: Placement, side: Integers, depth: Array) -> Array:
    """Return the angles (rad) of sides of the sectors at given depths between the innermost circle and the rim.

    Args:
        placement: One placement for each row of points.
        side: Index of the side for each point, shape (k, n).
        depth: Depth of each point, 0 on the innermost circle and 1 on the rim, shape (k, n).

    Returns:
        Angles, shape (k, n).
    """
    circle_angle = np.take_along_axis(placement.circle_angles, side, axis=1)
    rim_angle = np.take_along_axis(placement.rim_angles, side, axis=1)
    return np.asarray(circle_angle + depth * (rim_angle - circle_angle))


def _locate_inside(placement: Placement, blocks: Blocks, points: Complexes) -> tuple[Integers, Array, Array]:
    """Locate points inside the innermost circle. There is one point for each placement.

    The signed distance of a point from a side of an element is positive if both the point and the element lie on the
    same side of the straight line through this side. Each point is assigned to the element for which the smallest of
    its distances from the four sides is largest. Curved sides have an infinite distance, so that they are ignored.
    Elements that cannot contain the point get a negative infinite distance.

    Args:
        placement: One placement for each point.
        blocks: The elements.
        points: Film points, shape (n,), in film radii.

    Returns:
        Index of the element and its radial and angular coordinate from 0 to 1, each of shape (n,).
    """
    # Distance of each point from the four sides of each element, shape (n, n_inner). The corners a and b are on the
    # inner side of an element, c and d on its outer side.
    corners = _inner_corners(placement, blocks)
    point_column = points[:, None]
    distance_from_first_side = _distance_to_left(corners.a, corners.c, point_column)
    distance_from_last_side = _distance_to_left(corners.d, corners.b, point_column)
    distance_from_inner_side = _distance_to_left(corners.b, corners.a, point_column)
    distance_from_outer_side = _distance_to_left(corners.c, corners.d, point_column)

    # Ignore curved sides. With two layers, the boundary of the footprint decides between footprint and last layer.
    distance_from_outer_side[:, blocks.n_quad :] = np.inf
    if blocks.n_layer == 2:
        centroid = placement.corners[:, -1]
        in_footprint = placement.probe.contains((points - centroid) / placement.rotation_and_scale)
        distance_from_inner_side[:, blocks.last_layer] = np.inf
        distance_from_outer_side[~in_footprint, blocks.footprint] = -np.inf
        distance_from_outer_side[in_footprint, blocks.last_layer] = -np.inf

    distances = [
        distance_from_first_side,
        distance_from_last_side,
        distance_from_inner_side,
        distance_from_outer_side,
    ]
    smallest_distance = np.min(distances, axis=0)  # shape (n, n_inner)
    element = np.argmax(smallest_distance, axis=1)
    radial, angular = _invert_blend(placement, blocks, points, element, corners.of_elements(element))
    if blocks.n_layer == 2:
        _correct_sectors(placement, blocks, points, corners, element, radial, angular)
    return element, radial, angular


def _correct_sectors(
    placement: Placement,
    blocks: Blocks,
    points: Complexes,
    corners: QuadCorners,
    element: Integers,
    radial: Array,
    angular: Array,
) -> None:
    """Assign points that lie outside of the found element to another sector of the same layer.

    The straight sides of two sectors may cross outside of the elements. A point may then lie between the extended sides
    of a sector that does not contain the point. This occurs for elongated probes near the rim. The neighbouring sectors
    on both sides are tried, then the next neighbours, and so on.

    Args:
        placement: One placement for each point.
        blocks: The elements.
        points: Film points, shape (n,), in film radii.
        corners: Corners of all elements inside the innermost circle, each of shape (n, n_inner).
        element: Index of the element that was found for each point, shape (n,); changed in place.
        radial: Coordinates from the inner to the outer side, shape (n,); changed in place.
        angular: Coordinates along the sector, shape (n,); changed in place.
    """
    first_element = element.copy()  # because `element` changes in the loop
    for shift in range(1, blocks.n_sector // 2 + 1):
        is_outside = _overshoot(radial, angular) > SECTOR_TOLERANCE
        rows = np.flatnonzero(is_outside & (first_element >= blocks.n_quad))
        if rows.size == 0:
            return

        # Sector in its layer for each point that is outside of its element. Quadrilaterals have no sectors.
        row_corners = QuadCorners(*(corner[rows] for corner in corners))
        in_last_layer = first_element[rows] >= blocks.last_layer.start
        layer_start = np.where(in_last_layer, blocks.last_layer.start, blocks.n_quad)
        sector = first_element[rows] - layer_start

        # Try the sectors on both sides, and keep a sector in which the local coordinates overshoot less.
        for signed_shift in (shift, -shift):
            candidate = layer_start + (sector + signed_shift) % blocks.n_sector
            candidate_corners = row_corners.of_elements(candidate)
            new_radial, new_angular = _invert_blend(placement[rows], blocks, points[rows], candidate, candidate_corners)
            is_better = _overshoot(new_radial, new_angular) < _overshoot(radial[rows], angular[rows])
            better_rows = rows[is_better]
            element[better_rows] = candidate[is_better]
            radial[better_rows] = new_radial[is_better]
            angular[better_rows] = new_angular[is_better]


def _inner_corners(placement: Placement, blocks: Blocks) -> QuadCorners:
    """Return the corners of all elements inside the innermost circle.

    Corners on straight sides are weighted sums of the corners of the core polygon. The other corners lie on the
    innermost circle or on the boundary of the footprint.

    Args:
        placement: One or several placements.
        blocks: The elements.

    Returns:
        The four corners x + iy of each element, each of shape (n_placement, n_inner), in film radii.
    """
    # Sum over the corners n of the core polygon, for each element e, its corner k and each placement p.
    weighted_sums = np.einsum("ekn,pn->pek", blocks.straight, placement.corners)
    a, b, c, d = np.moveaxis(weighted_sums, -1, 0)

    # Replace the corners on curved lines: c and d are on the outer side of an element, a and b on its inner side.
    circle = placement.to_film(placement.rho[:, None] * np.exp(1j * placement.circle_angles))
    c[:, blocks.last_layer] = circle[:, :-1]
    d[:, blocks.last_layer] = circle[:, 1:]
    if blocks.n_layer == 2:
        boundary = placement.boundary(blocks.boundary_parameter)
        c[:, blocks.first_layer] = boundary[:, :-1]
        d[:, blocks.first_layer] = boundary[:, 1:]
        a[:, blocks.last_layer] = boundary[:, :-1]
        b[:, blocks.last_layer] = boundary[:, 1:]
    return QuadCorners(a, b, c, d)


def _invert_blend(
    placement: Placement, blocks: Blocks, points: Complexes, element: Integers, corners: QuadCorners
) -> tuple[Array, Array]:
    """Compute the local coordinates of points in given elements inside the innermost circle, by Newton's method.

    The film point with the coordinates (radial, angular) is (1 - radial) * inner(angular) + radial * outer(angular),
    where inner and outer are the two sides of the element.

    Args:
        placement: One placement for each point.
        blocks: The elements.
        points: Film points, shape (n,), in film radii.
        element: Index of the element that contains each point, shape (n,).
        corners: Corners of these elements, each of shape (n,).

    Returns:
        Radial and angular coordinate from 0 to 1, each of shape (n,).
    """
    radial = np.full(points.shape, 0.5)
    angular = np.full(points.shape, 0.5)
    for _ in range(NEWTON_STEPS):
        sides = _sides(placement, blocks, element, corners, angular)
        radial_derivative = sides.outer - sides.inner
        angular_derivative = (1.0 - radial) * sides.inner_derivative + radial * sides.outer_derivative
        residual = sides.inner + radial * radial_derivative - points

        # Newton step for two unknowns by Cramer's rule, with 2 x 2 determinants as products of complex numbers
        determinant = (np.conj(radial_derivative) * angular_derivative).imag
        radial_step = -(np.conj(residual) * angular_derivative).imag / determinant
        angular_step = -(np.conj(radial_derivative) * residual).imag / determinant
        radial = np.clip(radial + radial_step, -OVERSHOOT, 1.0 + OVERSHOOT)
        angular = np.clip(angular + angular_step, -OVERSHOOT, 1.0 + OVERSHOOT)
    return radial, angular


def _sides(placement: Placement, blocks: Blocks, element: Integers, corners: QuadCorners, angular: Array) -> _Sides:
    """Compute the points of the inner and the outer side of elements at given angular coordinates.

    Args:
        placement: One placement for each point.
        blocks: The elements.
        element: Index of the element of each point, shape (n,).
        corners: Corners of these elements, each of shape (n,).
        angular: Angular coordinate of each point from 0 to 1, shape (n,).

    Returns:
        Points of both sides and their derivatives with respect to the angular coordinate, each of shape (n,).
    """
    # The elements are ordered from the inside out: quadrilaterals of the core polygon, then the layers of sectors.
    in_sector = element >= blocks.n_quad
    in_last_layer = element >= blocks.last_layer.start
    sector = np.where(in_sector, (element - blocks.n_quad) % blocks.n_sector, 0)

    # Begin with straight sides, and replace those on the innermost circle.
    straight_inner_derivative = corners.b - corners.a
    straight_outer_derivative = corners.d - corners.c
    inner = corners.a + angular * straight_inner_derivative
    outer = corners.c + angular * straight_outer_derivative
    circle, circle_derivative = _circle_in_sector(placement, sector, angular)
    outer = np.where(in_last_layer, circle, outer)
    outer_derivative = np.where(in_last_layer, circle_derivative, straight_outer_derivative)
    if blocks.n_layer == 1:
        return _Sides(inner, straight_inner_derivative, outer, outer_derivative)

    # With two layers, the boundary of the footprint is the outer side of the first and the inner side of the last.
    boundary, boundary_derivative = _boundary_in_sector(placement, blocks, sector, angular)
    in_first_layer = in_sector & ~in_last_layer
    return _Sides(
        inner=np.where(in_last_layer, boundary, inner),
        inner_derivative=np.where(in_last_layer, boundary_derivative, straight_inner_derivative),
        outer=np.where(in_first_layer, boundary, outer),
        outer_derivative=np.where(in_first_layer, boundary_derivative, outer_derivative),
    )


def _circle_in_sector(placement: Placement, sector: Integers, angular: Array) -> tuple[Complexes, Complexes]:
    """Return points of the innermost circle and their derivatives with respect to the angular coordinate.

    Args:
        placement: One placement for each point.
        sector: Index of the sector of each point, shape (n,).
        angular: Position in the sector, from 0 to 1, shape (n,).

    Returns:
        Points and derivatives, each of shape (n,), in film radii.
    """
    # Angles of the first and the last side of the sector of each point
    first_angle = np.take_along_axis(placement.circle_angles, sector[:, None], axis=1)[:, 0]
    last_angle = np.take_along_axis(placement.circle_angles, (sector + 1)[:, None], axis=1)[:, 0]
    angle_range = last_angle - first_angle
    # z is a point of the template plane. The conformal map (z + c) / (1 + c z) converts it into a film point.
    z = placement.rho * np.exp(1j * (first_angle + angular * angle_range))
    points = (z + placement.c) / (1.0 + placement.c * z)
    derivative = 1j * angle_range * z * (1.0 - placement.c**2) / (1.0 + placement.c * z) ** 2
    return np.asarray(points), np.asarray(derivative)


def _boundary_in_sector(
    placement: Placement, blocks: Blocks, sector: Integers, angular: Array
) -> tuple[Complexes, Complexes]:
    """Return boundary points of a curved footprint and their derivatives with respect to the angular coordinate.

    Args:
        placement: One placement for each point.
        blocks: The elements.
        sector: Index of the sector of each point, shape (n,).
        angular: Position in the sector, from 0 to 1, shape (n,).

    Returns:
        Points and derivatives, each of shape (n,), in film radii.
    """
    first_parameter = blocks.boundary_parameter[sector]
    parameter_range = blocks.boundary_parameter[sector + 1] - first_parameter
    parameter = (first_parameter + angular * parameter_range)[:, None]
    point = placement.boundary(parameter)[:, 0]
    next_point = placement.boundary(parameter + PARAMETER_STEP)[:, 0]
    previous_point = placement.boundary(parameter - PARAMETER_STEP)[:, 0]
    parameter_derivative = (next_point - previous_point) / (2.0 * PARAMETER_STEP)
    angular_derivative = parameter_derivative * parameter_range
    return point, angular_derivative


def _overshoot(radial: Array, angular: Array) -> Array:
    """Return the signed distance of local coordinates from the range from 0 to 1, shape (n,).

    The distance is negative within the range.
    """
    distance_from_middle = np.maximum(np.abs(radial - 0.5), np.abs(angular - 0.5))
    return np.asarray(distance_from_middle - 0.5)


def _distance_to_left(start: Complexes, end: Complexes, points: Complexes) -> Array:
    """Return the signed distances of points from directed lines, positive to the left of a line.

    Args:
        start: Points x + iy at which the lines start, any shape.
        end: Points x + iy at which the lines end, same shape.
        points: Points x + iy, of a shape that broadcasts with that of the lines.
    """
    direction = end - start
    length = np.maximum(np.abs(direction), 1e-300)
    return np.asarray(((points - start) * np.conj(direction)).imag / length)
