"""Design of a layout: search of the electrode positions, and rejection of layouts with ambiguous charges."""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.errors import SolveError
from isocharge.common.progress import track
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.ambiguous_pairs import find_ambiguous_pairs
from isocharge.simulate.identifiability.folds import find_folds
from isocharge.simulate.layout.case import NO_NUISANCES, DesignCase
from isocharge.simulate.layout.charge_table import ChargeTable
from isocharge.simulate.layout.position_error import ErrorModel
from isocharge.simulate.layout.search import Search, random_layouts
from isocharge.simulate.numerics.disk import Rings
from isocharge.simulate.sensor.sensor import Sensor

DECIMALS = 3
"""Number of decimals to which positions in mm are rounded. It corresponds to one micrometre."""

UNAMBIGUOUS = "no folds, no ambiguous pairs"
"""Summary of a layout without folds and ambiguous pairs."""

NOT_SEARCHED = "folds and ambiguous pairs could not be looked for: the charges vary too quickly"
"""Summary of a layout whose charges cannot be interpolated."""


@dataclass(frozen=True)
class ErrorMap:
    """Lower limits of the position error of one layout. The limits are computed for the presses of a design case.

    Attributes:
        presses: Positions of the presses on a square grid, shape (n, 2), mm.
        noise_alone: Errors caused by the noise if there are no nuisances, shape (n,), mm.
        with_nuisances: Errors with the nuisances of the case, shape (n,), mm.
    """

    presses: Array
    noise_alone: Array
    with_nuisances: Array

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Return the largest error, its position and the root mean square, without and with nuisances, for JSON."""
        return {
            "noise_alone": self._statistics(self.noise_alone),
            "with_nuisances": self._statistics(self.with_nuisances),
        }

    def _statistics(self, errors: Array) -> dict[str, Any]:
        """Return the largest error, its root mean square and the position of the largest error, for JSON."""
        return {
            "worst_mm": float(errors.max()),
            "rms_mm": float(np.sqrt(np.mean(errors**2))),
            "worst_at_mm": self.presses[np.argmax(errors)].round(DECIMALS).tolist(),
        }


@dataclass(frozen=True)
class Design:
    """Result of the design of a layout.

    Attributes:
        case: Design case.
        sensor: Sensor with the new layout.
        value: Quantity that the search minimised, for the new layout, mm.
        summary: Sentence about folds and ambiguous pairs of the new layout over the default range of forces.
        refused: Number of layouts with a smaller error that were rejected because they are ambiguous.
        before: Errors of the initial sensor; None if it has fewer than three electrodes.
        after: Errors of the new layout.
    """

    case: DesignCase
    sensor: Sensor
    value: float
    summary: str
    refused: int
    before: ErrorMap | None
    after: ErrorMap

    @property
    def unambiguous(self) -> bool:
        """Whether neither folds nor ambiguous pairs were found."""
        return self.summary == UNAMBIGUOUS

    def to_dict(self) -> dict[str, Any]:
        """Return the case, the layout, the errors before and after, and the result of the checks, for JSON."""
        return {
            "case": self.case.to_dict(),
            "sensor": self.sensor.name,
            "electrodes_mm": {
                electrode.name: np.round(electrode.centre, DECIMALS).tolist() for electrode in self.sensor.electrodes
            },
            "before": self.before.to_dict() if self.before else None,
            "after": self.after.to_dict(),
            "unambiguous": self.unambiguous,
            "folds_and_pairs": self.summary,
            "refused": self.refused,
        }


def design(case: DesignCase, *, executor: Executor | None = None) -> Design:
    """Find the layout with the smallest position errors that has neither folds nor ambiguous pairs.

    Random layouts are improved on a grid, and the best layouts are refined. The refined layouts are checked in the
    order of their errors. If all of them are ambiguous, the layout with the smallest error is returned.

    Args:
        case: Design case.
        executor: Executor that runs the solves and the refinements; this process if absent. The result does not depend
            on the executor.

    Returns:
        The layout, its errors, and the errors of the initial sensor if it has at least three electrodes.

    Raises:
        InputError: If the electrodes do not fit.
        SolveError: If an equilibrium is not reached.
    """
    # Improve random layouts, and refine the best ones.
    grid, initial_layouts = random_layouts(case)
    table = ChargeTable.solve(case.sensor, case.probe, case.force, case.radius, executor)
    search = Search(case, table)
    optima = search.optima(grid, initial_layouts)
    # A refined layout is an array of its error, followed by the coordinates of its squares.
    refined_layouts = list(track(in_order(executor, search.refine, optima), "refining", len(optima)))
    refined_layouts.sort(key=lambda layout: layout[0])

    # Check the layouts in the order of their errors, up to the first layout that is not ambiguous.
    forward_map = _solve_forward_map(case, executor)
    candidates: list[tuple[Sensor, float, str]] = []
    for error, *coordinates in track(refined_layouts, "looking for folds and ambiguous pairs"):
        centres = np.round(np.array(coordinates).reshape(-1, 2), DECIMALS)  # x and y of one square after the other
        sensor = case.layout(centres)
        summary = NOT_SEARCHED
        if forward_map is not None:
            summary = ambiguities(case, ChargeSpline.of(replace(forward_map, sensor=sensor)))
        candidates.append((sensor, float(error), summary))
        if summary == UNAMBIGUOUS:
            break

    # If the last candidate is unambiguous, it is chosen, and the candidates before it are refused. Otherwise all
    # candidates are ambiguous, and the candidate with the smallest error is chosen, which is the first one.
    has_unambiguous_candidate = summary == UNAMBIGUOUS
    if has_unambiguous_candidate:
        n_refused = len(candidates) - 1
        chosen = candidates[-1]
    else:
        n_refused = 0
        chosen = candidates[0]
    sensor, error, summary = chosen
    errors_before = error_map(case, table, case.sensor) if len(case.sensor.electrodes) >= 3 else None
    errors_after = error_map(case, table, sensor)
    return Design(case, sensor, error, summary, n_refused, errors_before, errors_after)


def _solve_forward_map(case: DesignCase, executor: Executor | None) -> ForwardMap | None:
    """Build the forward map of the film for the default range of forces, which is extended to the force of the case.

    The stress does not depend on the electrodes, so all layouts use the same map.

    Args:
        case: Design case.
        executor: Executor that runs the solves; this process if absent.

    Returns:
        Map with the electrodes of the sensor of the case, or None if it does not reach its accuracy.
    """
    default_min_force, default_max_force = DEFAULT_FORCE_RANGE
    force_range = (min(default_min_force, case.force), max(default_max_force, case.force))
    try:
        return ForwardMap.build(case.sensor, case.probe, case.radius, force_range, executor=executor)
    except SolveError:
        return None


def ambiguities(case: DesignCase, charges: ChargeMap) -> str:
    """Search for folds and ambiguous pairs of a layout, and summarise them in a sentence.

    The search covers the smallest and the largest force of the charge map, and the force of the case.

    Args:
        case: Design case.
        charges: Charges of the layout as a function of the contact.

    Returns:
        `UNAMBIGUOUS`, or a sentence about the folds and pairs.
    """
    min_force, max_force = charges.domain.force_range
    forces = sorted({min_force, case.force, max_force})
    rings = Rings.spread(case.radius)
    fold_points = np.concatenate([find_folds(charges, rings, force, case.noise).points for force in forces])
    pair_count = sum(len(find_ambiguous_pairs(charges, case.noise, force)) for force in forces)

    findings = []
    if len(fold_points):
        x, y = fold_points.T
        findings.append(f"the map folds {np.hypot(x, y).min():.1f} mm from the centre")
    if pair_count:
        findings.append(f"{pair_count} pairs of contacts have the same charges")
    return "; ".join(findings) or UNAMBIGUOUS


def error_map(case: DesignCase, table: ChargeTable, sensor: Sensor) -> ErrorMap:
    """Compute the position errors of a sensor whose electrodes lie at their nominal positions.

    Args:
        case: Design case, which contains the positions, the noise and the nuisances.
        table: Charge table of the case.
        sensor: Sensor with the layout.

    Returns:
        Position errors for the noise alone, and for the noise and the nuisances, mm.
    """
    # All electrodes are given by their shapes, so the table is evaluated without squares.
    no_squares = np.empty((0, 2))
    unused_side = 1.0
    charge_rows = table.rows(case.fine_grid, no_squares, unused_side, sensor.electrodes)
    error_by_noise = np.sqrt(ErrorModel.of(case.noise, NO_NUISANCES).squared(charge_rows))
    error_with_nuisances = np.sqrt(ErrorModel.of(case.noise, case.nuisances).squared(charge_rows))
    return ErrorMap(case.fine_grid, error_by_noise, error_with_nuisances)
