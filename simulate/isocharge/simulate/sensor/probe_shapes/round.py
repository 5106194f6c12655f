"""Probes with a circular footprint: a circle with a uniform pressure, and fingertips with a Hertzian pressure.

A soft sphere that is pressed against a flat surface touches the surface in a circle of radius a. If F is the force, the
pressure at the distance r from the centre of this circle is p(r) = p0 sqrt(1 - (r / a)^2), with the maximum
p0 = 1.5 F / (pi a^2) (Johnson 1985, Contact Mechanics, equation 3.39). The radius a is proportional to the cube root of
the force (equation 3.40).
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.interpolation import gauss_line
from isocharge.simulate.numerics.polygon import area_in_disk, to_complex
from isocharge.simulate.sensor.probe_shapes.base import CurvedProbe, check_length
from isocharge.simulate.sensor.size_check import tidy

PEAK_PRESSURE = 1.5
"""Ratio of the largest pressure to the mean pressure, dimensionless."""

PRESSURE_LEVELS = 48
"""Number of pressure levels over which the force on an area is integrated."""


@dataclass(frozen=True)
class RoundProbe(CurvedProbe):
    """Base class of probes with a circular footprint.

    A subclass implements `notation`. A subclass whose pressure is not uniform also overrides `pressure`.

    Attributes:
        radius: Radius of the footprint, mm.
    """

    radius: float

    angle = 0.0
    """Rotation of the footprint, rad. The rotation is always zero, because a rotation does not change a circle."""

    period = 0.0
    """Period of the footprint. The period is always zero, because every rotation maps a circle onto itself."""

    def __post_init__(self) -> None:
        check_length("probe radius", self.radius)

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

    @property
    def notation(self) -> str:
        """Notation of this probe, which `parse_probe` converts back into the probe."""
        return f"circle:{tidy(self.radius)}"


@dataclass(frozen=True)
class Finger(RoundProbe):
    """Probe with a circular footprint. The pressure decreases from a maximum at the centre to zero at the edge.

    Attributes:
        radius: Radius of the footprint, mm, which does not depend on the force. The radius is 4 to 8 mm for a
            fingertip.
    """

    has_uniform_pressure = False

    @property
    def notation(self) -> str:
        """Notation of this probe, which `parse_probe` converts back into the probe."""
        return f"finger:{tidy(self.radius)}"

    def pressure(self, points: Complexes) -> Array:
        """Return the Hertzian pressure at points, divided by the mean pressure. It is zero outside the footprint.

        Args:
            points: Points x + iy relative to the centre of the footprint, any shape, mm.

        Returns:
            Relative pressure, of the shape of `points`, dimensionless.
        """
        squared_ratio_to_peak = np.clip(1.0 - np.abs(points) ** 2 / self.radius**2, 0.0, None)
        return np.asarray(PEAK_PRESSURE * np.sqrt(squared_ratio_to_peak))

    def force_share(self, corners: Array, at: complex) -> float:
        """Return the fraction of the force that acts on a convex polygon of the film, from 0 to 1.

        Let a be the radius of the footprint. The pressure exceeds the fraction t of its peak within a disk of radius
        a sqrt(1 - t^2). Let A(t) be the area that the polygon and this disk have in common. The force on the polygon is
        the peak pressure times the integral of A(t) over t from 0 to 1. The integral is computed by a Gauss rule.

        Args:
            corners: Corners (x, y) of the polygon, anticlockwise, shape (n, 2), mm.
            at: Position of the centroid of the footprint as x + iy, mm.
        """
        pressure_fraction, weights = gauss_line(PRESSURE_LEVELS)
        disk_radius = self.radius * np.sqrt(1.0 - pressure_fraction**2)
        common_areas = area_in_disk(to_complex(corners), at, disk_radius)  # A(t), mm^2

        # For a force of 1, the mean pressure is 1 / area, and the peak pressure is `PEAK_PRESSURE` times as large.
        return float(PEAK_PRESSURE / self.area * (weights @ common_areas))


@dataclass(frozen=True)
class GrowingFinger(Finger):
    """Fingertip whose contact area grows with the force, as that of an elastic sphere does.

    Attributes:
        radius: Radius of the footprint at 1 N, mm. Under the force F, it is larger by the cube root of F / (1 N).
    """

    grows = True

    @property
    def notation(self) -> str:
        """Notation of this probe, which `parse_probe` converts back into the probe."""
        return f"growing-finger:{tidy(self.radius)}"

    def under(self, force: float) -> Finger:
        """Return the fingertip with the radius that it has under a force (N)."""
        return Finger(self.radius * float(np.cbrt(force)))
