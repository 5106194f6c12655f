"""Probe whose footprint is a convex polygon."""

import math
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.errors import SceneError, cut
from isocharge.simulate.numerics.polygon import area_of, centroid_of, is_convex, to_complex, to_corners
from isocharge.simulate.sensor.film import tidy
from isocharge.simulate.sensor.footprint import FootprintTopology, Probe, check_angle, check_length

MAX_CORNERS = 64
"""Largest number of corners of a polygon.

A polygon with more corners has nearly the charges of a circle, which needs fewer unknowns.
"""


@dataclass(frozen=True)
class Polygon(Probe):
    """Probe with a convex polygonal footprint and a uniform pressure.

    Attributes:
        corners: Corners (x, y) before the rotation, anticlockwise, mm. They are stored relative to the centroid.
        angle: Rotation about the centroid, anticlockwise, rad.
        shape: Notation of a rectangle or a triangle without its rotation; empty for another polygon.
    """

    corners: tuple[tuple[float, float], ...]
    angle: float = 0.0
    shape: str = ""

    def __post_init__(self) -> None:
        """Check that the corners form a convex polygon, and shift them such that its centroid becomes the origin.

        Raises:
            SceneError: If the corners do not form such a polygon, or if the polygon is too small.
        """
        corners = np.array(self.corners, dtype=float)
        if corners.shape[1:] != (2,) or not (3 <= len(corners) <= MAX_CORNERS and np.isfinite(corners).all()):
            raise SceneError(f"probe: expected 3 to {MAX_CORNERS} corners (x, y), got {cut(str(self.corners))}")
        check_angle(self.angle)
        if not is_convex(corners):
            raise SceneError(
                f"probe: expected a convex polygon with its corners anticlockwise, got {cut(str(corners.tolist()))} mm"
            )
        # Corners that are relative to their centroid are stored as they are, without further rounding errors.
        centroid = centroid_of(corners)
        if np.linalg.norm(centroid) > 1e-9 * self.reach:
            object.__setattr__(self, "corners", _as_tuples(corners - centroid))  # the dataclass is frozen
        check_length("probe reach", self.reach)

    @classmethod
    def of(cls, corners: Array, angle: float = 0.0, shape: str = "") -> "Polygon":
        """Create a polygon from an array of corners.

        Args:
            corners: Corners (x, y) relative to any point, anticlockwise, shape (n, 2), mm.
            angle: Rotation about the centroid, anticlockwise, rad.
            shape: Notation of a rectangle or a triangle without its rotation; empty for another polygon.

        Raises:
            SceneError: If the corners do not form a convex polygon, or if the polygon is too small.
        """
        return cls(_as_tuples(corners), angle, shape)

    @classmethod
    def rectangle(cls, width: float, height: float, angle: float = 0.0) -> "Polygon":
        """Create a probe with a rectangular footprint.

        Args:
            width: Length of the sides along x before the rotation, mm.
            height: Length of the sides along y before the rotation, mm.
            angle: Rotation about the centroid, anticlockwise, rad.
        """
        check_length("probe width", width)
        check_length("probe height", height)
        x = 0.5 * width
        y = 0.5 * height
        return cls(((x, y), (-x, y), (-x, -y), (x, -y)), angle, f"rectangle:{tidy(width)}x{tidy(height)}")

    @classmethod
    def triangle(cls, side: float, angle: float = 0.0) -> "Polygon":
        """Create a probe whose footprint is an equilateral triangle. Before the rotation, one corner points to +y.

        Args:
            side: Length of the sides, mm.
            angle: Rotation about the centroid, anticlockwise, rad.
        """
        check_length("probe side", side)
        circumradius = side / np.sqrt(3.0)
        corner_angles = 0.5 * np.pi + 2.0 * np.pi / 3.0 * np.arange(3)
        return cls.of(to_corners(np.exp(1j * corner_angles) * circumradius), angle, f"triangle:{tidy(side)}")

    @property
    def notation(self) -> str:
        """Notation of this probe without its rotation, which `parse_probe` converts back into the probe."""
        corners = ";".join(f"{tidy(x)},{tidy(y)}" for x, y in self.corners)
        return self.shape or f"polygon:{corners}"

    @property
    def area(self) -> float:
        """Area of the polygon, mm^2."""
        return area_of(np.array(self.corners))

    @property
    def reach(self) -> float:
        """Distance from the centroid to the farthest corner, mm."""
        return float(np.linalg.norm(np.array(self.corners), axis=1).max())

    @property
    def period(self) -> float:
        """Smallest rotation that maps the polygon onto itself, rad."""
        # A rotation that maps the polygon onto itself maps each corner to another corner, which is a fixed number of
        # corners ahead (`corner_shift`). The smallest possible shift divides the number of corners.
        corners = to_complex(np.array(self.corners))
        for corner_shift in range(1, corners.size):
            if corners.size % corner_shift != 0:
                continue
            rotation = np.exp(2j * np.pi * corner_shift / corners.size)
            corners_ahead = np.roll(corners, -corner_shift)
            if np.allclose(corners_ahead, corners * rotation, rtol=0.0, atol=1e-9 * self.reach):
                return float(math.tau * corner_shift / corners.size)
        return math.tau  # only a full turn maps the polygon onto itself

    @property
    def topology(self) -> FootprintTopology:
        """Topology of a polygonal footprint. The core polygon is the whole footprint."""
        return FootprintTopology(len(self.corners), is_curved=False, fills_circle=False)

    @property
    def outline(self) -> Complexes:
        """Corners x + iy of the rotated polygon relative to its centroid, anticlockwise, shape (n_corner,), mm."""
        return np.asarray(to_complex(np.array(self.corners)) * np.exp(1j * self.angle))

    def core(self, unit: float) -> Complexes:
        """Return the corners x + iy of the rotated polygon in multiples of `unit` (mm), shape (n_corner,)."""
        return np.asarray(self.outline / unit)

    def boundary(self, parameter: Array) -> Complexes:
        """Return points x + iy of the boundary, mm.

        The parameter 0 is the middle of the edge that ends at the first corner. Each edge covers the same range of the
        parameter.

        Args:
            parameter: Values from 0 to 2 pi, any shape.
        """
        corners = np.append(self.outline, self.outline[:1])  # the first corner is repeated, which closes the boundary
        corner_parameter = 2.0 * np.pi * (np.arange(corners.size) + 0.5) / (corners.size - 1)
        return np.asarray(np.interp(parameter, corner_parameter, corners, period=2.0 * np.pi))


def _as_tuples(corners: Array) -> tuple[tuple[float, float], ...]:
    """Convert corners (x, y) of shape (n, 2) into nested tuples, which can be compared and hashed."""
    return tuple((float(x), float(y)) for x, y in corners)
