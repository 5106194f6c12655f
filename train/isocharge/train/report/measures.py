"""Figures of merit: errors of contacts, and which methods nothing beats."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.stats import norm

from isocharge.common.arrays import Array
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.data.presses import position_error


def rounded(value: float | None, digits: int = 4) -> float | None:
    """To significant digits, for the record; None if there is no such number."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.{digits}g}")


@dataclass(frozen=True)
class Errors:
    """Errors of contacts over the presses that were answered; None for what no press gives.

    Attributes:
        position_rms_mm, position_median_mm, position_p95_mm: Of the distance from the true position.
        force_rms_percent, force_median_percent: Of the relative error of the force.
        answered: Share of the presses, 0 to 1.
    """

    position_rms_mm: float | None
    position_median_mm: float | None
    position_p95_mm: float | None
    force_rms_percent: float | None
    force_median_percent: float | None
    answered: float

    @classmethod
    def of(cls, contact: Array, truth: Array) -> "Errors":
        """From contacts (x_mm, y_mm, force_N), NaN where a method gave no answer, and the presses; both (n, 3)."""
        answered = np.isfinite(contact[:, :2]).all(axis=1)
        if not answered.any():
            return cls(None, None, None, None, None, 0.0)
        position = position_error(contact[answered], truth[answered])
        force = 100.0 * np.abs(contact[answered, 2] / truth[answered, 2] - 1.0)
        return cls(
            position_rms_mm=rounded(rms(position)),
            position_median_mm=rounded(float(np.median(position))),
            position_p95_mm=rounded(float(np.percentile(position, 95))),
            force_rms_percent=rounded(rms(force)),
            force_median_percent=rounded(float(np.median(force))),
            answered=rounded(float(np.mean(answered))) or 0.0,
        )

    def to_dict(self) -> dict[str, float | None]:
        """For JSON."""
        return asdict(self)


Plot = Literal["latency", "throughput", "memory"]
"""A plot of the error against a cost."""

COST_SIGNS: dict[Plot, float] = {"latency": 1.0, "throughput": -1.0, "memory": 1.0}
"""1 where less of the plot's cost is better, -1 where more of it is."""


@dataclass(frozen=True)
class MethodRecord:
    """What the report says about a method in one form.

    Attributes:
        name: The method.
        form: What computes it.
        kind: "paper", "learnt", "fitted map" or "network".
        choice: Its hyperparameters and how they were chosen.
        force_given: Whether it was given the true force.
        errors: On all test presses.
        over_bayes: Position error over the Bayes limit's on the same presses; None where there is no limit.
        p50_us, p99_us: Median and 99th percentile of the duration of one prediction.
        per_second: Predictions per second in batches.
        memory_bytes: Serialised size.
        fit_seconds: Duration of fitting all forms.
        best_on: Plots on which no method is better in both error and cost.
    """

    name: str
    form: str
    kind: str
    choice: str
    force_given: bool
    errors: Errors
    over_bayes: float | None
    p50_us: float
    p99_us: float
    per_second: float
    memory_bytes: int
    fit_seconds: float
    best_on: tuple[Plot, ...] = ()

    @property
    def label(self) -> str:
        """Name and form."""
        return f"{self.name} ({self.form})"

    @property
    def competes(self) -> bool:
        """Whether it answers what the others answer: all presses, from the charges alone."""
        return not self.force_given and self.errors.answered == 1.0

    @property
    def error_mm(self) -> float:
        """Root-mean-square position error, mm; NaN without answers."""
        return float("nan") if self.errors.position_rms_mm is None else self.errors.position_rms_mm

    def cost(self, plot: Plot) -> float:
        """The figure along the plot's axis: us, predictions per second or bytes."""
        return {"latency": self.p50_us, "throughput": self.per_second, "memory": float(self.memory_bytes)}[plot]

    def to_dict(self) -> dict[str, Any]:
        """As in `report.json`."""
        figures = {key: rounded(getattr(self, key)) for key in ("p50_us", "p99_us", "per_second", "fit_seconds")}
        return {"label": self.label, **asdict(self), **figures}


def mark_fronts(records: Sequence[MethodRecord]) -> list[MethodRecord]:
    """The records with the plots on which nothing beats them; methods that do not compete are on none."""
    error = np.array([record.error_mm if record.competes else np.nan for record in records])
    fronts = {
        plot: pareto(sign * np.array([record.cost(plot) for record in records]), error)
        for plot, sign in COST_SIGNS.items()
    }
    return [
        replace(record, best_on=tuple(plot for plot, front in fronts.items() if front[number]))
        for number, record in enumerate(records)
    ]


def pareto(cost: Array, error: Array) -> np.ndarray:
    """Which methods no other beats in both: none has a lower cost and error, nor one equal and the other lower.

    Args:
        cost: Shape (n,).
        error: Shape (n,); NaN is never on the front.

    Returns:
        Shape (n,), bool.
    """
    lower = (cost[None] <= cost[:, None]) & (error[None] <= error[:, None])
    strictly = (cost[None] < cost[:, None]) | (error[None] < error[:, None])
    front: np.ndarray = ~(lower & strictly).any(axis=1) & np.isfinite(cost) & np.isfinite(error)
    return front


def coverage(contact: Array, std: Array, truth: Array, levels: Array) -> Array:
    """Share of truths within the central interval of each nominal level, Gaussian; shape (n_level, 3) for x, y, F."""
    deviation = np.abs(contact - truth) / std
    within: Array = np.mean(deviation[None] <= norm.ppf(0.5 + 0.5 * levels)[:, None, None], axis=1)
    return within
