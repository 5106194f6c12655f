"""Every method, fitted and measured on the same presses."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError, TrainingError
from isocharge.common.progress import Announce
from isocharge.simulate import Dataset, ForwardMap
from isocharge.train.baselines import (
    Estimator,
    Fitted,
    FittingTask,
    GaussianProcess,
    GaussNewton,
    GradientBoosting,
    InterpolatedTable,
    LinearBand,
    NearestEntry,
    NearestNeighbours,
    Network,
    PolynomialRidge,
    ReleasedModel,
    Triangulate,
)
from isocharge.train.baselines.linear_band import BAND_N
from isocharge.train.data.measured import is_measured
from isocharge.train.data.noise import noisy_charges
from isocharge.train.data.presses import LabelledPresses, presses_of, split_by_position
from isocharge.train.report.bench import EvaluationScene
from isocharge.train.report.measures import Errors, MethodRecord, mark_fronts, rounded
from isocharge.train.report.settings import Settings
from isocharge.train.report.timing import latencies, throughputs

TIMED = 64
"""Presses that single predictions go through in turn."""

TEST_NOISE = 4242
"""Seed of the noise on the test presses, relative to the bench's."""


FEWEST_LEARNT = 30
"""Measured presses that methods are fitted to at least, once the test presses are held out."""


@dataclass(frozen=True)
class Method:
    """A method in one form, and its answers to the test presses.

    Attributes:
        fitted: The method.
        kind: "paper", "learnt", "fitted map" or "network".
        contact: Its answers, shape (n, 3).
        fit_seconds: What fitting all forms took.
        p50_us: Median duration of one prediction, us.
        p95_us: 95th percentile.
        rounds_us: Smallest and largest median of a round.
        per_second: Predictions per second in a batch.
        memory: Bytes.
    """

    fitted: Fitted
    kind: str
    contact: Array
    fit_seconds: float
    p50_us: float = np.nan
    p95_us: float = np.nan
    rounds_us: tuple[float, float] = (np.nan, np.nan)
    per_second: float = np.nan
    memory: int = 0

    @property
    def label(self) -> str:
        """Name and form."""
        return f"{self.fitted.name} ({self.fitted.form})"


@dataclass(frozen=True)
class EvaluationPresses:
    """Test presses.

    Attributes:
        presses: Clean.
        charge_pC: With noise, shape (n, n_electrode).
    """

    presses: LabelledPresses
    charge_pC: Array

    @classmethod
    def of(cls, bench: EvaluationScene, presses: LabelledPresses) -> "EvaluationPresses":
        """With one draw of the bench's noise."""
        return cls(presses, noisy_charges(presses, bench.noise, bench.seed + TEST_NOISE))

    @classmethod
    def measured(cls, presses: LabelledPresses) -> "EvaluationPresses":
        """Measured presses, as they are."""
        return cls(presses, presses.charge_pC)


def task_of(dataset: Dataset, bench: EvaluationScene, settings: Settings) -> FittingTask:
    """What the methods are fitted for."""
    measured = is_measured(dataset)
    presses = presses_of(dataset, FEWEST_LEARNT) if measured else presses_of(dataset)
    train, validation = split_by_position(presses, settings.hold_out, settings.seed)
    return FittingTask(
        train, validation, bench.domain, bench.noise, settings.seed, quick=settings.quick, measured=measured
    )


def all_methods(dataset: Dataset, forward_map: ForwardMap | None, settings: Settings) -> list[tuple[str, Estimator]]:
    """Every method with its kind; without a forward map those that need none."""
    networks = [Network(dataset, hidden, settings.steps, settings.hold_out) for hidden in settings.sizes]
    simulated: list[tuple[str, Estimator]] = [("paper", Triangulate(forward_map))] if forward_map else []
    return [
        *simulated,
        ("paper", LinearBand()),
        ("paper", NearestEntry()),
        ("paper", InterpolatedTable()),
        ("learnt", NearestNeighbours()),
        ("learnt", PolynomialRidge()),
        ("learnt", GradientBoosting()),
        ("learnt", GaussianProcess()),
        ("fitted map", GaussNewton()),
        *(("network", network) for network in networks),
    ]


def fit_all(
    estimators: list[tuple[str, Estimator]],
    given: Sequence[ReleasedModel],
    task: FittingTask,
    test: EvaluationPresses,
    progress: Announce,
) -> list[Method]:
    """Fit every method and let all of its forms answer the test presses; models that are given come first."""
    forms_given: list[Fitted] = [form for model in given for form in (model, model.contact_only())]
    methods = [Method(form, "network", form.predict(test.charge_pC), 0.0) for form in forms_given]
    for kind, estimator in estimators:
        progress(f"fitting: {estimator.name}")
        begin = time.perf_counter()
        forms = estimator.fit(task)
        seconds = time.perf_counter() - begin
        methods += [Method(form, kind, answers(form, test), seconds) for form in forms]
    return methods


def fit_those_that_can(
    estimators: list[tuple[str, Estimator]],
    given: Sequence[ReleasedModel],
    task: FittingTask,
    test: EvaluationPresses,
    progress: Announce,
) -> tuple[list[Method], dict[str, str]]:
    """As `fit_all`, of few measured presses: methods that they cannot teach are left out, by name with the reason."""
    methods, refused = fit_all([], given, task, test, progress), {}
    for kind, estimator in estimators:
        try:
            methods += fit_all([(kind, estimator)], (), task, test, progress)
        except (DatasetError, TrainingError) as error:
            refused[estimator.name] = str(error)
    return methods, refused


def answers(fitted: Fitted, test: EvaluationPresses) -> Array:
    """Contacts of the noisy test presses."""
    return fitted.with_known_force(test.presses.contact[:, 2]).predict(test.charge_pC)


def timed(methods: list[Method], test: EvaluationPresses, settings: Settings, progress: Announce) -> list[Method]:
    """The same methods with their times and sizes, taken when all of them are fitted."""
    force, charge = test.presses.contact[:, 2], test.charge_pC
    singles = {method.label: _singles(method.fitted, force[:TIMED], charge[:TIMED]) for method in methods}
    durations = latencies(
        singles, settings.rounds, settings.round_ms, lambda done, total: progress(f"timing: round {done} of {total}")
    )
    many = {method.label: _batched(method.fitted, force) for method in methods}
    batch = np.resize(charge, (settings.batch, charge.shape[1]))
    per_second = throughputs(
        many, batch, 3, 1.0, lambda done, total: progress(f"timing batches: round {done} of {total}")
    )
    return [_with_times(method, durations[method.label], per_second[method.label]) for method in methods]


def _singles(fitted: Fitted, force: Array, charge: Array) -> list[Callable[[], object]]:
    """One call for each press, ready to be timed."""
    return [fitted.with_known_force(force[i : i + 1]).one(charge[i]) for i in range(len(force))]


def _batched(fitted: Fitted, force: Array) -> Callable[[Array], object]:
    return lambda charge: fitted.with_known_force(np.resize(force, len(charge))).predict(charge)


def _with_times(method: Method, durations: Array, per_second: float) -> Method:
    medians = np.median(durations, axis=1)
    return replace(
        method,
        p50_us=float(np.percentile(durations, 50)),
        p95_us=float(np.percentile(durations, 95)),
        rounds_us=(float(medians.min()), float(medians.max())),
        per_second=per_second,
        memory=method.fitted.memory,
    )


def records_of(methods: list[Method], test: EvaluationPresses, bayes: Array | None) -> list[MethodRecord]:
    """One record for each method; errors over the limit where `bayes` gives its contacts."""
    truth = test.presses.contact
    limit = Errors.of(bayes, truth[: len(bayes)]) if bayes is not None else None
    return mark_fronts([_record(method, truth, limit, 0 if bayes is None else len(bayes)) for method in methods])


def _record(method: Method, truth: Array, limit: Errors | None, limited: int) -> MethodRecord:
    figures, band = Errors.of(method.contact, truth), truth[:, 2] <= BAND_N
    if method.fitted.given_force:
        figures = replace(figures, force_rms_percent=None, force_median_percent=None)
    return MethodRecord(
        name=method.fitted.name,
        form=method.fitted.form,
        kind=method.kind,
        choice=method.fitted.choice,
        force_given=method.fitted.given_force,
        errors=figures,
        errors_in_band=Errors.of(method.contact[band], truth[band]) if band.any() else None,
        over_bayes=_ratio(Errors.of(method.contact[:limited], truth[:limited]), limit) if limit else None,
        p50_us=method.p50_us,
        p95_us=method.p95_us,
        p50_of_rounds_us=method.rounds_us,
        per_second=method.per_second,
        memory_bytes=method.memory,
        fit_seconds=method.fit_seconds,
    )


def _ratio(errors: Errors, limit: Errors) -> float | None:
    if errors.position_rms_mm is None or limit.position_rms_mm is None:
        return None
    return rounded(errors.position_rms_mm / limit.position_rms_mm)
