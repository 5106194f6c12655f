"""The number that a search makes small, for one layout: from tables, in milliseconds, with its derivatives."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.layout.place_table import PlaceTable
from isocharge.simulate.layout.placing import MILLIMETRE, Parameters, Rules
from isocharge.simulate.layout.position_error import ErrorModel

PENALTY = 20.0
"""Weight of a squared violation, 1/mm^2, against the logarithm of the error."""

SPARE = 0.05e-3
"""The search keeps this much more distance than the rules ask for, m: a penalty gives way a little."""


@dataclass(frozen=True)
class Condition:
    """One scene of a design: its tables, the rows of the electrodes that stay, and the error to compare with.

    Attributes:
        table: Rows of squares anywhere.
        stay: Rows of the electrodes that stay, shape (n_press, n_stay, 7).
        weight: Of each press in the goal, shape (n_press,).
        reference: Error that counts as one, m: that of the best layout for this scene alone.
    """

    table: PlaceTable
    stay: Array
    weight: Array
    reference: float


@dataclass(frozen=True)
class Objective:
    """The logarithm of a layout's error over all conditions, with penalties for broken rules.

    The mean of the errors' powers is their root mean square for the power 2, and near the worst one for a large power.

    Attributes:
        conditions: The scenes.
        errors: What is known and what not.
        parameters: Free numbers of a layout.
        rules: What a layout must keep to.
        power: Of the error, even.
    """

    conditions: tuple[Condition, ...]
    errors: ErrorModel
    parameters: Parameters
    rules: Rules
    power: float

    def value(self, free: Array) -> float:
        """Of free numbers, shape (n_free,), m."""
        centres, sides = self.parameters.layout(free)
        logs = [self._log(condition, self._rows(condition, centres, sides)[0]) for condition in self.conditions]
        return _soft_largest(np.array(logs))[0] + self._penalty(centres, sides)[0]

    def gradient(self, free: Array) -> tuple[float, Array]:
        """Value and its derivatives, per m."""
        centres, sides = self.parameters.layout(free)
        logs, slopes = [], []
        for condition in self.conditions:
            rows, by_square = self._rows(condition, centres, sides)
            squared, by_rows = self.errors.gradient(rows)
            log, by_squared = self._mean(condition, squared)
            logs.append(log)
            slopes.append(np.einsum("k,kec,kecd->ed", by_squared, by_rows[:, : len(centres)], by_square))
        value, share = _soft_largest(np.array(logs))
        penalty, by_layout = self._penalty(centres, sides)
        total = np.einsum("s,sed->ed", share, np.stack(slopes)) + by_layout
        return value + penalty, self.parameters.back(total)

    def _rows(self, condition: Condition, centres: Array, sides: Array) -> tuple[Array, Array]:
        """Rows of the layout and of the electrodes that stay, and the derivatives of the former by the squares."""
        parts = [condition.table.rows(centre, float(side)) for centre, side in zip(centres, sides, strict=True)]
        rows = np.stack([row for row, _ in parts], axis=1)
        return np.concatenate([rows, condition.stay], axis=1), np.stack([slope for _, slope in parts], axis=1)

    def _log(self, condition: Condition, rows: Array) -> float:
        return self._mean(condition, self.errors.squared(rows))[0]

    def _mean(self, condition: Condition, squared: Array) -> tuple[float, Array]:
        """Logarithm of the power mean of the errors over the reference, and its derivatives by the squared errors."""
        logs = 0.5 * self.power * np.log(squared)
        top = logs.max()
        terms = condition.weight * np.exp(logs - top)
        total, weight = terms.sum(), condition.weight.sum()
        mean = (top + np.log(total / weight)) / self.power - np.log(condition.reference)
        return float(mean), 0.5 * terms / total / squared

    def _penalty(self, centres: Array, sides: Array) -> tuple[float, Array]:
        values, slopes = self.rules.violations(centres, sides)
        excess = np.maximum(values + SPARE, 0.0) / MILLIMETRE
        by_layout = np.einsum("r,red->ed", 2.0 * PENALTY * excess / MILLIMETRE, slopes)
        return float(PENALTY * (excess**2).sum()), by_layout


SHARPNESS = 40.0
"""How sharply the worst condition counts alone: those whose error is 1/40 smaller still have a third of its weight."""


def _soft_largest(logs: Array) -> tuple[float, Array]:
    """Smooth largest value, and its derivatives."""
    terms = np.exp(SHARPNESS * (logs - logs.max()))
    share: Array = terms / terms.sum()
    return float(logs.max() + np.log(terms.sum()) / SHARPNESS), share
