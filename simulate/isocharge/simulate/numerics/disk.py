"""Regular patterns of points in a disk, and projection of points outside a disk onto its edge."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Complexes

ROUNDING = 1e-9
"""Relative tolerance for points on the edge of a disk, dimensionless."""

INNER_RADIUS = 1.0 - ROUNDING
"""Radius of the disk in which contacts are searched for, divided by the radius of the charge map, dimensionless.

The value is smaller than one, because rounding errors would otherwise move some contacts out of the disk.
"""


def onto_disk(position: Array, radius: float) -> Array:
    """Replace each position outside a disk by the nearest point on the edge of the disk.

    Args:
        position: Positions (x, y), shape (n, 2), in the unit of the radius.
        radius: Radius of the disk, whose centre is the origin.

    Returns:
        Positions within the disk or on its edge, shape (n, 2). Positions that were inside are unchanged.
    """
    x, y = position.T
    relative_distance = np.hypot(x, y) / radius
    return np.asarray(position / np.maximum(1.0, relative_distance)[:, None])


@dataclass(frozen=True)
class Rings:
    """Positions on concentric rings around the origin.

    Attributes:
        distance: Radius of each ring, shape (n_ring,).
        position: Positions (x, y), shape (n_ring, n_angle, 2), in the unit of the radii.
    """

    distance: Array
    position: Array

    @classmethod
    def spread(cls, radius: float, rings: int = 100, angles: int = 180) -> "Rings":
        """Create rings with equal distances between them. The outermost ring has the given radius.

        The positions do not include the centre of the rings.

        Args:
            radius: Radius of the outermost ring.
            rings: Number of rings.
            angles: Number of positions on each ring.
        """
        distance = radius * np.arange(1, rings + 1) / rings
        z = np.outer(distance, np.exp(2j * np.pi * np.arange(angles) / angles))
        return cls(distance, np.stack([z.real, z.imag], axis=-1))

    def contacts(self, force: float) -> Array:
        """Return one contact (x, y, F) for each position. All contacts have the same force F.

        Args:
            force: Force of all contacts, N.

        Returns:
            Contacts, ordered ring by ring, shape (n_ring * n_angle, 3).
        """
        flat_position = self.position.reshape(-1, 2)
        return np.concatenate([flat_position, np.full((len(flat_position), 1), force)], axis=1)

    def per_ring(self, values: Array) -> Array:
        """Split the first axis of an array into one axis for the rings and one axis for the angles.

        Args:
            values: Values of all contacts, in the order of `contacts`, shape (n_ring * n_angle, ...).

        Returns:
            The same values, shape (n_ring, n_angle, ...).
        """
        return values.reshape(*self.position.shape[:2], *values.shape[1:])


def lattice(max_count: int) -> Complexes:
    """Return the points of a square lattice within the unit disk as complex numbers x + iy.

    The lattice has as many points as possible, but not more than `max_count`. One of the points is the centre of the
    disk. The outermost points lie on the unit circle.

    Args:
        max_count: Largest allowed number of points. A number below 1 counts as 1.

    Returns:
        Points, sorted by their distance from the centre, shape (n,).
    """
    # Integer coordinates of a square that contains a disk with `max_count` points. Such a disk has about the area
    # `max_count`, because there is one point per unit area. The 2 is a margin.
    max_count = max(max_count, 1)
    half_side = int(np.sqrt(max_count / np.pi)) + 2
    coordinates = np.arange(-half_side, half_side + 1)
    x_grid, y_grid = np.meshgrid(coordinates, coordinates)
    squared_distance = x_grid**2 + y_grid**2

    # Find the largest radius within which the lattice has at most `max_count` points.
    squared_radii, point_counts = np.unique(squared_distance, return_counts=True)
    n_allowed_radii = np.searchsorted(np.cumsum(point_counts), max_count, side="right")
    squared_radius = squared_radii[n_allowed_radii - 1]

    # Sort the points by the distance from the centre, and by x and y if the distances are equal.
    is_inside = squared_distance <= squared_radius
    x = x_grid[is_inside]
    y = y_grid[is_inside]
    order = np.lexsort((y, x, squared_distance[is_inside]))

    # Scale the lattice such that the outermost points have the distance 1 from the centre.
    radius = max(np.sqrt(squared_radius), 1.0)  # the radius is 0 if the centre is the only point
    rounding_margin = 1.0 - 1e-15  # keeps the outermost points within the unit circle despite rounding errors
    return np.asarray((x[order] + 1j * y[order]) / radius * rounding_margin)


def square_grid(radius: float, spacing: float) -> Array:
    """Return the points of a square grid that lie within a disk. One of the points is the centre of the disk.

    Args:
        radius: Radius of the disk, whose centre is the origin.
        spacing: Distance between neighbouring points, in the unit of the radius.

    Returns:
        Points (x, y), shape (n, 2), including points on the edge of the disk.
    """
    # The tolerance keeps points on the edge of the disk, whose distance may exceed the radius by a rounding error.
    radius_with_tolerance = radius * (1.0 + ROUNDING)
    intervals_to_edge = int(radius / spacing * (1.0 + ROUNDING))
    coordinates = spacing * np.arange(-intervals_to_edge, intervals_to_edge + 1)
    x_grid, y_grid = np.meshgrid(coordinates, coordinates)
    points = np.stack([x_grid.ravel(), y_grid.ravel()], axis=1)
    distance_from_centre = np.hypot(points[:, 0], points[:, 1])
    return np.asarray(points[distance_from_centre <= radius_with_tolerance])


def sunflower(count: int) -> Complexes:
    """Return points x + iy that are distributed evenly over the unit disk.

    The points are arranged like the seeds of a sunflower (Vogel 1979).

    Args:
        count: Number of points.

    Returns:
        Points, sorted by their distance from the centre of the disk, shape (count,).
    """
    number = np.arange(count)
    golden_angle = np.pi * (3.0 - np.sqrt(5.0))
    return np.asarray(np.sqrt((number + 0.5) / count) * np.exp(1j * golden_angle * number))
