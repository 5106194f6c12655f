"""`isocharge train report`: speed against error, all methods, with the limits."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.measured_presses import read_press_file
from isocharge.cli.shared.options import FreshOption, JsonOption, NewFolderOption
from isocharge.cli.shared.probe_option import ProbeOption
from isocharge.cli.shared.terminal import say, show_json, shown_progress, this_command
from isocharge.common.errors import InputError, ModelError
from isocharge.common.resumable_run import refuse_finished
from isocharge.serve import find_model
from isocharge.simulate import Dataset, load_sensor, parse_probe, read_dataset
from isocharge.train.data.presses import dataset_of
from isocharge.train.report import QUICK, Settings, write_report


def report_command(
    datasets: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATASET|PRESSES.csv...",
            help="Dataset folders of `isocharge simulate sweep` or of measured presses; or with --sensor CSV files of "
            "50 measured presses or more.",
        ),
    ],
    output: NewFolderOption,
    model: Annotated[
        list[str] | None,
        typer.Option(
            "--model",
            metavar="MODEL",
            help="Model to compare, name or path; once for each DATASET. (default: the one named as the sensor)",
        ),
    ] = None,
    student: Annotated[
        list[str] | None,
        typer.Option(
            "--student",
            metavar="MODEL",
            help="Small model to compare too; may be repeated. (default: the released one named MODEL-student)",
        ),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option("--sensor", metavar="SENSOR", help="The sensor of PRESSES.csv. (default: DATASET's)"),
    ] = None,
    probe: ProbeOption = "circle:1.0",
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Try it on little data, in half a minute; the figures mean nothing. (default: all data)"
        ),
    ] = False,
    fresh: FreshOption = False,
    json: JsonOption = False,
) -> None:
    """Compare a model with other methods: error (mm, % of force) against time (us), throughput and memory (bytes).

    All methods answer the same noisy presses. Measured presses are judged as they are, by a fifth that no method has
    seen: no simulator has a say, and what needs one is left out. --probe is what made the presses of PRESSES.csv.

    It takes some minutes for a dataset of 24,000 presses. Let nothing else run meanwhile: times are measured. A report
    that was stopped leaves DIR.part with its solves and limits; the same command goes on. --json prints report.json.

    Example: isocharge train report presses -o report
    """
    refuse_finished(output)
    if model and len(model) != len(datasets):
        raise InputError(f"--model: expected one model for each of {len(datasets)} datasets, got {len(model)}")
    loaded = [_read(path, sensor, probe) for path in datasets]
    names = model or [dataset.sensor.name for dataset in loaded]
    subjects = [(dataset, find_model(name)) for dataset, name in zip(loaded, names, strict=True)]
    students = [find_model(name) for name in student] if student else _students_of(names)
    settings, command = QUICK if quick else Settings(), this_command()
    with shown_progress():
        record = write_report(output, subjects, settings, students=students, command=command, fresh=fresh)
    for section in record["datasets"]:
        for sentence in section["verdict"]["sentences"]:
            say(f"{section['sensor']}: {sentence}")
    say(str(output / "report.md"))
    if json:
        show_json(record)


def _students_of(models: list[str]) -> list[Path]:
    """The students that are there, by name."""
    students = []
    for model in models:
        with suppress(ModelError):
            students.append(find_model(f"{model}-student"))
    return students


def _read(path: Path, sensor: str | None, probe: str) -> Dataset:
    """A dataset folder, or a file of measured presses."""
    if not path.is_file():
        return read_dataset(path)
    if sensor is None:
        raise InputError(f"{path}: a file of measured presses needs --sensor SENSOR, which says what was pressed")
    described = load_sensor(sensor)
    return dataset_of(read_press_file(path, described.electrode_names), described, parse_probe(probe))
