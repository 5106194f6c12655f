"""Set of contacts for which a charge map is valid, and checks of contacts."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import SceneError

MIN_LOG_FORCE_HALF_WIDTH = 0.05
"""Smallest half width of a domain in ln F, dimensionless.

Without this limit, a domain with a single force would have the half width zero, and contacts could not be scaled.
"""

LIMIT_TOLERANCE = 1.0 + 1e-9
"""Factor by which a distance or a force may exceed the limits of a domain, in order to allow for rounding errors."""


@dataclass(frozen=True)
class Domain:
    """Set of contacts for which a charge map is valid.

    The positions of the contacts lie in a disk around the centre of the film, and the forces lie in an interval.

    Attributes:
        radius: Largest distance from the centre, mm.
        force_range: Smallest and largest force, N.
    """

    radius: float
    force_range: tuple[float, float]

    @property
    def centre(self) -> Array:
        """Centre of the domain in the coordinates x (mm), y (mm) and ln F, where F is the force in N, shape (3,)."""
        low, high = np.log(self.force_range)
        return np.array([0.0, 0.0, 0.5 * (low + high)])

    @property
    def scale(self) -> Array:
        """Half width of the domain along x (mm), y (mm) and ln F, where F is the force in N, shape (3,)."""
        low, high = np.log(self.force_range)
        return np.array([self.radius, self.radius, max(0.5 * (high - low), MIN_LOG_FORCE_HALF_WIDTH)])

    def is_outside(self, contact: Array) -> Booleans:
        """Return whether each contact lies outside the disk or has a force outside the range of forces.

        The comparison allows for rounding errors.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N. A position or a force that is NaN counts as inside.

        Returns:
            Whether each contact lies outside, shape (n,).
        """
        x, y, force = contact.T
        low, high = self.force_range
        is_off_disk = np.hypot(x, y) > self.radius * LIMIT_TOLERANCE
        return np.asarray(is_off_disk | (force < low / LIMIT_TOLERANCE) | (force > high * LIMIT_TOLERANCE))

    def to_unit(self, contact: Array) -> Array:
        """Convert contacts (x, y, F) into coordinates (x, y, ln F) that are scaled to the cube [-1, 1]^3.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Scaled coordinates, shape (n, 3), dimensionless.
        """
        return (with_log_force(contact) - self.centre) / self.scale

    def to_contact(self, unit: Array) -> Array:
        """Convert the scaled coordinates that `to_unit` returns back into contacts (x, y, F).

        Args:
            unit: Scaled coordinates, shape (..., 3), dimensionless.

        Returns:
            Contacts (x, y, F), shape (..., 3), mm and N.
        """
        contact: Array = unit * self.scale + self.centre
        contact[..., 2] = np.exp(contact[..., 2])
        return contact

    def within(self, radius: float) -> "Domain":
        """Return a copy of the domain with another radius (mm) and the same range of forces."""
        return Domain(radius, self.force_range)

    def contains(self, contact: Array) -> Booleans:
        """Return whether each contact lies in the domain.

        The comparison allows for rounding errors. A contact that contains NaN lies outside.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Whether each contact lies in the domain, shape (n,).
        """
        return ~self.is_outside(contact) & ~np.isnan(contact).any(axis=1)

    def check(self, contact: Array, source: str) -> Array:
        """Convert contacts into an array of floats, and raise an error if a contact lies outside the domain.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            source: Name of the charge map in the error message, such as "forward map".

        Returns:
            The same contacts as an array of floats, shape (n, 3).

        Raises:
            SceneError: If the array does not have the shape (n, 3), or a contact lies outside the domain.
        """
        contact = as_contacts(contact, source)
        is_inside = self.contains(contact)
        if not is_inside.all():
            first_outside = np.argmin(is_inside)  # index of the first False
            x, y, force = contact[first_outside]
            low, high = self.force_range
            raise SceneError(
                f"press {first_outside} at ({x:.4g}, {y:.4g}) mm with {force:.4g} N is outside the {source}: expected "
                f"at most {self.radius:g} mm from the centre and {low:g} to {high:g} N"
            )
        return contact


def with_log_force(contact: Array) -> Array:
    """Convert contacts (x, y, F), shape (n, 3), mm and N, into (x, y, ln F)."""
    return np.column_stack([contact[:, :2], np.log(contact[:, 2])])


def into_unit_domain(unit: Array) -> Array:
    """Move each point outside the unit cylinder (the unit disk times [-1, 1]) to the nearest point of the cylinder.

    Args:
        unit: Scaled coordinates, as `Domain.to_unit` returns them, shape (n, 3). The first two coordinates belong to
            the disk.

    Returns:
        Points in the cylinder, shape (n, 3).
    """
    distance = np.hypot(unit[:, 0], unit[:, 1])
    return np.column_stack([unit[:, :2] / np.maximum(distance, 1.0)[:, None], np.clip(unit[:, 2], -1.0, 1.0)])


def as_contacts(contact: Array, source: str) -> Array:
    """Convert contacts into an array of floats, and check that the array has the shape (n, 3).

    Args:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        source: Name of the charge map in the error message, such as "forward map".

    Returns:
        The same contacts as an array of floats, shape (n, 3).

    Raises:
        SceneError: If the array has another shape.
    """
    contact = np.asarray(contact, dtype=float)
    if contact.ndim != 2 or contact.shape[1] != 3:
        raise SceneError(
            f"{source}: expected contacts (x, y, F), shape (n, 3), mm and N, like [[3.0, -2.0, 1.0]], got shape "
            f"{contact.shape}"
        )
    return contact
