"""Grid of films and presses at which a family of films is solved, and low-rank decomposition of the stresses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.theory import Theory
from isocharge.simulate.mesh.conformal_map import distance_coordinate
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values

AXES = ("distance", "load", "tension", "thickness", "reach")
"""Dimensionless coordinates of a press on a film, in the order of the axes of the grid."""

THEORY = Theory(stretching=True, bending=True, pretensioned=True)
"""Theory of all solves of a family, which includes all terms because the pretension varies."""

SOFTENING = 4e-4
"""Strain that is added to the pretension strain before its logarithm is taken.

A press of 0.05 N induces about this strain. Smaller pretension strains hardly change its charges.
"""

FilmLimits = dict[str, tuple[float, float]]
"""Smallest and largest value along each of `AXES`, dimensionless."""


@dataclass(frozen=True)
class FilmGrid:
    """Nodes of a family of films: one ascending array for each of `AXES`.

    E is Young's modulus, h the thickness and a the radius of the film.

    Attributes:
        distance: Distance of the press from the centre of the film over a.
        load: Force over E h a.
        tension: Pretension over E.
        thickness: Thickness h over a.
        reach: Radius of the probe over a.
    """

    distance: Array
    load: Array
    tension: Array
    thickness: Array
    reach: Array

    @classmethod
    def spread(cls, limits: FilmLimits, counts: Sequence[int]) -> "FilmGrid":
        """Distribute Chebyshev nodes between limits.

        On each axis, the coordinate of `_interpolation_coordinate` has Chebyshev nodes between those of the limits.
        These nodes are converted back into values of the axis.

        Args:
            limits: Smallest and largest value along each axis.
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
        """Compute the interpolation weights of the nodes of an axis at a value on this axis, shape (n_node,).

        Args:
            axis: One of `AXES`.
            value: Value on the axis, dimensionless.
        """
        nodes = _interpolation_coordinate(axis, getattr(self, axis))
        coordinate = np.array([_interpolation_coordinate(axis, value)])
        (weights,) = lagrange_values(nodes, barycentric_weights(nodes), coordinate)
        return np.asarray(weights)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of nodes along each axis."""
        return tuple(getattr(self, name).size for name in AXES)


def _interpolation_coordinate(axis: str, value: Array | float) -> Any:
    """Return the coordinate in which the stress is interpolated along an axis.

    For the load and the reach, the coordinate is the logarithm of the value. For the tension, the coordinate is the
    logarithm of the sum of the tension and `SOFTENING`. For the distance, the coordinate is `distance_coordinate`. The
    thickness is its own coordinate.

    Args:
        axis: One of `AXES`.
        value: Dimensionless values along this axis, any shape.
    """
    if axis in ("load", "reach"):
        return np.log(value)
    if axis == "tension":
        return np.log(value + SOFTENING)
    if axis == "distance":
        return distance_coordinate(value)
    return value


def _axis_value(axis: str, coordinate: Array) -> Array:
    """Convert interpolation coordinates of an axis into values. This is the inverse of `_interpolation_coordinate`.

    Args:
        axis: One of `AXES`.
        coordinate: Interpolation coordinates, any shape.
    """
    if axis in ("load", "reach"):
        return np.exp(coordinate)
    if axis == "tension":
        return np.maximum(np.exp(coordinate) - SOFTENING, 0.0)
    if axis == "distance":
        return np.tanh(coordinate)
    return coordinate


def bits_of(coefficients: Array, modes: Array, max_bits: int, extra_bits: float) -> Array:
    """Compute the number of bits with which each mode of a decomposition is stored.

    The decomposition is coefficients @ modes. A mode whose contribution to it is smaller by a factor of 2 needs one bit
    less for the same absolute error. Every mode has at least 2 bits.

    Args:
        coefficients: Coefficients of the modes, shape (..., n_mode).
        modes: Modes, shape (n_mode, n).
        max_bits: Number of bits of the mode with the largest contribution.
        extra_bits: Number of bits that each mode gets in addition, because the errors of many modes add up.

    Returns:
        Numbers of bits, shape (n_mode,).
    """
    largest_coefficient = np.abs(coefficients).reshape(-1, len(modes)).max(axis=0)
    largest_contribution = largest_coefficient * np.abs(modes).max(axis=1)
    relative_bits = np.log2(largest_contribution / largest_contribution.max())  # zero or negative
    return np.asarray(np.clip(np.round(max_bits + extra_bits + relative_bits), 2.0, max_bits))


def quantised(values: Array, axis: int | tuple[int, ...], bits: Array | int) -> tuple[np.ndarray, Array]:
    """Divide values by a scale and round them to integers.

    Args:
        values: The values.
        axis: Axes along which the values have the same scale.
        bits: Number of bits of the integers, a number or an array that broadcasts with the scales.

    Returns:
        The integers, shape of `values`, and the scales. The values are approximately integers * scales.
    """
    scale = np.abs(values).max(axis=axis, keepdims=True) / (2 ** (bits - 1) - 1)
    return np.round(values / scale).astype(np.int16), scale


def decompose(stress: Array, max_error: float) -> tuple[Array, Array]:
    """Compute a low-rank decomposition of stresses (proper orthogonal decomposition, Sirovich 1987).

    Each stress becomes a weighted sum of a few modes: stress = coefficients @ modes. The stress at each node is first
    divided by its root mean square over the presses. Otherwise the large stress under the probe would dominate the
    stress at the electrodes.

    Args:
        stress: Scaled stresses (s11, s22, s12) at the nodes for all presses, shape (..., n_node * 3).
        max_error: Largest relative error of the decomposition (root mean square).

    Returns:
        Coefficients, shape (..., n_mode), and modes, shape (n_mode, n_node * 3), with the smallest number of modes.
    """
    stress_of_presses = stress.reshape(-1, stress.shape[-1])
    node_stress = stress_of_presses.reshape(len(stress_of_presses), -1, 3)
    squared_magnitude = (node_stress**2).sum(axis=2)  # shape (n_press, n_node)
    rms_of_nodes = np.sqrt(squared_magnitude.mean(axis=0))
    rms_of_values = np.repeat(rms_of_nodes, 3)  # a node has three components of the stress

    relative_stress = stress_of_presses / rms_of_values
    relative_modes = _right_singular_vectors(relative_stress, max_error)
    coefficients = relative_stress @ relative_modes.T
    return coefficients.reshape(*stress.shape[:-1], -1), relative_modes * rms_of_values


def _right_singular_vectors(matrix: Array, max_error: float) -> Array:
    """Compute the right singular vectors of a matrix M with the largest singular values.

    The singular value decomposition is M = U S V^T. The squares of the singular values are the eigenvalues of M M^T and
    of M^T M. The smaller one of these Gram matrices is decomposed. The columns of V are the eigenvectors of M^T M. If
    M M^T is decomposed, its eigenvectors are the columns of U, and V^T = S^-1 U^T M.

    Args:
        matrix: The matrix M, shape (n_row, n_column).
        max_error: Largest relative error (root mean square) of M if the other singular values are omitted.

    Returns:
        Rows of V^T, shape (n_vector, n_column), by descending singular value. The number of rows is the smallest one
        with a sufficiently small error.
    """
    n_row, n_column = matrix.shape
    has_fewer_rows = n_row < n_column
    gram_matrix = matrix @ matrix.T if has_fewer_rows else matrix.T @ matrix
    ascending_eigenvalues, ascending_eigenvectors = np.linalg.eigh(gram_matrix)
    eigenvalues = np.maximum(ascending_eigenvalues[::-1], 0.0)
    eigenvectors = ascending_eigenvectors[:, ::-1].T  # one eigenvector in each row

    # The squared relative error is the sum of the omitted eigenvalues over the sum of all eigenvalues.
    kept_fraction = np.cumsum(eigenvalues) / eigenvalues.sum()  # if the first 1, 2, ... eigenvalues are kept
    relative_error = np.sqrt(np.maximum(1.0 - kept_fraction, 0.0))
    n_vector = int(np.argmax(relative_error <= max_error)) + 1  # the first sufficiently small error
    kept_eigenvectors = eigenvectors[:n_vector]

    if has_fewer_rows:
        singular_values = np.sqrt(eigenvalues[:n_vector, None])
        return np.asarray(kept_eigenvectors @ matrix / singular_values)
    return kept_eigenvectors
