"""`isocharge train ...`: a dataset, or a sensor, to a model."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.report import report_command
from isocharge.cli.terminal import progress, say, this_command
from isocharge.errors import InputError
from isocharge.files import refuse_existing

if TYPE_CHECKING:
    from isocharge.simulate import Dataset
    from isocharge.train import Release

train_app = typer.Typer(no_args_is_help=True, help="From a dataset to a model.")
train_app.command("report")(report_command)


@train_app.command("fit")
def fit_command(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="models/NAME", help="Model folder; its name is the model's.")
    ],
    dataset: Annotated[
        Path | None, typer.Argument(metavar="[DATASET]", help="Dataset folder, as `simulate sweep` makes it.")
    ] = None,
    sensor: Annotated[
        str | None, typer.Option("--sensor", help="Simulate this sensor's presses instead, circle:1.0 within 8 mm.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Training configuration, TOML. (default: built in)")
    ] = None,
    version: Annotated[int, typer.Option("--version", min=1, help="Number of the version folder to make.")] = 1,
) -> None:
    """Train a network, export it as ONNX, measure it, and write the model folder with its card.

    Example: isocharge train fit --sensor three-25um-biaxial -o models/three-25um-biaxial
    """
    if (dataset is None) == (sensor is None):
        raise InputError("train fit: expected either a DATASET folder or --sensor SENSOR, not both and not neither")
    from isocharge.train import load_config, train_model

    refuse_existing(output / str(version))
    settings = load_config(config) if config else None
    presses = _read(dataset) if dataset else _simulate(str(sensor))
    with progress("training") as advance:
        release = train_model(presses, output, settings, command=this_command(), version=version, progress=advance)
    say(_summary(release))


def _read(folder: Path) -> "Dataset":
    from isocharge.simulate import read_dataset

    return read_dataset(folder)


def _simulate(sensor: str) -> "Dataset":
    """A sweep with its defaults, kept only as long as it is needed."""
    from tempfile import TemporaryDirectory

    from isocharge.simulate import Circle, Sweep, load_sensor, read_dataset, run_sweep

    with TemporaryDirectory() as folder, progress("solving the film") as advance:
        probes = (Circle(1e-3),)
        return read_dataset(
            run_sweep(Path(folder) / "presses", load_sensor(sensor), probes, Sweep(samples=24_000), progress=advance)
        )


def _summary(release: "Release") -> str:
    errors = release.metadata.errors
    return (
        f"{release.folder}: position error {errors['position_median_mm']:g} mm median, "
        f"{errors['position_rms_mm']:g} mm rms, {errors['position_p95_mm']:g} mm at 95 %; "
        f"force {errors['force_rms_percent']:g} % rms"
    )
