"""Fits of the compared methods, and measurements of their errors and durations on the same presses."""

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
from isocharge.train.baselines.networks import OnnxContact, StoredModel
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report.case import Settings
from isocharge.train.report.measures import ContactErrors, MethodRecord, round_significant, with_pareto_fronts

SINGLE_PRESSES = 64
"""Number of different presses that are predicted in turn when single predictions are timed."""

MAX_BATCH_SECONDS = 0.1
"""Estimated duration of a batch, s, above which a smaller batch is timed."""

BATCH_REDUCTION = 64
"""Factor by which the size of a batch is divided if its prediction would take longer than `MAX_BATCH_SECONDS`."""


@dataclass(frozen=True)
class FittedMethod:
    """A fitted method with its estimates for the test presses.

    Attributes:
        method: The fitted method.
        estimate: Estimated contacts (x, y, F) of the test presses, shape (n, 3), mm and N. Presses without an estimate
            are NaN.
        fit_seconds: Duration of fitting, s.
    """

    method: ComparedMethod
    estimate: Array
    fit_seconds: float


def fit_all(
    methods: Sequence[ComparedMethod], task: FittingTask, test: LabelledPresses
) -> tuple[list[FittedMethod], dict[str, str]]:
    """Fit all methods, and estimate the contacts of the test presses with each of them.

    If a method cannot be fitted to measured presses, the reason is recorded, and the next method is fitted. If a method
    cannot be fitted to simulated presses, an error is raised.

    Args:
        methods: The methods to fit.
        task: The presses and conditions to which the methods are fitted.
        test: The test presses, with the noise in their charges.

    Returns:
        The fitted methods; and, by the name of the method, the reasons why other methods cannot be fitted to the
        measured presses.

    Raises:
        DatasetError: If a method cannot be fitted to simulated presses.
        TrainingError: If the training of a network on simulated presses fails.
    """
    fitted_methods = []
    failure_reasons = {}
    for method in track(methods, "fitting methods"):
        start = time.perf_counter()
        try:
            fitted_method = method.fit(task)
        except (DatasetError, TrainingError) as error:
            if not task.train.measured:
                raise
            failure_reasons[method.name] = str(error)
            continue
        fit_seconds = time.perf_counter() - start
        test_inputs = _test_inputs(fitted_method, test)
        estimate = fitted_method.regressor.predict(test_inputs)
        fitted_methods.append(FittedMethod(fitted_method, estimate, fit_seconds))
    return fitted_methods, failure_reasons


def measure_methods(
    fitted_methods: Sequence[FittedMethod],
    test: LabelledPresses,
    settings: Settings,
    posterior_mean: Array | None = None,
) -> list[MethodRecord]:
    """Measure the errors, durations and sizes of all methods.

    The methods take turns in short periods of timing. If the speed of the machine changes, the change therefore affects
    all methods in the same way.

    Args:
        fitted_methods: The fitted methods with their estimates.
        test: The test presses, with the noise in their charges.
        settings: Settings of the report: the time for timing and the size of a batch.
        posterior_mean: Posterior means (x, y, F) of the first m test presses, shape (m, 3), mm and N, whose error is
            the Bayes limit. None if the limit was not computed.

    Returns:
        The records of the methods, in the order of `fitted_methods`.
    """
    methods = [fitted_method.method for fitted_method in fitted_methods]
    method_count = len(methods)
    single_contenders = [Contender(method.name, 1, _single_press_call(method, test)) for method in methods]
    batch_contenders = [_batch_contender(method, test, settings.batch) for method in methods]
    total_seconds = 2 * method_count * settings.seconds  # for single presses and for batches
    timings = take_turns([*single_contenders, *batch_contenders], total_seconds)
    # The timings are in the order of the contenders: those of single presses, then those of batches.
    single_timings = timings[:method_count]
    batch_timings = timings[method_count:]

    records = []
    for fitted_method, single_timing, batch_timing in zip(fitted_methods, single_timings, batch_timings, strict=True):
        records.append(_method_record(fitted_method, test.contact, posterior_mean, single_timing, batch_timing))
    return with_pareto_fronts(records)


def _test_inputs(method: ComparedMethod, test: LabelledPresses) -> Array:
    """Return the inputs of a method, shape (n, n_input): charges of the test presses, and forces if needed."""
    return method.inputs(test.charge, test.contact[:, 2])


def _single_press_call(method: ComparedMethod, test: LabelledPresses) -> Callable[[], object]:
    """Return a function without arguments that predicts one press.

    Each call predicts the next of the first `SINGLE_PRESSES` presses. After the last of these presses, the first press
    follows again. For ONNX networks, the arrays for the input and the outputs are given to the runtime before the
    timing, as in `Predictor`.

    Args:
        method: Fitted method.
        test: Presses that are predicted one after the other.
    """
    inputs = _test_inputs(method, test)[:SINGLE_PRESSES]
    regressor = method.regressor
    calls: list[Callable[[], object]]
    if isinstance(regressor, OnnxContact | StoredModel):
        calls = [regressor.single_press_function(press_input) for press_input in inputs]
    else:
        # `predict` expects a batch, so each press becomes a batch of one press, shape (1, n_input).
        calls = [partial(regressor.predict, press_input[None]) for press_input in inputs]
    cyclic_calls = cycle(calls)
    return lambda: next(cyclic_calls)()  # takes the function of the next press, and calls it


def _batch_contender(method: ComparedMethod, test: LabelledPresses, batch_size: int) -> Contender:
    """Return the prediction of a batch that will be timed in order to measure the throughput of a method.

    The duration of a small batch is measured first. If the whole batch would take longer than `MAX_BATCH_SECONDS`, the
    returned prediction is that of the small batch.

    Args:
        method: The fitted method.
        test: The test presses; they are repeated if the batch is larger.
        batch_size: Number of presses in the whole batch.
    """
    inputs = _test_inputs(method, test)
    repeated_rows = np.arange(batch_size) % len(inputs)
    batch = inputs[repeated_rows]
    small_batch = batch[: max(1, batch_size // BATCH_REDUCTION)]

    start = time.perf_counter()
    method.regressor.predict(small_batch)
    small_batch_seconds = time.perf_counter() - start
    estimated_seconds = small_batch_seconds * batch_size / len(small_batch)
    timed_batch = small_batch if estimated_seconds > MAX_BATCH_SECONDS else batch
    return Contender(method.name, len(timed_batch), partial(method.regressor.predict, timed_batch))


def _method_record(
    fitted_method: FittedMethod, truth: Array, posterior_mean: Array | None, single_timing: Timing, batch_timing: Timing
) -> MethodRecord:
    """Return the record of a method with its errors, durations and memory.

    The record of a method that is given the true force contains no force error.

    Args:
        fitted_method: Fitted method and its estimates of the contacts.
        truth: True contacts, shape (n, 3), mm and N.
        posterior_mean: Posterior means (x, y, F) of the first m presses, shape (m, 3), mm and N, for the ratio of the
            error to the Bayes limit. None if the means were not computed.
        single_timing: Durations of predictions of one press.
        batch_timing: Durations of predictions of a batch of presses.
    """
    errors = ContactErrors.compute(fitted_method.estimate, truth)
    if fitted_method.method.given_force:
        errors = replace(errors, force_rms_percent=None, force_median_percent=None)
    error_ratio = None
    if posterior_mean is not None:
        error_ratio = bayes_ratio(fitted_method.estimate, posterior_mean, truth)
    return MethodRecord(
        method=fitted_method.method,
        errors=errors,
        bayes_ratio=error_ratio,
        single_timing=single_timing,
        batch_timing=batch_timing,
        memory_bytes=_serialised_bytes(fitted_method.method),
        fit_seconds=fitted_method.fit_seconds,
    )


def bayes_ratio(estimate: Array, posterior_mean: Array, truth: Array) -> float | None:
    """Compute the position error of a method divided by the Bayes limit on the same presses.

    Args:
        estimate: Contacts (x, y, F) estimated by the method, shape (n, 3), mm and N.
        posterior_mean: Posterior means of the first m presses, shape (m, 3), mm and N.
        truth: True contacts, shape (n, 3), mm and N.

    Returns:
        The ratio of the root-mean-square position errors over the first m presses; None if there is no estimate.
    """
    count = len(posterior_mean)
    method_error = ContactErrors.compute(estimate[:count], truth[:count]).position_rms_mm
    bayes_error = ContactErrors.compute(posterior_mean, truth[:count]).position_rms_mm
    if method_error is None or bayes_error is None:
        return None
    return round_significant(method_error / bayes_error)


def _serialised_bytes(method: ComparedMethod) -> int:
    """Return the size of the ONNX file of a network, or the size of the pickle of another regressor, in bytes."""
    regressor = method.regressor
    if isinstance(regressor, OnnxContact | StoredModel):
        return len(regressor.graph)
    return len(pickle.dumps(regressor, protocol=pickle.HIGHEST_PROTOCOL))
