"""The grid of a family of films, and the low-rank decomposition of the stresses at its nodes."""

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

It is about the strain that a press of 0.05 N induces. Smaller pretensions have no effect.
"""

FilmLimits = dict[str, tuple[float, float]]
"""Smallest and largest value along each of `AXES`, dimensionless."""


@dataclass(frozen=True)
class FilmGrid:
    """Nodes of a family, with one ascending array for each of `AXES`.

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

        The nodes of the load, the reach and the tension (plus `SOFTENING`) are Chebyshev nodes in the logarithm, and
        those of the distance in `distance_coordinate`.

        Args:
            limits: Smallest and largest value along each axis.
            counts: Number of nodes along each of `AXES`.
        """
        axes = {name: (_stretched(name, low), _stretched(name, high)) for name, (low, high) in limits.items()}
        nodes = [chebyshev_nodes(count, *axes[name]) for name, count in zip(AXES, counts, strict=True)]
        return cls(*(_unstretched(name, values) for name, values in zip(AXES, nodes, strict=True)))

    def weights(self, axis: str, at: float) -> Array:
        """Compute the weights of the nodes of an axis for the interpolation to a value `at`, shape (n_node,)."""
        nodes = _stretched(axis, getattr(self, axis))
        return np.asarray(lagrange_values(nodes, barycentric_weights(nodes), np.array([_stretched(axis, at)]))[0])

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of nodes along each axis."""
        return tuple(getattr(self, name).size for name in AXES)


def _stretched(axis: str, value: Array | float) -> Any:
    """Return the coordinate in which the values of an axis are interpolated by polynomials.

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


def _unstretched(axis: str, value: Array) -> Array:
    """Convert interpolation coordinates of an axis into values. This is the inverse of `_stretched`.

    Args:
        axis: One of `AXES`.
        value: Interpolation coordinates, any shape.
    """
    if axis in ("load", "reach"):
        return np.exp(value)
    if axis == "tension":
        return np.maximum(np.exp(value) - SOFTENING, 0.0)
    if axis == "distance":
        return np.tanh(value)
    return value


def bits_of(coefficients: Array, modes: Array, max_bits: int, extra_bits: float) -> Array:
    """Compute the number of bits with which each mode of a decomposition is stored.

    Modes with small contributions need fewer bits for the same absolute error.

    Args:
        coefficients: Coefficients of the modes, shape (..., n_mode).
        modes: Modes, shape (n_mode, n).
        max_bits: Number of bits of the mode with the largest contribution.
        extra_bits: Number of bits that each mode gets in addition, because the errors of many modes add up.

    Returns:
        Shape (n_mode,).
    """
    largest = np.abs(coefficients).reshape(-1, len(modes)).max(axis=0) * np.abs(modes).max(axis=1)
    relative_bits = np.log2(largest / largest.max())
    return np.asarray(np.clip(np.round(max_bits + extra_bits + relative_bits), 2.0, max_bits))


def quantised(values: Array, axis: int | tuple[int, ...], bits: Array | int) -> tuple[np.ndarray, Array]:
    """Round values to integers with a scale.

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
    """Compute a low-rank decomposition of stresses (proper orthogonal decomposition).

    The stress at each node is scaled by its root mean square. Otherwise the large stress under the probe would dominate
    the stress at the electrodes.

    Args:
        stress: Scaled stresses of all presses, shape (..., n).
        max_error: Largest relative error of the decomposition (root mean square).

    Returns:
        Coefficients, shape (..., n_mode), and modes, shape (n_mode, n), with the smallest number of modes.
    """
    flat = stress.reshape(-1, stress.shape[-1])
    node_stress = np.sqrt((flat.reshape(len(flat), -1, 3) ** 2).sum(axis=2).mean(axis=0))
    size = np.repeat(node_stress, 3)
    relative = flat / size
    has_fewer_rows = len(relative) < relative.shape[1]
    gram = relative @ relative.T if has_fewer_rows else relative.T @ relative
    ascending_values, ascending_vectors = np.linalg.eigh(gram)
    values = np.maximum(ascending_values[::-1], 0.0)
    vectors = ascending_vectors[:, ::-1]
    error = np.sqrt(np.maximum(1.0 - np.cumsum(values) / values.sum(), 0.0))
    count = int(np.argmax(error <= max_error)) + 1
    modes = vectors[:, :count].T
    if has_fewer_rows:
        modes = modes @ relative / np.sqrt(values[:count, None])
    return (relative @ modes.T).reshape(*stress.shape[:-1], count), modes * size
