"""Where the mesh lies: a conformal map of the disk carries the rings, straight blocks fill the footprint.

The disk automorphism

    Z = (z + c) / (1 + c z),   0 <= c < 1,

carries rings about the template's centre onto the film (Z in units of the film's radius, the probe on the positive x
axis), circles to circles, so that with

    al = (atanh(p + R) + atanh(p - R)) / 2,   be = (atanh(p + R) - atanh(p - R)) / 2,   c = tanh al,   rho = tanh be

the circle |z| = rho becomes the circle of radius R about p, exactly. Inside that circle blocks are blended between the
straight edges of the footprint's polygon and the circle, on the film itself, so that the edges stay straight and the
load is integrated over the footprint and nothing else. Nodal fields are smooth functions of the position, and points
of the film are found in the mesh by closed formulas and, inside the circle, a few steps of Newton.
"""

from dataclasses import dataclass
from typing import Self

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
from isocharge.simulate.sensor.probe import Circle, Probe

CORE = 0.45
"""Half side of the virtual square in a circular footprint, in units of its radius: the corners lie at 0.64 of it."""

DIAGONALS = np.array([0.25, 0.75, 1.25, 1.75])
"""Directions of the corners of that square, in units of pi."""

NEWTON_STEPS = 20
"""Steps of Newton to find a point inside the circle; six are enough where blocks are well shaped."""

OVERSHOOT = 0.1
"""Largest distance outside its element at which Newton looks for a point, in local coordinates from 0 to 1."""


@dataclass(frozen=True)
class Placement:
    """A template's place on the film; the attributes may have leading axes, one placement per press.

    Attributes:
        c: The map's parameter, shape (...).
        rho: Radius of the circle in the template, shape (...).
        corners: Corners of the footprint's polygon and, last, its centroid, the hub, on the film, in units of its
            radius, shape (..., n_corner + 1).
        start: Angles of the sectors on the circle, shape (..., n_sector + 1).
        end: Angles of the sectors on the rim, shape (..., n_sector + 1).
        depth: Edges of the rings, 0 on the circle and 1 on the rim, shape (..., n_ring + 1).
    """

    c: Array
    rho: Array
    corners: Complexes
    start: Array
    end: Array
    depth: Array

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
            blocks: The blocks; their number of corners must be the probe's.
            probe: The footprint, rotated as it is when the press lies on the x axis.
            distance: Distance of the footprint's centroid from the film's centre, mm, any shape.
            film_radius: mm.
            layer: Width of the thin rings at the rim over the film's radius.
            rotation: Further rotation of the footprint, rad, the shape of `distance` or a number.
        """
        at = np.asarray(distance, dtype=float) / film_radius
        if isinstance(probe, Circle):
            centre, radius = at, np.full(at.shape, probe.radius / film_radius)
            corners = at[..., None] + radius[..., None] * CORE * np.sqrt(2.0) * np.exp(1j * np.pi * DIAGONALS)
        else:
            rotated = np.exp(1j * np.broadcast_to(rotation, at.shape))[..., None]
            corners = at[..., None] + probe.outline / film_radius * rotated
            centre, radius = enclosing_circle(corners, at)
        corners = np.concatenate([corners, at[..., None]], axis=-1)
        c, rho = automorphism_onto(centre, radius)
        start = sector_angles(blocks, corners, centre, radius, c * rho)
        depth = ring_edges(blocks.resolution, rho, layer * (1.0 + c) / (1.0 - c))
        return cls(c, rho, corners, start, rim_angles(start, c, rho), depth)

    def __getitem__(self, which: Integers) -> "Placement":
        """Some of the placements."""
        return Placement(**{name: value[which] for name, value in vars(self).items()})

    def batch(self) -> "Placement":
        """One placement as a batch of one."""
        return Placement(**{name: np.asarray(value)[None] for name, value in vars(self).items()})

    def to_film(self, z: Complexes) -> Complexes:
        """Template points, shape (..., n), to film points (unit radius)."""
        c = self.c[..., None]
        return np.asarray((z + c) / (1.0 + c * z))

    def to_template(self, points: Complexes) -> Complexes:
        """Film points (unit radius), shape (..., n), to template points."""
        c = self.c[..., None]
        return np.asarray((points - c) / (1.0 - c * points))

    def element_points(self, blocks: Blocks) -> Complexes:
        """Film points of every element's nodes for one placement, shape (n_element, (order + 1)^2), unit radius."""
        v, t = 0.5 * (blocks.xi + 1.0), 0.5 * (blocks.eta + 1.0)
        a, b, c, d = (blocks.straight @ self.corners).T[:, :, None]
        inner = (1.0 - v) * (a + t * (b - a)) + v * (c + t * (d - c))
        sector = np.arange(blocks.n_sector)[:, None]
        low, high = self.start[sector], self.start[sector + 1]
        arc = self.to_film(self.rho * np.exp(1j * (low + t * (high - low))))
        inner[blocks.n_quad :] += v * arc
        depth = self.depth[:-1, None] + v * np.diff(self.depth)[:, None]
        swept = depth[:, None]
        angles = (1.0 - swept) * (low + t * (high - low)) + swept * (self.end[sector] + t * np.diff(self.end)[:, None])
        outside = self.to_film(np.exp((1.0 - swept) * np.log(self.rho) + 1j * angles))
        return np.concatenate([inner, outside.reshape(-1, v.size)])

    def locate(self, blocks: Blocks, points: Complexes) -> tuple[Integers, Array, Array]:
        """Find film points in the blocks, n points for each placement.

        Args:
            blocks: The blocks.
            points: Film points (unit radius), shape (k, n) where the attributes have one leading axis of length k; in
                the upper half where only that is meshed.

        Returns:
            Element, xi and eta, each of shape (k, n).
        """
        z = self.to_template(points)
        element, v, t = self._locate_rings(blocks, z)
        inside = np.nonzero(np.abs(z) <= self.rho[:, None])
        if inside[0].size:
            element[inside], v[inside], t[inside] = self[inside[0]]._locate_inner(blocks, points[inside])
        return element, 2.0 * v - 1.0, 2.0 * t - 1.0

    def _locate_rings(self, blocks: Blocks, z: Complexes) -> tuple[Integers, Array, Array]:
        with np.errstate(divide="ignore"):
            depth = np.clip(1.0 - np.log(np.abs(z)) / np.log(self.rho)[:, None], 0.0, 1.0)
        ring = np.sum(self.depth[:, None, 1:-1] <= depth[..., None], axis=-1)
        low, high = (np.take_along_axis(self.depth, ring + i, axis=1) for i in (0, 1))

        def edge(number: Integers) -> Array:
            start, end = (np.take_along_axis(angles, number, axis=1) for angles in (self.start, self.end))
            return np.asarray(start + depth * (end - start))

        angle = np.angle(z)
        if not blocks.half:
            first = edge(np.zeros_like(ring))
            angle = first + np.mod(angle - first, 2.0 * np.pi)
        turn = (self.end - self.start)[:, None, 1:-1]
        sector = np.sum(self.start[:, None, 1:-1] + depth[..., None] * turn <= angle[..., None], axis=-1)
        before, after = edge(sector), edge(sector + 1)
        return (
            blocks.n_inner + ring * blocks.n_sector + sector,
            (depth - low) / (high - low),
            (angle - before) / (after - before),
        )

    def _locate_inner(self, blocks: Blocks, points: Complexes) -> tuple[Integers, Array, Array]:
        """Points inside the circle, one for each placement; all of shape (n,)."""
        a, b, c, d = np.moveaxis(np.einsum("ekn,pn->pek", blocks.straight, self.corners), -1, 0)
        circle = self.to_film(self.rho[:, None] * np.exp(1j * self.start))
        c[:, blocks.n_quad :], d[:, blocks.n_quad :] = circle[:, :-1], circle[:, 1:]
        at = points[:, None]
        sides = [_left(a, c, at), _left(d, b, at), _left(b, a, at), _left(c, d, at)]
        sides[3][:, blocks.n_quad :] = np.inf
        element = np.argmax(np.min(sides, axis=0), axis=1)
        pick = np.arange(points.size), element
        return element, *self._invert(blocks, points, element, tuple(corner[pick] for corner in (a, b, c, d)))

    def _invert(
        self, blocks: Blocks, points: Complexes, element: Integers, corners: tuple[Complexes, ...]
    ) -> tuple[Array, Array]:
        """(v, t) of points in given elements inside the circle, whose corners are (a, b, c, d), each of shape (n,).

        Newton on two equations, to round-off in a few steps.
        """
        a, b, c, d = corners
        arc = element >= blocks.n_quad
        sector = np.where(arc, element - blocks.n_quad, 0)
        v, t = np.full(points.shape, 0.5), np.full(points.shape, 0.5)
        low, high = (np.take_along_axis(self.start, (sector + i)[:, None], axis=1)[:, 0] for i in (0, 1))
        for _ in range(NEWTON_STEPS):
            z = self.rho * np.exp(1j * (low + t * (high - low)))
            rotated = 1j * (high - low) * z * (1.0 - self.c**2) / (1.0 + self.c * z) ** 2
            outer = np.where(arc, (z + self.c) / (1.0 + self.c * z), c + t * (d - c))
            by_t = (1.0 - v) * (b - a) + v * np.where(arc, rotated, d - c)
            inner = a + t * (b - a)
            by_v = outer - inner
            residual = inner + v * by_v - points
            determinant = (np.conj(by_v) * by_t).imag
            v = np.clip(v - (np.conj(residual) * by_t).imag / determinant, -OVERSHOOT, 1.0 + OVERSHOOT)
            t = np.clip(t - (np.conj(by_v) * residual).imag / determinant, -OVERSHOOT, 1.0 + OVERSHOOT)
        return v, t


def _left(start: Complexes, end: Complexes, at: Complexes) -> Array:
    """Distance of points to the left of directed lines."""
    direction = end - start
    return np.asarray(((at - start) * np.conj(direction)).imag / np.maximum(np.abs(direction), 1e-300))
