"""Probe with an elliptical footprint."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes
from isocharge.simulate.sensor.probe_shapes.base import (
    CurvedProbe,
    ProbeNotation,
    check_angle,
    check_reach,
    check_side,
)
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

    notations = (ProbeNotation("ellipse", "WIDTHxHEIGHT", lambda axes, angle: Ellipse(axes[0], axes[1], angle)),)

    def __post_init__(self) -> None:
        check_side("probe width", self.width)
        check_side("probe height", self.height)
        check_angle(self.angle)
        check_reach(self.reach)

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

    @property
    def period(self) -> float:
        """Smallest rotation that maps the ellipse onto itself, rad. It is half a turn."""
        return float(np.pi)

    def boundary(self, parameter: Array) -> Complexes:
        """Return points x + iy of the ellipse, mm. The parameter is the eccentric angle, rad."""
        before_rotation = 0.5 * self.width * np.cos(parameter) + 0.5j * self.height * np.sin(parameter)
        return np.asarray(before_rotation * np.exp(1j * self.angle))

    def contains(self, points: Complexes) -> Booleans:
        """Return whether each point x + iy (mm, relative to the centre) lies in the ellipse."""
        unrotated = points * np.exp(-1j * self.angle)
        squared_ratio = (2.0 * unrotated.real / self.width) ** 2 + (2.0 * unrotated.imag / self.height) ** 2
        return np.asarray(squared_ratio <= 1.0)
