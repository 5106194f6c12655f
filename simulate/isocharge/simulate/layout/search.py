"""Search for electrode positions with small position errors, in two stages.

The first stage starts from a random layout and is an exchange on a grid (Fedorov 1972; Meyer and Nachtsheim 1995). One
square after the other is moved to the grid position at which the error of the whole layout is smallest. The exchange
ends when the error no longer decreases. The formula of Sherman and Morrison computes the errors for all positions of
the grid at once (see `position_error`). If the goal is the largest error, the exchange minimises an approximation of
the largest error: a power mean of all errors.

The second stage is a refinement. The largest error mostly occurs near the edge of an electrode, between the presses of
a coarse grid. The refinement therefore considers the presses with the largest errors on a fine grid. The refinement
minimises a bound t under the constraint that the logarithm of the error of each considered press is at most t. The
method is sequential quadratic programming. In each round of the refinement, the presses are selected again, and the
change of the electrode positions is limited.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import InputError
from isocharge.common.progress import track
from isocharge.simulate.layout.case import DesignCase
from isocharge.simulate.layout.charge_table import ChargeTable
from isocharge.simulate.layout.position_error import ErrorModel, squared_errors_with_candidates
from isocharge.simulate.numerics.disk import square_grid

STARTS = 24
"""Number of random layouts from which the exchange starts."""

WORST_POWER = 12.0
"""Exponent of the power mean of the errors that is minimised if the goal is the largest error, dimensionless."""

RMS_POWER = 2.0
"""Exponent of the power mean of the errors that is minimised for all other goals, dimensionless."""

MAX_SWEEPS = 30
"""Largest number of sweeps of the exchange. In each sweep, every square is moved once."""

MIN_SWEEP_GAIN = 1e-4
"""The exchange ends if a sweep reduces the error by less than this fraction, dimensionless."""

GRID_STEPS = 20
"""Number of steps of the grid of square positions from the centre to the edge of the grid."""

GRID_EXTENT = 1.0 / 3.0
"""Distance by which the grid of square positions extends beyond the presses, in film radii, dimensionless.

The charges of electrodes that are farther out depend little on the position of a press.
"""

MAX_FINALISTS = 3
"""Largest number of layouts that are refined."""

MIN_DIFFERENCE = 2e-3
"""Relative difference of the errors above which two layouts count as different, dimensionless.

Layouts whose errors differ less are mostly rotations of each other.
"""

MAX_ROUNDS = 8
"""Largest number of rounds of the refinement of a layout."""

MAX_ITERATIONS = 25
"""Largest number of quadratic programs that are solved in a round of the refinement."""

ACTIVE_ERROR = 0.9
"""Smallest error, relative to the largest error, at which a press becomes a constraint of the refinement."""

MAX_ACTIVE = 60
"""Largest number of presses that become constraints of the refinement."""

FIRST_STEP = 0.2
"""Largest change of a coordinate of a square in the first round of the refinement, in units of the side of a square.

The largest change is halved after each round that does not improve the layout.
"""

LAST_STEP = 0.02
"""The refinement ends if a round with at most this largest change brings no improvement, in sides of a square."""

MIN_ROUND_GAIN = 1e-3
"""A round improves the layout if it reduces the error by more than this fraction, dimensionless."""

CLEARANCE_TOLERANCE = 1e-3
"""Largest violation of a distance rule that a refined layout may have, mm."""

DIFFERENCE_STEP = 1e-2
"""Step of the finite differences with respect to the coordinates of the squares, mm."""

ALL_PRESSES = slice(None)
"""Selection of all presses, which is used as an index of arrays whose first axis is the press."""


def random_layouts(case: DesignCase) -> tuple[Array, list[Integers]]:
    """Create a grid of square positions, and choose random layouts on this grid that satisfy the distance rules.

    Args:
        case: Design case with the number of new squares and the distance rules.

    Returns:
        Positions (x, y) of the grid, shape (n, 2), mm. Random layouts, whose number is `STARTS`. A layout contains the
        index of the grid position of each new square, shape (n_new,).

    Raises:
        InputError: If the squares do not fit on the grid.
    """
    # The grid extends to the distance up to which a square is useful, but not into the rim of the film.
    useful_radius = case.radius + GRID_EXTENT * case.sensor.film.radius
    allowed_radius = case.sensor.film.inner_radius - case.rim - 0.5 * case.square_side
    grid_radius = min(useful_radius, allowed_radius)
    grid = square_grid(grid_radius, grid_radius / GRID_STEPS)
    allowed_grid = grid[case.clearance(grid) >= 0.0]

    rng = np.random.default_rng(case.seed)
    layouts = [_random_layout(case, allowed_grid, rng) for _ in range(STARTS)]
    is_any_incomplete = any(len(layout) < case.new_count for layout in layouts)  # some squares found no position
    if is_any_incomplete:
        raise InputError(
            f"{case.new_count} new squares of {case.square_side:g} mm do not fit within {grid_radius:.3g} mm of the "
            f"centre, with gaps of {case.gap:g} mm; ask for fewer, smaller or nearer electrodes"
        )
    return allowed_grid, layouts


def _random_layout(case: DesignCase, grid: Array, rng: np.random.Generator) -> Integers:
    """Choose a random position of the grid for each new square.

    The positions are tried in random order. A position is chosen if a square at this position has the required distance
    from the squares at all positions that were chosen earlier.

    Args:
        case: Design case with the number of new squares and the distance rules.
        grid: Allowed positions (x, y) of a square, shape (n, 2), mm.
        rng: Random number generator.

    Returns:
        Indices of the positions, in the order in which they were chosen, shape (n_new,). There are fewer than
        `case.new_count` indices if no further square fits.
    """
    chosen: list[int] = []
    for candidate in rng.permutation(len(grid)).tolist():
        if len(chosen) == case.new_count:
            break
        clearance = case.pair_clearance(grid[[candidate]], grid[chosen])  # shape (1, len(chosen))
        if (clearance >= 0.0).all():
            chosen.append(candidate)
    return np.array(chosen, dtype=np.intp)


@dataclass(frozen=True)
class Search:
    """Search for the electrode positions that minimise the goal of a design case.

    Attributes:
        case: Requirements of the layout.
        table: Charge table for the probe and the force of the case.
    """

    case: DesignCase
    table: ChargeTable

    @cached_property
    def model(self) -> ErrorModel:
        """Error model with the nuisances of the case."""
        return ErrorModel.of(self.case.noise, self.case.nuisances)

    @cached_property
    def presses(self) -> Array:
        """Positions (x, y) of the presses for which the refinement evaluates a layout, shape (n, 2), mm.

        The presses form a fine grid if the goal is the largest error. For all other goals, the refinement uses the same
        presses as the exchange.
        """
        return self.case.fine_grid if self.case.goal == "worst" else self.case.search_presses

    @cached_property
    def weights(self) -> Array:
        """Weight of each press in the goal, shape (n,), dimensionless."""
        return self.case.weights(self.presses)

    @cached_property
    def kept_rows(self) -> Array:
        """Rows of the charge table for the kept electrodes and all presses, shape (n, n_kept, 6)."""
        return self.table.rows(self.presses, np.empty((0, 2)), self.case.square_side, self.case.kept_electrodes)

    def squared_errors(self, positions: Array, selection: Integers | slice) -> Array:
        """Compute the squared position errors of a layout for selected presses.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.
            selection: Indices of the selected presses, shape (n_press,), or `ALL_PRESSES`.

        Returns:
            Squared errors, shape (n_press,), mm^2.
        """
        rows = self.table.rows(self.presses[selection], positions, self.case.square_side)
        return self.model.squared_errors(np.concatenate([rows, self.kept_rows[selection]], axis=1))

    def optima(self, grid: Array, layouts: list[Integers]) -> list[Array]:
        """Improve layouts by exchanges, and return at most `MAX_FINALISTS` of the best improved layouts.

        Layouts with nearly equal errors are mostly rotations of each other, so only one of them is returned.

        Args:
            grid: Positions (x, y) of the grid, shape (n, 2), mm.
            layouts: Initial layouts. A layout contains the index of the grid position of each new square, shape
                (n_new,).

        Returns:
            Layouts in ascending order of their errors. A layout contains the centre (x, y) of each new square, shape
            (n_new, 2), mm.
        """
        exchange = _Exchange.prepare(self, grid)
        results = [exchange.improve(layout) for layout in track(layouts, "exchanging")]
        results.sort(key=lambda result: result[0])  # a result is a pair of the error and the layout

        # Two layouts count as different if their errors differ. Equal errors mostly belong to rotated layouts.
        finalists: list[Array] = []
        last_error = 0.0
        for error, indices in results:
            is_different = error > last_error * (1.0 + MIN_DIFFERENCE)
            if is_different and len(finalists) < MAX_FINALISTS:
                finalists.append(grid[indices])
                last_error = error
        return finalists

    def minimised_error(self, positions: Array) -> float:
        """Compute the quantity that the search minimises: the largest error or the weighted root mean square, mm.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.
        """
        return float(np.exp(self._log_errors(positions, ALL_PRESSES).max()))

    def _log_errors(self, positions: Array, selection: Integers | slice) -> Array:
        """Compute the logarithms of the errors of a layout. The refinement minimises the largest logarithm.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.
            selection: Indices of the selected presses, shape (n_press,), or `ALL_PRESSES`.

        Returns:
            If the goal is the largest error, the logarithm of the error (mm) of each selected press, shape (n_press,).
            For all other goals, the logarithm of the weighted root mean square of the errors (mm), shape (1,).
        """
        rows = self.table.rows(self.presses[selection], positions, self.case.square_side)
        return self._log_errors_of_rows(np.concatenate([rows, self.kept_rows[selection]], axis=1), selection)

    def _log_errors_of_rows(self, rows: Array, selection: Integers | slice) -> Array:
        """Compute the result of `_log_errors` from the charges of all electrodes and the derivatives of these charges.

        Args:
            rows: Rows of the charge table for the selected presses and all electrodes, shape (n_press, n_electrode, 6).
            selection: Indices of the selected presses, shape (n_press,), or `ALL_PRESSES`.
        """
        squared_error = self.model.squared_errors(rows)
        if self.case.goal != "worst":
            squared_error = np.average(squared_error, weights=self.weights[selection], keepdims=True)
        return np.asarray(0.5 * np.log(squared_error))

    def _log_error_jacobian(self, positions: Array, selection: Integers | slice) -> Array:
        """Compute the derivatives of `_log_errors` with respect to the coordinates of the squares.

        There is one error for each selected press if the goal is the largest error, and a single error for all other
        goals. The derivatives are forward differences. The errors are computed from the rows of the electrodes. The row
        of an electrode contains its charge and the derivatives of the charge, for each press. If one square moves, only
        the row of this square changes.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.
            selection: Indices of the selected presses, shape (n_press,), or `ALL_PRESSES`.

        Returns:
            Derivatives with respect to the coordinates in the order x1, y1, x2, y2, ..., shape (n_error, 2 n_new),
            1/mm.
        """
        kept_rows = self.kept_rows[selection]
        n_new = len(positions)

        # Compute the rows of the new squares, shape (n_press, n_new, 6). Also compute the rows of each square after a
        # step along x and after a step along y, shape (n_press, 2 n_new, 6).
        steps = DIFFERENCE_STEP * np.eye(2)
        moved_positions = (positions[:, None] + steps).reshape(-1, 2)
        all_positions = np.concatenate([positions, moved_positions])
        all_rows = self.table.rows(self.presses[selection], all_positions, self.case.square_side)
        new_rows = all_rows[:, :n_new]
        moved_rows = all_rows[:, n_new:]

        # For each coordinate, replace the row of the moved square, and compute the difference of the errors.
        log_error = self._log_errors_of_rows(np.concatenate([new_rows, kept_rows], axis=1), selection)
        derivatives = []
        for coordinate in range(2 * n_new):
            square = coordinate // 2  # the coordinates x and y of a square are adjacent
            changed_rows = new_rows.copy()
            changed_rows[:, square] = moved_rows[:, coordinate]
            all_changed_rows = np.concatenate([changed_rows, kept_rows], axis=1)
            changed_log_error = self._log_errors_of_rows(all_changed_rows, selection)
            derivatives.append((changed_log_error - log_error) / DIFFERENCE_STEP)
        return np.stack(derivatives, axis=1)

    def _clearance_jacobian(self, positions: Array) -> Array:
        """Compute the derivatives of `DesignCase.all_clearances` with respect to the coordinates of the squares.

        The derivatives are forward differences.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.

        Returns:
            Derivatives with respect to the coordinates in the order x1, y1, x2, y2, ..., shape (n_rule, 2 n_new),
            dimensionless.
        """
        clearances = self.case.all_clearances(positions)
        # Each step changes a single coordinate; shape (2 n_new, n_new, 2).
        steps = DIFFERENCE_STEP * np.eye(positions.size).reshape(-1, *positions.shape)
        moved_clearances = [self.case.all_clearances(positions + step) for step in steps]
        return (np.stack(moved_clearances, axis=1) - clearances[:, None]) / DIFFERENCE_STEP

    def refine(self, positions: Array) -> Array:
        """Improve a layout in rounds. In each round, the change of the coordinates of the squares is limited.

        If a round does not improve the layout, the largest allowed change is halved for the next round. The refinement
        ends if the largest allowed change is already small, and in any case after `MAX_ROUNDS` rounds.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.

        Returns:
            Error that the search minimises, mm, followed by the coordinates x1, y1, x2, y2, ... of the refined layout,
            mm, shape (1 + 2 n_new,).
        """
        relative_step = FIRST_STEP  # largest change of a coordinate, in units of the side of a square
        best_error = self.minimised_error(positions)
        for _ in range(MAX_ROUNDS):
            moved_positions = self._refinement_round(positions, relative_step * self.case.square_side)
            error = self.minimised_error(moved_positions)
            satisfies_rules = self.case.all_clearances(moved_positions).min() > -CLEARANCE_TOLERANCE
            if error < best_error * (1.0 - MIN_ROUND_GAIN) and satisfies_rules:
                positions = moved_positions
                best_error = error
            elif relative_step > LAST_STEP:
                relative_step *= 0.5
            else:
                break
        return np.append(best_error, positions)

    def _active_presses(self, positions: Array) -> Integers | slice:
        """Select the presses whose errors are constraints in a round of the refinement.

        If the goal is the largest error, the presses with nearly the largest error are selected, at most `MAX_ACTIVE`.
        For all other goals, all presses are selected.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.

        Returns:
            Indices of the selected presses, shape (n_press,), or `ALL_PRESSES`.
        """
        if self.case.goal != "worst":
            return ALL_PRESSES
        squared_error = self.squared_errors(positions, ALL_PRESSES)
        largest = np.argsort(-squared_error)[:MAX_ACTIVE]
        active: Integers = largest[squared_error[largest] >= ACTIVE_ERROR**2 * squared_error.max()]
        return active

    def _refinement_round(self, positions: Array, max_step: float) -> Array:
        """Improve a layout by sequential quadratic programming for the presses that have the largest errors.

        The variables are the coordinates of the squares and a bound. The bound, which is the last variable, is an upper
        limit of the logarithms of the errors. The bound is minimised under two constraints. No logarithm of an error
        exceeds the bound, and the layout satisfies the distance rules.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.
            max_step: Largest change of a coordinate, mm.

        Returns:
            Changed centres, shape (n_new, 2), mm. They may violate the distance rules slightly.
        """
        active = self._active_presses(positions)

        def constraints(variables: Array) -> Array:
            """Return the bound minus the logarithm of each error, and the margin of each distance rule.

            None of these values must be negative. Their shape is (n_error + n_rule,).
            """
            moved_positions = variables[:-1].reshape(-1, 2)
            bound = variables[-1]
            error_margins = bound - self._log_errors(moved_positions, active)
            return np.concatenate([error_margins, self.case.all_clearances(moved_positions)])

        def constraint_jacobian(variables: Array) -> Array:
            """Return the derivatives of the constraints with respect to the variables.

            The derivative with respect to the bound is 1 for the constraints of the errors, and 0 for the distance
            rules.
            """
            moved_positions = variables[:-1].reshape(-1, 2)
            log_error_jacobian = self._log_error_jacobian(moved_positions, active)
            clearance_jacobian = self._clearance_jacobian(moved_positions)
            coordinate_columns = np.concatenate([-log_error_jacobian, clearance_jacobian])
            bound_column = np.zeros((len(coordinate_columns), 1))
            bound_column[: len(log_error_jacobian)] = 1.0
            return np.concatenate([coordinate_columns, bound_column], axis=1)

        # The first value of the bound is the largest error, so that all constraints of the errors are satisfied.
        start = np.append(positions, self._log_errors(positions, active).max())
        gradient = np.append(np.zeros(positions.size), 1.0)  # the minimised quantity is the last variable itself
        coordinate_bounds = [(value - max_step, value + max_step) for value in positions.ravel().tolist()]
        bounds = [*coordinate_bounds, (None, None)]  # the last variable is not limited
        solution = scipy.optimize.minimize(
            lambda variables: variables[-1],
            start,
            jac=lambda _: gradient,
            method="SLSQP",
            bounds=bounds,
            constraints={"type": "ineq", "fun": constraints, "jac": constraint_jacobian},
            options={"maxiter": MAX_ITERATIONS, "ftol": 1e-4},
        )
        return np.asarray(solution.x[:-1].reshape(-1, 2))


@dataclass(frozen=True)
class _Exchange:
    """Improvement of layouts by moving one square at a time to the best position of a grid.

    The error of a layout is the power mean of the position errors of the presses. If p is the exponent, the power mean
    is the p-th root of the weighted mean of the p-th powers of the errors.

    Attributes:
        kept_sensitivity: Sensitivities of the kept electrodes (`ErrorModel.sensitivity`), shape (n_press, n_kept, 5).
        candidates: Sensitivities of a square at each position of the grid, shape (n_press, 5, n).
        is_allowed_pair: Whether two squares at a pair of positions satisfy the distance rules, shape (n, n).
        weights: Weight of each press in the mean, shape (n_press,), dimensionless.
        power: Exponent of the power mean, dimensionless.
    """

    kept_sensitivity: Array
    candidates: Array
    is_allowed_pair: Booleans
    weights: Array
    power: float

    @classmethod
    def prepare(cls, search: Search, grid: Array) -> "_Exchange":
        """Prepare exchanges by computing the sensitivities of a square at every position of a grid.

        Args:
            search: Search with the design case and the charge table.
            grid: Positions (x, y) of the grid, shape (n, 2), mm.
        """
        case = search.case
        presses = case.search_presses
        no_squares = grid[:0]
        kept_rows = search.table.rows(presses, no_squares, case.square_side, case.kept_electrodes)
        square_rows = search.table.rows(presses, grid, case.square_side)
        square_sensitivity = search.model.sensitivity(square_rows)  # shape (n_press, n, 5)
        return cls(
            kept_sensitivity=search.model.sensitivity(kept_rows),
            candidates=np.ascontiguousarray(square_sensitivity.swapaxes(1, 2)),
            is_allowed_pair=case.pair_clearance(grid, grid) >= 0.0,
            weights=case.weights(presses),
            power=WORST_POWER if case.goal == "worst" else RMS_POWER,
        )

    def mean_powers(self, other_squares: Integers) -> Array:
        """Add a square to a layout at each position of the grid in turn, and compute how large the errors then are.

        The measure is the weighted mean of the p-th powers of the position errors of all presses, where p is `power`.

        Args:
            other_squares: Indices of the grid positions of the new squares to which the square is added, shape
                (n_new - 1,).

        Returns:
            Mean for each position of the added square, shape (n,). It is infinite if the added square violates a
            distance rule.
        """
        # Collect the sensitivities of the electrodes without the added square, shape (n_press, n_kept + n_new - 1, 5).
        others_sensitivity = self.candidates[:, :, other_squares].swapaxes(1, 2)
        layout_sensitivity = np.concatenate([self.kept_sensitivity, others_sensitivity], axis=1)
        squared_error = squared_errors_with_candidates(layout_sensitivity, self.candidates)  # shape (n_press, n)
        positive_squared_error = np.maximum(squared_error, 1e-12)  # rounding may make a small value negative
        mean_power = np.average(positive_squared_error ** (0.5 * self.power), axis=0, weights=self.weights)
        is_allowed = self.is_allowed_pair[other_squares].all(axis=0)
        mean_power[~is_allowed] = np.inf
        return np.asarray(mean_power)

    def improve(self, layout: Integers) -> tuple[float, Integers]:
        """Move single squares until no such move improves the layout.

        In each sweep, every square in turn is moved to the grid position at which the error of the layout is smallest.

        Args:
            layout: Index of the grid position of each new square, shape (n_new,).

        Returns:
            Power mean of the errors of the improved layout, mm. Index of the improved grid position of each new square,
            shape (n_new,).
        """
        improved_layout = layout.copy()
        previous_error = np.inf
        for _ in range(MAX_SWEEPS):
            for square in range(len(improved_layout)):
                other_squares = np.delete(improved_layout, square)
                mean_powers = self.mean_powers(other_squares)
                improved_layout[square] = np.argmin(mean_powers)

            # The last square was moved to the position with the smallest mean, so this mean is that of the layout. Stop
            # if the sweep has hardly reduced the error.
            error = float(mean_powers.min() ** (1.0 / self.power))
            if error > previous_error * (1.0 - MIN_SWEEP_GAIN):
                break
            previous_error = error
        return error, improved_layout
