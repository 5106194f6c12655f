"""Mechanical properties and piezoelectric coefficients of the film."""

import math
from dataclasses import dataclass
from typing import Literal

from isocharge.common.errors import SensorError
from isocharge.simulate.sensor.size_check import check_length, check_stress

Surface = Literal["middle", "top", "bottom"]
"""Surface in the thickness of the film at which the stress is read. The probe touches the top."""

MIN_RADIUS = 1.0
"""Smallest radius of a film, mm. Smaller values are probably in metres."""

MIN_THICKNESS = 1e-4
"""Smallest thickness of a film, mm. Smaller values are probably in metres."""

MAX_PIEZO = 1e5
"""Largest piezoelectric or pyroelectric coefficient, pC/N or pC/(mm^2 K).

It is thirty times the coefficient of the strongest crystals.
"""

MIN_PIEZO = 1e-3
"""Smallest coefficient d31, d32, d33 or d12 other than zero, pC/N. Smaller values are probably in C/N."""

MIN_YOUNG = 1e-6
"""Smallest Young's modulus of a film, MPa."""

MAX_YOUNG = 1e7
"""Largest Young's modulus of a film, MPa. Larger values are probably in Pa."""

MAX_PRETENSION = 1e4
"""Largest pretension of a film, MPa. Larger values are probably in Pa."""

MAX_SLACK = 10.0
"""Largest magnitude of a negative pretension, MPa. A slack film wrinkles under small forces."""

MAX_YOUNG_RATIO = 10.0
"""Largest ratio E1 / E2 for which the solver has been tested, dimensionless."""

MAX_OVAL = 0.1
"""Largest parameter e of an oval clamp for which the mesh has been tested, dimensionless."""

MAX_EXPANSION = 1e-3
"""Largest size of a thermal expansion coefficient, 1/K. Larger values are probably in ppm/K."""

ALUMINIUM_EXPANSION = 23e-6
"""Thermal expansion coefficient of aluminium, of which most rings are made, 1/K."""

MIN_BACK_VOLUME = 1.0
"""Smallest volume behind a film, mm^3. Smaller values are probably in m^3."""

MAX_STATIC_PRESSURE = 0.01
"""Largest size of a static pressure, MPa. A film of 25 um bulges by several millimetres under such a pressure."""

MAX_COAT_STIFFNESS = 5.0
"""Largest ratio of the stiffness of a coat to that of the film. The bending of a stiffer coat cannot be neglected."""


@dataclass(frozen=True)
class Coat:
    """Metal or ink that stiffens parts of a film.

    The coat is isotropic, has the same Poisson's ratio as the film, and has no pretension.

    Attributes:
        stiffness: Young's modulus times thickness of one layer, N/mm.
        layers: Areas with at least one layer and, if there are any, areas with two layers (one on each side). Each area
            is a tuple of convex polygons that do not overlap, with anticlockwise corners (x, y) on the real film, mm.
    """

    stiffness: float
    layers: tuple[tuple[tuple[tuple[float, float], ...], ...], ...]

    def __repr__(self) -> str:
        """Return a short text with the stiffness and the number of polygons.

        The corners are omitted, because there are many.
        """
        return f"Coat({self.stiffness:.4g} N/mm, {len(self.layers[0])} parts)"


@dataclass(frozen=True)
class Film:
    """A film that is clamped along its edge.

    Attributes:
        radius: Radius of the clamped edge, mm.
        thickness: Thickness, mm.
        young: Young's modulus, MPa; sqrt(E1 E2) of an orthotropic film.
        poisson: Poisson's ratio, 0 <= poisson < 0.5; sqrt(nu12 nu21) of an orthotropic film.
        pretension: Uniform second Piola-Kirchhoff stress without load, mean of T11 and T22, MPa, tension positive.
        deviator: (T11 - T22) / 2 and T12 of a pretension that depends on the direction, MPa.
        young_ratio: Ratio E1 / E2 of an orthotropic film, dimensionless.
        shear: Shear modulus G12 of an orthotropic film, MPa; None for young / (2 (1 + poisson)).
        axis: Angle of axis 1 of an orthotropic film from x, anticlockwise, rad.
        oval: Parameter e of an oval clamp, whose semi-axes are radius * (1 + e) and radius * (1 - e), dimensionless.
        oval_axis: Angle of the longer semi-axis from x, anticlockwise, rad.
        coat: Coat that stiffens parts of the film; None if there is no coat.
        back_volume: Volume of the closed cavity behind the film, mm^3; None if the back is vented.
        static_pressure: Pressure on the film without contact, MPa, positive in the direction of the push. With a closed
            cavity, this is the pressure on the flat film.
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
    coat: Coat | None = None
    back_volume: float | None = None
    static_pressure: float = 0.0
    expansion: tuple[float, float] | None = None
    ring_expansion: float = ALUMINIUM_EXPANSION

    @property
    def expands_evenly(self) -> bool:
        """Whether a change of the temperature changes the pretension equally in all directions."""
        if self.expansion is None:
            return True
        along, across = self.expansion
        return along == across and self.young_ratio == 1.0

    @property
    def has_back_pressure(self) -> bool:
        """Whether a pressure acts on the whole film, with or without contact."""
        return self.back_volume is not None or self.static_pressure != 0.0

    @property
    def is_anisotropic(self) -> bool:
        """Whether the elasticity or the pretension depends on the direction."""
        return self.deviator != (0.0, 0.0) or self.young_ratio != 1.0 or self.shear is not None

    @property
    def asymmetries(self) -> dict[str, object]:
        """Names and values of the attributes because of which the film is not axisymmetric."""
        names = ("deviator", "young_ratio", "shear", "axis", "oval", "oval_axis", "coat")
        return {name: getattr(self, name) for name in names if getattr(self, name) != getattr(Film, name)}

    @property
    def is_axisymmetric(self) -> bool:
        """Whether a rotation of the film about its centre changes nothing."""
        return not self.is_anisotropic and self.oval == 0.0 and self.coat is None

    def __post_init__(self) -> None:
        """Check the properties of the film.

        Raises:
            SensorError: If a property is outside the range for which the solver was tested.
        """
        check_length("film radius", self.radius, MIN_RADIUS, SensorError)
        check_length("film thickness", self.thickness, MIN_THICKNESS, SensorError)
        check_stress("film young", self.young, MIN_YOUNG, MAX_YOUNG, SensorError)
        check_stress("film pretension", self.pretension, -MAX_SLACK, MAX_PRETENSION, SensorError)
        if not 0.0 <= self.poisson < 0.5:
            raise SensorError(f"film poisson: expected 0 <= poisson < 0.5, got {self.poisson}")

        # Coat, and properties that depend on the direction
        max_stiffness = MAX_COAT_STIFFNESS * self.young * self.thickness
        if self.coat is not None and not 0.0 < self.coat.stiffness <= max_stiffness:
            raise SensorError(
                f"film coat: expected Young's modulus times thickness up to {MAX_COAT_STIFFNESS:g} times the film's, "
                f"{max_stiffness:.4g} N/mm, got {self.coat.stiffness:.4g} N/mm"
            )
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

        # Temperature, pressure on the back, and shape
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

    With d31 > 0, a tension along x causes a positive charge. In PVDF, a decrease of the thickness increases the charge,
    and an increase of the thickness decreases the charge. With d31 = 20 pC/N, PVDF therefore has d33 = -33 pC/N and
    pyro = -30 pC/(mm^2 K), because warming increases the thickness (Kepler and Anderson 1978). Data sheets often omit
    these signs. If the wires of a film are exchanged, all signs change.

    Attributes:
        d31: Charge per force of tension along x, pC/N.
        d32: Charge per force of tension along y, pC/N.
        d33: Charge per force of tension through the thickness, pC/N.
        d12: Coefficient of the shear stress, pC/N: the charge density is 2 d12 s12. If the piezoelectric axes are
            rotated by an angle, d12 is (d31 - d32) / 2 times the sine of twice this angle.
        pyro: Charge per area and temperature of a film that is free to expand, pC/(mm^2 K).
    """

    d31: float
    d32: float
    d33: float = 0.0
    pyro: float = 0.0
    d12: float = 0.0

    def __post_init__(self) -> None:
        """Check the coefficients.

        Raises:
            SensorError: If a coefficient is too large or too small for the unit pC/N, or if the film has no charge.
        """
        for name, coefficient in vars(self).items():
            if not abs(coefficient) <= MAX_PIEZO:
                raise SensorError(f"piezo {name}: expected a number up to {MAX_PIEZO:g} in size, got {coefficient}")
            if name != "pyro" and 0.0 < abs(coefficient) < MIN_PIEZO:
                raise SensorError(
                    f"piezo {name}: expected pC/N, got {coefficient:.6g} pC/N; {coefficient:.6g} C/N are "
                    f"{1e12 * coefficient:.6g} pC/N"
                )
        if self.d31 == self.d32 == self.d12 == 0.0:
            raise SensorError("piezo d31 and d32 are both 0: such a film gives no charge")
