"""The last steps of a search: the true worst place on a fine grid, with exact rows.

A coarse grid hides the worst place, which mostly lies beside an electrode. So the places that are worst on the fine
grid become constraints,

    make t small with   ln error(place) <= t   at all of them,

which is solved by sequential quadratic programming within a small step; then the worst places are taken anew.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from isocharge.common.arrays import Array
from isocharge.simulate.layout.placing import MILLIMETRE, Parameters, Rules
from isocharge.simulate.layout.position_error import ErrorModel
from isocharge.simulate.layout.square_charges import PressedSquares, SquareCharges

ROUNDS, STEPS = 8, 25
"""Largest number of rounds, and of quadratic programs in each."""

NEARLY, MOST = 0.9, 60
"""Places count as worst down to this share of the largest error, and at most so many of them."""

REACH_MM = (0.6, 0.5)
"""Largest change of a free number in the first round, mm, and its reduction after a round that did not help."""

ENOUGH = 1e-3
"""Relative gain of a round below which the search ends."""


@dataclass(frozen=True)
class FineGrid:
    """One scene on its fine grid.

    Attributes:
        charges: Rows of any square.
        presses: Shape (n_press, 2), m.
        stay: Rows of the electrodes that stay, shape (n_press, n_stay, 7).
        reference: Error that counts as one, m.
    """

    charges: SquareCharges
    presses: Array
    stay: Array
    reference: float

    def errors(self, model: ErrorModel, centres: Array, sides: Array) -> Array:
        """Position errors of a layout at all presses, shape (n_press,), m."""
        rows = np.concatenate([self.charges.under(self.presses).layout(centres, sides), self.stay], axis=1)
        return np.sqrt(model.squared(rows))


@dataclass(frozen=True)
class Polish:
    """What the last steps need.

    Attributes:
        grids: The scenes.
        errors: What is known and what not.
        parameters: Free numbers of a layout.
        rules: What a layout must keep to.
    """

    grids: tuple[FineGrid, ...]
    errors: ErrorModel
    parameters: Parameters
    rules: Rules

    def worst(self, free: Array) -> float:
        """Largest error over its reference, of all scenes."""
        layout = self.parameters.layout(free)
        return max(float(grid.errors(self.errors, *layout).max()) / grid.reference for grid in self.grids)

    def run(self, free: Array) -> Array:
        """Free numbers of a layout that keeps to the rules and whose worst error is smaller, from nearby ones."""
        reach, best = REACH_MM[0], np.inf
        for _ in range(ROUNDS):
            tried = self._round(free, reach)
            value = self.worst(tried)
            if value < best * (1.0 - ENOUGH):
                free, best = tried, value
            elif reach < 0.1 * REACH_MM[0]:
                break
            else:
                reach *= REACH_MM[1]
        return free

    def _round(self, free: Array, reach: float) -> Array:
        """One sequence of quadratic programs for the places that are worst now."""
        active = [self._worst_places(grid, free) for grid in self.grids]
        start = free / MILLIMETRE
        limits = _Remembered(lambda variables: self._limits(active, variables))
        first = np.append(start, 0.0)
        first[-1] = -min(limits.values(first)[: sum(len(places.stay) for places in active)])
        only_last = np.append(np.zeros(start.size), 1.0)
        result = minimize(
            lambda variables: (variables[-1], only_last),
            first,
            jac=True,
            method="SLSQP",
            bounds=[*self._bounds(start, reach), (None, None)],
            constraints={"type": "ineq", "fun": limits.values, "jac": limits.slopes},
            options={"maxiter": STEPS, "ftol": 1e-5},
        )
        moved: Array = result.x[:-1] * MILLIMETRE
        return moved

    def _bounds(self, start_mm: Array, reach_mm: float) -> list[tuple[float, float]]:
        """Free numbers within the reach, sides within their own limits."""
        places = self.parameters.places.shape[1]
        low, high = (side / MILLIMETRE for side in self.parameters.side)
        near = [(x - reach_mm, x + reach_mm) for x in start_mm[:places].tolist()]
        return near + [(max(low, x - reach_mm), min(high, x + reach_mm)) for x in start_mm[places:].tolist()]

    def _worst_places(self, grid: FineGrid, free: Array) -> "_Active":
        error = grid.errors(self.errors, *self.parameters.layout(free))
        worst = np.argsort(-error)[:MOST]
        worst = worst[error[worst] >= NEARLY * error.max()]
        return _Active(grid.charges.under(grid.presses[worst]), grid.stay[worst], grid.reference)

    def _limits(self, active: "list[_Active]", variables: Array) -> tuple[Array, Array]:
        """Values that must not be negative, and their derivatives by the variables: free numbers (mm) and t."""
        centres, sides = self.parameters.layout(variables[:-1] * MILLIMETRE)
        parts = [places.logs(self.errors, centres, sides) for places in active]
        logs, by_layout = (np.concatenate(part) for part in zip(*parts, strict=True))
        broken, by_rule = self.rules.violations(centres, sides)
        above = np.concatenate([-self.parameters.back(by_layout) * MILLIMETRE, np.ones((len(logs), 1))], axis=1)
        below = np.concatenate([-self.parameters.back(by_rule), np.zeros((len(broken), 1))], axis=1)
        return np.concatenate([variables[-1] - logs, -broken / MILLIMETRE]), np.concatenate([above, below])


@dataclass(frozen=True)
class PolishJob:
    """The last steps from one local optimum: free numbers, m."""

    polish: Polish
    free: Array


def run_polish(job: PolishJob) -> Array:
    """The worst error over its reference, then the free numbers, m."""
    free = job.polish.run(job.free)
    return np.concatenate([[job.polish.worst(free)], free])


@dataclass(frozen=True)
class _Active:
    """The worst places of a scene: their rows, those of the electrodes that stay, and the error that counts as one."""

    pressed: PressedSquares
    stay: Array
    reference: float

    def logs(self, model: ErrorModel, centres: Array, sides: Array) -> tuple[Array, Array]:
        """Logarithms of the errors, shape (n,), and their derivatives by each square's x, y and side, (n, n_new, 3)."""
        rows = np.concatenate([self.pressed.layout(centres, sides), self.stay], axis=1)
        squared, by_rows = model.gradient(rows)
        slopes = np.einsum(
            "kec,kecd->ked", by_rows[:, : len(centres)], self.pressed.layout_gradient(centres, sides), optimize=True
        )
        return 0.5 * np.log(squared) - np.log(self.reference), 0.5 * slopes / squared[:, None, None]


class _Remembered:
    """Values and slopes of one function, computed together: the optimiser asks for them one after the other."""

    def __init__(self, function: Callable[[Array], tuple[Array, Array]]) -> None:
        self._function, self._at, self._last = function, b"", (np.empty(0), np.empty(0))

    def values(self, variables: Array) -> Array:
        return self._of(variables)[0]

    def slopes(self, variables: Array) -> Array:
        return self._of(variables)[1]

    def _of(self, variables: Array) -> tuple[Array, Array]:
        if variables.tobytes() != self._at:
            self._at, self._last = variables.tobytes(), self._function(variables)
        return self._last
