"""The film and its piezoelectric coefficients."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from isocharge.common.errors import SensorError
from isocharge.simulate.sensor.size_check import check_megapascals, check_millimetres

Surface = Literal["middle", "top", "bottom"]
"""Where in the thickness the stress is read; the probe touches the top."""

LEAST_RADIUS, LEAST_THICKNESS = 1.0, 1e-4
"""Smallest radius and thickness of a film, mm: smaller numbers are in metres."""

LEAST_PIEZO = 1e-6
"""Smallest coefficient d31, d32 or d33 other than 0, pC/N: smaller numbers are in C/N."""

MOST_YOUNG, MOST_PRETENSION = 1e7, 1e4
"""Largest Young's modulus and pretension of a film, MPa: larger numbers are in pascals."""


@dataclass(frozen=True)
class Film:
    """The clamped circular film.

    Attributes:
        radius: mm.
        thickness: mm.
        young: Young's modulus, MPa.
        poisson: Poisson's ratio, 0 <= poisson < 0.5.
        pretension: Uniform second Piola-Kirchhoff stress without load, MPa, tension positive.
    """

    radius: float
    thickness: float
    young: float
    poisson: float
    pretension: float = 0.0

    def __post_init__(self) -> None:
        for name, unit in (("radius", "mm"), ("thickness", "mm"), ("young", "MPa")):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise SensorError(f"film {name}: expected a positive number, got {value:.6g} {unit}")
        check_millimetres("film radius", self.radius, LEAST_RADIUS, SensorError)
        check_millimetres("film thickness", self.thickness, LEAST_THICKNESS, SensorError)
        check_megapascals("film young", self.young, MOST_YOUNG, SensorError)
        if not 0.0 <= self.poisson < 0.5:
            raise SensorError(f"film poisson: expected 0 <= poisson < 0.5, got {self.poisson}")
        if not (np.isfinite(self.pretension) and self.pretension >= 0.0):
            raise SensorError(f"film pretension: expected zero or tension (>= 0 MPa), got {self.pretension}")
        check_megapascals("film pretension", self.pretension, MOST_PRETENSION, SensorError)
        if self.thickness > 0.1 * self.radius:
            raise SensorError(
                f"film thickness: expected at most a tenth of the radius ({self.radius:g} mm), "
                f"got {self.thickness:.6g} mm; this is a solid, not a film"
            )


@dataclass(frozen=True)
class Piezo:
    """Piezoelectric strain coefficients d31, d32, d33 in pC/N and the pyroelectric one in pC/(mm^2 K)."""

    d31: float
    d32: float
    d33: float = 0.0
    pyro: float = 0.0

    def __post_init__(self) -> None:
        for name in ("d31", "d32", "d33", "pyro"):
            if not np.isfinite(getattr(self, name)):
                raise SensorError(f"piezo {name}: expected a finite number, got {getattr(self, name)}")
            if name != "pyro" and 0.0 < abs(getattr(self, name)) < LEAST_PIEZO:
                d = getattr(self, name)
                raise SensorError(f"piezo {name}: expected pC/N, got {d:.6g} pC/N; {d:.6g} C/N are {1e12 * d:.6g} pC/N")
        if self.d31 == 0.0 and self.d32 == 0.0:
            raise SensorError("piezo d31 and d32 are both 0: such a film gives no charge")
