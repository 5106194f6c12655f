"""Positions of the elements on the film: a conformal map for the rings, and blended blocks in and around the footprint.

The disk automorphism

    Z = (z + c) / (1 + c z),   0 <= c < 1,

is a conformal map of the unit disk onto itself. The map converts points z of the template plane into film points Z, in
film radii, with the probe on the positive x axis. The images of circles are circles. With

    al = (atanh(p + R) + atanh(p - R)) / 2,   be = (atanh(p + R) - atanh(p - R)) / 2,   c = tanh al,   rho = tanh be

the circle |z| = rho is mapped exactly onto the circle of radius R about p. Inside this circle, the blocks are linear
blends between the edges of the core polygon, the boundary of the footprint and the circle. The edges of a polygonal
footprint remain straight, so the load is integrated over exactly the footprint. The values of fields at the nodes are
smooth functions of the position of the probe. The module `point_location` finds the element that contains a film point.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.simulate.mesh.blocks import Blocks
from isocharge.simulate.mesh.conformal_map import (
    automorphism_onto,
    enclosing_circle,
    rim_angles,
    ring_edges,
    sector_angles,
    widest_layer,
)
from isocharge.simulate.sensor.probe import Probe

CHECKED_ORIENTATIONS = 12
"""Number of orientations of a probe for which the width of the thin rings is checked."""


@dataclass(frozen=True)
class Placement:
    """Position of a template on the film. The arrays may have leading axes, for one placement per press.

    Attributes:
        c: Parameter of the conformal map, shape (...).
        rho: Radius of the innermost circle in the template plane, shape (...).
        corners: Corners of the core polygon and, last, its centroid, on the film, in film radii, shape
            (..., n_corner + 1).
        circle_angles: Angles of the sides of the sectors on the innermost circle, shape (..., n_sector + 1), rad.
        rim_angles: Angles of the sides of the sectors on the rim, shape (..., n_sector + 1), rad.
        ring_depths: Depths of the edges of the rings, 0 on the innermost circle and 1 on the rim, shape
            (..., n_ring + 1).
        rotation_and_scale: Complex factor that rotates points of the footprint by the further rotation and converts
            them from mm to film radii, shape (...). The points are relative to the centroid.
        probe: The probe.
    """

    c: Array
    rho: Array
    corners: Complexes
    circle_angles: Array
    rim_angles: Array
    ring_depths: Array
    rotation_and_scale: Complexes
    probe: Probe

    @classmethod
    def of(
        cls,
        blocks: Blocks,
        probe: Probe,
        distance: Array,
        film_radius: float,
        layer: float,
        rotation: Array | float = 0.0,
    ) -> Self:
        """Place a template under a press on the positive x axis.

        The method determines the innermost circle, the conformal map that belongs to it, and the angles and depths of
        the elements between this circle and the rim.

        Args:
            blocks: The elements, whose topology must be the topology of the probe.
            probe: The probe in the frame in which the press lies on the positive x axis.
            distance: Distance of the centroid of the footprint from the centre of the film, any shape, mm.
            film_radius: Radius of the film, mm.
            layer: Width of the thin rings at the rim, in film radii.
            rotation: Further rotation of the footprint, a number or of the shape of `distance`, rad.
        """
        # Corners of the core polygon on the film, followed by the centroid of the footprint. The centroid is a real
        # number, because the press lies on the x axis.
        centroid = np.asarray(distance, dtype=float) / film_radius
        if probe.is_axisymmetric:
            rotation = 0.0
        rotation_factor: Complexes = np.exp(1j * np.broadcast_to(rotation, centroid.shape))
        core = centroid[..., None] + probe.core(film_radius) * rotation_factor[..., None]
        corners = np.concatenate([core, centroid[..., None]], axis=-1)

        # The innermost circle is the footprint itself, or encloses it. `reach` is the largest distance of the blocks
        # inside the circle from its centre. `stops` are the corners of the footprint and the points half-way between
        # them, at which the sectors around the footprint begin.
        stops: Complexes = np.asarray(corners @ blocks.boundary[:: blocks.split].T)
        if probe.topology.fills_circle:
            centre = centroid
            radius = np.full(centroid.shape, probe.reach / film_radius)
            reach = np.abs(corners - centre[..., None]).max(axis=-1)
        else:
            outline = centroid[..., None] + probe.outline / film_radius * rotation_factor[..., None]
            centre, radius = enclosing_circle(outline, centroid)
            reach = np.abs(outline - centre[..., None]).max(axis=-1)
            if probe.topology.is_curved:
                boundary = probe.boundary(blocks.boundary_parameter[:: blocks.split])
                stops = np.asarray(centroid[..., None] + boundary / film_radius * rotation_factor[..., None])

        # Compute the conformal map of the innermost circle, and the angles and depths of the elements around it.
        c, rho = automorphism_onto(centre, radius)
        circle_angles = sector_angles(blocks, stops, reach, centroid, centre, radius, c * rho)
        template_layer = layer * (1.0 + c) / (1.0 - c)  # width of the thin rings in the template plane
        return cls(
            c=c,
            rho=rho,
            corners=corners,
            circle_angles=circle_angles,
            rim_angles=rim_angles(circle_angles, c, rho),
            ring_depths=ring_edges(blocks.resolution, rho, template_layer),
            rotation_and_scale=np.asarray(rotation_factor / film_radius),
            probe=probe,
        )

    def __getitem__(self, indices: Integers) -> "Placement":
        """Return the placements with the given indices along the first axis."""
        return self._with_arrays(lambda values: values[indices])

    def batch(self) -> "Placement":
        """Return a single placement with an additional axis of length one, as for several presses."""
        return self._with_arrays(lambda values: np.asarray(values)[None])

    def _with_arrays(self, function: Callable[[Any], Any]) -> "Placement":
        """Return a copy in which a function is applied to every array."""
        arrays: dict[str, Any] = {
            field.name: function(getattr(self, field.name)) for field in fields(self) if field.name != "probe"
        }
        return replace(self, **arrays)

    def to_film(self, z: Complexes) -> Complexes:
        """Map points of the template plane, shape (..., n), to film points in film radii."""
        c = self.c[..., None]
        return np.asarray((z + c) / (1.0 + c * z))

    def to_template(self, points: Complexes) -> Complexes:
        """Map film points in film radii, shape (..., n), to points of the template plane."""
        c = self.c[..., None]
        return np.asarray((points - c) / (1.0 - c * points))

    def boundary(self, parameter: Array) -> Complexes:
        """Return points of the boundary of the footprint on the film, in film radii.

        Args:
            parameter: Boundary parameters, from 0 to 2 pi, shape (..., n).
        """
        centroid = self.corners[..., -1:]
        return np.asarray(centroid + self.rotation_and_scale[..., None] * self.probe.boundary(parameter))

    def element_points(self, blocks: Blocks) -> Complexes:
        """Compute the film points of the nodes of every element for a single placement.

        Returns:
            Film points x + iy, shape (n_element, (order + 1)^2), in film radii.
        """
        inner_points = self._inner_element_points(blocks)
        ring_points = self._ring_element_points(blocks)
        return np.concatenate([inner_points, ring_points])

    def _inner_element_points(self, blocks: Blocks) -> Complexes:
        """Compute the film points of the nodes of the elements inside the innermost circle.

        A point is a linear blend between the inner and the outer side of its element. `Blocks.straight` describes the
        straight sides. This method adds the curved sides.

        Returns:
            Film points x + iy, shape (n_inner, (order + 1)^2), in film radii.
        """
        radial, angular = _unit_coordinates(blocks)  # of the nodes of an element, from 0 to 1, shape (n_local,)
        corners = blocks.straight @ self.corners  # shape (n_inner, 4)
        a, b, c, d = corners.T[:, :, None]  # each of shape (n_inner, 1)
        inner_side = a + angular * (b - a)
        outer_side = c + angular * (d - c)
        points = (1.0 - radial) * inner_side + radial * outer_side

        innermost_circle = self.to_film(self.rho * np.exp(1j * self._node_circle_angles(blocks)))
        points[blocks.last_layer] += radial * innermost_circle
        if blocks.n_layer == 2:  # the boundary of the footprint separates the two layers
            sector = np.arange(blocks.n_sector)[:, None]
            first_parameter = blocks.boundary_parameter[sector]
            last_parameter = blocks.boundary_parameter[sector + 1]
            boundary = self.boundary(first_parameter + angular * (last_parameter - first_parameter))
            points[blocks.first_layer] += radial * boundary
            points[blocks.last_layer] += (1.0 - radial) * boundary
        return np.asarray(points)

    def _ring_element_points(self, blocks: Blocks) -> Complexes:
        """Compute the film points of the nodes of the elements between the innermost circle and the rim.

        Returns:
            Film points x + iy, shape (n_ring * n_sector, (order + 1)^2), in film radii.
        """
        # Depth of the nodes: 0 on the innermost circle, 1 on the rim
        radial, angular = _unit_coordinates(blocks)
        inner_depth = self.ring_depths[:-1, None]
        node_depth = inner_depth + radial * np.diff(self.ring_depths)[:, None]  # shape (n_ring, n_local)
        depth = node_depth[:, None]  # shape (n_ring, 1, n_local)

        # The angle is interpolated over the depth between the innermost circle and the rim.
        circle_angle = self._node_circle_angles(blocks)  # shape (n_sector, n_local)
        rim_angle = self.rim_angles[:-1, None] + angular * np.diff(self.rim_angles)[:, None]
        angle = (1.0 - depth) * circle_angle + depth * rim_angle  # shape (n_ring, n_sector, n_local)
        log_radius = (1.0 - depth) * np.log(self.rho)
        template_points = np.exp(log_radius + 1j * angle)
        return self.to_film(template_points).reshape(-1, radial.size)

    def _node_circle_angles(self, blocks: Blocks) -> Array:
        """Return the angles (rad) on the innermost circle for the nodes of each sector, shape (n_sector, n_local)."""
        _, angular = _unit_coordinates(blocks)
        first_side = self.circle_angles[:-1, None]
        last_side = self.circle_angles[1:, None]
        return np.asarray(first_side + angular * (last_side - first_side))


def _unit_coordinates(blocks: Blocks) -> tuple[Array, Array]:
    """Return the radial and angular coordinates (0 to 1) of the nodes of an element, each of shape (n_local,)."""
    return 0.5 * (blocks.xi + 1.0), 0.5 * (blocks.eta + 1.0)


def widest_smooth_layer(mesh: Blocks, probe: Probe, distance: float, film_radius: float) -> float:
    """Return the largest width of the thin rings for which the mesh is a smooth function of the position of the press.

    `ring_edges` limits the depth of wider thin rings if the press is near the rim. The positions of the nodes would
    then have a kink as functions of the distance. Polynomials in the distance would interpolate the fields badly.

    Args:
        mesh: Template of the mesh.
        probe: The probe.
        distance: Largest distance of a press from the centre, mm.
        film_radius: Radius of the film, mm.

    Returns:
        Width of all thin rings together, in film radii.
    """
    rotation = 2.0 * np.pi * np.arange(CHECKED_ORIENTATIONS) / CHECKED_ORIENTATIONS
    placement = Placement.of(mesh, probe, np.full(CHECKED_ORIENTATIONS, distance), film_radius, 0.0, rotation)
    return float(widest_layer(mesh.resolution, placement.c, placement.rho).min())
