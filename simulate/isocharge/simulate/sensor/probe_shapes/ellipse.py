"""Probe with an elliptical footprint."""

import math
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.sensor.probe_shapes.base import CurvedProbe, check_angle, check_length
from isocharge.simulate.sensor.size_check import tidy


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
