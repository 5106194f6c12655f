"""Training and release of a model. `isocharge train fit` and `isocharge train distil` use this module."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from msgspec import json

from isocharge.cli.shared.forward_maps import write_deflection
from isocharge.cli.shared.terminal import say, show_json, shown_progress, this_command
from isocharge.common.files import write_whole
from isocharge.serve import ModelMetadata
from isocharge.serve.model.model_folder import check_target
from isocharge.serve.viewer.deflection_field import DEFLECTION_FILE, read_deflection_field
from isocharge.simulate import parse_probe
from isocharge.simulate.sensor.sensor_file import sensor_from_dict
from isocharge.train import Fitted, Release, release

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


@dataclass(frozen=True)
class ReleaseOptions:
    """Options of a command that trains and releases a model.

    Attributes:
        model_folder: Folder of the model, `models/NAME`.
        version: Number of the version folder.
        json: Whether to print the folder and the errors as one JSON object.
    """

    model_folder: Path
    version: int
    json: bool

    def check_version_folder(self, electrodes: tuple[str, ...]) -> Path:
        """Check that the command can write the version folder, and return its path.

        Args:
            electrodes: Names of the electrodes of the new model.

        Raises:
            OutputExists: If the version exists.
            ModelError: If the name of the model is not allowed, or other versions have other electrodes.
        """
        return check_target(self.model_folder, self.version, electrodes)


def train_and_release(
    train: Callable[[], Fitted],
    version_folder: Path,
    options: ReleaseOptions,
    dataset: Path | None = None,
) -> None:
    """Train a network, release it as a version folder, and print its errors.

    Args:
        train: Function that trains the network.
        version_folder: Folder to write, as `ReleaseOptions.check_version_folder` returned it.
        options: Options of the command.
        dataset: Dataset folder of the training, whose file with the deflection of the film is copied if there is one.
            If it is None, the deflection is computed.
    """
    with shown_progress():
        released = release(train(), version_folder.parent, version=options.version, command=this_command())
    _add_deflection(released, dataset)
    if options.json:
        show_json({"folder": str(released.folder), "errors": dict(released.metadata.errors)})
    say(f"{released.folder}: {_errors_sentence(released.metadata)}")


def _add_deflection(released: Release, dataset: Path | None) -> None:
    """Add the file with the deflection of the film to a released model, unless its sensor has no description.

    Args:
        released: The released model.
        dataset: Dataset folder of the training; None to compute the deflection.
    """
    if dataset is not None:
        path = dataset / DEFLECTION_FILE
        if path.is_file():
            write_whole(released.folder / DEFLECTION_FILE, json.encode(read_deflection_field(path)))
    elif "film" in released.metadata.sensor:
        probes = [parse_probe(notation) for notation in released.metadata.probes]
        write_deflection(released.folder, sensor_from_dict(released.metadata.sensor).film, probes)


def _errors_sentence(metadata: ModelMetadata) -> str:
    """Return a sentence that states the errors of a model."""
    errors = metadata.errors
    force_words = "the force is not estimated"
    if "force_rms_percent" in errors:
        force_words = f"force {errors['force_rms_percent']:g} % rms"
    return (
        f"{_measured_presses_words(metadata)}position error {errors['position_median_mm']:g} mm median, "
        f"{errors['position_rms_mm']:g} mm rms, {errors['position_p95_mm']:g} mm at 95 %; "
        f"{force_words}"
    )


def _measured_presses_words(metadata: ModelMetadata) -> str:
    """Return words about the measured presses on which the errors of a model were measured.

    The text is empty if the presses were simulated.

    Args:
        metadata: Metadata of the model.
    """
    press_count = metadata.errors.get("measured_presses")
    if not press_count:
        return ""
    # The metadata of a model that was trained on presses alone contain the number of folds of the cross-validation.
    is_cross_validated = "folds" in metadata.made_with.get("measured", {})
    if is_cross_validated:
        return f"on {press_count:.0f} measured presses at places that were left out, "
    return f"on {press_count:.0f} measured presses that were not used for training, "
