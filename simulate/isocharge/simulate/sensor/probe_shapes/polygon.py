"""Convex polygonal probes: rectangles, equilateral triangles and polygons with any corners."""

import math
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes
from isocharge.common.errors import SceneError
from isocharge.simulate.numerics.polygon import (
    area_of,
    centroid_of,
    is_convex,
    min_edge_cross_product,
    shared_area,
    to_complex,
)
from isocharge.simulate.sensor.probe_shapes.base import (
    NUMBER,
    FootprintTopology,
    Probe,
    ProbeNotation,
    check_angle,
    check_reach,
    check_side,
)
from isocharge.simulate.sensor.size_check import tidy

MAX_CORNERS = 64
"""Largest number of corners of a polygon. A circle gives the charges of a polygon with more corners with fewer
unknowns."""

CORNERS_PATTERN = rf"{NUMBER},{NUMBER}(?:;{NUMBER},{NUMBER})+"
"""Regular expression of the corners `X,Y;X,Y;...` of a polygon."""


@dataclass(frozen=True)
class Polygon(Probe):
    """A convex polygonal footprint.

    Attributes:
        corners: Corners (x, y) relative to the centroid, anticlockwise, mm, before the rotation.
        angle: Rotation about the centroid, anticlockwise, rad.
        name: Kind of polygon in the notation: "rectangle", "triangle" or "polygon".
    """

    corners: tuple[tuple[float, float], ...]
    angle: float = 0.0
    name: str = "polygon"

    notations = (
        ProbeNotation("rectangle", "WIDTHxHEIGHT", lambda sides, angle: Polygon.rectangle(sides[0], sides[1], angle)),
        ProbeNotation("triangle", "SIDE", lambda sides, angle: Polygon.triangle(sides[0], angle)),
        ProbeNotation(
            "polygon",
            "X,Y;X,Y;X,Y",
            lambda numbers, angle: Polygon.of(np.array(numbers).reshape(-1, 2), angle),
            CORNERS_PATTERN,
        ),
    )

    def __post_init__(self) -> None:
        """Check that the corners form a convex polygon whose centroid is the origin.

        Raises:
            SceneError: If the corners do not form such a polygon, or if the polygon is too small.
        """
        corners = np.array(self.corners, dtype=float)
        is_table = corners.ndim == 2 and corners.shape[1:] == (2,)
        if not is_table or not 3 <= len(corners) <= MAX_CORNERS or not np.isfinite(corners).all():
            raise SceneError(f"probe: expected 3 to {MAX_CORNERS} corners (x, y), got {self.corners}")
        check_angle(self.angle)
        if not is_convex(corners):
            raise SceneError(
                f"probe: expected a convex polygon with its corners anticlockwise, got {corners.tolist()} mm"
            )
        if not np.linalg.norm(centroid_of(corners)) <= 1e-9 * np.linalg.norm(corners, axis=1).max():
            raise SceneError(
                f"probe: expected corners relative to their centroid, got {corners.tolist()} mm; use Polygon.of"
            )
        check_reach(self.reach)

    @classmethod
    def of(cls, corners: Array, angle: float = 0.0, name: str = "polygon") -> "Polygon":
        """Create a polygon from corners that need not be relative to their centroid.

        Args:
            corners: Corners (x, y), anticlockwise, shape (n, 2), mm. They are shifted so that the centroid is the
                origin.
            angle: Rotation about the centroid, anticlockwise, rad.
            name: Kind of polygon in the notation.
        """
        # Corners that are not valid are not shifted. The constructor reports them.
        points = np.asarray(corners, dtype=float)
        is_table = points.ndim == 2 and points.shape[0] >= 3 and points.shape[1] == 2
        if is_table and np.isfinite(points).all() and is_convex(points):
            points = points - centroid_of(points)
        return cls(tuple((float(x), float(y)) for x, y in points), angle, name)

    @classmethod
    def rectangle(cls, width: float, height: float, angle: float = 0.0) -> "Polygon":
        """Create a rectangle.

        Args:
            width: Length of the sides along x before the rotation, mm.
            height: Length of the sides along y before the rotation, mm.
            angle: Rotation about the centroid, anticlockwise, rad.
        """
        check_side("probe width", width)
        check_side("probe height", height)
        x = 0.5 * width
        y = 0.5 * height
        return cls(((x, y), (-x, y), (-x, -y), (x, -y)), angle, "rectangle")

    @classmethod
    def triangle(cls, side: float, angle: float = 0.0) -> "Polygon":
        """Create an equilateral triangle.

        Args:
            side: Length of the sides, mm. One corner points to +y before the rotation.
            angle: Rotation about the centroid, anticlockwise, rad.
        """
        check_side("probe side", side)
        circumradius = side / np.sqrt(3.0)
        corner_angles = 0.5 * np.pi + 2.0 * np.pi / 3.0 * np.arange(3)
        corners = np.exp(1j * corner_angles) * circumradius
        return cls(tuple((float(corner.real), float(corner.imag)) for corner in corners), angle, "triangle")

    @property
    def notation(self) -> str:
        """Text that `parse_probe` converts back into this probe, without the rotation."""
        corners = np.array(self.corners)
        first_corner, second_corner, *_ = corners
        if self.name == "rectangle":  # the first corner lies at (width / 2, height / 2)
            half_width, half_height = first_corner
            return f"rectangle:{tidy(2.0 * half_width)}x{tidy(2.0 * half_height)}"
        if self.name == "triangle":
            side = float(np.linalg.norm(second_corner - first_corner))
            return f"triangle:{tidy(side)}"
        return "polygon:" + ";".join(f"{tidy(x)},{tidy(y)}" for x, y in corners)

    @property
    def area(self) -> float:
        """Area, mm^2."""
        return area_of(np.array(self.corners))

    @property
    def reach(self) -> float:
        """Distance of the farthest corner from the centroid, mm."""
        return float(np.linalg.norm(np.array(self.corners), axis=1).max())

    @property
    def period(self) -> float:
        """Smallest rotation that maps the polygon onto itself, rad."""
        # A rotation that maps the polygon onto itself maps each corner to the corner that is `step` corners ahead. The
        # smallest such step divides the number of corners.
        corners = to_complex(np.array(self.corners))
        for step in range(1, corners.size):
            if corners.size % step != 0:
                continue
            rotation = np.exp(2j * np.pi * step / corners.size)
            corners_ahead = np.roll(corners, -step)
            if np.allclose(corners_ahead, corners * rotation, rtol=0.0, atol=1e-9 * self.reach):
                return float(math.tau * step / corners.size)
        return math.tau

    @property
    def topology(self) -> FootprintTopology:
        """The polygon is its own core polygon."""
        return FootprintTopology(len(self.corners), is_curved=False, fills_circle=False)

    @property
    def outline(self) -> Complexes:
        """Corners x + iy relative to the centroid, rotated, anticlockwise, shape (n_corner,), mm."""
        return np.asarray(to_complex(np.array(self.corners)) * np.exp(1j * self.angle))

    def core(self, unit: float) -> Complexes:
        """Return the corners of the polygon, rotated, in multiples of `unit` mm."""
        return np.asarray(self.outline / unit)

    def boundary(self, parameter: Array) -> Complexes:
        """Return points of the boundary, mm. The parameter starts half-way along the edge before the first corner."""
        corners = np.append(self.outline, self.outline[:1])
        corner_parameter = 2.0 * np.pi * (np.arange(corners.size) + 0.5) / (corners.size - 1)
        return np.asarray(np.interp(parameter, corner_parameter, corners, period=2.0 * np.pi))

    def contains(self, points: Complexes) -> Booleans:
        """Return whether points lie in the polygon."""
        return np.asarray(min_edge_cross_product(self.outline, points) >= 0.0)

    def farthest_distance(self, at: tuple[float, float]) -> float:
        """Return the distance of the farthest corner from the centre of the film, mm."""
        return float(np.abs(complex(*at) + self.outline).max())

    def covered_area(self, corners: Array, at: complex) -> float:
        """Return the area that a convex polygon shares with the footprint, mm^2."""
        return shared_area(to_complex(corners), at + self.outline)
