"""Circular probe, and the base class of all probes with a circular footprint."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes
from isocharge.simulate.numerics.polygon import area_in_disk, to_complex
from isocharge.simulate.sensor.probe_shapes.base import CurvedProbe, FootprintTopology, ProbeNotation, check_reach
from isocharge.simulate.sensor.size_check import tidy


@dataclass(frozen=True)
class RoundProbe(CurvedProbe):
    """A circular footprint. Subclasses implement `notation`, and `pressure` if the pressure is not uniform.

    Attributes:
        radius: Radius, mm.
    """

    radius: float

    def __post_init__(self) -> None:
        check_reach(self.radius, "probe radius")

    @property
    def area(self) -> float:
        """Area, mm^2."""
        return float(np.pi * self.radius**2)

    @property
    def reach(self) -> float:
        """Radius, mm."""
        return self.radius

    @property
    def angle(self) -> float:
        """Zero: a rotation does not change a circle."""
        return 0.0

    @property
    def period(self) -> float:
        """Zero: every rotation maps a circle onto itself."""
        return 0.0

    @property
    def topology(self) -> FootprintTopology:
        """A square core polygon, and a layer of blocks up to the innermost circle of the mesh."""
        return FootprintTopology(n_corner=4, is_curved=True, fills_circle=True)

    def rotated(self, angle: float) -> Self:
        """Return the same circle."""
        del angle
        return self

    def boundary(self, parameter: Array) -> Complexes:
        """Return points of the boundary, mm; the parameter is the polar angle."""
        return np.asarray(self.radius * np.exp(1j * parameter))

    def contains(self, points: Complexes) -> Booleans:
        """Return whether points lie in the circle."""
        return np.asarray(np.abs(points) <= self.radius)

    def farthest_distance(self, at: tuple[float, float]) -> float:
        """Return the distance of the farthest point of the circle from the centre of the film, mm."""
        return float(np.hypot(*at)) + self.radius

    def covered_area(self, corners: Array, at: complex) -> float:
        """Return the area of a polygon that lies in the circle, mm^2."""
        return float(area_in_disk(to_complex(corners), at, self.radius))


@dataclass(frozen=True)
class Circle(RoundProbe):
    """A circular footprint with uniform pressure.

    Attributes:
        radius: Radius, mm.
    """

    notations = (ProbeNotation("circle", "RADIUS", lambda numbers, _angle: Circle(numbers[0])),)

    @property
    def notation(self) -> str:
        """Text that `parse_probe` converts back into this probe."""
        return f"circle:{tidy(self.radius)}"
