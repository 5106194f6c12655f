"""Patterns of points in a disk, projection of points onto the edge of a disk, and contacts at given points."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.polygon import to_corners

ROUNDING = 1e-9
"""Relative tolerance for points on the edge of a disk, dimensionless."""

INNER_RADIUS = 1.0 - ROUNDING
"""Radius of a disk that lies just inside the disk with the radius one, dimensionless.

Contacts are searched for in the smaller disk, because rounding errors would otherwise move some contacts out of the
domain of a charge map.
"""


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
        """Create evenly spaced rings, the outermost of which has the given radius.

        The positions do not include the centre of the rings.

        Args:
            radius: Radius of the outermost ring.
            rings: Number of rings.
            angles: Number of positions on each ring.
        """
        distance = radius * np.arange(1, rings + 1) / rings
        return cls._at(distance, np.exp(2j * np.pi * np.arange(angles) / angles))

    @classmethod
    def between(cls, inner: float, outer: float, rings: int, sectors: int) -> "Rings":
        """Divide the area between two circles into rings of equal width, and each ring into sectors.

        The positions are the middles of the sectors. The first sector begins at the x axis, and the others follow
        anticlockwise.

        Args:
            inner: Radius of the inner circle.
            outer: Radius of the outer circle.
            rings: Number of rings.
            sectors: Number of sectors of each ring.
        """
        edges = np.linspace(inner, outer, rings + 1)
        distance = 0.5 * (edges[1:] + edges[:-1])
        return cls._at(distance, np.exp(2j * np.pi * (np.arange(sectors) + 0.5) / sectors))

    @classmethod
    def _at(cls, distance: Array, direction: Complexes) -> "Rings":
        """Create rings from radii, shape (n_ring,), and from directions as unit vectors x + iy, shape (n_angle,)."""
        return cls(distance, to_corners(np.outer(distance, direction)))

    def contacts(self, force: float) -> Array:
        """Return one contact (x, y, F) for each position. All contacts have the same force F.

        Args:
            force: Force of all contacts, N.

        Returns:
            Contacts, ordered ring by ring, shape (n_ring * n_angle, 3).
        """
        return contacts_at(self.position.reshape(-1, 2), force)

    def per_ring(self, values: Array) -> Array:
        """Split the first axis of an array into one axis for the rings and one axis for the angles.

        Args:
            values: Values of all contacts, in the order of `contacts`, shape (n_ring * n_angle, ...).

        Returns:
            The same values, shape (n_ring, n_angle, ...).
        """
        return values.reshape(*self.position.shape[:2], *values.shape[1:])


def onto_disk(position: Array, radius: float) -> Array:
    """Replace each position outside a disk by the nearest point on the edge of the disk.

    Args:
        position: Positions (x, y), shape (..., 2), in the unit of the radius.
        radius: Radius of the disk, whose centre is the origin.

    Returns:
        Positions within the disk or on its edge, same shape. Positions inside the disk are unchanged.
    """
    relative_distance = np.linalg.norm(position, axis=-1, keepdims=True) / radius
    return np.asarray(position / np.maximum(1.0, relative_distance))


def contacts_at(position: Array, force: float) -> Array:
    """Return contacts (x, y, F), shape (n, 3), with the same force F at all positions (x, y), shape (n, 2)."""
    return np.column_stack([position, np.full(len(position), force)])


def log_spaced_forces(fraction: Array, force_range: tuple[float, float]) -> Array:
    """Return the forces at given fractions of a range of forces on a logarithmic scale.

    Args:
        fraction: Fractions from 0 (smallest force) to 1 (largest force), any shape.
        force_range: Smallest and largest force, N.

    Returns:
        Forces, same shape, N.
    """
    min_log_force, max_log_force = np.log(force_range)
    force = np.exp(min_log_force + (max_log_force - min_log_force) * fraction)
    return np.asarray(np.clip(force, *force_range))  # rounding must not move a force out of the range


def sunflower(count: int) -> Array:
    """Return points that are distributed evenly over the unit disk.

    The points are arranged like the seeds of a sunflower (Vogel 1979).

    Args:
        count: Number of points.

    Returns:
        Points (x, y), sorted by their distance from the centre of the disk, shape (count, 2).
    """
    number = np.arange(count)
    golden_angle = np.pi * (3.0 - np.sqrt(5.0))
    distance = np.sqrt((number + 0.5) / count)
    return to_corners(distance * np.exp(1j * golden_angle * number))
