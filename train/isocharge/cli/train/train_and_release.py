"""Training and release of a model. The command `isocharge train fit` uses this module."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.terminal import say, show_json, shown_progress, this_command
from isocharge.serve import ModelMetadata
from isocharge.train import Fitted, release

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
