"""Grid of films and presses for which a family of films is solved, and decomposition of the stresses into modes.

The modes and their coefficients are rounded to integers before they are stored in a file.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.theory import Theory
from isocharge.simulate.mesh.conformal_map import distance_coordinate
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values

AXES = ("distance", "load", "tension", "thickness", "reach")
"""Names of the axes of the grid. Together, their values describe a press on a film by dimensionless numbers."""

THEORY = Theory(stretching=True, bending=True, pretensioned=True)
"""Theory of all solves of a family. It includes all terms, because the pretension of the films varies."""

SOFTENING = 4e-4
"""Strain that is added to the pretension strain before the logarithm of the sum is taken, dimensionless.

A press of 0.05 N induces about this strain. A pretension strain that is smaller hardly changes the charges of such a
press.
"""

FilmLimits = dict[str, tuple[float, float]]
"""Smallest and largest value along each of `AXES`, dimensionless."""


@dataclass(frozen=True)
class FilmGrid:
    """Grid of the dimensionless parameters for which presses on films are solved.

    Each attribute contains the nodes along one axis of the grid in ascending order. In the list of attributes, E is
    Young's modulus, h is the thickness, and a is the radius of the film.

    Attributes:
        distance: Distances of the press from the centre of the film, divided by a, shape (n_distance,).
        load: Forces divided by E h a, shape (n_load,).
        tension: Pretensions divided by E, shape (n_tension,).
        thickness: Thicknesses divided by a, shape (n_thickness,).
        reach: Radii of the probe divided by a, shape (n_reach,).
    """

    distance: Array
    load: Array
    tension: Array
    thickness: Array
    reach: Array

    @classmethod
    def spread(cls, limits: FilmLimits, counts: Sequence[int]) -> "FilmGrid":
        """Return a grid with the given number of nodes between the limits of each axis.

        The interpolation coordinates of the nodes are Chebyshev nodes. The interpolation coordinates are converted back
        into values along the axis.

        Args:
            limits: Smallest and largest value along each axis, dimensionless.
            counts: Number of nodes along each of `AXES`.
        """
        nodes = {}
        for axis, count in zip(AXES, counts, strict=True):
            smallest, largest = limits[axis]
            first_coordinate = _interpolation_coordinate(axis, smallest)
            last_coordinate = _interpolation_coordinate(axis, largest)
            nodes[axis] = _axis_value(axis, chebyshev_nodes(count, first_coordinate, last_coordinate))
        return cls(**nodes)

    def weights(self, axis: str, value: float) -> Array:
        """Compute the weights that interpolate between the nodes of one axis.

        Args:
            axis: Name of the axis, from `AXES`.
            value: Value along the axis to which a quantity is interpolated, dimensionless.

        Returns:
            Weights of the nodes of the axis, shape (n_node,), dimensionless. The sum of the weights is 1.
        """
        nodes = _interpolation_coordinate(axis, getattr(self, axis))
        coordinate = np.array([_interpolation_coordinate(axis, value)])  # a single value
        (weights,) = lagrange_values(nodes, barycentric_weights(nodes), coordinate)
        return np.asarray(weights)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of nodes along each axis of the grid, in the order of `AXES`."""
        return tuple(getattr(self, name).size for name in AXES)


def _interpolation_coordinate(axis: str, value: Array | float) -> Any:
    """Convert values along an axis of the grid into the interpolation coordinate of the axis.

    For the load and the reach, the coordinate is the logarithm of the value. For the tension, the coordinate is the
    logarithm of the sum of the tension and `SOFTENING`. For the distance, the coordinate is computed by the function
    `distance_coordinate`. For the thickness, the coordinate is the value itself.

    Args:
        axis: Name of the axis, from `AXES`.
        value: Dimensionless values along this axis, any shape.

    Returns:
        Coordinates, of the shape of `value`, dimensionless.
    """
    if axis in ("load", "reach"):
        return np.log(value)
    if axis == "tension":
        return np.log(value + SOFTENING)
    if axis == "distance":
        return distance_coordinate(value)
    return value


def _axis_value(axis: str, coordinate: Array) -> Array:
    """Convert interpolation coordinates into values along an axis.

    This function is the inverse of `_interpolation_coordinate`.

    Args:
        axis: Name of the axis, from `AXES`.
        coordinate: Interpolation coordinates, any shape, dimensionless.

    Returns:
        Dimensionless values along the axis, of the shape of `coordinate`.
    """
    if axis in ("load", "reach"):
        return np.exp(coordinate)
    if axis == "tension":
        return np.maximum(np.exp(coordinate) - SOFTENING, 0.0)  # rounding must not make the tension negative
    if axis == "distance":
        return np.tanh(coordinate)  # the inverse of `distance_coordinate`
    return coordinate


def bits_of(coefficients: Array, modes: Array, max_bits: int, extra_bits: float) -> Array:
    """Compute the number of bits with which the values of each mode are stored in a file.

    The stresses are the product coefficients @ modes. If a mode contributes half as much to the stresses as another
    mode, it needs one bit less for the same absolute error. Every mode has at least 2 bits.

    Args:
        coefficients: Coefficients of the modes, shape (..., n_mode).
        modes: Modes, shape (n_mode, n).
        max_bits: Number of bits of the mode with the largest contribution, which no mode exceeds.
        extra_bits: Number of bits by which the other modes get more bits than their contribution requires, because the
            errors of many modes add up.

    Returns:
        Number of bits of each mode, shape (n_mode,). The numbers are integers stored as floats.
    """
    largest_coefficient = np.abs(coefficients).reshape(-1, len(modes)).max(axis=0)
    largest_contribution = largest_coefficient * np.abs(modes).max(axis=1)
    relative_bits = np.log2(largest_contribution / largest_contribution.max())  # zero or negative
    return np.asarray(np.clip(np.round(max_bits + extra_bits + relative_bits), 2.0, max_bits))


def quantise(values: Array, axis: int | tuple[int, ...], bits: Array | int) -> tuple[np.ndarray, Array]:
    """Divide values by a scale, and round the quotients to integers.

    Args:
        values: Values to be stored, any shape.
        axis: Axes along which all values are divided by the same scale.
        bits: Number of bits of the integers including the sign, a number or an array that broadcasts with the scales.

    Returns:
        The integers, of the shape of `values`. The scales, with length 1 along `axis`. The product of both is
        approximately `values`.
    """
    # The largest magnitude becomes the largest signed integer.
    scale = np.abs(values).max(axis=axis, keepdims=True) / (2 ** (bits - 1) - 1)
    return np.round(values / scale).astype(np.int16), scale


def decompose(stress: Array, max_error: float) -> tuple[Array, Array]:
    """Decompose the stresses of many presses into a few modes (proper orthogonal decomposition, Sirovich 1987).

    The stress field of each press is approximated by a weighted sum of the modes: stress = coefficients @ modes. Before
    the decomposition, the stress at each node is divided by its root mean square over the presses. Without the division
    by the root mean square, the decomposition would be accurate only under the probe, where the stress is large, and
    not at the electrodes.

    Args:
        stress: Scaled stresses (s11, s22, s12) at the nodes of the mesh for all presses, shape (..., n_node * 3).
        max_error: Largest relative error (root mean square) that the decomposition may have.

    Returns:
        Coefficients, shape (..., n_mode), and modes, shape (n_mode, n_node * 3). The number of modes is the smallest
        number that satisfies `max_error`.
    """
    stress_of_presses = stress.reshape(-1, stress.shape[-1])
    node_stress = stress_of_presses.reshape(len(stress_of_presses), -1, 3)
    squared_magnitude = (node_stress**2).sum(axis=2)  # shape (n_press, n_node)
    rms_of_nodes = np.sqrt(squared_magnitude.mean(axis=0))
    rms_of_values = np.repeat(rms_of_nodes, 3)  # a node has three components of the stress

    relative_stress = stress_of_presses / rms_of_values
    relative_modes = _right_singular_vectors(relative_stress, max_error)  # orthonormal rows
    coefficients = relative_stress @ relative_modes.T
    return coefficients.reshape(*stress.shape[:-1], -1), relative_modes * rms_of_values


def _right_singular_vectors(matrix: Array, max_error: float) -> Array:
    """Compute the right singular vectors of a matrix M that belong to the largest singular values of M.

    The singular value decomposition is M = U S V^T. The squares of the singular values are the eigenvalues of both Gram
    matrices, M M^T and M^T M. The columns of U are the eigenvectors of M M^T, and the columns of V are the eigenvectors
    of M^T M. Only the eigenvectors of the smaller Gram matrix are computed. If the computed eigenvectors are the
    columns of U, the right singular vectors follow from V^T = S^-1 U^T M.

    Args:
        matrix: The matrix M, shape (n_row, n_column).
        max_error: Largest relative error (root mean square) of M if all other singular values are replaced by zero.

    Returns:
        Right singular vectors, shape (n_vector, n_column), by descending singular value. The number of vectors is the
        smallest number that satisfies `max_error`.
    """
    n_row, n_column = matrix.shape
    has_fewer_rows = n_row < n_column
    gram_matrix = matrix @ matrix.T if has_fewer_rows else matrix.T @ matrix
    ascending_eigenvalues, ascending_eigenvectors = np.linalg.eigh(gram_matrix)
    eigenvalues = np.maximum(ascending_eigenvalues[::-1], 0.0)
    eigenvectors = ascending_eigenvectors[:, ::-1].T  # one eigenvector in each row

    # If only the first n singular values are kept, the squared relative error is the sum of the other eigenvalues,
    # divided by the sum of all eigenvalues. The arrays contain the results for n = 1, 2, ...
    kept_fraction = np.cumsum(eigenvalues) / eigenvalues.sum()
    relative_error = np.sqrt(np.maximum(1.0 - kept_fraction, 0.0))
    n_vector = int(np.argmax(relative_error <= max_error)) + 1  # the smallest n with a sufficiently small error
    kept_eigenvectors = eigenvectors[:n_vector]

    if has_fewer_rows:  # the rows of `kept_eigenvectors` are columns of U
        singular_values = np.sqrt(eigenvalues[:n_vector, None])  # shape (n_vector, 1)
        return np.asarray(kept_eigenvectors @ matrix / singular_values)
    return kept_eigenvectors
