"""Search for electrode positions with small position errors.

A layout is described by the coordinates of its new squares. The minimised quantity is a power mean of the position
errors of many presses: the p-th root of the mean of the p-th powers of the errors. The exponent is 2 for the root mean
square. For the largest error, a large exponent makes the power mean a smooth approximation of the maximum.

Sequential quadratic programming (SLSQP) minimises the logarithm of the power mean from several random layouts, for
presses on a coarse lattice, under the distance rules. The largest error mostly occurs near the edge of an electrode,
between the presses of the lattice. The best layouts are therefore improved further, for the presses with the largest
errors on a fine grid, which are selected again after each improvement.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.layout.case import DesignCase
from isocharge.simulate.layout.stress_fields import PressedFilm, rows_of
from isocharge.simulate.numerics.disk import sunflower
from isocharge.simulate.sensor.sensor import Electrode

STARTS = 24
"""Number of random layouts from which the search starts."""

POWER = 12.0
"""Exponent of the power mean on the lattice if the goal is the largest error. It is doubled in each further round."""

EXTENT = 1.0 / 3.0
"""Distance by which the random squares extend beyond the presses, in film radii, dimensionless.

The charges of electrodes that are farther out depend little on the position of a press.
"""

ROUNDS = 5
"""Number of improvements of a layout for the presses with the largest errors."""

MAX_FINALISTS = 3
"""Largest number of layouts that are improved further."""

MIN_DIFFERENCE = 2e-3
"""Relative difference of the errors above which two layouts are different and not rotations of each other."""

CLEARANCE_TOLERANCE = 1e-3
"""Largest violation of a distance rule that a layout may have, mm."""

DIFFERENCE_STEP = 1e-2
"""Step of the finite differences with respect to the coordinates of the squares, mm."""


@dataclass(frozen=True)
class Layout:
    """Positions of the new squares.

    Attributes:
        positions: Centres (x, y), shape (n_new, 2), mm.
        error: Value of the minimised quantity, mm.
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
    useful_radius = case.radius + EXTENT * case.sensor.film.radius
    allowed_radius = case.sensor.film.inner_radius - case.rim - 0.5 * case.square_side
    radius = min(useful_radius, allowed_radius)
    points = radius * sunflower(1000)
    grid = np.stack([points.real, points.imag], axis=1)
    grid = grid[case.clearance(grid) >= 0.0]

    rng = np.random.default_rng(case.seed)
    layouts = []
    for _ in range(STARTS):
        positions = grid[:0]
        for candidate in grid[rng.permutation(len(grid))]:
            if len(positions) < case.new_count and (case.pair_clearance(positions, candidate[None]) >= 0.0).all():
                positions = np.vstack([positions, candidate])
        if len(positions) < case.new_count:
            raise InputError(
                f"{case.new_count} new squares of {case.square_side:g} mm do not fit within {radius:.3g} mm of the "
                f"centre, with gaps of {case.gap:g} mm; ask for fewer, smaller or nearer electrodes"
            )
        layouts.append(positions)
    return layouts


@dataclass(frozen=True)
class Search:
    """Search for the electrode positions that minimise the goal of a design case.

    Attributes:
        case: Requirements of the layout.
        fields: Stress fields for the probe and the force of the case.
    """

    case: DesignCase
    fields: ForwardMap

    def errors(self, positions: Array) -> Array:
        """Compute the position error of each press of the fine grid, shape (n_press,), mm.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.
        """
        electrodes = self.case.layout(positions).electrodes
        return self.case.position_errors(rows_of(self.fields, self.case.fine_grid, electrodes), self.case.nuisances)

    def minimised_error(self, positions: Array) -> float:
        """Compute the largest error or the root mean square of the errors on the fine grid, mm.

        Args:
            positions: Centres (x, y) of the new squares, shape (n_new, 2), mm.
        """
        errors = self.errors(positions)
        return float(errors.max() if self.case.goal == "worst" else np.sqrt(np.mean(errors**2)))

    def optimum(self, start: Array) -> Layout:
        """Minimise the power mean of the errors on the lattice, from the positions of a layout.

        Args:
            start: Centres (x, y) of the new squares, shape (n_new, 2), mm.

        Returns:
            Improved layout, whose error is the power mean.
        """
        power = POWER if self.case.goal == "worst" else 2.0
        return self.minimise(self.case.search_presses, start, power)

    def refine(self, layout: Layout) -> Layout:
        """Reduce the largest error on the fine grid, and return the layout with the value of the goal.

        Args:
            layout: Layout for which the power mean on the lattice is small.
        """
        positions = layout.positions
        if self.case.goal != "worst":
            return Layout(positions, self.minimised_error(positions))
        smallest_errors = self.errors(positions)
        for round_number in range(1, ROUNDS + 1):
            largest = np.argsort(-smallest_errors)[: len(self.case.search_presses)]
            presses = np.concatenate([self.case.search_presses, self.case.fine_grid[largest]])
            changed = self.minimise(presses, positions, POWER * 2.0**round_number).positions
            errors = self.errors(changed)
            if errors.max() < smallest_errors.max():
                positions = changed
                smallest_errors = errors
        return Layout(positions, float(smallest_errors.max()))

    def minimise(self, presses: Array, start: Array, power: float) -> Layout:
        """Minimise a power mean of the position errors of presses.

        Args:
            presses: Positions (x, y) of the presses, shape (n_press, 2), mm.
            start: Centres (x, y) of the new squares, which satisfy the distance rules, shape (n_new, 2), mm.
            power: Exponent of the power mean.

        Returns:
            Layout with its power mean.
        """
        pressed = PressedFilm.interpolate(self.fields, presses)
        kept_rows = pressed.rows(self.case.kept_electrodes)
        side = self.case.square_side

        def square_rows(positions: Array) -> Array:
            """Return the rows of squares at positions of shape (n, 2), shape (n_press, n, 6)."""
            return pressed.rows([Electrode.of_square("A", (x, y), side) for x, y in positions.tolist()])

        def log_mean(new_rows: Array) -> float:
            """Return the logarithm of the power mean for rows of the new squares, shape (n_press, n_new, 6)."""
            rows = np.concatenate([new_rows, kept_rows], axis=1)
            error = self.case.position_errors(rows, self.case.nuisances)
            largest = error.max()  # the powers of the ratios neither overflow nor all underflow
            return float(np.log(largest) + np.log(np.mean((error / largest) ** power)) / power)

        def objective(coordinates: Array) -> tuple[float, Array]:
            """Return the logarithm of the power mean, and its derivatives with respect to x1, y1, x2, y2, ..."""
            # If one square moves, only the rows of this square change.
            positions = coordinates.reshape(-1, 2)
            moved_positions = (positions[:, None] + DIFFERENCE_STEP * np.eye(2)).reshape(-1, 2)
            rows = square_rows(positions)
            value = log_mean(rows)
            gradient = np.empty(coordinates.size)
            for index, moved_rows in enumerate(square_rows(moved_positions).swapaxes(0, 1)):
                changed_rows = rows.copy()
                changed_rows[:, index // 2] = moved_rows
                gradient[index] = (log_mean(changed_rows) - value) / DIFFERENCE_STEP
            return value, gradient

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
            return Layout(start, float(np.exp(objective(start.ravel())[0])))
        return Layout(positions, float(np.exp(solution.fun)))
