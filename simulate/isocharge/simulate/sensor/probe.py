"""Probes, and their notation on the command line and in files.

Examples of the notation:

    circle:1.0             radius
    ellipse:4.0x2.0        axes along x and y
    rectangle:4.0x2.0      sides along x and y
    triangle:4.0           side of an equilateral triangle with one corner towards +y
    polygon:x,y;x,y;x,y    corners of a convex polygon, anticlockwise
    finger:6.0             radius of the contact area of a fingertip
    growing-finger:6.0     radius at 1 N of a contact area that grows with the cube root of the force

All lengths are in mm. The suffix `@30` rotates the footprint by 30 degrees anticlockwise.

A soft sphere that is pressed against a flat surface touches the surface in a circle of radius a. If F is the force, the
pressure at the distance r from the centre of this circle is p(r) = p0 sqrt(1 - (r / a)^2), with the maximum
p0 = 1.5 F / (pi a^2) (Johnson 1985, Contact Mechanics, equation 3.39). The radius a is proportional to the cube root of
the force (equation 3.40). The class `Finger` has this pressure and a constant radius. The radius of a `GrowingFinger`
grows with the force. All other probes have a uniform pressure.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.errors import SceneError, cut
from isocharge.simulate.numerics.interpolation import gauss_line
from isocharge.simulate.numerics.polygon import area_in_disk, area_of, centroid_of, is_convex, to_complex, to_corners
from isocharge.simulate.sensor.film import tidy
from isocharge.simulate.sensor.footprint import (
    MIN_LENGTH,
    CurvedProbe,
    FootprintTopology,
    Probe,
    check_angle,
    check_length,
)


@dataclass(frozen=True)
class RoundProbe(CurvedProbe):
    """Base class of probes with a circular footprint.

    A subclass defines `name`. A subclass with a non-uniform pressure also overrides `pressure`.

    Attributes:
        radius: Radius of the footprint, mm.
    """

    radius: float

    name: ClassVar[str]
    """Word before the colon in the notation of the probe."""

    angle = 0.0
    """Rotation of the footprint, rad. The rotation is always zero, because a rotation does not change a circle."""

    period = 0.0
    """Period of the footprint. The period is always zero, because every rotation maps a circle onto itself."""

    def __post_init__(self) -> None:
        check_length("probe radius", self.radius)

    @property
    def notation(self) -> str:
        """Notation of this probe for `parse_probe`."""
        return f"{self.name}:{tidy(self.radius)}"

    @property
    def area(self) -> float:
        """Area of the footprint, mm^2."""
        return float(np.pi * self.radius**2)

    @property
    def reach(self) -> float:
        """Radius of the circle, which is the distance from its centre to its farthest point, mm."""
        return self.radius

    def boundary(self, parameter: Array) -> Complexes:
        """Return points x + iy of the circle, mm. The parameter is the polar angle, rad."""
        return np.asarray(self.radius * np.exp(1j * parameter))

    def force_share(self, corners: Array, at: complex) -> float:
        """Return the fraction of a uniformly distributed force that acts on a convex polygon of the film."""
        return float(area_in_disk(to_complex(corners), at, self.radius)) / self.area


@dataclass(frozen=True)
class Circle(RoundProbe):
    """Probe with a circular footprint and a uniform pressure.

    Attributes:
        radius: Radius of the footprint, mm.
    """

    name = "circle"


FINGER_PEAK_PRESSURE = 1.5
"""Ratio of the largest pressure to the mean pressure under a fingertip, dimensionless."""

FINGER_PRESSURE_LEVELS = 48
"""Number of pressure levels over which the force on an area is integrated."""


@dataclass(frozen=True)
class Finger(RoundProbe):
    """Probe with a circular footprint. The pressure decreases from a maximum at the centre to zero at the edge.

    Attributes:
        radius: Radius of the footprint, mm, which does not depend on the force. The radius is 4 to 8 mm for a
            fingertip.
    """

    name = "finger"
    has_uniform_pressure = False

    def pressure(self, points: Complexes) -> Array:
        """Return the Hertzian pressure at points, divided by the mean pressure; zero outside the footprint.

        Args:
            points: Points x + iy relative to the centre of the footprint, any shape, mm.

        Returns:
            Relative pressure, of the shape of `points`, dimensionless.
        """
        squared_ratio_to_peak = np.clip(1.0 - np.abs(points) ** 2 / self.radius**2, 0.0, None)
        return FINGER_PEAK_PRESSURE * np.sqrt(squared_ratio_to_peak)

    def force_share(self, corners: Array, at: complex) -> float:
        """Return the fraction of the force that acts on a convex polygon of the film, from 0 to 1.

        Let a be the radius of the footprint. The pressure exceeds the fraction t of its peak within a disk of radius
        a sqrt(1 - t^2). Let A(t) be the area that the polygon and this disk have in common. The force on the polygon is
        the peak pressure times the integral of A(t) over t from 0 to 1. The integral is computed by a Gauss rule.

        Args:
            corners: Corners (x, y) of the polygon, anticlockwise, shape (n, 2), mm.
            at: Position of the centroid of the footprint as x + iy, mm.
        """
        pressure_fraction, weights = gauss_line(FINGER_PRESSURE_LEVELS)
        disk_radius = self.radius * np.sqrt(1.0 - pressure_fraction**2)
        common_areas = area_in_disk(to_complex(corners), at, disk_radius)  # A(t), mm^2

        # For a force of 1, the mean pressure is 1 / area. The peak pressure is `FINGER_PEAK_PRESSURE` times as large.
        return float(FINGER_PEAK_PRESSURE / self.area * (weights @ common_areas))


@dataclass(frozen=True)
class GrowingFinger(Finger):
    """Fingertip whose contact area grows with the force, like the contact area of an elastic sphere.

    Attributes:
        radius: Radius of the footprint at 1 N, mm. Under the force F, the radius is this value times the cube root of
            F / (1 N).
    """

    name = "growing-finger"
    grows = True

    def under(self, force: float) -> Finger:
        """Return the fingertip with the radius that it has under a force (N).

        Raises:
            SceneError: If the force is not positive, or so small that the radius is below `MIN_LENGTH`.
        """
        radius = self.radius * math.cbrt(force)
        if not radius >= MIN_LENGTH:
            raise SceneError(
                f"{self.notation} under {force:.4g} N: expected a radius of at least {MIN_LENGTH:g} mm, got "
                f"{radius:.4g} mm; press with more force"
            )
        return Finger(radius)


@dataclass(frozen=True)
class Ellipse(CurvedProbe):
    """Probe with an elliptical footprint and a uniform pressure.

    Attributes:
        width: Length of the ellipse axis that lies along x before the rotation, mm.
        height: Length of the ellipse axis that lies along y before the rotation, mm.
        angle: Rotation about the centre, anticlockwise, rad.
    """

    width: float
    height: float
    angle: float = 0.0

    period = math.pi
    """Smallest rotation that maps the ellipse onto itself, which is half a turn, rad."""

    def __post_init__(self) -> None:
        check_length("probe width", self.width)
        check_length("probe height", self.height)
        check_angle(self.angle)

    @property
    def notation(self) -> str:
        """Notation of this probe for `parse_probe`, without the rotation of the probe."""
        return f"ellipse:{tidy(self.width)}x{tidy(self.height)}"

    @property
    def area(self) -> float:
        """Area of the ellipse, mm^2."""
        return float(0.25 * np.pi * self.width * self.height)

    @property
    def reach(self) -> float:
        """Distance from the centre to the farthest point of the ellipse, which is half of the longer axis, mm."""
        return 0.5 * max(self.width, self.height)

    def boundary(self, parameter: Array) -> Complexes:
        """Return points x + iy of the ellipse, mm. The parameter is the eccentric angle, rad."""
        before_rotation = 0.5 * self.width * np.cos(parameter) + 0.5j * self.height * np.sin(parameter)
        return np.asarray(before_rotation * np.exp(1j * self.angle))


MAX_CORNERS = 64
"""Largest number of corners of a polygon.

A polygon with more corners causes nearly the same charges as a circle, which needs fewer unknowns.
"""


@dataclass(frozen=True)
class Polygon(Probe):
    """Probe with a convex polygonal footprint and a uniform pressure.

    Attributes:
        corners: Corners (x, y) before the rotation, anticlockwise, mm. The stored corners are relative to the centroid.
        angle: Rotation about the centroid, anticlockwise, rad.
        shape: Notation of a rectangle or a triangle without its rotation; empty for another polygon.
    """

    corners: tuple[tuple[float, float], ...]
    angle: float = 0.0
    shape: str = ""

    def __post_init__(self) -> None:
        """Check that the corners form a convex polygon, and move the centroid of the polygon to the origin.

        Raises:
            SceneError: If the corners do not form a convex polygon, or if the polygon is too small.
        """
        corners = np.array(self.corners, dtype=float)
        are_points = corners.shape[1:] == (2,) and np.isfinite(corners).all()  # shape (n, 2)
        if not (are_points and 3 <= len(corners) <= MAX_CORNERS):
            raise SceneError(f"probe: expected 3 to {MAX_CORNERS} corners (x, y), got {cut(str(self.corners))}")
        check_angle(self.angle)
        if not is_convex(corners):
            raise SceneError(
                f"probe: expected a convex polygon with its corners anticlockwise, got {cut(str(corners.tolist()))} mm"
            )
        # Corners that are relative to their centroid are stored as they are, without further rounding errors.
        centroid = centroid_of(corners)
        if np.linalg.norm(centroid) > 1e-9 * self.reach:
            relative_corners = (corners - centroid).tolist()
            object.__setattr__(self, "corners", tuple(map(tuple, relative_corners)))  # the dataclass is frozen
        check_length("probe diameter", 2.0 * self.reach)

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
        return cls(tuple(map(tuple, corners.tolist())), angle, shape)

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
        # The arguments are the corners, the rotation and the notation of the rectangle.
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
        corner_angles = 0.5 * math.pi + math.tau / 3.0 * np.arange(3)
        return cls.of(to_corners(np.exp(1j * corner_angles) * circumradius), angle, f"triangle:{tidy(side)}")

    @property
    def notation(self) -> str:
        """Notation of this probe for `parse_probe`, without the rotation of the probe."""
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
        # Find the largest order n for which a rotation by an n-th part of a turn maps the polygon onto itself. The
        # rotation maps each corner to the corner that is an n-th part of all corners ahead.
        corners = to_complex(np.array(self.corners))
        for order in range(corners.size, 1, -1):
            if corners.size % order != 0:
                continue
            corners_ahead = np.roll(corners, -(corners.size // order))
            rotated_corners = corners * np.exp(2j * np.pi / order)
            if np.allclose(corners_ahead, rotated_corners, rtol=0.0, atol=1e-9 * self.reach):
                return math.tau / order
        return math.tau  # only a full turn maps the polygon onto itself

    @property
    def topology(self) -> FootprintTopology:
        """Topology of a polygonal footprint. The core polygon is the whole footprint."""
        return FootprintTopology(len(self.corners), is_curved=False, fills_circle=False)

    @property
    def outline(self) -> Complexes:
        """Corners x + iy of the rotated polygon relative to its centroid, anticlockwise, shape (n_corner,), mm."""
        return np.asarray(to_complex(np.array(self.corners)) * np.exp(1j * self.angle))

    def core(self) -> Complexes:
        """Return the corners x + iy of the rotated polygon, shape (n_corner,), mm."""
        return self.outline


NUMBER_PATTERN = r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
"""Regular expression of a decimal number in the notation of a probe."""


PROBE_SHAPES: dict[str, Callable[..., Probe]] = {
    "circle:RADIUS": Circle,
    "rectangle:WIDTHxHEIGHT": Polygon.rectangle,
    "triangle:SIDE": Polygon.triangle,
    "polygon:X,Y;X,Y;X,Y": lambda *coordinates: Polygon.of(np.reshape(coordinates, (-1, 2))),
    "ellipse:WIDTHxHEIGHT": Ellipse,
    "finger:RADIUS": Finger,
    "growing-finger:RADIUS": GrowingFinger,
}
"""Notation of each probe shape, and function that creates an unrotated probe from the numbers of the notation (mm).

Each word of capital letters stands for a number, and a polygon may have more corners. The parser, the help text and the
error messages are derived from this table.
"""


def _join_with_or(forms: list[str]) -> str:
    """Join several texts into one text such as "a, b or c"."""
    return f"{', '.join(forms[:-1])} or {forms[-1]}"


PROBE_HELP = (
    f"Footprint, mm: {_join_with_or(list(PROBE_SHAPES))}; @DEGREES at the end rotates the footprint anticlockwise."
)
"""Help text of command-line options whose value is the notation of a probe."""


def parse_probe(text: str) -> Probe:
    """Create the probe that a notation describes.

    Args:
        text: Notation such as "rectangle:4.0x2.0@30"; see the docstring of the module.

    Raises:
        SceneError: If the text is not the notation of a probe, or if the footprint cannot exist.
    """
    for notation, create_probe in PROBE_SHAPES.items():
        # Convert the notation, such as "rectangle:WIDTHxHEIGHT" or "polygon:X,Y;X,Y;X,Y", into a regular expression. A
        # polygon may have more corners. Each word of capital letters stands for a number. The lambda inserts the
        # pattern unchanged, whereas `re.sub` would interpret the backslashes of a replacement text.
        with_more_corners = notation.replace(";X,Y;X,Y", "(?:;X,Y)+")
        shape_pattern = re.sub("[A-Z]+", lambda _: NUMBER_PATTERN, with_more_corners)
        match = re.fullmatch(f"({shape_pattern})(?:@({NUMBER_PATTERN}))?", text.strip())
        if match is not None:
            shape, degrees = match.groups()
            numbers = map(float, re.findall(NUMBER_PATTERN, shape))  # lengths or coordinates, mm
            probe = create_probe(*numbers)
            return probe.rotated(math.radians(float(degrees or 0.0)))
    forms = [f"'{notation}'" for notation in PROBE_SHAPES]
    raise SceneError(
        f"probe {cut(text)!r}: expected {_join_with_or(forms)} in mm, each optionally rotated as in 'triangle:4.0@30' "
        "(degrees)"
    )
