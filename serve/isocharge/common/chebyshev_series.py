"""Chebyshev series in position and force, which describe the charges of all contacts on a film."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev

from isocharge.common.arrays import Array, Integers

CHUNK_SIZE = 4096
"""Number of contacts that are evaluated at a time, which limits the memory."""


@dataclass(frozen=True)
class Series:
    """A sum of products of Chebyshev polynomials in three coordinates, each from -1 to 1.

    Attributes:
        coefficients: Shape (degree + 1, degree + 1, force_degree + 1, n_electrode). The first three axes are the
            degrees of the polynomials in x, in y and in the logarithm of the force.
    """

    coefficients: Array

    def values(self, coordinates: Array) -> Array:
        """Evaluate the series and its derivatives with respect to the three coordinates.

        The series is evaluated in chunks of `CHUNK_SIZE` points. For each chunk, the terms are first summed over the
        polynomials in x and y. They are then summed over the polynomials in the logarithm of the force.

        Args:
            coordinates: Scaled coordinates, shape (n, 3). Coordinates outside [-1, 1] are clipped.

        Returns:
            Values and derivatives, shape (n, 4, n_electrode): the value, then the three derivatives.
        """
        _, n_y, n_force, n_electrode = self.coefficients.shape
        n_chunk = len(coordinates) // CHUNK_SIZE + 1  # at least one; no chunk is longer than CHUNK_SIZE
        evaluated_chunks = []
        for chunk in np.array_split(coordinates, n_chunk):
            position_terms, force_terms = chebyshev_terms(chunk, degree=n_y - 1, force_degree=n_force - 1)

            # Sum over the terms in x and y: (points, n_term) @ (n_term, n_force * 4 * n_electrode). The factor 4 stands
            # for the value and its three derivatives.
            force_coefficients = position_terms @ self._term_coefficients
            force_coefficients = force_coefficients.reshape(len(chunk), n_force, 4 * n_electrode)

            # Sum over the terms in the force: (points, 1, n_force) @ (points, n_force, 4 * n_electrode).
            evaluated = force_terms[:, None, :] @ force_coefficients
            evaluated_chunks.append(evaluated[:, 0, :])
        return np.concatenate(evaluated_chunks).reshape(len(coordinates), 4, n_electrode)

    @cached_property
    def _term_coefficients(self) -> Array:
        """Coefficients of the series and of its derivatives, with one row for each product of polynomials in x and y.

        The shape is (n_term, (force_degree + 1) * 4 * n_electrode).
        """
        derivatives = [_derivative(self.coefficients, axis) for axis in range(3)]
        series_and_derivatives = np.stack([self.coefficients, *derivatives])
        degree = self.coefficients.shape[0] - 1
        x_degree, y_degree = position_degrees(degree)  # degrees in x and y of each product, shape (n_term,)

        terms = series_and_derivatives[:, x_degree, y_degree]  # shape (4, n_term, force_degree + 1, n_electrode)
        terms_first = terms.transpose(1, 2, 0, 3)  # shape (n_term, force_degree + 1, 4, n_electrode)
        return np.asarray(terms_first.reshape(len(x_degree), -1))


def position_degrees(degree: int) -> tuple[Integers, Integers]:
    """Return the degrees in x and in y of all terms whose total degree is at most `degree`, each of shape (n_term,)."""
    single = np.arange(degree + 1)
    total = np.add.outer(single, single)
    x_degree, y_degree = np.nonzero(total <= degree)
    return x_degree, y_degree


def chebyshev_terms(coordinates: Array, degree: int, force_degree: int) -> tuple[Array, Array]:
    """Evaluate all products of Chebyshev polynomials that occur in a series.

    Args:
        coordinates: Scaled coordinates, shape (n, 3). Coordinates outside [-1, 1] are clipped.
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
    """Return the coefficients of the derivative with respect to one coordinate, padded with zeros to the same shape."""
    padding = [(0, 0)] * coefficients.ndim
    padding[axis] = (0, 1)
    return np.pad(chebyshev.chebder(coefficients, axis=axis), padding)
