"""Every method, fitted and measured on the same presses."""

import pickle
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError, TrainingError
from isocharge.common.progress import track
from isocharge.serve.benchmark import Contender, Timing, take_turns
from isocharge.train.baselines.compared_methods import ComparedMethod, FittingTask
from isocharge.train.baselines.networks import OnnxContact, ReleasedModel
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report.case import Settings
from isocharge.train.report.measures import Errors, MethodRecord, mark_fronts, rounded

TIMED = 64
"""Presses that single predictions go through in turn."""

LONGEST_S = 0.1
"""Where a batch takes longer than this, a 64th of it is timed, s."""


@dataclass(frozen=True)
class Method:
    """A fitted method, and its answers to the test presses.

    Attributes:
        compared: The method.
        contact: Its answers, shape (n, 3).
        fit_seconds: What fitting took.
    """

    compared: ComparedMethod
    contact: Array
    fit_seconds: float


def fit_all(
    compared_methods: Sequence[ComparedMethod], task: FittingTask, test: LabelledPresses
) -> tuple[list[Method], dict[str, str]]:
    """Fit every method and let it answer the test presses.

    Args:
        compared_methods: The methods.
        task: What they are fitted for.
        test: Test presses as they are measured: with noise.

    Returns:
        The methods, and those that few measured presses cannot teach, by name with the reason.
    """
    methods, refused = [], {}
    for compared in track(compared_methods, "fitting methods"):
        begin = time.perf_counter()
        try:
            fitted = compared.fit(task)
        except (DatasetError, TrainingError) as error:
            if not task.train.measured:
                raise
            refused[compared.name] = str(error)
            continue
        seconds = time.perf_counter() - begin
        contact = fitted.regressor.predict(fitted.inputs(test.charge, test.contact[:, 2]))
        methods.append(Method(fitted, contact, seconds))
    return methods, refused


def records_of(
    methods: Sequence[Method], test: LabelledPresses, settings: Settings, bayes: Array | None = None
) -> list[MethodRecord]:
    """A record for each method, timed when all of them are fitted; errors over the limit where `bayes` has contacts."""
    compared_methods = [method.compared for method in methods]
    singles = [Contender(compared.name, 1, _single(compared, test)) for compared in compared_methods]
    batches = [_batch(compared, test, settings.batch) for compared in compared_methods]
    timings = take_turns([*singles, *batches], settings.seconds * 2 * len(methods))
    per_method = zip(methods, timings[: len(methods)], timings[len(methods) :], strict=True)
    return mark_fronts([_record(method, test.contact, bayes, *timing) for method, *timing in per_method])


def _single(compared: ComparedMethod, test: LabelledPresses) -> Callable[[], object]:
    """A call for one press, each time another; networks by the calls that bind their arrays once."""
    rows, regressor = compared.inputs(test.charge, test.contact[:, 2])[:TIMED], compared.regressor
    if isinstance(regressor, OnnxContact | ReleasedModel):
        calls = cycle([regressor.single(row) for row in rows])
    else:
        calls = cycle([partial(regressor.predict, row[None]) for row in rows])
    return lambda: next(calls)()


def _batch(compared: ComparedMethod, test: LabelledPresses, count: int) -> Contender:
    """A call for a batch, presses over and over; for few where a first try says that all would take too long."""
    rows = compared.inputs(test.charge, test.contact[:, 2])
    batch = rows[np.arange(count) % len(rows)]
    few = batch[: max(1, count // 64)]
    begin = time.perf_counter()
    compared.regressor.predict(few)
    if (time.perf_counter() - begin) * count / len(few) > LONGEST_S:
        batch = few
    return Contender(compared.name, len(batch), partial(compared.regressor.predict, batch))


def _record(method: Method, truth: Array, bayes: Array | None, one: Timing, many: Timing) -> MethodRecord:
    compared, figures = method.compared, Errors.of(method.contact, truth)
    if compared.given_force:
        figures = replace(figures, force_rms_percent=None, force_median_percent=None)
    over_limit = None if bayes is None else over_bayes(method.contact, bayes, truth)
    return MethodRecord(compared, figures, over_limit, one, many, _memory(compared), method.fit_seconds)


def over_bayes(contact: Array, bayes: Array, truth: Array) -> float | None:
    """Position error over the Bayes limit's, whose contacts are those of the first presses."""
    mine, limit = (Errors.of(each[: len(bayes)], truth[: len(bayes)]).position_rms_mm for each in (contact, bayes))
    return None if mine is None or limit is None else rounded(mine / limit)


def _memory(compared: ComparedMethod) -> int:
    """Serialised size of what a prediction needs, bytes; of networks the ONNX file."""
    regressor = compared.regressor
    if isinstance(regressor, OnnxContact | ReleasedModel):
        return len(regressor.graph)
    return len(pickle.dumps(regressor, protocol=pickle.HIGHEST_PROTOCOL))
