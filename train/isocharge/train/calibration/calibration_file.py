"""Writer and reader of `calibration.json`, the file with the estimate of a film.

The file contains the value and the standard deviation of each parameter of the film. The section `correlations`
contains the correlations of all parameters, rounded to six digits. The unknowns of a film are its parameters and, if
the film has imperfections or a discrepancy, coefficients that describe these effects. The section `discrepancy`
contains the coefficients. This section also contains the standard deviations and the correlations of the parameters and
coefficients together. If temperatures were measured, the section `temperature` states how the pretension changes with
temperature.

If the standard deviation of an unknown is zero, its correlations with other unknowns are not defined, and zeros are
written for them. Older versions of this module wrote null for undefined correlations. The reader replaces such a null
by zero.
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
"""Version of the file format that this module writes and reads."""

PA_PER_MPA = 1e6
"""Factor that converts MPa to Pa. The file contains the pretension in Pa."""

LARGEST_STD = 100.0
"""Largest standard deviation that the reader accepts, in standard deviations of the prior."""

LARGEST_COEFFICIENT = 30.0
"""Largest coefficient of a discrepancy that the reader accepts, dimensionless. Real films have less than 3."""

BOUND_TOLERANCE = 1e-6
"""Largest distance of a parameter beyond its bounds that counts as a rounding error, in prior standard deviations."""

CORRELATION_TOLERANCE = 2e-6
"""Largest difference of two equal correlations that counts as a rounding error.

Correlations are written with six digits."""

EIGENVALUE_TOLERANCE = 1e-4
"""Largest magnitude of a negative eigenvalue of a correlation matrix that counts as a rounding error.

Rounding the correlations of 160 unknowns causes negative eigenvalues of about 1e-5."""

TEMPERATURES_C = (-100.0, 200.0)
"""Lowest and highest temperature of a film that the reader accepts, degrees Celsius.

The limits are the same in files of presses."""


class _Estimate(Struct, frozen=True):
    """Estimate of a quantity in the file, with its value and its standard deviation."""

    value: Finite
    std: NotNegative


Correlation = Annotated[float, Meta(ge=-1.0 - CORRELATION_TOLERANCE, le=1.0 + CORRELATION_TOLERANCE)] | None


class _Temperature(Struct, frozen=True):
    """Section `temperature` of the file, which states how the pretension changes with temperature."""

    at_C: Annotated[float, Meta(ge=TEMPERATURES_C[0], le=TEMPERATURES_C[1])]
    pretension_per_K: _Estimate
    correlations: list[Correlation] = []  # older versions wrote none


class _Discrepancy(Struct, frozen=True):
    """Section `discrepancy` of the file, which contains the coefficients of the film.

    The standard deviations and correlations are those of the parameters, followed by those of the coefficients.
    """

    coefficients: list[Finite]
    std: list[NotNegative]
    correlations: list[list[Correlation]]


class _CalibrationFile(Struct, frozen=True):
    """Entries of calibration.json that `read_film` uses."""

    format_version: Literal[1]
    sensor: Text
    parameters: dict[str, _Estimate]
    correlations: list[list[Correlation]]
    discrepancy: _Discrepancy | None = None
    temperature: _Temperature | None = None


def film_table(prior: FilmPrior, posterior: FilmPosterior) -> dict[str, Any]:
    """Return the part of calibration.json that `read_film` reads.

    Args:
        prior: Distribution of the films, with the names and units of the parameters.
        posterior: The estimate of the film from presses.
    """
    return {
        "format_version": FORMAT_VERSION,
        "sensor": prior.sensor.name,
        "parameters": _parameter_table(prior, posterior),
        "correlations": _correlation_table(posterior.covariance),
        "discrepancy": _discrepancy_table(posterior),
        "temperature": _temperature_table(posterior),
    }


def _parameter_table(prior: FilmPrior, posterior: FilmPosterior) -> dict[str, dict[str, float]]:
    """Return the value and the standard deviation of each parameter in the units of the file.

    The keys of the result are the names of the parameters.

    Args:
        prior: Distribution of the films, with the names and units of the parameters.
        posterior: The estimate of the film from presses.
    """
    file_factors = prior.file_factors  # factors from the units of the prior to those of the file
    values = file_factors * posterior.parameters
    # The covariance is in units of the prior standard deviations, so its square roots are multiplied by them.
    stds = file_factors * prior.std * np.sqrt(np.diag(posterior.covariance))
    return {
        name: {"value": float(value), "std": float(std)}
        for name, value, std in zip(prior.names, values, stds, strict=True)
    }


def _correlation_table(covariance: Array) -> list[list[float]]:
    """Convert a covariance matrix into rows of correlations, rounded to six digits.

    If the variance of an unknown is zero, its correlations with all other unknowns are set to zero. All diagonal
    elements are one.

    Args:
        covariance: Covariance matrix, shape (n, n).
    """
    std = np.sqrt(np.diag(covariance))
    correlations = _divide_by_std(covariance, np.outer(std, std))
    np.fill_diagonal(correlations, 1.0)
    return [[float(value) for value in row] for row in np.round(correlations, 6)]


def _discrepancy_table(posterior: FilmPosterior) -> dict[str, Any] | None:
    """Return the section `discrepancy` of the file, or None if the film probably needs no coefficients.

    The coefficients describe the imperfections and the discrepancy of the film. The section contains the coefficients,
    and the standard deviations and correlations of the parameters and coefficients together.

    Args:
        posterior: The estimate of the film from presses.
    """
    if not posterior.imperfect:
        return None
    return {
        "coefficients": posterior.coefficients.tolist(),
        "std": np.sqrt(np.diag(posterior.joint)).tolist(),
        "correlations": _correlation_table(posterior.joint),
    }


def _temperature_table(posterior: FilmPosterior) -> dict[str, Any] | None:
    """Return the section `temperature` of the file, or None if no temperatures were measured.

    The section contains the temperature of the film, in degrees Celsius, and the change of the pretension with
    temperature, in Pa/K. The section also contains the correlations of this change with the other unknowns in the
    file.

    Args:
        posterior: The estimate of the film from presses.
    """
    warming = posterior.warming
    if warming is None:
        return None
    # Without imperfections, the file contains only the parameters of the film. They are the first unknowns.
    film_covariance = posterior.joint if posterior.imperfect else posterior.covariance
    film_std = np.sqrt(np.diag(film_covariance))
    covariance_with_film = warming.covariance[: film_std.size]
    correlations = _divide_by_std(covariance_with_film, warming.std * film_std)
    return {
        "at_C": warming.at_C,
        "pretension_per_K": {"value": PA_PER_MPA * warming.MPa_per_K, "std": PA_PER_MPA * warming.std},
        "correlations": np.round(correlations, 6).tolist(),
    }


def _divide_by_std(covariance: Array, product_of_std: Array) -> Array:
    """Divide covariances by products of standard deviations. Where a product is zero, the result is zero.

    Args:
        covariance: Covariances of pairs of unknowns, an array of any shape.
        product_of_std: Product of the standard deviations of each pair, in the same shape.
    """
    return np.divide(covariance, product_of_std, out=np.zeros_like(covariance), where=product_of_std > 0.0)


def read_film(path: Path, problem: CalibrationProblem) -> FilmEstimate:
    """Read the estimate of a film from calibration.json.

    Args:
        path: The file.
        problem: The calibration problem for which the estimate is read.

    Raises:
        PressError: If the file does not fit the format, belongs to another sensor or to other parameters, or contains
            numbers that no calibration can have written.
    """
    content = read_json(path, "the calibration.json of `train calibrate`", PressError, _CalibrationFile)
    prior = problem.prior
    names = tuple(content.parameters)
    if names != prior.names or content.sensor != prior.sensor.name:
        raise PressError(
            f"{path}: a calibration of {shown(content.sensor)} with the parameters {cut(', '.join(names))}; expected "
            f"{prior.sensor.name!r} with {', '.join(prior.names)}"
        )

    # The unknowns of the film are its parameters, followed by its coefficients if the file has them.
    parameters, parameter_std = _read_parameters(path, content, prior)
    parameter_correlations = _read_correlations(path, "correlations", content.correlations, parameter_std)
    if content.discrepancy is None:
        coefficients = np.empty(0)
        film_std = parameter_std
        film_correlations = parameter_correlations
    else:
        coefficients, film_std = _read_coefficients(path, content.discrepancy, problem, parameter_std)
        film_correlations = _read_film_correlations(path, content.discrepancy, film_std, parameter_correlations)

    # A covariance matrix must have no negative eigenvalues. If the file has a section `temperature`, this is checked
    # for all unknowns of the film together with the change of the pretension.
    if content.temperature is None:
        film_covariance = _positive_semidefinite(path, film_correlations) * np.outer(film_std, film_std)
        warming = None
    else:
        film_covariance, warming = _read_temperature(path, content.temperature, film_correlations, film_std)
    return FilmEstimate(
        parameters=parameters,
        covariance=film_covariance[: len(names), : len(names)],
        coefficients=coefficients,
        joint=film_covariance if coefficients.size else np.empty((0, 0)),
        warming=warming,
    )


def _read_film_correlations(path: Path, section: _Discrepancy, film_std: Array, parameter_correlations: Array) -> Array:
    """Read the correlations of the parameters and coefficients of a film from the section `discrepancy`.

    The file contains the correlations of the parameters in two sections, which must agree with each other.

    Args:
        path: The file, for error messages.
        section: Section `discrepancy` of the file.
        film_std: Standard deviations of parameters and coefficients, shape (n,).
        parameter_correlations: Correlations of the parameters, from the section `correlations`, shape (n_parameter,
            n_parameter).

    Returns:
        Correlations, shape (n, n).

    Raises:
        PressError: If the matrix is not a correlation matrix, or contradicts the section `correlations`.
    """
    correlations = _read_correlations(path, "discrepancy.correlations", section.correlations, film_std)
    n_parameter = len(parameter_correlations)
    shared_correlations = correlations[:n_parameter, :n_parameter]  # the parameters are the first unknowns
    # Both matrices were rounded, so the tolerance is doubled.
    if np.abs(shared_correlations - parameter_correlations).max() > 2.0 * CORRELATION_TOLERANCE:
        raise PressError(
            f"{path}: discrepancy.correlations: expected those of the parameters, as under correlations, in the "
            f"first {n_parameter} rows, got others; calibrate anew"
        )
    return correlations


def _read_temperature(
    path: Path, section: _Temperature, film_correlations: Array, film_std: Array
) -> tuple[Array, Warming]:
    """Read from the section `temperature` how the pretension changes with temperature.

    Args:
        path: The file, for error messages.
        section: Section `temperature` of the file, in Pa/K and degrees Celsius.
        film_correlations: Correlations of the unknowns of the film, shape (n, n).
        film_std: Standard deviations of the unknowns of the film, shape (n,).

    Returns:
        Covariance of the unknowns of the film, shape (n, n), and the change of the pretension in MPa/K.

    Raises:
        PressError: If the section has wrong numbers, or its correlations are not possible together with those of the
            film.
    """
    correlations = _with_pretension_change(path, section, film_correlations, film_std)
    change = section.pretension_per_K  # in Pa/K
    change_std = change.std / PA_PER_MPA  # in MPa/K
    std = np.append(film_std, change_std)
    covariance = _positive_semidefinite(path, correlations) * np.outer(std, std)
    n_film = film_std.size  # number of unknowns of the film, and index of the change, which follows them
    warming = Warming(
        MPa_per_K=change.value / PA_PER_MPA,
        std=change_std,
        at_C=section.at_C,
        covariance=covariance[:n_film, n_film],
    )
    return covariance[:n_film, :n_film], warming


def _read_parameters(path: Path, content: _CalibrationFile, prior: FilmPrior) -> tuple[Array, Array]:
    """Read the parameters of a film and their standard deviations, and check that all values are within their limits.

    Args:
        path: The file, for error messages.
        content: Content of the file.
        prior: Distribution of the films, with the bounds and units of the parameters.

    Returns:
        Parameters in the units of the prior, and their standard deviations divided by those of the prior, each of shape
        (n_parameter,).

    Raises:
        PressError: If a value is outside the bounds, or a standard deviation is too large.
    """
    file_factors = prior.file_factors  # factors from the units of the prior to those of the file
    lower, upper = (bound * file_factors for bound in prior.bounds)
    tolerance = BOUND_TOLERANCE * prior.std * file_factors
    largest_std = LARGEST_STD * prior.std * file_factors
    for index, (name, estimate) in enumerate(content.parameters.items()):
        if not lower[index] - tolerance[index] <= estimate.value <= upper[index] + tolerance[index]:
            raise PressError(
                f"{path}: parameters.{name}.value: expected {lower[index]:.6g} to {upper[index]:.6g}, as these films "
                f"have, got {estimate.value:g}"
            )
        if estimate.std > largest_std[index]:
            raise PressError(
                f"{path}: parameters.{name}.std: expected at most {largest_std[index]:.6g}, got {estimate.std:g}"
            )
    parameters = np.array([estimate.value for estimate in content.parameters.values()]) / file_factors
    std = np.array([estimate.std for estimate in content.parameters.values()]) / file_factors / prior.std
    return parameters, std


def _read_coefficients(
    path: Path, section: _Discrepancy, problem: CalibrationProblem, parameter_std: Array
) -> tuple[Array, Array]:
    """Read the coefficients and standard deviations in the section `discrepancy`, and check their number and size.

    Args:
        path: The file, for error messages.
        section: Section `discrepancy` of the file.
        problem: The calibration problem, which defines the number of coefficients.
        parameter_std: Standard deviations of the parameters divided by those of the prior, shape (n_parameter,).

    Returns:
        Coefficients, shape (n_coefficient,), and the standard deviations of parameters and coefficients together, shape
        (n_parameter + n_coefficient,).

    Raises:
        PressError: If there are too few or too many numbers, if a number is too large, or if the standard deviations
            contradict those of the parameters.
    """
    coefficient_count = problem.charges.n_coefficient
    if len(section.coefficients) != coefficient_count:
        raise PressError(
            f"{path}: discrepancy.coefficients: expected {coefficient_count} numbers, got {len(section.coefficients)}; "
            "calibrate anew"
        )
    std_count = parameter_std.size + coefficient_count
    if len(section.std) != std_count:
        raise PressError(
            f"{path}: discrepancy.std: expected {std_count} numbers, one for each parameter and coefficient, got "
            f"{len(section.std)}; calibrate anew"
        )

    coefficients = np.array(section.coefficients)
    std = np.array(section.std)  # of the parameters, followed by the coefficients
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

    # The file contains the standard deviations of the parameters twice: here and beside the values of the parameters.
    if not np.allclose(std[: parameter_std.size], parameter_std, rtol=1e-6, atol=1e-12):
        raise PressError(
            f"{path}: discrepancy.std: expected the standard deviations of the parameters, over those of the prior, in "
            f"the first {parameter_std.size} places, got others; calibrate anew"
        )
    return coefficients, std


def _with_pretension_change(path: Path, section: _Temperature, film_correlations: Array, film_std: Array) -> Array:
    """Extend the correlations of a film by one row and one column for the change of the pretension per kelvin.

    Args:
        path: The file, for error messages.
        section: Section `temperature` of the file, which contains the added correlations.
        film_correlations: Correlations of the unknowns of the film, shape (n, n).
        film_std: Standard deviations of the unknowns of the film, shape (n,).

    Returns:
        Correlations, shape (n + 1, n + 1). The last row and column are those of the change of the pretension.

    Raises:
        PressError: If the number of correlations is wrong, if a correlation is null although it is defined, or if the
            change of the pretension or its standard deviation is too large.
    """
    change = section.pretension_per_K
    largest_Pa_per_K = LARGEST_STD * PRETENSION_PER_KELVIN.std_with_temperatures * PA_PER_MPA
    for key, number in (("value", change.value), ("std", change.std)):
        if abs(number) > largest_Pa_per_K:
            raise PressError(
                f"{path}: temperature.pretension_per_K.{key}: expected at most {largest_Pa_per_K:g} Pa/K, "
                f"got {number:g}"
            )
    # Older versions wrote no correlations of the change, because they assumed that it is uncorrelated with the film.
    given_row: list[Correlation] = section.correlations or [0.0] * film_std.size
    if len(given_row) != film_std.size:
        raise PressError(
            f"{path}: temperature.correlations: expected {film_std.size} numbers, one for each unknown of the film, "
            f"got {len(given_row)}"
        )
    may_be_null = (film_std == 0.0) | (change.std == 0.0)  # the correlation of a constant is not defined
    # `_correlation_array` converts a matrix, so the row is passed and returned as a matrix with one row.
    (temperature_row,) = _correlation_array(path, "temperature.correlations", [given_row], may_be_null[None])

    extended = np.eye(film_std.size + 1)
    extended[:-1, :-1] = film_correlations
    extended[-1, :-1] = temperature_row
    extended[:-1, -1] = temperature_row
    return extended


def _read_correlations(path: Path, key: str, rows: list[list[Correlation]], std: Array) -> Array:
    """Read a matrix of correlations, and check that the matrix is symmetric with ones on its diagonal.

    Args:
        path: The file, for error messages.
        key: Key of the matrix, for error messages.
        rows: Rows of the matrix. The correlations of an unknown without variance may be null, and become zero.
        std: Standard deviations of the unknowns, shape (n,).

    Returns:
        Correlations, shape (n, n).

    Raises:
        PressError: If the matrix has the wrong shape, is not symmetric, has a diagonal entry other than 1, or contains
            null for a pair of unknowns that both have a variance.
    """
    is_square = len(rows) == std.size and all(len(row) == std.size for row in rows)
    if not is_square:
        raise PressError(f"{path}: {key}: expected {std.size} rows of as many numbers")
    is_constant = std == 0.0
    involves_constant = is_constant[:, None] | is_constant[None, :]  # shape (n, n)
    matrix = _correlation_array(path, key, rows, may_be_null=involves_constant)

    # The diagonal element of an unknown without variance may have been null, and is not checked.
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
    """Convert rows of correlations into an array, and replace each null by zero.

    Args:
        path: The file, for error messages.
        key: Key of the rows, for error messages.
        rows: Rows of numbers and null, all of the same length.
        may_be_null: Whether null is allowed at each place, shape (n_row, n_column).

    Raises:
        PressError: If the rows contain null at a place where it is not allowed.
    """
    matrix = np.array(rows, dtype=float)  # JSON's null was read as None, which NumPy converts into NaN
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
    """Replace small negative eigenvalues of a correlation matrix by zero.

    Small negative eigenvalues are caused by the rounding of the correlations.

    Args:
        path: The file, for the error message.
        correlations: Symmetric matrix, shape (n, n).

    Returns:
        The nearest positive semidefinite matrix, shape (n, n); the given matrix if it has no negative eigenvalue.

    Raises:
        PressError: If the magnitude of a negative eigenvalue exceeds `EIGENVALUE_TOLERANCE`.
    """
    eigenvalues, eigenvectors = np.linalg.eigh(correlations)  # in ascending order
    smallest_eigenvalue = eigenvalues[0]
    if smallest_eigenvalue < -EIGENVALUE_TOLERANCE:
        raise PressError(
            f"{path}: correlations: expected a positive semidefinite matrix, got one with the eigenvalue "
            f"{smallest_eigenvalue:.3g}: no unknowns have these correlations together; calibrate anew"
        )
    if smallest_eigenvalue >= 0.0:
        return correlations
    limited_eigenvalues = np.maximum(eigenvalues, 0.0)
    return np.asarray((eigenvectors * limited_eigenvalues) @ eigenvectors.T)
