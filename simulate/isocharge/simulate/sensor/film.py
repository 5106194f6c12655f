"""Mechanical properties and piezoelectric coefficients of a film, and their accepted ranges.

The table `FILM_NUMBERS` declares the unit and the range of each mechanical property. The function `check_range` raises
an error if a quantity is outside its range. Probes, electrodes and layouts use this function, too.
"""

import cmath
import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Self

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.errors import InputError, SensorError

Surface = Literal["middle", "top", "bottom"]
"""Surface at which the stress of the film is read. The top is the surface that the probe touches."""


class FilmNumber(NamedTuple):
    """Unit and accepted range of a property of a film in a sensor file.

    Attributes:
        key: Key in the section `film`. The key contains the unit, and some keys belong to several properties.
        unit: Unit of the value in the file.
        factor: Factor that converts the value of the attribute of `Film` into the value in the file.
        smallest: Smallest accepted value, in the unit of the file.
        largest: Largest accepted value, in the unit of the file.
    """

    key: str
    unit: str
    factor: float
    smallest: float
    largest: float


FILM_NUMBERS = {
    "radius": FilmNumber("radius_mm", "mm", 1.0, 1.0, 1e3),  # the mesh then resolves the smallest probe
    "thickness": FilmNumber("thickness_um", "um", 1e3, 0.1, math.inf),
    "young": FilmNumber("young_GPa", "GPa", 1e-3, 1e-3, 1e3),  # from a soft rubber to nearly diamond
    "young_ratio": FilmNumber("young_GPa, E1 / E2", "", 1.0, 0.1, 10.0),  # the solver has been tested in this range
    "poisson": FilmNumber("poisson", "", 1.0, 0.0, 0.4999),
    "pretension": FilmNumber("pretension_MPa", "MPa", 1.0, -10.0, 300.0),  # slack wrinkles; stretched PVDF breaks
    "deviator": FilmNumber("pretension_MPa, (T11 - T22) / 2 and T12", "MPa", 1.0, -300.0, 300.0),
    "shear": FilmNumber("shear_GPa", "GPa", 1e-3, 1e-3, 1e3),
    "axis": FilmNumber("axis_deg", "deg", math.degrees(1.0), -math.inf, math.inf),
    "oval": FilmNumber("oval", "", 1.0, -0.1, 0.1),  # the mesh has been tested in this range
    "oval_axis": FilmNumber("oval_axis_deg", "deg", math.degrees(1.0), -math.inf, math.inf),
    "back_volume": FilmNumber("back_volume_mm3", "mm^3", 1.0, 1.0, math.inf),
    "static_pressure": FilmNumber("static_pressure_Pa", "Pa", 1e6, -1e4, 1e4),  # a film of 25 um bulges by millimetres
    "expansion": FilmNumber("expansion_ppm_per_K", "ppm/K", 1e6, -1e3, 1e3),
    "ring_expansion": FilmNumber("ring_expansion_ppm_per_K", "ppm/K", 1e6, -1e3, 1e3),
}
"""Unit and accepted range of each attribute of `Film`. The sensor file is read and written according to this table."""

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
        pretension: Stress of the unloaded film, MPa, tension positive. The value is the mean of the components T11 and
            T22 of the second Piola-Kirchhoff stress.
        deviator: Half difference (T11 - T22) / 2 and shear T12 of a pretension that depends on the direction, MPa.
        young_ratio: Ratio E1 / E2 of Young's moduli of an orthotropic film, dimensionless.
        shear: Shear modulus G12 of an orthotropic film, MPa; None for young / (2 (1 + poisson)).
        axis: Angle of axis 1 of an orthotropic film from the x axis, anticlockwise, rad.
        oval: Parameter e of an oval clamp, whose semi-axes are radius * (1 + e) and radius * (1 - e), dimensionless.
        oval_axis: Angle of the longer semi-axis of an oval clamp from the x axis, anticlockwise, rad.
        back_volume: Volume of the closed cavity behind the film, mm^3; None if the back is vented.
        static_pressure: Constant pressure on the film, MPa, positive in the direction of the push. With a closed
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
        return self.radius * (1.0 + self.oval * np.cos(2.0 * (angle - self.oval_axis)))

    def relative_distance(self, points: Complexes) -> Array:
        """Return the distance of points from the centre, divided by the distance of the rim in the same direction.

        Args:
            points: Points x + iy, any shape, mm.

        Returns:
            Ratios, same shape, dimensionless. The ratios are less than 1 on the film and 1 on the rim.
        """
        return np.abs(points) / self.rim_distance(np.angle(points))

    @property
    def rim(self) -> Complexes:
        """Points x + iy of the rim for drawings, one for each degree from 0 to 360, anticlockwise, shape (361,), mm."""
        angle = np.radians(np.arange(361.0))
        return np.asarray(self.rim_distance(angle) * np.exp(1j * angle))

    @property
    def has_back_pressure(self) -> bool:
        """Whether the film has a closed back or a static pressure, so that a pressure acts on the whole film."""
        return self.back_volume is not None or self.static_pressure != 0.0

    @property
    def is_axisymmetric(self) -> bool:
        """Whether the properties of the film remain unchanged if the film is rotated about its centre."""
        is_isotropic = self.deviator == (0.0, 0.0) and self.young_ratio == 1.0 and self.shear is None
        return is_isotropic and self.oval == 0.0

    def rotated(self, angle: float) -> Self:
        """Return the film after a rotation about its centre.

        Args:
            angle: Angle of the rotation, anticlockwise, rad.
        """
        if self.is_axisymmetric:
            return self
        # As a complex number, the deviator is rotated by twice the angle.
        deviator = complex(*self.deviator) * cmath.rect(1.0, 2.0 * angle)
        return replace(
            self,
            deviator=(deviator.real, deviator.imag),
            axis=self.axis + angle,
            oval_axis=self.oval_axis + angle,
        )

    def __post_init__(self) -> None:
        """Check the properties of the film.

        For each attribute, the table `FILM_NUMBERS` contains the key, the unit and the range of its value in a sensor
        file, and the factor that converts the attribute into this unit.

        Raises:
            SensorError: If a property is outside its accepted range.
        """
        for attribute, number in FILM_NUMBERS.items():
            value = getattr(self, attribute)
            if value is None:  # an optional property
                continue
            limits = (number.smallest, number.largest)
            values_in_file = np.atleast_1d(np.multiply(value, number.factor))  # some properties have two components
            for value_in_file in values_in_file.tolist():
                check_range(f"film.{number.key}", value_in_file, limits, number.unit, SensorError)
        if self.thickness > 0.1 * self.radius:
            raise SensorError(
                f"film.thickness_um: expected at most a tenth of the radius ({self.radius:g} mm), "
                f"got {self.thickness:.6g} mm; this is a solid, not a film"
            )


PIEZO_LIMITS = (1e-3, 1e5)
"""Smallest magnitude of a nonzero d31, d32 or d33, and largest magnitude of any coefficient, pC/N or pC/(mm^2 K).

A smaller coefficient was probably given in C/N. The largest magnitude is thirty times the coefficient of the strongest
crystals.
"""


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
        pyro: Charge density per temperature change of a film that is free to expand, pC/(mm^2 K).
    """

    d31: float
    d32: float
    d33: float = 0.0
    pyro: float = 0.0
    d12: float = 0.0

    @property
    def charge_per_stress(self) -> Array:
        """Charge density per stress (s11, s22, s12), shape (3,), pC/N. The shear stresses s12 and s21 are equal."""
        return np.array([self.d31, self.d32, 2.0 * self.d12])

    def __post_init__(self) -> None:
        """Check the coefficients.

        Raises:
            SensorError: If a coefficient is outside its accepted range, or if d31, d32 and d12 are all zero.
        """
        smallest, largest = PIEZO_LIMITS
        for name, coefficient in vars(self).items():
            unit = "pC/(mm^2 K)" if name == "pyro" else "pC/N"
            check_range(f"piezo {name}", coefficient, (-largest, largest), unit, SensorError)
            may_be_tiny = name in ("pyro", "d12")  # d12 is an imperfection
            if not may_be_tiny and 0.0 < abs(coefficient) < smallest:
                raise SensorError(
                    f"piezo {name}: expected pC/N, got {coefficient:.6g} pC/N; if this is the value in C/N, write "
                    f"{1e12 * coefficient:.6g}"
                )
        if self.d31 == self.d32 == self.d12 == 0.0:
            raise SensorError("piezo d31, d32 and d12 are all 0: such a film gives no charge")


OTHER_UNITS = {"mm": ("m", 1e3), "um": ("mm", 1e3), "MPa": ("Pa", 1e-6), "GPa": ("MPa", 1e-3)}
"""Map from a unit to another unit that is easily used by mistake, and to the conversion factor.

A value in the other unit times the factor is the value in the expected unit.
"""


def tidy(value: float) -> float:
    """Round a number to twelve significant digits, in order to remove the rounding errors of unit conversions."""
    return float(f"{value:.12g}")


def check_range(what: str, value: float, allowed: tuple[float, float], unit: str, error: type[InputError]) -> None:
    """Raise an error if a quantity is infinite or outside its accepted range.

    If a conversion from another unit (`OTHER_UNITS`) would bring the value into the range, the value was probably given
    in the other unit by mistake. The error message then contains the converted value.

    Args:
        what: Name of the quantity in the error message.
        value: Value to be checked. NaN is outside every range.
        allowed: Smallest and largest accepted value.
        unit: Unit of the value, such as "mm" or "MPa".
        error: Class of the error that is raised.

    Raises:
        InputError: If the value is not accepted. The class of the error is `error`.
    """
    low, high = allowed
    if low <= value <= high and math.isfinite(value):
        return
    hint = ""
    other_unit, factor = OTHER_UNITS.get(unit, ("", math.nan))
    converted_value = factor * value  # NaN, which is outside the range, if there is no other unit
    if low <= converted_value <= high:
        hint = f"; {value:.6g} {other_unit} are {converted_value:.6g} {unit}"
    expected = f"at least {low:g}" if high == math.inf else f"{low:g} to {high:g}"
    space = " " if unit else ""
    raise error(f"{what}: expected {expected}{space}{unit}, got {value:.6g}{space}{unit}{hint}")


def add_axial(size: float, axis: float, addition: complex) -> tuple[float, float]:
    """Change a property of a film that has a size and an axis, such as the shape of an oval clamp.

    Half a turn maps an axis onto itself. The property is therefore converted into the complex number
    size * exp(2 i axis), which remains the same if the axis makes half a turn.

    Args:
        size: Size of the property.
        axis: Angle of the axis from the x axis, rad.
        addition: Complex number that is added to the property.

    Returns:
        New size and new axis (rad). If the addition is zero, both are unchanged. Otherwise, the new size is not
        negative, because a negative size is the same as a positive size with a perpendicular axis. If the new size is
        zero except for rounding errors, the property has no axis, and the given axis is returned.
    """
    if addition == 0.0:
        return size, axis
    total = cmath.rect(size, 2.0 * axis) + addition
    if abs(total) < 1e-12 * abs(size):
        return 0.0, axis
    return abs(total), 0.5 * cmath.phase(total)


def add_anisotropy(film: Film, addition: complex) -> Film:
    """Change the anisotropy of the stiffness of a film.

    If the shear modulus of the film is given, the film keeps its axis, because the shear modulus refers to this axis.
    Only the component of the addition along the axis then changes the film.

    Args:
        film: Film that is changed.
        addition: Second anisotropy that is added to the anisotropy of the film. An anisotropy is a complex number with
            the magnitude ln(E1 / E2). Its argument is twice the angle from the x axis to axis 1.
    """
    log_ratio = math.log(film.young_ratio)
    if film.shear is None:
        log_ratio, axis = add_axial(log_ratio, film.axis, addition)
        return replace(film, young_ratio=math.exp(log_ratio), axis=axis)
    log_ratio += (addition * cmath.rect(1.0, -2.0 * film.axis)).real  # component along the axis of the film
    return replace(film, young_ratio=math.exp(log_ratio))
