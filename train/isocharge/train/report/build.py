"""The report: measure everything, write the record, the pictures and the page; whole or not at all."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ModelError
from isocharge.common.files import new_folder, write_whole
from isocharge.common.progress import StageProgress
from isocharge.serve import ModelMetadata, Predictor
from isocharge.serve.benchmark import machine
from isocharge.simulate import Dataset, Samples, SolveSettings, sensor_to_dict
from isocharge.train.baselines import (
    Fitted,
    FittingTask,
    ReleasedModel,
    boosting,
    gauss_newton,
    linear_band,
    polynomial,
    table,
)
from isocharge.train.data.domain import inner_radius
from isocharge.train.data.measured import check_enough, held_out, is_measured
from isocharge.train.data.presses import LabelledPresses, domain_of
from isocharge.train.report import effects, maps, pictures
from isocharge.train.report.bench import EvaluationScene, press_on
from isocharge.train.report.limits import BAYES, CRAMER_RAO, ErrorBounds, error_bounds
from isocharge.train.report.measures import MethodRecord, Plot, rounded
from isocharge.train.report.methods import (
    EvaluationPresses,
    Method,
    all_methods,
    fit_all,
    fit_those_that_can,
    records_of,
    task_of,
    timed,
)
from isocharge.train.report.page import page
from isocharge.train.report.settings import Settings
from isocharge.train.report.speed import AXES, speed_plot
from isocharge.train.report.timing import one_thread
from isocharge.train.report.verdict import verdict

FORMAT_VERSION = 1

MEASURED_WITH = ("isocharge", "numpy", "scipy", "scikit-learn", "torch", "onnxruntime")
"""Packages whose versions belong to the figures."""

COMPARED = (gauss_newton.NAME, polynomial.NAME, table.INTERPOLATED, boosting.NAME, linear_band.NAME)
"""Methods in the pictures of effects next to the released model; of their forms the last, the plain one."""


@dataclass
class Steps:
    """Counts what is done.

    Attributes:
        total: Steps in all, as far as is known.
        tell: Called with steps done, all steps, and a text.
        done: Steps done.
    """

    total: int
    tell: StageProgress | None
    done: int = 0

    def __call__(self, text: str) -> None:
        """One more step begins."""
        self.done += 1
        self.total = max(self.total, self.done)
        self.say(text)

    def say(self, text: str) -> None:
        """A text about the present step."""
        if self.tell:
            self.tell(self.done - 1, self.total, text)


def write_report(
    folder: Path,
    subjects: Sequence[tuple[Dataset, Path]],
    settings: Settings | None = None,
    *,
    students: Sequence[Path] = (),
    command: str = "",
    progress: StageProgress | None = None,
) -> dict[str, Any]:
    """Measure every method on every dataset and write `report.md`, `report.json` and the pictures.

    Args:
        folder: Where; must not exist yet.
        subjects: Datasets, each with the version folder of the released model for it.
        settings: How much work; the full report if absent.
        students: Version folders of small models, each compared on the datasets of its sensor.
        command: How to make this report again, for the page.
        progress: Called with steps done, all steps, and the step that begins.

    Returns:
        The record, as in `report.json`.

    Raises:
        OutputExists: If the folder exists.
        DatasetError: If a dataset cannot teach the methods.
        ModelError: If a model is for another layout or knows less than its dataset.
        PressError: If there are too few measured presses.

    A measured dataset (`is_measured`) is judged by its own presses: a fifth is held out and scored as measured.
    """
    settings = settings or Settings()
    small = [ReleasedModel(student, Predictor(student).metadata.name) for student in dict.fromkeys(students)]
    prepared = [_Subject.of(dataset, model, settings, small) for dataset, model in subjects]
    steps = Steps(sum(subject.steps for subject in prepared), progress)
    with new_folder(folder) as draft, one_thread():
        sections = [subject.measure(draft, stem, steps) for stem, subject in _stems(prepared)]
        record = {
            "format_version": FORMAT_VERSION,
            "command": command,
            "machine": machine(MEASURED_WITH),
            "settings": settings.to_dict(),
            "datasets": sections,
        }
        plain = {**record, "datasets": [_plain_section(section) for section in sections]}
        write_whole(draft / "report.json", (json.dumps(plain, indent=1, allow_nan=False) + "\n").encode())
        write_whole(draft / "report.md", page(record).encode())
    return plain


def _plain_section(section: dict[str, Any]) -> dict[str, Any]:
    return {**section, "methods": [method.to_dict() for method in section["methods"]]}


def _stems(subjects: "list[_Subject]") -> "list[tuple[str, _Subject]]":
    """Names for the pictures: the sensor's, with a number where two datasets share it."""
    names = [subject.bench.sensor.name for subject in subjects]
    return [
        (name if names.count(name) == 1 else f"{name}-{number}", subject)
        for number, (name, subject) in enumerate(zip(names, subjects, strict=True), start=1)
    ]


@dataclass(frozen=True)
class _Subject:
    """One dataset, its model and that model's students.

    Of measured presses, `held` are the test presses, and `dataset` the others.
    """

    dataset: Dataset
    released: ReleasedModel
    students: tuple[ReleasedModel, ...]
    task: FittingTask
    bench: EvaluationScene
    settings: Settings
    held: LabelledPresses | None = None

    @classmethod
    def of(cls, dataset: Dataset, model: Path, settings: Settings, small: Sequence[ReleasedModel]) -> "_Subject":
        released = ReleasedModel(model)
        students = tuple(each for each in small if each.predictor.metadata.sensor == released.predictor.metadata.sensor)
        if is_measured(dataset):
            return cls._of_measured(dataset, released, students, settings)
        dataset = _known_to(released.predictor.metadata, dataset)
        if len(dataset.samples) > settings.learn_from:
            dataset = replace(dataset, samples=_rows(dataset.samples, np.arange(settings.learn_from)))
        bench = EvaluationScene.of(dataset, settings.presses, settings.seed)
        task = task_of(dataset, bench, settings)
        return cls(dataset, released, students, task, bench, settings)

    @classmethod
    def _of_measured(
        cls, dataset: Dataset, released: ReleasedModel, students: tuple[ReleasedModel, ...], settings: Settings
    ) -> "_Subject":
        dataset = _measured_known_to(released.predictor.metadata, dataset)
        presses = LabelledPresses.of(dataset.samples)
        held = held_out(presses.contact)
        bench = EvaluationScene.of(dataset, settings.presses, settings.seed)
        others = replace(dataset, samples=_rows(dataset.samples, np.flatnonzero(~held)[: settings.learn_from]))
        return cls(others, released, students, task_of(others, bench, settings), bench, settings, presses[held])

    @property
    def steps(self) -> int:
        """Number of steps that progress is called with, roughly."""
        remaining = 0 if len(self.bench.sensor.electrodes) < 4 else len(self.bench.sensor.electrodes)
        return 22 + len(self.settings.sizes) + 2 * self.settings.rounds + len(self.settings.shapes) + remaining

    @property
    def _given(self) -> tuple[ReleasedModel, ...]:
        """The models that are compared as they are, the released one first."""
        return self.released, *self.students

    def measure(self, folder: Path, stem: str, steps: Steps) -> dict[str, Any]:
        """Everything about this dataset: its section of the record, its pictures written."""
        if self.held is not None:
            return self._measured(folder, stem, EvaluationPresses.measured(self.held), steps)
        settings, bench = self.settings, self.bench
        steps("solving the film for limits and contours")
        forward_maps = bench.forward_maps(further=1.0, settings=SolveSettings(accuracy=settings.accuracy))
        steps("solving the film for the test presses")
        test_maps = forward_maps if settings.quick else bench.forward_maps()
        test = EvaluationPresses.of(bench, press_on(test_maps, bench.sweep()))
        steps("integrating the Bayes limit")
        limits = error_bounds(bench, forward_maps, test.presses, test.charge_pC, settings.limited, steps.say)
        methods = fit_all(all_methods(self.dataset, forward_maps[0], settings), self._given, self.task, test, steps)
        methods = timed(methods, test, settings, steps)
        section = self._section(test, limits, methods, steps)
        section["pictures"] = _draw(folder, stem, section, self._draws(test), bench, settings, steps)
        return section

    def _measured(self, folder: Path, stem: str, test: EvaluationPresses, steps: Steps) -> dict[str, Any]:
        """The same of measured presses, as they are: what needs a simulator is left out."""
        estimators = all_methods(self.dataset, None, self.settings)
        methods, refused = fit_those_that_can(estimators, self._given, self.task, test, steps)
        records = records_of(timed(methods, test, self.settings, steps), test, None)
        section = {
            **self._about(test),
            "limits": {"bayes": None, "cramer_rao": None},
            "methods": records,
            "verdict": verdict(records),
            "left_out": refused,
        }
        drawings = _speed_drawings(section, {}, self.settings)
        return section | {"pictures": pictures.draw_all(folder, stem, drawings, steps)}

    def _about(self, test: EvaluationPresses) -> dict[str, Any]:
        """Sensor, contacts, noise, numbers of presses, model."""
        bench = self.bench
        return {
            "sensor": bench.sensor.name,
            "measured": self.held is not None,
            "electrodes": list(bench.sensor.electrode_names),
            "probes": [probe.notation for probe in bench.probes],
            "radius_mm": bench.domain.radius_mm,
            "force_N": list(bench.domain.force_range_N),
            "noise": bench.noise.to_dict(),
            "dataset_sha256": self.dataset.sha256,
            "presses": {
                "train": len(self.task.train),
                "validation": len(self.task.validation),
                "test": len(test.presses),
            },
            "model": _model_record(self.released),
        }

    def _section(
        self, test: EvaluationPresses, limits: ErrorBounds, methods: list[Method], steps: Steps
    ) -> dict[str, Any]:
        bench, truth = self.bench, test.presses.contact
        records = records_of(methods, test, limits.bayes)
        draws = self._draws(test)
        threshold = effects.threshold_of(self.released, test.presses, bench, self.settings.draws)
        cases = effects.cases(bench, test.presses, self.settings, steps)
        return {
            **self._about(test),
            "limits": limits.record(truth),
            "methods": records,
            "verdict": verdict(records),
            "by_force": maps.by_force(bench.domain, truth, _lines(methods, limits), limits.position_mm),
            "worst_regions": maps.worst_regions(bench.domain, draws, limits.bayes, methods[0].contact, truth),
            "calibration": maps.calibration(bench.domain, draws),
            "alarm_threshold": rounded(threshold),
            "cases": effects.measure(cases, self.released, _compared(methods), threshold),
            "without_one": effects.without_one_electrode(self.task, bench, test.presses, steps),
        }

    def _draws(self, test: EvaluationPresses) -> maps.Draws:
        return maps.Draws(self.released, test.presses, self.bench, self.settings.draws)


def _rows(samples: Samples, rows: np.ndarray) -> Samples:
    return Samples(**{name: column[rows] for name, column in samples.columns().items()})


def _known_to(model: ModelMetadata, dataset: Dataset) -> Dataset:
    """The presses of the dataset that lie in the model's working area, which may be the smaller one.

    Raises:
        ModelError: If the model is for another sensor, or knows fewer forces.
    """
    expected, got = sensor_to_dict(dataset.sensor), dict(model.sensor)
    keys = sorted(key for key in (expected.keys() | got.keys()) - {"name"} if expected.get(key) != got.get(key))
    if keys:
        raise ModelError(
            f"model {model.label}: expected the dataset's sensor {expected['name']!r}, got {got.get('name')!r} with "
            f"another {', '.join(keys)}; choose its own model with --model, or train one"
        )
    domain, (low, high) = domain_of(dataset), model.force_range_N
    least, most = domain.force_range_N
    if least * SLACK < low or most > high * SLACK:
        raise ModelError(
            f"model {model.label}: knows forces from {low:g} to {high:g} N, the dataset reaches from {least:.4g} to "
            f"{most:.4g} N; sweep within that, or train one"
        )
    radius = inner_radius(model.working_area_mm)
    if domain.radius_mm <= radius * SLACK:
        return dataset
    inside = np.hypot(dataset.samples.x_mm, dataset.samples.y_mm) <= radius
    ranges = {**dataset.manifest.get("ranges", {}), "radius_mm": radius}
    samples = _rows(dataset.samples, np.flatnonzero(inside))
    return replace(dataset, samples=samples, manifest={**dataset.manifest, "ranges": ranges})


SLACK = 1.0 + 1e-6
"""By how much a range may be passed: rounding."""


def _model_record(released: ReleasedModel) -> dict[str, Any]:
    metadata = released.predictor.metadata
    return {
        "label": metadata.label,
        "probes": list(metadata.probes),
        "noise": metadata.noise["name"],
        "dataset_sha256": metadata.dataset_sha256,
        "card_errors": dict(metadata.errors),
    }


def _measured_known_to(model: ModelMetadata, dataset: Dataset) -> Dataset:
    """Measured presses with positive charges within the model's working area and forces.

    Raises:
        ModelError: If the model has other electrodes.
        PressError: If too few remain.
    """
    if model.electrodes != dataset.sensor.electrode_names:
        raise ModelError(
            f"model {model.label}: expected the electrodes {dataset.sensor.electrode_names} of the presses, got "
            f"{model.electrodes}; choose their own model with --model, or train one"
        )
    samples, (low, high) = dataset.samples, model.force_range_N
    inside = (np.hypot(samples.x_mm, samples.y_mm) <= inner_radius(model.working_area_mm) * SLACK) & (
        (samples.force_N * SLACK >= low) & (samples.force_N <= high * SLACK)
    )
    rows = np.flatnonzero(inside & (samples.charge_pC > 0.0).all(axis=1))
    check_enough(len(rows), len(samples), dataset.sensor.name)
    return replace(dataset, samples=_rows(samples, rows), manifest={})


def _compared(methods: list[Method]) -> list[Fitted]:
    """One form of each method that the effects are shown for; its last is the plain one."""
    last = {method.fitted.name: method.fitted for method in methods}
    return [last[name] for name in COMPARED if name in last]


def _lines(methods: list[Method], limits: ErrorBounds) -> dict[str, Array]:
    """Contacts for the picture of error against force."""
    last = {method.fitted.name: method.contact for method in methods}
    lines = {BAYES: limits.bayes} if limits.bayes is not None else {}
    released = methods[0].fitted.name
    return {**lines, released: methods[0].contact, **{name: last[name] for name in COMPARED if name in last}}


def _draw(
    folder: Path,
    stem: str,
    section: dict[str, Any],
    draws: maps.Draws,
    bench: EvaluationScene,
    settings: Settings,
    steps: Steps,
) -> dict[str, list[str]]:
    released: MethodRecord = section["methods"][0]
    known = {BAYES: section["limits"]["bayes"], CRAMER_RAO: section["limits"]["cramer_rao"]}
    limits = {name: limit["position_rms_mm"] for name, limit in known.items() if limit}

    drawings: dict[str, Callable[[], Any]] = {
        **_speed_drawings(section, limits, settings),
        "maps": lambda: pictures.error_maps(bench.sensor, bench.domain, draws),
        "force": lambda: pictures.against_force(section["by_force"], released.name),
        "calibration": lambda: pictures.calibration(section["calibration"]),
        "noise": lambda: pictures.noise_effect(section["cases"], released.name),
        "effects": lambda: pictures.mismatch_effect(section["cases"], released.name, released.errors.position_rms_mm),
    }
    return pictures.draw_all(folder, stem, drawings, steps)


def _speed_drawings(
    section: dict[str, Any], limits: dict[str, float], settings: Settings
) -> dict[str, Callable[[], Any]]:
    def speed(plot: Plot) -> Callable[[], Any]:
        return lambda: speed_plot(section["methods"], plot, limits, settings.batch)

    return {plot: speed(plot) for plot in AXES}
