"""The design of a layout: solve, tabulate, search, polish, and check what the search cannot see."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.errors import SolveError
from isocharge.common.progress import StageProgress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.layout_assessment import LayoutAssessment, assess_layout
from isocharge.simulate.layout.goal import Goal
from isocharge.simulate.layout.local_search import POWERS, Descents, descend
from isocharge.simulate.layout.objective import Condition, Objective
from isocharge.simulate.layout.place_table import PlaceTable
from isocharge.simulate.layout.placing import Parameters
from isocharge.simulate.layout.polish import FineGrid, Polish, PolishJob, run_polish
from isocharge.simulate.layout.position_error import ErrorModel
from isocharge.simulate.layout.square_charges import SquareCharges, solve_square_charges
from isocharge.simulate.layout.task import DesignTask
from isocharge.simulate.numerics.disk import lattice, square_grid
from isocharge.simulate.sensor.sensor import Sensor

PRESSES = 600
"""Presses of the search; the last steps use the fine grid."""

SPACING = 0.3e-3
"""Spacing of the fine grid, m."""

STARTS, JOBS = 24, 8
"""Descents of a search, and the jobs that they are cut into."""

REFERENCE_STARTS = 6
"""Descents for each scene alone, where there are several."""

FINALISTS, ALIKE = 3, 2e-3
"""Different local optima that are polished and checked; nearer values of the objective, relative, are the same one."""

DIGITS = 6
"""Places are rounded to a micrometre: decimals of a metre."""


@dataclass(frozen=True)
class Candidate:
    """A layout that the search found.

    Attributes:
        centres: Of the new squares, shape (n, 2), m.
        sides: Shape (n,), m.
        value: Its error, m, relative to the best of each scene alone if there are several.
        assessment: Limits, folds and twins over the forces of use; None if that could not be computed.
    """

    centres: Array
    sides: Array
    value: float
    assessment: LayoutAssessment | None

    @property
    def unambiguous(self) -> bool:
        """Whether no two contacts give the same charges, as far as known."""
        return self.assessment is not None and not (len(self.assessment.folds) or len(self.assessment.twins))


@dataclass(frozen=True)
class Design:
    """A designed layout.

    Attributes:
        task: What was asked.
        sensor: The sensor with the new layout.
        charges: The stress of each scene's presses.
        candidates: The chosen layout first, then those that were refused and those that are worse.
        references: Error of the best layout for each scene alone, m; NaN if there is one scene only.
    """

    task: DesignTask
    sensor: Sensor
    charges: tuple[SquareCharges, ...]
    candidates: tuple[Candidate, ...]
    references: tuple[float, ...]

    @property
    def chosen(self) -> Candidate:
        """The chosen layout."""
        return self.candidates[0]


def design(
    sensor: Sensor,
    electrodes: int,
    radius: float,
    *,
    goal: str = "worst",
    map_jobs: JobMap = map,
    progress: StageProgress | None = None,
    **choices: Any,
) -> Design:
    """The layout whose position errors are smallest.

    Args:
        sensor: Film, coefficients and readout, and the electrodes that may stay.
        electrodes: Number of electrodes, 3 to 8.
        radius: Largest distance of a press from the film's centre, m.
        goal: "worst", "rms", or the path of a map of what matters, CSV with the columns x_mm, y_mm, weight.
        map_jobs: Runs solves and searches, in this process by default: `Workers.in_order`. The result does not depend
            on it.
        progress: Called with (done, total, stage).
        choices: Everything else that a `DesignTask` has: keep, probes, forces, pretensions, side, seed, ...

    Raises:
        InputError: If the task is impossible.
        SolveError: If an equilibrium is not reached.
    """
    task = DesignTask(sensor, electrodes, radius, Goal.of(goal), **choices)
    return run_design(task, map_jobs=map_jobs, progress=progress)


def run_design(
    task: DesignTask,
    *,
    map_jobs: JobMap = map,
    progress: StageProgress | None = None,
    starts: int = STARTS,
    presses: int = PRESSES,
) -> Design:
    """As `design`, of a whole task; with `starts` descents on `presses` presses."""
    task.check()
    search = Search.prepare(task, presses, map_jobs, progress)
    optima = search.descents(search.conditions, starts, map_jobs, progress)
    finalists = search.polished(_different(optima), map_jobs, progress)
    candidates: list[Candidate] = []
    for number, (parameters, row) in enumerate(finalists):
        centres, sides = parameters.layout(row[1:])
        centres, sides = np.round(centres, DIGITS), np.round(sides, DIGITS)
        _report(progress, number, len(finalists), "looking for folds and twins")
        candidate = Candidate(centres, sides, float(row[0]), assess(task, centres, sides))
        candidates.append(candidate)
        if candidate.unambiguous:
            break
    candidates.sort(key=lambda candidate: (not candidate.unambiguous, candidate.value))
    chosen = candidates[0]
    sensor = task.layout(chosen.centres, chosen.sides, name_of(task))
    references = tuple(condition.reference for condition in search.conditions)
    return Design(task, sensor, search.charges, tuple(candidates), references if len(references) > 1 else (math.nan,))


def name_of(task: DesignTask) -> str:
    """Name of the designed sensor."""
    return f"{task.sensor.name}-{task.electrodes}-over-{1e3 * task.radius:g}mm"


def assess(task: DesignTask, centres: Array, sides: Array) -> LayoutAssessment | None:
    """Folds and twins of a layout over the radius and the forces of use; None if its charges cannot be interpolated."""
    low, high = min(DEFAULT_FORCE_RANGE[0], *task.forces), max(DEFAULT_FORCE_RANGE[1], *task.forces)
    pretension = (task.pretensions or (task.sensor.film.pretension,))[0]
    sensor = task.layout(centres, sides, "candidate")
    sensor = replace(sensor, film=replace(sensor.film, pretension=pretension))
    try:
        forward_map = ForwardMap.build(sensor, task.probes[0], task.radius, (low, high))
    except SolveError:
        return None
    forces = tuple(sorted({low, min(task.forces), high}))
    return assess_layout(ChargeSpline.of(forward_map), task.noise, radius=task.radius, forces=forces)


@dataclass(frozen=True)
class Search:
    """The tables of a task, and the searches on them.

    Attributes:
        task: The task.
        errors: What is known and what not.
        charges: The stress of each scene's presses.
        conditions: The scenes as the search sees them.
    """

    task: DesignTask
    errors: ErrorModel
    charges: tuple[SquareCharges, ...]
    conditions: tuple[Condition, ...]

    @classmethod
    def prepare(cls, task: DesignTask, presses: int, map_jobs: JobMap, progress: StageProgress | None) -> "Search":
        """Solve and tabulate all scenes; where there are several, find the best layout for each alone."""
        unit = lattice(presses)
        at = task.radius * np.stack([unit.real, unit.imag], axis=1)
        weights, charges, conditions = task.goal.weigh(at), [], []
        for scene in task.scenes:
            sensor = replace(task.sensor, film=scene.film)
            solved = solve_square_charges(
                sensor, scene, map_jobs=map_jobs, progress=_stage(progress, "solving the film")
            )
            table = PlaceTable.build(
                solved, at, task.sides, map_jobs=map_jobs, progress=_stage(progress, "tabulating charges")
            )
            charges.append(solved)
            conditions.append(Condition(table, _rows_that_stay(task, solved, at), weights, 1.0))
        errors = ErrorModel.of(task.noise, task.nuisances)
        search = cls(task, errors, tuple(charges), tuple(conditions))
        if len(conditions) == 1:
            return search
        alone = [
            replace(one, reference=search._best(one, map_jobs, progress, f"scene {number} alone"))
            for number, one in enumerate(conditions, start=1)
        ]
        return replace(search, conditions=tuple(alone))

    def _best(self, condition: Condition, map_jobs: JobMap, progress: StageProgress | None, stage: str) -> float:
        optima = self.descents((condition,), REFERENCE_STARTS, map_jobs, progress, stage)
        return float(np.exp(min(row[0] for _, rows in optima for row in rows)))

    def descents(
        self,
        conditions: tuple[Condition, ...],
        starts: int,
        map_jobs: JobMap,
        progress: StageProgress | None,
        stage: str = "searching",
    ) -> list[tuple[Parameters, Array]]:
        """Local optima of each kind of parameters: rows of the objective's value and the free numbers."""
        kinds = self.task.parameters
        count = -(-starts // (JOBS * len(kinds)))
        jobs, owner = [], []
        for kind, parameters in enumerate(kinds):
            objective = Objective(conditions, self.errors, parameters, self.task.rules, POWERS[self.task.goal.kind][-1])
            for number in range(max(1, min(JOBS, starts // len(kinds)))):
                jobs.append(Descents(objective, self.task.goal.kind, (self.task.seed, kind, number), count))
                owner.append(parameters)
        optima, best = [], np.inf
        for done, (parameters, rows) in enumerate(zip(owner, map_jobs(descend, jobs), strict=True), start=1):
            best = min(best, float(np.exp(rows[:, 0].min())))
            optima.append((parameters, rows))
            _report(progress, done, len(jobs), stage if len(conditions) > 1 else f"{stage}: {1e3 * best:.3f} mm")
        return optima

    def polished(
        self, optima: list[tuple[Parameters, Array]], map_jobs: JobMap, progress: StageProgress | None
    ) -> list[tuple[Parameters, Array]]:
        """The optima on the fine grid, the best first; other goals than the worst error need no finer grid."""
        if self.task.goal.kind != "worst":
            return [(parameters, np.concatenate([[np.exp(row[0])], row[1:]])) for parameters, row in optima]
        at = square_grid(self.task.radius, SPACING)
        grids = tuple(
            FineGrid(solved, at, _rows_that_stay(self.task, solved, at), condition.reference)
            for solved, condition in zip(self.charges, self.conditions, strict=True)
        )
        jobs = [
            PolishJob(Polish(grids, self.errors, parameters, self.task.rules), row[1:]) for parameters, row in optima
        ]
        rows = []
        for done, row in enumerate(map_jobs(run_polish, jobs), start=1):
            rows.append(row)
            _report(progress, done, len(jobs), "polishing on the fine grid")
        order = np.argsort([row[0] for row in rows])
        return [(jobs[i].polish.parameters, rows[i]) for i in order]


def _different(optima: list[tuple[Parameters, Array]]) -> list[tuple[Parameters, Array]]:
    """The best local optima that differ in their value: the same layout, turned, has nearly the same one."""
    every = sorted(((parameters, row) for parameters, rows in optima for row in rows), key=lambda one: float(one[1][0]))
    chosen: list[tuple[Parameters, Array]] = []
    for parameters, row in every:
        if len(chosen) < FINALISTS and all(row[0] - other[0] > ALIKE for _, other in chosen):
            chosen.append((parameters, row))
    return chosen


def _rows_that_stay(task: DesignTask, charges: SquareCharges, presses: Array) -> Array:
    """Rows of the electrodes that stay, shape (n_press, n_stay, 7)."""
    pressed = charges.under(presses)
    rows = [pressed.electrode(electrode) for electrode in task.stay]
    return np.stack(rows, axis=1) if rows else np.empty((len(presses), 0, 7))


def _stage(progress: StageProgress | None, stage: str) -> Any:
    return (lambda done, total: progress(done, total, stage)) if progress else None


def _report(progress: StageProgress | None, done: int, total: int, stage: str) -> None:
    if progress:
        progress(done, total, stage)
