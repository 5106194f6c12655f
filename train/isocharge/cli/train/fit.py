"""`isocharge train fit`: make a model from a dataset, from measured presses, or from the description of a sensor."""

import shlex
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.forward_maps import simulated_presses, sweep_radius, warn_of_stress
from isocharge.cli.shared.options import ConfigOption, JsonOption
from isocharge.cli.shared.press_options import ForceStdOption, PositionStdOption, read_press_file
from isocharge.cli.shared.terminal import say, show_json, shown_progress, this_command
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError
from isocharge.serve import MeasuredPresses, ModelMetadata
from isocharge.serve.model.model_folder import check_target
from isocharge.simulate import (
    Dataset,
    built_in_sensors,
    load_sensor,
    parse_probe,
    read_dataset,
)
from isocharge.simulate.sensor.probe import PROBE_HELP
from isocharge.train import FitConfig, Fitted, TrainingData, fit, fit_presses, load_config, release
from isocharge.train.data.presses import is_measured, measured_presses_of

ModelFolderOption = Annotated[
    Path,
    typer.Option(
        "--output",
        "-o",
        metavar="models/NAME",
        help="Folder of the model. The name of the folder becomes the name of the model.",
    ),
]

VersionOption = Annotated[
    int,
    typer.Option("--version", min=1, help="Version of the model, which is the name of the folder in models/NAME."),
]

DEFAULT_PROBE = "circle:1.0"
"""Notation of the probe if `--probe` is not given."""


def fit_command(
    context: typer.Context,
    output: ModelFolderOption,
    dataset: Annotated[
        Path | None,
        typer.Argument(
            metavar="DATASET|PRESSES.csv|SENSOR",
            help="A dataset folder of `isocharge simulate sweep` or of measured presses, or a CSV file of measured "
            "presses with the columns x_mm, y_mm, force_N and the names of the channels (pC). The file needs 500 or "
            "more presses. A SENSOR is the same as --sensor SENSOR alone. (default: --sensor)",
        ),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            metavar="SENSOR",
            help="Name of a built-in sensor or a TOML file. 24,000 presses from 0.05 to 2 N are simulated on this "
            "sensor, and 96,000 if it has more than four electrodes. (default: the sensor of DATASET)",
        ),
    ] = None,
    probe: Annotated[
        list[str] | None,
        typer.Option(
            "--probe", metavar="SHAPE", help=f"With --sensor: {PROBE_HELP} May be repeated. (default: {DEFAULT_PROBE})"
        ),
    ] = None,
    radius: Annotated[
        str,
        typer.Option(
            "--radius",
            metavar="MM|auto",
            help="With --sensor: largest distance of a press from the film's centre, mm; or auto: the working area, "
            "where the charges determine the position to 1 mm.",
        ),
    ] = f"{DEFAULT_RADIUS}",
    position_std_mm: PositionStdOption = 0.1,
    force_std: ForceStdOption = 0.01,
    config: ConfigOption = None,
    version: VersionOption = 1,
    json: JsonOption = False,
) -> None:
    """Train a network on charges, measure its errors, and write a model folder: ONNX file, card, golden vectors.

    The presses come from DATASET. With a SENSOR and no DATASET, presses are simulated first. The option --probe states
    the probes of the simulated presses, and --radius states their largest distance from the centre.

    With measured presses, a network is trained on the presses alone. Any sensor with 3 to 32 channels is
    possible. Each column of the file whose name has no other meaning is a channel. The errors are measured by
    cross-validation, in which all presses at a place are left out together. If a sensor file describes the film,
    `isocharge train calibrate` needs far fewer presses.

    Example: isocharge train fit three-25um-biaxial -o models/three-25um-biaxial

    Example: isocharge train fit presses.csv -o models/pad
    """
    notations = probe or [DEFAULT_PROBE]
    if dataset is not None and _is_sensor(dataset):
        if sensor is not None:
            raise InputError(f"expected one sensor, got {dataset} and --sensor {sensor}; leave one of them out")
        sensor = str(dataset)
        dataset = None

    # A path that is no folder is a file, a pipe, or missing.
    press_file = dataset if dataset is not None and not dataset.is_dir() else None
    if press_file is not None and not press_file.exists():
        raise InputError(f"{press_file}: expected a dataset folder or a file of measured presses; there is neither")
    if press_file is not None and sensor is not None:
        raise InputError(
            f"{press_file}: measured presses of a sensor with a sensor file calibrate its film; use `isocharge train "
            f"calibrate {shlex.quote(str(press_file))} --sensor {sensor} -o {shlex.quote(str(output))}`, or leave "
            "--sensor out to train a network on the presses alone"
        )
    if dataset is not None and sensor is not None:
        raise InputError("expected either a DATASET folder or --sensor SENSOR, got both; leave one of them out")
    if sensor is None:
        _refuse_options(context, ("radius",), "belongs to --sensor; the presses determine the working area")
    else:
        _refuse_options(context, ("position_std_mm", "force_std"), "belongs to a file of measured presses")
    if dataset is not None and press_file is None:
        _refuse_options(context, ("probe", "position_std_mm", "force_std"), "is contained in the dataset folder")
    fit_config = load_config(config) if config else FitConfig()
    loaded_dataset = read_dataset(dataset) if dataset is not None and press_file is None else None
    presses: MeasuredPresses | None = None
    sensor_name = output.resolve().name  # the sensor of a file of presses has no other name than that of the model
    pressing_probes = set(probe or ["unknown"])
    if press_file is not None:
        presses = _read_presses_of_unknown_sensor(press_file, position_std_mm, force_std)
    elif loaded_dataset is not None and is_measured(loaded_dataset):
        presses = measured_presses_of(loaded_dataset)
        sensor_name = loaded_dataset.sensor.name
        pressing_probes = set(map(str, loaded_dataset.samples.probe))
    if presses is not None:
        version_folder = check_target(output, version, presses.electrodes)
        train = partial(fit_presses, presses, sensor_name, fit_config, probes=tuple(sorted(pressing_probes)))
        train_and_release(train, version_folder, json=json)
        return

    # A dataset folder or --sensor alone: train a network on the dataset, or on presses that are simulated here.
    if sensor is not None:
        # Refuse an unsuitable model folder before the simulation, which takes a while.
        check_target(output, version, load_sensor(sensor).electrode_names)
    with shown_progress():
        data = _prepare_data(loaded_dataset, sensor, notations, radius)
    version_folder = check_target(output, version, data.sensor.electrode_names)
    train_and_release(partial(fit, data, fit_config), version_folder, json=json)


def _refuse_options(context: typer.Context, names: Sequence[str], reason: str) -> None:
    """Raise an error if one of the options is given, because it would have no effect.

    Args:
        context: The command with its arguments.
        names: Names of the function's arguments to which the options belong.
        reason: End of a sentence that begins with the option.

    Raises:
        InputError: If an option is given.
    """
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in names and source is not None and source.name == "COMMANDLINE":
            raise InputError(f"{parameter.opts[0]}: {reason}; leave the option out")


def _is_sensor(argument: Path) -> bool:
    """Return whether an argument is the name of a built-in sensor or a sensor file, and not a dataset or presses."""
    is_built_in = str(argument) in built_in_sensors() and not argument.exists()
    return is_built_in or argument.suffix.lower() == ".toml"


def _prepare_data(dataset: Dataset | None, sensor: str | None, notations: list[str], radius: str) -> TrainingData:
    """Convert a simulated dataset to training data, or simulate training data for a sensor.

    Args:
        dataset: The dataset; None to simulate presses.
        sensor: Name or file of the sensor; None to use the dataset.
        notations: Notations of the probes of the simulated presses.
        radius: Largest distance of the simulated presses from the centre: a number of mm, or "auto".

    Raises:
        InputError: If neither the dataset nor the sensor is given.
    """
    if dataset is not None:
        data = TrainingData.of(dataset)
        if data.yield_force_N is not None:
            say(f"caution: PVDF yields beyond {data.yield_force_N:g} N, and a dent stays")
        return data
    if sensor is None:
        raise InputError("expected either a DATASET folder or a SENSOR, got neither")
    described_sensor = load_sensor(sensor)
    probes = [parse_probe(notation) for notation in notations]
    warn_of_stress(described_sensor.film, probes, DEFAULT_FORCE_RANGE[1])
    radius_mm = sweep_radius(radius, described_sensor, probes, DEFAULT_FORCE_RANGE)
    return TrainingData.of(simulated_presses(described_sensor, probes, radius_mm, DEFAULT_FORCE_RANGE))


def _read_presses_of_unknown_sensor(file: Path, position_std_mm: float, force_std: float) -> MeasuredPresses:
    """Read the measured presses of a sensor without a description, and print which columns are its channels.

    Args:
        file: CSV file of the presses.
        position_std_mm: Standard deviation of the positions if the file contains none, mm.
        force_std: Relative standard deviation of the forces if the file contains none.

    Raises:
        PressError: If the file cannot be read.
    """
    presses = read_press_file(file, None, position_std_mm, force_std)
    say(f"{file}: {len(presses)} presses of the channels {', '.join(presses.electrodes)}")
    return presses


def train_and_release(train: Callable[[], Fitted], version_folder: Path, *, json: bool) -> None:
    """Train a network, release it as a version folder, and print its errors.

    Args:
        train: Function that trains the network.
        version_folder: Folder to write, as `check_target` returned it.
        json: Whether to print the folder and the errors as one JSON object, too.
    """
    with shown_progress():
        released = release(train(), version_folder.parent, version=int(version_folder.name), command=this_command())
    if json:
        show_json({"folder": str(released.folder), "errors": dict(released.metadata.errors)})
    say(f"{released.folder}: {_errors_sentence(released.metadata)}")


def _errors_sentence(metadata: ModelMetadata) -> str:
    """Return a sentence that states the errors of a model."""
    errors = metadata.errors
    force_words = "the force is not estimated"
    if "force_rms_percent" in errors:
        force_words = f"force {errors['force_rms_percent']:g} % rms"
    press_count = errors.get("measured_presses")
    condition = f"on {press_count:.0f} measured presses at places that were left out, " if press_count else ""
    return (
        f"{condition}position error {errors['position_median_mm']:g} mm median, "
        f"{errors['position_rms_mm']:g} mm rms, {errors['position_p95_mm']:g} mm at 95 %; "
        f"{force_words}"
    )
