"""`isocharge train fit`: a dataset, or a sensor, to a model."""

import json as json_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.forward_maps import sweep_radius
from isocharge.cli.shared.options import PROBE_HELP, ConfigOption, FreshOption, RadiusOption
from isocharge.cli.shared.terminal import progress, say, this_command
from isocharge.default_scene import DEFAULT_RADIUS
from isocharge.errors import InputError
from isocharge.files import refuse_existing

if TYPE_CHECKING:
    from isocharge.simulate import Dataset
    from isocharge.train import Release

SAMPLES = 24_000
"""Number of presses that are simulated if no dataset is given."""


def fit_command(
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="models/NAME", help="Model folder; its name becomes the model's name."),
    ],
    dataset: Annotated[
        Path | None,
        typer.Argument(metavar="DATASET", help="Dataset folder of `isocharge simulate sweep`. (default: --sensor)"),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            metavar="SENSOR",
            help="Simulate 24,000 presses on this sensor instead, from 0.05 to 2 N; a built-in name or a TOML file. "
            "(default: DATASET)",
        ),
    ] = None,
    probe: Annotated[
        list[str] | None,
        typer.Option(
            "--probe", metavar="SHAPE", help=f"With --sensor: {PROBE_HELP} May be repeated. (default: circle:1.0)"
        ),
    ] = None,
    radius: RadiusOption = f"{1e3 * DEFAULT_RADIUS}",
    config: ConfigOption = None,
    version: Annotated[int, typer.Option("--version", min=1, help="Version of the model: the folder in NAME.")] = 1,
    fresh: FreshOption = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the folder and the measured errors as one JSON object. (default: no)")
    ] = False,
) -> None:
    """Train a network on charges, measure its errors, and write a model folder: ONNX file, card, golden vectors.

    The presses come from DATASET, or are simulated first: --probe and --radius say how, and belong to --sensor.

    A run that was stopped or killed leaves models/NAME/VERSION.part; the same command goes on from there and makes the
    same model.

    Example: isocharge train fit --sensor three-25um-biaxial -o models/three-25um-biaxial
    """
    if (dataset is None) == (sensor is None):
        raise InputError(f"expected either a DATASET folder or --sensor SENSOR, got {'both' if dataset else 'neither'}")
    from isocharge.train import load_config, train_model

    refuse_existing(output / str(version))
    settings = load_config(config) if config else None
    presses = _read(dataset) if dataset else _simulate(str(sensor), probe or ["circle:1.0"], radius)
    try:
        with progress("training") as advance:
            release = train_model(
                presses,
                output,
                settings,
                command=this_command(),
                version=version,
                fresh=fresh,
                progress=advance,
                warn=lambda message: say(f"caution: {message}"),
            )
    except KeyboardInterrupt:
        if (part := output / f"{version}.part").exists():
            say(f"stopped; what is done is kept in {part}, and the same command goes on from there")
        raise
    if json:
        typer.echo(json_module.dumps({"folder": str(release.folder), "errors": dict(release.metadata.errors)}))
    say(_summary(release))


def _read(folder: Path) -> "Dataset":
    from isocharge.simulate import read_dataset

    return read_dataset(folder)


def _simulate(sensor: str, probes: list[str], radius: str) -> "Dataset":
    """A sweep with its defaults, deleted once it is read; it takes a few seconds, so one process is enough."""
    from tempfile import TemporaryDirectory

    from isocharge.simulate import Sweep, SweepCallbacks, load_sensor, parse_probe, read_dataset, run_sweep

    film_sensor, pressing, forces = load_sensor(sensor), [parse_probe(text) for text in probes], Sweep().force_range
    reach = sweep_radius(radius, film_sensor, pressing, forces)
    with TemporaryDirectory() as folder, progress("solving the film") as advance:
        sweep = Sweep(reach, samples=SAMPLES)
        return read_dataset(
            run_sweep(Path(folder) / "presses", film_sensor, pressing, sweep, callbacks=SweepCallbacks(advance))
        )


def _summary(release: "Release") -> str:
    errors = release.metadata.errors
    return (
        f"{release.folder}: position error {errors['position_median_mm']:g} mm median, "
        f"{errors['position_rms_mm']:g} mm rms, {errors['position_p95_mm']:g} mm at 95 %; "
        f"force {errors['force_rms_percent']:g} % rms"
    )
