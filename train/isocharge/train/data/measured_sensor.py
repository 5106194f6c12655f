"""A sensor of measured presses alone, without a simulator: the names of its channels, and the area that was pressed."""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import PressError
from isocharge.serve.prediction.contact import inside_polygon
from isocharge.simulate import Domain
from isocharge.simulate.numerics.polygon import area_of, to_complex, to_corners

LEAST_HOLE = 6.0
"""Smallest gap between places that may be outside the area, over the distance between neighbours."""

LEAST_RANGE = 1.1
"""Least ratio of the largest to the smallest force: presses of one force are learned, too."""

LEAST_WIDTH = 1e-3
"""Smallest standard deviation of the places across the line on which they almost lie, relative to that along it."""

LONGEST_MITRE = 2.0
"""Largest distance by which a corner moves out, over that of the sides."""


@dataclass(frozen=True)
class MeasuredSensor:
    """What a model of measured presses says about its sensor.

    Attributes:
        name: Of the sensor: the frame of x and y.
        electrode_names: Of the channels, in the order of their charges.
    """

    name: str
    electrode_names: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """For metadata."""
        return {"name": self.name, "electrodes": list(self.electrode_names)}


@dataclass(frozen=True)
class PressedArea(Domain):
    """Domain of the contacts that were pressed: an area of any shape in any place, and a range of forces.

    `radius` is the distance of the farthest corner from the middle of the area, not from the origin.

    Attributes:
        corners: Corners of the area, in order, mm.
    """

    corners: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, contact: Array) -> "PressedArea":
        """Return the area of contacts (x, y, F), shape (n, 3), mm and N.

        Raises:
            PressError: If the places lie on a line.
        """
        corners = np.round(outline(np.unique(contact[:, :2], axis=0)), 4)
        low, high = float(contact[:, 2].min()), float(contact[:, 2].max())
        if high < LEAST_RANGE * low:
            low, high = low / LEAST_RANGE**0.5, high * LEAST_RANGE**0.5
        return cls.of_corners(corners, (low, high))

    @classmethod
    def of_corners(cls, corners: Array, force_range: tuple[float, float]) -> "PressedArea":
        """Return the area with these corners, shape (n, 2), mm, and forces, N."""
        distance_from_middle = np.linalg.norm(corners - _middle(corners), axis=1)
        return cls(float(distance_from_middle.max()), force_range, tuple((x, y) for x, y in corners.tolist()))

    @cached_property
    def centre(self) -> Array:
        """Middle of (x, y, ln F), shape (3,), mm and logarithm of N."""
        return np.append(_middle(np.array(self.corners)), super().centre[2])

    @cached_property
    def scale(self) -> Array:
        """Half width of (x, y, ln F), shape (3,), mm and logarithm of N."""
        return np.append(0.5 * np.ptp(np.array(self.corners), axis=0), super().scale[2])

    @property
    def places(self) -> str:
        """Words that say where contacts may lie."""
        left, bottom = np.min(self.corners, axis=0)
        right, top = np.max(self.corners, axis=0)
        return f"a place in the pressed area, x from {left:g} to {right:g} mm and y from {bottom:g} to {top:g} mm,"

    def is_outside(self, contact: Array) -> Booleans:
        """Return which contacts, shape (n, 3), are outside the area or the range of forces; with NaN, none is."""
        is_known = ~np.isnan(contact).any(axis=1)
        return np.asarray(is_known & ~self.contains(contact))

    def contains(self, contact: Array) -> Booleans:
        """Return which contacts (x, y, F), shape (n, 3), mm and N, lie in the domain, shape (n,); NaN does not."""
        has_force = Domain(np.inf, self.force_range).contains(contact)
        return has_force & inside_polygon(contact[:, 0], contact[:, 1], np.array(self.corners))


def _middle(corners: Array) -> Array:
    """Return the middle of the box around corners, shape (2,), mm."""
    return np.asarray(0.5 * (corners.min(axis=0) + corners.max(axis=0)))


def outline(places: Array) -> Array:
    """Corners of the area that places cover, shape (n, 2), mm, grown by half the distance between neighbours.

    The triangles between places, without those that are too large for an area that was pressed (Edelsbrunner et al.
    1983): their limit is the least that leaves one ring with all places inside. Holes are closed.

    Args:
        places: Different (x, y), shape (m, 2), mm.

    Raises:
        PressError: If they lie on a line, or almost.
    """
    on_a_line = f"expected presses over an area, got {len(places)} places on one line; press beside it, too"
    length, width = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if width <= LEAST_WIDTH * length:
        raise PressError(on_a_line)
    try:
        triangles = Delaunay(places).simplices
    except QhullError as error:
        raise PressError(on_a_line) from error
    spacing = float(np.median(cKDTree(places).query(places, 2)[0][:, 1]))
    sizes = _circumradii(places[triangles])
    limits = [*LEAST_HOLE * spacing * 2.0 ** np.arange(0.0, 20.0, 0.5), np.inf]
    rings = (_ring(triangles[sizes <= limit], len(places)) for limit in limits)
    ring = next((ring for ring in rings if ring is not None), None)
    if ring is None:
        raise PressError(f"expected presses over an area, got {len(places)} places that enclose none")
    return _grown(places[ring], 0.5 * spacing)


def _circumradii(corners: Array) -> Array:
    """Radii of the circles through triangles, shape (n, 3, 2)."""
    a = corners[:, 1] - corners[:, 0]
    b = corners[:, 2] - corners[:, 0]
    sides = [np.hypot(*side.T) for side in (a, b, b - a)]
    doubled = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return np.asarray(np.prod(sides, axis=0) / np.maximum(2.0 * doubled, 1e-30))


def _ring(triangles: Integers, count: int) -> list[int] | None:
    """The outer edges of triangles as one ring, anticlockwise; None if they are more, or a place is in no triangle."""
    if len(np.unique(triangles)) < count:
        return None
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    beside: dict[int, list[int]] = {}
    for (one, other), times in Counter(map(tuple, pairs.tolist())).items():
        if times == 1:
            beside.setdefault(one, []).append(other)
            beside.setdefault(other, []).append(one)
    if any(len(others) != 2 for others in beside.values()):
        return None
    first = min(beside)
    ring = [first]
    at = beside[first][0]
    while at != first:
        one, other = beside[at]
        ring.append(at)
        at = other if one == ring[-2] else one
    return ring if len(ring) == len(beside) else None


def _grown(corners: Array, by: float) -> Array:
    """A polygon whose sides have moved out, mm, without its straight corners."""
    z = to_complex(corners if area_of(corners) > 0.0 else corners[::-1])
    along = np.roll(z, -1) - z
    turn = np.angle(along / np.roll(along, 1))
    z = z[np.abs(turn) > 1e-6]
    along = np.roll(z, -1) - z
    after = -1j * along / np.abs(along)
    before = np.roll(after, 1)
    mitre = (before + after) / np.maximum(1.0 + (before * np.conj(after)).real, 1e-9)
    return to_corners(z + by * mitre * np.minimum(1.0, LONGEST_MITRE / np.abs(mitre)))
