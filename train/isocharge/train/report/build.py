"""Evaluation of all datasets of a report, and writer of its JSON record, its picture and its page."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from isocharge.common.files import new_folder, refuse_existing, write_whole
from isocharge.common.progress import track
from isocharge.serve.benchmark import machine
from isocharge.simulate import Dataset
from isocharge.simulate.plots.figure import save_picture
from isocharge.train.report.evaluation import DatasetEvaluation, Settings
from isocharge.train.report.page import PICTURE, draw_speed, report_page
from isocharge.train.training.fit import threads_and_seed

FORMAT_VERSION = 3
"""Version of the format of `report.json`."""

RECORDED_PACKAGES = ("isocharge", "numpy", "scipy", "onnxruntime")
"""Packages whose versions are recorded with the results."""


def write_report(
    folder: Path,
    subjects: Sequence[tuple[Dataset, Path]],
    settings: Settings | None = None,
    *,
    command: str = "",
) -> dict[str, Any]:
    """Measure every method on every dataset, and write `report.md`, `report.json` and the picture.

    If a dataset was measured, a fifth of its presses is held out for the test. If it was simulated, the test presses
    are simulated as well.

    Args:
        folder: Folder to write; it must not exist.
        subjects: Datasets, each with the version folder of the model that is evaluated on it.
        settings: Settings of the report; None for the settings of a full report.
        command: Command that repeats the report, for the page; empty if there is none.

    Returns:
        The content of `report.json`.

    Raises:
        OutputExists: If the folder exists.
        DatasetError: If the methods cannot be fitted to a dataset.
        ModelError: If a model is for another sensor than its dataset.
        PressError: If there are too few measured presses.
    """
    refuse_existing(folder)
    settings = settings or Settings()
    evaluations = [DatasetEvaluation.prepare(dataset, model_folder, settings) for dataset, model_folder in subjects]
    with threads_and_seed(1, settings.seed):  # all methods are timed with one thread
        sections = [evaluation.measure() for evaluation in track(evaluations, "datasets")]

    this_machine = machine(RECORDED_PACKAGES)
    record = {
        "format_version": FORMAT_VERSION,
        "command": command,
        "machine": this_machine,
        "settings": asdict(settings),
        "datasets": [asdict(section) for section in sections],
    }
    page = report_page(sections, settings, this_machine, command)
    with new_folder(folder) as draft:
        save_picture(draw_speed(sections), draft / PICTURE)
        write_whole(draft / "report.md", page.encode())
        write_whole(draft / "report.json", (json.dumps(record, indent=1, allow_nan=False) + "\n").encode())
    return record
