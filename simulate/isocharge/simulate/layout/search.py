"""Search of the electrode positions: exchange on a grid, then minimisation of the largest error on a fine grid.

The exchange (Fedorov 1972; Meyer and Nachtsheim 1995) starts from a random layout. Each square in turn is moved to the
position at which the error of the whole layout is smallest, until the error no longer decreases. The formula of Sherman
and Morrison compares all positions of a grid at once (`position_error`). If the goal is the largest error, the exchange
minimises a power mean of the errors, which approximates the largest error.

The largest error mostly occurs near the edge of an electrode, between the presses of a coarse grid. The refinement
therefore minimises a bound t subject to the constraints ln error(press) <= t. The constraints apply to the presses with
the largest errors on a fine grid. The method is sequential quadratic programming with a limited change of the
positions. The presses are selected again in each round.
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
from isocharge.simulate.layout.position_error import ErrorModel, with_one_more
from isocharge.simulate.numerics.disk import square_grid

STARTS = 24
"""Number of random layouts from which the exchange starts."""

WORST_POWER = 12.0
"""Power of the errors in the mean that the exchange minimises if the goal is the largest error, dimensionless."""

RMS_POWER = 2.0
"""Power of the errors in the mean that the exchange minimises for the other goals, dimensionless."""

MAX_SWEEPS = 30
"""Largest number of sweeps, in each of which every square is exchanged once."""

MIN_SWEEP_GAIN = 1e-4
"""Relative decrease of the error below which the exchange ends, dimensionless."""

GRID_STEPS = 20
"""Number of steps of the grid of positions from the centre outwards."""

GRID_EXTENT = 1.0 / 3.0
"""Distance by which the grid of positions extends beyond the presses, in units of the film radius, dimensionless.

The charges of electrodes farther out change little.
"""

MAX_FINALISTS = 3
"""Largest number of layouts that are refined."""

MIN_DIFFERENCE = 2e-3
"""Relative difference of the errors above which two layouts count as different, dimensionless.

Layouts that differ less are mostly rotations of each other.
"""

MAX_ROUNDS = 8
"""Largest number of rounds of the refinement."""

MAX_ITERATIONS = 25
"""Largest number of quadratic programs in a round."""

ACTIVE_ERROR = 0.9
"""Error above which a press becomes a constraint, relative to the largest error, dimensionless."""

MAX_ACTIVE = 60
"""Largest number of presses that become constraints."""

FIRST_STEP = 0.2
"""Largest change of a coordinate in the first round, in units of the side of a square.

It is halved after each round without improvement.
"""

LAST_STEP = 0.02
"""Largest change of a coordinate below which the refinement ends, in units of the side of a square."""

MIN_ROUND_GAIN = 1e-3
"""Relative decrease of the error below which a round counts as without improvement, dimensionless."""

CLEARANCE_TOLERANCE = 1e-3
"""Largest violation of a distance rule that a refined layout may have, mm."""

DIFFERENCE_STEP = 1e-2
"""Step of the finite differences with respect to the coordinates of the squares, mm."""

ALL_PRESSES = slice(None)
"""Selection of all presses of the fine grid."""


def random_layouts(case: DesignCase) -> tuple[Array, list[Integers]]:
    """Choose random layouts on a grid that satisfy the distance rules.

    Args:
        case: Design case.

    Returns:
        Positions of the grid, shape (n, 2), mm, and `STARTS` layouts. A layout is an array of indices into the
        positions of the grid, shape (n_new,).

    Raises:
        InputError: If the squares do not fit.
    """
    film_radius = case.sensor.film.radius
    useful_radius = case.radius + GRID_EXTENT * film_radius
    allowed_radius = film_radius - case.rim - 0.5 * case.square_side
    grid_radius = min(useful_radius, allowed_radius)
    grid = square_grid(grid_radius, grid_radius / GRID_STEPS)
    allowed_grid = grid[case.clearance(grid) >= 0.0]

    rng = np.random.default_rng(case.seed)
    layouts = [_random_layout(case, allowed_grid, rng) for _ in range(STARTS)]
    is_any_incomplete = any(len(layout) < case.new_count for layout in layouts)
    if is_any_incomplete:
        raise InputError(
            f"{case.new_count} new squares of {case.square_side:g} mm do not fit within {grid_radius:.3g} mm of the "
            f"centre, with gaps of {case.gap:g} mm; ask for fewer, smaller or nearer electrodes"
        )
    return allowed_grid, layouts


def _random_layout(case: DesignCase, grid: Array, rng: np.random.Generator) -> Integers:
    """Choose random positions of the grid for the new squares, with the required distances between them.

    The positions are tried in random order. A position is chosen if its square has the required distance from the
    squares at all positions chosen before.

    Args:
        case: Design case.
        grid: Allowed positions, shape (n, 2), mm.
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
    """Search of the electrode positions for one design case.

    Attributes:
        case: Design case.
        table: Charges under the presses of the case.
    """

    case: DesignCase
    table: ChargeTable

    @cached_property
    def model(self) -> ErrorModel:
        """Error model with the nuisances of the case."""
        return ErrorModel.of(self.case.noise, self.case.nuisances)

    @cached_property
    def presses(self) -> Array:
        """Positions of the presses for which a layout is evaluated, shape (n, 2), mm.

        The grid is fine only if the largest error is minimised.
        """
        return self.case.fine_grid if self.case.goal == "worst" else self.case.search_presses

    @cached_property
    def weights(self) -> Array:
        """Weight of each press in the goal, shape (n,), dimensionless."""
        return self.case.weights(self.presses)

    @cached_property
    def kept_rows(self) -> Array:
        """Rows of the kept electrodes for all presses, shape (n, n_kept, 6)."""
        return self.table.rows(self.presses, np.empty((0, 2)), self.case.square_side, self.case.kept_electrodes)

    def squared_errors(self, positions: Array, selection: Integers | slice) -> Array:
        """Compute the squared position errors of a layout.

        Args:
            positions: Centres of the new squares, shape (n_new, 2), mm.
            selection: Selection of presses.

        Returns:
            Squared errors, shape (n_press,), mm^2.
        """
        rows = self.table.rows(self.presses[selection], positions, self.case.square_side)
        return self.model.squared(np.concatenate([rows, self.kept_rows[selection]], axis=1))

    def optima(self, grid: Array, layouts: list[Integers]) -> list[Array]:
        """Improve layouts by exchange, and return at most `MAX_FINALISTS` different layouts with the smallest errors.

        Args:
            grid: Positions of the grid, shape (n, 2), mm.
            layouts: Indices of the positions of each initial layout, each of shape (n_new,).

        Returns:
            Centres of the new squares of each layout, each of shape (n_new, 2), mm, in ascending order of the error.
        """
        exchange = _Exchange.of(self, grid)
        results = [exchange.improve(layout) for layout in track(layouts, "exchanging")]
        results.sort(key=lambda result: result[0])  # by the error

        # Two layouts count as different if their errors differ. Equal errors mostly belong to rotated layouts.
        finalists: list[Array] = []
        last_error = 0.0
        for error, indices in results:
            is_different = error > last_error * (1.0 + MIN_DIFFERENCE)
            if is_different and len(finalists) < MAX_FINALISTS:
                finalists.append(grid[indices])
                last_error = error
        return finalists

    def value(self, positions: Array) -> float:
        """Compute the quantity that the search minimises, mm: the largest error, or the weighted root mean square."""
        return float(np.exp(self._log_errors(positions, ALL_PRESSES).max()))

    def _log_errors(self, positions: Array, selection: Integers | slice) -> Array:
        """Compute the logarithms of the errors whose maximum is minimised.

        Args:
            positions: Centres of the new squares, shape (n_new, 2), mm.
            selection: Selection of presses.

        Returns:
            Logarithm of the error (mm) of each press if the goal is the largest error, shape (n_press,). For other
            goals, logarithm of the weighted root mean square of the errors (mm), shape (1,).
        """
        rows = self.table.rows(self.presses[selection], positions, self.case.square_side)
        return self._log_errors_of_rows(np.concatenate([rows, self.kept_rows[selection]], axis=1), selection)

    def _log_errors_of_rows(self, rows: Array, selection: Integers | slice) -> Array:
        """Compute the result of `_log_errors` from the charges and derivatives of all electrodes.

        Args:
            rows: Rows of the charge table, shape (n_press, n_electrode, 6).
            selection: Selection of the presses to which the rows belong.
        """
        squared_error = self.model.squared(rows)
        if self.case.goal != "worst":
            squared_error = np.average(squared_error, weights=self.weights[selection], keepdims=True)
        return np.asarray(0.5 * np.log(squared_error))

    def _log_error_jacobian(self, positions: Array, selection: Integers | slice) -> Array:
        """Compute the derivatives of `_log_errors` with respect to the coordinates by forward differences.

        If one square moves, the rows of all other electrodes remain unchanged. Only the moved square is integrated
        again.

        Args:
            positions: Centres of the new squares, shape (n_new, 2), mm.
            selection: Selection of presses.

        Returns:
            Derivatives, shape (n_error, 2 n_new), 1/mm.
        """
        kept_rows = self.kept_rows[selection]
        n_new = len(positions)

        # Rows of the new squares, followed by the rows of each square after a step along x and after a step along y
        steps = DIFFERENCE_STEP * np.eye(2)
        moved_positions = (positions[:, None] + steps).reshape(-1, 2)
        all_positions = np.concatenate([positions, moved_positions])
        all_rows = self.table.rows(self.presses[selection], all_positions, self.case.square_side)
        new_rows = all_rows[:, :n_new]
        moved_rows = all_rows[:, n_new:]

        log_error = self._log_errors_of_rows(np.concatenate([new_rows, kept_rows], axis=1), selection)
        derivatives = []
        for coordinate in range(2 * n_new):
            square = coordinate // 2  # x and y of a square are two successive coordinates
            changed_rows = new_rows.copy()
            changed_rows[:, square] = moved_rows[:, coordinate]
            all_changed_rows = np.concatenate([changed_rows, kept_rows], axis=1)
            changed_log_error = self._log_errors_of_rows(all_changed_rows, selection)
            derivatives.append((changed_log_error - log_error) / DIFFERENCE_STEP)
        return np.stack(derivatives, axis=1)

    def _clearance_jacobian(self, positions: Array) -> Array:
        """Compute the derivatives of all distance rules with respect to the coordinates by forward differences.

        Args:
            positions: Centres of the new squares, shape (n_new, 2), mm.

        Returns:
            Derivatives, shape (n_rule, 2 n_new), dimensionless.
        """
        clearances = self.case.all_clearances(positions)
        steps = DIFFERENCE_STEP * np.eye(positions.size).reshape(-1, *positions.shape)  # of one coordinate each
        moved_clearances = [self.case.all_clearances(positions + step) for step in steps]
        return (np.stack(moved_clearances, axis=1) - clearances[:, None]) / DIFFERENCE_STEP

    def refine(self, positions: Array) -> Array:
        """Improve a layout by small steps that satisfy the distance rules.

        If a round does not improve the layout, the largest step is halved. The refinement ends when a round with a
        small step brings no improvement.

        Args:
            positions: Centres of the new squares, shape (n_new, 2), mm.

        Returns:
            Minimised quantity of the refined layout, mm, followed by its coordinates, mm, shape (1 + 2 n_new,).
        """
        step = FIRST_STEP  # in units of the side of a square
        best_value = self.value(positions)
        for _ in range(MAX_ROUNDS):
            moved = self._refinement_round(positions, step * self.case.square_side)
            value = self.value(moved)
            satisfies_rules = self.case.all_clearances(moved).min() > -CLEARANCE_TOLERANCE
            if value < best_value * (1.0 - MIN_ROUND_GAIN) and satisfies_rules:
                positions = moved
                best_value = value
            elif step > LAST_STEP:
                step *= 0.5
            else:
                break
        return np.append(best_value, positions)

    def _active_presses(self, positions: Array) -> Integers | slice:
        """Select the presses whose errors a refinement bounds.

        If the goal is the largest error, these are at most `MAX_ACTIVE` presses with nearly the largest error. For
        other goals, all presses are selected.

        Args:
            positions: Centres of the new squares, shape (n_new, 2), mm.
        """
        if self.case.goal != "worst":
            return ALL_PRESSES
        squared_error = self.squared_errors(positions, ALL_PRESSES)
        largest = np.argsort(-squared_error)[:MAX_ACTIVE]
        active: Integers = largest[squared_error[largest] >= ACTIVE_ERROR**2 * squared_error.max()]
        return active

    def _refinement_round(self, positions: Array, max_step: float) -> Array:
        """Run sequential quadratic programming for the presses that have the largest errors.

        The variables are the coordinates of the squares and a bound of the logarithmic errors. The bound is minimised,
        subject to the constraints that no error exceeds it and that the distance rules are satisfied.

        Args:
            positions: Centres of the new squares, shape (n_new, 2), mm.
            max_step: Largest change of a coordinate, mm.

        Returns:
            Changed positions, shape (n_new, 2), mm.
        """
        active = self._active_presses(positions)

        # The last variable is the bound of the logarithmic errors.
        def constraints(variables: Array) -> Array:
            """Return values that must not be negative: the bound minus the log errors, and the excess distances."""
            moved = variables[:-1].reshape(-1, 2)
            bound = variables[-1]
            return np.concatenate([bound - self._log_errors(moved, active), self.case.all_clearances(moved)])

        def constraint_jacobian(variables: Array) -> Array:
            """Return the derivatives of the constraints with respect to the variables.

            The last variable, the bound, enters only the constraints of the errors, with the derivative 1.
            """
            moved = variables[:-1].reshape(-1, 2)
            log_error_jacobian = self._log_error_jacobian(moved, active)
            clearance_jacobian = self._clearance_jacobian(moved)
            coordinate_columns = np.concatenate([-log_error_jacobian, clearance_jacobian])
            bound_column = np.zeros((len(coordinate_columns), 1))
            bound_column[: len(log_error_jacobian)] = 1.0
            return np.concatenate([coordinate_columns, bound_column], axis=1)

        # The search starts with the largest error as the bound, so that all constraints of the errors are satisfied.
        start = np.append(positions, self._log_errors(positions, active).max())
        gradient = np.append(np.zeros(positions.size), 1.0)  # of the minimised quantity, which is the last variable
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
    """Exchange of single squares on a grid of positions.

    Attributes:
        kept_sensitivity: Sensitivities of the kept electrodes (`ErrorModel.sensitivity`), shape (n_press, n_kept, 5).
        candidates: Sensitivities of a square at each position of the grid, shape (n_press, 5, n).
        is_allowed_pair: Whether two squares at a pair of positions satisfy the distance rules, shape (n, n).
        weights: Weight of each press in the mean of the errors, shape (n_press,), dimensionless.
        power: Power of the errors in the mean, dimensionless.
    """

    kept_sensitivity: Array
    candidates: Array
    is_allowed_pair: Booleans
    weights: Array
    power: float

    @classmethod
    def of(cls, search: Search, grid: Array) -> "_Exchange":
        """Create an exchange from a search, and evaluate the sensitivities of a square at every position of a grid.

        Args:
            search: Search with its design case and charge table.
            grid: Positions of the grid, shape (n, 2), mm.
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

    def mean_error(self, other_squares: Integers) -> Array:
        """Compute the mean of the errors to the given power for a further square at each position of the grid.

        Args:
            other_squares: Indices of the positions of the other new squares of the layout.

        Returns:
            Means, shape (n,). A mean is infinite if the further square violates a distance rule.
        """
        others_sensitivity = self.candidates[:, :, other_squares].swapaxes(1, 2)
        layout_sensitivity = np.concatenate([self.kept_sensitivity, others_sensitivity], axis=1)
        # Rounding can make the small difference in `with_one_more` negative.
        squared_error = np.maximum(with_one_more(layout_sensitivity, self.candidates), 1e-12)  # shape (n_press, n)
        mean = np.average(squared_error ** (0.5 * self.power), axis=0, weights=self.weights)
        is_allowed = self.is_allowed_pair[other_squares].all(axis=0)
        mean[~is_allowed] = np.inf
        return np.asarray(mean)

    def improve(self, layout: Integers) -> tuple[float, Integers]:
        """Exchange squares until no exchange of a single square improves the layout.

        In each sweep, every square in turn is moved to the position with the smallest mean error.

        Args:
            layout: Indices of the positions, shape (n_new,).

        Returns:
            Power mean of the errors, mm, and the indices of the improved positions, shape (n_new,).
        """
        improved = layout.copy()
        best_value = np.inf
        for _ in range(MAX_SWEEPS):
            for square in range(len(improved)):
                other_squares = np.delete(improved, square)
                mean_error = self.mean_error(other_squares)
                improved[square] = np.argmin(mean_error)
            value = float(mean_error.min() ** (1.0 / self.power))  # after the exchange of the last square
            if value > best_value * (1.0 - MIN_SWEEP_GAIN):
                break
            best_value = value
        return value, improved
