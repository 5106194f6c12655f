"""Writer and reader of `calibration.json`, the file with the estimate of a film.

The file contains the value, the standard deviation and the unit of each unknown. `correlations` is the lower triangle
of the correlation matrix of all unknowns, in this order: one row for each unknown, without the diagonal, rounded to six
digits. The correlations of an unknown whose standard deviation is zero are zero.
"""

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError, cut, shown
from isocharge.common.json_values import plain_values
from isocharge.common.structs import Text, convert, read_json
from isocharge.simulate import NoiseModel
from isocharge.train.calibration.film_estimate import FilmEstimate
from isocharge.train.calibration.problem import CalibrationProblem

FORMAT_VERSION = 5
"""Version of the file format that this module writes and reads."""

DIGITS = 6
"""Number of decimal digits of a correlation."""

EIGENVALUE_TOLERANCE = 1e-4
"""Largest magnitude of a negative eigenvalue of a correlation matrix that counts as a rounding error."""

Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Std = Annotated[float, Meta(ge=0.0, le=1e6)]
Correlation = Annotated[float, Meta(ge=-1.0, le=1.0)]


class _Unknown(Struct, frozen=True):
    """Value and standard deviation of an unknown. The unit in the file is for people."""

    value: Number
    std: Std


class _CalibrationFile(Struct, frozen=True):
    """Entries of calibration.json that `read_film` uses."""

    sensor: Text
    probe: Text
    radius_mm: Number
    force_range_N: tuple[Number, Number]
    unknowns: dict[str, _Unknown]
    noise: NoiseModel
    correlations: list[list[Correlation]]


def film_table(problem: CalibrationProblem, film: FilmEstimate) -> dict[str, Any]:
    """Return the entries of calibration.json that `read_film` reads.

    Args:
        problem: The calibration problem, with the sensor, the probe and the working area.
        film: The estimate of the film.
    """
    layout = film.layout
    std = np.sqrt(np.diag(film.covariance))
    product = np.outer(std, std)
    correlations = np.divide(film.covariance, product, out=np.zeros_like(product), where=product > 0.0)
    rounded = np.clip(np.round(correlations, DIGITS), -1.0, 1.0)
    return {
        "format_version": FORMAT_VERSION,
        "sensor": problem.sensor.name,
        "probe": problem.probe.notation,
        "radius_mm": problem.radius,
        "force_range_N": list(problem.force_range),
        "noise": vars(film.noise),
        "unknowns": {
            name: {"value": value, "std": one_std, "unit": unit}
            for name, value, one_std, unit in zip(layout.names, film.values, std, layout.units, strict=True)
        },
        "correlations": [row[:index] for index, row in enumerate(rounded)],
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
    table = read_json(path, "the calibration.json of `train calibrate`", PressError, dict[str, Any])
    version = table.get("format_version")
    if version != FORMAT_VERSION:
        raise PressError(
            f"{path}: format_version: expected {FORMAT_VERSION}, got {shown(version)}: another version of isocharge "
            "wrote this calibration; calibrate again with its presses"
        )
    content = convert(table, _CalibrationFile, str(path), PressError)
    _check_same_problem(path, content, problem)

    layout = problem.prior.layout
    unknowns = content.unknowns.values()
    values = np.array([one.value for one in unknowns])
    std = np.array([one.std for one in unknowns])
    low, high = layout.prior.bounds
    for index, name in enumerate(layout.prior.names):
        if not low[index] <= values[index] <= high[index]:
            raise PressError(
                f"{path}: unknowns.{name}.value: expected {low[index]:.6g} to {high[index]:.6g}, got "
                f"{values[index]:g}; calibrate again"
            )
    covariance = _correlations(path, content.correlations, len(values)) * np.outer(std, std)
    return FilmEstimate(layout, values, covariance, content.noise)


def _check_same_problem(path: Path, content: _CalibrationFile, problem: CalibrationProblem) -> None:
    """Raise PressError if a file belongs to another calibration problem."""
    layout = problem.prior.layout
    for key, expected, got in (
        ("sensor", problem.sensor.name, content.sensor),
        ("probe", problem.probe.notation, content.probe),
        ("radius_mm", problem.radius, content.radius_mm),
        ("force_range_N", problem.force_range, content.force_range_N),
        ("unknowns", ", ".join(layout.names), ", ".join(content.unknowns)),
    ):
        if got != expected:
            raise PressError(
                f"{path}: {key}: expected {cut(str(expected))}, as in this calibration, got {cut(str(got))}; calibrate "
                "without the earlier calibration"
            )


def _correlations(path: Path, rows: list[list[float]], count: int) -> Array:
    """Return the correlation matrix of a lower triangle, shape (count, count), and check that it is possible.

    Raises:
        PressError: If the triangle has the wrong shape, or the matrix is not positive semidefinite.
    """
    if [len(row) for row in rows] != list(range(count)):
        raise PressError(
            f"{path}: correlations: expected {count} rows of 0 to {count - 1} numbers, the lower triangle of a matrix, "
            f"got {len(rows)} rows of other lengths; calibrate again"
        )
    matrix = np.eye(count)
    for index, row in enumerate(rows):
        matrix[index, :index] = row
        matrix[:index, index] = row
    eigenvalues, vectors = np.linalg.eigh(matrix)
    if eigenvalues[0] < -EIGENVALUE_TOLERANCE:
        raise PressError(
            f"{path}: correlations: expected a positive semidefinite matrix, got one with the eigenvalue "
            f"{eigenvalues[0]:.3g}: no unknowns have these correlations together; calibrate again"
        )
    return np.asarray((vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T)
