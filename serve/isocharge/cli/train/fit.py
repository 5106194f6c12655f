"""`isocharge train fit`: a dataset, or a sensor, to a model."""

import json as json_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.options import PROBE_HELP, auto_radius, number_mm
from isocharge.cli.shared.terminal import progress, say, this_command
from isocharge.default_scene import DEFAULT_RADIUS
from isocharge.errors import InputError
from isocharge.files import refuse_existing

if TYPE_CHECKING:
    from isocharge.simulate import Dataset
    from isocharge.train import Release

SAMPLES = 24_000
"""Presses that are simulated where no dataset is given."""


def fit_command(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="models/NAME", help="Model folder; its name is the model's.")
    ],
    dataset: Annotated[
        Path | None, typer.Argument(metavar="[DATASET]", help="Dataset folder, as `simulate sweep` makes it.")
    ] = None,
    sensor: Annotated[
        str | None, typer.Option("--sensor", help="Simulate 24,000 presses on this sensor instead, 0.05 to 2 N.")
    ] = None,
    probe: Annotated[
        list[str] | None,
        typer.Option("--probe", help=f"With --sensor: {PROBE_HELP} May be given again. (default: circle:1.0)"),
    ] = None,
    radius: Annotated[
        str,
        typer.Option(
            "--radius",
            metavar="MM|auto",
            help="With --sensor: largest distance from the centre, mm, or auto.",
        ),
    ] = f"{1e3 * DEFAULT_RADIUS}",
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Training configuration, TOML. (default: built in)")
    ] = None,
    version: Annotated[int, typer.Option("--version", min=1, help="Number of the version folder to make.")] = 1,
    fresh: Annotated[bool, typer.Option("--fresh", help="Throw away what a stopped run left.")] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON object: folder and measured errors.")] = False,
) -> None:
    """Train a network, export it as ONNX, measure it, and write the model folder with its card.

    A run that was stopped or killed leaves models/NAME/VERSION.part; the same command goes on from there and makes the
    same model.

    Example: isocharge train fit --sensor three-25um-biaxial -o models/three-25um-biaxial
    """
    if (dataset is None) == (sensor is None):
        raise InputError("train fit: expected either a DATASET folder or --sensor SENSOR, not both and not neither")
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
                warn=lambda words: say(f"caution: {words}"),
            )
    except KeyboardInterrupt:
        if (part := output / f"{version}.part").exists():
            say(f"stopped; what is done is kept in {part}, and the same command goes on")
        raise
    if json:
        typer.echo(json_module.dumps({"folder": str(release.folder), "errors": dict(release.metadata.errors)}))
    say(_summary(release))


def _read(folder: Path) -> "Dataset":
    from isocharge.simulate import read_dataset

    return read_dataset(folder)


def _simulate(sensor: str, probes: list[str], radius: str) -> "Dataset":
    """A sweep with its defaults, kept only as long as it is needed; a few seconds, so in this process."""
    from tempfile import TemporaryDirectory

    from isocharge.simulate import Sweep, SweepCallbacks, load_sensor, parse_probe, read_dataset, run_sweep

    film_sensor, pressing, forces = load_sensor(sensor), [parse_probe(text) for text in probes], Sweep().force_range
    reach = auto_radius(film_sensor, pressing, forces) if radius == "auto" else 1e-3 * number_mm(radius)
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
