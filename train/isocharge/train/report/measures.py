"""Measurement of the errors and the durations of methods on the same presses."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import cycle

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.progress import track
from isocharge.serve.benchmark import Contender, take_turns
from isocharge.train.data.contact_errors import ContactErrorStatistics
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report.methods import Method

SINGLE_PRESSES = 64
"""Number of different presses that are predicted in turn when single predictions are timed."""

MAX_BATCH_SECONDS = 0.1
"""Estimated duration of a batch, s, above which a smaller batch is timed."""


@dataclass(frozen=True)
class MethodRecord:
    """Results of the report for one method. The names of the attributes are keys of `report.json`.

    Attributes:
        name: Name of the method.
        library: Library that computes the estimates.
        answered: Fraction of the presses for which the method returned an estimate, 0 to 1.
        errors: Statistics of the errors on these presses, by the names of `ContactErrorStatistics`; empty if there are
            no such presses.
        single_press_us: Median duration of the estimate for one press, us.
        presses_per_s: Number of presses per second in batches.
    """

    name: str
    library: str
    answered: float
    errors: dict[str, float]
    single_press_us: float
    presses_per_s: float


def measure_methods(
    methods: Sequence[Method], presses: LabelledPresses, batch_size: int, seconds: float
) -> list[MethodRecord]:
    """Measure the errors and the durations of all methods.

    The methods take turns in short periods of timing. If the speed of the machine changes, the change therefore affects
    all methods in the same way.

    Args:
        methods: The fitted methods.
        presses: The test presses, with the noise in their charges.
        batch_size: Number of presses in a batch.
        seconds: Duration for which single predictions of a method are timed, s. Its predictions of batches are timed
            for the same duration.

    Returns:
        The records of the methods, in the order of `methods`.
    """
    estimates = [method.estimate(presses.charge) for method in track(methods, "estimating contacts")]
    single_contenders = [_single_contender(method, presses.charge) for method in methods]
    batch_contenders = [_batch_contender(method, presses.charge, batch_size) for method in methods]
    timings = take_turns([*single_contenders, *batch_contenders], 2 * len(methods) * seconds)
    # The timings are in the order of the contenders: those of single presses, then those of batches.
    single_timings = timings[: len(methods)]
    batch_timings = timings[len(methods) :]

    records = []
    for method, estimate, single, batch in zip(methods, estimates, single_timings, batch_timings, strict=True):
        answered, errors = contact_errors(estimate, presses.contact)
        record = MethodRecord(
            name=method.name,
            library=method.library,
            answered=answered,
            errors=errors,
            single_press_us=round_significant(single.p50_us),
            presses_per_s=round_significant(batch.presses_per_s),
        )
        records.append(record)
    return records


def contact_errors(estimate: Array, truth: Array) -> tuple[float, dict[str, float]]:
    """Compute the statistics of the errors of estimated contacts.

    Args:
        estimate: Estimated contacts (x, y, F), shape (n, 3), mm and N. Presses without an estimate are NaN.
        truth: True contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        The fraction of the presses with an estimate; and the statistics of the errors on these presses, by the names of
        `ContactErrorStatistics`. Without any estimate, there are no statistics.
    """
    has_estimate = np.isfinite(estimate).all(axis=1)
    if not has_estimate.any():
        return 0.0, {}
    statistics = ContactErrorStatistics.of(estimate[has_estimate], truth[has_estimate])
    errors = {name: round_significant(value) for name, value in asdict(statistics).items()}
    return round_significant(float(np.mean(has_estimate))), errors


def round_significant(value: float) -> float:
    """Round a number to four significant digits."""
    return float(f"{value:.4g}")


def _single_contender(method: Method, charge: Array) -> Contender:
    """Return the estimate for one press, which is timed. Each call uses the next of the first `SINGLE_PRESSES` presses.

    Args:
        method: The fitted method.
        charge: Charges of the test presses, shape (n, n_electrode), pC.
    """
    calls = cycle([method.call_for(press_charge) for press_charge in charge[:SINGLE_PRESSES]])
    return Contender(method.name, 1, lambda: next(calls)())


def _batch_contender(method: Method, charge: Array, batch_size: int) -> Contender:
    """Return the estimates for a batch of presses, which are timed.

    If the estimates for a whole batch would take longer than `MAX_BATCH_SECONDS`, a smaller batch is timed.

    Args:
        method: The fitted method.
        charge: Charges of the test presses, shape (n, n_electrode), pC. They are repeated if the batch is larger.
        batch_size: Number of presses in a whole batch.
    """
    batch = np.resize(charge, (batch_size, charge.shape[1]))
    small_batch = batch[:SINGLE_PRESSES]
    start = time.perf_counter()
    method.estimate(small_batch)
    estimated_seconds = (time.perf_counter() - start) * batch_size / len(small_batch)
    timed_batch = small_batch if estimated_seconds > MAX_BATCH_SECONDS else batch
    return Contender(method.name, len(timed_batch), partial(method.estimate, timed_batch))
