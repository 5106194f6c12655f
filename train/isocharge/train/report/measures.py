"""Figures of merit of the compared methods: errors, costs, Pareto fronts, and a comparison with the evaluated model.

Each method has one error, which is the root-mean-square position error. Each method has three costs: the time of one
prediction, the throughput of batches, and the memory. A method is on the Pareto front of a cost unless another method
is at least as good in both error and cost, and better in one of them.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy  # scipy imports its submodules at their first use

from isocharge.common.arrays import Array, Booleans
from isocharge.common.contact_errors import ContactErrorStatistics
from isocharge.serve.benchmark import Timing
from isocharge.train.baselines.compared_methods import ComparedMethod


def round_significant(value: float | None, digits: int = 4) -> float | None:
    """Round a number to significant digits for the report.

    Args:
        value: The number, or None if there is none.
        digits: Number of significant digits.

    Returns:
        The rounded number; None if `value` is None, NaN or infinite, because JSON has no such numbers.
    """
    if value is None or not np.isfinite(value):
        return None
    return float(f"{value:.{digits}g}")


@dataclass(frozen=True)
class ContactErrors:
    """Errors of estimated contacts over the presses for which a method returned an estimate.

    All errors are None if the method returned no estimate for any press. The names of the attributes are keys of
    `report.json`.

    Attributes:
        position_rms_mm: Root mean square of the distance from the true position, mm.
        position_median_mm: Median of the distance from the true position, mm.
        position_p95_mm: 95th percentile of the distance from the true position, mm.
        force_rms_percent: Root mean square of the relative error of the force, %.
        force_median_percent: Median of the absolute relative error of the force, %.
        answered: Fraction of the presses for which the method returned an estimate, 0 to 1.
    """

    position_rms_mm: float | None
    position_median_mm: float | None
    position_p95_mm: float | None
    force_rms_percent: float | None
    force_median_percent: float | None
    answered: float

    @classmethod
    def compute(cls, estimate: Array, truth: Array) -> "ContactErrors":
        """Compute the errors of estimated contacts.

        Args:
            estimate: Estimated contacts (x, y, F), shape (n, 3), mm and N. Presses without an estimate are NaN.
            truth: True contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            The errors, rounded to four significant digits.
        """
        has_position = np.isfinite(estimate[:, :2]).all(axis=1)
        if not has_position.any():
            return cls(
                position_rms_mm=None,
                position_median_mm=None,
                position_p95_mm=None,
                force_rms_percent=None,
                force_median_percent=None,
                answered=0.0,
            )
        statistics = ContactErrorStatistics.of(estimate[has_position], truth[has_position])
        return cls(
            position_rms_mm=round_significant(statistics.position_rms_mm),
            position_median_mm=round_significant(statistics.position_median_mm),
            position_p95_mm=round_significant(statistics.position_p95_mm),
            force_rms_percent=round_significant(statistics.force_rms_percent),
            force_median_percent=round_significant(statistics.force_median_percent),
            answered=float(f"{np.mean(has_position):.4g}"),
        )


Cost = Literal["latency", "throughput", "memory"]
"""Name of a cost of a method. The report has a plot of the error against each cost."""

COST_SIGNS: dict[Cost, float] = {"latency": 1.0, "throughput": -1.0, "memory": 1.0}
"""Sign of each cost: 1 if a smaller value is better, -1 if a larger value is better."""


@dataclass(frozen=True)
class MethodRecord:
    """Results of the report for one method.

    Attributes:
        method: The fitted method.
        errors: Errors of the method on all test presses.
        bayes_ratio: Position error of the method, divided by the Bayes limit on the same presses; None if the Bayes
            limit was not computed.
        single_timing: Durations of predictions of one press.
        batch_timing: Durations of predictions of a batch of presses.
        memory_bytes: Size of the serialised method, bytes.
        fit_seconds: Duration of fitting, s.
        pareto_costs: Costs for which the method is on the Pareto front.
    """

    method: ComparedMethod
    errors: ContactErrors
    bayes_ratio: float | None
    single_timing: Timing
    batch_timing: Timing
    memory_bytes: int
    fit_seconds: float
    pareto_costs: tuple[Cost, ...] = ()

    @property
    def label(self) -> str:
        """Name of the method, and in brackets the library that computes it."""
        return f"{self.method.name} ({self.method.computed_by})"

    @property
    def is_comparable(self) -> bool:
        """Whether the method estimates the contacts of all presses and does not need the true force."""
        return not self.method.given_force and self.errors.answered == 1.0

    @property
    def error_mm(self) -> float:
        """Root-mean-square position error, mm; NaN if the method returned no estimate."""
        if self.errors.position_rms_mm is None:
            return float("nan")
        return self.errors.position_rms_mm

    def cost(self, cost: Cost) -> float:
        """Return the value of a cost.

        Args:
            cost: Name of the cost.

        Returns:
            The median duration of one prediction in us, the number of predictions per second in batches, or the memory
            in bytes.
        """
        if cost == "latency":
            return self.single_timing.p50_us
        if cost == "throughput":
            return self.batch_timing.presses_per_s
        return float(self.memory_bytes)

    def to_dict(self) -> dict[str, Any]:
        """Return the results as `report.json` contains them."""
        return {
            "label": self.label,
            "name": self.method.name,
            "form": self.method.computed_by,
            "kind": self.method.kind,
            "choice": self.method.choice,
            "force_given": self.method.given_force,
            "errors": asdict(self.errors),
            "over_bayes": self.bayes_ratio,
            "p50_us": round_significant(self.single_timing.p50_us),
            "p99_us": round_significant(self.single_timing.p99_us),
            "per_second": round_significant(self.batch_timing.presses_per_s),
            "memory_bytes": self.memory_bytes,
            "fit_seconds": round_significant(self.fit_seconds),
            "best_on": self.pareto_costs,
        }


def with_pareto_fronts(records: Sequence[MethodRecord]) -> list[MethodRecord]:
    """Determine the Pareto front of each cost, and return the records with the attribute `pareto_costs`.

    The documentation of `pareto_front` defines the front. Methods that are not comparable are on no front, and they are
    ignored when the fronts are determined.

    Args:
        records: Records of all methods.
    """
    # An error of NaN keeps a method off every front.
    error_mm = np.array([record.error_mm if record.is_comparable else np.nan for record in records])
    front_by_cost = {}
    for cost, sign in COST_SIGNS.items():
        signed_cost = sign * np.array([record.cost(cost) for record in records])  # smaller is better
        front_by_cost[cost] = pareto_front(signed_cost, error_mm)  # booleans, shape (n_record,)

    completed_records = []
    for index, record in enumerate(records):
        pareto_costs = tuple(cost for cost, is_on_front in front_by_cost.items() if is_on_front[index])
        completed_records.append(replace(record, pareto_costs=pareto_costs))
    return completed_records


def pareto_front(cost: Array, error: Array) -> Booleans:
    """Determine which methods are on the Pareto front of cost and error.

    A method is on the front unless another method is at least as good in both cost and error, and better in one of
    them.

    Args:
        cost: Costs of the methods, shape (n,); smaller is better.
        error: Errors of the methods, shape (n,). A method with the error NaN is not on the front.

    Returns:
        Whether each method is on the front, shape (n,).
    """
    # The entry (i, j) of each matrix, shape (n, n), compares method j with method i.
    is_no_worse = (cost[None] <= cost[:, None]) & (error[None] <= error[:, None])
    is_better_in_one = (cost[None] < cost[:, None]) | (error[None] < error[:, None])
    is_dominated = (is_no_worse & is_better_in_one).any(axis=1)
    return np.asarray(~is_dominated & np.isfinite(cost) & np.isfinite(error))


def interval_coverage(estimate: Array, std: Array, truth: Array, levels: Array) -> Array:
    """Compute the fraction of true values that lie in the central intervals of normal distributions.

    Args:
        estimate: Estimated contacts (x, y, F), shape (n, 3), mm and N: the means of the distribution.
        std: Standard deviations of the estimates, shape (n, 3), mm and N.
        truth: True contacts (x, y, F), shape (n, 3), mm and N.
        levels: Nominal probabilities of the intervals, shape (n_level,), 0 to 1.

    Returns:
        Fractions for x, y and F, shape (n_level, 3). They equal the levels if the standard deviations are correct.
    """
    standardised_error = np.abs(estimate - truth) / std
    half_width = scipy.stats.norm.ppf(0.5 + 0.5 * levels)  # in standard deviations, shape (n_level,)
    is_inside = standardised_error[None] <= half_width[:, None, None]  # shape (n_level, n, 3)
    return np.asarray(np.mean(is_inside, axis=1))


SPEED_NAMES: dict[Cost, str] = {"latency": "single predictions", "throughput": "batches"}
"""Names of the two costs that are speeds in the sentences of the report, by the cost."""


def compare_with_evaluated_model(records: Sequence[MethodRecord]) -> dict[str, Any]:
    """Compare all comparable methods with the evaluated model in speed and error.

    Args:
        records: Records of all methods; the first one is the record of the evaluated model.

    Returns:
        The value of "verdict" in `report.json`, which has two entries. The entry "sentences" is a list of sentences
        about the methods and the networks other than the evaluated model. The entry "both" contains a list of labels
        for "latency" and a list of labels for "throughput". Each list contains the methods that are both faster and
        more accurate than the evaluated model.
    """
    evaluated_record = records[0]
    comparable = [record for record in records[1:] if record.is_comparable]
    faster_and_more_accurate = {}
    for cost in SPEED_NAMES:
        faster = _faster_records(comparable, evaluated_record, cost)
        labels = [record.label for record in faster if record.error_mm < evaluated_record.error_mm]
        faster_and_more_accurate[cost] = labels

    other_methods = [record for record in comparable if record.method.kind != "network"]
    networks = [record for record in comparable if record.method.kind == "network"]
    sentences = []
    for group_name, group in (("other methods", other_methods), ("other networks", networks)):
        if group:
            sentences += [_comparison_sentence(cost, evaluated_record, group, group_name) for cost in SPEED_NAMES]
    return {"both": faster_and_more_accurate, "sentences": sentences}


def _speed_ratio(record: MethodRecord, evaluated_record: MethodRecord, cost: Cost) -> float:
    """Return the speed of a method divided by the speed of the evaluated model.

    Args:
        record: Record of the method.
        evaluated_record: Record of the evaluated model.
        cost: Kind of speed: "latency" or "throughput".
    """
    cost_ratio = evaluated_record.cost(cost) / record.cost(cost)
    # A latency is a duration, so its inverse is the speed. The throughput is a speed itself. Its sign of -1 inverts the
    # ratio.
    return float(cost_ratio ** COST_SIGNS[cost])


def _faster_records(records: Sequence[MethodRecord], evaluated_record: MethodRecord, cost: Cost) -> list[MethodRecord]:
    """Return the records of the methods that are faster than the evaluated model."""
    return [record for record in records if _speed_ratio(record, evaluated_record, cost) > 1.0]


def _comparison_sentence(
    cost: Cost, evaluated_record: MethodRecord, group: Sequence[MethodRecord], group_name: str
) -> str:
    """Return sentences that compare the methods of a group with the evaluated model.

    The first sentence states how many methods are both faster and more accurate than the evaluated model. The second
    sentence describes the most accurate of the faster methods. If no method is faster, a single sentence states this.

    Args:
        cost: The kind of speed: "latency" or "throughput".
        evaluated_record: Record of the evaluated model.
        group: Records of the methods of the group; at least one.
        group_name: Name of the group in the sentence, in the plural.
    """
    faster = _faster_records(group, evaluated_record, cost)
    if not faster:
        return f"In {SPEED_NAMES[cost]}, none of {len(group)} {group_name} is faster than the evaluated model."
    n_more_accurate = sum(record.error_mm < evaluated_record.error_mm for record in faster)
    verb = "are" if n_more_accurate > 1 else "is"

    most_accurate = min(faster, key=lambda record: record.error_mm)
    speed_ratio = _speed_ratio(most_accurate, evaluated_record, cost)
    error_change_percent = 100.0 * (most_accurate.error_mm / evaluated_record.error_mm - 1.0)
    comparative = "less" if error_change_percent < 0.0 else "more"
    return (
        f"In {SPEED_NAMES[cost]}, {n_more_accurate or 'none'} of {len(group)} {group_name} {verb} both faster and "
        f"more accurate than the evaluated model. The most accurate of the faster ones is {most_accurate.label}: it is "
        f"{speed_ratio:.3g} times as fast as the evaluated model, with {abs(error_change_percent):.2g} % {comparative} "
        "error."
    )
