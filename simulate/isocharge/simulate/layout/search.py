"""The search: exchange on a grid of places, then the true worst place on a fine grid.

Exchange (Fedorov 1972; Meyer and Nachtsheim 1995): from a random layout, each square in turn goes to the place that is
best beside the others, until none moves. All places of a grid are compared at once, because one more electrode changes
the information by a product of vectors. A power mean of the errors is made small there, near the worst one.

A coarse grid hides the worst error, which mostly lies beside an electrode. So the presses that are worst on the fine
grid become constraints,

    make t small with   ln error(press) <= t   at all of them,

which sequential quadratic programs solve within a small step; then the worst presses are taken anew.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.arrays import Array, Integers
from isocharge.common.errors import InputError
from isocharge.common.progress import track
from isocharge.simulate.layout.case import DesignCase
from isocharge.simulate.layout.charge_table import ChargeTable
from isocharge.simulate.layout.position_error import ErrorModel, with_one_more
from isocharge.simulate.numerics.disk import square_grid

STARTS = 24
"""Random layouts that are improved."""

POWERS = {"worst": 12.0, "rms": 2.0}
"""Power of the errors whose mean the exchange makes small."""

SWEEPS, SETTLED = 30, 1e-4
"""Largest number of exchanges of every square, and the relative gain of all below which they end."""

GRID, BEYOND = 20, 1.0 / 3.0
"""Steps of the grid of places from the centre outwards, and how far it reaches beyond the presses, in film radii:
charges of electrodes farther out change little."""

FINALISTS, ALIKE = 3, 2e-3
"""Different layouts that are refined; nearer values, relative, are the same one, turned."""

ROUNDS, STEPS = 8, 25
"""Largest number of rounds of the refinement, and of quadratic programs in each."""

NEARLY, ACTIVE = 0.9, 60
"""Presses count as worst down to this share of the largest error, and at most so many of them."""

REACH, LEAST_REACH = 0.2, 0.02
"""Largest change of a coordinate in the first round over the side, halved after rounds that do not help; the last."""

ENOUGH = 1e-3
"""Relative gain of a round below which it does not help."""

DIFFERENCE = 1e-2
"""Step of the optimiser's differences, mm."""

ALL = slice(None)
"""Every press of the fine grid."""


def random_layouts(case: DesignCase) -> tuple[Array, list[Integers]]:
    """The grid of places, shape (n, 2), mm, and the numbers of `STARTS` random layouts that keep to the rules.

    Raises:
        InputError: If the squares do not fit.
    """
    film = case.sensor.film.radius
    reach = min(case.radius + BEYOND * film, film - case.rim - 0.5 * case.square_side)
    places = square_grid(reach, reach / GRID)
    places = places[case.room(places) >= 0.0]
    rng, layouts = np.random.default_rng(case.seed), []
    for _ in range(STARTS):
        chosen: list[int] = []
        for number in rng.permutation(len(places)).tolist():
            if len(chosen) < case.new and (case.apart(places[[number]], places[chosen]) >= 0.0).all():
                chosen.append(number)
        layouts.append(np.array(chosen))
    if min(map(len, layouts)) < case.new:
        raise InputError(
            f"{case.new} new squares of {case.square_side:g} mm do not fit within {reach:.3g} mm of the centre, with "
            f"gaps of {case.gap:g} mm; ask for fewer, smaller or nearer electrodes"
        )
    return places, layouts


@dataclass(frozen=True)
class Search:
    """The search for one case.

    Attributes:
        case: What is asked.
        table: Charges under the presses of the case.
    """

    case: DesignCase
    table: ChargeTable

    @cached_property
    def model(self) -> ErrorModel:
        """Errors with the nuisances of the case."""
        return ErrorModel.of(self.case.noise, self.case.nuisances)

    @cached_property
    def fine(self) -> Array:
        """Presses of the fine grid, shape (n, 2), mm; goals other than the worst error need no finer one."""
        return self.case.grid if self.case.goal == "worst" else self.case.presses

    @cached_property
    def weights(self) -> Array:
        """What the presses of the fine grid count in the goal, shape (n,)."""
        return self.case.weights(self.fine)

    @cached_property
    def staying(self) -> Array:
        """Rows of the electrodes that stay under the presses of the fine grid."""
        return self.table.rows(self.fine, np.empty((0, 2)), self.case.square_side, self.case.stay)

    def squared(self, places: Array, which: Integers | slice) -> Array:
        """Squared errors of a layout under some presses of the fine grid, shape (n_press,), mm^2."""
        rows = self.table.rows(self.fine[which], places, self.case.square_side)
        return self.model.squared(np.concatenate([rows, self.staying[which]], axis=1))

    def optima(self, places: Array, layouts: list[Integers]) -> list[Array]:
        """The best different layouts that exchange reaches, each of shape (n_new, 2), mm, the best first."""
        case, side = self.case, self.case.square_side
        stay = self.model.sensitivity(self.table.rows(case.presses, places[:0], side, case.stay))
        squares = self.model.sensitivity(self.table.rows(case.presses, places, side))
        candidates, apart = np.ascontiguousarray(squares.swapaxes(1, 2)), case.apart(places, places) >= 0.0
        weight, power = case.weights(case.presses), POWERS["worst" if case.goal == "worst" else "rms"]

        def errors_with(others: Integers) -> Array:
            """Power of the mean error with one more square beside others at each place; infinite where too near."""
            beside = np.concatenate([stay, candidates[:, :, others].swapaxes(1, 2)], axis=1)
            squared = np.maximum(with_one_more(beside, candidates), 1e-12)
            errors = np.average(squared ** (0.5 * power), axis=0, weights=weight)
            errors[~apart[others].all(axis=0)] = np.inf
            return np.asarray(errors)

        def exchanged(start: Integers) -> tuple[float, Integers]:
            """A layout that no exchange of a single square improves, and its value."""
            chosen, best = start.copy(), np.inf
            for _ in range(SWEEPS):
                for i in range(len(chosen)):
                    errors = errors_with(np.delete(chosen, i))
                    chosen[i] = np.argmin(errors)
                value = float(errors.min() ** (1.0 / power))
                if value > best * (1.0 - SETTLED):
                    break
                best = value
            return value, chosen

        optima = sorted((exchanged(start) for start in track(layouts, "exchanging")), key=lambda optimum: optimum[0])
        different = optima[:1]
        for value, chosen in optima:
            if len(different) < FINALISTS and value > different[-1][0] * (1.0 + ALIKE):
                different.append((value, chosen))
        return [places[chosen] for _, chosen in different]

    def value(self, places: Array) -> float:
        """What is made small, mm: the worst error on the fine grid, or the weighted root mean square."""
        return float(np.exp(self._logs(places, ALL).max()))

    def _logs(self, places: Array, which: Integers | slice) -> Array:
        """Logarithms of the errors that count: of each press, or one of their mean over the fine grid."""
        squared = self.squared(places, which)
        if self.case.goal != "worst":
            squared = np.average(squared, weights=self.weights, keepdims=True)
        return np.asarray(0.5 * np.log(squared))

    def refine(self, places: Array) -> Array:
        """A better layout near one that keeps to the rules: its value, mm, then its coordinates, (1 + 2 n_new,)."""
        reach, best = REACH, self.value(places)
        for _ in range(ROUNDS):
            moved = self._round(places, reach * self.case.square_side)
            value = self.value(moved)
            if value < best * (1.0 - ENOUGH) and self.case.spare(moved).min() > -1e-3:
                places, best = moved, value
            elif reach > LEAST_REACH:
                reach *= 0.5
            else:
                break
        return np.append(best, places)

    def _round(self, places: Array, reach: float) -> Array:
        """One sequence of quadratic programs, within `reach` (mm), for the presses that are worst now."""
        active: Integers | slice = ALL
        if self.case.goal == "worst":
            squared = self.squared(places, ALL)
            worst = np.argsort(-squared)[:ACTIVE]
            active = worst[squared[worst] >= NEARLY**2 * squared.max()]

        def spare(variables: Array) -> Array:
            moved = variables[:-1].reshape(-1, 2)
            return np.concatenate([variables[-1] - self._logs(moved, active), self.case.spare(moved)])

        only_last = np.append(np.zeros(places.size), 1.0)
        solved = scipy.optimize.minimize(
            lambda variables: variables[-1],
            np.append(places, self._logs(places, active).max()),
            jac=lambda _: only_last,
            method="SLSQP",
            bounds=[*((x - reach, x + reach) for x in places.ravel().tolist()), (None, None)],
            constraints={"type": "ineq", "fun": spare},
            options={"maxiter": STEPS, "ftol": 1e-4, "eps": DIFFERENCE},
        )
        return np.asarray(solved.x[:-1].reshape(-1, 2))
