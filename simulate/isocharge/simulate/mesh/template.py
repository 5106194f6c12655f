"""Mesh templates with numbered nodes, and the search for the elements that contain given points.

A template is the same for all positions of a probe. `locate_points` finds the elements that contain given film points.
For points outside the innermost circle, the elements are computed by closed formulas. For points inside the innermost
circle, the local coordinates are computed by Newton's method. The docstring of the module `placement` describes the
positions of the elements on the film. In the search, each element has two local coordinates from 0 to 1. The radial
coordinate increases from the inner side to the outer side of the element. The angular coordinate increases
anticlockwise.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.mesh.blocks import Blocks, Resolution
from isocharge.simulate.mesh.placement import Placement, interpolate
from isocharge.simulate.numerics.polygon import cross_product
from isocharge.simulate.sensor.footprint import FootprintTopology
from isocharge.simulate.sensor.probe import RoundProbe

SAMPLE_REACH = 0.1
"""Radius of the circular footprint of the sample press, in film radii.

If nodes of different elements coincide under the sample press, they are the same node.
"""

SAMPLE_DISTANCE = 0.1
"""Distance of the sample press from the centre of the film, in film radii."""

SAMPLE_LAYER = 0.05
"""Width of the thin rings at the rim under the sample press, in film radii."""


@dataclass(frozen=True)
class SampleProbe(RoundProbe):
    """Probe of the sample press, with a circular footprint that has the topology of another footprint.

    Attributes:
        radius: Radius of the circle, mm.
        other_topology: Topology of the other footprint.
    """

    other_topology: FootprintTopology

    @property
    def topology(self) -> FootprintTopology:
        """Topology of the other footprint."""
        return self.other_topology


class Template(Blocks):
    """Elements with numbered nodes. Adjacent elements share the nodes on their common side.

    Attributes:
        nodes: Number of each node of each element, shape (n_element, (order + 1)^2).
        n_node: Number of nodes.
        first_occurrence: Index of the first occurrence of each node among the nodes of all elements, shape (n_node,).
        is_interior: Whether each node of an element lies in the interior of the element, shape ((order + 1)^2,).
        on_rim: Whether each node lies on the rim, shape (n_node,).
        on_axis: Whether each node lies on the line of symmetry of a half mesh, shape (n_node,).
    """

    def __init__(self, resolution: Resolution, topology: FootprintTopology, whole: bool = False) -> None:
        """Count the elements, which the constructor of the base class does, and number their nodes.

        Nodes of different elements count as one node if they have the same position under a sample press.

        Args:
            resolution: Fineness of the mesh.
            topology: Number and kind of the blocks in and around the footprint.
            whole: Whether to mesh the whole film even if the footprint is symmetric.
        """
        super().__init__(resolution, topology, whole)
        # No element is folded under the sample press. Therefore two nodes have the same position only if they are the
        # same node. The film has the radius 1, and SAMPLE_LAYER is the total width of the thin rings at its rim. The
        # placement reads only the elements of this object, which have been counted, and not the nodes.
        probe = SampleProbe(SAMPLE_REACH, topology)
        placement = Placement.of(self, probe, np.array(SAMPLE_DISTANCE), 1.0, SAMPLE_LAYER)
        element_points = placement.element_points(self)  # x + iy in film radii, shape (n_element, n_local)
        all_points = element_points.ravel()
        rounded_points = np.round(all_points, 9)  # positions of the same node may differ by rounding errors
        _, self.first_occurrence, node_number = np.unique(rounded_points, return_index=True, return_inverse=True)
        self.nodes: Integers = node_number.reshape(element_points.shape)
        self.n_node = self.first_occurrence.size
        # The local coordinates xi and eta of a node are -1 or 1 on the sides of its element.
        self.is_interior = np.maximum(np.abs(self.xi), np.abs(self.eta)) < 1.0

        # Find the nodes on the rim, and the nodes on the line of symmetry of a half mesh.
        node_points = all_points[self.first_occurrence]
        self.on_rim = np.abs(node_points) > 1.0 - 1e-9
        self.on_axis = (np.abs(node_points.imag) < 1e-9) & self.half


template_for = lru_cache(maxsize=16)(Template)
"""Function that returns the template for a given resolution and topology. Templates are cached."""


def locate_points(placement: Placement, blocks: Blocks, points: Complexes) -> tuple[Integers, Array, Array, Booleans]:
    """Find the elements that contain film points, and the local coordinates of the points in their elements.

    Args:
        placement: Positions of the mesh under k presses, one for each row of points.
        blocks: The elements of the mesh.
        points: Film points x + iy, shape (k, n), in film radii. If only the upper half of the film is meshed, points in
            the lower half are reflected.

    Returns:
        Index of the element, local coordinates xi and eta from -1 to 1, and whether the point was reflected, each of
        shape (k, n).
    """
    # Convert the points into points of the meshed part of a circular film.
    circular_points, is_reflected = blocks.into_meshed_half(placement.to_circular_film(points))

    # First locate all points as if they were in the rings. Then locate the points inside the innermost circle again.
    template_points = placement.to_template(circular_points)
    element, coordinates = _locate_in_rings(placement, blocks, template_points)
    is_inside = np.abs(template_points) <= placement.template_radius[:, None]
    if np.any(is_inside):
        # The corners of the elements are the same for all points of a row, and are computed once for each row.
        row_of_point, _ = np.nonzero(is_inside)  # for each point inside the circle
        rows, index_in_rows = np.unique(row_of_point, return_inverse=True)  # rows[index_in_rows] is row_of_point
        corners_of_rows = _inner_corners(placement[rows], blocks)
        element[is_inside], coordinates[:, is_inside] = _locate_inside(
            placement[row_of_point], blocks, circular_points[is_inside], corners_of_rows[index_in_rows]
        )

    # Convert the coordinates from the range from 0 to 1 to the range from -1 to 1.
    xi, eta = 2.0 * coordinates - 1.0
    return element, xi, eta, is_reflected


def _locate_in_rings(placement: Placement, blocks: Blocks, template_points: Complexes) -> tuple[Integers, Array]:
    """Find the elements that contain points between the innermost circle of the mesh and the rim of the film.

    Between the circle and the rim, the mesh consists of rings, which are divided into sectors. The depth of a point
    determines its ring, and the angle of the point determines its sector. The depth increases from 0 on the innermost
    circle to 1 on the rim, in proportion to the logarithm of the distance from the origin of the template plane.

    Args:
        placement: Positions of the mesh under k presses, one for each row of points.
        blocks: The elements of the mesh.
        template_points: Points x + iy of the template plane, which is a unit disk that represents the film, shape
            (k, n).

    Returns:
        Index of the element, shape (k, n). Radial and angular coordinate in the element from 0 to 1, shape (2, k, n).
    """
    # Find the rings. `_locate_in_intervals` expects the edges of the intervals along the first axis, so the arrays of
    # the placement are transposed, and an axis is added for the n points of each row.
    depth = placement.depth(template_points)
    ring_edges = placement.ring_depths.T[..., None]  # shape (n_ring + 1, k, 1)
    ring, radial = _locate_in_intervals(ring_edges, depth)

    # Compute the angles at which the sides of the sectors lie at the depths of the points. Along a side, the angle
    # changes linearly with the depth, from its value on the innermost circle to its value on the rim.
    circle_angles = placement.circle_angles.T[..., None]  # shape (n_sector + 1, k, 1)
    rim_angles = placement.rim_angles.T[..., None]
    side_angles = interpolate(circle_angles, rim_angles, depth)  # shape (n_sector + 1, k, n)

    # Find the sectors. If the whole film is meshed, and not only its upper half, add full turns such that each angle
    # lies within one turn after the first side.
    angle = np.angle(template_points)
    if not blocks.half:
        angle = side_angles[0] + np.mod(angle - side_angles[0], math.tau)
    sector, angular = _locate_in_intervals(side_angles, angle)

    # The elements inside the innermost circle are numbered before the sectors of all rings.
    element = blocks.n_inner + ring * blocks.n_sector + sector
    return element, np.stack([radial, angular])


def _locate_in_intervals(edges: Array, values: Array) -> tuple[Integers, Array]:
    """Find the interval that contains each value. A value outside all intervals is assigned to the nearest interval.

    Args:
        edges: Edges of adjacent intervals in increasing order, shape (n_interval + 1, k, n) or (n_interval + 1, k, 1).
        values: The values, shape (k, n).

    Returns:
        Index of the interval, and coordinate from 0 at the start to 1 at the end of the interval, each of shape (k, n).
    """
    # The index of the interval is the number of inner edges that do not exceed the value.
    index = np.sum(edges[1:-1] <= values, axis=0)
    start, end = np.take_along_axis(edges, np.stack([index, index + 1]), axis=0)
    return index, (values - start) / (end - start)


def _locate_inside(
    placement: Placement, blocks: Blocks, points: Complexes, corners: Complexes
) -> tuple[Integers, Array]:
    """Find the elements that contain points inside the innermost circle of the mesh.

    A straight line is drawn through each side of an element. The signed distance of a point from the line is positive
    if the point and the element lie on the same side of the line. For points inside an element with straight sides, the
    smallest of the four distances is therefore positive. For each point, the elements are sorted by the smallest of
    their four distances. The element with the largest value is tried first. Most points lie in the first element that
    is tried. Near curved sides, further elements may have to be tried.

    Args:
        placement: n placements, one for each point.
        blocks: The elements.
        points: Film points x + iy, shape (n,), in film radii.
        corners: Corners x + iy of all elements for each point, shape (n, n_inner, 4): the first and the last corner of
            the inner side, and the first and the last corner of the outer side.

    Returns:
        Index of the element, shape (n,). Radial and angular coordinate in the element from 0 to 1, shape (2, n).
    """
    # The first corners of an element lie clockwise of its last corners. The start and the end of each side are ordered
    # such that the element lies on the left of the side. The four sides are the side through both first corners, the
    # side through both last corners, the inner side and the outer side.
    inner_first, inner_last, outer_first, outer_last = np.moveaxis(corners, -1, 0)
    sides = ((inner_first, outer_first), (outer_last, inner_last), (inner_last, inner_first), (outer_first, outer_last))
    distances = [_distance_to_left(start, end, points[:, None]) for start, end in sides]
    smallest_distance = np.min(distances, axis=0)  # shape (n, n_inner)
    candidates = np.argsort(-smallest_distance, axis=1)

    # Try the elements. For each point, keep the element in which the coordinates exceed the range from 0 to 1 least.
    # `_overshoot` returns by how much they exceed the range. At first, no coordinates are known, so they are infinite.
    best_element = candidates[:, 0]
    best_coordinates = np.full((2, points.size), np.inf)
    for candidate in candidates.T:
        # A point is found if its coordinates lie in the range. The tolerance 1e-9 is for rounding errors.
        remaining = np.flatnonzero(_overshoot(best_coordinates) > 1e-9)
        if remaining.size == 0:
            break
        tried_element = candidate[remaining]
        new_coordinates = _local_coordinates(placement[remaining], blocks, points[remaining], tried_element)
        is_better = _overshoot(new_coordinates) < _overshoot(best_coordinates[:, remaining])
        improved = remaining[is_better]
        best_element[improved] = tried_element[is_better]
        best_coordinates[:, improved] = new_coordinates[:, is_better]
    return best_element, best_coordinates


def _inner_corners(placement: Placement, blocks: Blocks) -> Complexes:
    """Return the corners of all elements inside the innermost circle.

    Args:
        placement: Positions of the mesh under n presses.
        blocks: The elements.

    Returns:
        Corners x + iy, shape (n, n_inner, 4), in film radii. The four corners of an element are the first and the last
        corner of the inner side, and the first and the last corner of the outer side.
    """
    # The corners are the ends of the inner and the outer side, at the angular coordinates 0 and 1. The sides of all
    # elements are computed for each placement. The angular coordinate increases anticlockwise.
    n_placement = len(placement.template_radius)
    placement_index = np.repeat(np.arange(n_placement), blocks.n_inner)
    element = np.tile(np.arange(blocks.n_inner), n_placement)
    # Ends of the inner and of the outer side, each of shape (n * n_inner, 2)
    inner_and_outer_ends = placement[placement_index].sides(blocks, element, np.array([[0.0, 1.0]]))
    return np.concatenate(inner_and_outer_ends, axis=1).reshape(n_placement, blocks.n_inner, 4)


def _local_coordinates(placement: Placement, blocks: Blocks, points: Complexes, element: Integers) -> Array:
    """Compute the local coordinates of points in given elements inside the innermost circle by Newton's method.

    A point with the radial coordinate r lies on the straight line between two points with the same angular coordinate:
    the point I of the inner side and the point O of the outer side. The position of the point is (1 - r) I + r O.

    Args:
        placement: n placements, one for each point.
        blocks: The elements.
        points: Film points x + iy, shape (n,), in film radii.
        element: Index of the element that contains each point, shape (n,).

    Returns:
        Radial coordinate and angular coordinate, shape (2, n). Both coordinates are between 0 and 1 for points inside
        the element.
    """
    step_size = 1e-5  # of the angular coordinate, for the derivative of the sides by central differences
    coordinates = np.full((2, points.size), 0.5)
    for _ in range(20):  # three to six steps are typical
        # Evaluate the sides at the angular coordinate, and before and after it for the central differences.
        radial, angular = coordinates
        shifted_angular = angular[:, None] + np.array([0.0, -step_size, step_size])
        inner, outer = placement.sides(blocks, element, shifted_angular)
        shifted_points = interpolate(inner, outer, radial[:, None])
        current, before, after = shifted_points.T
        residual = current - points
        radial_derivative = outer[:, 0] - inner[:, 0]
        angular_derivative = (after - before) / (2.0 * step_size)

        # Newton step for two unknowns by Cramer's rule
        determinant = cross_product(radial_derivative, angular_derivative)
        radial_numerator = cross_product(residual, angular_derivative)
        angular_numerator = cross_product(radial_derivative, residual)
        step = -np.stack([radial_numerator, angular_numerator]) / determinant
        new_coordinates = np.clip(coordinates + step, -0.1, 1.1)  # the point may leave the element a little
        largest_step = np.abs(new_coordinates - coordinates).max()
        coordinates = new_coordinates
        if largest_step < 1e-13:  # the steps of all points are rounding errors
            break
    return coordinates


def _overshoot(coordinates: Array) -> Array:
    """Compute by how much local coordinates exceed the range from 0 to 1.

    Args:
        coordinates: Radial and angular coordinates, shape (2, n).

    Returns:
        Larger of the two excesses, shape (n,). The excess is negative if both coordinates lie within the range.
    """
    return np.asarray(np.abs(coordinates - 0.5).max(axis=0) - 0.5)


def _distance_to_left(start: Complexes, end: Complexes, points: Complexes) -> Array:
    """Compute the signed distances of points from directed lines. The distance is positive to the left of a line.

    Args:
        start: Points x + iy at which the lines start, any shape.
        end: Points x + iy at which the lines end, same shape.
        points: Points x + iy, of a shape that can be broadcast with the shape of the lines.
    """
    direction = end - start
    length = np.maximum(np.abs(direction), 1e-300)  # the limit avoids a division by zero
    return cross_product(direction, points - start) / length
