"""Writer and reader of the folder of a calibrated film.

    FOLDER/config.pbtxt            configuration for the model server Triton
    FOLDER/<version>/model.onnx    the model of this film, with golden.json and card.md as in every model
    FOLDER/<version>/sensor.toml   the calibrated sensor
    FOLDER/<version>/calibration.json    the estimate of the film, and the errors that its uncertainty causes
    FOLDER/<version>/presses.csv   the presses
    FOLDER/<version>/charges.npz   compact charge map of the film, for `serve stream --follow`
    FOLDER/<version>/calibration.png     picture of the calibration
    FOLDER/sensor.toml, calibration.json, card.md, calibration.png    copies of the files of the last version

A further calibration in the same folder becomes its next version. A server loads the new version when it reloads its
models. Programs only read the version folders, and the copies above the version folders are for people. Before each
calibration, the copies are written again from the last version, because an earlier process may have been killed before
it wrote the copies.
"""

import shutil
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from msgspec.structs import replace as replace_setting

from isocharge.common.errors import ModelError
from isocharge.common.files import as_output_errors, locked, remove_empty, write_whole
from isocharge.serve.model.charge_file import FILE as CHARGES
from isocharge.serve.model.charge_file import charge_map_bytes
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import check_target
from isocharge.serve.model.model_search import version_folders
from isocharge.serve.presses.measured_presses import presses_text
from isocharge.simulate.sensor.sensor_file import sensor_to_toml
from isocharge.train.calibration.calibration_file import film_table, json_text, read_film
from isocharge.train.calibration.film_estimate import FilmEstimate
from isocharge.train.calibration.film_network import compact_charges, training_data
from isocharge.train.calibration.problem import CalibrationProblem
from isocharge.train.calibration.result import CalibrationResult
from isocharge.train.model_release.release import release
from isocharge.train.training.config import FitConfig
from isocharge.train.training.fit import fit

RESULT = "calibration.json"
"""File with the estimate of the film."""

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


def write_calibration(
    result: CalibrationResult,
    folder: Path,
    command: str = "",
    *,
    config: FitConfig | None = None,
    executor: Executor | None = None,
) -> Path:
    """Train the network of a calibrated film, and write it as the next version of a model folder.

    The readable files of the version are also copied to the folder itself.

    Args:
        result: Result of the calibration.
        folder: A new folder, or the folder of an earlier calibration.
        command: Command that repeats this calibration, for the card.
        config: Sizes and steps of the training; None for the defaults.
        executor: Executor that runs solves; None for this process.

    Returns:
        The version folder.

    Raises:
        ModelError: If the folder cannot be used for a calibration because of its name or content.
        OutputError: If the folder cannot be written.
    """
    # These modules are imported late, because they import matplotlib, whose import is slow.
    from isocharge.simulate.plots.figure import picture_bytes
    from isocharge.train.calibration.picture import calibration_picture

    check_calibration_folder(folder, result.problem.electrodes)
    problem, film = result.problem, result.film
    noisy_problem = replace(problem, noise=film.noise)
    series = compact_charges(noisy_problem, result.charges, film, executor)
    settings = config or FitConfig()
    if film.noise != problem.noise:
        settings = FitConfig(settings.network, replace_setting(settings.training, noise=film.noise))
    fitted = fit(training_data(result.charges, film, series, executor), settings)

    sensor, _ = result.sensor_and_probe
    is_folded = CHARGES in fitted.provenance.files
    files = {
        CHARGES: charge_map_bytes(replace(series, is_folded=is_folded)),
        RESULT: json_text(result_table(result)).encode(),
        SENSOR: sensor_to_toml(sensor).encode(),
        PICTURE: picture_bytes(calibration_picture(result)),
        PRESSES: presses_text(result.presses).encode(),
    }
    provenance = replace(fitted.provenance, files={**fitted.provenance.files, **files})
    released_model = release(
        replace(fitted, provenance=provenance),
        folder,
        version=max(version_folders(folder), default=0) + 1,
        command=command,
        card=lambda about, trained: _card(result, about, trained.domain.radius),  # replaces the usual card of a model
    )
    _copy_last_version(folder)
    return released_model.folder


def result_table(result: CalibrationResult) -> dict[str, Any]:
    """Convert a calibration result into the content of calibration.json."""
    return result.to_dict() | film_table(result.problem, result.film)


def read_earlier(folder: Path, problem: CalibrationProblem) -> FilmEstimate:
    """Read the film of an earlier calibration, and add the possible drift since then to its uncertainty.

    Args:
        folder: Folder that `write_calibration` wrote, or one of its version folders.
        problem: Problem of the new calibration.

    Raises:
        PressError: If the folder contains no calibration, or a calibration of another problem.
    """
    versions = _calibrated_versions(folder)
    path = (versions[-1] if versions else folder) / RESULT
    return read_film(path, problem).drifted()


def _card(result: CalibrationResult, about: ModelMetadata, radius: float) -> str:
    """Return the Markdown text of the card of a calibrated model.

    Args:
        result: Result of the calibration.
        about: Metadata of the model.
        radius: Radius of the working area of the network, mm.
    """
    problem = result.problem
    min_force, max_force = about.force_range_N
    sentences = (*result.summary, *(f"Caution: {caution}." for caution in result.cautions))
    summary_list = "\n".join(f"- {sentence}" for sentence in sentences)
    property_rows = "\n".join(
        f"| `{name}` | {one.meaning} | {one.value:.4g} | {one.std:.2g} | {one.before_std:.2g} | "
        f"{'' if one.unit == '1' else one.unit} | {'yes' if one.identified else 'no'} |"
        for name, one in result.properties.items()
    )
    return f"""# {about.name}, version {about.version}: a calibrated film

The sensor `{problem.sensor.name}`, calibrated on {len(result.presses)} presses, with `{problem.probe.notation}`
(radius as found).
The model answers within {radius:g} mm of the centre, {min_force:g} to {max_force:g} N.

{summary_list}

![errors by the film, residuals]({PICTURE})

## The film

| property | what it is | value | standard deviation | before | unit | identified |
|---|---|---|---|---|---|---|
{property_rows}

Identified: the presses at least halved its standard deviation. `calibration.json` has the correlations.

## The model on this film

On new simulated presses, with noise, on films that these presses leave possible:

| error | figure |
|---|---|
| position, median | {about.errors["position_median_mm"]:g} mm |
| position, rms | {about.errors["position_rms_mm"]:g} mm |
| force, rms | {about.errors["force_rms_percent"]:g} % |

{LIMITS}
## Make it again

```bash
{about.made_with.get("command") or "(made by a program, see metadata)"}
```
"""


LIMITS = """## Limits

- A real film differs from the simulated one: by wrinkles, a seam under an electrode, a spot of glue. Such differences
  are learned from the presses as far as they are smooth. The rest shows as residuals above 1 in the picture.
- Pretension creeps and coefficients age. Press a few times now and then and ask `isocharge serve check`; calibrate
  again with `--from` this folder.
- Positions refer to the rig's zero: an offset of the rig is taken for a shift of the electrodes.
"""
