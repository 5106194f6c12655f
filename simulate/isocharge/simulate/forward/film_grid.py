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

    Modes with small contributions need fewer bits for the same absolute error.

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
    divided by its root mean square. Otherwise the large stress under the probe would dominate the stress at the
    electrodes.

    Args:
        stress: Scaled stresses of all presses, shape (..., n).
        max_error: Largest relative error of the decomposition (root mean square).

    Returns:
        Coefficients, shape (..., n_mode), and modes, shape (n_mode, n), with the smallest number of modes.
    """
    stress_of_presses = stress.reshape(-1, stress.shape[-1])
    n_press, n_value = stress_of_presses.shape
    squared_magnitude = (stress_of_presses.reshape(n_press, -1, 3) ** 2).sum(axis=2)
    rms_of_nodes = np.sqrt(squared_magnitude.mean(axis=0))
    rms_of_values = np.repeat(rms_of_nodes, 3)  # a node has three components of the stress
    relative_stress = stress_of_presses / rms_of_values

    # Singular value decomposition of the relative stress by the eigenvectors of a Gram matrix. Of the two Gram
    # matrices, of shape (n_press, n_press) and (n_value, n_value), the smaller one is used.
    has_fewer_presses = n_press < n_value
    vectors = relative_stress if has_fewer_presses else relative_stress.T
    gram_matrix = vectors @ vectors.T
    ascending_eigenvalues, ascending_eigenvectors = np.linalg.eigh(gram_matrix)
    eigenvalues = np.maximum(ascending_eigenvalues[::-1], 0.0)
    eigenvectors = ascending_eigenvectors[:, ::-1].T  # one eigenvector in each row

    # The error of a truncation follows from the sum of the omitted eigenvalues. Take the first number of modes with a
    # sufficiently small error.
    relative_error = np.sqrt(np.maximum(1.0 - np.cumsum(eigenvalues) / eigenvalues.sum(), 0.0))
    n_mode = int(np.argmax(relative_error <= max_error)) + 1

    # The modes are the right singular vectors.
    if has_fewer_presses:
        left_vectors = eigenvectors[:n_mode]
        singular_values = np.sqrt(eigenvalues[:n_mode, None])
        modes = left_vectors @ relative_stress / singular_values
    else:
        modes = eigenvectors[:n_mode]
    coefficients = relative_stress @ modes.T
    return coefficients.reshape(*stress.shape[:-1], n_mode), modes * rms_of_values
