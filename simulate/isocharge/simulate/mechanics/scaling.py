"""The dimensionless groups of a press, and the amplitude that makes the scaled solution of order one.

Under a central force F, the deflection of the centre is w = a A. The force F / (E h a) is proportional to

    A^3                     for a membrane without pretension,
    (pretension / E) A      for a membrane with a large pretension,
    16 pi b A               for a plate, with b = (h / a)^2 / (12 (1 - poisson^2))

(Schwerin 1929; Timoshenko and Woinowsky-Krieger 1959, art. 19). The amplitude A is the solution of the cubic equation
in which the sum of the three terms is equal to F / (E h a). Between the limiting cases, this amplitude is also a good
approximation. The in-plane displacement is proportional to A^2. After this scaling, only the ratios of the terms remain
as parameters of the press.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.stress import rotate_stress, stress, stress_rotation
from isocharge.simulate.sensor.film import Film

MEMBRANE_STIFFNESS = 1.6
"""Ratio of force to deflection of a membrane with a large pretension, in units of pretension times thickness.

The value is 2 pi / ln(a / R) for a probe radius R = 0.02 a."""

AMBIENT_PRESSURE = 0.101325
"""Pressure of the atmosphere, MPa."""

AIR_SHAPE = 0.6
"""Square of the ratio of the volume under the film to the deflection of the centre, for the first iterate of Newton's
method, in units of a^4."""

PLATE_STIFFNESS = 16.0 * np.pi
"""Ratio of force to deflection of a clamped plate under a central point load, in units of the plate stiffness over
a^2."""


@dataclass(frozen=True, eq=False)
class Anisotropy:
    """Direction-dependent properties of a film, in axes that are rotated with the press.

    Attributes:
        moduli: Difference between the elasticity matrix C over E and that of the isotropic film, shape (3, 3); see
            `mechanics.stress.stress`.
        tension: Difference (T11, T22, T12) between the pretension and its mean, over E A^2, shape (3,).
    """

    moduli: Array
    tension: Array


@dataclass(frozen=True)
class DimensionlessGroups:
    """The dimensionless groups that define the scaled problem.

    E is Young's modulus, h the thickness and a the radius of the film.

    Attributes:
        squared_amplitude: Square A^2 of the amplitude A, which scales the deflection in film radii.
        load: Force over E h a A^3.
        tension: Mean pretension over E A^2.
        bending: Bending stiffness over E h a^2 A^2, which is b / A^2. Zero omits bending.
        poisson: Poisson's ratio.
        anisotropy: Direction-dependent properties; None if the film is isotropic.
        side_load: Side force (Fx, Fy) over E h a A^2, in axes that are rotated with the press.
        static_pressure: Static pressure over E h A^3 / a, positive in the direction of the push.
        ambient_pressure: Pressure of the atmosphere over E h A^3 / a. Zero if the back is vented.
        compression: Relative compression of the air behind the film, divided by the integral of the scaled deflection W
            over the film. Zero if the back is vented.
    """

    squared_amplitude: float
    load: float
    tension: float
    bending: float
    poisson: float
    anisotropy: Anisotropy | None = None
    side_load: tuple[float, float] = (0.0, 0.0)
    static_pressure: float = 0.0
    ambient_pressure: float = 0.0
    compression: float = 0.0

    @classmethod
    def of(
        cls,
        film: Film,
        force: float,
        *,
        bending: bool,
        angle: float = 0.0,
        side_force: tuple[float, float] = (0.0, 0.0),
    ) -> "DimensionlessGroups":
        """Compute the groups of a press, which is rotated onto the x axis.

        Args:
            film: The film.
            force: Force, N.
            bending: Whether the theory includes bending.
            angle: Direction of the press from the centre of the film, rad.
            side_force: Force (Fx, Fy) of the probe on the film along the film, N.

        Returns:
            The groups, which describe the press completely.
        """
        # Units of the force and of the pressure: E h a A^3 and E h A^3 / a
        squared_amplitude = float(amplitude_squared(film, force))
        force_unit = film.young * film.thickness * film.radius * squared_amplitude**1.5
        pressure_unit = film.young * film.thickness * squared_amplitude**1.5 / film.radius

        side_load = (0.0, 0.0)
        if any(side_force):  # rotated into the axes of the press
            side_x, side_y = side_force
            along_press = side_x * np.cos(angle) + side_y * np.sin(angle)
            across_press = side_y * np.cos(angle) - side_x * np.sin(angle)
            side_unit = side_force_unit(film, squared_amplitude)
            side_load = (float(along_press / side_unit), float(across_press / side_unit))

        # Ratio of the unit of the displaced volume, a^3 A, to the volume of the trapped air
        compression = 0.0
        if film.back_volume is not None:
            compression = film.radius**3 * squared_amplitude**0.5 / film.back_volume
        return cls(
            squared_amplitude=squared_amplitude,
            load=force / force_unit,
            tension=film.pretension / (film.young * squared_amplitude),
            bending=slenderness(film) / squared_amplitude if bending else 0.0,
            poisson=film.poisson,
            anisotropy=_anisotropy(film, squared_amplitude, angle) if film.is_anisotropic else None,
            side_load=side_load,
            static_pressure=film.static_pressure / pressure_unit,
            ambient_pressure=AMBIENT_PRESSURE / pressure_unit if compression else 0.0,
            compression=compression,
        )

    @property
    def has_back_pressure(self) -> bool:
        """Whether a pressure acts on the whole film."""
        return self.static_pressure != 0.0 or self.compression != 0.0

    @property
    def without_probe(self) -> "DimensionlessGroups":
        """Groups of the same film without the forces of the probe, in the same units."""
        return replace(self, load=0.0, side_load=(0.0, 0.0))

    @property
    def total_load(self) -> float:
        """Force of the probe plus the magnitude of the force of the static pressure, in units of E h a A^3."""
        return self.load + np.pi * abs(self.static_pressure)

    @property
    def height(self) -> float:
        """Approximate deflection of the centre in units of a A.

        The value is 1 if the back of the film is vented and the groups were computed by `of` with bending.
        """
        linear = MEMBRANE_STIFFNESS * max(self.tension, 0.0) + PLATE_STIFFNESS * self.bending
        air = AIR_SHAPE * self.ambient_pressure * self.compression
        return float(_root(linear + air, self.load))

    @property
    def static_height(self) -> float:
        """Approximate deflection of the centre by the static pressure, in units of a A.

        The deflection H is the root of a cubic equation that has the correct limits for a scaled pressure p:
        H^3 = (0.662)^3 p for a membrane without pretension (Hencky 1915), H = p / (4 tension) for a large pretension,
        and H = p / (64 bending) for a plate.
        """
        # Coefficients of the equation cubic H^3 + linear H = p. The trapped air also resists the deflection. The volume
        # under a paraboloid of the height H and the radius 1 is pi H / 2.
        air_stiffness = 0.5 * np.pi * self.ambient_pressure * self.compression
        linear = 4.0 * max(self.tension, 0.0) + 64.0 * self.bending + air_stiffness
        cubic = 1.0 / 0.662**3
        height = float(_root(linear / cubic, abs(self.static_pressure) / cubic))
        return float(np.copysign(height, self.static_pressure))

    @property
    def induced(self) -> float:
        """Approximate share of the load that the induced stress carries, from 0 (linear film) to 1 (no pretension)."""
        return self.height**3 / self.load

    def stiffened(self, tension: float) -> "DimensionlessGroups":
        """Return the groups with an additional tension, in units of E A^2."""
        return replace(self, tension=self.tension + tension)


def scaled_stress(scaled_strain: Array, groups: DimensionlessGroups) -> Array:
    """Compute the scaled stress C : E' of a scaled strain.

    Args:
        scaled_strain: Scaled strain (E11, E22, 2 E12), shape (..., 3), in units of A^2.
        groups: Dimensionless groups of the press.

    Returns:
        (S11, S22, S12), shape (..., 3), in units of E_young A^2.
    """
    moduli = None if groups.anisotropy is None else groups.anisotropy.moduli
    return stress(scaled_strain, groups.poisson, moduli)


def _anisotropy(film: Film, squared_amplitude: float, angle: float) -> Anisotropy:
    """Compute the direction-dependent properties of a film, in axes whose first one points to the press.

    Args:
        film: The film.
        squared_amplitude: Square A^2 of the amplitude.
        angle: Direction of the press from the centre of the film, rad.

    Returns:
        Differences from the isotropic elasticity matrix and from the mean pretension.
    """
    # The moduli refer to the axes of the material, which lie at this angle to the direction of the press.
    material_angle = film.axis - angle
    rotation = stress_rotation(material_angle)
    moduli = rotation @ orthotropic_moduli(film) @ rotation.T

    # The pretension refers to the axes x and y. The x axis lies at the angle -angle to the direction of the press.
    half_difference, shear_tension = film.deviator
    tension_difference = np.array([half_difference, -half_difference, shear_tension])  # (T11, T22, T12) minus the mean
    rotated_difference = rotate_stress(tension_difference, -angle)
    return Anisotropy(moduli, rotated_difference / (film.young * squared_amplitude))


def orthotropic_moduli(film: Film) -> Array:
    """Compute the matrix C / E of a film minus the matrix C / E of an isotropic film, where C is the elasticity matrix.

    The axes are those of the film. The moduli along the axes are E1 = E r and E2 = E / r, with r^2 = E1 / E2.

    Args:
        film: The film.

    Returns:
        Difference for the strain components (E11, E22, 2 E12), shape (3, 3), dimensionless.
    """
    plane_modulus = 1.0 / (1.0 - film.poisson**2)
    r = np.sqrt(film.young_ratio)
    difference_11 = plane_modulus * (r - 1.0)
    difference_22 = plane_modulus * (1.0 / r - 1.0)

    # Without a given shear modulus, the shear modulus is that of an isotropic film.
    difference_12 = 0.0
    if film.shear is not None:
        isotropic_shear = 0.5 / (1.0 + film.poisson)
        difference_12 = film.shear / film.young - isotropic_shear
    return np.diag([difference_11, difference_22, difference_12])


def side_force_unit(film: Film, squared_amplitude: Array | float) -> Any:
    """Compute the side force that corresponds to a scaled side load of one, E h a A^2.

    Args:
        film: The film.
        squared_amplitude: Square A^2 of the amplitude, a number or an array of any shape.

    Returns:
        Force, N, of the shape and type of `squared_amplitude`.
    """
    return film.young * film.thickness * film.radius * squared_amplitude


def slenderness(film: Film) -> float:
    """Return the dimensionless bending stiffness b, which is the bending stiffness over E h a^2."""
    return (film.thickness / film.radius) ** 2 / (12.0 * (1.0 - film.poisson**2))


def amplitude_squared(film: Film, force: Array | float) -> Any:
    """Compute the square A^2 of the amplitude of a press; see the docstring of this module.

    Args:
        film: The film.
        force: Force, N, a number or an array of any shape.

    Returns:
        A^2, of the shape and type of `force`.
    """
    linear = MEMBRANE_STIFFNESS * max(film.pretension, 0.0) / film.young + PLATE_STIFFNESS * slenderness(film)
    return _root(linear, force / (film.young * film.thickness * film.radius)) ** 2


def _root(linear: float, right_side: Array | float) -> Any:
    """Return the real root x of x^3 + linear * x = right_side. Both parameters must not be negative."""
    if linear == 0.0:
        return np.cbrt(right_side)
    scale = np.sqrt(linear / 3.0)
    # Hyperbolic form of Cardano's formula, from x = 2 scale sinh(t) and 4 sinh(t)^3 + 3 sinh(t) = sinh(3 t)
    return 2.0 * scale * np.sinh(np.arcsinh(right_side / (2.0 * scale**3)) / 3.0)
