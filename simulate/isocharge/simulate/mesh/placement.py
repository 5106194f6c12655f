"""Positions of the elements on the film for a given position of the probe.

All lengths are in film radii, and all angles are in radians. Outside an innermost circle around the probe, the module
`conformal_map` determines the positions of the elements.

Inside the innermost circle, the points of an element are interpolated linearly between the inner and the outer side of
the element. The sides of the elements lie on the core polygon, on the boundary of the footprint and on the innermost
circle. The edges of a polygonal footprint remain straight, so the load is integrated exactly over the footprint. The
values of fields at the nodes are smooth functions of the position of the probe.

The class `Placement` combines these steps for one or several presses on a circular film. If the clamp is oval, the
class then displaces the points. All points inside the innermost circle have the same displacement, so the footprint
keeps its shape. In the rings, the displacement changes gradually from the displacement of the footprint to the
displacement of the rim (`oval.oval_displacement`). The function `template.locate_points` finds the element that
contains a film point.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.simulate.mesh.blocks import Blocks
from isocharge.simulate.mesh.conformal_map import (
    automorphism_onto,
    enclosing_circle,
    map_stretch,
    rim_angles,
    ring_edges,
    sector_angles,
)
from isocharge.simulate.mesh.oval import circular_distance, oval_displacement
from isocharge.simulate.sensor.footprint import CurvedProbe, Probe


@dataclass(frozen=True)
class Placement:
    """Position of a mesh template on the film, or several positions along the leading axes of the arrays.

    Attributes:
        map_parameter: Parameter c of the conformal map, shape (...).
        template_radius: Radius of the innermost circle in the template plane, shape (...).
        corners: Corners of the core polygon, followed by its centroid, as points x + iy of the circular film, in film
            radii, shape (..., n_corner + 1).
        circle_angles: Angles at which the sides of the sectors meet the innermost circle in the template plane, shape
            (..., n_sector + 1), rad.
        rim_angles: Angles at which the sides of the sectors meet the rim in the template plane, shape
            (..., n_sector + 1), rad.
        ring_depths: Depths of the edges of the rings, from 0 on the innermost circle to 1 on the rim, shape
            (..., n_ring + 1).
        rotation_and_scale: Complex factor for points of the footprint relative to its centroid, shape (...). The factor
            rotates the points by the additional rotation of the footprint, and converts them from mm to film radii.
        probe: The probe.
        oval: Complex number that describes the clamp in the frame of the press, shape (...); see the module `oval`.
        footprint_displacement: Displacement of the footprint from the circular film to the real film along the x axis,
            shape (...), in film radii. The displacement is zero if the clamp is circular.
    """

    map_parameter: Array
    template_radius: Array
    corners: Complexes
    circle_angles: Array
    rim_angles: Array
    ring_depths: Array
    rotation_and_scale: Complexes
    probe: Probe
    oval: Complexes
    footprint_displacement: Array

    @classmethod
    def of(
        cls,
        blocks: Blocks,
        probe: Probe,
        distance: Array,
        film_radius: float,
        thin_ring_width: float,
        rotation: Array | float = 0.0,
        oval: complex | Complexes = 0.0,
    ) -> Self:
        """Place a mesh template under a press on the positive x axis.

        The innermost circle of the mesh encloses the footprint of the probe. The method determines this circle, the
        conformal map that converts the template plane into the film, and the angles and depths of the elements between
        the circle and the rim. If the clamp of the real film is oval, the mesh is first created on a circular film, and
        its points are displaced later.

        Args:
            blocks: The elements, which must have the topology of the probe.
            probe: The probe in the frame in which the press lies on the positive x axis.
            distance: Distance of the centroid of the footprint from the centre of the real film, any shape, mm.
            film_radius: Radius of the film, mm.
            thin_ring_width: Total width of the thin rings at the rim, in film radii.
            rotation: Additional rotation of the footprint, a number or of the shape of `distance`, rad.
            oval: Complex number that describes the clamp in the frame of the press, a number or of the shape of
                `distance`.
        """
        # Compute the position of the centroid on the real film and on the circular film. Both are coordinates on the x
        # axis, because the press lies on this axis.
        displaced_centroid = distance / film_radius
        reach = probe.reach / film_radius
        centroid = circular_distance(displaced_centroid, np.asarray(oval), reach)

        # Compute the corners of the core polygon on the circular film, followed by the centroid of the footprint.
        rotation_factor: Complexes = np.exp(1j * np.broadcast_to(rotation, centroid.shape))
        rotation_and_scale = rotation_factor / film_radius
        core_corners = _on_film(probe.core(), centroid, rotation_and_scale)
        corners = np.concatenate([core_corners, centroid[..., None]], axis=-1)

        # The innermost circle is the boundary of a circular footprint, or encloses the footprint with a gap.
        if probe.topology.fills_circle:
            centre = centroid
            radius = np.full(centroid.shape, reach)
        else:
            outline = _on_film(probe.outline, centroid, rotation_and_scale)
            centre, radius = enclosing_circle(outline, centroid)

        # The last layer of elements inside the circle connects the circle to an inner boundary. With one layer, the
        # inner boundary is the edge of the core polygon. `inner_points` are its middles of edges and its corners.
        inner_points: Complexes = np.asarray(corners @ blocks.half_edge_ends.T)
        if blocks.n_layer == 2:
            # The inner boundary is the edge of the footprint. The elements of the first layer connect the ends of the
            # half edges to these points. There are `n_half_edge` elements along each half edge.
            assert isinstance(probe, CurvedProbe)
            parameter_of_half_edge_ends = blocks.boundary_parameter[:: blocks.n_half_edge]
            boundary = probe.boundary(parameter_of_half_edge_ends)
            inner_points = _on_film(boundary, centroid, rotation_and_scale)

        # Compute the conformal map of the innermost circle, and the angles and depths of the elements around it.
        map_parameter, template_radius = automorphism_onto(centre, radius)
        circle_stretch = map_stretch(map_parameter, template_radius)
        circle_angles = sector_angles(blocks, inner_points, centroid, centre, radius, circle_stretch)
        template_thin_ring_width = thin_ring_width * map_stretch(map_parameter, 1.0)
        return cls(
            map_parameter=map_parameter,
            template_radius=template_radius,
            corners=corners,
            circle_angles=circle_angles,
            rim_angles=rim_angles(circle_angles, map_parameter, template_radius),
            ring_depths=ring_edges(blocks.resolution, template_radius, template_thin_ring_width),
            rotation_and_scale=rotation_and_scale,
            probe=probe,
            oval=np.asarray(oval),
            footprint_displacement=displaced_centroid - centroid,
        )

    def __getitem__(self, indices: Integers | None) -> "Placement":
        """Select placements by their indices along the first axis of the arrays.

        The index None adds a first axis of length one.
        """
        arrays: dict[str, Any] = {
            field.name: getattr(self, field.name)[indices] for field in fields(self) if field.name != "probe"
        }
        return replace(self, **arrays)

    def to_film(self, z: Complexes) -> Complexes:
        """Convert points of the template plane into points of the circular film by the conformal map.

        Args:
            z: Points x + iy of the template plane, shape (..., n).

        Returns:
            Points of the circular film, shape (..., n), in film radii.
        """
        map_parameter = self.map_parameter[..., None]
        return (z + map_parameter) / (1.0 + map_parameter * z)

    def to_template(self, points: Complexes) -> Complexes:
        """Convert points of the circular film into points of the template plane by the inverse of the conformal map.

        Args:
            points: Points x + iy of the circular film, shape (..., n), in film radii.

        Returns:
            Points of the template plane, shape (..., n).
        """
        map_parameter = self.map_parameter[..., None]
        return (points - map_parameter) / (1.0 - map_parameter * points)

    def depth(self, template_points: Complexes) -> Array:
        """Compute the depths of points in the rings, from 0 on the innermost circle to 1 on the rim.

        Args:
            template_points: Points x + iy of the template plane, shape (..., n).

        Returns:
            Depths, shape (..., n). The depth is zero inside the innermost circle.
        """
        with np.errstate(divide="ignore"):  # at the origin, the logarithm is infinite, and the depth is clipped to 0
            log_ratio = np.log(np.abs(template_points)) / np.log(self.template_radius)[..., None]
        return np.clip(1.0 - log_ratio, 0.0, 1.0)

    def displacement(self, points: Complexes, depth: Array) -> Complexes:
        """Compute the displacements that move points from a circular film to the real film, whose clamp may be oval.

        Args:
            points: Points x + iy of the circular film, shape (..., n), in film radii.
            depth: Depths of the points in the rings, shape (..., n).

        Returns:
            Displacements x + iy, shape (..., n), in film radii.
        """
        # Between the innermost circle and the rim, the displacement changes linearly with the depth.
        rim_displacement = oval_displacement(points, self.oval[..., None])
        displacement: Complexes = interpolate(self.footprint_displacement[..., None], rim_displacement, depth)
        return displacement

    def to_circular_film(self, points: Complexes) -> Complexes:
        """Convert points of the real film, whose clamp may be oval, into points of a circular film.

        The displacement from the circular film to the real film depends on the unknown point of the circular film, and
        on the depth of this point. The depth increases from 0 at the innermost circle of the mesh, which encloses the
        footprint, to 1 at the rim. A fixed-point iteration finds the point.

        Args:
            points: Points x + iy of the real film, shape (..., n), in film radii.

        Returns:
            Points of the circular film, shape (..., n), in film radii.
        """
        # In a first approximation, all points have the displacement of the footprint. If the clamp is circular, this
        # displacement is zero, and so are all others.
        circular_points = points - self.footprint_displacement[..., None]
        if not self.oval.any():
            return circular_points
        for _ in range(1000):  # ten to twenty steps are typical
            previous = circular_points
            depth = self.depth(self.to_template(previous))
            circular_points = points - self.displacement(previous, depth)
            if np.abs(circular_points - previous).max(initial=0.0) < 1e-15:
                break
        return circular_points

    def element_points(self, blocks: Blocks) -> Complexes:
        """Compute the film points of the nodes of all elements for a single placement.

        Args:
            blocks: The elements.

        Returns:
            Film points x + iy, shape (n_element, (order + 1)^2), in film radii.
        """
        inner_points = self._inner_element_points(blocks) + self.footprint_displacement
        ring_points = self._ring_element_points(blocks)
        return np.concatenate([inner_points, ring_points])

    def _inner_element_points(self, blocks: Blocks) -> Complexes:
        """Compute the points of the circular film at the nodes of the elements inside the innermost circle.

        The points of an element are interpolated linearly between its inner side and its outer side.

        Args:
            blocks: The elements.

        Returns:
            Points x + iy of the circular film, shape (n_inner, (order + 1)^2), in film radii.
        """
        # Coordinates of the nodes within an element from 0 to 1, which are the same for all elements, shape (n_local,)
        radial, angular = _unit_coordinates(blocks)

        # `sides` expects one placement for each element, so this placement is repeated: add an axis of length one, and
        # select its only entry, which has the index 0, once for each element.
        repeated_placement = self[None][np.zeros(blocks.n_inner, dtype=np.intp)]
        # Points on both sides of each element at the angular coordinates of its nodes, shape (n_inner, n_local)
        inner_side, outer_side = repeated_placement.sides(blocks, np.arange(blocks.n_inner), angular[None])
        points: Complexes = interpolate(inner_side, outer_side, radial)
        return points

    def sides(self, blocks: Blocks, element: Integers, angular: Array) -> tuple[Complexes, Complexes]:
        """Compute points on the inner and outer sides of elements that lie inside the innermost circle.

        The object contains n placements, one for each element. Between the core polygon and the innermost circle, there
        are one or two layers of elements. The points lie on a film with a circular clamp. If the real clamp is oval,
        they are displaced later.

        Args:
            blocks: The elements.
            element: Index of each element, shape (n,).
            angular: Angular coordinates of the points from 0 to 1, shape (n, k) or (1, k).

        Returns:
            Points x + iy of the inner sides and of the outer sides, each of shape (n, k), in film radii.
        """
        # Compute the sides as if they were straight. The points of curved sides are replaced below. Each of the four
        # corners of an element (index i) is a weighted sum of the corners and the centroid of the core polygon (j). The
        # attribute `corners` contains these corners, followed by the centroid, shape (n, n_corner + 1).
        element_corners = np.einsum("nij,nj->in", blocks.inner_corner_weights[element], self.corners)
        inner_first, inner_last, outer_first, outer_last = element_corners[:, :, None]  # each of shape (n, 1)
        inner = interpolate(inner_first, inner_last, angular)
        outer = interpolate(outer_first, outer_last, angular)

        # The elements are numbered from the inside to the outside: first the `n_quad` elements of the core polygon,
        # whose sides are straight, and then `n_sector` elements of each layer. The sector of an element is its position
        # within its layer. An element of the core polygon also gets a sector, but the sector has no effect.
        in_last_layer = element >= blocks.n_inner - blocks.n_sector
        sector = (element[:, None] - blocks.n_quad) % blocks.n_sector

        # The outer sides of the last layer lie on the innermost circle. In the template plane, this circle has the
        # centre 0 and the radius `template_radius`. The conformal map `to_film` converts its points into film points.
        first_angle = np.take_along_axis(self.circle_angles, sector, axis=1)
        last_angle = np.take_along_axis(self.circle_angles, sector + 1, axis=1)
        angle = interpolate(first_angle, last_angle, angular)  # in the template plane
        circle_points = self.to_film(self.template_radius[:, None] * np.exp(1j * angle))
        outer[in_last_layer] = circle_points[in_last_layer]

        # If there are two layers, the boundary of the footprint separates them. `boundary` computes its points from a
        # parameter, which increases from 0 to 2 pi around the footprint. With one layer, the inner sides are straight.
        if blocks.n_layer == 2:
            in_first_layer = (element >= blocks.n_quad) & ~in_last_layer
            first_parameter = blocks.boundary_parameter[sector]
            last_parameter = blocks.boundary_parameter[sector + 1]
            assert isinstance(self.probe, CurvedProbe)
            boundary = self.probe.boundary(interpolate(first_parameter, last_parameter, angular))
            # The last entry of `corners` is the centroid.
            boundary_points = _on_film(boundary, self.corners[..., -1], self.rotation_and_scale)
            outer[in_first_layer] = boundary_points[in_first_layer]
            inner[in_last_layer] = boundary_points[in_last_layer]
        return inner, outer

    def _ring_element_points(self, blocks: Blocks) -> Complexes:
        """Compute the film points of the nodes in the rings, which lie between the innermost circle and the rim.

        The points are first computed in a unit disk, the template plane. A conformal map converts them into points of a
        circular film. If the real clamp is oval, the points are then displaced.

        Args:
            blocks: Elements of the mesh. The rings are divided into sectors.

        Returns:
            Film points x + iy, shape (n_ring * n_sector, (order + 1)^2), in film radii.
        """
        # Depths of the nodes, from 0 on the innermost circle to 1 on the rim
        radial, angular = _unit_coordinates(blocks)  # of the nodes within an element, from 0 to 1, shape (n_local,)
        inner_depth = self.ring_depths[:-1, None, None]
        outer_depth = self.ring_depths[1:, None, None]
        depth = interpolate(inner_depth, outer_depth, radial)  # shape (n_ring, 1, n_local)

        # The angle of a node and the logarithm of its radius are interpolated linearly with respect to the depth,
        # between the innermost circle and the rim. On the rim, the logarithm of the radius is 0.
        # First, interpolate between the two sides of each sector, shape (n_sector, n_local).
        circle_angle = interpolate(self.circle_angles[:-1, None], self.circle_angles[1:, None], angular)
        rim_angle = interpolate(self.rim_angles[:-1, None], self.rim_angles[1:, None], angular)
        angle = interpolate(circle_angle, rim_angle, depth)  # shape (n_ring, n_sector, n_local)
        log_radius = (1.0 - depth) * np.log(self.template_radius)
        template_points = np.exp(log_radius + 1j * angle)
        circular_points = self.to_film(template_points)  # on the circular film
        film_points = circular_points + self.displacement(circular_points, depth)
        return film_points.reshape(-1, radial.size)  # one row for each element


def _on_film(footprint_points: Complexes, centroid: Array | Complexes, rotation_and_scale: Complexes) -> Complexes:
    """Convert points of a footprint into points of the circular film.

    Args:
        footprint_points: Points x + iy relative to the centroid of the footprint, shape (n,) or (..., n), mm.
        centroid: Position of the centroid on the circular film, shape (...), in film radii.
        rotation_and_scale: Factor that rotates the points and converts them from mm to film radii, shape (...).

    Returns:
        Points x + iy, shape (..., n), in film radii.
    """
    return centroid[..., None] + rotation_and_scale[..., None] * footprint_points


def interpolate(start: Any, end: Any, share: Array) -> Any:
    """Interpolate linearly between real or complex numbers: the share 0 yields `start`, and the share 1 yields `end`.

    The three arguments are broadcast with each other.
    """
    return start + share * (end - start)


def _unit_coordinates(blocks: Blocks) -> tuple[Array, Array]:
    """Return the radial and angular coordinates of the nodes of an element.

    Args:
        blocks: The elements.

    Returns:
        Radial coordinate and angular coordinate, both from 0 to 1, each of shape (n_local,).
    """
    return 0.5 * (blocks.xi + 1.0), 0.5 * (blocks.eta + 1.0)
