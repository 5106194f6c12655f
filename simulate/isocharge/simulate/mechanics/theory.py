"""Theory of the film: strains and stresses, and the dimensionless groups of a press.

A force F at the centre of the film deflects the centre by w = a A, where a is the radius of the film and A is the
amplitude. With Young's modulus E and the thickness h of the film, the dimensionless force F / (E h a) is approximately

    A^3                         for a membrane without pretension,
    1.6 (pretension / E) A      for a membrane with a large pretension,
    16 pi b A                   for a plate, with b = (h / a)^2 / (12 (1 - poisson^2))

(Schwerin 1929; Timoshenko and Woinowsky-Krieger 1959, art. 19). The amplitude A is the solution of a cubic equation, in
which the sum of the three terms equals F / (E h a). Between the three limiting cases, the cubic equation is a good
approximation. The in-plane displacement is proportional to A^2. If the deflection is divided by a A, the scaled
deflection is of order one. The scaled equations depend on the press only through the ratios of the three terms.

Stretching is always geometrically nonlinear and includes the pretension. *Bending* is the resistance of the film to a
change of its curvature. A theory may omit bending. Bending is important near the rim and near the probe, and for the
stress at the surfaces of the film. The effect of bending reaches as far as the bending length sqrt(D / N), where D is
the bending stiffness and N is the tension force per length. If the pretension and the induced tension are small, the
bending stiffness carries the load.

The amplitude of a press also shows whether the strains are small enough for Saint-Venant-Kirchhoff elasticity
(`load_case.check_press`).
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.simulate.sensor.film import Film


def principal_stresses(stresses: Array) -> tuple[float, float]:
    """Compute the smallest and the largest principal stress in an array of stresses.

    Args:
        stresses: Stresses (S11, S22, S12), shape (..., 3).

    Returns:
        Smallest and largest principal stress of all stresses, in the unit of the stresses.
    """
    s11, s22, s12 = np.moveaxis(stresses, -1, 0)

    # The principal stresses are the ends of the horizontal diameter of Mohr's circle.
    centre = 0.5 * (s11 + s22)
    radius = np.hypot(0.5 * (s11 - s22), s12)
    smallest = float((centre - radius).min())
    largest = float((centre + radius).max())
    return smallest, largest


def strain(slopes: Array, squared_amplitude: float) -> Array:
    """Compute the scaled Green-Lagrange strain from the derivatives of the scaled displacements.

    The scaled strain is E' = sym grad U + grad W (x) grad W / 2 + A^2 (grad U)^T grad U / 2, where U and W are the
    scaled displacements in the plane of the film and perpendicular to it.

    Args:
        slopes: Derivatives of (U1, U2, W) with respect to (X1, X2), shape (..., 2, 3). The last two axes are the
            coordinate and the displacement component.
        squared_amplitude: Square A^2 of the amplitude.

    Returns:
        Scaled strain (E11, E22, 2 E12), shape (..., 3).
    """
    slopes_1 = slopes[..., 0, :]  # derivatives of (U1, U2, W) with respect to X1
    slopes_2 = slopes[..., 1, :]  # derivatives of (U1, U2, W) with respect to X2

    # The quadratic terms of U1 and U2 have the factor A^2, and the quadratic term of W has the factor 1.
    product_weights = np.array([squared_amplitude, squared_amplitude, 1.0])
    strain_11 = slopes_1[..., 0] + 0.5 * (slopes_1**2) @ product_weights
    strain_22 = slopes_2[..., 1] + 0.5 * (slopes_2**2) @ product_weights
    double_strain_12 = slopes_2[..., 0] + slopes_1[..., 1] + (slopes_1 * slopes_2) @ product_weights
    return np.stack([strain_11, strain_22, double_strain_12], axis=-1)


def rotate_stress(rotated_frame_stress: Array, angle: float | Array) -> Array:
    """Transform stresses from a rotated frame to the unrotated frame.

    Args:
        rotated_frame_stress: Stress (s11, s22, s12) in the rotated frame, shape (..., 3).
        angle: Angle of the rotated frame, anticlockwise, rad, a number or of the shape (...).

    Returns:
        Stress (s11, s22, s12) in the unrotated frame, shape (..., 3).
    """
    s11, s22, s12 = np.moveaxis(rotated_frame_stress, -1, 0)

    # In Mohr's circle, the mean of s11 and s22 does not change. The deviator consists of half of the difference of s11
    # and s22, and of the shear stress. The deviator is rotated as a complex number by twice the angle.
    mean = 0.5 * (s11 + s22)
    deviator = (0.5 * (s11 - s22) + 1j * s12) * np.exp(2j * np.asarray(angle))
    return np.stack([mean + deviator.real, mean - deviator.real, deviator.imag], axis=-1)


def elasticity(film: Film, angle: float) -> Array:
    """Compute the plane-stress elasticity matrix of a film (Hooke's law), divided by Young's modulus E.

    The product of a strain (E11, E22, 2 E12) and the matrix is the stress (S11, S22, S12) in units of E, without the
    pretension. The moduli along the two axes of the film are E1 = E r and E2 = E / r, where r is the square root of
    E1 / E2. Poisson's ratio nu is the geometric mean of the ratios along both axes. In the axes of the film, the matrix
    is

        [ r    nu     0                     ]
        [ nu   1 / r  0                     ] / (1 - nu^2),
        [ 0    0      (1 - nu^2) shear / E  ]

    where `shear` is the shear modulus of the film. If the film specifies no shear modulus, the value is E / (2 + 2 nu).

    Args:
        film: The film.
        angle: Angle from the x axis to axis 1 of the strain and the stress, anticlockwise, rad.

    Returns:
        Symmetric matrix, shape (3, 3), dimensionless.
    """
    plane_modulus = 1.0 / (1.0 - film.poisson**2)
    shear_modulus = 0.5 / (1.0 + film.poisson)
    coupling = plane_modulus * film.poisson
    isotropic_elasticity = np.array(
        [[plane_modulus, coupling, 0.0], [coupling, plane_modulus, 0.0], [0.0, 0.0, shear_modulus]]
    )

    # Compute the difference from an isotropic film in the axes of the film. The coupling is the same in both films.
    # The last row and column belong to the shear. All entries are divided by Young's modulus.
    root_of_ratio = np.sqrt(film.young_ratio)  # r
    difference_11 = plane_modulus * (root_of_ratio - 1.0)
    difference_22 = plane_modulus * (1.0 / root_of_ratio - 1.0)
    difference_12 = 0.0 if film.shear is None else film.shear / film.young - shear_modulus
    difference = np.diag([difference_11, difference_22, difference_12])

    # Rotate the difference from the axes of the film into the axes of the strain. The matrix of an isotropic film is
    # not rotated, so that it has no rounding errors. `rotate_stress` rotates the rows of the unit matrix, which become
    # the columns of the rotation matrix of a stress.
    rotation = rotate_stress(np.eye(3), film.axis - angle).T
    return isotropic_elasticity + rotation @ difference @ rotation.T


MEMBRANE_STIFFNESS = 1.6
"""Ratio of the force to the deflection for a membrane with a large pretension, in units of pretension times thickness.

The value is 2 pi / ln(a / R) for a probe radius R = 0.02 a, where a is the radius of the film.
"""

AMBIENT_PRESSURE = 0.101325
"""Pressure of the atmosphere, MPa."""

AIR_SHAPE = 0.6
"""Squared ratio of the displaced volume to the deflection of the centre, in units of a^4.

Here, a is the radius of the film. The value is used to compute the first iterate of Newton's method.
"""

PLATE_STIFFNESS = 16.0 * np.pi
"""Ratio of the force to the deflection for a clamped plate under a point load at its centre.

The unit is the bending stiffness of the plate divided by a^2, where a is the radius of the plate.
"""


@dataclass(frozen=True)
class Theory:
    """Terms that a theory of the film includes.

    Attributes:
        bending: Whether the film resists bending.
    """

    bending: bool

    @property
    def name(self) -> str:
        """Name of the theory in engineering terms."""
        return "nonlinear membrane + bending" if self.bending else "nonlinear membrane"


WITH_BENDING = Theory(bending=True)
"""Theory with all terms, which is the default."""


@dataclass(frozen=True)
class DimensionlessGroups:
    """Dimensionless groups that define the scaled problem of a press.

    In the descriptions of the attributes, E is Young's modulus, h is the thickness, and a is the radius of the film.

    Attributes:
        squared_amplitude: Square A^2 of the amplitude A. The scaled deflection is the deflection in film radii divided
            by A.
        load: Force divided by E h a A^3.
        tension: Mean pretension divided by E A^2.
        bending: Bending stiffness divided by E h a^2 A^2. Zero if the theory omits bending.
        elasticity: Elasticity matrix of the film in the axes of the press, divided by E, shape (3, 3). The product of a
            scaled strain (E11, E22, 2 E12) and the matrix is the scaled stress (S11, S22, S12) without the pretension,
            in units of E A^2.
        uneven_tension: Pretension (T11, T22, T12) minus its mean, divided by E A^2, in the axes of the press, shape
            (3,).
        side_load: Side force (Fx, Fy) divided by E h a A^2, in the axes of the press.
        static_pressure: Static pressure divided by E h A^3 / a, positive in the direction of the push.
        ambient_pressure: Pressure of the atmosphere divided by E h A^3 / a.
        compression: Factor that converts the integral of the scaled deflection W over the film into the displaced share
            of the air volume behind the film. Zero if the back is vented.
    """

    squared_amplitude: float
    load: float
    tension: float
    bending: float
    elasticity: Array
    uneven_tension: Array
    side_load: tuple[float, float]
    static_pressure: float
    ambient_pressure: float
    compression: float

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
        """Compute the dimensionless groups of a press in the axes of the press.

        The first axis of the press points from the centre of the film to the press.

        Args:
            film: The film.
            force: Force of the press, N.
            bending: Whether the theory includes bending.
            angle: Direction of the press from the centre of the film, rad.
            side_force: Force (Fx, Fy) of the probe on the film in the plane of the film, N.
        """
        # With Young's modulus E, the thickness h, the radius a and the amplitude A, the unit of the side force is
        # E h a A^2, the unit of the force is E h a A^3, and the unit of the pressure is E h A^3 / a.
        squared_amplitude = float(amplitude_squared(film, force))
        side_unit = side_force_unit(film, squared_amplitude)
        force_unit = side_unit * squared_amplitude**0.5
        pressure_unit = force_unit / film.radius**2

        # Rotate the side force, as a complex number Fx + i Fy, into the axes of the press.
        rotation = complex(np.cos(angle), -np.sin(angle))
        side_load = complex(*side_force) * rotation / side_unit

        # The pretension (T11, T22, T12) minus its mean, MPa, refers to the axes x and y. The angle from the direction
        # of the press to the x axis is `-angle`.
        half_difference, shear_tension = film.deviator
        deviator = np.array([half_difference, -half_difference, shear_tension])
        tension_unit = film.young * squared_amplitude

        # The unit of the displaced volume is a^3 A. The compression is the unit of the displaced volume divided by the
        # volume of the air behind the film. It is zero if the back of the film is vented.
        compression = 0.0
        if film.back_volume is not None:
            compression = film.radius**3 * squared_amplitude**0.5 / film.back_volume
        return cls(
            squared_amplitude=squared_amplitude,
            load=force / force_unit,
            tension=film.pretension / tension_unit,
            bending=bending_stiffness(film) / squared_amplitude if bending else 0.0,
            elasticity=elasticity(film, angle),
            uneven_tension=rotate_stress(deviator, -angle) / tension_unit,
            side_load=(side_load.real, side_load.imag),
            static_pressure=film.static_pressure / pressure_unit,
            ambient_pressure=AMBIENT_PRESSURE / pressure_unit,
            compression=compression,
        )

    @property
    def induced_tension(self) -> float:
        """Order of magnitude of the tension that the load induces in a film without pretension, in units of E A^2.

        The load is the force of the probe plus the magnitude of the force of the static pressure.
        """
        load = self.load + np.pi * abs(self.static_pressure)
        return math.cbrt(load) ** 2

    @property
    def height(self) -> float:
        """Approximate scaled deflection of the centre of the film under the force of the probe, dimensionless.

        The unit is the product of the radius a of the film and the amplitude A. The value is 1 if the back of the film
        is vented and the theory includes bending.
        """
        film_stiffness = MEMBRANE_STIFFNESS * max(self.tension, 0.0) + PLATE_STIFFNESS * self.bending
        air_stiffness = AIR_SHAPE * self.ambient_pressure * self.compression
        return float(_cubic_root(film_stiffness + air_stiffness, self.load))

    @property
    def static_height(self) -> float:
        """Approximate scaled deflection of the centre of the film under the static pressure, dimensionless.

        The value has the same unit as `height`. The deflection H solves a cubic equation that is correct in three
        limits. For a scaled pressure p, the limits are H^3 = 0.662^3 p for a membrane without pretension (Hencky 1915),
        H = p / (4 tension) for a membrane with a large pretension, and H = p / (64 bending) for a plate.
        """
        # The cubic equation is cubic_factor H^3 + linear_factor H = p. The trapped air also resists the deflection. The
        # displaced volume is about pi H / 2, the volume of a paraboloid with the height H and the radius 1. The
        # pressure of the air rises by the ambient pressure times the displaced share, compression * pi H / 2.
        air_stiffness = 0.5 * np.pi * self.ambient_pressure * self.compression
        linear_factor = 4.0 * max(self.tension, 0.0) + 64.0 * self.bending + air_stiffness
        cubic_factor = 1.0 / 0.662**3
        height = _cubic_root(linear_factor / cubic_factor, abs(self.static_pressure) / cubic_factor)
        return math.copysign(height, self.static_pressure)


def side_force_unit(film: Film, squared_amplitude: Array | float) -> Any:
    """Compute the side force that corresponds to a scaled side load of one.

    The side force is E h a A^2 with Young's modulus E, the thickness h, the radius a and the squared amplitude A^2.

    Args:
        film: The film.
        squared_amplitude: Square A^2 of the amplitude, a number or an array of any shape.

    Returns:
        Force, N, of the shape and type of `squared_amplitude`.
    """
    return film.young * film.thickness * film.radius * squared_amplitude


def directional_stiffness(film: Film) -> Array:
    """Compute the bending stiffness of a film in each of five directions, in units of E h a^2, shape (5,).

    Here, E is Young's modulus, h is the thickness and a is the radius of the film. The directions are evenly spaced
    over half a turn. Five directions determine the mean and the standard deviation over all directions exactly. The
    bending stiffness of an isotropic plate is E h^3 / (12 (1 - poisson^2)).
    """
    directions = np.pi / 5.0 * np.arange(5)
    moduli = np.array([elasticity(film, angle)[0, 0] for angle in directions])
    return moduli * (film.thickness / film.radius) ** 2 / 12.0


@lru_cache(maxsize=256)
def bending_stiffness(film: Film) -> float:
    """Compute the mean bending stiffness of a film over all directions, in units of E h a^2.

    Here, E is Young's modulus, h is the thickness and a is the radius of the film. Under a uniform pressure, an
    orthotropic plate bends like an isotropic plate with the mean stiffness (Timoshenko and Woinowsky-Krieger 1959,
    art. 86).
    """
    return float(directional_stiffness(film).mean())


def amplitude_squared(film: Film, force: Array | float) -> Any:
    """Compute the square A^2 of the amplitude of a press.

    The amplitude A is the approximate deflection of the centre under a force at the centre, in film radii. The
    amplitude A solves the equation A^3 + linear_factor A = F / (E h a), where F is the force, E is Young's modulus, h
    is the thickness and a is the radius of the film. The cubic term is the resistance of a membrane without pretension.
    The linear term is the resistance of the pretension and of bending.

    Args:
        film: The film.
        force: Force, N, a number or an array of any shape.

    Returns:
        A^2, of the shape and type of `force`.
    """
    pretension_factor = MEMBRANE_STIFFNESS * max(film.pretension, 0.0) / film.young
    linear_factor = pretension_factor + PLATE_STIFFNESS * bending_stiffness(film)
    amplitude = _cubic_root(linear_factor, force / (film.young * film.thickness * film.radius))
    return amplitude**2


def _cubic_root(linear_factor: float, right_side: Array | float) -> Any:
    """Return the real root x of the cubic equation x^3 + linear_factor * x = right_side.

    Args:
        linear_factor: Factor of the linear term, which must not be negative.
        right_side: Right side of the equation, which must not be negative, a number or an array of any shape.

    Returns:
        Root, of the shape and type of `right_side`.
    """
    if linear_factor == 0.0:
        return np.cbrt(right_side)
    scale = np.sqrt(linear_factor / 3.0)
    # Hyperbolic form of Cardano's formula, which follows from x = 2 scale sinh(t) and from the identity 4 sinh(t)^3 +
    # 3 sinh(t) = sinh(3 t)
    return 2.0 * scale * np.sinh(np.arcsinh(right_side / (2.0 * scale**3)) / 3.0)


ACCURACY = 1e-3
"""Default target for the relative error of a charge, dimensionless."""

INDUCED_STRAIN = 0.44
"""Radial strain at the rim of a membrane without pretension, in units of the squared amplitude A^2."""


def bending_length(film: Film, force: float) -> float:
    """Compute the width of the zone along the clamped edge in which the film is bent, in film radii.

    The width is sqrt(D / N), where D is the bending stiffness and N is the tension force per length at the edge.

    Args:
        film: The film.
        force: Force of the press, N.
    """
    groups = DimensionlessGroups.of(film, force, bending=True)
    induced_tension = INDUCED_STRAIN * groups.height**2
    tension = max(groups.tension, 0.0) + induced_tension
    return math.sqrt(groups.bending / tension)


def theory_by_name(name: str) -> Theory:
    """Return the theory with a given name: "nonlinear membrane" or "nonlinear membrane + bending".

    Raises:
        SceneError: If no theory has this name.
    """
    theories = {theory.name: theory for theory in (Theory(bending=False), Theory(bending=True))}
    if name not in theories:
        raise SceneError(f"theory: expected one of {list(theories)}, got {name!r}")
    return theories[name]
