"""Points on a disk: lattice, square grid, sunflower, rings, and the projection back onto it."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Complexes

INSIDE = 1.0 - 1e-9
"""Radius that is searched, relative to a map's: rounding must not leave the disk."""


def onto_disk(position: Array, radius: float) -> Array:
    """Positions (x, y), shape (n, 2), those outside the disk moved onto its edge, in the unit of the radius."""
    return np.asarray(position / np.maximum(1.0, np.hypot(*position.T) / radius)[:, None])


@dataclass(frozen=True)
class Rings:
    """Positions on rings about the centre.

    Attributes:
        distance: From the centre, shape (n_ring,).
        position: x and y, shape (n_ring, n_angle, 2), in the same unit.
    """

    distance: Array
    position: Array

    @classmethod
    def spread(cls, radius: float, rings: int = 100, angles: int = 180) -> "Rings":
        """Evenly up to the radius, without the centre."""
        distance = radius * np.arange(1, rings + 1) / rings
        at = np.outer(distance, np.exp(2j * np.pi * np.arange(angles) / angles))
        return cls(distance, np.stack([at.real, at.imag], axis=-1))

    def contacts(self, force: float) -> Array:
        """(x, y, F) of every position, shape (n_ring * n_angle, 3)."""
        flat = self.position.reshape(-1, 2)
        return np.concatenate([flat, np.full((len(flat), 1), force)], axis=1)

    def per_ring(self, values: Array) -> Array:
        """Values of all contacts as (n_ring, n_angle, ...)."""
        return values.reshape(*self.position.shape[:2], *values.shape[1:])


def lattice(most: int) -> Complexes:
    """Points x + iy of the largest square lattice with at most `most` points in the unit disk.

    The centre is one of them and the outermost lie on the circle; from the inside out, shape (n,).
    """
    reach = int(np.sqrt(max(most, 1) / np.pi)) + 2
    i, j = (axis.ravel() for axis in np.meshgrid(*[np.arange(-reach, reach + 1)] * 2))
    squared = i**2 + j**2
    rings, counts = np.unique(squared, return_counts=True)
    ring = rings[np.searchsorted(np.cumsum(counts), max(most, 1), side="right") - 1]
    inside = np.flatnonzero(squared <= ring)
    inside = inside[np.lexsort((j[inside], i[inside], squared[inside]))]
    return np.asarray((i[inside] + 1j * j[inside]) / max(np.sqrt(ring), 1.0) * (1.0 - 1e-15))


def square_grid(radius: float, spacing: float) -> Array:
    """Places of a square grid through the centre of a disk, shape (n, 2), in the unit of the radius."""
    count = int(radius / spacing * (1.0 + 1e-9))
    x, y = (axis.ravel() for axis in np.meshgrid(*[spacing * np.arange(-count, count + 1)] * 2))
    return np.asarray(np.stack([x, y], axis=1)[np.hypot(x, y) <= radius * (1.0 + 1e-9)])


def sunflower(count: int) -> Complexes:
    """`count` points x + iy spread evenly over the unit disk, from the inside out (Vogel 1979)."""
    number = np.arange(count)
    return np.asarray(np.sqrt((number + 0.5) / count) * np.exp(1j * np.pi * (3.0 - np.sqrt(5.0)) * number))
