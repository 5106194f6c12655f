"""`isocharge train fit`: make a model from a dataset, from measured presses, or from the description of a sensor."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.forward_maps import simulated_presses, sweep_radius, warn_of_stress
from isocharge.cli.shared.measured_presses import ForceStdOption, PositionStdOption, read_press_file
from isocharge.cli.shared.options import (
    ConfigOption,
    FreshOption,
    JsonOption,
    ModelsOption,
    parse_radius_mm,
    worker_count,
)
from isocharge.cli.shared.terminal import say, shown_progress
from isocharge.cli.train.resumable_release import (
    ModelFolderOption,
    ReleaseOptions,
    VersionOption,
    train_and_release,
)
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError, ModelError, SceneError
from isocharge.common.resumable_run import ResumableRun
from isocharge.serve import MeasuredPresses
from isocharge.simulate import (
    Circle,
    FilmPrior,
    built_in_sensors,
    load_sensor,
    local_workers,
    parse_probe,
    read_dataset,
)
from isocharge.simulate.sensor.probe import PROBE_HELP
from isocharge.train import FitConfig, Fitted, TrainingData, fit, fit_presses, load_config, release
from isocharge.train.training.cross_fit import presses_identity, usable_presses
from isocharge.train.training.fit import fit_identity

if TYPE_CHECKING:  # these modules import the solver, which a training on a dataset does not need
    from isocharge.train import CalibrationProblem, FilmsModel, Rig

DEFAULT_PROBE = "circle:1.0"
"""Notation of the probe if `--probe` is not given."""

DEFAULT_RADIUS_TEXT = f"{DEFAULT_RADIUS}"
"""Value of `--radius` if the option is not given: the radius of the working area, mm, as text."""


def fit_command(
    output: ModelFolderOption,
    dataset: Annotated[
        Path | None,
        typer.Argument(
            metavar="DATASET|PRESSES.csv|SENSOR",
            help="A dataset folder of `isocharge simulate sweep` or of measured presses, or a CSV file of measured "
            "presses with the columns x_mm, y_mm, force_N and the names of the electrodes (pC). The file needs three "
            "or more presses with --sensor, 500 without. A SENSOR is the same as --sensor SENSOR alone. (default: "
            "--sensor)",
        ),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            metavar="SENSOR",
            help="Sensor of PRESSES.csv: the name of a built-in sensor or a TOML file. Without a file, 24,000 presses "
            "from 0.05 to 2 N are simulated on this sensor, and 96,000 if it has more than four electrodes. (default: "
            "the sensor of DATASET)",
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
            help="With --sensor: largest distance of a press from the film's centre, mm. With one film and no "
            "PRESSES.csv, also auto: the working area, where the charges determine the position to 1 mm.",
        ),
    ] = DEFAULT_RADIUS_TEXT,
    films: Annotated[
        bool,
        typer.Option(
            "--films",
            help="With --sensor: train one network for all films that the sensor may have, which `isocharge train "
            "calibrate` uses. This takes about seven minutes on 2 cores. (default: only the film as described)",
        ),
    ] = False,
    position_std_mm: PositionStdOption = 0.1,
    force_std: ForceStdOption = 0.01,
    models: ModelsOption = None,
    config: ConfigOption = None,
    version: VersionOption = 1,
    fresh: FreshOption = False,
    json: JsonOption = False,
) -> None:
    """Train a network on charges, measure its errors, and write a model folder: ONNX file, card, golden vectors.

    The presses come from DATASET. With a SENSOR and no DATASET, presses are simulated first. The option --probe states
    the probes of the simulated presses, and --radius states their largest distance from the centre.

    With measured presses and --sensor, the film is calibrated, as `isocharge train calibrate` does. If there is no
    network for all films of this sensor, the presses correct the simulated charges instead. In this case, a fifth of
    the presses is held out to measure the errors. With measured presses and no --sensor, a network is trained on the
    presses alone. Without --sensor, any sensor with three to eight channels is possible. Each column of the file whose
    name has no other meaning is a channel. The errors are measured by cross-validation, in which all presses at a place
    are left out together.

    With --films, the network is trained on many films. The pretension, stiffness, piezoelectric coefficients, gains and
    electrode positions of these films are drawn at random. With --films, the model folder also contains films.npz, the
    file of the network for all films.

    A run that was stopped leaves models/NAME/VERSION.part. The same command continues a stopped run and makes the same
    model.

    Example: isocharge train fit three-25um-biaxial -o models/three-25um-biaxial

    Example: isocharge train fit presses.csv --sensor four-25um-biaxial -o models/rig

    Example: isocharge train fit presses.csv -o models/pad
    """
    notations = probe or [DEFAULT_PROBE]
    options = ReleaseOptions(output, version, fresh=fresh, json=json)
    if dataset is not None and _is_sensor(dataset):
        if sensor is not None:
            raise InputError(f"expected one sensor, got {dataset} and --sensor {sensor}; leave one of them out")
        sensor = str(dataset)
        dataset = None

    # There are five cases, which depend on the given options and files.

    # Case 1, --films: train a network for all films.
    if films:
        film_prior = _film_prior(dataset, sensor, notations, radius, config)
        _release_films_model(film_prior, parse_radius_mm(radius), options)
        return

    press_file = dataset if dataset is not None and dataset.is_file() else None
    if sensor is not None and press_file is None:
        # Refuse an unsuitable model folder before the simulation, which takes a while.
        options.check_version_folder(load_sensor(sensor).electrode_names)
    fit_config = load_config(config) if config else FitConfig()

    # Case 2, a file of measured presses without --sensor: train a network on the presses alone.
    if press_file is not None and sensor is None:
        presses = _read_presses_of_unknown_sensor(press_file, radius, position_std_mm, force_std)
        pressing_probes = tuple(probe or ["unknown"])
        _release_presses_model(presses, pressing_probes, fit_config, options)
        return

    # A path that is no folder is a regular file, a pipe, or missing. `_read_rig` refuses a missing file.
    measured_file = dataset if dataset is not None and not dataset.is_dir() else None
    if measured_file is not None:
        rig = _read_rig(measured_file, sensor, notations, radius, position_std_mm, force_std)
        problem = calibration_problem(rig, models)  # None without a network for all films of this sensor

        # Case 3, measured presses with --sensor and a network for all films: calibrate the film.
        if problem is not None:
            from isocharge.cli.train.calibrate import calibrate_into

            refuse_training_options(config, version, radius)
            calibrate_into(rig.presses, problem, output, json=json)
            return

        # Case 4, the same without such a network: train a network on simulated charges that the presses correct.
        from isocharge.train import rig_data

        warn_of_stress(rig.sensor.film, [rig.probe], DEFAULT_FORCE_RANGE[1])
        with shown_progress():
            data = rig_data(rig, seed=fit_config.training.seed)
    else:
        # Case 5, a dataset folder or --sensor alone: train a network on the dataset, or on presses simulated here.
        with shown_progress():
            data = _read_or_simulate_data(dataset, sensor, notations, radius)
    _release_data_model(data, fit_config, options, dataset if measured_file is None else None)


def _is_sensor(argument: Path) -> bool:
    """Return whether an argument is the name of a built-in sensor or a sensor file, and not a dataset or presses."""
    is_built_in = str(argument) in built_in_sensors() and not argument.exists()
    return is_built_in or argument.suffix.lower() == ".toml"


def _release_films_model(film_prior: FilmPrior, radius_mm: float, options: ReleaseOptions) -> None:
    """Train a network for all films of a sensor, and release it.

    Args:
        film_prior: Distribution of the films.
        radius_mm: Radius of the working area, mm.
        options: Folder and version of the model.
    """
    from isocharge.train import FilmsConfig, fit_films, release_films
    from isocharge.train.films.fit import films_identity

    films_config = FilmsConfig(radius=radius_mm)
    version_folder = options.check_version_folder(film_prior.sensor.electrode_names)
    _, max_force = films_config.force_range
    warn_of_stress(film_prior.sensor.film, [film_prior.probe], max_force)

    def train(run: ResumableRun) -> "FilmsModel":
        """Train the network on all cores of this machine, and save the state of the training in the run."""
        with local_workers(worker_count(None)) as executor:
            return fit_films(film_prior, films_config, executor=executor, run=run)

    train_and_release(train, films_identity(film_prior, films_config), version_folder, options, release_films)


def _release_presses_model(
    presses: MeasuredPresses, notations: tuple[str, ...], fit_config: FitConfig, options: ReleaseOptions
) -> None:
    """Train a network on measured presses alone, and release it.

    Args:
        presses: Measured presses of a sensor without a description.
        notations: Notations of the probes, or "unknown".
        fit_config: Settings of the network and its training.
        options: Options of the command.
    """
    version_folder = options.check_version_folder(presses.electrodes)
    sensor_name = options.model_folder.resolve().name  # the sensor has no other name than that of the model

    def train(run: ResumableRun) -> Fitted:
        """Train the network, and save the state of the training in the run."""
        return fit_presses(presses, sensor_name, fit_config, probes=notations, run=run)

    train_and_release(train, presses_identity(presses, fit_config), version_folder, options, release)


def _release_data_model(
    data: TrainingData, fit_config: FitConfig, options: ReleaseOptions, dataset: Path | None
) -> None:
    """Train a network on the training data of a known sensor, and release it.

    Args:
        data: Presses of the sensor for training and test.
        fit_config: Settings of the training.
        options: Folder and version of the model.
        dataset: Dataset folder of the training data; None if there is none.
    """
    version_folder = options.check_version_folder(data.sensor.electrode_names)

    def train(run: ResumableRun) -> Fitted:
        """Train the network, and save the state of the training in the run."""
        return fit(data, fit_config, run=run)

    train_and_release(train, fit_identity(data, fit_config), version_folder, options, release, dataset)


def _read_or_simulate_data(dataset: Path | None, sensor: str | None, notations: list[str], radius: str) -> TrainingData:
    """Read training data from a dataset folder, or simulate training data for a sensor.

    Args:
        dataset: Dataset folder; None to simulate presses.
        sensor: Name or file of the sensor; None to read the dataset.
        notations: Notations of the probes of the simulated presses.
        radius: Largest distance of the simulated presses from the centre: a number of mm, or "auto".

    Raises:
        InputError: If both the dataset and the sensor are given, or neither.
    """
    if dataset is not None and sensor is not None:
        raise InputError("expected either a DATASET folder or --sensor SENSOR, got both; leave one of them out")
    if dataset is not None:
        data = TrainingData.of(read_dataset(dataset))
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


def _read_presses_of_unknown_sensor(
    file: Path, radius: str, position_std_mm: float, force_std: float
) -> MeasuredPresses:
    """Read the measured presses of a sensor without a description, and print which columns are its channels.

    Args:
        file: CSV file of the presses.
        radius: Value of `--radius`, which must be the default.
        position_std_mm: Standard deviation of the positions if the file contains none, mm.
        force_std: Relative standard deviation of the forces if the file contains none.

    Raises:
        InputError: If `--radius` is given.
        PressError: If the presses are too few or not usable.
    """
    if radius != DEFAULT_RADIUS_TEXT:
        raise InputError(
            f"--radius: belongs to --sensor, got {radius} without --sensor; leave it out, because the working area is "
            "then the area of the presses"
        )
    presses = usable_presses(read_press_file(file, None, position_std_mm, force_std))
    say(f"{file}: {len(presses)} presses of the channels {', '.join(presses.electrodes)}")
    return presses


def _read_rig(
    file: Path, sensor: str | None, notations: list[str], radius: str, position_std_mm: float, force_std: float
) -> "Rig":
    """Read presses that were measured with a sensor for which a sensor file exists.

    Args:
        file: CSV file of the presses.
        sensor: Name or file of the sensor.
        notations: Notations of the probes; exactly one.
        radius: Radius of the working area: a number of mm.
        position_std_mm: Standard deviation of the positions if the file contains none, mm.
        force_std: Relative standard deviation of the forces if the file contains none.

    Raises:
        InputError: If the file or the sensor is missing, the radius is "auto", or there are several probes.
        PressError: If the file cannot be read.
    """
    if not file.exists():
        raise InputError(f"{file}: expected a dataset folder, or a CSV file of measured presses; there is neither")
    if sensor is None:  # the file is then a pipe, because `fit_command` handles a regular file without a sensor
        raise InputError(
            f"{file}: expected --sensor SENSOR for presses that are not in a regular file, got no sensor; add this "
            "option"
        )
    if radius == "auto":
        raise InputError("--radius: expected a number of mm with measured presses, got auto")
    if len(notations) != 1:
        raise InputError(f"--probe: expected the one probe that made the presses, got {', '.join(notations)}")
    (notation,) = notations
    described_sensor = load_sensor(sensor)
    presses = read_press_file(file, described_sensor.electrode_names, position_std_mm, force_std)
    from isocharge.train import Rig

    return Rig(presses, described_sensor, parse_probe(notation), parse_radius_mm(radius))


def calibration_problem(rig: "Rig", models: Path | None) -> "CalibrationProblem | None":
    """Return the calibration problem of the film on which measured presses were made.

    Args:
        rig: The presses, the sensor and the probe.
        models: Folder of models that is searched first.

    Returns:
        The calibration problem. None, with a warning on the terminal, if no network for all films fits the sensor.
    """
    from isocharge.train import CalibrationProblem

    try:
        return CalibrationProblem.of(rig.sensor, rig.probe, models)
    except (ModelError, SceneError) as error:
        say(f"caution: the film is not calibrated, and the presses correct the sensor as described: {error}")
        return None


def refuse_training_options(config: Path | None, version: int, radius: str) -> None:
    """Raise an error if an option for the training of a network is given, although the presses only calibrate a film.

    Args:
        config: File with training settings; None if the option was not given.
        version: Version of the model; 1 if the option was not given.
        radius: Radius of the working area; the default text if the option was not given.

    Raises:
        InputError: If one of the options is given.
    """
    # Each option is compared with its default, because Typer does not show whether the user gave the option.
    if config is not None:
        raise InputError(
            "--config: the presses calibrate this film and no network is trained, so training settings have no effect, "
            f"got {config}; leave the option out"
        )
    if version != 1:
        raise InputError(
            f"--version: each calibration is the next version in its folder, got {version}; leave the option out"
        )
    if radius != DEFAULT_RADIUS_TEXT:
        raise InputError(
            "--radius: the model of a calibrated film has the working area of the network for all films, got "
            f"{radius}; leave the option out"
        )


def _film_prior(
    dataset: Path | None, sensor: str | None, notations: list[str], radius: str, config: Path | None
) -> FilmPrior:
    """Check the options of a training with `--films`, and return the distribution of the films of the sensor.

    With the option `--films`, the command trains a network for all films of a sensor.

    Args:
        dataset: Dataset or file of presses, which must be None.
        sensor: Name or file of the sensor, which must be given.
        notations: Notations of the probes; exactly one, which must be round.
        radius: Radius of the working area, which must be a number of mm.
        config: File with settings of the training, which must be None.

    Raises:
        InputError: If an option does not fit `--films`.
    """
    if dataset is not None:
        raise InputError(
            f"--films: expected --sensor SENSOR alone, got presses ({dataset}), which belong to a single film; leave "
            "them out"
        )
    if config is not None:
        raise InputError(
            f"--films: expected no --config, got {config}, whose settings are for a single film; leave it out"
        )
    if sensor is None:
        raise InputError("expected either a DATASET folder or a SENSOR, got neither; --films needs a SENSOR")
    if radius == "auto":
        raise InputError(
            "--films: expected --radius in mm, got auto, which is different for each film; give a number of mm"
        )
    first_probe = parse_probe(notations[0])
    if len(notations) != 1 or not isinstance(first_probe, Circle):
        raise InputError(f"--films: expected one probe circle:RADIUS, got {', '.join(notations)}")
    return FilmPrior(load_sensor(sensor), first_probe)
