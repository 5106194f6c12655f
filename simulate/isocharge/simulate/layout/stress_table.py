"""The stress of all presses of one scene, at every point of the film.

A round film under a press at distance r from its centre is one equilibrium, whatever the electrodes. Seen in the
coordinates of the conformal map that carries the probe's circle onto |z| = rho (`mesh.placement`), the stress is smooth
but for a kink on that circle. It is solved at Chebyshev nodes in r, sampled on an even grid of

    depth = 1 - ln|z| / ln rho   from 0 on the circle to 1 on the rim (inside the circle |z| / rho),   angle = arg z,

and interpolated: in r by polynomials, in depth and angle by local cubics. Derivatives come from the same weights.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.simulate.layout.scene import DesignScene
from isocharge.simulate.mesh.conformal_map import automorphism_onto
from isocharge.simulate.numerics.cubic import cubic_weights
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.simulate.sensor.film import Surface
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.load_case import layer_for
from isocharge.simulate.solver.press import needed_resolution, press
from isocharge.simulate.solver.settings import SolveSettings

INSIDE, OUTSIDE, AROUND = 10, 49, 64
"""Nodes of the grid inside the probe's circle, from there to the rim, and around."""

DISTANCES = (5, 8)
"""Number of distances that are solved: up to a quarter of the film's radius, and beyond."""

NEAREST = 1e-9
"""Distance from the pole of the map below which a point counts as this far from it, in units of the film's radius."""

STEP = 1e-6
"""Step of the derivatives of the coordinates by the distance of the press, in units of the film's radius."""

FORCE_STEP = 0.05
"""Step of the derivative by ln F, dimensionless."""


class Channels(NamedTuple):
    """Stress and its derivatives at points, each of shape (n_press, n_point, n_component), Pa and Pa per unit.

    Components are (s11, s22, s12) in the frame of the press, or the trace s11 + s22 alone.
    """

    stress: Array
    by_x: Array
    by_y: Array
    by_force: Array
    by_pretension: Array


@dataclass(frozen=True)
class SolveJob:
    """Presses at one distance: of the scene, and with the other forces and pretension that derivatives need.

    Attributes:
        scene: The scene.
        distance: m.
        settings: Theory and mesh.
        surface: Where in the thickness the stress is read.
        derivatives: Whether force and pretension are varied, too.
    """

    scene: DesignScene
    distance: float
    settings: SolveSettings
    surface: Surface
    derivatives: bool


def solve_job(job: SolveJob) -> Array:
    """(s11, s22, s12) on the grid, and its derivatives by ln F and pretension, shape (1 or 3, n_node, 3)."""
    scene, step = job.scene, job.scene.pretension_step
    points = _grid_points(scene, job.distance)
    base = _press(job, scene, scene.force, None)
    rows = [base.touch_stress(points, job.surface)]
    if job.derivatives:
        up, down = (
            _press(job, scene, scene.force * np.exp(sign * FORCE_STEP), base).touch_stress(points, job.surface)
            for sign in (1.0, -1.0)
        )
        tauter = scene.with_pretension(scene.film.pretension + step)
        taut = _press(job, tauter, scene.force, base).touch_stress(points, job.surface)
        rows += [(up - down) / (2.0 * FORCE_STEP), (taut - rows[0]) / step]
    return np.stack(rows)


def _press(job: SolveJob, scene: DesignScene, force: float, start: Equilibrium | None) -> Equilibrium:
    return press(scene.film, scene.probe, (job.distance, 0.0), force, job.settings, start=start)


def distances(radius: float, film_radius: float) -> Array:
    """Distances from the centre that are solved, shape (n,), m."""
    count = DISTANCES[0] if radius <= 0.25 * film_radius else DISTANCES[1]
    return chebyshev_nodes(count, 0.0, radius)


def settings_for(scene: DesignScene, settings: SolveSettings) -> SolveSettings:
    """Mesh for all presses of a scene; the theory must be set."""
    layer = layer_for(scene.film, scene.force)
    settings = replace(settings, layer=layer)
    resolution = needed_resolution(scene.film, scene.probe, (scene.radius, 0.0), scene.force, settings)
    return replace(settings, resolution=resolution)


@dataclass(frozen=True)
class StressTable:
    """Stress of the presses of a scene on the grid of the conformal map.

    Attributes:
        probe_radius: m.
        film_radius: m.
        distance: Distances of the presses that were solved, shape (n_distance,), m.
        values: Stress in the frame of the press, and its derivatives by ln F and pretension if they were solved: shape
            (n_distance, INSIDE + OUTSIDE, AROUND, 1 or 3, n_component), Pa.
    """

    probe_radius: float
    film_radius: float
    distance: Array
    values: Array

    @classmethod
    def of(cls, scene: DesignScene, solved: Array) -> "StressTable":
        """From the results of `solve_job` at each of `distances`, shape (n_distance, 1 or 3, n_node, 3)."""
        grid = solved.reshape(*solved.shape[:2], INSIDE + OUTSIDE, AROUND, 3)
        values = np.ascontiguousarray(np.moveaxis(grid, 1, 3))
        return cls(scene.probe.radius, scene.film.radius, distances(scene.radius, scene.film.radius), values)

    def trace(self) -> "StressTable":
        """Only s11 + s22, which is the same in every frame."""
        return replace(self, values=self.values[..., :1] + self.values[..., 1:2])

    def at(self, distance: Array, derivatives: bool) -> "PressedTable":
        """The table for presses at some distances, shape (n,), m, above 0; without derivatives the stress alone."""
        nodes, weights = self.distance, barycentric_weights(self.distance)
        step = STEP * self.film_radius
        by_value, ahead, behind = (lagrange_values(nodes, weights, distance + sign * step) for sign in (0.0, 1.0, -1.0))
        values = self.values if derivatives else self.values[..., :1, :]
        channels = [_contract(by_value, values)]
        if derivatives:
            channels.append(_contract((ahead - behind) / (2.0 * step), values[..., :1, :]))
        table = np.concatenate(channels, axis=3)
        return PressedTable(self, distance, table.reshape(-1, table.shape[-2] * table.shape[-1]))

    def coordinates(self, distance: Array, points: Complexes) -> tuple[Array, Array, list[tuple[Array, Array]]]:
        """Row and column of points on the grid, and their derivatives by x and y of the point and by the distance."""
        a, at = self.film_radius, distance / self.film_radius
        z = points / a
        z = z / np.maximum(np.abs(z), 1.0)
        (c, rho), (c_next, rho_next), (c_last, rho_last) = (
            automorphism_onto(at + sign * STEP, np.full(at.shape, self.probe_radius / a)) for sign in (0.0, 1.0, -1.0)
        )
        by_c, by_rho = (c_next - c_last) / (2.0 * STEP), np.log(rho_next / rho_last) / (2.0 * STEP)
        away = np.where(np.abs(z - c) < NEAREST, NEAREST, z - c)
        logs = np.log(away / (1.0 - c * z))
        by_z = (1.0 - c**2) / (away * (1.0 - c * z)) / a
        by_distance = (z**2 - 1.0) / (away * (1.0 - c * z)) * by_c / a
        log_rho, inside = np.log(rho), logs.real <= np.log(rho)
        share = np.exp(np.minimum(logs.real - log_rho, 0.0))
        row = np.where(inside, share * (INSIDE - 1), INSIDE + (1.0 - logs.real / log_rho) * (OUTSIDE - 1))
        chain = []
        for change, grown in ((by_z, 0.0), (1j * by_z, 0.0), (by_distance, by_rho / a)):
            within = share * (change.real - grown) * (INSIDE - 1)
            beyond = (logs.real / log_rho * grown - change.real) / log_rho * (OUTSIDE - 1)
            chain.append((np.where(inside, within, beyond), change.imag * AROUND / (2.0 * np.pi)))
        return row, logs.imag * AROUND / (2.0 * np.pi), chain


@dataclass(frozen=True)
class PressedTable:
    """The table of some presses, each on the positive x axis of its frame.

    Attributes:
        source: The table of the whole scene.
        distance: Of the presses from the film's centre, shape (n,), m.
        values: Stress, its derivatives by ln F and pretension, and that by the distance at fixed coordinates, on the
            grid of each press: shape (n * (INSIDE + OUTSIDE) * AROUND, n_channel * n_component).
    """

    source: StressTable
    distance: Array
    values: np.ndarray

    def stress(self, which: Integers, points: Complexes) -> Array:
        """Stress under the presses of numbers `which`, shape (m,), at points (m, n_point): (m, n_point, n_component).

        Points are x + iy on the film in the frame of the press, m; those beyond the rim have the stress of the rim.
        """
        row, column, _ = self.source.coordinates(self.distance[which, None], points)
        stress: Array = self._interpolated(which, row, column, ((0, 0),))[..., 0, 0, :]
        return stress

    def channels(self, which: Integers, points: Complexes) -> Channels:
        """As `stress`, with the derivatives; those by the place of the press are at a fixed point of the film."""
        distance = self.distance[which, None]
        row, column, chain = self.source.coordinates(distance, points)
        parts = self._interpolated(which, row, column, ((0, 0), (1, 0), (0, 1)))
        value, by_row, by_column = parts[..., 0, :, :], parts[..., 1, 0, :], parts[..., 2, 0, :]
        by_x, by_y, by_r = (by_row * chain[i][0][..., None] + by_column * chain[i][1][..., None] for i in range(3))
        outward = value[..., 3, :] + by_r
        sideways = _sideways(distance, points, value[..., 0, :], by_x, by_y)
        return Channels(value[..., 0, :], outward, sideways, value[..., 1, :], value[..., 2, :])

    def _interpolated(self, which: Integers, row: Array, column: Array, orders: tuple[tuple[int, int], ...]) -> Array:
        """Channels at rows and columns, and their derivatives by these: (m, n_point, n_order, n_channel, ...)."""
        rows, by_rows = _row_weights(row)
        columns, *by_columns = cubic_weights(column, AROUND, periodic=True)
        node = (which[:, None, None, None] * (INSIDE + OUTSIDE) + rows[..., None]) * AROUND + columns[..., None, :]
        weights = np.stack([_outer(by_rows[i], by_columns[j]) for i, j in orders], axis=-2)
        values = np.matmul(weights.astype(np.float32), self.values[node.reshape(*row.shape, 16)])
        shaped: Array = values.astype(float).reshape(*row.shape, len(orders), -1, self.source.values.shape[-1])
        return shaped


def _contract(weights: Array, values: np.ndarray) -> np.ndarray:
    """Sums over the solved distances with weights (n, n_distance), in single precision: shape (n, ...)."""
    flat = values.reshape(len(values), -1).astype(np.float32)
    return (weights.astype(np.float32) @ flat).reshape(len(weights), *values.shape[1:])


def _grid_points(scene: DesignScene, distance: float) -> Array:
    """Film points (x, y) of the grid under a press on the positive x axis, shape (n_node, 2), m."""
    a = scene.film.radius
    c, rho = automorphism_onto(np.array(distance / a), np.array(scene.probe.radius / a))
    inside = rho * np.linspace(0.0, 1.0, INSIDE)
    outside = rho ** np.linspace(1.0, 0.0, OUTSIDE)
    z = np.concatenate([inside, outside])[:, None] * np.exp(2j * np.pi * np.arange(AROUND) / AROUND)
    points = a * ((z + c) / (1.0 + c * z)).ravel() * (1.0 - 1e-12)
    return np.stack([points.real, points.imag], axis=1)


def _row_weights(row: Array) -> tuple[Integers, tuple[Array, Array]]:
    """Neighbours and weights across the rows; the two sides of the probe's circle do not share neighbours."""
    inside = row <= INSIDE - 1
    near, far = cubic_weights(row, INSIDE), cubic_weights(row - INSIDE, OUTSIDE)
    number, weights, slopes = (np.where(inside[..., None], a, b) for a, b in zip(near, far, strict=True))
    return np.where(inside[..., None], number, number + INSIDE), (weights, slopes)


def _outer(first: Array, second: Array) -> Array:
    """Products of the weights along two axes, shape (..., 4), as (..., 16)."""
    products: Array = (first[..., :, None] * second[..., None, :]).reshape(*first.shape[:-1], 16)
    return products


def _sideways(distance: Array, points: Complexes, stress: Array, by_x: Array, by_y: Array) -> Array:
    """Derivative by the press's y at a fixed point: the press, and with it the field, turns about the film's centre."""
    x, y = points.real[..., None], points.imag[..., None]
    turned = y * by_x - x * by_y
    if stress.shape[-1] == 3:
        s11, s22, s12 = np.moveaxis(stress, -1, 0)
        turned = turned + np.stack([-2.0 * s12, 2.0 * s12, s11 - s22], axis=-1)
    sideways: Array = turned / distance[..., None]
    return sideways
