"""The folder of a calibrated film: its one writer, and the reader of what the next calibration starts from.

    FOLDER/config.pbtxt            for Triton
    FOLDER/<version>/model.onnx    the model of this film, with golden.json and card.md as every model
    FOLDER/<version>/sensor.toml   the calibrated sensor
    FOLDER/<version>/calibration.json    parameters, errors, correlations, what cannot be told
    FOLDER/<version>/presses.csv   the presses
    FOLDER/<version>/calibration.png
    FOLDER/sensor.toml, calibration.json, card.md, calibration.png    of the last version
    FOLDER/presses.part.csv        presses of a session at the bench that is not over

A further calibration in the same folder is its next version: a server that watches it takes it with a reload, and
nothing is lost.
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ModelError, PressError
from isocharge.common.files import read_whole, write_whole
from isocharge.common.json_values import plain_values
from isocharge.common.tables import parse_json
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.repository import version_folders
from isocharge.serve.prediction.measured_presses import MeasuredPresses, write_presses
from isocharge.simulate.sensor.sensor_file import sensor_to_toml
from isocharge.train.calibration.calibrate import Calibration, CalibrationScene, EarlierFilm, loosened
from isocharge.train.calibration.card import calibration_card
from isocharge.train.calibration.picture import calibration_picture
from isocharge.train.films.films_model import FilmsModel, write_film_model

RESULT, SENSOR, PRESSES, PICTURE = "calibration.json", "sensor.toml", "presses.csv", "calibration.png"
"""Names of the files."""

SESSION = "presses.part.csv"
"""Name of the file with the presses of a session that is not over."""

DOTS_PER_INCH = 90
"""Of the picture: readable, and some 150 kB."""


def next_version(folder: Path) -> int:
    """Number of the version that a calibration in this folder gets: one more than the last."""
    return max(version_folders(folder), default=0) + 1


def check_calibration_folder(folder: Path) -> None:
    """Raise ModelError if a calibration cannot go into this folder, because it holds something else."""
    if not folder.exists() or (folder / RESULT).is_file():
        return
    if not folder.is_dir() or {path.name for path in folder.iterdir() if not path.name.startswith(".")} - {SESSION}:
        raise ModelError(f"{folder}: expected a new folder or one of an earlier calibration; choose another --output")


def save_session(folder: Path, presses: MeasuredPresses) -> None:
    """Write the presses of a session into its folder, all of them anew; without presses the file goes."""
    if len(presses):
        folder.mkdir(parents=True, exist_ok=True)
        write_presses(folder / SESSION, presses)
    else:
        end_session(folder)


def end_session(folder: Path) -> None:
    """Remove the presses of a session whose calibration is written: the version folder has them."""
    (folder / SESSION).unlink(missing_ok=True)


def write_calibration(folder: Path, calibration: Calibration, films: FilmsModel, command: str = "") -> Path:
    """Write a calibrated film as a version of a model folder, and copy its files for people to the top.

    Args:
        folder: The folder; new, or one of an earlier calibration.
        calibration: What the presses say.
        films: The network for all films that the calibration's scene was made of.
        command: How to make this again, for the card.

    Returns:
        The version folder.

    Raises:
        ModelError: If the folder holds something else.
        OutputError: If the file system refuses.
    """
    check_calibration_folder(folder)
    further = {
        RESULT: json.dumps(plain_values(calibration.to_dict()), indent=1, allow_nan=False).encode(),
        SENSOR: sensor_to_toml(calibration.film[0]).encode(),
        PRESSES: _presses_text(calibration),
        PICTURE: _drawn(calibration),
    }

    def card(about: ModelMetadata) -> str:
        return calibration_card(calibration, about, PICTURE)

    version = write_film_model(
        films,
        calibration.posterior.parameters,
        folder,
        card=card,
        version=next_version(folder),
        made_with={"command": command},
        further=further,
        widen=_widened(calibration),
    )
    for name in (SENSOR, PICTURE, "card.md", RESULT):
        write_whole(folder / name, (version / name).read_bytes())
    return version


def _widened(calibration: Calibration) -> tuple[float, float]:
    """Factors on the deviations of position and force: what the film leaves comes on top of noise."""
    left, noise = calibration.left, calibration.sensitivity.of_noise()
    return (
        float(np.hypot(1.0, left.position_mm / noise.position_mm)),
        float(np.hypot(1.0, left.force_percent / noise.force_percent)),
    )


def _presses_text(calibration: Calibration) -> bytes:
    text = io.StringIO()
    write_presses(text, calibration.presses)
    return text.getvalue().encode()


def _drawn(calibration: Calibration) -> bytes:
    picture = io.BytesIO()
    calibration_picture(calibration).savefig(picture, dpi=DOTS_PER_INCH, format="png")
    return picture.getvalue()


def read_earlier(folder: Path, scene: CalibrationScene) -> EarlierFilm:
    """The film of an earlier calibration, loosened by what may have drifted since.

    Args:
        folder: As `write_calibration` made it, or one of its version folders.
        scene: The films of the new calibration.

    Raises:
        PressError: If the folder has no calibration, or one of other parameters.
    """
    path = folder / RESULT
    try:
        table: dict[str, Any] = parse_json(read_whole(path), str(path), PressError)
        names, prior = tuple(table["parameters"]), scene.charges.prior
        if names != prior.names or table["sensor"] != prior.sensor.name:
            raise PressError(
                f"{path}: a calibration of {table['sensor']!r} with the parameters {', '.join(names)}; expected "
                f"{prior.sensor.name!r} with {', '.join(prior.names)}"
            )
        rows = [(float(entry["value"]), float(entry["std"])) for entry in table["parameters"].values()]
        parameters, std = np.array(rows).T
        correlations = np.array(table["correlations"], dtype=float)
        return loosened(scene, parameters, _covariance(correlations, std / prior.std))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        if isinstance(error, PressError):
            raise
        raise PressError(
            f"{path}: no calibration ({type(error).__name__}: {error}); expected the folder of `train calibrate`"
        ) from error


def _covariance(correlations: Array, std: Array) -> Array:
    """Covariance from correlations and standard deviations, made positive definite against rounding."""
    covariance = correlations * np.outer(std, std)
    if covariance.shape != (std.size, std.size) or not np.isfinite(covariance).all():
        raise ValueError(f"correlations of shape {correlations.shape}")
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    repaired: Array = (vectors * np.maximum(values, 1e-10)) @ vectors.T
    return repaired
