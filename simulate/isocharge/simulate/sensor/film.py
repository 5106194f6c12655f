"""The film and its piezoelectric coefficients."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from isocharge.common.errors import SensorError

Surface = Literal["middle", "top", "bottom"]


@dataclass(frozen=True)
class Film:
    """The clamped circular film.

    Attributes:
        radius: m.
        thickness: m.
        young: Young's modulus, Pa.
        poisson: Poisson's ratio, 0 <= poisson < 0.5.
        pretension: Uniform second Piola-Kirchhoff stress without load, Pa, tension positive.
    """

    radius: float
    thickness: float
    young: float
    poisson: float
    pretension: float = 0.0

    def __post_init__(self) -> None:
        for name, unit in (("radius", "m"), ("thickness", "m"), ("young", "Pa")):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise SensorError(f"film {name}: expected a positive number, got {value:.6g} {unit}")
        if not 0.0 <= self.poisson < 0.5:
            raise SensorError(f"film poisson: expected 0 <= poisson < 0.5, got {self.poisson}")
        if not (np.isfinite(self.pretension) and self.pretension >= 0.0):
            raise SensorError(f"film pretension: expected zero or tension (>= 0 Pa), got {self.pretension}")
        if self.thickness > 0.1 * self.radius:
            raise SensorError(
                f"film thickness: expected at most a tenth of the radius ({self.radius * 1e3} mm), "
                f"got {float(f'{self.thickness * 1e6:.6g}')} um; this is a solid, not a film"
            )


@dataclass(frozen=True)
class Piezo:
    """Piezoelectric strain coefficients d31, d32, d33 in C/N and the pyroelectric one in C/(m^2 K)."""

    d31: float
    d32: float
    d33: float = 0.0
    pyro: float = 0.0

    def __post_init__(self) -> None:
        for name in ("d31", "d32", "d33", "pyro"):
            if not np.isfinite(getattr(self, name)):
                raise SensorError(f"piezo {name}: expected a finite number, got {getattr(self, name)}")
        if self.d31 == 0.0 and self.d32 == 0.0:
            raise SensorError("piezo d31 and d32 are both 0: such a film gives no charge")
