"""Evaluation of all datasets of a report, and writer of its JSON record, its pictures and its page.

The folder of the report appears when the report is complete. A stopped report keeps the simulations of the film and the
theoretical limits that are already complete. The same call of `write_report` then continues the report.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from isocharge.common.files import write_whole
from isocharge.common.resumable_run import resume_folder
from isocharge.serve.benchmark import machine
from isocharge.simulate import Dataset
from isocharge.train.report.case import Settings
from isocharge.train.report.evaluation import DatasetEvaluation
from isocharge.train.report.page import report_page
from isocharge.train.training.fit import threads_and_seed

FORMAT_VERSION = 1
"""Version of the format of `report.json`."""

RECORDED_PACKAGES = ("isocharge", "numpy", "scipy", "scikit-learn", "torch", "onnxruntime")
"""Packages whose versions are recorded with the results."""


def write_report(
    folder: Path,
    subjects: Sequence[tuple[Dataset, Path]],
    settings: Settings | None = None,
    *,
    students: Sequence[Path] = (),
    command: str = "",
    fresh: bool = False,
) -> dict[str, Any]:
    """Measure every method on every dataset, and write `report.md`, `report.json` and the pictures.

    Methods are fitted to the presses of a dataset and tested on other presses. If the dataset was measured, a fifth of
    its presses is held out for the test. If the dataset was simulated, the test presses are simulated as well. A
    stopped report keeps completed simulations of the film and completed theoretical limits in the folder `FOLDER.part`.
    The same call then continues the report.

    Args:
        folder: Folder to write; it must not exist.
        subjects: Datasets, each with the version folder of the model that is evaluated on it.
        settings: Settings of the report; None for the settings of a full report.
        students: Version folders of small models. Each of them is compared on the datasets of its sensor.
        command: Command that repeats the report, for the page; empty if there is none.
        fresh: Whether to delete the results of a stopped report, and to begin again.

    Returns:
        The content of `report.json`.

    Raises:
        OutputExists: If the folder exists, or a stopped report had other settings, datasets or models.
        DatasetError: If the methods cannot be fitted to a dataset.
        ModelError: If a model is for another sensor or for a smaller range of forces than its dataset.
        PressError: If there are too few measured presses.
    """
    settings = settings or Settings()
    evaluations = [
        DatasetEvaluation.prepare(dataset, model_folder, students, settings) for dataset, model_folder in subjects
    ]
    header = {
        "format_version": FORMAT_VERSION,
        "command": command,
        "machine": machine(RECORDED_PACKAGES),
        "settings": asdict(settings),
    }
    # A stopped report is continued only if its settings, its datasets and its models are the same.
    run_identity = {**header, "datasets": [evaluation.identity() for evaluation in evaluations]}
    file_stems = _file_stems([evaluation.case.sensor.name for evaluation in evaluations])
    # All methods are timed with one thread.
    with resume_folder(folder, run_identity, fresh=fresh) as run, threads_and_seed(1, settings.seed):
        sections = []
        for file_stem, evaluation in zip(file_stems, evaluations, strict=True):
            section = evaluation.measure(run.storing_executor(file_stem))
            picture_files = section.save_pictures(run.data, file_stem)
            sections.append({**section.content, "pictures": picture_files})

        # The page needs the methods as `MethodRecord` objects. For `report.json`, these are converted to dictionaries.
        page = report_page({**header, "datasets": sections})
        record = {**header, "datasets": [_json_section(section) for section in sections]}
        write_whole(run.data / "report.md", page.encode())
        write_whole(run.data / "report.json", (json.dumps(record, indent=1, allow_nan=False) + "\n").encode())
    return record


def _file_stems(sensor_names: Sequence[str]) -> list[str]:
    """For each dataset, return the text with which the file names of its pictures begin.

    The text is the name of the sensor. If several datasets have the same sensor, the number of the dataset, counted
    from 1, is appended to the name.

    Args:
        sensor_names: Name of the sensor of each dataset.
    """
    stems = []
    for number, name in enumerate(sensor_names, start=1):
        is_unique = sensor_names.count(name) == 1
        stem = name if is_unique else f"{name}-{number}"
        stems.append(stem)
    return stems


def _json_section(section: Mapping[str, Any]) -> dict[str, Any]:
    """Return a section in the form of `report.json`, in which the record of each method is a dictionary."""
    return {**section, "methods": [method.to_dict() for method in section["methods"]]}
