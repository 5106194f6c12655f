"""Chebyshev series that describe a quantity, such as a charge, as a function of position and force."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev

from isocharge.common.arrays import Array, Integers

CHUNK_SIZE = 4096
"""Number of points at which a series is evaluated at the same time, which limits the memory."""


@dataclass(frozen=True)
class Series:
    """Sum of products of Chebyshev polynomials in three coordinates: x, y and the logarithm of the force.

    Each coordinate is scaled to the range from -1 to 1. The sum has one value for each electrode. Products whose total
    degree in x and y exceeds `degree` are omitted.

    Attributes:
        coefficients: Coefficients of the products, shape (degree + 1, degree + 1, force_degree + 1, n_electrode). The
            indices of the first three axes are the degrees of the polynomials in x, in y and in the logarithm of the
            force.
    """

    coefficients: Array

    def values_and_derivatives(self, coordinates: Array) -> Array:
        """Evaluate the series and its derivatives with respect to the three coordinates.

        The points are processed in chunks of at most `CHUNK_SIZE` points. In each chunk, the method first sums over the
        polynomials in x and y, and then over the polynomials in the logarithm of the force.

        Args:
            coordinates: Scaled coordinates of n points, shape (n, 3). Coordinates outside [-1, 1] are clipped.

        Returns:
            Values and derivatives, shape (n, 4, n_electrode). The second axis contains the value and the derivatives
            with respect to x, y and the logarithm of the force.
        """
        n_x, _n_y, n_force, n_electrode = self.coefficients.shape  # numbers of polynomials, and of electrodes
        degree = n_x - 1  # the same in x and in y
        n_chunk = len(coordinates) // CHUNK_SIZE + 1  # at least one chunk, even if there are no points
        evaluated_chunks = []
        for chunk in np.array_split(coordinates, n_chunk):
            position_terms, force_terms = chebyshev_terms(chunk, degree, force_degree=n_force - 1)

            # Sum over the products of polynomials in x and y: (points, n_term) @ (n_term, n_force * 4 * n_electrode).
            # The factor 4 stands for the value and its three derivatives. For each point, the sums are the coefficients
            # of series in the logarithm of the force.
            position_sums = position_terms @ self._term_coefficients
            force_coefficients = position_sums.reshape(len(chunk), n_force, 4 * n_electrode)

            # Sum over the polynomials in the logarithm of the force:
            # (points, 1, n_force) @ (points, n_force, 4 * n_electrode).
            chunk_values = force_terms[:, None, :] @ force_coefficients
            evaluated_chunks.append(chunk_values[:, 0, :])
        return np.concatenate(evaluated_chunks).reshape(len(coordinates), 4, n_electrode)

    @cached_property
    def _term_coefficients(self) -> Array:
        """Coefficients of the series and of its derivatives with respect to x, y and the logarithm of the force.

        The shape is (n_term, (force_degree + 1) * 4 * n_electrode). Each row belongs to one product of a polynomial in
        x and a polynomial in y, in the order of `position_degrees`.
        """
        derivatives = [_derivative(self.coefficients, axis) for axis in range(3)]
        series_and_derivatives = np.stack([self.coefficients, *derivatives])
        degree = self.coefficients.shape[0] - 1
        x_degree, y_degree = position_degrees(degree)  # degrees in x and y of each product, shape (n_term,)

        coefficients = series_and_derivatives[:, x_degree, y_degree]  # (4, n_term, force_degree + 1, n_electrode)
        coefficients_by_term = coefficients.transpose(1, 2, 0, 3)  # shape (n_term, force_degree + 1, 4, n_electrode)
        return np.asarray(coefficients_by_term.reshape(len(x_degree), -1))


def position_degrees(degree: int) -> tuple[Integers, Integers]:
    """Return the degrees in x and in y of all products of polynomials whose total degree is at most `degree`.

    Args:
        degree: Largest sum of the degrees in x and in y.

    Returns:
        The degree in x and the degree in y of each product, each of shape (n_term,).
    """
    degrees = np.arange(degree + 1)
    total_degree = np.add.outer(degrees, degrees)
    x_degree, y_degree = np.nonzero(total_degree <= degree)
    return x_degree, y_degree


def chebyshev_terms(coordinates: Array, degree: int, force_degree: int) -> tuple[Array, Array]:
    """Evaluate the Chebyshev polynomials that occur in a series.

    Args:
        coordinates: Scaled coordinates of n points, shape (n, 3). Coordinates outside [-1, 1] are clipped.
        degree: Largest total degree in x and y.
        force_degree: Largest degree in the logarithm of the force.

    Returns:
        Products of the polynomials in x and y, in the order of `position_degrees`, shape (n, n_term). Polynomials in
        the logarithm of the force, shape (n, force_degree + 1).
    """
    x, y, log_force = np.clip(coordinates, -1.0, 1.0).T
    x_polynomials = chebyshev.chebvander(x, degree).astype(float)  # shape (n, degree + 1)
    y_polynomials = chebyshev.chebvander(y, degree).astype(float)
    force_polynomials = chebyshev.chebvander(log_force, force_degree).astype(float)

    x_degree, y_degree = position_degrees(degree)
    position_terms = x_polynomials[:, x_degree] * y_polynomials[:, y_degree]
    return position_terms, force_polynomials


def _derivative(coefficients: Array, axis: int) -> Array:
    """Return the coefficients of the derivative of a Chebyshev series with respect to one coordinate.

    Args:
        coefficients: Coefficients of the series; see `Series`.
        axis: Axis of `coefficients` that belongs to the coordinate.

    Returns:
        Coefficients of the derivative, padded with zeros to the shape of `coefficients`.
    """
    derivative = chebyshev.chebder(coefficients, axis=axis)
    # The derivative of a constant has as many coefficients as the constant. Otherwise, it has one coefficient less.
    missing_count = coefficients.shape[axis] - derivative.shape[axis]
    padding = [(0, 0)] * coefficients.ndim
    padding[axis] = (0, missing_count)
    return np.pad(derivative, padding)
