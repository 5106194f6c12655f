"""Writer and reader of the estimate of a film in `calibration.json`.

The file contains each parameter with its standard deviation. The file also contains the correlations of all parameters,
rounded to six digits. If the film has a discrepancy, the file also contains its coefficients. The standard deviations
and correlations then refer to the parameters and the coefficients. If temperatures were measured, the file also
contains the change of the pretension with temperature.

An unknown whose standard deviation is zero is written with correlations of zero to all others. Older versions wrote
null for these correlations, because zero divided by zero is not a number. The reader replaces such a null by zero.
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
"""Factor from MPa to Pa, the unit of the pretension in the file."""

LARGEST_STD = 100.0
"""Largest standard deviation that the reader accepts, in standard deviations of the prior."""

LARGEST_COEFFICIENT = 30.0
"""Largest coefficient of a discrepancy that the reader accepts, dimensionless. Real films have less than 3."""

BOUND_TOLERANCE = 1e-6
"""Distance from the bounds of a parameter that counts as rounding, in standard deviations of the prior."""

CORRELATION_TOLERANCE = 2e-6
"""Difference of correlations that counts as rounding, because correlations are written with six digits."""

EIGENVALUE_TOLERANCE = 1e-4
"""Largest magnitude of a negative eigenvalue of a correlation matrix that counts as rounding.

Rounding the correlations of 160 unknowns causes negative eigenvalues of about 1e-5."""

TEMPERATURES_C = (-100.0, 200.0)
"""Lowest and highest temperature of a film, degrees Celsius, as in files of presses."""


class _Estimate(Struct, frozen=True):
    """Value of a quantity in the file, with its standard deviation."""

    value: Finite
    std: NotNegative


Correlation = Annotated[float, Meta(ge=-1.0 - CORRELATION_TOLERANCE, le=1.0 + CORRELATION_TOLERANCE)] | None


class _Temperature(Struct, frozen=True):
    """Section of the file about the change of the pretension with temperature."""

    at_C: Annotated[float, Meta(ge=TEMPERATURES_C[0], le=TEMPERATURES_C[1])]
    pretension_per_K: _Estimate
    correlations: list[Correlation] = []  # older versions wrote none


class _Discrepancy(Struct, frozen=True):
    """Section of the file about the coefficients of the film."""

    coefficients: list[Finite]
    std: list[NotNegative]
    correlations: list[list[Correlation]]


class _CalibrationFile(Struct, frozen=True):
    """The entries of calibration.json that the reader uses."""

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
    """Return the value and the standard deviation of each parameter, in the units of the file."""
    units = prior.file_factors
    values = units * posterior.parameters
    stds = units * prior.std * np.sqrt(np.diag(posterior.covariance))
    return {
        name: {"value": float(value), "std": float(std)}
        for name, value, std in zip(prior.names, values, stds, strict=True)
    }


def _correlation_table(covariance: Array) -> list[list[float]]:
    """Return the correlations of a covariance, shape (n, n), rounded to six digits.

    If the variance of an unknown is zero, its correlations with all other unknowns are zero.
    """
    std = np.sqrt(np.diag(covariance))
    correlations = _divide_by_std(covariance, np.outer(std, std))
    np.fill_diagonal(correlations, 1.0)
    return [[float(value) for value in row] for row in np.round(correlations, 6)]


def _discrepancy_table(posterior: FilmPosterior) -> dict[str, Any] | None:
    """Return coefficients, standard deviations and correlations of parameters and coefficients for the file.

    The result is None if the film probably has neither imperfections nor a discrepancy.
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

    The table includes the correlations of the change with the other unknowns in the file: the parameters, and the
    coefficients if the film has imperfections. The result is None if no temperatures were measured.

    Args:
        posterior: The estimate of the film.
    """
    warming = posterior.warming
    if warming is None:
        return None
    film_covariance = posterior.joint if posterior.imperfect else posterior.covariance
    film_std = np.sqrt(np.diag(film_covariance))
    covariance_with_film = warming.covariance[: film_std.size]  # the unknowns in the file are the first ones
    correlations = _divide_by_std(covariance_with_film, warming.std * film_std)
    return {
        "at_C": warming.at_C,
        "pretension_per_K": {"value": PASCAL_FACTOR * warming.MPa_per_K, "std": PASCAL_FACTOR * warming.std},
        "correlations": np.round(correlations, 6).tolist(),
    }


def _divide_by_std(covariance: Array, product_of_std: Array) -> Array:
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

    # The unknowns of the film are its parameters, followed by its coefficients if the file has them.
    parameters, parameter_std = _read_parameters(path, table, prior)
    parameter_correlations = _correlations(path, "correlations", table.correlations, parameter_std)
    if table.discrepancy is None:
        coefficients = np.empty(0)
        film_std = parameter_std
        film_correlations = parameter_correlations
    else:
        coefficients, film_std = _read_coefficients(path, table.discrepancy, problem, parameter_std)
        film_correlations = _film_correlations(path, table.discrepancy, film_std, parameter_correlations)

    # If the film changes with temperature, its correlations are checked together with those of the change.
    if table.temperature is None:
        film_covariance = _positive_semidefinite(path, film_correlations) * np.outer(film_std, film_std)
        warming = None
    else:
        film_covariance, warming = _read_temperature(path, table.temperature, film_correlations, film_std)
    return FilmEstimate(
        parameters=parameters,
        covariance=film_covariance[: len(names), : len(names)],
        coefficients=coefficients,
        joint=film_covariance if coefficients.size else np.empty((0, 0)),
        warming=warming,
    )


def _film_correlations(path: Path, table: _Discrepancy, film_std: Array, parameter_correlations: Array) -> Array:
    """Read the correlations of parameters and coefficients, and check the correlations of the parameters.

    Args:
        path: The file, for error messages.
        table: Section `discrepancy` of the file.
        film_std: Standard deviations of parameters and coefficients, shape (n,).
        parameter_correlations: Correlations of the parameters, from the section `correlations`, shape (n_parameter,
            n_parameter).

    Returns:
        Correlations, shape (n, n).

    Raises:
        PressError: If the matrix is not a correlation matrix, or contradicts the section `correlations`.
    """
    correlations = _correlations(path, "discrepancy.correlations", table.correlations, film_std)
    n_parameter = len(parameter_correlations)
    shared_correlations = correlations[:n_parameter, :n_parameter]
    if np.abs(shared_correlations - parameter_correlations).max() > 2.0 * CORRELATION_TOLERANCE:
        raise PressError(
            f"{path}: discrepancy.correlations: expected those of the parameters, as under correlations, in the "
            f"first {n_parameter} rows, got others; calibrate anew"
        )
    return correlations


def _read_temperature(
    path: Path, table: _Temperature, film_correlations: Array, film_std: Array
) -> tuple[Array, Warming]:
    """Read the change of the pretension with temperature.

    Args:
        path: The file, for error messages.
        table: Section `temperature` of the file, in Pa/K and degrees Celsius.
        film_correlations: Correlations of the unknowns of the film, shape (n, n).
        film_std: Standard deviations of the unknowns of the film, shape (n,).

    Returns:
        Covariance of the unknowns of the film, shape (n, n), and the change of the pretension in MPa/K.

    Raises:
        PressError: If the section is not possible together with the unknowns of the film.
    """
    correlations = _with_temperature(path, table, film_correlations, film_std)
    change = table.pretension_per_K
    change_std = change.std / PASCAL_FACTOR
    std = np.append(film_std, change_std)
    covariance = _positive_semidefinite(path, correlations) * np.outer(std, std)
    n_film = film_std.size  # index of the change, which follows the unknowns of the film
    warming = Warming(
        MPa_per_K=change.value / PASCAL_FACTOR,
        std=change_std,
        at_C=table.at_C,
        covariance=covariance[:n_film, n_film],
    )
    return covariance[:n_film, :n_film], warming


def _read_parameters(path: Path, table: _CalibrationFile, prior: FilmPrior) -> tuple[Array, Array]:
    """Read the parameters, and check that they are within the bounds of the films.

    Args:
        path: The file, for error messages.
        table: Contents of the file.
        prior: Distribution of the films.

    Returns:
        Parameters, and their standard deviations over those of the prior, each of shape (n_parameter,).

    Raises:
        PressError: If a value is outside the bounds, or a standard deviation is too large.
    """
    file_factors = prior.file_factors  # factors from the units of the prior to those of the file
    lower, upper = (bound * file_factors for bound in prior.bounds)
    tolerance = BOUND_TOLERANCE * prior.std * file_factors
    largest_std = LARGEST_STD * prior.std * file_factors
    for index, (name, estimate) in enumerate(table.parameters.items()):
        if not lower[index] - tolerance[index] <= estimate.value <= upper[index] + tolerance[index]:
            raise PressError(
                f"{path}: parameters.{name}.value: expected {lower[index]:.6g} to {upper[index]:.6g}, as these films "
                f"have, got {estimate.value:g}"
            )
        if estimate.std > largest_std[index]:
            raise PressError(
                f"{path}: parameters.{name}.std: expected at most {largest_std[index]:.6g}, got {estimate.std:g}"
            )
    parameters = np.array([estimate.value for estimate in table.parameters.values()]) / file_factors
    std = np.array([estimate.std for estimate in table.parameters.values()]) / file_factors / prior.std
    return parameters, std


def _read_coefficients(
    path: Path, table: _Discrepancy, problem: CalibrationProblem, parameter_std: Array
) -> tuple[Array, Array]:
    """Read the coefficients of the film, and check their number and size.

    Args:
        path: The file, for error messages.
        table: Section `discrepancy` of the file.
        problem: The calibration that needs the estimate.
        parameter_std: Standard deviations of the parameters over those of the prior, shape (n_parameter,).

    Returns:
        Coefficients, shape (n_coefficient,), and the standard deviations of parameters and coefficients together, shape
        (n_parameter + n_coefficient,).

    Raises:
        PressError: If there are too few or too many numbers, if a number is too large, or if the standard deviations
            contradict those of the parameters.
    """
    coefficient_count = problem.charges.n_coefficient
    if len(table.coefficients) != coefficient_count:
        raise PressError(
            f"{path}: discrepancy.coefficients: expected {coefficient_count} numbers, got {len(table.coefficients)}; "
            "calibrate anew"
        )
    std_count = parameter_std.size + coefficient_count
    if len(table.std) != std_count:
        raise PressError(
            f"{path}: discrepancy.std: expected {std_count} numbers, one for each parameter and coefficient, got "
            f"{len(table.std)}; calibrate anew"
        )

    coefficients = np.array(table.coefficients)
    std = np.array(table.std)
    for key, values, limit in (
        ("coefficients", coefficients, LARGEST_COEFFICIENT),
        ("std", std, LARGEST_STD),
    ):
        largest_index = int(np.abs(values).argmax())
        largest_value = values[largest_index]
        if abs(largest_value) > limit:
            raise PressError(
                f"{path}: discrepancy.{key}[{largest_index}]: expected at most {limit:g}, got {largest_value:g}"
            )

    # The first standard deviations are those of the parameters, which the file contains twice.
    if not np.allclose(std[: parameter_std.size], parameter_std, rtol=1e-6, atol=1e-12):
        raise PressError(
            f"{path}: discrepancy.std: expected the standard deviations of the parameters, over those of the prior, in "
            f"the first {parameter_std.size} places, got others; calibrate anew"
        )
    return coefficients, std


def _with_temperature(path: Path, table: _Temperature, correlations: Array, std: Array) -> Array:
    """Append the change of the pretension with temperature, as a last row and column, to a matrix of correlations.

    Args:
        path: The file, for error messages.
        table: Section `temperature` of the file.
        correlations: Correlations of the unknowns of the film, shape (n, n).
        std: Standard deviations of the unknowns of the film, shape (n,).

    Returns:
        Correlations, shape (n + 1, n + 1). The last row and column are those of the change of the pretension.

    Raises:
        PressError: If the number of correlations is wrong, or the change of the pretension is too large.
    """
    change = table.pretension_per_K
    largest_Pa_per_K = LARGEST_STD * PRETENSION_PER_KELVIN.std_with_temperatures * PASCAL_FACTOR
    for key, number in (("value", change.value), ("std", change.std)):
        if abs(number) > largest_Pa_per_K:
            raise PressError(
                f"{path}: temperature.pretension_per_K.{key}: expected at most {largest_Pa_per_K:g} Pa/K, "
                f"got {number:g}"
            )
    # A file without these correlations is of an older version, in which the change was uncorrelated with the film.
    given_row: list[Correlation] = table.correlations or [0.0] * std.size
    if len(given_row) != std.size:
        raise PressError(
            f"{path}: temperature.correlations: expected {std.size} numbers, one for each unknown of the film, "
            f"got {len(given_row)}"
        )
    may_be_null = (std == 0.0) | (change.std == 0.0)  # the correlation of a constant is not defined
    # `_correlation_array` reads a matrix, so the row is given and returned as a matrix of one row.
    (temperature_row,) = _correlation_array(path, "temperature.correlations", [given_row], may_be_null[None])

    extended = np.eye(std.size + 1)
    extended[:-1, :-1] = correlations
    extended[-1, :-1] = temperature_row
    extended[:-1, -1] = temperature_row
    return extended


def _correlations(path: Path, key: str, rows: list[list[Correlation]], std: Array) -> Array:
    """Read a matrix of correlations, and check that it is symmetric with ones on its diagonal.

    Args:
        path: The file, for error messages.
        key: Key of the matrix, for error messages.
        rows: Rows of the matrix. The correlations of an unknown without variance are null, and become zero.
        std: Standard deviations of the unknowns, shape (n,).

    Returns:
        Correlations, shape (n, n).

    Raises:
        PressError: If the matrix has another shape, or is not a matrix of correlations.
    """
    is_square = len(rows) == std.size and all(len(row) == std.size for row in rows)
    if not is_square:
        raise PressError(f"{path}: {key}: expected {std.size} rows of as many numbers")
    is_constant = std == 0.0
    matrix = _correlation_array(path, key, rows, may_be_null=is_constant[:, None] | is_constant[None, :])

    diagonal = np.where(is_constant, 1.0, np.diag(matrix))
    deviation_from_one = np.abs(diagonal - 1.0)
    if deviation_from_one.max() > CORRELATION_TOLERANCE:
        index = int(deviation_from_one.argmax())
        raise PressError(
            f"{path}: {key}[{index}][{index}]: expected 1, the correlation of an unknown with itself, "
            f"got {diagonal[index]:g}"
        )

    asymmetry = np.abs(matrix - matrix.T)
    if asymmetry.max() > CORRELATION_TOLERANCE:
        row, column = np.unravel_index(int(asymmetry.argmax()), asymmetry.shape)
        raise PressError(
            f"{path}: {key}: expected a symmetric matrix, got {matrix[row, column]:g} in row {row + 1}, column "
            f"{column + 1} and {matrix[column, row]:g} in row {column + 1}, column {row + 1}"
        )
    np.fill_diagonal(matrix, 1.0)  # removes rounding errors, and the zeros of unknowns without variance
    return matrix


def _correlation_array(path: Path, key: str, rows: list[list[Correlation]], may_be_null: Booleans) -> Array:
    """Convert rows of correlations into an array, in which null becomes zero.

    Args:
        path: The file, for error messages.
        key: Key of the rows, for error messages.
        rows: Rows of numbers and null, all of the same length.
        may_be_null: Where null is allowed, of the shape of the rows.

    Raises:
        PressError: If a row contains null where a number is needed.
    """
    matrix = np.array(rows, dtype=float)  # NumPy converts None into NaN
    is_null = np.isnan(matrix)
    is_missing = is_null & ~may_be_null
    if is_missing.any():
        row, column = np.argwhere(is_missing)[0]
        raise PressError(
            f"{path}: {key}: expected a number from -1 to 1 in row {row + 1}, column {column + 1}, got null; calibrate "
            "anew"
        )
    return np.where(is_null, 0.0, matrix)


def _positive_semidefinite(path: Path, correlations: Array) -> Array:
    """Return the correlation matrix without the small negative eigenvalues that rounding causes.

    Args:
        path: The file, for the error message.
        correlations: Symmetric matrix, shape (n, n).

    Returns:
        The nearest positive semidefinite matrix, shape (n, n).

    Raises:
        PressError: If an eigenvalue is too negative for rounding, so that the matrix cannot contain correlations.
    """
    eigenvalues, vectors = np.linalg.eigh(correlations)
    smallest_eigenvalue = eigenvalues[0]
    if smallest_eigenvalue < -EIGENVALUE_TOLERANCE:
        raise PressError(
            f"{path}: correlations: expected a positive semidefinite matrix, got one with the eigenvalue "
            f"{smallest_eigenvalue:.3g}: no unknowns have these correlations together; calibrate anew"
        )
    if smallest_eigenvalue >= 0.0:
        return correlations
    limited_eigenvalues = np.maximum(eigenvalues, 0.0)
    return np.asarray((vectors * limited_eigenvalues) @ vectors.T)
