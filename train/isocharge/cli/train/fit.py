"""`isocharge train fit`: a dataset, measured presses, or a sensor, to a model."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from isocharge.cli.shared.forward_maps import shown_run, simulated_presses, sweep_radius, warn_of_stress
from isocharge.cli.shared.measured_presses import ForceStdOption, PositionStdOption, read_press_file
from isocharge.cli.shared.options import (
    ConfigOption,
    FreshOption,
    JsonOption,
    ModelsOption,
    RadiusOption,
    parse_radius_mm,
    refuse,
    worker_count,
)
from isocharge.cli.shared.terminal import say, show_json, shown_progress, this_command
from isocharge.cli.train.calibrate import calibrate_into
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError, ModelError, SceneError
from isocharge.common.resumable_run import ResumableRun, resume_parts
from isocharge.serve import MeasuredPresses
from isocharge.serve.model.model_folder import check_target
from isocharge.simulate import Circle, FilmPrior, load_sensor, local_workers, parse_probe, read_dataset
from isocharge.simulate.sensor.probe import PROBE_HELP
from isocharge.train import (
    CalibrationProblem,
    FilmsConfig,
    FilmsModel,
    FitConfig,
    Release,
    Rig,
    TrainingData,
    fit,
    fit_films,
    fit_presses,
    load_config,
    release,
    release_films,
    rig_data,
)
from isocharge.train.films.fit import films_identity
from isocharge.train.training.cross_fit import presses_identity, usable_presses
from isocharge.train.training.fit import fit_identity

Trained = TypeVar("Trained")
"""What training gives, and a release is made of."""

DEFAULT_TEXT = f"{DEFAULT_RADIUS}"
"""Radius of the working area where no other is asked for, mm."""

ModelFolderOption = Annotated[
    Path,
    typer.Option("--output", "-o", metavar="models/NAME", help="Model folder; its name becomes the model's name."),
]

VersionOption = Annotated[int, typer.Option("--version", min=1, help="Version of the model: the folder in NAME.")]


def fit_command(
    output: ModelFolderOption,
    dataset: Annotated[
        Path | None,
        typer.Argument(
            metavar="DATASET|PRESSES.csv",
            help="Dataset folder of `isocharge simulate sweep` or of measured presses; or a CSV file of measured "
            "presses, three or more with --sensor, 500 without: x_mm, y_mm, force_N and the electrodes' names (pC). "
            "(default: --sensor)",
        ),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            metavar="SENSOR",
            help="The sensor of PRESSES.csv; without a file, 24,000 presses are simulated on it, from 0.05 to 2 N; a "
            "built-in name or a TOML file. (default: DATASET's)",
        ),
    ] = None,
    probe: Annotated[
        list[str] | None,
        typer.Option(
            "--probe", metavar="SHAPE", help=f"With --sensor: {PROBE_HELP} May be repeated. (default: circle:1.0)"
        ),
    ] = None,
    radius: RadiusOption = DEFAULT_TEXT,
    films: Annotated[
        bool,
        typer.Option(
            "--films",
            help="With --sensor: train one network for every film that the sensor may be, for `isocharge train "
            "calibrate`; some 20 minutes on 2 cores. (default: the film as described)",
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

    The presses come from DATASET, or are simulated first: --probe and --radius say how, and belong to --sensor.

    From measured presses with --sensor the film is calibrated, as by `isocharge train calibrate`. If no network for all
    films fits the sensor, the presses correct the sensor as described, and a fifth of them is held out for the errors.
    Without --sensor the presses alone are learned, of any sensor with three to eight channels: every other column is
    one. Their errors are of networks that left out the presses' places.

    With --films the sensor's film is not taken as described: pretension, stiffness, coefficients, gains and the place
    of the electrodes are drawn as they spread between films, and the folder also gets films.npz, the network for all of
    them.

    A run that was stopped or killed leaves models/NAME/VERSION.part; the same command goes on from there and makes the
    same model.

    Example: isocharge train fit --sensor three-25um-biaxial -o models/three-25um-biaxial

    Example: isocharge train fit presses.csv --sensor four-25um-biaxial -o models/rig

    Example: isocharge train fit presses.csv -o models/pad
    """
    probes = probe or ["circle:1.0"]
    if films:
        prior, sizes = _films(dataset, sensor, probes, radius, config)
        target = check_target(output, version, prior.sensor.electrode_names)
        warn_of_stress(prior.sensor.film, [prior.probe], sizes.force_range[1])

        def train_films(run: ResumableRun) -> FilmsModel:
            with local_workers(worker_count(None)) as executor:
                return fit_films(prior, sizes, executor=executor, run=run)

        identity = films_identity(prior, sizes)
        release_resumably(train_films, identity, target, release_films, fresh=fresh, json=json)
        return
    if sensor and not (dataset and dataset.is_file()):  # before anything is simulated
        check_target(output, version, load_sensor(sensor).electrode_names)
    settings = load_config(config) if config else FitConfig()
    if dataset and dataset.is_file() and not sensor:
        presses = _measured(dataset, radius, (position_std_mm, force_std))
        target = check_target(output, version, presses.electrodes)
        train = partial(fit_presses, presses, output.resolve().name, settings, probes=tuple(probe or ["unknown"]))
        release_resumably(
            lambda run: train(run=run), presses_identity(presses, settings), target, release, fresh=fresh, json=json
        )
        return
    rig = None
    if dataset and not dataset.is_dir():
        rig = _rig(dataset, sensor, probes, radius, (position_std_mm, force_std))
        problem = calibration_problem(rig, models)
        if problem is not None:
            refuse_training_options(config, version, radius)
            calibrate_into(rig.presses, problem, output, json=json)
            return
    with shown_progress():
        if rig is not None:
            data = rig_data(rig, seed=settings.training.seed)
        else:
            data = _presses(dataset, sensor, probes, radius)
    target = check_target(output, version, data.sensor.electrode_names)
    warn_of_stress(data.sensor.film, map(parse_probe, data.probes), data.domain.force_range[1])
    identity = fit_identity(data, settings)
    release_resumably(lambda run: fit(data, settings, run=run), identity, target, release, fresh=fresh, json=json)


UNSEEN = "that training never saw"
"""What is said of measured presses that were held out."""


def _presses(dataset: Path | None, sensor: str | None, probes: list[str], radius: str) -> TrainingData:
    """A dataset, read or simulated."""
    if dataset and not sensor:
        return TrainingData.of(read_dataset(dataset))
    if dataset or not sensor:
        raise InputError(f"expected either a DATASET folder or --sensor SENSOR, got {'both' if dataset else 'neither'}")
    film_sensor, pressing, forces = load_sensor(sensor), [parse_probe(text) for text in probes], DEFAULT_FORCE_RANGE
    reach = sweep_radius(radius, film_sensor, pressing, forces)
    return TrainingData.of(simulated_presses(film_sensor, pressing, reach, forces))


def _measured(file: Path, radius: str, stds: tuple[float, float]) -> MeasuredPresses:
    """Measured presses of any sensor; the columns that are taken for channels are said."""
    refuse({"--radius: belongs to --sensor; without it, the area is where the presses are": radius != DEFAULT_TEXT})
    presses = usable_presses(read_press_file(file, None, *stds))
    say(f"{file}: {len(presses)} presses of the channels {', '.join(presses.electrodes)}")
    return presses


def _rig(file: Path, sensor: str | None, probes: list[str], radius: str, stds: tuple[float, float]) -> Rig:
    """Measured presses of a file."""
    refuse(
        {
            f"{file}: expected a dataset folder, or a CSV file of measured presses; there is neither": (
                not file.exists()
            ),
            "--radius: expected a number of mm with measured presses, got auto": radius == "auto",
            f"--probe: expected the one that made the presses, got {', '.join(probes)}": len(probes) != 1,
        }
    )
    described = load_sensor(str(sensor))
    presses = read_press_file(file, described.electrode_names, *stds)
    return Rig(presses, described, parse_probe(probes[0]), parse_radius_mm(radius))


def calibration_problem(rig: Rig, models: Path | None) -> CalibrationProblem | None:
    """Return how to calibrate the film of measured presses; None, with a warning, if no network for all films fits.

    Args:
        rig: The presses, the sensor and the probe.
        models: Folder of models that is searched first.
    """
    try:
        return CalibrationProblem.of(rig.sensor, rig.probe, models)
    except (ModelError, SceneError) as error:
        say(f"caution: the film is not calibrated, and the presses correct the sensor as described: {error}")
        return None


def refuse_training_options(config: Path | None, version: int, radius: str) -> None:
    """Refuse options that have no meaning if the film is calibrated, because no network is trained then."""
    refuse(
        {
            "--config: this film is calibrated by the presses, and no network is trained; leave it out": config,
            "--version: each calibration is the next version in its folder; leave it out": version != 1,
            "--radius: the model of a calibrated film has the working area of the network for all films; leave it "
            "out": radius != DEFAULT_TEXT,
        }
    )


def _films(
    dataset: Path | None, sensor: str | None, probes: list[str], radius: str, config: Path | None
) -> tuple[FilmPrior, FilmsConfig]:
    """The films that a sensor may be, and how a network for all of them is fitted."""
    refuse(
        {
            "--films: expected --sensor SENSOR alone, got presses, which are of one film": dataset,
            "--films: expected no --config: its settings are for one film; leave it out": config,
            "expected either a DATASET folder or --sensor SENSOR, got neither": not sensor,
            "--films: expected --radius in mm, got auto: the working area differs from film to film": radius == "auto",
        }
    )
    probe = parse_probe(probes[0])
    if len(probes) != 1 or not isinstance(probe, Circle):
        raise InputError(f"--films: expected one round probe (circle:RADIUS), got {', '.join(probes)}")
    return FilmPrior(load_sensor(str(sensor)), probe), FilmsConfig(radius=parse_radius_mm(radius))


def release_resumably(
    train: Callable[[ResumableRun], Trained],
    identity: Mapping[str, Any],
    target: Path,
    release: Callable[..., Release],
    *,
    fresh: bool,
    json: bool,
) -> None:
    """Fit into a version folder and print the errors; stopped, say how to go on.

    Args:
        train: The work; it keeps its state in the run.
        identity: All that decides about the weights.
        target: The version folder.
        release: Writes what `train` gives.
        fresh: Throw away what an earlier run left.
        json: Print the folder and the errors as one JSON object.
    """
    with shown_run(target), resume_parts(target, identity, fresh=fresh) as run:
        made = release(train(run), target.parent, version=int(target.name), command=this_command())
    errors = made.metadata.errors
    if json:
        show_json({"folder": str(made.folder), "errors": dict(errors)})
    measured = errors.get("measured_presses")
    unseen = "at places that were left out" if "folds" in made.metadata.made_with.get("measured", {}) else UNSEEN
    presses = f"on {measured:.0f} measured presses {unseen}, " if measured else ""
    say(
        f"{made.folder}: {presses}position error {errors['position_median_mm']:g} mm median, "
        f"{errors['position_rms_mm']:g} mm rms, {errors['position_p95_mm']:g} mm at 95 %; "
        f"force {errors['force_rms_percent']:g} % rms"
    )
