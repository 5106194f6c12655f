"""The lookup table over forces and positions, the second remedy of Mirbagheri et al. (2007), interpolated.

An entry is a contact with the mean of its presses; with it goes the affine map that fits its neighbourhood best. Large
neighbourhoods of noisy presses average the noise, small ones of clean presses follow the map: validation decides. (The
table without interpolation is a nearest neighbour.)
"""

import numpy as np
from scipy.spatial import cKDTree
from sklearn.base import BaseEstimator, RegressorMixin

from isocharge.common.arrays import Array

CHUNK = 100_000
"""Neighbours gathered at once."""

RIDGE = 1e-6
"""Relative ridge of an affine map: neighbours may lie in a plane."""


class AffineTable(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Nearest entry and its affine map.

    Attributes:
        neighbours: Presses that a map is fitted to.
    """

    def __init__(self, neighbours: int = 64) -> None:
        self.neighbours = neighbours

    def fit(self, values: Array, target: Array) -> "AffineTable":
        """Entries and maps; rows with the same target are one entry."""
        _, entry, count = np.unique(target, axis=0, return_inverse=True, return_counts=True)
        sums = np.zeros((count.size, values.shape[1]))
        np.add.at(sums, entry.ravel(), values)
        entries, presses = sums / count[:, None], cKDTree(values)
        chunk = max(1, CHUNK // self.neighbours)
        parts = []
        for at in np.array_split(entries, len(entries) // chunk + 1):
            rows = presses.query(at, range(1, min(self.neighbours, len(values)) + 1))[1]
            parts.append(affine_maps(values[rows] - at[:, None], target[rows]))
        self.tree_, self.maps_ = cKDTree(entries), np.concatenate(parts)
        return self

    def predict(self, values: Array) -> Array:
        """The nearest entries' maps."""
        rows = self.tree_.query(values)[1]
        answers: Array = np.einsum("ne,nek->nk", values - self.tree_.data[rows], self.maps_[rows, :-1])
        answers += self.maps_[rows, -1]
        return answers


def affine_maps(offset: Array, target: Array) -> Array:
    """Least squares with a ridge on the slopes.

    Args:
        offset: Presses about each entry, shape (m, k, p).
        target: Theirs, shape (m, k, q).

    Returns:
        Shape (m, p + 1, q): (offset, 1) times the map is the target.
    """
    columns = np.concatenate([offset, np.ones((*offset.shape[:2], 1))], axis=2)
    normal = columns.transpose(0, 2, 1) @ columns
    size = np.trace(normal[:, :-1, :-1], axis1=1, axis2=2)
    normal[:, :-1, :-1] += RIDGE * size[:, None, None] * np.eye(offset.shape[2])
    maps: Array = np.linalg.solve(normal, columns.transpose(0, 2, 1) @ target)
    return maps
