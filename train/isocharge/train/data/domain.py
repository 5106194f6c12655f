"""The contacts a model knows, and the range of charges it takes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array


@dataclass(frozen=True)
class ContactDomain:
    """The contacts that a model knows: a disk and a range of forces.

    Attributes:
        radius_mm: Radius of the working area.
        force_range_N: Smallest and largest force.
    """

    radius_mm: float
    force_range_N: tuple[float, float]

    @property
    def centre(self) -> Array:
        """Middle of (x_mm, y_mm, ln force), shape (3,)."""
        low, high = np.log(self.force_range_N)
        return np.array([0.0, 0.0, 0.5 * (low + high)])

    @property
    def scale(self) -> Array:
        """Half width of (x_mm, y_mm, ln force), shape (3,)."""
        low, high = np.log(self.force_range_N)
        return np.array([self.radius_mm, self.radius_mm, max(0.5 * (high - low), 0.05)])

    def to_unit(self, contact: Array) -> Array:
        """(x_mm, y_mm, force_N), shape (n, 3), to [-1, 1]^3."""
        logs = np.stack([contact[:, 0], contact[:, 1], np.log(contact[:, 2])], axis=1)
        unit: Array = (logs - self.centre) / self.scale
        return unit

    def to_contact(self, unit: Array) -> Array:
        """The inverse of `to_unit`: shape (n, 3) to (x_mm, y_mm, force_N), shape (n, 3)."""
        contact: Array = unit * self.scale + self.centre
        contact[..., 2] = np.exp(contact[..., 2])
        return contact


LOWEST_PC, HIGHEST_PC = 1.0, 1e6
"""Charges are brought between these before the logarithm: what is negative or absurd still gives a finite answer."""


def inner_radius(polygon_mm: Sequence[tuple[float, float]]) -> float:
    """Radius of the largest disk about the origin in a convex polygon, mm, to 0.001 mm."""
    corners = np.array(polygon_mm)
    along = np.roll(corners, -1, axis=0) - corners
    distances = np.abs(along[:, 0] * corners[:, 1] - along[:, 1] * corners[:, 0]) / np.hypot(*along.T)
    return round(float(distances.min()), 3)
