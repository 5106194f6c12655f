"""Positions of the elements on the film: a conformal map for the rings, and blended blocks in and around the footprint.

The disk automorphism

    Z = (z + c) / (1 + c z),   0 <= c < 1,

maps rings about the origin of the template plane (z) onto the film (Z, in film radii, with the probe on the positive x
axis). It maps circles to circles. With

    al = (atanh(p + R) + atanh(p - R)) / 2,   be = (atanh(p + R) - atanh(p - R)) / 2,   c = tanh al,   rho = tanh be

the circle |z| = rho becomes exactly the circle of radius R about p. Inside this circle, the blocks are linear blends
between the edges of the core polygon, the boundary of the footprint and the circle. The edges of a polygon stay
straight, so the load is integrated over exactly the footprint. Nodal fields are smooth functions of the position of the
probe. A film point is located in the mesh by closed formulas outside the circle, and by Newton's method inside.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Self

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.simulate.mesh.blocks import Blocks
from isocharge.simulate.mesh.conformal_map import (
    automorphism_onto,
    enclosing_circle,
    rim_angles,
    ring_edges,
    sector_angles,
)
from isocharge.simulate.sensor.probe import Probe

NEWTON_STEPS = 20
"""Number of Newton steps to locate a point inside the innermost circle. Six suffice in well-shaped blocks."""

OVERSHOOT = 0.1
"""Largest distance outside its element at which Newton's method evaluates a point, in local coordinates from 0 to 1."""

SECTOR_TOLERANCE = 1e-9
"""Distance outside its element, in local coordinates from 0 to 1, from which a neighbouring sector is tried."""

PARAMETER_STEP = 1e-5
"""Step of the boundary parameter for the derivative of a curved boundary by central differences."""


class QuadCorners(NamedTuple):
    """Corners of blocks, on the film: a and b on the inner side, c and d on the outer side, in film radii."""

    a: Complexes
    b: Complexes
    c: Complexes
    d: Complexes

    def of_elements(self, element: Integers) -> "QuadCorners":
        """Return the corners of one element for each of n points, if these are the corners of all elements."""
        return QuadCorners(*(corner[np.arange(element.size), element] for corner in self))


@dataclass(frozen=True)
class Placement:
    """Position of a template on the film. The arrays may have leading axes, for one placement per press.

    Attributes:
        c: Parameter of the conformal map, shape (...).
        rho: Radius of the innermost circle in the template plane, shape (...).
        corners: Corners of the core polygon and, last, its centroid, on the film, in film radii, shape
            (..., n_corner + 1).
        start: Angles of the sides of the sectors on the innermost circle, shape (..., n_sector + 1).
        end: Angles of the sides of the sectors on the rim, shape (..., n_sector + 1).
        depth: Edges of the rings, 0 on the innermost circle and 1 on the rim, shape (..., n_ring + 1).
        rotation_and_scale: Complex factor that converts points relative to the centroid from mm before the further
            rotation to film radii, shape (...).
        probe: The probe.
    """

    c: Array
    rho: Array
    corners: Complexes
    start: Array
    end: Array
    depth: Array
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

        Args:
            blocks: The elements, whose topology must be the topology of the probe.
            probe: The probe, rotated as it is when the press lies on the x axis.
            distance: Distance of the centroid of the footprint from the centre of the film, any shape, mm.
            film_radius: Radius of the film, mm.
            layer: Width of the thin rings at the rim, in film radii.
            rotation: Further rotation of the footprint, a number or of the shape of `distance`, rad.
        """
        centroid = np.asarray(distance, dtype=float) / film_radius
        if probe.is_axisymmetric:
            rotation = 0.0
        rotation_factor: Complexes = np.exp(1j * np.broadcast_to(rotation, centroid.shape))
        core = centroid[..., None] + probe.core(film_radius) * rotation_factor[..., None]
        corners = np.concatenate([core, centroid[..., None]], axis=-1)
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
        c, rho = automorphism_onto(centre, radius)
        start = sector_angles(blocks, stops, reach, centroid, centre, radius, c * rho)
        depth = ring_edges(blocks.resolution, rho, layer * (1.0 + c) / (1.0 - c))
        return cls(
            c, rho, corners, start, rim_angles(start, c, rho), depth, np.asarray(rotation_factor / film_radius), probe
        )

    def __getitem__(self, which: Integers) -> "Placement":
        """Return the placements with the indices `which` along the first axis."""
        return self._with_arrays(lambda values: values[which])

    def batch(self) -> "Placement":
        """Return a single placement as a batch of one placement."""
        return self._with_arrays(lambda values: np.asarray(values)[None])

    def _with_arrays(self, change: Callable[[Any], Any]) -> "Placement":
        """Return the placement with a function applied to every array."""
        changed: dict[str, Any] = {
            field.name: change(getattr(self, field.name)) for field in fields(self) if field.name != "probe"
        }
        return replace(self, **changed)

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
            Shape (n_element, (order + 1)^2), in film radii.
        """
        v = 0.5 * (blocks.xi + 1.0)
        t = 0.5 * (blocks.eta + 1.0)
        sector = np.arange(blocks.n_sector)[:, None]
        start_angle = self.start[sector] + t * (self.start[sector + 1] - self.start[sector])

        a, b, c, d = (blocks.straight @ self.corners).T[:, :, None]
        inside = (1.0 - v) * (a + t * (b - a)) + v * (c + t * (d - c))
        innermost_circle = self.to_film(self.rho * np.exp(1j * start_angle))
        inside[blocks.last_layer] += v * innermost_circle
        if blocks.n_layer == 2:
            parameter = blocks.boundary_parameter
            boundary = self.boundary(parameter[sector] + t * (parameter[sector + 1] - parameter[sector]))
            inside[blocks.first_layer] += v * boundary
            inside[blocks.last_layer] += (1.0 - v) * boundary

        depth = (self.depth[:-1, None] + v * np.diff(self.depth)[:, None])[:, None]
        end_angle = self.end[sector] + t * np.diff(self.end)[:, None]
        angle = (1.0 - depth) * start_angle + depth * end_angle
        rings = self.to_film(np.exp((1.0 - depth) * np.log(self.rho) + 1j * angle))
        return np.concatenate([inside, rings.reshape(-1, v.size)])

    def locate(self, blocks: Blocks, points: Complexes) -> tuple[Integers, Array, Array]:
        """Find the elements that contain film points, n points for each of k placements.

        Args:
            blocks: The elements.
            points: Film points, shape (k, n), in film radii. They lie in the upper half if only that half is meshed.

        Returns:
            Index of the element, xi and eta, each of shape (k, n).
        """
        z = self.to_template(points)
        element, v, t = self._locate_in_rings(blocks, z)
        inside = np.nonzero(np.abs(z) <= self.rho[:, None])
        if inside[0].size:
            element[inside], v[inside], t[inside] = self[inside[0]]._locate_inside(blocks, points[inside])
        return element, 2.0 * v - 1.0, 2.0 * t - 1.0

    def _locate_in_rings(self, blocks: Blocks, z: Complexes) -> tuple[Integers, Array, Array]:
        """Locate points between the innermost circle and the rim.

        Args:
            blocks: The elements.
            z: Points of the template plane, shape (k, n).

        Returns:
            Index of the element and its coordinates v and t from 0 to 1, each of shape (k, n).
        """
        with np.errstate(divide="ignore"):
            depth = np.clip(1.0 - np.log(np.abs(z)) / np.log(self.rho)[:, None], 0.0, 1.0)
        ring = np.sum(self.depth[:, None, 1:-1] <= depth[..., None], axis=-1)
        inner_edge = np.take_along_axis(self.depth, ring, axis=1)
        outer_edge = np.take_along_axis(self.depth, ring + 1, axis=1)

        def side_angle(number: Integers) -> Array:
            """Return the angle of a side of the sectors at the depth of each point, shape (k, n)."""
            start = np.take_along_axis(self.start, number, axis=1)
            end = np.take_along_axis(self.end, number, axis=1)
            return np.asarray(start + depth * (end - start))

        angle = np.angle(z)
        if not blocks.half:
            first = side_angle(np.zeros_like(ring))
            angle = first + np.mod(angle - first, 2.0 * np.pi)
        inner_sides = self.start[:, None, 1:-1]
        side_change = (self.end - self.start)[:, None, 1:-1]
        sector = np.sum(inner_sides + depth[..., None] * side_change <= angle[..., None], axis=-1)
        before = side_angle(sector)
        after = side_angle(sector + 1)
        return (
            blocks.n_inner + ring * blocks.n_sector + sector,
            (depth - inner_edge) / (outer_edge - inner_edge),
            (angle - before) / (after - before),
        )

    def _locate_inside(self, blocks: Blocks, points: Complexes) -> tuple[Integers, Array, Array]:
        """Locate points inside the innermost circle, one point for each placement.

        Args:
            blocks: The elements.
            points: Film points, shape (n,), in film radii.

        Returns:
            Index of the element and its coordinates v and t from 0 to 1, each of shape (n,).
        """
        corners = self._inner_corners(blocks)
        at = points[:, None]
        distance_from_first_side = _distance_to_left(corners.a, corners.c, at)
        distance_from_last_side = _distance_to_left(corners.d, corners.b, at)
        distance_from_inner_side = _distance_to_left(corners.b, corners.a, at)
        distance_from_outer_side = _distance_to_left(corners.c, corners.d, at)
        distance_from_outer_side[:, blocks.n_quad :] = np.inf  # the outer side is curved
        if blocks.n_layer == 2:
            centroid = self.corners[:, -1]
            in_footprint = self.probe.contains((points - centroid) / self.rotation_and_scale)
            distance_from_inner_side[:, blocks.last_layer] = np.inf  # the inner side is curved, too
            distance_from_outer_side[~in_footprint, blocks.footprint] = -np.inf
            distance_from_outer_side[in_footprint, blocks.last_layer] = -np.inf
        distances = [
            distance_from_first_side,
            distance_from_last_side,
            distance_from_inner_side,
            distance_from_outer_side,
        ]
        element = np.argmax(np.min(distances, axis=0), axis=1)
        v, t = self._invert_blend(blocks, points, element, corners.of_elements(element))
        if blocks.n_layer == 2:
            self._correct_sectors(blocks, points, corners, element, v, t)
        return element, v, t

    def _correct_sectors(
        self, blocks: Blocks, points: Complexes, corners: QuadCorners, element: Integers, v: Array, t: Array
    ) -> None:
        """Move points whose coordinates lie outside of their element to a neighbouring sector that contains them.

        The straight sides of two sectors may cross outside of the elements, so that a point lies between the sides of
        a sector that does not contain it. This occurs for elongated probes near the rim.

        Args:
            blocks: The elements.
            points: Film points, shape (n,), in film radii.
            corners: Corners of all elements inside the innermost circle, each of shape (n, n_inner).
            element: Index of the element that was found for each point, shape (n,); changed in place.
            v: Coordinates from the inner to the outer side, shape (n,); changed in place.
            t: Coordinates along the sector, shape (n,); changed in place.
        """
        original = element.copy()
        for shift in range(1, blocks.n_sector // 2 + 1):
            rows = np.flatnonzero((_overshoot(v, t) > SECTOR_TOLERANCE) & (original >= blocks.n_quad))
            if rows.size == 0:
                return
            for signed_shift in (shift, -shift):
                in_last_layer = original[rows] >= blocks.last_layer.start
                first = np.where(in_last_layer, blocks.last_layer.start, blocks.n_quad)
                candidate = first + (original[rows] - first + signed_shift) % blocks.n_sector
                row_corners = QuadCorners(*(corner[rows] for corner in corners)).of_elements(candidate)
                new_v, new_t = self[rows]._invert_blend(blocks, points[rows], candidate, row_corners)
                is_better = _overshoot(new_v, new_t) < _overshoot(v[rows], t[rows])
                better_rows = rows[is_better]
                element[better_rows] = candidate[is_better]
                v[better_rows] = new_v[is_better]
                t[better_rows] = new_t[is_better]

    def _inner_corners(self, blocks: Blocks) -> QuadCorners:
        """Return the corners of all elements inside the innermost circle, each of shape (n_placement, n_inner)."""
        a, b, c, d = np.moveaxis(np.einsum("ekn,pn->pek", blocks.straight, self.corners), -1, 0)
        circle = self.to_film(self.rho[:, None] * np.exp(1j * self.start))
        c[:, blocks.last_layer] = circle[:, :-1]
        d[:, blocks.last_layer] = circle[:, 1:]
        if blocks.n_layer == 2:
            boundary = self.boundary(blocks.boundary_parameter)
            c[:, blocks.first_layer] = boundary[:, :-1]
            d[:, blocks.first_layer] = boundary[:, 1:]
            a[:, blocks.last_layer] = boundary[:, :-1]
            b[:, blocks.last_layer] = boundary[:, 1:]
        return QuadCorners(a, b, c, d)

    def _invert_blend(
        self, blocks: Blocks, points: Complexes, element: Integers, corners: QuadCorners
    ) -> tuple[Array, Array]:
        """Compute the coordinates of points in given elements inside the innermost circle, by Newton's method.

        Args:
            blocks: The elements.
            points: Film points, shape (n,), in film radii.
            element: Index of the element that contains each point, shape (n,).
            corners: Corners of these elements, each of shape (n,).

        Returns:
            Coordinates v and t from 0 to 1, each of shape (n,).
        """
        a, b, c, d = corners
        in_last_layer = element >= blocks.last_layer.start
        in_sector = element >= blocks.n_quad
        sector = np.where(in_sector, (element - blocks.n_quad) % blocks.n_sector, 0)
        low = np.take_along_axis(self.start, sector[:, None], axis=1)[:, 0]
        high = np.take_along_axis(self.start, (sector + 1)[:, None], axis=1)[:, 0]
        v = np.full(points.shape, 0.5)
        t = np.full(points.shape, 0.5)
        inner_by_t = b - a
        straight_outer_by_t = d - c
        for _ in range(NEWTON_STEPS):
            z = self.rho * np.exp(1j * (low + t * (high - low)))
            circle = (z + self.c) / (1.0 + self.c * z)
            circle_by_t = 1j * (high - low) * z * (1.0 - self.c**2) / (1.0 + self.c * z) ** 2
            outer = np.where(in_last_layer, circle, c + t * straight_outer_by_t)
            outer_by_t = np.where(in_last_layer, circle_by_t, straight_outer_by_t)
            inner = a + t * inner_by_t
            by_t = (1.0 - v) * inner_by_t + v * outer_by_t
            if blocks.n_layer == 2:
                boundary, boundary_by_t = self._boundary_in_sector(blocks, sector, t)
                in_first_layer = in_sector & ~in_last_layer
                outer = np.where(in_first_layer, boundary, outer)
                outer_by_t = np.where(in_first_layer, boundary_by_t, outer_by_t)
                inner = np.where(in_last_layer, boundary, inner)
                by_t = (1.0 - v) * np.where(in_last_layer, boundary_by_t, inner_by_t) + v * outer_by_t
            by_v = outer - inner
            residual = inner + v * by_v - points
            determinant = (np.conj(by_v) * by_t).imag
            v = np.clip(v - (np.conj(residual) * by_t).imag / determinant, -OVERSHOOT, 1.0 + OVERSHOOT)
            t = np.clip(t - (np.conj(by_v) * residual).imag / determinant, -OVERSHOOT, 1.0 + OVERSHOOT)
        return v, t

    def _boundary_in_sector(self, blocks: Blocks, sector: Integers, t: Array) -> tuple[Complexes, Complexes]:
        """Return boundary points of a curved footprint and their derivatives with respect to t.

        Args:
            blocks: The elements.
            sector: Index of the sector of each point, shape (n,).
            t: Position in the sector, from 0 to 1, shape (n,).

        Returns:
            Points and derivatives, each of shape (n,), in film radii.
        """
        low = blocks.boundary_parameter[sector]
        width = blocks.boundary_parameter[sector + 1] - low
        parameter = (low + t * width)[:, None]
        after = self.boundary(parameter + PARAMETER_STEP)
        before = self.boundary(parameter - PARAMETER_STEP)
        by_parameter = (after - before)[:, 0] / (2.0 * PARAMETER_STEP)
        return self.boundary(parameter)[:, 0], by_parameter * width


def _overshoot(v: Array, t: Array) -> Array:
    """Return how far local coordinates lie outside of the range from 0 to 1; negative inside, shape (n,)."""
    return np.asarray(np.maximum(np.abs(v - 0.5), np.abs(t - 0.5)) - 0.5)


def _distance_to_left(start: Complexes, end: Complexes, points: Complexes) -> Array:
    """Return the distances of points to the left of directed lines from `start` to `end`."""
    direction = end - start
    return np.asarray(((points - start) * np.conj(direction)).imag / np.maximum(np.abs(direction), 1e-300))
