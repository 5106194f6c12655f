"""`isocharge train fit`: a dataset, or a sensor, to a model."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.shared.forward_maps import sweep_radius
from isocharge.cli.shared.measured_presses import (
    ForceStdOption,
    ModelsOption,
    PositionStdOption,
    films_or_none,
    read_presses_of,
)
from isocharge.cli.shared.options import PROBE_HELP, ConfigOption, FreshOption, RadiusOption, radius_mm_of
from isocharge.cli.shared.simulated_presses import simulated_presses
from isocharge.cli.shared.training_run import train_and_say
from isocharge.common.defaults import DEFAULT_RADIUS
from isocharge.common.errors import InputError
from isocharge.common.files import refuse_existing

if TYPE_CHECKING:
    from isocharge.simulate import Dataset
    from isocharge.train import Release


def fit_command(
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="models/NAME", help="Model folder; its name becomes the model's name."),
    ],
    dataset: Annotated[
        Path | None,
        typer.Argument(
            metavar="DATASET|PRESSES.csv",
            help="Dataset folder of `isocharge simulate sweep` or of measured presses; or with --sensor a CSV file of "
            "50 measured presses or more: x_mm, y_mm, force_N and the electrodes' names (pC). (default: --sensor)",
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
    radius: RadiusOption = f"{1e3 * DEFAULT_RADIUS}",
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
    version: Annotated[int, typer.Option("--version", min=1, help="Version of the model: the folder in NAME.")] = 1,
    fresh: FreshOption = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the folder and the measured errors as one JSON object. (default: no)")
    ] = False,
) -> None:
    """Train a network on charges, measure its errors, and write a model folder: ONNX file, card, golden vectors.

    The presses come from DATASET, or are simulated first: --probe and --radius say how, and belong to --sensor.

    From measured presses the film is calibrated, what is then still wrong everywhere is corrected, and a fifth is held
    out: the errors are of those presses as measured.

    With --films the sensor's film is not taken as described: pretension, stiffness, coefficients, gains and the place
    of the electrodes are drawn as they spread between films, and the folder also gets films.npz, the network for all of
    them.

    A run that was stopped or killed leaves models/NAME/VERSION.part; the same command goes on from there and makes the
    same model.

    Example: isocharge train fit --sensor three-25um-biaxial -o models/three-25um-biaxial

    Example: isocharge train fit presses.csv --sensor four-25um-biaxial -o models/rig
    """
    measured = dataset is not None and not dataset.is_dir()
    if films:
        _refuse_with_films(dataset, config)
    _check_source(dataset, sensor, measured)
    refuse_existing(output / str(version))
    if films:
        train = _train_films(str(sensor), probe or ["circle:1.0"], radius)
    elif dataset and measured:
        stds = position_std_mm, force_std
        train = _train_on_measured(dataset, str(sensor), probe or ["circle:1.0"], radius, stds, models, config)
    else:
        train = _train_on_presses(dataset, sensor, probe or ["circle:1.0"], radius, config)
    train_and_say(train, output, version, fresh=fresh, json=json)


def _check_source(dataset: Path | None, sensor: str | None, measured: bool) -> None:
    if measured and dataset and not dataset.exists():
        raise InputError(f"{dataset}: expected a dataset folder, or a CSV file of measured presses; there is neither")
    if measured and sensor is None:
        raise InputError(f"{dataset}: a file of measured presses needs --sensor SENSOR, which says what was pressed")
    if not measured and (dataset is None) == (sensor is None):
        raise InputError(f"expected either a DATASET folder or --sensor SENSOR, got {'both' if dataset else 'neither'}")


def _train_on_measured(
    file: Path,
    sensor: str,
    probes: list[str],
    radius: str,
    stds: tuple[float, float],
    models: Path | None,
    config: Path | None,
) -> "Callable[..., Release]":
    """Trains on a file of measured presses."""
    from isocharge.simulate import load_sensor, parse_probe
    from isocharge.train import Rig, load_config, train_rig

    if radius == "auto":
        raise InputError("--radius: expected a number of mm with measured presses, got auto")
    if len(probes) != 1:
        raise InputError(f"--probe: expected the one that made the presses, got {', '.join(probes)}")
    described = load_sensor(sensor)
    presses = read_presses_of(file, described.electrode_names, *stds)
    rig = Rig(presses, described, parse_probe(probes[0]), 1e-3 * radius_mm_of(radius))
    settings = load_config(config) if config else None
    return partial(train_rig, rig, films_or_none(sensor, probes[0], models), config=settings)


def _train_on_presses(
    dataset: Path | None, sensor: str | None, probes: list[str], radius: str, config: Path | None
) -> "Callable[..., Release]":
    """Trains on a dataset, read or simulated."""
    from isocharge.train import load_config, train_model

    settings = load_config(config) if config else None
    presses = _read(dataset) if dataset else _simulate(str(sensor), probes, radius)
    return partial(train_model, presses, config=settings)


def _refuse_with_films(dataset: Path | None, config: Path | None) -> None:
    if dataset:
        raise InputError("--films: expected --sensor SENSOR alone, got presses, which are of one film")
    if config:
        raise InputError("--films: expected no --config: its settings are for one film; leave it out")


def _train_films(sensor: str, probes: list[str], radius: str) -> "Callable[..., Release]":
    """Trains on the films that a sensor may be, in a process for each core."""
    from isocharge.simulate import Circle, FilmPrior, load_sensor, parse_probe
    from isocharge.train import FilmsConfig

    if radius == "auto":
        raise InputError("--films: expected --radius in mm, got auto: the working area differs from film to film")
    pressing = [parse_probe(text) for text in probes]
    if len(pressing) != 1 or not isinstance(pressing[0], Circle):
        raise InputError(f"--films: expected one round probe (circle:RADIUS), got {', '.join(probes)}")
    prior, config = FilmPrior(load_sensor(sensor), pressing[0]), FilmsConfig(radius=1e-3 * radius_mm_of(radius))
    return partial(_train_films_with_workers, prior, config=config)


def _train_films_with_workers(*arguments: Any, **options: Any) -> "Release":
    from isocharge.simulate.execution.workers import cores, local_workers
    from isocharge.train import train_films

    with local_workers(cores()) as workers:
        return train_films(*arguments, **options, map_jobs=workers.in_order)


def _read(folder: Path) -> "Dataset":
    from isocharge.simulate import read_dataset

    return read_dataset(folder)


def _simulate(sensor: str, probes: list[str], radius: str) -> "Dataset":
    from isocharge.simulate import Sweep, load_sensor, parse_probe

    film_sensor, pressing, forces = load_sensor(sensor), [parse_probe(text) for text in probes], Sweep().force_range
    return simulated_presses(film_sensor, pressing, sweep_radius(radius, film_sensor, pressing, forces), forces)
