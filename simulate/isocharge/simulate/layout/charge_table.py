"""Charges of electrodes anywhere on the film, and their derivatives by the press and by what nobody knows exactly.

A round film under a press at some distance from its centre is one equilibrium, whatever the electrodes. In the
coordinates of the conformal map that carries the probe's circle onto |z| = rho (`mesh.placement`) its stress is smooth
but for a kink on that circle. It is solved at Chebyshev nodes in the distance and sampled, with its central differences
by the unknowns, on a grid that is even in |z| within the circle, in ln|z| from there to the rim, and in arg z.
Polynomials interpolate in the distance and local cubics on the grid; an electrode reads the mean over its area.
"""

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.common.progress import track
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.readout import electrode_rule
from isocharge.simulate.mechanics.theory import theory_for
from isocharge.simulate.mesh.conformal_map import automorphism_onto
from isocharge.simulate.numerics.interpolation import (
    barycentric_weights,
    chebyshev_nodes,
    cubic_weights,
    gauss_square,
    lagrange_values,
)
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Electrode, Sensor
from isocharge.simulate.solver.equilibrium import touch_stress
from isocharge.simulate.solver.load_case import SolveSettings, layer_for
from isocharge.simulate.solver.press import needed_resolution, press

COLUMNS = ("charge", "x", "y", "ln force", "probe radius", "pretension")
"""Columns of a row: the charge, pC, and its derivatives, per mm, 1 and MPa."""

INSIDE, OUTSIDE, AROUND = 10, 49, 64
"""Nodes of the grid within the probe's circle, from there to the rim, and around."""

MARGIN = 0.03
"""The grid leaves out this share of the radius on both sides of the circle: differences are wrong there."""

SHIFT, LOG_STEP, PRETENSION_STEP = 0.02, 0.05, 0.1
"""Steps of the differences: by place and probe radius over the probe's radius, by ln F, and by the pretension, MPa."""

DISTANCES = (5, 8)
"""Number of distances that are solved: up to a quarter of the film's radius, and beyond."""

RULES = ((1.4, 10), (2.5, 4), (np.inf, 2))
"""Gauss points per side of a square by its distance from the press, in units of half its diagonal plus the probe's
radius; nearer than the first the kink of the stress on the footprint's edge crosses it."""

PRESSES, POINTS = 256, 20_000
"""Presses and points evaluated at once: keeps the working arrays within some 100 MB."""


@dataclass(frozen=True)
class ChargeTable:
    """Charges of electrodes under one probe with one force, anywhere within a disk.

    Attributes:
        film_radius: mm.
        probe: The footprint.
        piezo: d31 and d32, pC/N.
        distance: Distances of the presses from the centre that were solved, shape (n_distance,), mm.
        stress: (s11, s22, s12) and their derivatives in the frame of the press, single precision, MPa and MPa per unit:
            shape (n_distance * 3, n_node * 6).
    """

    film_radius: float
    probe: Circle
    piezo: tuple[float, float]
    distance: Array
    stress: np.ndarray

    @classmethod
    def solve(
        cls, sensor: Sensor, probe: Circle, force: float, radius: float, executor: Executor | None = None
    ) -> "ChargeTable":
        """Solve presses of `force` (N) up to `radius` (mm) from the centre, some sixty.

        Raises:
            SolveError: If an equilibrium is not reached.
        """
        film = sensor.film
        settings = SolveSettings(theory=theory_for(sensor, probe, (force, force)), layer=layer_for(film, force))
        settings = replace(settings, resolution=needed_resolution(film, probe, (radius, 0.0), force, settings))
        distance = chebyshev_nodes(DISTANCES[int(radius > 0.25 * film.radius)], 0.0, radius)
        solve = partial(_stress_at, film, sensor.surface, probe, force, settings)
        solved = list(track(in_order(executor, solve, distance.tolist()), "solving the film", len(distance)))
        stress = np.stack(solved).transpose(0, 3, 2, 1).reshape(3 * len(distance), -1).astype(np.float32)
        return cls(film.radius, probe, (sensor.piezo.d31, sensor.piezo.d32), distance, stress)

    def rows(self, presses: Array, centres: Array, side: float, stay: tuple[Electrode, ...] = ()) -> Array:
        """Charges and derivatives of squares, and after them of other electrodes.

        Args:
            presses: (x, y), shape (n, 2), mm.
            centres: Of the squares, shape (m, 2), mm.
            side: Of the squares, mm.
            stay: The other electrodes, of any shape.

        Returns:
            Shape (n, m + len(stay), 6), the columns of `COLUMNS`. The mean over the area is read, whatever the sensor's
            readout.
        """
        chunks = [presses[start : start + PRESSES] for start in range(0, len(presses), PRESSES)]
        return np.concatenate([np.concatenate(list(self._parts(at, centres, side, stay)), axis=1) for at in chunks])

    def _parts(self, presses: Array, centres: Array, side: float, stay: tuple[Electrode, ...]) -> Iterator[Array]:
        pressed = _Pressed.of(self, presses)
        yield pressed.squares(centres, side)
        for electrode in stay:
            points, shares = electrode_rule(electrode, "area", RULES[0][1])
            chunks = np.array_split(np.arange(len(presses)), -(-len(presses) * len(points) // POINTS))
            every = [np.broadcast_to(points, (len(chunk), *points.shape)) for chunk in chunks]
            means = [pressed.means(chunk, at, shares[:, 0]) for chunk, at in zip(chunks, every, strict=True)]
            yield electrode.area * np.concatenate(means)[:, None]


@dataclass(frozen=True)
class _Pressed:
    """Charge per area of some presses on the grid, and where the grid lies.

    Attributes:
        table: The table.
        presses: x + iy, shape (n,), mm.
        turn: Direction of each press, shape (n,).
        pole, rho: Of the conformal maps, shape (n,).
        density: Shape (n * n_node, 6), pC/mm^2 and per unit; derivatives by place in the frame of the press.
    """

    table: ChargeTable
    presses: Complexes
    turn: Complexes
    pole: Array
    rho: Array
    density: np.ndarray

    @classmethod
    def of(cls, table: ChargeTable, presses: Array) -> "_Pressed":
        at = presses @ np.array([1.0, 1j])
        distance, turn = np.abs(at), np.exp(1j * np.angle(at))
        (d31, d32), double = table.piezo, turn**2
        mean, half = 0.5 * (d31 + d32), 0.5 * (d31 - d32)
        by_stress = np.stack([mean + half * double.real, mean - half * double.real, -2.0 * half * double.imag], axis=1)
        by_distance = lagrange_values(table.distance, barycentric_weights(table.distance), distance)
        weights = (by_distance[:, :, None] * by_stress[:, None, :]).reshape(len(at), -1)
        density = (weights.astype(np.float32) @ table.stress).reshape(-1, len(COLUMNS))
        a = table.film_radius
        return cls(table, at, turn, *automorphism_onto(distance / a, np.full(len(at), table.probe.radius / a)), density)

    def squares(self, centres: Array, side: float) -> Array:
        """Rows of all presses and squares, shape (n, m, 6), each with as many points as its distance needs."""
        away = np.abs(centres @ np.array([1.0, 1j]) - self.presses[:, None])
        level = np.searchsorted([reach for reach, _ in RULES], away / (np.sqrt(0.5) * side + self.table.probe.radius))
        rows = np.empty((*away.shape, len(COLUMNS)))
        for number, (_, count) in enumerate(RULES):
            (unit, share), (press_index, square) = gauss_square(count), np.nonzero(level == number)
            for start in range(0, len(square), size := POINTS // len(unit)):
                chunk = slice(start, start + size)
                points = centres[square[chunk], None] + side * (unit - 0.5)
                rows[press_index[chunk], square[chunk]] = side**2 * self.means(press_index[chunk], points, share)
        return rows

    def means(self, which: Integers, points: Array, share: Array) -> Array:
        """Means over points (k, n_point, 2), mm, with shares (n_point,) under presses `which`: (k, 6), per area."""
        turn = self.turn[which]
        row, column = self._coordinates(which, points @ np.array([1.0, 1j]) / turn[:, None])
        rows, by_row = _row_weights(row)
        columns, by_column = cubic_weights(column, AROUND, periodic=True)
        node = (which[:, None, None, None] * (INSIDE + OUTSIDE) + rows[..., None]) * AROUND + columns[..., None, :]
        weights = share[:, None, None] * by_row[..., None] * by_column[..., None, :]
        flat = weights.reshape(len(which), 1, -1).astype(np.float32)
        mean: Array = np.matmul(flat, self.density[node.reshape(len(which), -1)])[:, 0].astype(float)
        place = (mean[:, 1] + 1j * mean[:, 2]) * turn
        mean[:, 1], mean[:, 2] = place.real, place.imag
        return mean

    def _coordinates(self, which: Integers, points: Complexes) -> tuple[Array, Array]:
        """Row and column on the grid of points in the frame of the press; beyond the rim they count as on it."""
        z = points / self.table.film_radius
        z = z / np.maximum(np.abs(z), 1.0)
        c, rho = self.pole[which, None], self.rho[which, None]
        z = (z - c) / (1.0 - c * z)
        inside = np.abs(z) / (rho * (1.0 - MARGIN)) * (INSIDE - 1)
        outside = 1.0 - np.log(np.maximum(np.abs(z), rho)) / np.log(rho * (1.0 + MARGIN))
        row = np.where(np.abs(z) <= rho, inside, INSIDE + outside * (OUTSIDE - 1))
        return row, np.angle(z) * AROUND / (2.0 * np.pi)


def _row_weights(row: Array) -> tuple[Integers, Array]:
    """Neighbours and weights across the rows; the two sides of the probe's circle do not share neighbours."""
    within = (row < INSIDE - 0.5)[..., None]
    (near, by_near), (far, by_far) = cubic_weights(row, INSIDE), cubic_weights(row - INSIDE, OUTSIDE)
    return np.where(within, near, far + INSIDE), np.where(within, by_near, by_far)


def _stress_at(
    film: Film, surface: Surface, probe: Circle, force: float, settings: SolveSettings, distance: float
) -> Array:
    """Stress on the grid in the frame of the press, and its derivatives by all unknowns, shape (6, n_node, 3)."""
    points, step = _grid_points(film.radius, probe.radius, distance), SHIFT * probe.radius
    first = press(film, probe, (distance, 0.0), force, settings)

    def stress(x: float = 0.0, y: float = 0.0, log: float = 0.0, radius: float = 0.0, pretension: float = 0.0) -> Array:
        other, at = replace(film, pretension=film.pretension + pretension), (distance + x, y)
        pressed = press(other, Circle(probe.radius + radius), at, force * float(np.exp(log)), settings, start=first)
        return touch_stress(pressed, points, surface)

    derivatives = [
        (stress(**{name: size}) - stress(**{name: -size})) / (2.0 * size)
        for name, size in (("x", step), ("y", step), ("log", LOG_STEP), ("radius", step))
    ]
    base = touch_stress(first, points, surface)
    return np.stack([base, *derivatives, (stress(pretension=PRETENSION_STEP) - base) / PRETENSION_STEP])


def _grid_points(film_radius: float, probe_radius: float, distance: float) -> Array:
    """Film points (x, y) of the grid under a press on the positive x axis, shape (n_node, 2), mm."""
    a = film_radius
    c, rho = automorphism_onto(np.array(distance / a), np.array(probe_radius / a))
    inside = rho * (1.0 - MARGIN) * np.linspace(0.0, 1.0, INSIDE)
    outside = (rho * (1.0 + MARGIN)) ** np.linspace(1.0, 0.0, OUTSIDE)
    z = np.concatenate([inside, outside])[:, None] * np.exp(2j * np.pi * np.arange(AROUND) / AROUND)
    points = a * ((z + c) / (1.0 + c * z)).ravel() * (1.0 - 1e-12)
    return np.stack([points.real, points.imag], axis=1)
