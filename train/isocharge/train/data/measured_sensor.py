"""Description of a sensor without a sensor file: the names of its channels, and the area that was pressed."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import PressError
from isocharge.serve.model.validity import inside_polygon
from isocharge.simulate import Domain

HULL_RATIO = 0.3
"""Length above which an edge of the outline bends inwards to further places.

It is relative to the range of the distances between neighbouring places, of which the shortest is 0 and the longest 1.
"""

LEAST_RANGE = 1.1
"""Smallest ratio of the largest to the smallest force of a domain, which applies even if all forces are equal."""

LEAST_WIDTH = 1e-3
"""Smallest ratio of the standard deviations of the places across and along their main direction."""


@dataclass(frozen=True)
class MeasuredSensor:
    """Description of a sensor without a sensor file, for the metadata of a model.

    Attributes:
        name: Name of the sensor, in whose system of coordinates x and y are given.
        electrode_names: Names of the channels, in the order of their charges.
    """

    name: str
    electrode_names: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the description for the metadata of a model."""
        return {"name": self.name, "electrodes": list(self.electrode_names)}


@dataclass(frozen=True)
class PressedArea(Domain):
    """Domain of measured contacts: an area of any shape and position, and a range of forces.

    `radius` is the distance of the farthest corner from the middle of the area, not from the origin.

    Attributes:
        corners: Corners (x, y) of the area in the order along its outline, mm.
    """

    corners: tuple[tuple[float, float], ...]

    @classmethod
    def of_contacts(cls, contact: Array) -> "PressedArea":
        """Return the domain of given contacts: the outline of their places, and the range of their forces.

        If all forces are nearly equal, the range of forces is enlarged.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Raises:
            PressError: If the places lie on a line.
        """
        places = np.unique(contact[:, :2], axis=0)
        corners = np.round(outline(places), 4)  # to 0.1 um
        force = contact[:, 2]
        min_force = float(force.min())
        max_force = float(force.max())
        if max_force < LEAST_RANGE * min_force:
            # Both ends are moved by the same factor, so that their geometric mean remains.
            min_force /= LEAST_RANGE**0.5
            max_force *= LEAST_RANGE**0.5
        return cls.of_corners(corners, (min_force, max_force))

    @classmethod
    def of_corners(cls, corners: Array, force_range: tuple[float, float]) -> "PressedArea":
        """Return the domain with the given corners (x, y), shape (n, 2), mm, and the given range of forces, N."""
        distance_from_middle = np.linalg.norm(corners - _box_middle(corners), axis=1)
        return cls(float(distance_from_middle.max()), force_range, tuple((x, y) for x, y in corners.tolist()))

    @cached_property
    def centre(self) -> Array:
        """Middles of the ranges of x, y and ln F, shape (3,), with x and y in mm and F in N."""
        return np.append(_box_middle(np.array(self.corners)), super().centre[2])

    @cached_property
    def scale(self) -> Array:
        """Half widths of the ranges of x, y and ln F, shape (3,), with x and y in mm and F in N."""
        return np.append(0.5 * np.ptp(np.array(self.corners), axis=0), super().scale[2])

    @property
    def _allowed_positions(self) -> str:
        """Description of the allowed positions for error messages."""
        left, bottom = np.min(self.corners, axis=0)
        right, top = np.max(self.corners, axis=0)
        return f"a place in the pressed area, x from {left:g} to {right:g} mm and y from {bottom:g} to {top:g} mm,"

    def is_outside(self, contact: Array) -> Booleans:
        """Return whether each contact is outside the area or outside the range of forces.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N. Contacts with NaN do not count as outside.

        Returns:
            Whether each contact is outside, shape (n,).
        """
        is_known = ~np.isnan(contact).any(axis=1)
        return np.asarray(is_known & ~self.contains(contact))

    def contains(self, contact: Array) -> Booleans:
        """Return whether each contact lies in the area and in the range of forces.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N. Contacts with NaN do not lie in the domain.

        Returns:
            Whether each contact lies in the domain, shape (n,).
        """
        has_force = Domain(np.inf, self.force_range).contains(contact)
        return has_force & inside_polygon(contact[:, 0], contact[:, 1], np.array(self.corners))


def _box_middle(corners: Array) -> Array:
    """Return the middle of the bounding box of corners (x, y), shape (2,), mm."""
    return np.asarray(0.5 * (corners.min(axis=0) + corners.max(axis=0)))


def outline(places: Array) -> Array:
    """Compute the outline of the area that places cover.

    The outline is the concave hull of the places. It is moved outwards by half the median distance between neighbouring
    places.

    Args:
        places: Positions (x, y), all different, shape (m, 2), mm.

    Returns:
        Corners of the outline, anticlockwise, shape (n, 2), mm.

    Raises:
        PressError: If the places lie on a line, or almost.
    """
    # The singular values are proportional to the extents of the places along their principal axes.
    length, width = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if width <= LEAST_WIDTH * length:
        raise PressError(f"expected presses over an area, got {len(places)} places on one line; press beside it, too")

    # The nearest place is the place itself, and the second nearest is its nearest neighbour.
    distances, _ = cKDTree(places).query(places, 2)
    spacing = float(np.median(distances[:, 1]))
    exterior = shapely.concave_hull(shapely.MultiPoint(places), HULL_RATIO).simplify(0.0)
    enlarged = exterior.buffer(0.5 * spacing, join_style="mitre", mitre_limit=2.0)
    return np.asarray(shapely.get_coordinates(enlarged.normalize().exterior)[:0:-1])
