"""The report: measure everything, write the record, the pictures and the page; whole or not at all."""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from isocharge.common.arrays import Booleans
from isocharge.common.errors import ModelError
from isocharge.common.files import write_whole
from isocharge.common.progress import track
from isocharge.common.resumable_run import resume_folder
from isocharge.serve import ModelMetadata, Predictor
from isocharge.serve.benchmark import machine
from isocharge.simulate import ChargeSpline, Dataset, Samples
from isocharge.simulate.plots.figure import save_picture
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.baselines.compared_methods import (
    BOOSTING,
    GAUSS_NEWTON,
    LINEAR_BAND,
    POLYNOMIAL,
    TABLE,
    ComparedMethod,
    FittingTask,
    compared_methods,
)
from isocharge.train.baselines.networks import RELEASED, ReleasedModel, TrainedNetwork
from isocharge.train.data.presses import (
    LabelledPresses,
    check_enough,
    domain_of,
    held_out,
    is_measured,
    presses_of,
    split_by_position,
)
from isocharge.train.model_release.evaluate import alarm_threshold
from isocharge.train.model_release.release import model_domain
from isocharge.train.report import pictures, studies
from isocharge.train.report.case import BAYES, ErrorBounds, EvaluationCase, Settings, press_on
from isocharge.train.report.measures import rounded, verdict
from isocharge.train.report.methods import fit_all, records_of
from isocharge.train.report.page import page
from isocharge.train.training.fit import threads_and_seed
from isocharge.train.training.source import TrainingData

FORMAT_VERSION = 1

MEASURED_WITH = ("isocharge", "numpy", "scipy", "scikit-learn", "torch", "onnxruntime")
"""Packages whose versions belong to the figures."""

COMPARED = (GAUSS_NEWTON, POLYNOMIAL, TABLE, BOOSTING, LINEAR_BAND)
"""Methods in the pictures of effects next to the released model."""

TEST_NOISE = 4242
"""Seed of the noise on the test presses, relative to the case's."""

FEWEST_LEARNT = 30
"""Measured presses that methods are fitted to at least, once the test presses are held out."""

SLACK = 1.0 + 1e-6
"""By how much a range may be passed: rounding."""

Drawings = dict[str, Callable[[], Figure]]


def write_report(
    folder: Path,
    subjects: Sequence[tuple[Dataset, Path]],
    settings: Settings | None = None,
    *,
    students: Sequence[Path] = (),
    command: str = "",
    fresh: bool = False,
) -> dict[str, Any]:
    """Measure every method on every dataset and write `report.md`, `report.json` and the pictures.

    A measured dataset (`is_measured`) is judged by its own presses: a fifth is held out and scored as measured. Solves
    and limits of a report that was killed are kept in FOLDER.part, and the same call goes on.

    Args:
        folder: Where; must not exist yet.
        subjects: Datasets, each with the version folder of the released model for it.
        settings: How much work; the full report if absent.
        students: Version folders of small models, each compared on the datasets of its sensor.
        command: How to make this report again, for the page.
        fresh: Throw away what a killed report kept.

    Returns:
        The record, as in `report.json`.

    Raises:
        OutputExists: If the folder exists.
        DatasetError: If a dataset cannot teach the methods.
        ModelError: If a model is for another layout or knows less than its dataset.
        PressError: If there are too few measured presses.
    """
    settings = settings or Settings()
    prepared = [_Subject.of(dataset, model, students, settings) for dataset, model in subjects]
    about = {
        "format_version": FORMAT_VERSION,
        "command": command,
        "machine": machine(MEASURED_WITH),
        "settings": asdict(settings),
    }
    identity = {
        **about,
        "datasets": [
            {"dataset_sha256": each.dataset.sha256, "models": list(map(str, (each.released.folder, *each.students)))}
            for each in prepared
        ],
    }
    with resume_folder(folder, identity, fresh=fresh) as run, threads_and_seed(1, settings.seed):
        sections = [subject.measure(run.data, stem, run.keeping(stem)) for stem, subject in _stems(prepared).items()]
        write_whole(run.data / "report.md", page({**about, "datasets": sections}).encode())
        plain = [{**section, "methods": [method.to_dict() for method in section["methods"]]} for section in sections]
        record = {**about, "datasets": plain}
        write_whole(run.data / "report.json", (json.dumps(record, indent=1, allow_nan=False) + "\n").encode())
    return record


def _stems(subjects: "Sequence[_Subject]") -> "dict[str, _Subject]":
    """Names for the pictures: the sensor's, with a number where two datasets share it."""
    names = [subject.case.sensor.name for subject in subjects]
    return {
        name if names.count(name) == 1 else f"{name}-{number}": subject
        for number, (name, subject) in enumerate(zip(names, subjects, strict=True), start=1)
    }


@dataclass(frozen=True)
class _Subject:
    """One dataset, its model and that model's students.

    Of measured presses, `held` are the test presses, and `dataset` the others.
    """

    dataset: Dataset
    released: ReleasedModel
    students: tuple[Path, ...]
    task: FittingTask
    case: EvaluationCase
    settings: Settings
    held: LabelledPresses | None = None

    @classmethod
    def of(cls, dataset: Dataset, model: Path, students: Sequence[Path], settings: Settings) -> "_Subject":
        """Presses that the model knows, split."""
        about, measured, held = Predictor(model).metadata, is_measured(dataset), None
        dataset = _measured_known_to(about, dataset) if measured else _known_to(about, dataset)
        case = EvaluationCase.of(dataset, settings.presses, settings.seed)
        if measured:
            presses = LabelledPresses.of(dataset)
            out = held_out(presses.contact)
            held, dataset = presses[out], _rows(dataset, ~out)
        dataset = _rows(dataset, np.arange(len(dataset.samples)) < settings.learn_from)
        learnt = presses_of(dataset, FEWEST_LEARNT) if measured else presses_of(dataset)
        train, validation = split_by_position(learnt, settings.hold_out, settings.seed)
        task = FittingTask(train, validation, case.domain, case.noise, settings.seed, settings.quick)
        own = tuple(path for path in dict.fromkeys(students) if Predictor(path).metadata.sensor == about.sensor)
        return cls(dataset, ReleasedModel(model), own, task, case, settings, held)

    def measure(self, folder: Path, stem: str, executor: Executor) -> dict[str, Any]:
        """Everything about this dataset: its section of the record, its pictures written."""
        section, drawings = self._simulated(executor) if self.held is None else self._measured(self.held)
        limits = pictures.limit_lines(section["limits"])
        for plot in pictures.AXES:
            drawings[plot] = lambda plot=plot: pictures.speed_plot(section["methods"], plot, limits)  # type: ignore[misc]
        section["pictures"] = {name: [f"{stem}-{name}.{kind}" for kind in ("png", "svg")] for name in drawings}
        for name, draw in track(drawings.items(), "drawing"):
            figure = draw()
            for file in section["pictures"][name]:
                save_picture(figure, folder / file)
        return section

    def _simulated(self, executor: Executor) -> tuple[dict[str, Any], Drawings]:
        case, settings, released = self.case, self.settings, self.released
        exact = case.forward_maps(further=1.0, accuracy=settings.accuracy, executor=executor)
        clean = press_on(exact if settings.quick else case.forward_maps(executor=executor), case.sweep())
        test = replace(clean, charge=clean.noisy(case.noise, case.seed + TEST_NOISE))
        charges = ChargeSpline.of(exact[0])
        limits = ErrorBounds.of(case, charges, clean, test.charge[: settings.limited], executor)
        methods, _ = fit_all(
            [*self._models(), *compared_methods(self.task, charges), *self._networks()], self.task, test
        )
        records, fitted = (
            records_of(methods, test, settings, limits.bayes),
            {each.compared.name: each for each in methods},
        )
        draws = studies.Draws.of(released, clean, case, settings.draws)
        threshold = alarm_threshold(draws.misfit)
        compared = [fitted[name].compared for name in COMPARED]
        contacts = {name: fitted[name].contact for name in (RELEASED, *COMPARED)}
        lines = contacts if limits.bayes is None else {BAYES: limits.bayes, **contacts}
        different = [
            studies.measured(deviation, RELEASED, released, compared, threshold)
            for deviation in studies.deviations(case, clean, settings, executor)
        ]
        section = {
            **self._about(len(test)),
            "limits": limits.record(test.contact),
            "methods": records,
            "verdict": verdict(records),
            "by_force": studies.by_force(case.domain, test.contact, lines, limits.cramer_rao.position),
            "calibration": studies.calibration(draws),
            "alarm_threshold": rounded(threshold),
            "cases": different,
        }
        return section, _drawings(section, case, draws)

    def _measured(self, test: LabelledPresses) -> tuple[dict[str, Any], Drawings]:
        """The same of measured presses, as they are: what needs a simulator is left out."""
        methods, refused = fit_all([*self._models(), *compared_methods(self.task), *self._networks()], self.task, test)
        records = records_of(methods, test, self.settings)
        section = {
            **self._about(len(test)),
            "limits": {"bayes": None, "cramer_rao": None},
            "methods": records,
            "verdict": verdict(records),
            "left_out": refused,
        }
        return section, {}

    def _models(self) -> list[ComparedMethod]:
        """The models that are compared as they are, the released one first."""
        models = {RELEASED: self.released}
        models |= {Predictor(path).metadata.name: ReleasedModel(path) for path in self.students}
        rows = []
        for name, model in models.items():
            rows.append(ComparedMethod(name, "network", "Predictor", model, choice="as released"))
            contact, choice = model.contact_only(), "as released, its contact alone"
            rows.append(
                ComparedMethod(f"{name}, contact only", "network", "ONNX Runtime, bound", contact, choice=choice)
            )
        return rows

    def _networks(self) -> list[ComparedMethod]:
        """Networks of several sizes."""
        case, noise, steps = self.case, self.case.noise, self.settings.steps
        data = TrainingData(
            sensor=case.sensor,
            probes=tuple(probe.notation for probe in case.probes),
            domain=case.domain,
            presses=self.task.train,
            sha256=self.dataset.sha256,
        )
        return [
            ComparedMethod(
                f"network {'-'.join(map(str, hidden))}",
                "network",
                "ONNX Runtime, bound",
                TrainedNetwork(data, hidden, steps, noise, self.settings.seed),
                choice=f"{steps} steps",
            )
            for hidden in self.settings.sizes
        ]

    def _about(self, tested: int) -> dict[str, Any]:
        """Sensor, contacts, noise, numbers of presses, model."""
        case, model = self.case, self.released.predictor.metadata
        return {
            "sensor": case.sensor.name,
            "measured": self.held is not None,
            "electrodes": list(case.sensor.electrode_names),
            "probes": [probe.notation for probe in case.probes],
            "radius_mm": case.domain.radius,
            "force_N": list(case.domain.force_range),
            "noise": case.noise.to_dict(),
            "dataset_sha256": self.dataset.sha256,
            "presses": {"train": len(self.task.train), "validation": len(self.task.validation), "test": tested},
            "model": {
                "label": model.label,
                "probes": list(model.probes),
                "noise": model.noise.name,
                "dataset_sha256": model.dataset_sha256,
                "card_errors": dict(model.errors),
            },
        }


def _drawings(section: dict[str, Any], case: EvaluationCase, draws: studies.Draws) -> Drawings:
    """The pictures of a simulated dataset beside those of speed."""
    force, nominal = section["by_force"], section["methods"][0].errors.position_rms_mm
    noise = [deviation for deviation in section["cases"] if deviation["group"] == "noise"]
    lines = {name: [level["errors"][name]["position_rms_mm"] for level in noise] for name in noise[0]["errors"]}
    return {
        "maps": lambda: pictures.error_maps(case.sensor, case.domain, draws),
        "force": lambda: pictures.error_lines(force["force_N"], force["position_rms_mm"], "force, N"),
        "calibration": lambda: pictures.calibration(section["calibration"]),
        "noise": lambda: pictures.error_lines(studies.LEVELS, lines, "noise over reference"),
        "effects": lambda: pictures.mismatch_effect(section["cases"], nominal),
    }


def _rows(dataset: Dataset, rows: Booleans) -> Dataset:
    """Some presses of a dataset."""
    columns = dataset.samples.columns().items()
    return replace(dataset, samples=Samples(**{name: values[rows] for name, values in columns}))


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
    least, most = domain.force_range
    if least * SLACK < low or most > high * SLACK:
        raise ModelError(
            f"model {model.label}: knows forces from {low:g} to {high:g} N, the dataset reaches from {least:.4g} to "
            f"{most:.4g} N; sweep within that, or train one"
        )
    radius = model_domain(model).radius
    if domain.radius <= radius * SLACK:
        return dataset
    ranges = {**dataset.manifest.get("ranges", {}), "radius_mm": radius}
    inside = np.hypot(dataset.samples.x_mm, dataset.samples.y_mm) <= radius
    return replace(_rows(dataset, inside), manifest={**dataset.manifest, "ranges": ranges})


def _measured_known_to(model: ModelMetadata, dataset: Dataset) -> Dataset:
    """Measured presses within the model's working area and forces.

    Raises:
        ModelError: If the model has other electrodes.
        PressError: If too few remain.
    """
    if model.electrodes != dataset.sensor.electrode_names:
        raise ModelError(
            f"model {model.label}: expected the electrodes {dataset.sensor.electrode_names} of the presses, got "
            f"{model.electrodes}; choose their own model with --model, or train one"
        )
    presses = LabelledPresses.of(dataset)
    inside = model_domain(model).contains(presses.contact)
    check_enough(int(inside.sum()), len(presses), dataset.sensor.name)
    return replace(_rows(dataset, inside), manifest={})
