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
models. Programs only read the version folders, and the copies above the version folders are for people.

The file `calibration.json` contains the value and the standard deviation of each unknown. Both have the unit of the
property with the same name. The unit of an `offset` is pC, the unit of `force_offset` is N, and coefficients have no
unit. The entry `correlations` is the lower triangle of the correlation matrix of all unknowns, without the diagonal. It
has one row for each unknown, in the order of the unknowns. The correlations are rounded to six digits. If the standard
deviation of an unknown is zero, its correlations are zero.
"""

import json
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace as replace_setting

from isocharge.common.arrays import Array
from isocharge.common.errors import ModelError, PressError, cut, error_context
from isocharge.common.files import StrPath, write_whole
from isocharge.common.structs import Text, plain_values, read_json
from isocharge.serve.model.charge_file import FILE as CHARGES
from isocharge.serve.model.charge_file import charge_map_bytes
from isocharge.serve.model.model_folder import check_target, version_folders
from isocharge.serve.presses.measured_presses import MeasuredPresses, read_presses
from isocharge.serve.presses.std_factor import FEWEST_HELD_OUT, StdFactor
from isocharge.serve.presses.table_file import csv_text
from isocharge.simulate import Domain, NoiseModel
from isocharge.simulate.sensor.sensor_file import sensor_to_dict, sensor_to_toml
from isocharge.simulate.solver.assembly import single_threaded_blas
from isocharge.train.calibration.compact_map import compact_charges
from isocharge.train.calibration.film_estimate import FilmEstimate
from isocharge.train.calibration.film_network import training_data
from isocharge.train.calibration.problem import CalibrationProblem, domain_words
from isocharge.train.calibration.result import CalibrationResult
from isocharge.train.data.presses import have_charges_of, have_charges_of_earlier
from isocharge.train.model_release.release import release
from isocharge.train.training.config import FitConfig
from isocharge.train.training.fit import Fitted, fit

CORRELATION_DIGITS = 6
"""Number of decimal digits of a correlation."""

Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Std = Annotated[float, Meta(ge=0.0, le=1e6)]
Correlation = Annotated[float, Meta(ge=-1.0, le=1.0)]


class _Unknown(Struct, frozen=True):
    """Value and standard deviation of an unknown."""

    value: Number
    std: Std


class _CalibrationFile(Struct, frozen=True):
    """Entries of calibration.json that `read_film` uses."""

    format_version: Annotated[int, Meta(ge=6, le=6, description="6")]
    probe: Text
    radius_mm: Number
    force_range_N: tuple[Number, Number]
    unknowns: dict[str, _Unknown]
    noise: NoiseModel
    correlations: list[list[Correlation]]
    described_sensor: dict[str, Any]


def film_table(problem: CalibrationProblem, film: FilmEstimate) -> dict[str, Any]:
    """Return the entries of calibration.json that `read_film` reads.

    Args:
        problem: The calibration problem, with the sensor, the probe and the working area.
        film: The estimate of the film.
    """
    layout = film.layout
    std = np.sqrt(np.diag(film.covariance))
    std_product = np.outer(std, std)
    correlations = np.divide(film.covariance, std_product, out=np.zeros_like(std_product), where=std_product > 0.0)
    rounded_correlations = np.clip(np.round(correlations, CORRELATION_DIGITS), -1.0, 1.0)
    return {
        "format_version": 6,  # the version that `_CalibrationFile` reads
        "probe": problem.probe.rotated_notation,
        "radius_mm": problem.radius,
        "force_range_N": list(problem.force_range),
        "noise": film.noise,
        "unknowns": {
            name: {"value": value, "std": unknown_std}
            for name, value, unknown_std in zip(layout.names, film.values, std, strict=True)
        },
        # The lower triangle without the diagonal: row i has i numbers.
        "correlations": [row[:index] for index, row in enumerate(rounded_correlations)],
        "described_sensor": sensor_to_dict(problem.sensor),
    }


def json_text(table: dict[str, Any]) -> str:
    """Return a table as JSON in which each entry is one line."""
    lines = [f"{json.dumps(key)}: {json.dumps(plain_values(value), allow_nan=False)}" for key, value in table.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def read_film(path: Path, problem: CalibrationProblem) -> FilmEstimate:
    """Read the estimate of a film from calibration.json.

    Args:
        path: The file.
        problem: The calibration problem for which the estimate is read.

    Raises:
        PressError: If the file does not fit the format, belongs to another sensor, probe or working area, or contains
            numbers that no calibration can have written.
    """
    advice = "; if another version of isocharge wrote this calibration, calibrate again with its presses"
    with error_context(PressError, after=advice):
        content = read_json(path, "the calibration.json of `train calibrate`", PressError, _CalibrationFile)
    _check_same_problem(path, content, problem)

    layout = problem.prior.layout
    unknowns = content.unknowns.values()  # in the order of the layout, as `_check_same_problem` ensures
    values = np.array([unknown.value for unknown in unknowns])
    std = np.array([unknown.std for unknown in unknowns])
    for film_property in layout.prior.properties:
        low, high = film_property.limits  # a calibration finds no value outside
        value = content.unknowns[film_property.name].value
        if not low <= value <= high:
            raise PressError(
                f"{path}: unknowns.{film_property.name}.value: expected {low:.6g} to {high:.6g}, got {value:g}; "
                "calibrate again"
            )
    covariance = _correlation_matrix(path, content.correlations, len(values)) * np.outer(std, std)
    return FilmEstimate(layout, values, covariance, content.noise)


def _check_same_problem(path: Path, content: _CalibrationFile, problem: CalibrationProblem) -> None:
    """Raise PressError if a file belongs to another calibration problem.

    The estimated properties are changes from the values of the sensor file. Added to the values of another sensor file,
    they would describe another film.

    Args:
        path: The file calibration.json.
        content: Entries of the file. The entry `described_sensor` is the sensor file with which it was written.
        problem: The present calibration problem.
    """
    described = plain_values(sensor_to_dict(problem.sensor))
    differences = [key for key in described if described[key] != content.described_sensor.get(key)]
    if differences:
        raise PressError(
            f"{path}: expected the sensor file from which this calibration began, got one with another "
            f"{', '.join(differences)}; give that file, not the calibrated {SENSOR}, or calibrate without the earlier "
            "calibration"
        )
    layout = problem.prior.layout
    for key, expected, got in (
        ("probe", problem.probe.rotated_notation, content.probe),
        ("radius_mm", problem.radius, content.radius_mm),
        ("force_range_N", problem.force_range, content.force_range_N),
        ("unknowns", ", ".join(layout.names), ", ".join(content.unknowns)),
    ):
        if got != expected:
            raise PressError(
                f"{path}: {key}: expected {cut(str(expected))}, as in this calibration, got {cut(str(got))}; state "
                "the earlier value, or calibrate without the earlier calibration"
            )


def _correlation_matrix(path: Path, rows: list[list[float]], count: int) -> Array:
    """Return the symmetric matrix with a given lower triangle, and check that it can be a correlation matrix.

    Args:
        path: File that contains the triangle, for messages.
        rows: Rows of the triangle without the diagonal. Row i has i numbers, for i from 0.
        count: Number of unknowns.

    Returns:
        Matrix, shape (count, count).

    Raises:
        PressError: If the triangle has the wrong shape, or the matrix is not positive semidefinite.
    """
    if [len(row) for row in rows] != list(range(count)):
        raise PressError(
            f"{path}: correlations: expected {count} rows of 0 to {count - 1} numbers, the lower triangle of a matrix, "
            f"got {len(rows)} rows of other lengths; calibrate again"
        )
    lower_triangle = np.eye(count)  # the diagonal of a correlation matrix is 1; the upper triangle is not used
    lower_triangle[np.tril_indices(count, -1)] = [number for row in rows for number in row]
    eigenvalues, vectors = np.linalg.eigh(lower_triangle, UPLO="L")  # of the symmetric matrix with this triangle
    largest_rounding_error = count * 10.0**-CORRELATION_DIGITS  # of an eigenvalue, if each correlation was rounded
    if eigenvalues[0] < -largest_rounding_error:
        raise PressError(
            f"{path}: correlations: expected a positive semidefinite matrix, got one with the eigenvalue "
            f"{eigenvalues[0]:.3g}: no unknowns have these correlations together; calibrate again"
        )
    # Compute the matrix from its eigenvalues. Rounding may have made an eigenvalue of zero slightly negative.
    return np.asarray((vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T)


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
    """Check that a calibration can be written to a folder.

    A calibration can be written to a new folder, to an empty folder, or to a folder of earlier calibrations. A folder
    that contains only hidden files, such as those of file managers, counts as empty.

    Args:
        folder: The folder, which need not exist.
        electrodes: Names of the electrodes of the calibrated sensor.

    Raises:
        ModelError: If the folder contains other files or a model with another number of electrodes, or if the name of
            the folder is not a valid name of a model.
        OutputExists: If a file has the folder's name.
        OutputError: If the folder cannot be written.
    """
    versions = version_folders(folder)
    next_version = max(versions, default=0) + 1
    check_target(folder, next_version, electrodes)
    # A model that no calibration has written lacks the file with the estimate of the film.
    has_calibration = any((version / RESULT).is_file() for version in versions.values())
    is_empty = not folder.exists() or all(path.name.startswith(".") for path in folder.iterdir())
    if not (has_calibration or is_empty):
        raise ModelError(f"{folder}: expected a new folder or one of an earlier calibration; choose another --output")


def write_calibration(
    result: CalibrationResult,
    folder: StrPath,
    command: str = "",
    *,
    held_out: MeasuredPresses | None = None,
    config: FitConfig | None = None,
    executor: Executor | None = None,
) -> Path:
    """Train the network of a calibrated film, and write it as the next version of a model folder.

    The files that people read are also copied from the version folder to the folder itself.

    Args:
        result: Result of the calibration.
        folder: A new folder, or the folder of an earlier calibration.
        command: Command that repeats this calibration, for the card.
        held_out: Presses that were not used for the calibration. The standard deviations of the model are multiplied by
            a factor (`StdFactor`), so that the 95 % regions of the model hold for contacts like these presses. None for
            no factor.
        config: Sizes and steps of the training; None for the defaults.
        executor: Executor that runs solves; None for this process.

    Returns:
        The version folder.

    Raises:
        ModelError: If the folder cannot be used for a calibration because of its name or content.
        OutputError: If the folder cannot be written.
        PressError: If too few presses are held out.
    """
    # These modules are imported late, because they import matplotlib, whose import is slow.
    from isocharge.simulate.plots.figure import picture_bytes
    from isocharge.train.calibration.picture import calibration_picture

    # Check the folder and the presses before the training, which takes long.
    folder = Path(folder)
    problem = result.problem
    film = result.film
    check_calibration_folder(folder, problem.electrodes)
    if held_out is not None:
        held_out = usable_held_out(held_out, result.presses, problem, problem.domain)

    # Train the network.
    with single_threaded_blas():
        series = compact_charges(problem.domain, result.charges, film, executor)
    requested = config or FitConfig()
    settings = FitConfig(requested.network, replace_setting(requested.training, noise=film.noise))
    fitted = fit(training_data(result.charges, film, series, executor), settings)
    if held_out is not None:
        fitted = with_guarantee(fitted, usable_held_out(held_out, result.presses, problem, fitted.domain))

    # Write the version folder, and copy the readable files.
    sensor, _ = result.sensor_and_probe
    follower_map = replace(
        series,
        is_folded=CHARGES in fitted.files,  # a training writes this file only if the charges fold
        # For a follower, the description of a film is at best as accurate as the measurement of its charges.
        charge_std=max(series.charge_std, film.noise.gain),
    )
    files = {
        CHARGES: charge_map_bytes(follower_map),
        RESULT: json_text(result_table(result)).encode(),
        SENSOR: sensor_to_toml(sensor).encode(),
        PICTURE: picture_bytes(calibration_picture(result)),
        PRESSES: csv_text(result.presses.columns).encode(),
    }
    description = _film_section(result, fitted.made_with)
    released_model = release(
        replace(fitted, description=description, files={**fitted.files, **files}),
        folder,
        version=max(version_folders(folder), default=0) + 1,
        command=command,
    )
    for name in (SENSOR, PICTURE, CARD, RESULT):
        write_whole(folder / name, (released_model.folder / name).read_bytes())
    return released_model.folder


def usable_held_out(
    held_out: MeasuredPresses, presses: MeasuredPresses, problem: CalibrationProblem, domain: Domain
) -> MeasuredPresses:
    """Select the held-out presses that show how large the errors of the model are.

    A held-out press is selected if it lies in the domain, has all charges, and has a known position or force. A press
    with the same charges as an earlier held-out press is left out.

    Args:
        held_out: Presses that were not used for the calibration.
        presses: Presses of the calibration.
        problem: The calibration problem.
        domain: Domain of the model. Before the training, this is the domain of the problem. The training reduces it if
            the map from contacts to charges folds.

    Raises:
        PressError: If a held-out press was also used for the calibration, or if fewer than `FEWEST_HELD_OUT` presses
            remain, so that the factor for the standard deviations of the model cannot be computed.
    """
    sensor_name = problem.sensor.name
    held_out = held_out.of_electrodes(problem.electrodes, sensor_name)
    calibration_presses = presses.of_electrodes(problem.electrodes, sensor_name)
    # The text is a part of the error message: "expected ..., got the same charges".
    _refuse_learned(held_out, calibration_presses, "held-out presses that are not among those of the calibration")

    has_all_charges = np.isfinite(held_out.charge_pC).all(axis=1)
    has_position_or_force = np.isfinite(held_out.contact).any(axis=1)
    is_inside = ~domain.is_outside(held_out.contact)
    is_copy = have_charges_of_earlier(held_out.charge_pC)
    usable = held_out[has_all_charges & has_position_or_force & is_inside & ~is_copy]
    if len(usable) < FEWEST_HELD_OUT:
        raise PressError(
            f"expected at least {FEWEST_HELD_OUT} held-out presses {domain_words(domain)}, with all charges and a "
            f"known place or force, without copies, got {len(usable)} of {len(held_out)}; measure more, or calibrate "
            "without held-out presses"
        )
    return usable


def _refuse_learned(presses: MeasuredPresses, learned: MeasuredPresses, expected: str) -> None:
    """Raise an error if presses have the same charges as presses that are already used.

    Args:
        presses: The presses.
        learned: The presses that are already used, with the charges of the same electrodes.
        expected: Description of the expected presses, for the message.

    Raises:
        PressError: If a press is already used.
    """
    is_learned = have_charges_of(presses.charge_pC, learned.charge_pC)
    if is_learned.any():
        raise PressError(
            f"{presses[is_learned].line_words}: expected {expected}, got the same charges; leave them out of this file"
        )


def with_guarantee(fitted: Fitted, held_out: MeasuredPresses) -> Fitted:
    """Multiply the standard deviations of a network by the factor that follows from held-out presses.

    The metadata of the model contain the factor and the number of presses as `std_factor`.

    Args:
        fitted: The network.
        held_out: Presses that `usable_held_out` returned.
    """
    contact, std, _ = fitted.predict(held_out.charge_pC)
    std_factor = StdFactor.from_errors(contact - held_out.contact, std)
    return replace(
        fitted,
        network=fitted.network.with_scaled_std(std_factor.factor, std_factor.factor),
        made_with={**fitted.made_with, "std_factor": std_factor._asdict()},
    )


def result_table(result: CalibrationResult) -> dict[str, Any]:
    """Return the content of calibration.json, which describes the result of a calibration."""
    estimation = result.estimation
    return {
        "presses": len(result.presses),
        "left_out_lines": result.bad_lines,
        "reduced_chi2": estimation.residual**2,
        "press_chi2": estimation.press_chi2.round(3),
        "error_left": result.film_error,
        "error_left_before": result.film_error_before,
        "error_of_noise": result.sensitivity.noise_error,
        "properties": result.properties,
        "summary": result.summary,
        "cautions": result.cautions,
        **film_table(result.problem, result.film),
    }


def read_earlier(folder: StrPath, problem: CalibrationProblem, *presses: MeasuredPresses | None) -> FilmEstimate:
    """Read the film of an earlier calibration, and add the possible drift since then to its uncertainty.

    Args:
        folder: Folder that `write_calibration` wrote, or one of its version folders.
        problem: Problem of the new calibration.
        *presses: Presses of the new calibration and held-out presses, with the electrodes of the problem. None stands
            for presses that do not exist.

    Raises:
        PressError: If the folder contains no calibration or a calibration of another problem, or if one of the presses
            was already used for a calibration in the folder. Such a press would count twice, and the standard
            deviations would be too small.
    """
    folder = Path(folder)
    calibrated_versions = [version for version in version_folders(folder).values() if (version / RESULT).is_file()]
    versions = calibrated_versions or [folder]
    film = read_film(versions[-1] / RESULT, problem)
    # The last calibration may have continued the others, so that it has learned from their presses, too.
    for version in versions:
        if (version / PRESSES).is_file():
            learned = read_presses(version / PRESSES, problem.electrodes)
            expected = f"presses that are not among those of the earlier calibration {version}"
            for new_presses in filter(None, presses):
                _refuse_learned(new_presses, learned, expected)
    return film.drifted()  # with the uncertainty that a drift since then adds


def _film_section(result: CalibrationResult, made_with: Mapping[str, Any]) -> str:
    """Return the Markdown section that describes the film on the card of a calibrated model.

    Args:
        result: Result of the calibration.
        made_with: Entries of the metadata, which may contain the factor of the standard deviations.
    """
    probe = result.problem.probe.rotated_notation  # the text that describes the probe
    sentences = [*result.summary, *(f"Caution: {caution}." for caution in result.cautions)]
    if "std_factor" in made_with:
        sentences.append(f"Held-out presses: {StdFactor(**made_with['std_factor']).statement}.")
    summary_list = "\n".join(f"- {sentence}" for sentence in sentences)
    property_rows = "\n".join(
        f"| `{name}` | {entry.meaning} | {entry.value:.4g} | {entry.std:.2g} | {entry.before_std:.2g} | "
        f"{'' if entry.unit == '1' else entry.unit} | {'yes' if entry.identified else 'no'} |"
        for name, entry in result.properties.items()
    )
    return f"""## The film

A calibration estimated the film from {len(result.presses)} presses with `{probe}` (radius as found).
The model was trained, and its errors below were measured, on simulated films that these presses leave possible.

{summary_list}

![errors by the film, residuals]({PICTURE})

| property | what it is | value | standard deviation | before | unit | identified |
|---|---|---|---|---|---|---|
{property_rows}

The values are changes from the sensor file; that of the pretension is the pretension itself. Identified: the presses at
least halved its standard deviation. `calibration.json` has the correlations.

- A real film differs from the simulated one: by wrinkles, a seam under an electrode, a spot of glue. Such differences
  are learned from the presses as far as they are smooth. The rest shows as residuals above 1 in the picture.
- Pretension creeps and coefficients age. Press a few times now and then and ask `isocharge serve check`; calibrate
  again with `--from` this folder.
- Positions refer to the rig's zero: an offset of the rig is taken for a shift of the electrodes.

"""
