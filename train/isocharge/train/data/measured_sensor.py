"""Description of a sensor without a sensor file: the names of its channels, and the area that was pressed."""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import PressError
from isocharge.serve.model.validity import inside_polygon
from isocharge.simulate import Domain
from isocharge.simulate.numerics.polygon import area_of, to_complex, to_corners

LEAST_HOLE = 6.0
"""Radius of the circumscribed circle above which a triangle between places may be left out of the area.

The radius is relative to the distance between neighbouring places."""

LEAST_RANGE = 1.1
"""Smallest ratio of the largest to the smallest force of a domain, which applies even if all forces are equal."""

LEAST_WIDTH = 1e-3
"""Smallest ratio of the standard deviations of the places across and along their main direction."""

LONGEST_MITRE = 2.0
"""Largest ratio of the distance by which a corner is moved outwards to the distance by which the sides are moved."""


MIN_TURN_rad = 1e-6
"""Smallest angle by which an outline turns at a corner, rad. A corner with a smaller angle is left out."""


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

    The outline is moved outwards by half the median distance between neighbouring places. The area consists of
    triangles whose corners are places (alpha shape, Edelsbrunner et al., 1983). Only triangles with a sufficiently
    small circumscribed circle are used. Larger and larger limits of the radius are tried, until the triangles contain
    all places and have a single boundary. Holes are filled.

    Args:
        places: Positions (x, y), all different, shape (m, 2), mm.

    Returns:
        Corners of the outline, anticlockwise, shape (n, 2), mm.

    Raises:
        PressError: If the places lie on a line, or almost.
    """
    # The singular values are proportional to the extents of the places along their principal axes.
    line_message = f"expected presses over an area, got {len(places)} places on one line; press beside it, too"
    length, width = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if width <= LEAST_WIDTH * length:
        raise PressError(line_message)
    try:
        triangles = Delaunay(places).simplices
    except QhullError as error:
        raise PressError(line_message) from error

    # The nearest place is the place itself, and the second nearest is its nearest neighbour.
    distances, _ = cKDTree(places).query(places, 2)
    spacing = float(np.median(distances[:, 1]))
    circumradii = _circumradii(places[triangles])
    # Each limit is larger than the previous one by a factor of sqrt(2). The last limit includes all triangles.
    finite_limits = LEAST_HOLE * spacing * 2.0 ** np.arange(0.0, 20.0, 0.5)
    for radius_limit in [*finite_limits, np.inf]:
        boundary = _single_boundary(triangles[circumradii <= radius_limit], len(places))
        if boundary is not None:
            return _enlarged_polygon(places[boundary], 0.5 * spacing)
    raise PressError(f"expected presses over an area, got {len(places)} places that enclose none")


def _circumradii(corners: Array) -> Array:
    """Compute the radii of the circumscribed circles of triangles.

    The radius of a triangle with the sides a, b and c is a b c / (4 area).

    Args:
        corners: Corners (x, y) of the triangles, shape (n, 3, 2), mm.

    Returns:
        Radii, shape (n,), mm.
    """
    first_side = corners[:, 1] - corners[:, 0]
    second_side = corners[:, 2] - corners[:, 0]
    third_side = second_side - first_side
    lengths = [np.hypot(side[:, 0], side[:, 1]) for side in (first_side, second_side, third_side)]
    cross_product = first_side[:, 0] * second_side[:, 1] - first_side[:, 1] * second_side[:, 0]
    twice_area = np.abs(cross_product)
    # The lower limit avoids a division by zero for corners on a line.
    return np.asarray(np.prod(lengths, axis=0) / np.maximum(2.0 * twice_area, 1e-30))


def _single_boundary(triangles: Integers, n_place: int) -> list[int] | None:
    """Return the boundary of an area that consists of triangles, if the boundary is a single closed line.

    Args:
        triangles: Indices of the places at the corners of each triangle, shape (n, 3).
        n_place: Number of all places.

    Returns:
        Indices of the places on the boundary, in order. None if the boundary is not a single closed line, or if a place
        belongs to no triangle.
    """
    if len(np.unique(triangles)) < n_place:
        return None

    # On closed lines that do not touch each other, every place has two neighbours.
    neighbours = _boundary_neighbours(triangles)
    if any(len(place_neighbours) != 2 for place_neighbours in neighbours.values()):
        return None

    # Walk along the boundary until it returns to its first place.
    first_place = min(neighbours)
    boundary = [first_place]
    place = neighbours[first_place][0]
    while place != first_place:
        first_neighbour, second_neighbour = neighbours[place]
        previous_place = boundary[-1]
        boundary.append(place)
        place = second_neighbour if first_neighbour == previous_place else first_neighbour

    # If places of the boundary were not reached, there are further closed lines.
    return boundary if len(boundary) == len(neighbours) else None


def _boundary_neighbours(triangles: Integers) -> dict[int, list[int]]:
    """For each place on the boundary of an area of triangles, return its neighbours along the boundary.

    Args:
        triangles: Indices of the places at the corners of each triangle, shape (n, 3).

    Returns:
        Indices of the neighbours of each place on the boundary, by the index of the place.
    """
    # The ends of each edge are sorted, so that equal edges of two triangles are recognised.
    corner_pairs = [[0, 1], [1, 2], [2, 0]]
    edges = np.sort(triangles[:, corner_pairs].reshape(-1, 2), axis=1)
    triangles_per_edge = Counter(map(tuple, edges.tolist()))
    neighbours: dict[int, list[int]] = {}
    for (start, end), n_triangle in triangles_per_edge.items():
        is_on_boundary = n_triangle == 1  # an edge inside the area belongs to two triangles
        if is_on_boundary:
            neighbours.setdefault(start, []).append(end)
            neighbours.setdefault(end, []).append(start)
    return neighbours


def _enlarged_polygon(corners: Array, distance: float) -> Array:
    """Enlarge a polygon by moving all its sides outwards by the same distance.

    Points and directions in the plane are complex numbers x + i y, so a multiplication by -i turns a direction to the
    right.

    Args:
        corners: Corners (x, y) of the polygon, clockwise or anticlockwise, shape (n, 2), mm.
        distance: Distance by which each side is moved, mm. The displacement of a sharp corner is limited by
            `LONGEST_MITRE` times this distance.

    Returns:
        Corners, anticlockwise, shape (m, 2), mm. Corners between two sides in the same direction are left out.
    """
    # Make the corners anticlockwise, and leave out those at which the polygon does not turn.
    is_anticlockwise = area_of(corners) > 0.0
    all_points = to_complex(corners if is_anticlockwise else corners[::-1])
    all_sides = np.roll(all_points, -1) - all_points  # from each point to the next one
    turning_angle = np.angle(all_sides / np.roll(all_sides, 1))
    points = all_points[np.abs(turning_angle) > MIN_TURN_rad]

    # Unit normals of the sides that follow and precede each corner. A normal points to the right, which is outwards.
    sides = np.roll(points, -1) - points
    next_normal = -1j * sides / np.abs(sides)
    previous_normal = np.roll(next_normal, 1)

    # The displacement of each corner that moves both of its sides by 1, called the mitre. It is (m + n) / (1 + m n),
    # with the normals m and n of both sides and their scalar product m n. The mitre of a sharp corner is shortened.
    scalar_product = (previous_normal * np.conj(next_normal)).real
    denominator = np.maximum(1.0 + scalar_product, 1e-9)  # not zero
    mitre = (previous_normal + next_normal) / denominator
    limited_mitre = mitre * np.minimum(1.0, LONGEST_MITRE / np.abs(mitre))
    return to_corners(points + distance * limited_mitre)
