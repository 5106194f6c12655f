"""Local cubic interpolation on even grids: four neighbours along each axis."""

import numpy as np

from isocharge.common.arrays import Array, Integers

TAPS = np.arange(4)
"""Neighbours along one axis."""


def cubic_weights(at: Array, count: int, periodic: bool = False) -> tuple[Integers, Array]:
    """Weights of the four neighbours of places between the nodes 0, 1, ..., count - 1.

    Args:
        at: Places in steps of the grid, any shape; beyond an end they are extrapolated.
        count: Number of nodes, at least four.
        periodic: Whether node `count` is node 0 again.

    Returns:
        Numbers of the neighbours and their weights, each of shape (..., 4).
    """
    first = np.floor(at).astype(np.intp) - 1
    if not periodic:
        first = np.clip(first, 0, count - 4)
    t = (at - first)[..., None]
    a, b, c, d = t, t - 1.0, t - 2.0, t - 3.0
    weights = np.concatenate([-b * c * d / 6.0, a * c * d / 2.0, -a * b * d / 2.0, a * b * c / 6.0], axis=-1)
    number = first[..., None] + TAPS
    return number % count if periodic else number, weights
