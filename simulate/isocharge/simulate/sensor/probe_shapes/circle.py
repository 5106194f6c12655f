"""Circular probe with a uniform pressure, and the base class of all probes with a circular footprint."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes
from isocharge.simulate.numerics.polygon import area_in_disk, to_complex
from isocharge.simulate.sensor.probe_shapes.base import CurvedProbe, FootprintTopology, ProbeNotation, check_reach
from isocharge.simulate.sensor.size_check import tidy


@dataclass(frozen=True)
class RoundProbe(CurvedProbe):
    """Base class of probes with a circular footprint.

    A subclass implements `notation`. A subclass whose pressure is not uniform also overrides `pressure`.

    Attributes:
        radius: Radius of the footprint, mm.
    """

    radius: float

    def __post_init__(self) -> None:
        check_reach(self.radius, "probe radius")

    @property
    def area(self) -> float:
        """Area of the footprint, mm^2."""
        return float(np.pi * self.radius**2)

    @property
    def reach(self) -> float:
        """Radius of the circle, which is the distance from its centre to its farthest point, mm."""
        return self.radius

    @property
    def angle(self) -> float:
        """Rotation of the footprint. The rotation is always zero, because a rotation does not change a circle."""
        return 0.0

    @property
    def period(self) -> float:
        """Period of the footprint. The period is always zero, because every rotation maps a circle onto itself."""
        return 0.0

    @property
    def topology(self) -> FootprintTopology:
        """Topology with a square core polygon, and a layer of blocks up to the innermost circle of the mesh."""
        return FootprintTopology(n_corner=4, is_curved=True, fills_circle=True)

    def rotated(self, angle: float) -> Self:
        """Return the same probe, because a rotation does not change a circle."""
        del angle
        return self

    def boundary(self, parameter: Array) -> Complexes:
        """Return points x + iy of the circle, mm. The parameter is the polar angle, rad."""
        return np.asarray(self.radius * np.exp(1j * parameter))

    def contains(self, points: Complexes) -> Booleans:
        """Return whether each point x + iy (mm, relative to the centre) lies in the circle."""
        return np.asarray(np.abs(points) <= self.radius)

    def farthest_distance(self, at: tuple[float, float]) -> float:
        """Return the distance from the centre of the film to the farthest point of the circle, mm."""
        return float(np.hypot(*at)) + self.radius

    def covered_area(self, corners: Array, at: complex) -> float:
        """Return the area that the circle and a convex polygon have in common, mm^2."""
        return float(area_in_disk(to_complex(corners), at, self.radius))


@dataclass(frozen=True)
class Circle(RoundProbe):
    """Probe with a circular footprint and a uniform pressure.

    Attributes:
        radius: Radius of the footprint, mm.
    """

    notations = (ProbeNotation("circle", "RADIUS", lambda numbers, _angle: Circle(numbers[0])),)

    @property
    def notation(self) -> str:
        """Notation of this probe, which `parse_probe` converts back into the probe."""
        return f"circle:{tidy(self.radius)}"
