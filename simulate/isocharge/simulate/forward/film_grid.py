"""The grid of a family of films: its axes, its nodes, and stresses on it as the coefficients of few modes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.theory import Theory
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values

AXES = ("distance", "load", "tension", "thickness", "reach")
"""The numbers that a press of a film is described by, in the order of the grid's axes."""

THEORY = Theory(stretching=True, bending=True, pretensioned=True)
"""All terms: a family holds slack films and taut ones."""

SOFTENING = 4e-4
"""Added to the tension before its logarithm is taken: about the strain that a press of 0.05 N induces, below which the
pretension makes no difference."""

FilmLimits = dict[str, tuple[float, float]]
"""Smallest and largest value along each of `AXES`, all dimensionless."""


@dataclass(frozen=True)
class FilmGrid:
    """Nodes of a family, one array for each of `AXES`, ascending.

    Attributes:
        distance: Of the press from the film's centre over the film's radius a.
        load: F / (E h a).
        tension: Pretension over E.
        thickness: h / a.
        reach: Radius of the probe over a.
    """

    distance: Array
    load: Array
    tension: Array
    thickness: Array
    reach: Array

    @classmethod
    def spread(cls, limits: FilmLimits, counts: Sequence[int]) -> "FilmGrid":
        """Chebyshev nodes between the limits: of load, reach and softened tension in the logarithm."""
        axes = {name: (_stretched(name, low), _stretched(name, high)) for name, (low, high) in limits.items()}
        nodes = [chebyshev_nodes(count, *axes[name]) for name, count in zip(AXES, counts, strict=True)]
        return cls(*(_unstretched(name, values) for name, values in zip(AXES, nodes, strict=True)))

    def weights(self, axis: str, at: float) -> Array:
        """Interpolation weights of an axis at one value, shape (n_node,)."""
        nodes = _stretched(axis, getattr(self, axis))
        return np.asarray(lagrange_values(nodes, barycentric_weights(nodes), np.array([_stretched(axis, at)]))[0])

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of nodes along each axis."""
        return tuple(getattr(self, name).size for name in AXES)


def _stretched(axis: str, value: Array | float) -> Any:
    """The coordinate in which an axis is interpolated by polynomials."""
    if axis in ("load", "reach"):
        return np.log(value)
    return np.log(value + SOFTENING) if axis == "tension" else value


def _unstretched(axis: str, value: Array) -> Array:
    if axis in ("load", "reach"):
        return np.exp(value)
    return np.maximum(np.exp(value) - SOFTENING, 0.0) if axis == "tension" else value


def bits_of(coefficients: Array, modes: Array, most: int, spare: float) -> Array:
    """Bits for each mode, shape (n_mode,): fewer, but for `spare` ones, for those of which there is little.

    Args:
        coefficients: Shape (..., n_mode).
        modes: Shape (n_mode, n).
        most: Bits of the largest mode.
        spare: As many modes share the error, each is given some bits more than its size asks for.
    """
    largest = np.abs(coefficients).reshape(-1, len(modes)).max(axis=0) * np.abs(modes).max(axis=1)
    return np.asarray(np.clip(np.round(most + spare + np.log2(largest / largest.max())), 2.0, most))


def quantised(values: Array, axis: int | tuple[int, ...], bits: Array | int) -> tuple[np.ndarray, Array]:
    """Integers of some bits, and the scales along an axis that give the values back: values = integers * scale."""
    scale = np.abs(values).max(axis=axis, keepdims=True) / (2 ** (bits - 1) - 1)
    return np.round(values / scale).astype(np.int16), scale


def decompose(stress: Array, left_out: float) -> tuple[Array, Array]:
    """Coefficients and modes of scaled stresses of shape (..., n): the fewest that leave out a share.

    Every node counts relative to its own stress: the peak under the probe would else hide the electrodes.
    """
    flat = stress.reshape(-1, stress.shape[-1])
    size = np.repeat(np.sqrt((flat.reshape(len(flat), -1, 3) ** 2).sum(axis=2).mean(axis=0)), 3)
    relative = flat / size
    few = len(relative) < relative.shape[1]  # the smaller of both products has the same values
    values, vectors = np.linalg.eigh(relative @ relative.T if few else relative.T @ relative)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    left = np.sqrt(np.maximum(1.0 - np.cumsum(values) / values.sum(), 0.0))
    count = int(np.argmax(left <= left_out)) + 1
    modes = vectors[:, :count].T
    if few:
        modes = modes @ relative / np.sqrt(values[:count, None])
    return (relative @ modes.T).reshape(*stress.shape[:-1], count), modes * size
