"""`isocharge train report`: compare a model with other methods by error and speed."""

from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.forward_maps import DEFAULT_PROBE
from isocharge.cli.shared.options import ModelsOption, NewFolderOption
from isocharge.cli.shared.terminal import say, shown_progress, this_command
from isocharge.common.errors import InputError
from isocharge.serve import find_model, read_presses
from isocharge.simulate import Dataset, load_sensor, parse_probe, read_dataset
from isocharge.simulate.sensor.probe import PROBE_HELP
from isocharge.train.data.presses import dataset_of
from isocharge.train.report import QUICK, Settings, write_report


def report_command(
    datasets: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATASET|PRESSES.csv...",
            help="Dataset folders of `isocharge simulate sweep` or of measured presses. With --sensor also CSV files "
            "of measured presses at 50 or more positions.",
        ),
    ],
    output: NewFolderOption,
    model: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MODEL",
            help="Name or path of the model to compare, once for each DATASET. (default: the model with the name of "
            "the sensor)",
        ),
    ] = None,
    models: ModelsOption = None,
    sensor: Annotated[
        str | None,
        typer.Option(metavar="SENSOR", help="Sensor of PRESSES.csv. (default: the sensor of DATASET)"),
    ] = None,
    probe: Annotated[
        str | None,
        typer.Option(metavar="SHAPE", help=f"{PROBE_HELP} (default: {DEFAULT_PROBE})"),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Write a trial report in half a minute; its results are not meaningful. (default: a full report)",
        ),
    ] = False,
) -> None:
    """Compare a model with other methods: error (mm, % of force) against time (us).

    All methods predict the same presses, to which no method was fitted: a tenth of the presses of DATASET with noise,
    or a fifth without noise if DATASET was measured. The option --probe states the probe with which the presses of
    PRESSES.csv were made.

    The report takes less than a minute for each dataset. Durations are measured, so do not run other programs at the
    same time.

    Example: isocharge train report presses -o report
    """
    # Find the datasets and, for each of them, the model to compare.
    if model and len(model) != len(datasets):
        raise InputError(f"--model: expected one model for each of {len(datasets)} datasets, got {len(model)}")
    # Both options are only for files of measured presses, so without a file they have no effect.
    for option, value in (("--sensor", sensor), ("--probe", probe)):
        if value is not None and all(path.is_dir() for path in datasets):
            raise InputError(f"{option} {value}: the dataset folders contain sensor and probes; leave {option} out")
    loaded_datasets = [_read_dataset(path, sensor, probe or DEFAULT_PROBE) for path in datasets]
    model_names = model or [dataset.sensor.name for dataset in loaded_datasets]
    model_folders = [find_model(name, models) for name in model_names]

    settings = QUICK if quick else Settings()
    with shown_progress():
        write_report(
            output,
            list(zip(loaded_datasets, model_folders, strict=True)),
            settings,
            command=this_command(),
        )

    say(str(output / "report.md"))


def _read_dataset(path: Path, sensor: str | None, probe: str) -> Dataset:
    """Read a dataset folder or a CSV file of measured presses.

    Args:
        path: The folder or the file.
        sensor: Name or file of the sensor that measured the presses of a CSV file; not used for a folder.
        probe: Notation of the probe that made the presses of a CSV file; not used for a folder.

    Raises:
        InputError: If `path` is a file and no sensor is given.
    """
    if not path.is_file():
        return read_dataset(path)
    if sensor is None:
        raise InputError(f"{path}: expected --sensor SENSOR with a file of measured presses, got no sensor; add it")
    described_sensor = load_sensor(sensor)
    presses = read_presses(path, described_sensor.electrode_names)
    return dataset_of(presses, described_sensor, parse_probe(probe))
