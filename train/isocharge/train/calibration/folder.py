"""Writer and reader of the folder of a calibrated film.

    FOLDER/config.pbtxt            configuration for the model server Triton
    FOLDER/<version>/model.onnx    the model of this film, with golden.json and card.md as in every model
    FOLDER/<version>/sensor.toml   the calibrated sensor
    FOLDER/<version>/calibration.json    parameters, errors, correlations, and quantities of the film
    FOLDER/<version>/presses.csv   the presses; missing if the calibration was only moved to another temperature
    FOLDER/<version>/pretensions.npz     weights for `serve stream --follow`, with four electrodes or more
    FOLDER/<version>/film_charges.npz       charges of the film at several pretensions, for `serve stream --follow`
    FOLDER/<version>/film_directions.npz    further uncertainty of the film, for `serve stream --follow`
    FOLDER/<version>/calibration.png     picture of the calibration
    FOLDER/sensor.toml, calibration.json, card.md, calibration.png    copies of the files of the last version

A further calibration in the same folder becomes its next version. A server loads the new version when it reloads its
models. Programs only read the version folders, and the copies above the version folders are for people. Before each
calibration, the copies are written again from the last version, because an earlier process may have been killed before
it wrote the copies.
"""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from isocharge.common.errors import ModelError, PressError
from isocharge.common.files import as_output_errors, remove_empty, write_whole
from isocharge.common.json_values import plain_values
from isocharge.common.measured_presses import presses_text
from isocharge.common.resumable_run import locked
from isocharge.serve.model.film_charges import FILE as FILM_CHARGES
from isocharge.serve.model.film_directions import FILE as DIRECTIONS
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import check_target, version_folders
from isocharge.serve.model.pretensions import FILE as PRETENSIONS
from isocharge.simulate.sensor.sensor_file import sensor_to_toml
from isocharge.simulate.solver.stress_limit import yield_force
from isocharge.train.calibration.calibration_file import film_table, read_film
from isocharge.train.calibration.contact_error import ContactError
from isocharge.train.calibration.cross_validation import FOLD_COUNT
from isocharge.train.calibration.film_charge_series import film_charge_series
from isocharge.train.calibration.film_directions import film_directions
from isocharge.train.calibration.following import pretensions_of
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate
from isocharge.train.calibration.result import CalibrationResult, film_without_presses
from isocharge.train.model_release.release import release
from isocharge.train.training.fitted import Provenance

RESULT = "calibration.json"
"""File with the parameters and errors of the film."""

SENSOR = "sensor.toml"
"""File with the calibrated sensor."""

PRESSES = "presses.csv"
"""File with the presses of the calibration."""

PICTURE = "calibration.png"
"""Picture of the calibration."""

CARD = "card.md"
"""File with a description of the calibrated model."""


def check_calibration_folder(folder: Path, electrodes: tuple[str, ...]) -> None:
    """Raise ModelError if the name or the content of a folder makes it unsuitable for a calibration.

    A calibration can be written to a new folder, to an empty folder, or to a folder of earlier calibrations. Hidden
    files in the folder are ignored.

    Args:
        folder: The folder, which need not exist.
        electrodes: Names of the electrodes of the calibrated sensor.
    """
    versions = version_folders(folder)
    next_version = max(versions, default=0) + 1
    check_target(folder, next_version, electrodes)
    has_calibration = any((version / RESULT).is_file() for version in versions.values())
    if not folder.exists() or has_calibration:
        return
    has_other_files = any(not path.name.startswith(".") for path in folder.iterdir())
    if has_other_files:
        raise ModelError(f"{folder}: expected a new folder or one of an earlier calibration; choose another --output")


@contextmanager
def calibration_folder(folder: Path, problem: CalibrationProblem) -> Iterator[None]:
    """Lock a folder for a calibration while a `with` block runs (context manager).

    Before the block, drafts that a killed process left behind are removed. In addition, the readable files of the last
    version are copied to the folder again. After the block, the folder and its newly created parent folders are removed
    if they are empty.

    Args:
        folder: The folder, which is created if it does not exist.
        problem: The calibration problem, which defines the electrodes.

    Raises:
        ModelError: If the folder cannot be used for a calibration because of its name or content.
        OutputExists: If another process writes a calibration to the folder.
        OutputError: If the folder cannot be written.
    """
    check_calibration_folder(folder, problem.electrodes)
    folder_and_new_parents = [folder, *(parent for parent in folder.parents if not parent.exists())]
    with as_output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with locked(folder):
                for draft in folder.glob(".*.draft"):
                    shutil.rmtree(draft, ignore_errors=True)  # removes the draft if it is a folder
                    draft.unlink(missing_ok=True)  # removes the draft if it is a file
                _copy_last_version(folder)
                yield
        finally:
            remove_empty(folder_and_new_parents)


def _copy_last_version(folder: Path) -> None:
    """Copy the readable files of the last version to the folder of the calibration, if the copies are not up to date.

    Args:
        folder: Folder of the calibration, which contains the version folders.
    """
    calibrated_versions = _calibrated_versions(folder)
    if not calibrated_versions:
        return
    last_version = calibrated_versions[-1]
    for name in (SENSOR, PICTURE, CARD, RESULT):
        content = (last_version / name).read_bytes()
        copy = folder / name
        is_up_to_date = copy.is_file() and copy.read_bytes() == content
        if not is_up_to_date:
            write_whole(copy, content)


def _calibrated_versions(folder: Path) -> list[Path]:
    """Return the version folders that contain a calibration, in ascending order of the version.

    Args:
        folder: Folder of the calibration, which contains the version folders.
    """
    return [version for version in version_folders(folder).values() if (version / RESULT).is_file()]


def write_calibration(result: CalibrationResult, folder: Path, command: str = "") -> Path:
    """Write a calibrated film as the next version of a model folder.

    The readable files of the version are also copied to the folder itself.

    Args:
        result: Result of the calibration.
        folder: A new folder, or the folder of an earlier calibration.
        command: Command that repeats this calibration, for the card.

    Returns:
        The version folder.

    Raises:
        ModelError: If the folder cannot be used for a calibration because of its name or content.
        OutputError: If the folder cannot be written.
    """
    check_calibration_folder(folder, result.problem.electrodes)
    with threadpool_limits(1):  # the matrices are small, so a second thread would only wait
        version = _write_version(result, folder, command)
    _copy_last_version(folder)
    return version


def _write_version(result: CalibrationResult, folder: Path, command: str) -> Path:
    """Write the model and all files of a calibration to the next version folder, and return this folder.

    The presses are not written if the calibration was moved to another temperature, because no presses were made at
    this temperature. If a service can follow the pretension, the files for this purpose are also written.

    Args:
        result: Result of the calibration.
        folder: Folder of the calibration.
        command: Command that repeats this calibration, for the card.
    """
    # These modules are imported late, because they import matplotlib. Its import is slow, and `train fit` does not need
    # it.
    from isocharge.simulate.plots.figure import picture_bytes
    from isocharge.train.calibration.picture import calibration_picture

    sensor, _ = result.film
    table = plain_values(result_table(result))
    files = {
        RESULT: json.dumps(table, indent=1, allow_nan=False).encode(),
        SENSOR: sensor_to_toml(sensor).encode(),
        PICTURE: picture_bytes(calibration_picture(result)),
    }
    if not result.move_description:
        files[PRESSES] = presses_text(result.presses).encode()

    # Files with which a service follows the pretension of the film
    fitted = result.fitted
    pretensions = pretensions_of(result, fitted.network)
    if pretensions is not None:
        files[PRETENSIONS] = pretensions.to_bytes()
        files[DIRECTIONS] = film_directions(result).to_bytes()
        series = film_charge_series(result, pretensions.range_MPa)
        if series is not None:
            files[FILM_CHARGES] = series.to_bytes()

    sensor, probe = result.problem.prior.film(result.posterior.parameters)
    yield_force_N = yield_force(sensor.film, [probe], fitted.domain.force_range)
    released_model = release(
        replace(fitted, provenance=Provenance(files=files), yield_force_N=yield_force_N),
        folder,
        version=max(version_folders(folder), default=0) + 1,
        command=command,
        card=lambda about, _: _card(result, about),  # replaces the usual card of a model
    )
    return released_model.folder


def result_table(result: CalibrationResult) -> dict[str, Any]:
    """Convert a calibration result into the content of calibration.json."""
    film = film_table(result.problem.prior, result.posterior)
    return {
        # These two entries of `film` come first in the file, and the others come later.
        "format_version": film.pop("format_version"),
        "sensor": film.pop("sensor"),
        "probe": result.problem.prior.probe.notation,
        "presses": len(result.presses),
        "left_out_lines": list(result.bad_lines),
        "friction": friction_table(result),
        "side_force": result.problem.side_force,
        "reduced_chi2": result.reduced_chi2,
        "error_left": error_table(result.film_error),
        "error_left_before": error_table(result.film_error_before),
        "error_of_noise": error_table(result.sensitivity.noise_error),
        "held_out": held_out_table(result),
        "quantities": {name: quantity.to_dict() for name, quantity in result.quantities.items()},
        **film,
        "words": list(result.summary),
    }


def friction_table(result: CalibrationResult) -> dict[str, float] | None:
    """Return the estimated coefficient of friction for JSON, or None if friction was not an unknown of the fit."""
    if result.side_forces is None or result.problem.friction == 0.0:
        return None
    return result.side_forces.friction._asdict()


def held_out_table(result: CalibrationResult) -> dict[str, float] | None:
    """Return the errors of the cross-validation for JSON, or None if no cross-validation was possible."""
    if result.held_out is None:
        return None
    return {"presses": len(result.held_out.presses), "folds": FOLD_COUNT, **result.held_out.errors}


def error_table(error: ContactError) -> dict[str, float]:
    """Return the root-mean-square errors of contacts for JSON."""
    return {"position_mm": error.position_mm, "force_percent": error.force_percent}


def read_earlier(folder: Path, problem: CalibrationProblem, *, knows_temperature: bool = False) -> FilmEstimate:
    """Read the film of an earlier calibration, and add the possible drift since then to its uncertainty.

    Args:
        folder: Folder that `write_calibration` wrote, or one of its version folders.
        problem: Problem of the new calibration.
        knows_temperature: Whether the temperatures of the new presses are known.

    Raises:
        PressError: If the folder contains no calibration, or a calibration with other parameters.
    """
    _, film = _read_last_film(folder, problem)
    return film.drifted(problem.prior, knows_temperature=knows_temperature)


def read_moved(folder: Path, problem: CalibrationProblem, to_C: float) -> CalibrationResult:
    """Read an earlier calibration, and compute the film at another temperature without new presses.

    The uncertainty is not increased by a possible drift of the film.

    Args:
        folder: Folder that `write_calibration` wrote, or one of its version folders.
        problem: The calibration problem.
        to_C: The other temperature, degrees Celsius.

    Raises:
        PressError: If the folder contains no calibration or a calibration with other parameters, or if the earlier
            presses did not determine how the film changes with temperature.
    """
    path, film = _read_last_film(folder, problem)
    if film.warming is None or not film.warming.identified:
        raise PressError(
            f"{path}: expected a calibration that contains the change of the film with temperature, got one without; "
            "calibrate with presses that have a column temperature_C and cover a few degrees"
        )
    # The path is FOLDER/VERSION/calibration.json. The text contains the last two folders, FOLDER/VERSION.
    version_folder = path.parent
    version = "/".join(version_folder.parts[-2:])
    move_text = f"moved from {film.warming.at_C:.1f} C, {version}, to {to_C:.1f} C by the change in its calibration"
    moved_film = film.at_temperature(to_C, problem.prior)
    # The film before the move is passed as the earlier estimate, so that the result compares both films.
    return film_without_presses(replace(problem, earlier=film), moved_film, move_text)


def _read_last_film(folder: Path, problem: CalibrationProblem) -> tuple[Path, FilmEstimate]:
    """Find the file calibration.json of an earlier calibration, and read its film.

    If the given folder contains version folders, the file of the last version is read. Otherwise, the given folder is
    expected to be a version folder, which contains the file itself.

    Args:
        folder: Folder of an earlier calibration, or one of its version folders.
        problem: The calibration problem for which the film is read.

    Returns:
        Path of the file, and the estimate of the film.

    Raises:
        PressError: If the folder contains no calibration, or a calibration with other parameters.
    """
    versions = _calibrated_versions(folder)
    version_folder = versions[-1] if versions else folder
    path = version_folder / RESULT
    return path, read_film(path, problem)


def _card(result: CalibrationResult, about: ModelMetadata) -> str:
    """Return the Markdown text of the card of a calibrated model.

    Args:
        result: Result of the calibration.
        about: Metadata of the model.
    """
    sensor, probe = result.film
    min_force, max_force = about.force_range_N
    origin = (
        f"{result.move_description}," if result.move_description else f"calibrated on {len(result.presses)} presses"
    )
    summary_list = "\n".join(f"- {sentence}" for sentence in result.summary)
    quantity_rows = "\n".join(
        f"| `{quantity.name}` | {quantity.meaning} | {quantity.value:.4g} | {quantity.std:.2g} | "
        f"{quantity.before_std:.2g} | {'yes' if quantity.identified else 'no'} |"
        for quantity in result.quantities.values()
    )
    return f"""# {about.name}, version {about.version}: a calibrated film

The sensor `{sensor.name}`, {origin} with `{probe.notation}` (radius as found).
The model answers within {result.problem.domain.radius:g} mm of the centre, {min_force:g} to {max_force:g} N.

{summary_list}

![error left, quantities, misses]({PICTURE})

## The film

| quantity | what it is | value | standard deviation | before | identified |
|---|---|---|---|---|---|
{quantity_rows}

Identified: the presses at least halved its standard deviation. `sensor.toml` has single parameters, of which only the
combinations above are known; `calibration.json` has their correlations.

## The model on this film

{_errors_section(result, about)}
{LIMITS}
## Make it again

```bash
{about.made_with.get("command") or "(made by a program, see metadata)"}
```
"""


def _errors_section(result: CalibrationResult, about: ModelMetadata) -> str:
    """Return the section about the errors of the model for the card, in Markdown.

    The section contains a table of errors. It also describes the presses on which the errors were measured. The errors
    come from a cross-validation if it was possible. Otherwise, they come from simulated presses.

    Args:
        result: Result of the calibration.
        about: Metadata of the model, which contain the errors.
    """
    if result.held_out is None:
        introduction = "On new simulated presses on the film as calibrated, with noise:"
        conclusion = (
            "What not knowing the film leaves is added to these errors; `contact_std` contains it, as a common factor."
        )
    else:
        introduction = (
            f"On {len(result.held_out.presses)} measured presses. They are divided by their places into {FOLD_COUNT} "
            "parts, and each part is\nanswered by a calibration without it:"
        )
        conclusion = (
            "These errors contain those of the measured places and forces, and of a film that was calibrated with a "
            "fifth fewer\nplaces. The model itself is calibrated with all presses."
        )
    return f"""{introduction}

| error | figure |
|---|---|
| position, median | {about.errors["position_median_mm"]:g} mm |
| position, rms | {about.errors["position_rms_mm"]:g} mm |
| force, rms | {about.errors["force_rms_percent"]:g} % |

{conclusion}
"""


LIMITS = """## Limits

- The film's theory is the simulator's: clamped round its edge, flat, of even thickness. What a real film adds to that
  (a loose rim, wrinkles, a seam under an electrode) shows as misses above 1 in the picture, not in the errors here.
- Pretension creeps and coefficients age. Press a few times now and then and ask `isocharge serve check`; calibrate
  again with `--from` this folder.
- Positions refer to the rig's zero: an offset of the rig is taken for a shift of the electrodes.
"""
