"""`isocharge train fit`: make a model from a dataset, from measured presses, or from the description of a sensor."""

import shlex
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Annotated

import typer

from isocharge.cli.shared.forward_maps import (
    DEFAULT_PROBE,
    ProbesOption,
    simulated_presses,
    solving_executor,
    sweep_radius,
    warn_of_stress,
)
from isocharge.cli.shared.options import ForceStdOption, JsonOption, PositionStdOption, RadiusOption
from isocharge.cli.shared.terminal import say, show_result, shown_progress, this_command
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError, ModelError, OutputError, OutputExists
from isocharge.serve import read_presses
from isocharge.serve.model.model_folder import check_target
from isocharge.simulate import Sensor, load_sensor, parse_probe, read_dataset
from isocharge.train import FitConfig, Fitted, TrainingConfig, TrainingData, fit, fit_presses, load_config, release
from isocharge.train.data.channel_noise import misfit_noise
from isocharge.train.model_release.release import Release


def fit_command(
    context: typer.Context,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="models/NAME",
            help="Folder of the model. The name of the folder becomes the name of the model.",
        ),
    ],
    dataset: Annotated[
        Path | None,
        typer.Argument(
            metavar="DATASET|PRESSES.csv",
            help="A dataset folder of `isocharge simulate sweep`, or a CSV file of measured presses with the columns "
            "x_mm, y_mm, force_N and the names of the channels (pC). The file needs 500 or more presses. (default: "
            "--sensor)",
        ),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            metavar="SENSOR",
            help="Name of a built-in sensor or a TOML file. 24,000 presses from 0.05 to 2 N are simulated on this "
            "sensor, and 96,000 if it has more than four electrodes. (default: the sensor of DATASET)",
        ),
    ] = None,
    probe: ProbesOption = None,
    radius: RadiusOption = f"{DEFAULT_RADIUS}",
    position_std_mm: PositionStdOption = 0.1,
    force_std: ForceStdOption = 0.01,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Training settings, TOML. (default: those of train/configs/default.toml)"),
    ] = None,
    version: Annotated[
        int, typer.Option(min=1, help="Version of the model, which is the name of the folder in models/NAME.")
    ] = 1,
    json: JsonOption = False,
) -> None:
    """Train a network on charges, measure its errors, and write a model folder: ONNX file, card, golden vectors.

    The presses come from DATASET. With --sensor, presses are simulated first. The option --probe states the probes of
    the simulated presses, and --radius states their largest distance from the centre.

    With measured presses, a network is trained on the presses alone. Any sensor with 3 to 32 channels is
    possible. Each column of the file whose name has no other meaning is a channel. The errors are measured by
    cross-validation, in which all presses at a place are left out together. If a sensor file describes the film,
    `isocharge train calibrate` needs far fewer presses.

    Example: isocharge train fit --sensor three-25um-biaxial -o models/three-25um-biaxial

    Example: isocharge train fit presses.csv -o models/pad
    """
    if dataset is not None and (dataset.suffix == ".toml" or not dataset.exists()):
        raise InputError(
            f"{dataset}: expected a dataset folder or a file of measured presses; there is neither. The option "
            "--sensor names a sensor"
        )
    if dataset is not None and sensor is not None:
        if dataset.is_dir():
            raise InputError("expected either a DATASET folder or --sensor SENSOR, got both; leave one of them out")
        raise InputError(
            f"{dataset}: measured presses of a sensor with a sensor file calibrate its film; use `isocharge train "
            f"calibrate {shlex.quote(str(dataset))} --sensor {sensor} -o {shlex.quote(str(output))}`, or leave "
            "--sensor out to train a network on the presses alone"
        )

    fit_config = load_config(config) if config else FitConfig()
    train: Callable[[FitConfig], Fitted]
    if sensor is not None:
        _refuse_options(context, "simulated presses", "probe", "radius")
        described_sensor = load_sensor(sensor)
        electrodes = described_sensor.electrode_names
        train = partial(_fit_simulated_presses, described_sensor, probe or [DEFAULT_PROBE], radius)
    elif dataset is None:
        raise InputError("expected either a DATASET folder or --sensor SENSOR, got neither")
    elif dataset.is_dir():
        _refuse_options(context, "a dataset folder")
        training_data = TrainingData.of(read_dataset(dataset))
        electrodes = training_data.sensor.electrode_names
        if training_data.yield_force_N is not None:
            say(f"caution: PVDF yields beyond {training_data.yield_force_N:g} N at the centre, and a dent stays")
        train = partial(fit, training_data)
    else:  # a file or a pipe
        _refuse_options(context, "measured presses", "probe", "position_std_mm", "force_std")
        _refuse_settings(config, fit_config)
        presses = read_presses(dataset, position_std_mm=position_std_mm, force_std=force_std)
        electrodes = presses.electrodes
        say(f"{dataset}: {len(presses)} presses of the channels {', '.join(electrodes)}")
        sensor_name = output.resolve().name  # this sensor has no other name than that of the model
        train = partial(fit_presses, presses, sensor_name, probes=tuple(sorted(set(probe or ["unknown"]))))

    check_target(output, version, electrodes)
    with shown_progress():
        fitted = train(fit_config)
        released = _release(fitted, output, version)
    show_result({"folder": str(released.folder), "errors": released.metadata.errors}, json=json)


def _refuse_options(context: typer.Context, source: str, *used_options: str) -> None:
    """Raise an error if an option is given that has no effect on the presses.

    Args:
        context: The command with its arguments.
        source: Description of the presses, for the error message.
        *used_options: Parameters of the command that have an effect on the presses. All other parameters that describe
            presses are refused.

    Raises:
        InputError: If an option without an effect is given.
    """
    without_effect = {"probe", "radius", "position_std_mm", "force_std"} - {*used_options}
    for parameter in context.command.params:
        origin = context.get_parameter_source(parameter.name or "")  # whether the value was typed, or is the default
        if parameter.name in without_effect and origin is not None and origin.name == "COMMANDLINE":
            raise InputError(f"{parameter.opts[0]}: has no effect on {source}; leave the option out")


def _refuse_settings(path: Path | None, config: FitConfig) -> None:
    """Raise an error if a configuration file contains a setting that has no effect on measured presses.

    Args:
        path: The file; None for the default settings.
        config: Settings from the file, or the default settings.

    Raises:
        InputError: If the file contains a setting without an effect.
    """
    for setting in ("noise", "hold_out"):
        if getattr(config.training, setting) != getattr(TrainingConfig(), setting):
            raise InputError(
                f"{path}: training.{setting} has no effect on measured presses, whose noise is estimated, and whose "
                "errors are measured by cross-validation; leave it out"
            )


def _release(fitted: Fitted, model_folder: Path, version: int) -> Release:
    """Write a trained network as a version of a model.

    If the version cannot be written to the folder of the model, the version is written to a new temporary folder. For
    example, the disk may be full, or another process may have written this version during the training.

    Args:
        fitted: The network.
        model_folder: Folder of the model.
        version: Number of the version.

    Raises:
        IsochargeError: If the version cannot be written to the folder of the model. The message names the temporary
            folder.
    """
    write = partial(release, fitted, version=version, command=this_command())  # takes the folder of the model
    try:
        return write(model_folder)
    except (OutputExists, OutputError, ModelError) as error:
        temporary = write(Path(mkdtemp(prefix="isocharge-"), model_folder.resolve().name))
        # Raise an error of the same class with a longer message.
        raise type(error)(f"{error}. The trained model is kept in {temporary.folder}") from error


def _fit_simulated_presses(sensor: Sensor, notations: Sequence[str], radius: str, config: FitConfig) -> Fitted:
    """Train a network on presses that are simulated on a sensor.

    Args:
        sensor: The sensor.
        notations: Notations of the probes.
        radius: Largest distance of a press from the centre: a text with a number of mm, or "auto".
        config: Training settings.
    """
    probes = [parse_probe(notation) for notation in notations]
    warn_of_stress(sensor.film, probes, DEFAULT_FORCE_RANGE[1])
    noise = misfit_noise(config.training.noise_model)  # for the radius "auto", which is that of the working area
    with solving_executor(sensor.film) as executor:
        radius_mm = sweep_radius(radius, sensor, probes, DEFAULT_FORCE_RANGE, executor, noise)
        dataset = simulated_presses(sensor, probes, radius_mm, executor)
    return fit(dataset, config)
