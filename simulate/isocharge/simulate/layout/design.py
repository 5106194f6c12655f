"""Design of an electrode layout that has small position errors and unambiguous charges.

A layout is described by the coordinates of its new squares. The design minimises a power mean of the position errors of
many presses. For the exponent p, the power mean of the errors is mean(error^p)^(1/p). If the goal is the root mean
square, the exponent is 2. If the goal is the largest error, the exponent is large, so that the power mean is a smooth
approximation of the maximum.

Sequential quadratic programming (SLSQP) minimises the logarithm of the power mean over a few presses, and respects the
smallest allowed distances. The minimisation starts at several random layouts. The largest error mostly occurs near the
edge of an electrode, between the few presses. The best layouts are therefore improved further. Each improvement reduces
the largest errors among many presses. The presses with the largest errors are then selected again.
"""

import math
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.errors import InputError, SceneError, SolveError
from isocharge.common.progress import track
from isocharge.simulate.execution import in_order
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.working_area import working_area
from isocharge.simulate.layout.case import GAP, NO_NUISANCES, RIM_DISTANCE, DesignCase
from isocharge.simulate.layout.stress_fields import (
    charge_density,
    charges_and_derivatives,
    electrode_charges,
    solve_fields,
)
from isocharge.simulate.numerics.disk import sunflower
from isocharge.simulate.sensor.sensor import Electrode, Sensor

STARTS = 24
"""Number of random layouts from which the search starts."""

POWER = 12.0
"""Exponent of the power mean if the goal is the largest error. Each further round doubles the exponent."""

EXTENT = 1.0 / 3.0
"""Largest distance of the random squares from the disk of the presses, in film radii, dimensionless.

The charges of electrodes that are farther out depend little on the position of a press.
"""

ROUNDS = 5
"""Number of rounds in which a layout is improved for the presses with the largest errors."""

MAX_FINALISTS = 3
"""Largest number of layouts that are improved further."""

MIN_DIFFERENCE = 2e-3
"""Relative difference of the errors up to which two layouts count as rotations of each other."""

CLEARANCE_TOLERANCE = 1e-3
"""Largest violation of a distance rule that a layout may have, mm."""

DIFFERENCE_STEP = 1e-2
"""Step of the finite differences with respect to the coordinates of the squares, mm."""


@dataclass(frozen=True)
class Layout:
    """Positions of the new squares.

    Attributes:
        positions: Centres (x, y), shape (n_new, 2), mm.
        error: Position error that the design minimises, mm.
    """

    positions: Array
    error: float


def random_layouts(case: DesignCase) -> list[Array]:
    """Choose random layouts that satisfy the distance rules.

    Args:
        case: Design case with the number of new squares and the distance rules.

    Returns:
        Centres (x, y) of the new squares of `STARTS` layouts, each of shape (n_new, 2), mm.

    Raises:
        InputError: If the squares do not fit.
    """
    # Squares far outside the presses are of little use. They are only allowed if the squares do not fit otherwise. The
    # constant `EXTENT` is a share of the film radius.
    useful_radius = case.radius + EXTENT * case.sensor.film.radius
    allowed_radius = case.sensor.film.inner_radius - RIM_DISTANCE - 0.5 * case.square_side
    layouts = _layouts_within(min(useful_radius, allowed_radius), case) or _layouts_within(allowed_radius, case)
    if not layouts:
        raise InputError(
            f"found no layout of {case.new_count} new squares of {case.square_side:g} mm within "
            f"{allowed_radius:.3g} mm of the centre, with gaps of {GAP:g} mm; ask for fewer or smaller electrodes"
        )
    return layouts


def _layouts_within(radius: float, case: DesignCase) -> list[Array]:
    """Choose random layouts of new squares whose centres lie within a radius around the centre of the film.

    Candidates are points that are distributed evenly over the disk. For each layout, the candidates are tried in random
    order. A square is added at a candidate if all squares keep the smallest allowed distances.

    Args:
        radius: Largest distance of a centre from the centre of the film, mm.
        case: Design case with the number of new squares and the distance rules.

    Returns:
        Centres (x, y) of the squares of each layout, shape (n_new, 2), mm. The list is empty if a layout remains
        incomplete.
    """
    points = radius * sunflower(1000)  # evenly distributed over the disk
    allowed_points = points[case.clearance(points) >= 0.0]
    rng = np.random.default_rng(case.seed)
    layouts = []
    for _ in range(STARTS):
        positions = np.empty((0, 2))
        for point in rng.permutation(allowed_points):  # has no effect when the layout is complete
            if len(positions) < case.new_count and (case.pair_clearance(positions, point[None]) >= 0.0).all():
                positions = np.vstack([positions, point])
        if len(positions) < case.new_count:
            return []
        layouts.append(positions)
    return layouts


@dataclass(frozen=True)
class Search:
    """Search for the electrode positions that minimise the position errors according to the goal of a design case.

    Attributes:
        case: Requirements of the layout.
        fields: Stress fields for the probe and the force of the case.
    """

    case: DesignCase
    fields: ForwardMap

    def error_map(self, sensor: Sensor) -> "ErrorMap":
        """Compute the position errors of a sensor for many presses that cover the disk of the design case.

        The nuisance parameters are the probe radius, the pretension and the gains, which may not be known exactly. The
        errors are lower limits (Cramer-Rao). The electrodes are at their nominal positions.

        Args:
            sensor: Sensor whose layout is evaluated.

        Returns:
            Position errors due to the noise alone, and position errors due to the noise and the uncertain nuisance
            parameters of the design case together.
        """
        presses = self.case.fine_presses
        charges = charges_and_derivatives(self.fields, presses, sensor.electrodes)
        error_by_noise = self.case.position_errors(charges, NO_NUISANCES)
        error_with_nuisances = self.case.position_errors(charges, self.case.nuisances)
        return ErrorMap(presses, error_by_noise, error_with_nuisances)

    def errors(self, positions: Array) -> Array:
        """Compute the position errors of a layout for the presses `DesignCase.fine_presses`.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.

        Returns:
            Position errors with uncertain nuisance parameters, shape (n_press,), mm.
        """
        return self.error_map(self.case.layout(positions)).with_nuisances

    def optimum(self, start: Array) -> Layout:
        """Minimise the power mean of the errors of a few presses, starting from a given layout.

        Args:
            start: Centres (x, y) of the new squares, shape (n_new, 2), mm.

        Returns:
            Improved layout, whose error is the power mean.
        """
        power = POWER if self.case.goal == "worst" else 2.0
        return self.minimise(self.case.search_presses, start, power)

    def refine(self, layout: Layout) -> Layout:
        """Reduce the largest error over the many presses `fine_presses`, and return the positions with this error.

        If the goal is the root-mean-square error, return the unchanged positions with their root-mean-square error.

        Args:
            layout: Positions of the squares for which the power mean of the errors of a few presses is small.
        """
        best_positions = layout.positions
        best_errors = self.errors(best_positions)
        if self.case.goal != "worst":
            return Layout(best_positions, math.sqrt(np.mean(best_errors**2)))
        for round_number in range(1, ROUNDS + 1):
            # Minimise the errors of the search presses, and of as many presses with the largest errors. The power mean
            # of the errors approaches the largest error if the power increases from round to round.
            worst = np.argsort(-best_errors)[: len(self.case.search_presses)]
            presses = np.concatenate([self.case.search_presses, self.case.fine_presses[worst]])
            power = POWER * 2.0**round_number
            positions = self.minimise(presses, best_positions, power).positions
            errors = self.errors(positions)
            if errors.max() < best_errors.max():
                best_positions = positions
                best_errors = errors
        return Layout(best_positions, best_errors.max())

    def minimise(self, presses: Array, start: Array, power: float) -> Layout:
        """Minimise a power mean of the position errors of presses.

        Args:
            presses: Positions (x, y) of the presses, shape (n_press, 2), mm.
            start: Centres (x, y) of the new squares, which satisfy the distance rules, shape (n_new, 2), mm.
            power: Exponent of the power mean.

        Returns:
            New layout with its power mean. If the new positions violate a distance rule, the starting layout is
            returned.
        """
        density = charge_density(self.fields, presses)
        kept_charges = electrode_charges(density, self.case.kept_electrodes)
        side = self.case.square_side

        def square_charges(positions: Array) -> Array:
            """Compute the charges of squares and their derivatives, with the columns `stress_fields.COLUMNS`.

            Args:
                positions: Centres (x, y) of the squares, shape (n, 2), mm.

            Returns:
                Charges and their derivatives, shape (n_press, n, 6).
            """
            squares = [Electrode.of_square("A", (x, y), side) for x, y in positions.tolist()]
            return electrode_charges(density, squares)

        def log_power_mean(new_charges: Array) -> float:
            """Compute the logarithm of the power mean of the position errors of the presses.

            Args:
                new_charges: Charges of the new squares and their derivatives, shape (n_press, n_new, 6).
            """
            charges = np.concatenate([new_charges, kept_charges], axis=1)
            error = self.case.position_errors(charges, self.case.nuisances)
            largest = error.max()  # the powers of the ratios neither overflow nor all underflow
            return float(np.log(largest) + np.log(np.mean((error / largest) ** power)) / power)

        def objective(coordinates: Array) -> tuple[float, Array]:
            """Compute the logarithm of the power mean of the position errors, and its derivatives.

            Args:
                coordinates: Coordinates x1, y1, x2, y2, ... of the new squares, shape (2 n_new,), mm.

            Returns:
                The logarithm, and its derivatives with respect to the coordinates, shape (2 n_new,), 1/mm.
            """
            positions = coordinates.reshape(-1, 2)
            charges = square_charges(positions)
            value = log_power_mean(charges)

            # Move one square along one axis at a time. Only the charges of this square change. The charges of all moved
            # squares are computed together. The steps are the vectors (DIFFERENCE_STEP, 0) and (0, DIFFERENCE_STEP).
            gradient = np.empty(positions.shape)
            for axis, step in enumerate(DIFFERENCE_STEP * np.eye(2)):
                moved_charges = square_charges(positions + step)
                for square in range(len(positions)):
                    changed_charges = charges.copy()
                    changed_charges[:, square] = moved_charges[:, square]
                    gradient[square, axis] = (log_power_mean(changed_charges) - value) / DIFFERENCE_STEP
            return value, gradient.ravel()

        solution = scipy.optimize.minimize(
            objective,
            start.ravel(),
            jac=True,
            method="SLSQP",
            constraints={"type": "ineq", "fun": lambda at: self.case.all_clearances(at.reshape(-1, 2))},
            options={"maxiter": 40, "ftol": 1e-4},
        )
        positions = solution.x.reshape(-1, 2)
        if self.case.all_clearances(positions).min() < -CLEARANCE_TOLERANCE:
            return Layout(start, math.exp(log_power_mean(square_charges(start))))
        return Layout(positions, math.exp(solution.fun))


DECIMALS = 3
"""Number of decimals to which electrode positions in mm are rounded. Positions are therefore multiples of 1 um."""

UNAMBIGUOUS = "no folds, no ambiguous pairs"
"""Summary of a layout that has neither folds nor ambiguous pairs."""


@dataclass(frozen=True)
class ErrorMap:
    """Lower limits of the position errors of one layout, for many presses.

    Attributes:
        presses: Positions (x, y) of the presses, shape (n, 2), mm.
        noise_alone: Root mean square errors that the noise causes if all nuisance parameters are known, shape (n,), mm.
        with_nuisances: Root mean square errors if the nuisance parameters of the design case are uncertain, shape (n,),
            mm.
    """

    presses: Array
    noise_alone: Array
    with_nuisances: Array

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Return a dictionary for JSON with the largest and the rms error, both without and with nuisances."""
        return {
            "noise_alone": self._statistics(self.noise_alone),
            "with_nuisances": self._statistics(self.with_nuisances),
        }

    def _statistics(self, errors: Array) -> dict[str, Any]:
        """Return a dictionary for JSON with the largest error, its position, and the rms of all errors.

        Args:
            errors: Error of each press, shape (n,), mm.
        """
        return {
            "worst_mm": float(errors.max()),
            "rms_mm": math.sqrt(np.mean(errors**2)),
            "worst_at_mm": self.presses[np.argmax(errors)].round(DECIMALS).tolist(),
        }


@dataclass(frozen=True)
class Design:
    """Result of the design of a layout.

    Attributes:
        case: Requirements of the layout.
        sensor: Sensor with the new layout.
        summary: Sentence about folds and ambiguous pairs of the new layout over the default range of forces.
        n_rejected: Number of layouts with a smaller error that were rejected because their charges are ambiguous.
        errors_before: Errors of the initial sensor; None if the sensor has fewer than three electrodes.
        errors_after: Errors of the new layout.
    """

    case: DesignCase
    sensor: Sensor
    summary: str
    n_rejected: int
    errors_before: ErrorMap | None
    errors_after: ErrorMap

    @property
    def unambiguous(self) -> bool:
        """Whether the search found neither folds nor ambiguous pairs for the new layout."""
        return self.summary == UNAMBIGUOUS

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON with the case, the new layout, the errors of both layouts and the checks."""
        return {
            "case": self.case.to_dict(),
            "sensor": self.sensor.name,
            "electrodes_mm": {
                electrode.name: np.round(electrode.centre, DECIMALS).tolist() for electrode in self.sensor.electrodes
            },
            "before": self.errors_before.to_dict() if self.errors_before else None,
            "after": self.errors_after.to_dict(),
            "unambiguous": self.unambiguous,
            "folds_and_pairs": self.summary,
            "refused": self.n_rejected,
        }


def design(case: DesignCase, *, executor: Executor | None = None) -> Design:
    """Find the layout that has the smallest position errors among the layouts without folds and ambiguous pairs.

    Random layouts are improved, and the best layouts are refined. The refined layouts are searched for folds and
    ambiguous pairs in ascending order of their errors. The first layout without folds and ambiguous pairs is returned.
    If every layout has folds or ambiguous pairs, the layout with the smallest error is returned.

    Args:
        case: Requirements of the layout.
        executor: Executor that runs the solves and the refinements; None for this process. The result does not depend
            on the executor.

    Returns:
        The new layout and its errors. The errors of the initial sensor are included if the sensor has at least
        three electrodes.

    Raises:
        InputError: If the electrodes do not fit on the film.
        SolveError: If a press has no equilibrium.
    """
    # Improve random layouts, and refine the best of them. Layouts with nearly equal errors are taken for rotations of
    # each other, so only one of them is kept.
    random_starts = random_layouts(case)
    fields = solve_fields(case.sensor, case.probe, case.force, case.radius, executor)
    search = Search(case, fields)
    improved_layouts = track(in_order(executor, search.optimum, random_starts), "improving", len(random_starts))
    finalists: list[Layout] = []
    for layout in sorted(improved_layouts, key=lambda layout: layout.error):
        if not finalists or layout.error > finalists[-1].error * (1.0 + MIN_DIFFERENCE):
            finalists.append(layout)
    finalists = finalists[:MAX_FINALISTS]
    refined_layouts = track(in_order(executor, search.refine, finalists), "refining", len(finalists))

    # `case.layout` creates the sensor with the electrodes at the positions of a layout. Check the sensors in the order
    # of their errors, up to the first one that is not ambiguous. No sensor can be checked if some presses cannot be
    # solved, or if the forward map is not accurate. The first sensor is then chosen.
    layouts_by_error = sorted(refined_layouts, key=lambda layout: layout.error)
    sensors = [case.layout(np.round(layout.positions, DECIMALS)) for layout in layouts_by_error]
    summaries = []  # one text for each checked sensor, or the reason why none can be checked
    try:
        forward_map = _solve_forward_map(case, executor)
    except (SceneError, SolveError) as error:
        summaries.append(f"folds and ambiguous pairs could not be looked for: {error}")
    else:
        for sensor in track(sensors, "looking for folds and ambiguous pairs"):
            summary = describe_ambiguities(case, ChargeSpline.of(replace(forward_map, sensor=sensor)))
            summaries.append(summary)
            if summary == UNAMBIGUOUS:
                break

    # If all layouts are ambiguous, choose the first layout, which has the smallest error. Its index is also
    # the number of rejected layouts.
    chosen = summaries.index(UNAMBIGUOUS) if UNAMBIGUOUS in summaries else 0
    errors_before = search.error_map(case.sensor) if len(case.sensor.electrodes) >= 3 else None
    errors_after = search.error_map(sensors[chosen])
    return Design(case, sensors[chosen], summaries[chosen], chosen, errors_before, errors_after)


def _solve_forward_map(case: DesignCase, executor: Executor | None) -> ForwardMap:
    """Build the forward map that the search for folds and ambiguous pairs uses for all layouts of a design case.

    All layouts use the same map, because the stress of the film does not depend on the electrodes. The map covers the
    default range of forces and the force of the case.

    Args:
        case: Requirements of the layout.
        executor: Executor that runs the solves; None to run the solves in this process.

    Raises:
        SceneError: If the film cannot bear a force of the map.
        SolveError: If a press has no equilibrium, or the map is not accurate enough.
    """
    default_min_force, default_max_force = DEFAULT_FORCE_RANGE
    force_range = (min(default_min_force, case.force), max(default_max_force, case.force))
    return ForwardMap.build(case.sensor, case.probe, case.radius, force_range, executor=executor)


def describe_ambiguities(case: DesignCase, charges: ChargeMap) -> str:
    """Search for folds and ambiguous pairs of a layout, and describe them in a short text.

    Args:
        case: Requirements of the layout, with the noise.
        charges: Charge map of the layout.

    Returns:
        `UNAMBIGUOUS` if there are no folds and no ambiguous pairs. Otherwise, a text with the distance of the nearest
        fold from the centre and the number of pairs.
    """
    area = working_area(charges, case.noise, error=np.inf)  # the position error is not limited here
    findings = []
    if len(area.folds):
        findings.append(f"the map folds {area.fold_radius:.1f} mm from the centre")
    if len(area.pairs):
        findings.append(f"{len(area.pairs)} pairs of contacts have the same charges")
    return "; ".join(findings) or UNAMBIGUOUS
