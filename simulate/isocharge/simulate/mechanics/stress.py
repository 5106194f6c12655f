"""Strain, stress and principal stresses of a film, rotation of stresses, and change of the pretension by temperature.

A film that is clamped in a ring cannot expand freely. If the film becomes warmer by dT and the ring by dR, the elastic
strain along axis i of the film changes by

    strain_i = ring_expansion * dR - expansion_i * dT.

The pretension changes by the stress that this change of the strain causes. The stress follows from the plane-stress
stiffness of the film. A drawn film expands more across the drawn direction than along the drawn direction. The tension
of a drawn film therefore becomes uneven. The temperature of a thin film follows the temperature of the air within
seconds. The ring needs many minutes to reach the temperature of the air.
"""

from dataclasses import replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.sensor import Sensor


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


def stress(strain: Array, poisson: float, moduli: Array | float = 0.0) -> Array:
    """Compute the plane stress that a strain causes according to Hooke's law, without the pretension.

    Args:
        strain: Strain (E11, E22, 2 E12), shape (..., 3).
        poisson: Poisson's ratio.
        moduli: Symmetric matrix that is added to the elasticity matrix C / E_young of an isotropic material, shape
            (3, 3). It is zero for an isotropic material.

    Returns:
        Stress (S11, S22, S12), shape (..., 3), in units of E_young times the unit of the strain.
    """
    plane_modulus = 1.0 / (1.0 - poisson**2)
    shear_modulus = 0.5 / (1.0 + poisson)
    coupling = plane_modulus * poisson
    isotropic_moduli = np.array(
        [[plane_modulus, coupling, 0.0], [coupling, plane_modulus, 0.0], [0.0, 0.0, shear_modulus]]
    )
    return np.asarray(strain @ (isotropic_moduli + moduli))


def stress_rotation(angle: float) -> Array:
    """Return the matrix that transforms stresses from a rotated frame to the unrotated frame.

    Let C be the elasticity matrix of a material in the rotated frame, and let T be the returned matrix. The elasticity
    matrix of the material in the unrotated frame is then T C T^T.

    Args:
        angle: Angle of the rotated frame, anticlockwise, rad.

    Returns:
        Matrix for the stress components (s11, s22, s12), shape (3, 3).
    """
    return rotate_stress(np.eye(3), angle).T


def rotate_stress(rotated_frame_stress: Array, angle: float | Array) -> Array:
    """Transform stresses from a rotated frame to the unrotated frame.

    Args:
        rotated_frame_stress: Stress (s11, s22, s12) in the rotated frame, shape (..., 3).
        angle: Angle of the rotated frame, anticlockwise, rad, a number or of the shape (...).

    Returns:
        Stress (s11, s22, s12) in the unrotated frame, shape (..., 3).
    """
    s11, s22, s12 = np.moveaxis(rotated_frame_stress, -1, 0)

    # In Mohr's circle, the mean of s11 and s22 does not change. The vector of half of their difference and the shear
    # stress is rotated by twice the angle.
    mean = 0.5 * (s11 + s22)
    half_difference = 0.5 * (s11 - s22)
    cosine = np.cos(2.0 * np.asarray(angle))
    sine = np.sin(2.0 * np.asarray(angle))
    new_half_difference = half_difference * cosine - s12 * sine
    new_s12 = half_difference * sine + s12 * cosine
    return np.stack([mean + new_half_difference, mean - new_half_difference, new_s12], axis=-1)


def orthotropic_moduli(film: Film) -> Array:
    """Compute the difference between the elasticity matrix of a film and that of an isotropic film.

    Both matrices are divided by Young's modulus E, and refer to the axes of the film. The moduli along the two axes are
    E1 = E r and E2 = E / r, where r is the square root of E1 / E2.

    Args:
        film: The film.

    Returns:
        Difference for the strain components (E11, E22, 2 E12), shape (3, 3), dimensionless.
    """
    plane_modulus = 1.0 / (1.0 - film.poisson**2)
    root_of_ratio = np.sqrt(film.young_ratio)  # r
    difference_11 = plane_modulus * (root_of_ratio - 1.0)
    difference_22 = plane_modulus * (1.0 / root_of_ratio - 1.0)

    # If no shear modulus is given, the film has the shear modulus of an isotropic film.
    difference_12 = 0.0
    if film.shear is not None:
        isotropic_shear = 0.5 / (1.0 + film.poisson)
        difference_12 = film.shear / film.young - isotropic_shear
    return np.diag([difference_11, difference_22, difference_12])


def tension_change(film: Film, film_warming_K: float, ring_warming_K: float) -> Array:
    """Compute by how much the pretension changes if the temperatures of the film and of its ring change.

    The elastic strain of the clamped film is the expansion of the ring minus the free expansion of the film. The change
    of the pretension is the stress that corresponds to the elastic strain.

    Args:
        film: The film. If the film has no expansion coefficients, the result is zero.
        film_warming_K: Increase of the temperature of the film, K.
        ring_warming_K: Increase of the temperature of the ring, K.

    Returns:
        Change of the pretension (T11, T22, T12) in the axes x and y, shape (3,), MPa.
    """
    if film.expansion is None:
        return np.zeros(3)
    free_strain = np.array(film.expansion) * film_warming_K  # along the axes 1 and 2 of the film
    elastic_strain = np.append(film.ring_expansion * ring_warming_K - free_strain, 0.0)
    change_in_film_axes = film.young * stress(elastic_strain, film.poisson, orthotropic_moduli(film))
    return rotate_stress(change_in_film_axes, film.axis)


def warmed(sensor: Sensor, film_warming_K: float, ring_warming_K: float = 0.0) -> Sensor:
    """Return a copy of a sensor whose pretension is the pretension at other temperatures of the film and its ring.

    Args:
        sensor: The sensor at the temperatures for which it is described.
        film_warming_K: Temperature of the film minus the temperature for which the film is described, K.
        ring_warming_K: Temperature of the ring minus the temperature for which the ring is described, K.

    Returns:
        The copy, which equals the sensor if the film has no expansion coefficients.

    Raises:
        SensorError: If the film becomes so slack that it is outside the range of the simulator.
    """
    film = sensor.film
    change_11, change_22, change_12 = tension_change(film, film_warming_K, ring_warming_K).tolist()
    warm_film = replace(film, pretension=film.pretension + 0.5 * (change_11 + change_22))
    if not film.expands_evenly:  # otherwise only the mean of the pretension changes
        # The deviator of the pretension consists of half of the difference between the pretensions along x and y, and
        # of the shear.
        half_difference, shear = film.deviator
        deviator = (half_difference + 0.5 * (change_11 - change_22), shear + change_12)
        warm_film = replace(warm_film, deviator=deviator)
    return replace(sensor, film=warm_film)
