"""Gauss-Newton on an interpolated forward map: the contact whose charges fit best, maximum a posteriori.

The forward map is the Chebyshev series of `ChargeField`, fitted to clean training presses; the residuals are
(Q - Q(c)) / sigma(Q). The prior, uniform over the disk and the range of log force, is a constraint, held by the active
set of `simulate.numerics.disk_least_squares`; damping makes every step an improvement. The start is the nearest of a
few presses, and the next nearest where that led to charges that do not fit.

The SciPy form hands the same residuals to `scipy.optimize.least_squares` in polar coordinates, where the disk is a box,
press by press.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from isocharge.common.arrays import Array
from isocharge.simulate.numerics.disk_least_squares import minimise, minimise_one
from isocharge.train.baselines.estimator import Fitted, FittingTask
from isocharge.train.baselines.features import LogFeatures
from isocharge.train.baselines.problem import Problem
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.domain import ContactDomain

NAME = "Gauss-Newton"

STARTS = 600
"""Presses that a start is chosen from."""

TOLERANCE = 1e-5
"""Step in unit coordinates at which SciPy stops: 0.1 um or 1e-5 of the force."""

DOUBTFUL = 12.0
"""Sum of squared residuals from which another start is tried: noise alone, with a charge or none to spare, hardly
reaches it."""

ATTEMPTS = 3
"""Starts at most."""

BATCH = 512
"""Presses at once: their polynomials stay in the cache."""


@dataclass(frozen=True)
class GaussNewton:
    """The method."""

    name: str = NAME

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """Fit the forward map on clean presses, its degree by the validation presses; both forms."""
        held = (task.validation.contact, task.validation.charge_pC)
        field = ChargeField.fit(task.domain, task.train.contact, task.train.charge_pC, held)
        rows = np.random.default_rng(task.seed).permutation(len(task.train))[:STARTS]
        features = LogFeatures.fit(task.train.charge_pC)
        starts = features(task.train.charge_pC[rows]), task.domain.to_unit(task.train.contact[rows])
        problem, degree = Problem.of(field, task.noise), len(field.series) - 1
        choice = f"series of degree {degree}, {100 * field.error:.2g} % rms off; start from {len(rows)} presses"
        return tuple(
            form(problem, features, *starts, task.domain, choice) for form in (ScipyGaussNewton, NumpyGaussNewton)
        )


@dataclass(frozen=True)
class _GaussNewton(Fitted):
    """What both forms need.

    Attributes:
        problem: Forward map and prior.
        features: Of the charges, to find a start.
        points: Features of the starts, shape (m, n_electrode).
        unit: Their contacts in unit coordinates, shape (m, 3).
        domain: What the unit coordinates refer to.
    """

    problem: Problem
    features: LogFeatures
    points: Array
    unit: Array
    domain: ContactDomain
    choice: str = ""
    name: str = NAME
    form: str = ""

    def start(self, charge_pC: Array, attempt: int) -> Array:
        """The nearest of the starts, or the next nearest ones, unit coordinates, (..., n_electrode) to (..., 3)."""
        distance = self._squares - self.features(charge_pC) @ self.points.T
        rank = distance.argmin(axis=-1) if attempt == 0 else distance.argsort(axis=-1)[..., attempt]
        start: Array = self.unit[rank]
        return start

    @cached_property
    def _squares(self) -> Array:
        squares: Array = 0.5 * (self.points**2).sum(axis=1)
        return squares


@dataclass(frozen=True)
class ScipyGaussNewton(_GaussNewton):
    """scipy.optimize.least_squares, its trust-region method for bounded variables."""

    form: str = "SciPy least_squares"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        return self.domain.to_contact(np.stack([self._solve(charge) for charge in charge_pC]))

    def _solve(self, charge: Array) -> Array:
        best: Any = None
        for attempt in range(ATTEMPTS):
            solution = self._descend(charge, self.start(charge, attempt))
            best = solution if best is None or solution.cost < best.cost else best
            if 2.0 * best.cost <= DOUBTFUL:
                break
        radius, angle, log_force = best.x
        return np.array([radius * np.cos(angle), radius * np.sin(angle), log_force])

    def _descend(self, charge: Array, start: Array) -> Any:
        sigma = self.problem.sigma(charge)

        def cartesian(polar: Array) -> Array:
            return np.array([polar[0] * np.cos(polar[1]), polar[0] * np.sin(polar[1]), polar[2]])

        def slopes(polar: Array) -> Array:
            sine, cosine = np.sin(polar[1]), np.cos(polar[1])
            turn = np.array([[cosine, sine, 0.0], [-polar[0] * sine, polar[0] * cosine, 0.0], [0.0, 0.0, 1.0]])
            return (turn @ self.problem.residuals(cartesian(polar), charge, sigma)[1]).T

        return least_squares(
            lambda polar: self.problem.residuals(cartesian(polar), charge, sigma)[0],
            [np.hypot(start[0], start[1]), np.arctan2(start[1], start[0]), start[2]],
            slopes,
            bounds=([0.0, -np.inf, -1.0], [1.0, np.inf, 1.0]),
            x_scale="jac",
            xtol=TOLERANCE,
        )


@dataclass(frozen=True)
class NumpyGaussNewton(_GaussNewton):
    """All presses of a batch step together; those that are done wait no longer."""

    form: str = "NumPy"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        parts = [self._solve(charge_pC[start : start + BATCH]) for start in range(0, len(charge_pC), BATCH)]
        return self.domain.to_contact(np.concatenate(parts))

    def _solve(self, charge: Array) -> Array:
        unit, cost = self._descend(charge, self.start(charge, 0))
        for attempt in range(1, ATTEMPTS):
            again = np.flatnonzero(cost > DOUBTFUL)
            if not again.size:
                break
            other, other_cost = self._descend(charge[again], self.start(charge[again], attempt))
            better = other_cost < cost[again]
            unit[again[better]], cost[again[better]] = other[better], other_cost[better]
        return unit

    def _descend(self, charge: Array, unit: Array) -> tuple[Array, Array]:
        """Contacts (n, 3) and sums of squared residuals (n,) from a start."""
        sigma = self.problem.sigma(charge)
        unit, residual = minimise(lambda rows, at: self.problem.residuals(at, charge[rows], sigma[rows]), unit)
        return unit, (residual**2).sum(axis=1)

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`."""
        charge = np.array(charge_pC, dtype=float)
        return lambda: self.single(charge)

    def single(self, charge_pC: Array) -> Array:
        """The contact of one press, shape (n_electrode,) to (3,)."""
        sigma = self.problem.sigma(charge_pC)

        def residuals(unit: Array) -> tuple[Array, Array]:
            return self.problem.residuals(unit, charge_pC, sigma)

        unit, square = minimise_one(residuals, self.start(charge_pC, 0))
        for attempt in range(1, ATTEMPTS):
            if square <= DOUBTFUL:
                break
            other, other_square = minimise_one(residuals, self.start(charge_pC, attempt))
            unit, square = (other, other_square) if other_square < square else (unit, square)
        return self.domain.to_contact(unit)
