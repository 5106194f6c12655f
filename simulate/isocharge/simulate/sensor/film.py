"""Mechanical properties and piezoelectric coefficients of the film."""

import math
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SensorError
from isocharge.simulate.sensor.size_check import check_range

Surface = Literal["middle", "top", "bottom"]
"""Surface at which the stress of the film is read. The top is the surface that the probe touches."""

FILM_LIMITS = {
    "radius": (1.0, math.inf, "mm"),
    "thickness": (1e-4, math.inf, "mm"),
    "young": (1.0, 1e6, "MPa"),  # from a soft rubber to nearly diamond
    "poisson": (0.0, 0.4999, ""),
    "pretension": (-10.0, 300.0, "MPa"),  # a slack film wrinkles; stretched PVDF breaks
    "(T11 - T22) / 2": (-300.0, 300.0, "MPa"),
    "T12": (-300.0, 300.0, "MPa"),
    "young, E1 / E2": (0.1, 10.0, ""),  # the solver has been tested in this range
    "shear": (1.0, 1e6, "MPa"),
    "axis": (-math.inf, math.inf, "rad"),
    "oval": (-0.1, 0.1, ""),  # the mesh has been tested in this range
    "oval_axis": (-math.inf, math.inf, "rad"),
    "back_volume": (1.0, math.inf, "mm^3"),
    "static_pressure": (-1e4, 1e4, "Pa"),  # a film of 25 um bulges by several millimetres
    "expansion": (-1e3, 1e3, "ppm/K"),
    "ring_expansion": (-1e3, 1e3, "ppm/K"),
}
"""Smallest and largest accepted value of each property of a film, and its unit.

Smaller lengths and volumes were probably given in metres, and larger stresses in pascals.
"""

UNIT_FACTORS = {"Pa": 1e6, "ppm/K": 1e6}
"""Factors that convert a value in MPa or 1/K into a unit of `FILM_LIMITS`. All other units are those of `Film`."""

PIEZO_LIMITS = (1e-3, 1e5)
"""Smallest accepted magnitude of a coefficient that is not zero, and largest magnitude, pC/N or pC/(mm^2 K).

A smaller coefficient was probably given in C/N. The largest is thirty times that of the strongest crystals.
"""

ALUMINIUM_EXPANSION = 23e-6
"""Thermal expansion coefficient of aluminium, 1/K. Most rings are made of aluminium."""


@dataclass(frozen=True)
class Film:
    """Mechanical properties of a film that is clamped along its edge.

    Attributes:
        radius: Radius of the clamped edge, mm.
        thickness: Thickness of the film, mm.
        young: Young's modulus, MPa. For an orthotropic film, this is sqrt(E1 E2).
        poisson: Poisson's ratio, from 0 to less than 0.5, dimensionless. For an orthotropic film, this is
            sqrt(nu12 nu21).
        pretension: Stress of the unloaded film, MPa, tension positive. It is the second Piola-Kirchhoff stress, and the
            mean of its components T11 and T22.
        deviator: Half difference (T11 - T22) / 2 and shear T12 of a pretension that depends on the direction, MPa.
        young_ratio: Ratio E1 / E2 of Young's moduli of an orthotropic film, dimensionless.
        shear: Shear modulus G12 of an orthotropic film, MPa; None for young / (2 (1 + poisson)).
        axis: Angle of axis 1 of an orthotropic film from the x axis, anticlockwise, rad.
        oval: Parameter e of an oval clamp, whose semi-axes are radius * (1 + e) and radius * (1 - e), dimensionless.
        oval_axis: Angle of the longer semi-axis of an oval clamp from the x axis, anticlockwise, rad.
        back_volume: Volume of the closed cavity behind the film, mm^3; None if the back is vented.
        static_pressure: Constant pressure on the film, MPa, positive in the direction of the push. With a closed
            cavity, this is the pressure on the film if it is flat.
        expansion: Thermal expansion coefficients of the film along its axes 1 and 2, 1/K; None if the temperature does
            not change the pretension.
        ring_expansion: Thermal expansion coefficient of the ring, 1/K.
    """

    radius: float
    thickness: float
    young: float
    poisson: float
    pretension: float = 0.0
    deviator: tuple[float, float] = (0.0, 0.0)
    young_ratio: float = 1.0
    shear: float | None = None
    axis: float = 0.0
    oval: float = 0.0
    oval_axis: float = 0.0
    back_volume: float | None = None
    static_pressure: float = 0.0
    expansion: tuple[float, float] | None = None
    ring_expansion: float = ALUMINIUM_EXPANSION

    @property
    def inner_radius(self) -> float:
        """Radius of the largest circle around the centre of the film that does not cross the clamp, mm."""
        return self.radius * (1.0 - abs(self.oval))

    def rim_distance(self, angle: Array) -> Array:
        """Return the distance of the rim from the centre of the film in given directions, mm.

        Args:
            angle: Angles from the x axis, anticlockwise, any shape, rad.
        """
        return np.asarray(self.radius * (1.0 + self.oval * np.cos(2.0 * (angle - self.oval_axis))))

    @property
    def expands_evenly(self) -> bool:
        """Whether a change of the temperature changes the pretension equally in all directions."""
        if self.expansion is None:
            return True
        along, across = self.expansion
        return along == across and self.young_ratio == 1.0

    @property
    def has_back_pressure(self) -> bool:
        """Whether the film has a closed back or a static pressure, so that a pressure acts on the whole film."""
        return self.back_volume is not None or self.static_pressure != 0.0

    @property
    def is_anisotropic(self) -> bool:
        """Whether the elasticity or the pretension depends on the direction."""
        return self.deviator != (0.0, 0.0) or self.young_ratio != 1.0 or self.shear is not None

    @property
    def is_axisymmetric(self) -> bool:
        """Whether the properties of the film remain unchanged if the film is rotated about its centre."""
        return not self.is_anisotropic and self.oval == 0.0

    def rotated(self, angle: float) -> Self:
        """Return the film after a rotation about its centre.

        Args:
            angle: Angle of the rotation, anticlockwise, rad.
        """
        if self.is_axisymmetric:
            return self
        half_difference, shear = self.deviator
        cosine = math.cos(2.0 * angle)
        sine = math.sin(2.0 * angle)
        deviator = (half_difference * cosine - shear * sine, half_difference * sine + shear * cosine)
        return replace(self, deviator=deviator, axis=self.axis + angle, oval_axis=self.oval_axis + angle)

    def __post_init__(self) -> None:
        """Check the properties of the film.

        Raises:
            SensorError: If a property is outside its accepted range.
        """
        half_difference, shear_tension = self.deviator
        other_names = {"young, E1 / E2": self.young_ratio, "(T11 - T22) / 2": half_difference, "T12": shear_tension}
        values = {**vars(self), **other_names}
        for name, (low, high, unit) in FILM_LIMITS.items():
            value = values[name]
            for number in value if isinstance(value, tuple) else (value,):
                if number is not None:  # an optional property
                    value_in_unit = number * UNIT_FACTORS.get(unit, 1.0)
                    check_range(f"film {name}", value_in_unit, (low, high), unit, SensorError)
        if self.thickness > 0.1 * self.radius:
            raise SensorError(
                f"film thickness: expected at most a tenth of the radius ({self.radius:g} mm), "
                f"got {self.thickness:.6g} mm; this is a solid, not a film"
            )


@dataclass(frozen=True)
class Piezo:
    """Piezoelectric strain coefficients and pyroelectric coefficient of a film.

    If d31 is positive, a tension along x causes a positive charge. In PVDF, a decrease of the thickness increases the
    charge, and an increase of the thickness decreases the charge. Tension along x makes the film thinner, and warming
    makes the film thicker. PVDF with d31 = 20 pC/N therefore has the negative coefficients d33 = -33 pC/N and
    pyro = -30 pC/(mm^2 K) (Kepler and Anderson 1978). Data sheets often omit the signs of the coefficients. If the two
    wires of a film are exchanged, all coefficients change their signs.

    Attributes:
        d31: Charge density per tensile stress along x, pC/N.
        d32: Charge density per tensile stress along y, pC/N.
        d33: Charge density per tensile stress through the thickness, pC/N.
        d12: Coefficient of the shear stress s12, pC/N. The charge density is 2 d12 s12. If the piezoelectric axes are
            rotated by an angle, d12 is (d31 - d32) / 2 times the sine of twice this angle.
        pyro: Charge density per change of the temperature of a film that is free to expand, pC/(mm^2 K).
    """

    d31: float
    d32: float
    d33: float = 0.0
    pyro: float = 0.0
    d12: float = 0.0

    def __post_init__(self) -> None:
        """Check the coefficients.

        Raises:
            SensorError: If a coefficient is outside its accepted range, or if d31, d32 and d12 are all zero.
        """
        smallest, largest = PIEZO_LIMITS
        for name, coefficient in vars(self).items():
            check_range(f"piezo {name}", coefficient, (-largest, largest), "pC/N", SensorError)
            if name != "pyro" and 0.0 < abs(coefficient) < smallest:
                raise SensorError(
                    f"piezo {name}: expected pC/N, got {coefficient:.6g} pC/N; {coefficient:.6g} C/N are "
                    f"{1e12 * coefficient:.6g} pC/N"
                )
        if self.d31 == self.d32 == self.d12 == 0.0:
            raise SensorError("piezo d31 and d32 are both 0: such a film gives no charge")
