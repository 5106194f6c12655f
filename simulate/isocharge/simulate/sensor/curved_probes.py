"""Probes whose footprint has a smooth boundary: circles, ellipses and fingertips.

A soft sphere that is pressed against a flat surface touches the surface in a circle of radius a. If F is the force, the
pressure at the distance r from the centre of this circle is p(r) = p0 sqrt(1 - (r / a)^2), with the maximum
p0 = 1.5 F / (pi a^2) (Johnson 1985, Contact Mechanics, equation 3.39). The radius a is proportional to the cube root of
the force (equation 3.40). The class `Finger` has this pressure and a constant radius. The radius of a `GrowingFinger`
grows with the force.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.errors import SceneError
from isocharge.simulate.numerics.interpolation import gauss_line
from isocharge.simulate.numerics.polygon import area_in_disk, to_complex
from isocharge.simulate.sensor.film import tidy
from isocharge.simulate.sensor.footprint import MIN_LENGTH, CurvedProbe, check_angle, check_length


@dataclass(frozen=True)
class RoundProbe(CurvedProbe):
    """Base class of probes with a circular footprint.

    A subclass has a `name`. A subclass whose pressure is not uniform also overrides `pressure`.

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
        """Notation of this probe, which `parse_probe` converts back into the probe."""
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

    def farthest_distance(self, at: tuple[float, float]) -> float:
        """Return the distance from the centre of the film to the farthest point of the circle, mm."""
        return float(np.hypot(*at)) + self.radius

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
        """Return the Hertzian pressure at points, divided by the mean pressure. It is zero outside the footprint.

        Args:
            points: Points x + iy relative to the centre of the footprint, any shape, mm.

        Returns:
            Relative pressure, of the shape of `points`, dimensionless.
        """
        squared_ratio_to_peak = np.clip(1.0 - np.abs(points) ** 2 / self.radius**2, 0.0, None)
        return np.asarray(FINGER_PEAK_PRESSURE * np.sqrt(squared_ratio_to_peak))

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
    """Fingertip whose contact area grows with the force, as that of an elastic sphere does.

    Attributes:
        radius: Radius of the footprint at 1 N, mm. Under the force F, it is multiplied by the cube root of F / (1 N).
    """

    name = "growing-finger"
    grows = True

    def under(self, force: float) -> Finger:
        """Return the fingertip with the radius that it has under a force (N).

        Raises:
            SceneError: If the force is so small that the radius is below `MIN_LENGTH`, or if it is not positive.
        """
        radius = self.radius * float(np.cbrt(force))
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
        width: Length of the axis along x before the rotation, mm.
        height: Length of the axis along y before the rotation, mm.
        angle: Rotation about the centre, anticlockwise, rad.
    """

    width: float
    height: float
    angle: float = 0.0

    period = math.pi
    """Smallest rotation that maps the ellipse onto itself, rad. It is half a turn."""

    def __post_init__(self) -> None:
        check_length("probe width", self.width)
        check_length("probe height", self.height)
        check_angle(self.angle)

    @property
    def notation(self) -> str:
        """Notation of this probe without its rotation, which `parse_probe` converts back into the probe."""
        return f"ellipse:{tidy(self.width)}x{tidy(self.height)}"

    @property
    def area(self) -> float:
        """Area of the ellipse, mm^2."""
        return float(0.25 * np.pi * self.width * self.height)

    @property
    def reach(self) -> float:
        """Distance from the centre to the farthest point of the ellipse, mm. It is half of the longer axis."""
        return 0.5 * max(self.width, self.height)

    def boundary(self, parameter: Array) -> Complexes:
        """Return points x + iy of the ellipse, mm. The parameter is the eccentric angle, rad."""
        before_rotation = 0.5 * self.width * np.cos(parameter) + 0.5j * self.height * np.sin(parameter)
        return np.asarray(before_rotation * np.exp(1j * self.angle))
