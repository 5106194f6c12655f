"""Figures of merit: errors of contacts, which methods nothing beats, and a sentence on the released model."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.arrays import Array
from isocharge.serve.benchmark import Timing
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.baselines.compared_methods import ComparedMethod
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


Plot = Literal["latency", "throughput", "memory"]
"""A plot of the error against a cost."""

COST_SIGNS: dict[Plot, float] = {"latency": 1.0, "throughput": -1.0, "memory": 1.0}
"""1 where less of the plot's cost is better, -1 where more of it is."""


@dataclass(frozen=True)
class MethodRecord:
    """What the report says about a method.

    Attributes:
        compared: The method, fitted.
        errors: On all test presses.
        over_bayes: Position error over the Bayes limit's on the same presses; None where there is no limit.
        one: Durations of single predictions.
        many: Durations of batches.
        memory_bytes: Serialised size.
        fit_seconds: Duration of fitting.
        best_on: Plots on which no method is better in both error and cost.
    """

    compared: ComparedMethod
    errors: Errors
    over_bayes: float | None
    one: Timing
    many: Timing
    memory_bytes: int
    fit_seconds: float
    best_on: tuple[Plot, ...] = ()

    @property
    def label(self) -> str:
        """Name, and what computes it."""
        return f"{self.compared.name} ({self.compared.computed_by})"

    @property
    def competes(self) -> bool:
        """Whether it answers what the others answer: all presses, from the charges alone."""
        return not self.compared.given_force and self.errors.answered == 1.0

    @property
    def error_mm(self) -> float:
        """Root-mean-square position error, mm; NaN without answers."""
        return float("nan") if self.errors.position_rms_mm is None else self.errors.position_rms_mm

    def cost(self, plot: Plot) -> float:
        """The figure along the plot's axis: us, predictions per second or bytes."""
        memory = float(self.memory_bytes)
        return {"latency": self.one.p50_us, "throughput": self.many.presses_per_s, "memory": memory}[plot]

    def to_dict(self) -> dict[str, Any]:
        """As in `report.json`."""
        return {
            "label": self.label,
            "name": self.compared.name,
            "form": self.compared.computed_by,
            "kind": self.compared.kind,
            "choice": self.compared.choice,
            "force_given": self.compared.given_force,
            "errors": asdict(self.errors),
            "over_bayes": self.over_bayes,
            "p50_us": rounded(self.one.p50_us),
            "p99_us": rounded(self.one.p99_us),
            "per_second": rounded(self.many.presses_per_s),
            "memory_bytes": self.memory_bytes,
            "fit_seconds": rounded(self.fit_seconds),
            "best_on": self.best_on,
        }


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
    return np.asarray(~(lower & strictly).any(axis=1) & np.isfinite(cost) & np.isfinite(error))


def coverage(contact: Array, std: Array, truth: Array, levels: Array) -> Array:
    """Share of truths within the central interval of each nominal level, Gaussian; shape (n_level, 3) for x, y, F."""
    deviation = np.abs(contact - truth) / std
    return np.asarray(np.mean(deviation[None] <= scipy.stats.norm.ppf(0.5 + 0.5 * levels)[:, None, None], axis=1))


WORDS: dict[Plot, str] = {"latency": "single predictions", "throughput": "batches"}
"""The plots that are compared, and their names in a sentence."""


def verdict(records: Sequence[MethodRecord]) -> dict[str, Any]:
    """Which methods beat the released model, in sentences and as labels.

    Args:
        records: Of all methods, the released one first.

    Returns:
        "sentences", and "both": for latency and throughput the labels of methods that are faster and more accurate.
    """
    released, others = records[0], [record for record in records[1:] if record.competes]
    both = {
        plot: [
            record.label
            for record in others
            if record.error_mm < released.error_mm and _speed(record, released, plot) > 1.0
        ]
        for plot in WORDS
    }
    groups = {
        "other methods": [record for record in others if record.compared.kind != "network"],
        "networks that give the contact alone": [record for record in others if record.compared.kind == "network"],
    }
    sentences = [_sentence(plot, released, group, kind) for kind, group in groups.items() if group for plot in WORDS]
    return {"both": both, "sentences": sentences}


def _speed(record: MethodRecord, released: MethodRecord, plot: Plot) -> float:
    """How many times as fast as the released model a method is."""
    return float((released.cost(plot) / record.cost(plot)) ** COST_SIGNS[plot])


def _sentence(plot: Plot, released: MethodRecord, others: Sequence[MethodRecord], kind: str) -> str:
    faster = [record for record in others if _speed(record, released, plot) > 1.0]
    if not faster:
        return f"In {WORDS[plot]}, none of {len(others)} {kind} is faster than the released model."
    nearest = min(faster, key=lambda record: record.error_mm)
    both = sum(record.error_mm < released.error_mm for record in faster)
    error = 100.0 * (nearest.error_mm / released.error_mm - 1.0)
    more = f"{abs(error):.2g} % {'less' if error < 0.0 else 'more'} error"
    return (
        f"In {WORDS[plot]}, {both or 'none'} of {len(others)} {kind} {'are' if both > 1 else 'is'} both faster and "
        f"more accurate than the released model. Of those that are faster the most accurate is {nearest.label} "
        f"({_speed(nearest, released, plot):.3g} times as fast, {more})."
    )
