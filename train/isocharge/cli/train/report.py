"""`isocharge train report`: speed against error, all methods, with the limits."""

import json as json_module
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.measured_presses import read_presses_of
from isocharge.cli.shared.options import NewFolderOption, ProbeOption
from isocharge.cli.shared.terminal import progress, say, this_command
from isocharge.common.errors import InputError, ModelError
from isocharge.common.files import refuse_existing

if TYPE_CHECKING:
    from isocharge.simulate import Dataset


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
    json: Annotated[bool, typer.Option("--json", help="Print the record, as in report.json. (default: no)")] = False,
) -> None:
    """Compare a model with other methods: error (mm, % of force) against time (us), throughput and memory (bytes).

    All methods answer the same noisy presses. Measured presses are judged as they are, by a fifth that no method has
    seen: no simulator has a say, and what needs one is left out. --probe is what made the presses of PRESSES.csv.

    It takes some minutes for a dataset of 24,000 presses. Let nothing else run meanwhile: times are measured.

    Example: isocharge train report presses -o report
    """
    refuse_existing(output)
    if model and len(model) != len(datasets):
        raise InputError(f"--model: expected one model for each of {len(datasets)} datasets, got {len(model)}")
    from isocharge.serve import find_model
    from isocharge.train.report import QUICK, Settings, write_report

    loaded = [_read(path, sensor, probe) for path in datasets]
    names = model or [dataset.sensor.name for dataset in loaded]
    subjects = [(dataset, find_model(name)) for dataset, name in zip(loaded, names, strict=True)]
    students = [find_model(name) for name in student] if student else _students_of(names)
    with progress("report") as advance:
        record = write_report(
            output,
            subjects,
            QUICK if quick else Settings(),
            students=students,
            command=this_command(),
            progress=advance,
        )
    for section in record["datasets"]:
        for sentence in section["verdict"]["sentences"]:
            say(f"{section['sensor']}: {sentence}")
    say(str(output / "report.md"))
    if json:
        typer.echo(json_module.dumps(record))


def _students_of(models: list[str]) -> list[Path]:
    """The students that are there, by name."""
    from isocharge.serve import find_model

    students = []
    for model in models:
        with suppress(ModelError):
            students.append(find_model(f"{model}-student"))
    return students


def _read(path: Path, sensor: str | None, probe: str) -> "Dataset":
    """A dataset folder, or a file of measured presses."""
    from isocharge.simulate import load_sensor, parse_probe, read_dataset
    from isocharge.train.data.measured import dataset_of

    if not path.is_file():
        return read_dataset(path)
    if sensor is None:
        raise InputError(f"{path}: a file of measured presses needs --sensor SENSOR, which says what was pressed")
    described = load_sensor(sensor)
    return dataset_of(read_presses_of(path, described.electrode_names), described, parse_probe(probe))
