"""The design of a layout: solve, search, refine, and refuse what is ambiguous."""

from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.errors import SolveError
from isocharge.common.progress import track
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.ambiguous_pairs import find_ambiguous_pairs
from isocharge.simulate.identifiability.folds import find_folds
from isocharge.simulate.layout.case import KNOWN, DesignCase, Nuisances
from isocharge.simulate.layout.charge_table import ChargeTable
from isocharge.simulate.layout.position_error import ErrorModel
from isocharge.simulate.layout.search import Search, random_layouts
from isocharge.simulate.numerics.disk import Rings
from isocharge.simulate.sensor.sensor import Sensor

DIGITS = 3
"""Places are rounded to a micrometre: decimals of a millimetre."""

UNAMBIGUOUS = "no folds, no ambiguous pairs"
"""What is said of a layout that has neither."""


@dataclass(frozen=True)
class ErrorMap:
    """Least position errors of one layout under the presses of a case.

    Attributes:
        presses: Square grid, shape (n, 2), mm.
        known: Errors if everything but the press is known, shape (n,), mm.
        unknown: Errors with the nuisances of the case, likewise.
    """

    presses: Array
    known: Array
    unknown: Array

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Worst error, its place and the root mean square for each level of knowledge, mm."""
        return {
            name: {
                "worst_mm": float(errors.max()),
                "rms_mm": float(np.sqrt(np.mean(errors**2))),
                "worst_at_mm": self.presses[np.argmax(errors)].round(DIGITS).tolist(),
            }
            for name, errors in (("noise_alone", self.known), ("with_nuisances", self.unknown))
        }


@dataclass(frozen=True)
class Design:
    """A designed layout.

    Attributes:
        case: What was asked.
        sensor: The sensor with the new layout.
        value: What was made small, mm.
        summary: Folds and ambiguous pairs of the new layout over the forces of use, for people.
        refused: Number of better layouts that are ambiguous.
        before: Errors of the sensor that it began from; None if that has fewer than three electrodes.
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
        """Whether no two contacts give the same charges, as far as known."""
        return self.summary == UNAMBIGUOUS

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the case, the layout, its errors and those of the sensor it began from, and what was checked."""
        return {
            "case": self.case.to_dict(),
            "sensor": self.sensor.name,
            "electrodes_mm": {e.name: np.round(e.centre, DIGITS).tolist() for e in self.sensor.electrodes},
            "before": self.before.to_dict() if self.before else None,
            "after": self.after.to_dict(),
            "unambiguous": self.unambiguous,
            "folds_and_pairs": self.summary,
            "refused": self.refused,
        }


def design(case: DesignCase, *, executor: Executor | None = None) -> Design:
    """The layout whose position errors are smallest: a minute for four electrodes.

    Args:
        case: What is asked.
        executor: Runs solves and refinements, in this process by default. The result does not depend on it.

    Raises:
        InputError: If the electrodes do not fit.
        SolveError: If an equilibrium is not reached.
    """
    places, starts = random_layouts(case)
    table = ChargeTable.solve(case.sensor, case.probe, case.force, case.radius, executor)
    search = Search(case, table)
    optima = search.optima(places, starts)
    refined = sorted(track(in_order(executor, search.refine, optima), "refining", len(optima)), key=lambda row: row[0])
    candidates = []
    for value, *numbers in track(refined, "looking for folds and ambiguous pairs"):
        sensor = case.layout(np.round(np.array(numbers).reshape(-1, 2), DIGITS))
        candidates.append((sensor, float(value), ambiguities(case, sensor)))
        if candidates[-1][2] == UNAMBIGUOUS:
            break
    refused = len(candidates) - 1 if candidates[-1][2] == UNAMBIGUOUS else 0
    before = error_map(case, table, case.sensor) if len(case.sensor.electrodes) >= 3 else None
    return Design(case, *candidates[refused], refused, before, error_map(case, table, candidates[refused][0]))


def ambiguities(case: DesignCase, sensor: Sensor) -> str:
    """Folds and ambiguous pairs of a layout over the forces of use by its forward map, for people."""
    low, high = min(DEFAULT_FORCE_RANGE[0], case.force), max(DEFAULT_FORCE_RANGE[1], case.force)
    forces = sorted({low, case.force, high})
    try:
        charges = ChargeSpline.of(ForwardMap.build(sensor, case.probe, case.radius, (low, high)))
    except SolveError:
        return "folds and ambiguous pairs could not be looked for: the charges vary too quickly"
    rings = Rings.spread(case.radius)
    folds = np.concatenate([find_folds(charges, rings, force, case.noise).points for force in forces])
    pairs = sum(len(find_ambiguous_pairs(charges, case.noise, force)) for force in forces)
    found = [f"the map folds {np.hypot(*folds.T).min():.1f} mm from the centre"] if len(folds) else []
    if pairs:
        found.append(f"{pairs} pairs of contacts have the same charges")
    return "; ".join(found) or UNAMBIGUOUS


def error_map(case: DesignCase, table: ChargeTable, sensor: Sensor) -> ErrorMap:
    """Errors of a sensor's electrodes at their nominal places."""
    rows = table.rows(case.grid, np.empty((0, 2)), 1.0, sensor.electrodes)

    def errors(nuisances: Nuisances) -> Array:
        return np.sqrt(ErrorModel.of(case.noise, nuisances).squared(rows))

    return ErrorMap(case.grid, errors(KNOWN), errors(case.nuisances))
