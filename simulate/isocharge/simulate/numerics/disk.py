"""Points on a disk: square lattices, the sunflower pattern, rings, and the projection of points onto the disk."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Complexes

INNER_RADIUS = 1.0 - 1e-9
"""Radius within which contacts are searched, in units of the radius of the charge map, dimensionless. The value is
smaller than one, so that rounding errors do not move a contact out of the disk."""

ROUNDING = 1e-9
"""Relative tolerance for points on the edge of a disk, dimensionless."""


def onto_disk(position: Array, radius: float) -> Array:
    """Move positions outside a disk to the nearest point of its edge.

    Args:
        position: Positions (x, y), shape (n, 2), in the unit of the radius.
        radius: Radius of the disk, whose centre is the origin.

    Returns:
        Positions within the disk, shape (n, 2).
    """
    relative_distance = np.hypot(*position.T) / radius
    return np.asarray(position / np.maximum(1.0, relative_distance)[:, None])


@dataclass(frozen=True)
class Rings:
    """Positions on concentric rings.

    Attributes:
        distance: Radius of each ring, shape (n_ring,).
        position: Positions (x, y), shape (n_ring, n_angle, 2), in the unit of the radii.
    """

    distance: Array
    position: Array

    @classmethod
    def spread(cls, radius: float, rings: int = 100, angles: int = 180) -> "Rings":
        """Create rings with equal distances between them. The outermost ring has the given radius.

        The centre of the rings is not one of the positions.

        Args:
            radius: Radius of the outermost ring.
            rings: Number of rings.
            angles: Number of positions on each ring.
        """
        distance = radius * np.arange(1, rings + 1) / rings
        z = np.outer(distance, np.exp(2j * np.pi * np.arange(angles) / angles))
        return cls(distance, np.stack([z.real, z.imag], axis=-1))

    def contacts(self, force: float) -> Array:
        """Return the contact (x, y, F) at every position, shape (n_ring * n_angle, 3).

        Args:
            force: Force of all contacts, N.
        """
        flat = self.position.reshape(-1, 2)
        return np.concatenate([flat, np.full((len(flat), 1), force)], axis=1)

    def per_ring(self, values: Array) -> Array:
        """Reshape values of all contacts, shape (n_ring * n_angle, ...), to shape (n_ring, n_angle, ...)."""
        return values.reshape(*self.position.shape[:2], *values.shape[1:])


def lattice(max_count: int) -> Complexes:
    """Return the points x + iy of a square lattice in the unit disk.

    The number of points is as large as possible, but at most `max_count`. The centre of the disk is one of the points,
    and the outermost points lie on the unit circle.

    Args:
        max_count: Largest number of points.

    Returns:
        Points in the order of their distance from the centre, shape (n,).
    """
    # Integer coordinates of a square that contains the disk
    max_count = max(max_count, 1)
    half_side = int(np.sqrt(max_count / np.pi)) + 2
    line = np.arange(-half_side, half_side + 1)
    x_grid, y_grid = np.meshgrid(line, line)
    squared_distance = x_grid**2 + y_grid**2

    # Find the largest radius within which the lattice has at most `max_count` points.
    squared_radii, point_counts = np.unique(squared_distance, return_counts=True)
    n_radii = np.searchsorted(np.cumsum(point_counts), max_count, side="right")
    squared_radius = squared_radii[n_radii - 1]

    # Sort the points by the distance, then by x and y, and scale the disk to the radius 1.
    is_inside = squared_distance <= squared_radius
    x = x_grid[is_inside]
    y = y_grid[is_inside]
    order = np.lexsort((y, x, squared_distance[is_inside]))
    radius = max(np.sqrt(squared_radius), 1.0)  # 1 if the centre is the only point
    rounding_margin = 1.0 - 1e-15  # keeps the outermost points within the unit circle
    return np.asarray((x[order] + 1j * y[order]) / radius * rounding_margin)


def square_grid(radius: float, spacing: float) -> Array:
    """Return the points of a square grid in a disk. The centre of the disk is one of the points.

    Args:
        radius: Radius of the disk.
        spacing: Distance between neighbouring points, in the unit of the radius.

    Returns:
        Points (x, y), shape (n, 2).
    """
    steps_to_edge = int(radius / spacing * (1.0 + ROUNDING))
    line = spacing * np.arange(-steps_to_edge, steps_to_edge + 1)
    x_grid, y_grid = np.meshgrid(line, line)
    points = np.stack([x_grid.ravel(), y_grid.ravel()], axis=1)
    is_inside = np.hypot(points[:, 0], points[:, 1]) <= radius * (1.0 + ROUNDING)
    return np.asarray(points[is_inside])


def sunflower(count: int) -> Complexes:
    """Return `count` points x + iy that are distributed evenly over the unit disk, shape (count,).

    The points form the pattern of the seeds of a sunflower (Vogel 1979). The points are ordered by the distance from
    the centre.
    """
    number = np.arange(count)
    golden_angle = np.pi * (3.0 - np.sqrt(5.0))
    return np.asarray(np.sqrt((number + 0.5) / count) * np.exp(1j * golden_angle * number))
