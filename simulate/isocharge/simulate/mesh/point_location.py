"""Search for the elements that contain given film points.

For points outside the innermost circle, the elements are computed by closed formulas. For points inside the innermost
circle, the local coordinates are computed by Newton's method. The docstring of the module `placement` describes the
positions of the elements on the film.

In this module, each element has two local coordinates from 0 to 1. The radial coordinate increases from the inner side
to the outer side of the element. The angular coordinate increases anticlockwise.
"""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.simulate.mesh.blocks import Blocks
from isocharge.simulate.mesh.placement import Placement

NEWTON_STEPS = 20
"""Number of Newton steps with which a point inside the innermost circle is located.

In well-shaped blocks, six steps are sufficient.
"""

OVERSHOOT = 0.1
"""Largest distance of the local coordinates of a point from the range from 0 to 1 in Newton's method."""

SECTOR_TOLERANCE = 1e-9
"""Distance of a local coordinate from the range from 0 to 1 above which neighbouring sectors are tried."""

PARAMETER_STEP = 1e-5
"""Step of the boundary parameter for the derivative of a curved boundary by central differences."""


class _Sides(NamedTuple):
    """Points of the inner and outer sides of elements, and the derivatives of these points.

    The derivatives are taken with respect to the angular coordinate.

    Attributes:
        inner: Points x + iy of the inner sides, shape (n,), in film radii.
        inner_derivative: Derivatives of `inner`, shape (n,).
        outer: Points x + iy of the outer sides, shape (n,), in film radii.
        outer_derivative: Derivatives of `outer`, shape (n,).
    """

    inner: Complexes
    inner_derivative: Complexes
    outer: Complexes
    outer_derivative: Complexes


class QuadCorners(NamedTuple):
    """Corners of quadrilateral elements as film points x + iy, in film radii.

    The two corners of a side are in anticlockwise order.

    Attributes:
        inner_first: First corner of the inner side.
        inner_last: Last corner of the inner side.
        outer_first: First corner of the outer side.
        outer_last: Last corner of the outer side.
    """

    inner_first: Complexes
    inner_last: Complexes
    outer_first: Complexes
    outer_last: Complexes

    def of_elements(self, element: Integers) -> "QuadCorners":
        """Select the corners of one element for each point.

        The arrays of the object must have the shape (n_point, n_element), with one row of elements for each point.

        Args:
            element: Index of the element of each point, shape (n_point,).

        Returns:
            Corners of the selected elements, each of shape (n_point,).
        """
        row_of_point = np.arange(element.size)
        return QuadCorners(
            inner_first=self.inner_first[row_of_point, element],
            inner_last=self.inner_last[row_of_point, element],
            outer_first=self.outer_first[row_of_point, element],
            outer_last=self.outer_last[row_of_point, element],
        )


def locate_points(placement: Placement, blocks: Blocks, points: Complexes) -> tuple[Integers, Array, Array]:
    """Find the elements that contain film points, and the local coordinates of the points in their elements.

    Args:
        placement: k placements, one for each row of points.
        blocks: The elements.
        points: Film points x + iy, shape (k, n), in film radii. If only the upper half of the film is meshed, all
            points must lie in the upper half.

    Returns:
        Index of the element and local coordinates xi and eta from -1 to 1, each of shape (k, n).
    """
    # First locate all points as if they were in the rings. Then locate the points inside the innermost circle again.
    template_points = placement.to_template(points)
    element, radial, angular = _locate_in_rings(placement, blocks, template_points)
    is_inside = np.abs(template_points) <= placement.template_radius[:, None]
    if np.any(is_inside):
        placement_index, _ = np.nonzero(is_inside)
        placement_of_point = placement[placement_index]  # one placement for each point inside the circle
        element[is_inside], radial[is_inside], angular[is_inside] = _locate_inside(
            placement_of_point, blocks, points[is_inside]
        )

    # Convert the coordinates from the range from 0 to 1 to the range from -1 to 1.
    xi = 2.0 * radial - 1.0
    eta = 2.0 * angular - 1.0
    return element, xi, eta


def _locate_in_rings(placement: Placement, blocks: Blocks, template_points: Complexes) -> tuple[Integers, Array, Array]:
    """Find the elements that contain points between the innermost circle and the rim.

    Args:
        placement: k placements, one for each row of points.
        blocks: The elements.
        template_points: Points x + iy of the template plane, shape (k, n).

    Returns:
        Index of the element, and radial and angular coordinate in the element from 0 to 1, each of shape (k, n).
    """
    # Depth of each point, from 0 on the innermost circle to 1 on the rim. At the origin, the logarithm is infinite, and
    # the depth is clipped to 0.
    with np.errstate(divide="ignore"):
        log_ratio = np.log(np.abs(template_points)) / np.log(placement.template_radius)[:, None]
    depth = np.clip(1.0 - log_ratio, 0.0, 1.0)

    # The index of the ring is the number of edges between rings that lie inside of the point.
    edges_between_rings = placement.ring_depths[:, None, 1:-1]  # shape (k, 1, n_ring - 1)
    ring = np.sum(edges_between_rings <= depth[..., None], axis=-1)
    inner_edge = np.take_along_axis(placement.ring_depths, ring, axis=1)
    outer_edge = np.take_along_axis(placement.ring_depths, ring + 1, axis=1)
    radial = (depth - inner_edge) / (outer_edge - inner_edge)

    sector, angular = _locate_in_sectors(placement, blocks, np.angle(template_points), depth)
    element = blocks.n_inner + ring * blocks.n_sector + sector
    return element, radial, angular


def _locate_in_sectors(placement: Placement, blocks: Blocks, angle: Array, depth: Array) -> tuple[Integers, Array]:
    """Find the sectors that contain points between the innermost circle and the rim.

    Args:
        placement: k placements, one for each row of points.
        blocks: The elements.
        angle: Angles of the points in the template plane, shape (k, n), rad.
        depth: Depths of the points, from 0 on the innermost circle to 1 on the rim, shape (k, n).

    Returns:
        Index of the sector, and angular coordinate in the sector from 0 to 1, each of shape (k, n).
    """
    # If the whole film is meshed, add full turns such that each angle lies within one turn after the first side.
    if not blocks.half:
        first_side = np.zeros(depth.shape, dtype=np.intp)
        angle_of_first_side = _side_angles(placement, first_side, depth)
        angle = angle_of_first_side + np.mod(angle - angle_of_first_side, 2.0 * np.pi)

    # The index of the sector is the number of sides between sectors whose angles do not exceed the angle of the point.
    circle_angles = placement.circle_angles[:, None, 1:-1]  # shape (k, 1, n_sector - 1)
    rim_angles = placement.rim_angles[:, None, 1:-1]
    side_angles = circle_angles + depth[..., None] * (rim_angles - circle_angles)
    sector: Integers = np.sum(side_angles <= angle[..., None], axis=-1)

    angle_of_side_before = _side_angles(placement, sector, depth)
    angle_of_side_after = _side_angles(placement, sector + 1, depth)
    angular = (angle - angle_of_side_before) / (angle_of_side_after - angle_of_side_before)
    return sector, angular


def _side_angles(placement: Placement, side: Integers, depth: Array) -> Array:
    """Compute the angles of sides of the sectors at given depths between the innermost circle and the rim.

    Args:
        placement: k placements, one for each row of points.
        side: Index of the side for each point, shape (k, n).
        depth: Depth of each point, from 0 on the innermost circle to 1 on the rim, shape (k, n).

    Returns:
        Angles in the template plane, shape (k, n), rad.
    """
    circle_angle = np.take_along_axis(placement.circle_angles, side, axis=1)
    rim_angle = np.take_along_axis(placement.rim_angles, side, axis=1)
    return np.asarray(circle_angle + depth * (rim_angle - circle_angle))


def _locate_inside(placement: Placement, blocks: Blocks, points: Complexes) -> tuple[Integers, Array, Array]:
    """Find the elements that contain points inside the innermost circle.

    A straight line is drawn through each side of an element. The signed distance of a point from the line is positive
    if the point and the element lie on the same side of the line. Therefore the smallest of the four distances is
    positive for points inside an element with straight sides. Each point is assigned to the element for which the
    smallest of its four distances is largest.

    The elements with straight sides fill the core polygon. One or two layers of elements with curved sides surround the
    core polygon. If there are two layers, the edge of the footprint separates them.

    Args:
        placement: n placements, one for each point.
        blocks: The elements.
        points: Film points x + iy, shape (n,), in film radii.

    Returns:
        Index of the element, and radial and angular coordinate in the element from 0 to 1, each of shape (n,).
    """
    # Signed distance of each point from the four sides of each element, shape (n, n_inner). The first two arguments of
    # `_distance_to_left` are the start and the end of the side, with the element on the left.
    corners = _inner_corners(placement, blocks)
    point_column = points[:, None]
    distance_from_first_side = _distance_to_left(corners.inner_first, corners.outer_first, point_column)
    distance_from_last_side = _distance_to_left(corners.outer_last, corners.inner_last, point_column)
    distance_from_inner_side = _distance_to_left(corners.inner_last, corners.inner_first, point_column)
    distance_from_outer_side = _distance_to_left(corners.outer_first, corners.outer_last, point_column)

    # Ignore curved sides: a distance of infinity is never the smallest of the four distances. All outer sides outside
    # the core polygon may be curved. If there are two layers, the inner sides of the last layer are curved, too.
    distance_from_outer_side[:, blocks.n_quad :] = np.inf
    if blocks.n_layer == 2:
        distance_from_inner_side[:, blocks.last_layer] = np.inf

    distances = [
        distance_from_first_side,
        distance_from_last_side,
        distance_from_inner_side,
        distance_from_outer_side,
    ]
    smallest_distance = np.min(distances, axis=0)  # shape (n, n_inner)

    # If there are two layers, exclude the elements on the other side of the edge of the footprint. An element whose
    # distance is minus infinity is never chosen.
    if blocks.n_layer == 2:
        centroid = placement.corners[:, -1]
        is_in_footprint = placement.probe.contains((points - centroid) / placement.rotation_and_scale)
        smallest_distance[~is_in_footprint, blocks.footprint] = -np.inf
        smallest_distance[is_in_footprint, blocks.last_layer] = -np.inf
    element = np.argmax(smallest_distance, axis=1)
    radial, angular = _local_coordinates(placement, blocks, points, element, corners.of_elements(element))
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
    """Reassign points that lie outside their element to another sector of the same layer.

    The core polygon is surrounded by two layers of elements. The elements of a layer are called sectors. Each point was
    assigned to a sector by the straight lines through the sides of the sectors. These lines may cross outside the
    elements, so a point may lie between the lines of a sector that does not contain the point. For elongated probes
    near the rim, some points are therefore assigned to a wrong sector. The function tries the neighbouring sectors on
    both sides, then the next neighbours, and so on.

    Args:
        placement: n placements, one for each point.
        blocks: The elements.
        points: Film points x + iy, shape (n,), in film radii.
        corners: Corners of all elements inside the innermost circle, each of shape (n, n_inner).
        element: Index of the element to which each point is assigned, shape (n,); changed in place.
        radial: Radial coordinate in the element, shape (n,); changed in place.
        angular: Angular coordinate in the element, shape (n,); changed in place.
    """
    first_element = element.copy()  # the first assignment, because `element` changes in the loop
    for shift in range(1, blocks.n_sector // 2 + 1):
        # Select the points whose local coordinates exceed the range from 0 to 1, which means that the points lie
        # outside their element. The elements of the core polygon have the indices below `n_quad`, and are not sectors.
        is_outside = _overshoot(radial, angular) > SECTOR_TOLERANCE
        selected = np.flatnonzero(is_outside & (first_element >= blocks.n_quad))  # indices of the points
        if selected.size == 0:
            return  # no point needs to be reassigned any more

        # Find the index of the sector of each selected point within its layer.
        in_last_layer = first_element[selected] >= blocks.last_layer.start
        layer_start = np.where(in_last_layer, blocks.last_layer.start, blocks.n_quad)
        sector = first_element[selected] - layer_start

        # Try the sectors on both sides. Assign a point to a sector in which its local coordinates overshoot less.
        selected_corners = QuadCorners(*(corner[selected] for corner in corners))
        for signed_shift in (shift, -shift):
            candidate = layer_start + (sector + signed_shift) % blocks.n_sector
            candidate_corners = selected_corners.of_elements(candidate)
            new_radial, new_angular = _local_coordinates(
                placement[selected], blocks, points[selected], candidate, candidate_corners
            )
            is_better = _overshoot(new_radial, new_angular) < _overshoot(radial[selected], angular[selected])
            reassigned = selected[is_better]
            element[reassigned] = candidate[is_better]
            radial[reassigned] = new_radial[is_better]
            angular[reassigned] = new_angular[is_better]


def _inner_corners(placement: Placement, blocks: Blocks) -> QuadCorners:
    """Compute the corners of all elements inside the innermost circle.

    Corners on straight sides are weighted sums of the corners and the centroid of the core polygon. All other corners
    lie on the innermost circle or on the boundary of the footprint.

    Args:
        placement: One or several placements.
        blocks: The elements.

    Returns:
        The four corners of each element, each of shape (n_placement, n_inner).
    """
    # Sum over the corners n of the core polygon, for each element e, its corner k and each placement p.
    weighted_sums = np.einsum("ekn,pn->pek", blocks.inner_corner_weights, placement.corners)
    inner_first, inner_last, outer_first, outer_last = np.moveaxis(weighted_sums, -1, 0)

    # Replace the corners of the last layer on the innermost circle.
    circle = placement.to_film(placement.template_radius[:, None] * np.exp(1j * placement.circle_angles))
    outer_first[:, blocks.last_layer] = circle[:, :-1]
    outer_last[:, blocks.last_layer] = circle[:, 1:]

    # Replace the corners on the boundary of the footprint, which separates the layers if there are two.
    if blocks.n_layer == 2:
        boundary = placement.boundary(blocks.boundary_parameter)
        outer_first[:, blocks.first_layer] = boundary[:, :-1]
        outer_last[:, blocks.first_layer] = boundary[:, 1:]
        inner_first[:, blocks.last_layer] = boundary[:, :-1]
        inner_last[:, blocks.last_layer] = boundary[:, 1:]
    return QuadCorners(inner_first, inner_last, outer_first, outer_last)


def _local_coordinates(
    placement: Placement, blocks: Blocks, points: Complexes, element: Integers, corners: QuadCorners
) -> tuple[Array, Array]:
    """Compute the local coordinates of points in given elements inside the innermost circle by Newton's method.

    The film point with the coordinates (radial, angular) is (1 - radial) * inner(angular) + radial * outer(angular).
    The functions inner and outer return the points of the inner and the outer side at a given angular coordinate.

    Args:
        placement: n placements, one for each point.
        blocks: The elements.
        points: Film points x + iy, shape (n,), in film radii.
        element: Index of the element that contains each point, shape (n,).
        corners: Corners of these elements, each of shape (n,).

    Returns:
        Radial coordinate and angular coordinate, each of shape (n,). They are between 0 and 1 for points inside the
        element.
    """
    radial = np.full(points.shape, 0.5)
    angular = np.full(points.shape, 0.5)
    for _ in range(NEWTON_STEPS):
        sides = _sides(placement, blocks, element, corners, angular)
        radial_derivative = sides.outer - sides.inner
        angular_derivative = (1.0 - radial) * sides.inner_derivative + radial * sides.outer_derivative
        residual = sides.inner + radial * radial_derivative - points

        # Newton step for two unknowns by Cramer's rule. The determinant of two plane vectors is the imaginary part of
        # the product of the conjugate of the first vector and the second vector.
        determinant = (np.conj(radial_derivative) * angular_derivative).imag
        radial_step = -(np.conj(residual) * angular_derivative).imag / determinant
        angular_step = -(np.conj(radial_derivative) * residual).imag / determinant
        radial = np.clip(radial + radial_step, -OVERSHOOT, 1.0 + OVERSHOOT)
        angular = np.clip(angular + angular_step, -OVERSHOOT, 1.0 + OVERSHOOT)
    return radial, angular


def _sides(placement: Placement, blocks: Blocks, element: Integers, corners: QuadCorners, angular: Array) -> _Sides:
    """Compute the points of the inner and the outer side of elements at given angular coordinates.

    The derivatives of the points with respect to the angular coordinate are also returned.

    Args:
        placement: n placements, one for each point.
        blocks: The elements.
        element: Index of the element of each point, shape (n,).
        corners: Corners of these elements, each of shape (n,).
        angular: Angular coordinate of each point from 0 to 1, shape (n,).
    """
    # The elements of the core polygon have the lowest indices, followed by the sectors of each layer. The sector of an
    # element of the core polygon is not used, and is set to 0.
    in_sector = element >= blocks.n_quad
    in_last_layer = element >= blocks.last_layer.start
    sector = np.where(in_sector, (element - blocks.n_quad) % blocks.n_sector, 0)

    # Compute straight sides for all elements, and replace the outer sides that lie on the innermost circle.
    straight_inner_derivative = corners.inner_last - corners.inner_first
    straight_outer_derivative = corners.outer_last - corners.outer_first
    straight_inner = corners.inner_first + angular * straight_inner_derivative
    straight_outer = corners.outer_first + angular * straight_outer_derivative
    circle, circle_derivative = _circle_in_sector(placement, sector, angular)
    outer = np.where(in_last_layer, circle, straight_outer)
    outer_derivative = np.where(in_last_layer, circle_derivative, straight_outer_derivative)
    if blocks.n_layer == 1:
        return _Sides(straight_inner, straight_inner_derivative, outer, outer_derivative)

    # If there are two layers, the boundary of the footprint is the outer side of the first layer and the inner side of
    # the last layer.
    boundary, boundary_derivative = _boundary_in_sector(placement, blocks, sector, angular)
    in_first_layer = in_sector & ~in_last_layer
    return _Sides(
        inner=np.where(in_last_layer, boundary, straight_inner),
        inner_derivative=np.where(in_last_layer, boundary_derivative, straight_inner_derivative),
        outer=np.where(in_first_layer, boundary, outer),
        outer_derivative=np.where(in_first_layer, boundary_derivative, outer_derivative),
    )


def _circle_in_sector(placement: Placement, sector: Integers, angular: Array) -> tuple[Complexes, Complexes]:
    """Compute points of the innermost circle, and the derivatives of the points with respect to the angular coordinate.

    Args:
        placement: n placements, one for each point.
        sector: Index of the sector of each point, shape (n,).
        angular: Angular coordinate of each point in its sector, from 0 to 1, shape (n,).

    Returns:
        Points x + iy and derivatives, each of shape (n,), in film radii.
    """
    # Angles of the first and the last side of the sector of each point
    first_angle = np.take_along_axis(placement.circle_angles, sector[:, None], axis=1)[:, 0]
    last_angle = np.take_along_axis(placement.circle_angles, (sector + 1)[:, None], axis=1)[:, 0]
    angle_range = last_angle - first_angle

    # The conformal map converts a point z of the template plane into the film point (z + c) / (1 + c z).
    template_points = placement.template_radius * np.exp(1j * (first_angle + angular * angle_range))
    denominator = 1.0 + placement.map_parameter * template_points
    points = (template_points + placement.map_parameter) / denominator
    derivative = 1j * angle_range * template_points * (1.0 - placement.map_parameter**2) / denominator**2
    return np.asarray(points), np.asarray(derivative)


def _boundary_in_sector(
    placement: Placement, blocks: Blocks, sector: Integers, angular: Array
) -> tuple[Complexes, Complexes]:
    """Compute boundary points of a curved footprint, and the derivatives with respect to the angular coordinate.

    Args:
        placement: n placements, one for each point.
        blocks: The elements.
        sector: Index of the sector of each point, shape (n,).
        angular: Angular coordinate of each point in its sector, from 0 to 1, shape (n,).

    Returns:
        Points x + iy and derivatives, each of shape (n,), in film radii.
    """
    # The boundary parameter is a linear function of the angular coordinate.
    first_parameter = blocks.boundary_parameter[sector]
    parameter_range = blocks.boundary_parameter[sector + 1] - first_parameter
    parameter = (first_parameter + angular * parameter_range)[:, None]  # shape (n, 1), one point for each placement
    points = placement.boundary(parameter)[:, 0]

    # The derivative with respect to the boundary parameter is a central difference.
    next_points = placement.boundary(parameter + PARAMETER_STEP)[:, 0]
    previous_points = placement.boundary(parameter - PARAMETER_STEP)[:, 0]
    parameter_derivative = (next_points - previous_points) / (2.0 * PARAMETER_STEP)
    angular_derivative = parameter_derivative * parameter_range
    return points, angular_derivative


def _overshoot(radial: Array, angular: Array) -> Array:
    """Compute by how much local coordinates exceed the range from 0 to 1.

    Args:
        radial: Radial coordinates, shape (n,).
        angular: Angular coordinates, shape (n,).

    Returns:
        Larger excess of the two coordinates, shape (n,). It is negative if both coordinates lie within the range.
    """
    distance_from_middle = np.maximum(np.abs(radial - 0.5), np.abs(angular - 0.5))
    return np.asarray(distance_from_middle - 0.5)


def _distance_to_left(start: Complexes, end: Complexes, points: Complexes) -> Array:
    """Compute the signed distances of points from directed lines. The distance is positive to the left of a line.

    Args:
        start: Points x + iy at which the lines start, any shape.
        end: Points x + iy at which the lines end, same shape.
        points: Points x + iy, of a shape that can be broadcast with the shape of the lines.
    """
    direction = end - start
    length = np.maximum(np.abs(direction), 1e-300)  # the limit avoids a division by zero
    cross_product = ((points - start) * np.conj(direction)).imag
    return np.asarray(cross_product / length)
