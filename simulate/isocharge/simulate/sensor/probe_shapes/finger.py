"""Fingertip: a circular footprint with Hertzian pressure.

A soft sphere that is pressed against a flat surface touches the surface in a circle of radius a. The pressure at the
distance r from the centre of this circle is p(r) = p0 sqrt(1 - (r / a)^2), where F is the force and the maximum is
p0 = 1.5 F / (pi a^2) (Johnson 1985, Contact Mechanics, equation 3.39).
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.polygon import area_in_disk, to_complex
from isocharge.simulate.sensor.probe_shapes.base import ProbeNotation
from isocharge.simulate.sensor.probe_shapes.circle import RoundProbe
from isocharge.simulate.sensor.size_check import tidy

PEAK_PRESSURE = 1.5
"""Largest pressure relative to the mean pressure, dimensionless."""

PRESSURE_LEVELS = 48
"""Number of pressure levels from which the share of the force on an area is computed."""


@dataclass(frozen=True)
class Finger(RoundProbe):
    """A circular contact area whose pressure decreases from a maximum at the centre to zero at the edge.

    Attributes:
        radius: Radius of the contact area, mm; 4 to 8 mm for a fingertip. It does not depend on the force.
    """

    notations = (ProbeNotation("finger", "RADIUS", lambda numbers, _angle: Finger(numbers[0])),)

    @property
    def notation(self) -> str:
        """Text that `parse_probe` converts back into this probe."""
        return f"finger:{tidy(self.radius)}"

    @property
    def has_uniform_pressure(self) -> bool:
        """Whether the pressure is uniform, which is false."""
        return False

    def pressure(self, points: Complexes) -> Array:
        """Return the Hertzian pressure relative to its mean, zero outside of the contact area."""
        squared_relative_pressure = np.clip(1.0 - np.abs(points) ** 2 / self.radius**2, 0.0, None)
        return np.asarray(PEAK_PRESSURE * np.sqrt(squared_relative_pressure))

    def force_share(self, corners: Array, at: complex) -> float:
        """Return the share of the force that acts on a convex polygon.

        The pressure exceeds the fraction t of its peak within a disk of radius a sqrt(1 - t^2). Let A(t) be the area
        that the polygon shares with this disk. The force on the polygon is the peak pressure times the integral of A(t)
        over t.

        Args:
            corners: Corners (x, y) of the polygon, anticlockwise, shape (n, 2), mm.
            at: Position of the centroid of the footprint as x + iy, mm.
        """
        # Gauss rule on [-1, 1], mapped to levels t from 0 to 1. The weights of this interval are half as large.
        nodes, weights = np.polynomial.legendre.leggauss(PRESSURE_LEVELS)
        level = 0.5 * (nodes + 1.0)
        level_radius = self.radius * np.sqrt(1.0 - level**2)
        points = to_complex(corners)
        areas = [float(area_in_disk(points, at, radius)) for radius in level_radius]
        return float(PEAK_PRESSURE / self.area * 0.5 * (weights @ areas))
