"""Mechanical properties and piezoelectric coefficients of the film."""

import math
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SensorError
from isocharge.simulate.sensor.size_check import check_length, check_stress

Surface = Literal["middle", "top", "bottom"]
"""Surface at which the stress of the film is read. The top is the surface that the probe touches."""

MIN_RADIUS = 1.0
"""Smallest accepted radius of a film, mm. A smaller value was probably given in metres."""

MIN_THICKNESS = 1e-4
"""Smallest accepted thickness of a film, mm. A smaller value was probably given in metres."""

MAX_PIEZO = 1e5
"""Largest accepted piezoelectric or pyroelectric coefficient, pC/N or pC/(mm^2 K).

This value is thirty times the coefficient of the strongest crystals.
"""

MIN_PIEZO = 1e-3
"""Smallest accepted magnitude of a coefficient d31, d32, d33 or d12 that is not zero, pC/N.

A smaller value was probably given in C/N.
"""

MIN_YOUNG = 1.0
"""Smallest accepted Young's modulus of a film, MPa. It is that of a soft rubber."""

MAX_YOUNG = 1e6
"""Largest accepted Young's modulus of a film, MPa. It is nearly that of diamond."""

MAX_PRETENSION = 300.0
"""Largest accepted pretension of a film, MPa. It is the tensile strength of stretched PVDF."""

MAX_SLACK = 10.0
"""Largest accepted magnitude of a negative pretension, MPa. A slack film wrinkles under small forces."""

MAX_YOUNG_RATIO = 10.0
"""Largest ratio E1 / E2 of Young's moduli for which the solver has been tested, dimensionless."""

MAX_OVAL = 0.1
"""Largest parameter e of an oval clamp for which the mesh has been tested, dimensionless."""

MAX_EXPANSION = 1e-3
"""Largest accepted magnitude of a thermal expansion coefficient, 1/K. A larger value was probably given in ppm/K."""

ALUMINIUM_EXPANSION = 23e-6
"""Thermal expansion coefficient of aluminium, 1/K. Most rings are made of aluminium."""

MIN_BACK_VOLUME = 1.0
"""Smallest accepted volume of the cavity behind a film, mm^3. A smaller value was probably given in m^3."""

MAX_STATIC_PRESSURE = 0.01
"""Largest accepted magnitude of a static pressure, MPa.

A film of 25 um bulges by several millimetres under such a pressure.
"""


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
    def asymmetries(self) -> dict[str, object]:
        """Names and values of the attributes that make the film differ from an axisymmetric film."""
        names = ("deviator", "young_ratio", "shear", "axis", "oval", "oval_axis")
        return {name: getattr(self, name) for name in names if getattr(self, name) != getattr(Film, name)}

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
        # Most conditions negate an accepted range, so that NaN is rejected as well.
        check_length("film radius", self.radius, MIN_RADIUS, SensorError)
        check_length("film thickness", self.thickness, MIN_THICKNESS, SensorError)
        check_stress("film young", self.young, MIN_YOUNG, MAX_YOUNG, SensorError)
        check_stress("film pretension", self.pretension, -MAX_SLACK, MAX_PRETENSION, SensorError)
        if not 0.0 <= self.poisson < 0.5:
            raise SensorError(f"film poisson: expected 0 <= poisson < 0.5, got {self.poisson}")

        # Check the properties that depend on the direction.
        for name, value in zip(("(T11 - T22) / 2", "T12"), self.deviator, strict=True):
            check_stress(f"film pretension, {name}", value, -MAX_PRETENSION, MAX_PRETENSION, SensorError)
        if self.shear is not None:
            check_stress("film shear", self.shear, MIN_YOUNG, MAX_YOUNG, SensorError)
        if not 1.0 / MAX_YOUNG_RATIO <= self.young_ratio <= MAX_YOUNG_RATIO:
            raise SensorError(
                f"film young: expected E1 / E2 from 1/{MAX_YOUNG_RATIO:g} to {MAX_YOUNG_RATIO:g}, got "
                f"{self.young_ratio:g}"
            )
        if not abs(self.oval) <= MAX_OVAL:
            raise SensorError(f"film oval: expected a share up to {MAX_OVAL:g}, got {self.oval}")

        # Check the thermal expansion, the pressure on the back, and the shape.
        for expansion in (*(self.expansion or ()), self.ring_expansion):
            if not abs(expansion) <= MAX_EXPANSION:
                raise SensorError(
                    f"film expansion: expected at most {1e6 * MAX_EXPANSION:g} ppm/K in size, got "
                    f"{1e6 * expansion:.6g} ppm/K"
                )
        if self.back_volume is not None and not MIN_BACK_VOLUME <= self.back_volume < math.inf:
            raise SensorError(
                f"film back volume: expected at least {MIN_BACK_VOLUME:g} mm^3, got {self.back_volume:.6g} mm^3; leave "
                "it out if the back is vented"
            )
        if not abs(self.static_pressure) <= MAX_STATIC_PRESSURE:
            raise SensorError(
                f"film static pressure: expected at most {1e6 * MAX_STATIC_PRESSURE:g} Pa in size, got "
                f"{1e6 * self.static_pressure:.6g} Pa"
            )
        if not (math.isfinite(self.axis) and math.isfinite(self.oval_axis)):
            raise SensorError(f"film axis, oval_axis: expected finite angles, got {self.axis}, {self.oval_axis}")
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
        for name, coefficient in vars(self).items():
            if not abs(coefficient) <= MAX_PIEZO:  # NaN is rejected as well
                raise SensorError(f"piezo {name}: expected a number up to {MAX_PIEZO:g} in size, got {coefficient}")
            if name != "pyro" and 0.0 < abs(coefficient) < MIN_PIEZO:
                raise SensorError(
                    f"piezo {name}: expected pC/N, got {coefficient:.6g} pC/N; {coefficient:.6g} C/N are "
                    f"{1e12 * coefficient:.6g} pC/N"
                )
        if self.d31 == self.d32 == self.d12 == 0.0:
            raise SensorError("piezo d31 and d32 are both 0: such a film gives no charge")
