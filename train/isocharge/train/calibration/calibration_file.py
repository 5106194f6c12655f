"""The estimate of a film in calibration.json: its writer, and the reader that checks every number.

The file gives each parameter with its standard deviation, and the correlations of all of them, rounded to six digits. A
film with a discrepancy has its coefficients besides, with the standard deviations and correlations of parameters and
coefficients together. A calibration with temperatures has the change of the pretension with temperature.

An unknown whose standard deviation is zero is written with correlations of zero to all others. Older versions wrote
null there, because zero over zero is not a number; the reader takes null for zero in these places.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import PressError, cut, shown
from isocharge.common.structs import Finite, NotNegative, Text, read_json
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.calibration.film_fit import FilmPosterior
from isocharge.train.calibration.nuisances import PRETENSION_PER_KELVIN
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate, Warming

FORMAT_VERSION = 1
"""Version of the format, which is written and read."""

PASCAL_FACTOR = 1e6
"""Factor from MPa to Pa, in which the file has the pretension."""

LARGEST_STD = 100.0
"""Largest standard deviation that the reader accepts, in standard deviations of the prior."""

LARGEST_COEFFICIENT = 30.0
"""Largest coefficient of a discrepancy that the reader accepts, dimensionless. Real films have less than 3."""

BOUND_TOLERANCE = 1e-6
"""Distance from the bounds of a parameter that counts as rounding, in standard deviations of the prior."""

CORRELATION_TOLERANCE = 2e-6
"""Difference of correlations that counts as rounding: they are written with six digits."""

EIGENVALUE_TOLERANCE = 1e-4
"""Largest negative eigenvalue of a matrix of correlations that counts as rounding; 160 unknowns give some 1e-5."""

TEMPERATURES_C = (-100.0, 200.0)
"""Lowest and highest temperature of a film, degrees Celsius, as in files of presses."""


class _Estimate(Struct, frozen=True):
    value: Finite
    std: NotNegative


Correlation = Annotated[float, Meta(ge=-1.0 - CORRELATION_TOLERANCE, le=1.0 + CORRELATION_TOLERANCE)] | None


class _Temperature(Struct, frozen=True):
    at_C: Annotated[float, Meta(ge=TEMPERATURES_C[0], le=TEMPERATURES_C[1])]
    pretension_per_K: _Estimate
    correlations: list[Correlation] = []  # older versions wrote none


class _Discrepancy(Struct, frozen=True):
    coefficients: list[Finite]
    std: list[NotNegative]
    correlations: list[list[Correlation]]


class _CalibrationFile(Struct, frozen=True):
    """What the reader takes from calibration.json."""

    format_version: Literal[1]
    sensor: Text
    parameters: dict[str, _Estimate]
    correlations: list[list[Correlation]]
    discrepancy: _Discrepancy | None = None
    temperature: _Temperature | None = None


def film_table(prior: FilmPrior, posterior: FilmPosterior) -> dict[str, Any]:
    """Return the part of calibration.json that `read_film` reads."""
    return {
        "format_version": FORMAT_VERSION,
        "sensor": prior.sensor.name,
        "parameters": _parameter_table(prior, posterior),
        "correlations": _correlation_table(posterior.covariance),
        "discrepancy": _discrepancy_table(posterior),
        "temperature": _temperature_table(posterior),
    }


def _parameter_table(prior: FilmPrior, posterior: FilmPosterior) -> dict[str, dict[str, float]]:
    """Return value and standard deviation of each parameter by its name, in the units of the file."""
    units = prior.file_factors
    values = units * posterior.parameters
    stds = units * prior.std * np.sqrt(np.diag(posterior.covariance))
    return {
        name: {"value": float(value), "std": float(std)}
        for name, value, std in zip(prior.names, values, stds, strict=True)
    }


def _correlation_table(covariance: Array) -> list[list[float]]:
    """Return the correlations of a covariance, shape (n, n), rounded to six digits.

    An unknown without variance has a correlation of one with itself and of zero with all others.
    """
    std = np.sqrt(np.diag(covariance))
    correlations = _over_std(covariance, np.outer(std, std))
    np.fill_diagonal(correlations, 1.0)
    return [[float(value) for value in row] for row in np.round(correlations, 6)]


def _discrepancy_table(posterior: FilmPosterior) -> dict[str, Any] | None:
    """Return coefficients, standard deviations and correlations of parameters and coefficients for the file.

    A film that probably has no discrepancy gives None.
    """
    if not posterior.imperfect:
        return None
    return {
        "coefficients": posterior.coefficients.tolist(),
        "std": np.sqrt(np.diag(posterior.joint)).tolist(),
        "correlations": _correlation_table(posterior.joint),
    }


def _temperature_table(posterior: FilmPosterior) -> dict[str, Any] | None:
    """Return the change of the pretension with temperature for the file, in C and Pa/K.

    A calibration without temperatures gives None. The correlations are those with the unknowns that the file has.
    """
    warming = posterior.warming
    if warming is None:
        return None
    unit = PASCAL_FACTOR
    stored_covariance = posterior.joint if posterior.imperfect else posterior.covariance
    std = np.sqrt(np.diag(stored_covariance))
    correlations = _over_std(warming.covariance[: std.size], warming.std * std)
    return {
        "at_C": warming.at_C,
        "pretension_per_K": {"value": unit * warming.MPa_per_K, "std": unit * warming.std},
        "correlations": np.round(correlations, 6).tolist(),
    }


def _over_std(covariance: Array, product_of_std: Array) -> Array:
    """Divide covariances by products of standard deviations; the result is zero where a product is zero."""
    return np.divide(covariance, product_of_std, out=np.zeros_like(covariance), where=product_of_std > 0.0)


def read_film(path: Path, problem: CalibrationProblem) -> FilmEstimate:
    """Read the estimate of a film from calibration.json.

    Args:
        path: The file.
        problem: The calibration that needs the estimate.

    Raises:
        PressError: If the file does not fit the format, belongs to another sensor or to other parameters, or has
            numbers that no calibration gives.
    """
    table = read_json(path, "the calibration.json of `train calibrate`", PressError, _CalibrationFile)
    prior = problem.prior
    names = tuple(table.parameters)
    if names != prior.names or table.sensor != prior.sensor.name:
        raise PressError(
            f"{path}: a calibration of {shown(table.sensor)} with the parameters {cut(', '.join(names))}; expected "
            f"{prior.sensor.name!r} with {', '.join(prior.names)}"
        )
    parameters, parameter_std = _read_parameters(path, table, prior)
    parameter_correlations = _correlations(path, "correlations", table.correlations, parameter_std)
    if table.discrepancy is None:
        coefficients = np.empty(0)
        std = parameter_std
        correlations = parameter_correlations
    else:
        coefficients, std = _read_coefficients(path, table.discrepancy, problem, parameter_std)
        correlations = _correlations(path, "discrepancy.correlations", table.discrepancy.correlations, std)
        shared_correlations = correlations[: len(names), : len(names)]
        if np.abs(shared_correlations - parameter_correlations).max() > 2.0 * CORRELATION_TOLERANCE:
            raise PressError(
                f"{path}: discrepancy.correlations: expected those of the parameters, as under correlations, in the "
                f"first {len(names)} rows, got others; calibrate anew"
            )
    if table.temperature is None:
        covariance = _possible(path, correlations) * np.outer(std, std)
        warming = None
    else:
        correlations = _with_temperature(path, table.temperature, correlations, std)
        change = table.temperature.pretension_per_K
        change_std = change.std / PASCAL_FACTOR
        all_std = np.append(std, change_std)
        all_covariance = _possible(path, correlations) * np.outer(all_std, all_std)
        covariance = all_covariance[: std.size, : std.size]
        warming = Warming(
            MPa_per_K=change.value / PASCAL_FACTOR,
            std=change_std,
            at_C=table.temperature.at_C,
            covariance=all_covariance[: std.size, std.size],
        )
    return FilmEstimate(
        parameters=parameters,
        covariance=covariance[: len(names), : len(names)],
        coefficients=coefficients,
        joint=covariance if coefficients.size else np.empty((0, 0)),
        warming=warming,
    )


def _read_parameters(path: Path, table: _CalibrationFile, prior: FilmPrior) -> tuple[Array, Array]:
    """Return the parameters, and their standard deviations over those of the prior, each of shape (n_parameter,)."""
    units = prior.file_factors
    parameters = np.array([estimate.value for estimate in table.parameters.values()]) / units
    lower, upper = prior.bounds
    tolerance = BOUND_TOLERANCE * prior.std
    for name, estimate, std_unit, unit, value, low, high, rounding in zip(
        prior.names, table.parameters.values(), prior.std, units, parameters, lower, upper, tolerance, strict=True
    ):
        if not low - rounding <= value <= high + rounding:
            raise PressError(
                f"{path}: parameters.{name}.value: expected {low * unit:.6g} to {high * unit:.6g}, as these films "
                f"have, got {estimate.value:g}"
            )
        if estimate.std > LARGEST_STD * std_unit * unit:
            raise PressError(
                f"{path}: parameters.{name}.std: expected at most {LARGEST_STD * std_unit * unit:.6g}, "
                f"got {estimate.std:g}"
            )
    std = np.array([estimate.std for estimate in table.parameters.values()]) / units / prior.std
    return parameters, std


def _read_coefficients(
    path: Path, table: _Discrepancy, problem: CalibrationProblem, parameter_std: Array
) -> tuple[Array, Array]:
    """Return the coefficients, and the standard deviations of parameters and coefficients together."""
    expected_count = problem.charges.n_coefficient
    if len(table.coefficients) != expected_count:
        raise PressError(
            f"{path}: discrepancy.coefficients: expected {expected_count} numbers, got {len(table.coefficients)}; "
            "calibrate anew"
        )
    if len(table.std) != parameter_std.size + expected_count:
        raise PressError(
            f"{path}: discrepancy.std: expected {parameter_std.size + expected_count} numbers, one for each parameter "
            f"and coefficient, got {len(table.std)}; calibrate anew"
        )
    coefficients = np.array(table.coefficients)
    std = np.array(table.std)
    for key, values, largest in (
        ("coefficients", coefficients, LARGEST_COEFFICIENT),
        ("std", std, LARGEST_STD),
    ):
        number = int(np.abs(values).argmax())
        if abs(values[number]) > largest:
            raise PressError(
                f"{path}: discrepancy.{key}[{number}]: expected at most {largest:g}, got {values[number]:g}"
            )
    if not np.allclose(std[: parameter_std.size], parameter_std, rtol=1e-6, atol=1e-12):
        raise PressError(
            f"{path}: discrepancy.std: expected the standard deviations of the parameters, over those of the prior, in "
            f"the first {parameter_std.size} places, got others; calibrate anew"
        )
    return coefficients, std


def _with_temperature(path: Path, table: _Temperature, correlations: Array, std: Array) -> Array:
    """Return a matrix of correlations with a last row and column for the change of the pretension with temperature."""
    change = table.pretension_per_K
    largest_Pa_per_K = LARGEST_STD * PRETENSION_PER_KELVIN.std_with_temperatures * PASCAL_FACTOR
    for key, number in (("value", change.value), ("std", change.std)):
        if abs(number) > largest_Pa_per_K:
            raise PressError(
                f"{path}: temperature.pretension_per_K.{key}: expected at most {largest_Pa_per_K:g} Pa/K, "
                f"got {number:g}"
            )
    row: list[Correlation] = table.correlations or [0.0] * std.size
    if len(row) != std.size:
        raise PressError(
            f"{path}: temperature.correlations: expected {std.size} numbers, one for each unknown of the film, "
            f"got {len(row)}"
        )
    without_variance = (std == 0.0) | (change.std == 0.0)
    temperature_row = _numbers(path, "temperature.correlations", [row], without_variance[None])[0]
    extended = np.eye(std.size + 1)
    extended[:-1, :-1] = correlations
    extended[-1, :-1] = temperature_row
    extended[:-1, -1] = temperature_row
    return extended


def _correlations(path: Path, key: str, rows: list[list[Correlation]], std: Array) -> Array:
    """Return correlations as a symmetric matrix with ones on its diagonal, shape (n, n); null is taken for zero."""
    if [len(row) for row in rows] != [std.size] * std.size:
        raise PressError(f"{path}: {key}: expected {std.size} rows of as many numbers")
    without_variance = np.add.outer(std == 0.0, std == 0.0)
    matrix = _numbers(path, key, rows, without_variance)
    diagonal = np.where(std == 0.0, 1.0, np.diag(matrix))
    if np.abs(diagonal - 1.0).max() > CORRELATION_TOLERANCE:
        number = int(np.abs(diagonal - 1.0).argmax())
        raise PressError(
            f"{path}: {key}[{number}][{number}]: expected 1, the correlation of an unknown with itself, "
            f"got {diagonal[number]:g}"
        )
    asymmetry = np.abs(matrix - matrix.T)
    if asymmetry.max() > CORRELATION_TOLERANCE:
        row, column = np.unravel_index(int(asymmetry.argmax()), asymmetry.shape)
        raise PressError(
            f"{path}: {key}: expected a symmetric matrix, got {matrix[row, column]:g} in row {row + 1}, column "
            f"{column + 1} and {matrix[column, row]:g} in row {column + 1}, column {row + 1}"
        )
    np.fill_diagonal(matrix, 1.0)
    return matrix


def _numbers(path: Path, key: str, rows: list[list[Correlation]], may_be_null: Booleans) -> Array:
    """Return rows as an array; null is taken for zero where it may stand, and refused elsewhere."""
    matrix = np.array([[np.nan if value is None else value for value in row] for row in rows])
    wrong = np.isnan(matrix) & ~may_be_null
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise PressError(
            f"{path}: {key}: expected a number from -1 to 1 in row {row + 1}, column {column + 1}, got null; calibrate "
            "anew"
        )
    return np.where(np.isnan(matrix), 0.0, matrix)


def _possible(path: Path, correlations: Array) -> Array:
    """Return correlations without the negative eigenvalues that rounding leaves.

    Raises:
        PressError: If they have larger negative eigenvalues: then no unknowns have these correlations.
    """
    eigenvalues, vectors = np.linalg.eigh(correlations)
    if eigenvalues[0] < -EIGENVALUE_TOLERANCE:
        raise PressError(
            f"{path}: correlations: expected a positive semidefinite matrix, got one with the eigenvalue "
            f"{eigenvalues[0]:.3g}: no unknowns have these correlations together; calibrate anew"
        )
    if eigenvalues[0] >= 0.0:
        return correlations
    return np.asarray((vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T)
