"""Charges of squares anywhere on the film, with their derivatives by the press, by nuisances, and by the squares.

Everything that a layout needs to be judged is linear in the stress, so one square is one row, whatever the others are.
The columns of a row are the charge, its derivatives by the x, y and ln F of the press, and its change by one standard
deviation of each nuisance of the scene: radius of the probe, profile of its pressure, pretension.

The pressure of a rigid flat punch has a larger second moment about its centre than a uniform one, R^2 2/3 instead of
R^2 / 2, and that is what reaches beyond the footprint. The load is moved outwards by that much: a disk of radius R
gives way to rings between R and a smaller radius b, and to first order charges follow the load.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.common.progress import Progress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.forward.readout import electrode_rule
from isocharge.simulate.forward.solve_family import report_each
from isocharge.simulate.layout.scene import DesignScene
from isocharge.simulate.layout.stress_table import (
    PressedTable,
    SolveJob,
    StressTable,
    distances,
    settings_for,
    solve_job,
)
from isocharge.simulate.mechanics.stress import turn_stress
from isocharge.simulate.mechanics.theory import theory_for
from isocharge.simulate.numerics.quadrature import gauss_line
from isocharge.simulate.sensor.electrode import Electrode
from isocharge.simulate.sensor.film import Piezo
from isocharge.simulate.sensor.sensor import Readout, Sensor
from isocharge.simulate.solver.settings import SolveSettings

Rule = Callable[[int], tuple[Array, Array]]
"""From points per side to points of the unit square, shape (n, 2), and shares of (s11, s22, s12), shape (n, 3)."""

COLUMNS = ("charge", "x", "y", "ln force", "probe radius", "profile", "pretension")
"""Columns of a row."""

RULES = ((1.4, 10), (2.5, 4), (np.inf, 2))
"""Gauss points per side of a square by its distance from the press, in units of half its diagonal plus the probe's
radius; nearer than the first the kink of the stress on the footprint's edge crosses it."""

CLOSEST = 0.2e-3
"""Presses nearer to the film's centre count as this far from it, m: the sideways derivative is a quotient there."""

PUNCH = 1.0 / 6.0
"""Second moment of a punch's pressure less that of a uniform one, in units of the squared radius."""

DIFFERENCE = 2e-5
"""Step of the differences by place and side with the edge readout, m."""

CHUNK = 20_000
"""Points evaluated at once: keeps the working arrays within some 100 MB."""


@dataclass(frozen=True)
class SquareCharges:
    """Charges of squares under the presses of one scene.

    Attributes:
        scene: The scene.
        tables: Stress of the scene's probe, of a smaller and of a larger one.
        piezo: Coefficients.
        readout: "area" or "edge".
    """

    scene: DesignScene
    tables: tuple[StressTable, StressTable, StressTable]
    piezo: Piezo
    readout: Readout

    def under(self, presses: Array) -> "PressedSquares":
        """Charges of squares under presses (x, y), shape (n, 2), m."""
        at = presses @ np.array([1.0, 1j])
        different, which = np.unique(np.round(np.maximum(np.abs(at), CLOSEST), 12), return_inverse=True)
        tables = tuple(table.at(different, derivatives=number == 0) for number, table in enumerate(self.tables))
        return PressedSquares(self, presses, np.exp(1j * np.angle(at)), which.ravel(), tables)


@dataclass(frozen=True)
class PressedSquares:
    """Charges of squares under given presses.

    Attributes:
        source: The scene.
        presses: (x, y), shape (n, 2), m.
        turn: Direction of each press as a complex number, shape (n,).
        which: Number of each press's distance in the tables, shape (n,).
        tables: Stress of the scene's probe, of a smaller and of a larger one, at the distances of the presses.
    """

    source: SquareCharges
    presses: Array
    turn: Complexes
    which: Integers
    tables: tuple[PressedTable, ...]

    def rows(self, number: Integers, centres: Array, sides: Array) -> Array:
        """Rows of pairs of a press and a square.

        Args:
            number: Of the presses, shape (n,).
            centres: Of the squares, shape (n, 2), m.
            sides: Shape (n,), m.

        Returns:
            Shape (n, 7), the columns of COLUMNS: C, C/m, C/m, C, and C per unit of each nuisance (m, 1, Pa).
        """
        return self._by_distance(number, centres, sides, self._mean_rule)

    def gradient(self, number: Integers, centres: Array, sides: Array) -> Array:
        """Derivatives of the rows by the square's x, y and side, shape (n, 7, 3), per m.

        A square that moves gains what lies under its leading edge and loses what was under the other.
        """
        if self.source.readout == "edge":
            return self._differences(number, centres, sides)
        parts = [self._by_distance(number, centres, sides, rule) for rule in (_right, _left, _upper, _lower)]
        right, left, upper, lower = (part / sides[:, None] for part in parts)
        return np.stack([right - left, upper - lower, 0.5 * (right + left + upper + lower)], axis=-1)

    def layout(self, centres: Array, sides: Array) -> Array:
        """Rows of all presses and the squares of a layout, shape (n_press, n_square, 7)."""
        number, centre, side = self._pairs(centres, sides)
        return self.rows(number, centre, side).reshape(len(self.presses), len(centres), -1)

    def layout_gradient(self, centres: Array, sides: Array) -> Array:
        """Derivatives of `layout` by the x, y and side of each square, shape (n_press, n_square, 7, 3)."""
        number, centre, side = self._pairs(centres, sides)
        return self.gradient(number, centre, side).reshape(len(self.presses), len(centres), -1, 3)

    def electrode(self, electrode: Electrode) -> Array:
        """Rows of one electrode of any shape, shape (n_press, 7)."""
        points, shares = electrode_rule(electrode, self.source.readout, RULES[0][1])
        number = np.arange(len(self.presses))
        size = max(CHUNK // len(points), 1)
        chunks = [number[start : start + size] for start in range(0, len(number), size)]
        rows = [self._evaluate(n, np.broadcast_to(points, (len(n), *points.shape)), shares) for n in chunks]
        return electrode.area * np.concatenate(rows)

    def _pairs(self, centres: Array, sides: Array) -> tuple[Integers, Array, Array]:
        number = np.repeat(np.arange(len(self.presses)), len(centres))
        return number, np.tile(centres, (len(self.presses), 1)), np.tile(sides, len(self.presses))

    def _differences(self, number: Integers, centres: Array, sides: Array) -> Array:
        """As `gradient`, by central differences."""
        columns = []
        for axis in range(3):
            step, grown = DIFFERENCE * np.eye(3)[axis, :2], DIFFERENCE * float(axis == 2)
            ahead = self.rows(number, centres + step, sides + grown)
            columns.append((ahead - self.rows(number, centres - step, sides - grown)) / (2.0 * DIFFERENCE))
        return np.stack(columns, axis=-1)

    def _mean_rule(self, count: int) -> tuple[Array, Array]:
        """Points of the unit square about the origin and shares of the mean of the readout."""
        return electrode_rule(Electrode.of_square("", (0.0, 0.0), 1.0), self.source.readout, count)

    def _by_distance(self, number: Integers, centres: Array, sides: Array, rule: Rule) -> Array:
        """Rows of pairs, each with as many points as its distance needs."""
        unit = np.sqrt(0.5) * sides + self.source.scene.probe.radius
        level = np.searchsorted([reach for reach, _ in RULES], np.hypot(*(centres - self.presses[number]).T) / unit)
        rows = np.empty((len(number), len(COLUMNS)))
        for rank, (_, count) in enumerate(RULES):
            points, shares = rule(count)
            chosen = np.flatnonzero(level == rank)
            for start in range(0, chosen.size, size := max(CHUNK // len(points), 1)):
                pair = chosen[start : start + size]
                at = centres[pair, None] + sides[pair, None, None] * points
                rows[pair] = self._evaluate(number[pair], at, shares) * sides[pair, None] ** 2
        return rows

    def _evaluate(self, number: Integers, points: Array, shares: Array) -> Array:
        """Rows for points (n, n_point, 2) with shares (n_point, 3) of (s11, s22, s12)."""
        scene, which, turn = self.source.scene, self.which[number], self.turn[number, None]
        local = (points @ np.array([1.0, 1j])) / turn
        table, smaller, larger = self.tables
        charge, along, across, by_force, by_pretension = (
            self._charge(channel, turn, shares) for channel in table.channels(which, local)
        )
        less, more = (self._charge(other.stress(which, local), turn, shares) for other in (smaller, larger))
        radius, b = scene.probe.radius, scene.probe.radius - scene.radius_step
        by_radius = (more - less) / (2.0 * scene.radius_step)
        by_profile = 2.0 * PUNCH * radius**2 / (radius**2 - b**2) * (charge - less)
        cos, sin = turn[:, 0].real, turn[:, 0].imag
        by_x, by_y = cos * along - sin * across, sin * along + cos * across
        return np.stack([charge, by_x, by_y, by_force, by_radius, by_profile, by_pretension], axis=1)

    def _charge(self, stress: Array, turn: Complexes, shares: Array) -> Array:
        """Charge per area from stress (n, n_point, n_component) in the frames of the presses."""
        piezo = self.source.piezo
        if stress.shape[-1] == 1:
            trace: Array = piezo.d31 * (stress[..., 0] @ shares[:, 0])
            return trace
        film = turn_stress(stress, np.angle(turn))
        charge: Array = np.einsum("kpc,pc->k", film, shares * [piezo.d31, piezo.d32, 0.0])
        return charge


def _edge(x: float | None, y: float | None) -> Rule:
    """The mean over one edge of the unit square: x or y is given, the other runs along it."""

    def rule(count: int) -> tuple[Array, Array]:
        along, share = gauss_line(count)
        points = np.stack(
            [np.full(count, x) if x is not None else along - 0.5, np.full(count, y) if y is not None else along - 0.5],
            axis=1,
        )
        return points, np.repeat(share[:, None], 3, axis=1)

    return rule


_right, _left, _upper, _lower = _edge(0.5, None), _edge(-0.5, None), _edge(None, 0.5), _edge(None, -0.5)


def solve_square_charges(
    sensor: Sensor, scene: DesignScene, *, map_jobs: JobMap = map, progress: Progress | None = None
) -> SquareCharges:
    """Solve the presses of a scene, some fifty.

    Args:
        sensor: Its coefficients and readout are used.
        scene: The presses.
        map_jobs: Runs the solves, in this process by default.
        progress: Called with (done, total) solves.

    Raises:
        SolveError: If an equilibrium is not reached.
    """
    theory = theory_for(sensor, scene.probe, (scene.force, scene.force))
    jobs, scenes = [], []
    for change in (0.0, -scene.radius_step, scene.radius_step):
        varied = scene.with_probe(scene.probe.radius + change)
        settings = settings_for(varied, SolveSettings(theory=theory))
        scenes.append(varied)
        jobs += [
            SolveJob(varied, float(distance), settings, sensor.surface, change == 0.0)
            for distance in distances(scene.radius, scene.film.radius)
        ]
    solved = list(report_each(map_jobs(solve_job, jobs), len(jobs), progress))
    count = len(jobs) // 3
    tables = [StressTable.of(varied, np.stack(solved[i * count : (i + 1) * count])) for i, varied in enumerate(scenes)]
    isotropic = sensor.piezo.d31 == sensor.piezo.d32 and sensor.readout == "area"
    plain, smaller, larger = (table.trace() if isotropic else table for table in tables)
    return SquareCharges(scene, (plain, smaller, larger), sensor.piezo, sensor.readout)
