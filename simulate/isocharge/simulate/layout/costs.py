"""What a design is worth and what it costs: errors before and after, placement tolerances, other sizes and numbers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.json_values import finite_or_none
from isocharge.common.progress import StageProgress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.layout.design import SPACING, Design, Search
from isocharge.simulate.layout.position_error import ErrorModel
from isocharge.simulate.layout.scene import Nuisances
from isocharge.simulate.layout.square_charges import COLUMNS, SquareCharges
from isocharge.simulate.layout.task import MOST_ELECTRODES, DesignTask
from isocharge.simulate.numerics.disk import square_grid
from isocharge.simulate.sensor.sensor import Sensor

TOLERANCES = (0.1e-3, 0.2e-3, 0.3e-3, 0.4e-3, 0.5e-3)
"""Placement tolerances, m: every electrode is off by up to this much along x and along y."""

DRAWS = 12
"""Random displacements for each tolerance."""

COARSE = 0.8e-3
"""Spacing of the presses for the tolerances, m."""

TRADE_STARTS, TRADE_PRESSES = 8, 300
"""Descents and presses for each point of a trade-off."""

RADII, SIZES = (0.5, 0.75, 1.0, 1.25), (0.5, 1.0, 1.5, 2.0)
"""Radii and sides of a trade-off over those of the task."""


@dataclass(frozen=True)
class ErrorMap:
    """Position errors of one layout in one scene.

    Attributes:
        presses: Square grid, shape (n, 2), m.
        noise_alone: Errors if everything is known, shape (n,), m.
        probe_and_pretension: Errors with the radius of the probe and the pretension unknown, likewise.
        task: Errors with the nuisances of the task, likewise.
    """

    presses: Array
    noise_alone: Array
    probe_and_pretension: Array
    task: Array

    @classmethod
    def of(cls, sensor: Sensor, charges: SquareCharges, task: DesignTask) -> "ErrorMap":
        """Errors on the fine grid of the electrodes of a sensor at their nominal places."""
        presses = square_grid(task.radius, SPACING)
        rows = rows_of(sensor, charges, presses)
        levels = (Nuisances.none(), Nuisances.probe_and_pretension(), task.nuisances)
        return cls(presses, *(np.sqrt(ErrorModel.of(task.noise, level).squared(rows)) for level in levels))

    def to_dict(self) -> dict[str, dict[str, float]]:
        """Worst error and root mean square for each level of knowledge, mm."""
        return {
            name: {
                "worst_mm": 1e3 * float(errors.max()),
                "rms_mm": 1e3 * float(np.sqrt(np.mean(errors**2))),
                "worst_at_mm": (1e3 * self.presses[int(np.argmax(errors))]).round(3).tolist(),
            }
            for name, errors in (
                ("noise_alone", self.noise_alone),
                ("probe_and_pretension_unknown", self.probe_and_pretension),
                ("nuisances_of_the_task", self.task),
            )
        }


def rows_of(sensor: Sensor, charges: SquareCharges, presses: Array) -> Array:
    """Rows of a sensor's electrodes at their nominal places, shape (n_press, n_electrode, 7)."""
    pressed = charges.under(presses)
    rows = np.empty((len(presses), len(sensor.electrodes), len(COLUMNS)))
    squares = [i for i, electrode in enumerate(sensor.electrodes) if electrode.square]
    for i, electrode in enumerate(sensor.electrodes):
        if not electrode.square:
            rows[:, i] = pressed.electrode(electrode)
    if squares:
        chosen = [sensor.electrodes[i] for i in squares]
        sides = np.array([electrode.corners[1][0] - electrode.corners[0][0] for electrode in chosen])
        rows[:, squares] = pressed.layout(np.array([electrode.centre for electrode in chosen]), sides)
    return rows


@dataclass(frozen=True)
class ToleranceCost:
    """What it costs if every electrode is off by up to `tolerance`, m, along x and along y.

    Attributes:
        tolerance: m.
        measured: 95th percentile over random displacements of the worst error, m, if the places are measured
            afterwards.
        unmeasured: Additional position error, root mean square over the presses, m, if they are not.
    """

    tolerance: float
    measured: float
    unmeasured: float


def tolerance_costs(design: Design, seed: int = 0) -> tuple[ToleranceCost, ...]:
    """Costs of placement tolerances, in the first scene of the design."""
    task, charges = design.task, design.charges[0]
    pressed, model = charges.under(square_grid(task.radius, COARSE)), ErrorModel.of(task.noise, task.nuisances)
    squares = [electrode for electrode in design.sensor.electrodes if electrode.square]
    centres = np.array([electrode.centre for electrode in squares])
    sides = np.array([electrode.corners[1][0] - electrode.corners[0][0] for electrode in squares])
    others = [pressed.electrode(electrode) for electrode in design.sensor.electrodes if not electrode.square]

    def rows(moved: Array) -> Array:
        return np.concatenate([pressed.layout(moved, sides), *(one[:, None] for one in others)], axis=1)

    shift = model.displacement(rows(centres))[:, :, : len(squares)]
    by_place = pressed.layout_gradient(centres, sides)[:, :, 0, :2]
    wrong = float(np.sqrt(np.mean(np.einsum("kie,ked->k", shift**2, by_place**2))))
    rng, costs = np.random.default_rng(seed), []
    for tolerance in TOLERANCES:
        worst = [
            float(np.sqrt(model.squared(rows(centres + tolerance * rng.uniform(-1.0, 1.0, centres.shape))).max()))
            for _ in range(DRAWS)
        ]
        costs.append(ToleranceCost(tolerance, float(np.quantile(worst, 0.95)), wrong * tolerance / np.sqrt(3.0)))
    return tuple(costs)


@dataclass(frozen=True)
class TradeOff:
    """Errors of the best layouts against radius and against size.

    Attributes:
        radius: m, shape (n_radius,).
        by_number: Error for each number of electrodes, shape (n_radius,), m; NaN where they do not fit.
        side: m, shape (n_side,).
        by_side: Error of the task's number of electrodes, shape (n_side,), m.
    """

    radius: Array
    by_number: dict[int, Array]
    side: Array
    by_side: Array

    def to_dict(self) -> dict[str, Any]:
        """For JSON, mm."""
        return {
            "radius_mm": (1e3 * self.radius).tolist(),
            "error_mm_by_electrodes": {
                str(number): [finite_or_none(1e3 * float(error)) for error in errors]
                for number, errors in self.by_number.items()
            },
            "side_mm": (1e3 * self.side).tolist(),
            "error_mm_by_side": [finite_or_none(1e3 * float(error)) for error in self.by_side],
        }


def trade_off(
    task: DesignTask,
    *,
    numbers: Sequence[int] = tuple(range(3, MOST_ELECTRODES + 1)),
    map_jobs: JobMap = map,
    progress: StageProgress | None = None,
) -> TradeOff:
    """Errors of rough searches, without the last steps: a few minutes.

    The goal, forces, nuisances and rules are those of the task; no electrode stays.
    """
    free = replace(task, keep=(), symmetry="none")
    radii = np.array([share * task.radius for share in RADII])
    sides = np.array([share * task.sides[0] for share in SIZES])
    by_radius = [_rough(replace(free, radius=float(radius)), numbers, map_jobs, progress) for radius in radii]
    by_side = [
        _rough(replace(free, side=(float(side), float(side))), (task.electrodes,), map_jobs, progress)[task.electrodes]
        for side in sides
    ]
    by_number = {number: np.array([errors[number] for errors in by_radius]) for number in numbers}
    return TradeOff(radii, by_number, sides, np.array(by_side))


def _rough(
    task: DesignTask, numbers: Sequence[int], map_jobs: JobMap, progress: StageProgress | None
) -> dict[int, float]:
    """Error of the best layout that a rough search finds, m, by number of electrodes."""
    search = Search.prepare(replace(task, electrodes=min(numbers)), TRADE_PRESSES, map_jobs, progress)
    errors = {}
    for number in numbers:
        one = replace(search, task=replace(task, electrodes=number))
        optima = one.descents(search.conditions, TRADE_STARTS, map_jobs, progress)
        errors[number] = float(np.exp(min(float(row[0]) for _, rows in optima for row in rows)))
    return errors


def design_to_dict(design: Design, before: Sequence[ErrorMap], after: Sequence[ErrorMap]) -> dict[str, Any]:
    """For JSON: the task, the layout, its errors and those of the sensor it began from, and what was checked."""
    chosen, scenes = design.chosen, design.task.scenes
    assessment = chosen.assessment
    return {
        "task": design.task.to_dict(),
        "sensor": design.sensor.name,
        "electrodes_mm": {
            electrode.name: [round(1e3 * value, 6) for value in electrode.centre]
            for electrode in design.sensor.electrodes
        },
        "scenes": [
            {
                "probe": scene.probe.notation,
                "force_N": scene.force,
                "pretension_MPa": 1e-6 * scene.film.pretension,
                "best_alone_mm": finite_or_none(1e3 * reference),
                "before": before[number].to_dict() if before else None,
                "after": after[number].to_dict(),
            }
            for number, (scene, reference) in enumerate(zip(scenes, design.references, strict=True))
        ],
        "folds_and_twins": assessment.words if assessment else "could not be looked for: the charges vary too quickly",
        "unambiguous": chosen.unambiguous,
        "refused": len(design.candidates) - 1,
        "placement": [
            {
                "tolerance_mm": 1e3 * cost.tolerance,
                "worst_if_measured_mm": 1e3 * cost.measured,
                "added_rms_if_not_mm": 1e3 * cost.unmeasured,
            }
            for cost in tolerance_costs(design)
        ],
    }
