"""Every method, fitted and measured on the same presses."""

import pickle
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError, TrainingError
from isocharge.common.progress import track
from isocharge.train.baselines.linear_band import BAND
from isocharge.train.baselines.networks import OnnxContact, ReleasedModel
from isocharge.train.baselines.rival import FittingTask, Rival
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report.measures import Errors, MethodRecord, mark_fronts, rounded
from isocharge.train.report.settings import Settings
from isocharge.train.report.timing import Call, durations

TIMED = 64
"""Presses that single predictions go through in turn."""

LONGEST_MS = 1000.0
"""Where a batch takes longer than this, a 64th of it is timed."""


@dataclass(frozen=True)
class Method:
    """A fitted method, and its answers to the test presses.

    Attributes:
        rival: The method.
        contact: Its answers, shape (n, 3).
        fit_seconds: What fitting took.
    """

    rival: Rival
    contact: Array
    fit_seconds: float


def fit_all(rivals: Sequence[Rival], task: FittingTask, test: LabelledPresses) -> tuple[list[Method], dict[str, str]]:
    """Fit every method and let it answer the test presses.

    Args:
        rivals: The methods.
        task: What they are fitted for.
        test: Test presses as they are measured: with noise.

    Returns:
        The methods, and those that few measured presses cannot teach, by name with the reason.
    """
    methods, refused = [], {}
    for rival in track(rivals, "fitting methods"):
        begin = time.perf_counter()
        try:
            fitted = rival.fit(task)
        except (DatasetError, TrainingError) as error:
            if not task.train.measured:
                raise
            refused[rival.name] = str(error)
            continue
        seconds = time.perf_counter() - begin
        contact = fitted.regressor.predict(fitted.inputs(test.charge, test.contact[:, 2]))
        methods.append(Method(fitted, contact, seconds))
    return methods, refused


def records_of(
    methods: Sequence[Method], test: LabelledPresses, settings: Settings, bayes: Array | None = None
) -> list[MethodRecord]:
    """A record for each method, timed when all of them are fitted; errors over the limit where `bayes` has contacts."""
    singles = {method.rival.name: _singles(method.rival, test) for method in methods}
    one = durations(singles, settings.rounds, settings.round_ms)
    batches = {method.rival.name: _batch(method.rival, test, settings.batch) for method in methods}
    calls = {
        name: [partial(method.rival.regressor.predict, batches[name])] for name, method in by_name(methods).items()
    }
    many = durations(calls, rounds=3, round_ms=0.0, least=1)
    per_second = {name: 1e6 * len(batches[name]) / float(np.median(many[name])) for name in many}
    return mark_fronts(
        [_record(method, test.contact, bayes, one[name], per_second[name]) for name, method in by_name(methods).items()]
    )


def by_name(methods: Sequence[Method]) -> dict[str, Method]:
    """The methods by their names."""
    return {method.rival.name: method for method in methods}


def _singles(rival: Rival, test: LabelledPresses) -> list[Call]:
    """One call for each press, ready to be timed; networks by the calls that bind their arrays once."""
    rows, regressor = rival.inputs(test.charge, test.contact[:, 2])[:TIMED], rival.regressor
    if isinstance(regressor, OnnxContact | ReleasedModel):
        return [regressor.single(row) for row in rows]
    return [partial(regressor.predict, row[None]) for row in rows]


def _batch(rival: Rival, test: LabelledPresses, count: int) -> Array:
    """Inputs of a batch: presses over and over; few where a first try says that all would take too long."""
    rows = rival.inputs(test.charge, test.contact[:, 2])
    batch = rows[np.arange(count) % len(rows)]
    few = batch[: max(1, count // 64)]
    (taken,) = durations({rival.name: [partial(rival.regressor.predict, few)]}, 1, 0.0, least=1).values()
    return batch if 1e-3 * float(taken.min()) * count / len(few) <= LONGEST_MS else few


def _record(method: Method, truth: Array, bayes: Array | None, durations_us: Array, per_second: float) -> MethodRecord:
    rival, figures, band = method.rival, Errors.of(method.contact, truth), truth[:, 2] <= BAND
    if rival.given_force:
        figures = replace(figures, force_rms_percent=None, force_median_percent=None)
    medians = np.median(durations_us, axis=1)
    return MethodRecord(
        name=rival.name,
        form=rival.computed_by,
        kind=rival.kind,
        choice=rival.choice,
        force_given=rival.given_force,
        errors=figures,
        errors_in_band=Errors.of(method.contact[band], truth[band]) if band.any() else None,
        over_bayes=None if bayes is None else over_bayes(method.contact, bayes, truth),
        p50_us=float(np.median(durations_us)),
        p95_us=float(np.percentile(durations_us, 95)),
        p50_of_rounds_us=(float(medians.min()), float(medians.max())),
        per_second=per_second,
        memory_bytes=_memory(rival),
        fit_seconds=method.fit_seconds,
    )


def over_bayes(contact: Array, bayes: Array, truth: Array) -> float | None:
    """Position error over the Bayes limit's, whose contacts are those of the first presses."""
    mine, limit = (Errors.of(each[: len(bayes)], truth[: len(bayes)]).position_rms_mm for each in (contact, bayes))
    return None if mine is None or limit is None else rounded(mine / limit)


def _memory(rival: Rival) -> int:
    """Serialised size of what a prediction needs, bytes; of networks the ONNX file."""
    regressor = rival.regressor
    if isinstance(regressor, OnnxContact | ReleasedModel):
        return len(regressor.graph)
    return len(pickle.dumps(regressor, protocol=pickle.HIGHEST_PROTOCOL))
