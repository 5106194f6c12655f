"""Strain and stress of a film, principal stresses, and rotation of stresses."""

import numpy as np

from isocharge.common.arrays import Array


def principal_stresses(stresses: Array) -> tuple[float, float]:
    """Compute the smallest and the largest principal stress that occur in an array of stresses.

    Args:
        stresses: Stresses (S11, S22, S12), shape (..., 3).

    Returns:
        Smallest and largest principal stress, in the unit of the stresses.
    """
    s11 = stresses[..., 0]
    s22 = stresses[..., 1]
    s12 = stresses[..., 2]
    mean = 0.5 * (s11 + s22)
    radius = np.hypot(0.5 * (s11 - s22), s12)  # of Mohr's circle
    return float((mean - radius).min()), float((mean + radius).max())


def strain(slope: Array, squared_amplitude: float) -> Array:
    """Compute the scaled Green-Lagrange strain E' from the derivatives of the scaled displacements.

    Args:
        slope: Derivatives d(U1, U2, W)/d(X1, X2), shape (..., 2, 3): the derivative, then the component.
        squared_amplitude: Square A^2 of the amplitude.

    Returns:
        (E11, E22, 2 E12), shape (..., 3).
    """
    slope_1 = slope[..., 0, :]  # derivatives of (U1, U2, W) with respect to X1
    slope_2 = slope[..., 1, :]  # derivatives of (U1, U2, W) with respect to X2

    # The squares of the in-plane slopes are smaller than that of W by the factor A^2.
    square_weights = np.array([squared_amplitude, squared_amplitude, 1.0])
    strain_11 = slope_1[..., 0] + 0.5 * (slope_1**2) @ square_weights
    strain_22 = slope_2[..., 1] + 0.5 * (slope_2**2) @ square_weights
    double_strain_12 = slope_2[..., 0] + slope_1[..., 1] + (slope_1 * slope_2) @ square_weights
    return np.stack([strain_11, strain_22, double_strain_12], axis=-1)


def stress(strain: Array, poisson: float, moduli: Array | None = None) -> Array:
    """Compute the plane stress C : E' of a strain, without pretension.

    Args:
        strain: (E11, E22, 2 E12), shape (..., 3).
        poisson: Poisson's ratio.
        moduli: Symmetric matrix that is added to the isotropic elasticity matrix C over E_young, shape (3, 3).

    Returns:
        (S11, S22, S12), shape (..., 3), in units of E_young times the unit of the strain.
    """
    e11 = strain[..., 0]
    e22 = strain[..., 1]
    double_e12 = strain[..., 2]
    plane_modulus = 1.0 / (1.0 - poisson**2)
    shear_modulus = 0.5 / (1.0 + poisson)

    # Hooke's law for plane stress of an isotropic material
    s11 = plane_modulus * (e11 + poisson * e22)
    s22 = plane_modulus * (e22 + poisson * e11)
    s12 = shear_modulus * double_e12
    isotropic = np.stack([s11, s22, s12], axis=-1)
    return isotropic if moduli is None else isotropic + strain @ moduli


def stress_rotation(angle: float) -> Array:
    """Return the matrix T of `rotate_stress` for an angle (rad), shape (3, 3).

    T C T^T is the elasticity matrix C of a rotated material in the unrotated frame.
    """
    return rotate_stress(np.eye(3), angle).T


def rotate_stress(local: Array, angle: float | Array) -> Array:
    """Transform stresses from a rotated frame to the unrotated frame.

    Args:
        local: Stress (s11, s22, s12) in the rotated frame, shape (..., 3).
        angle: Angle of the rotated frame, anticlockwise, rad, a number or of the shape (...).

    Returns:
        Stress (s11, s22, s12) in the unrotated frame, shape (..., 3).
    """
    # Mohr's circle: the mean does not change, and half of the difference and the shear rotate by twice the angle.
    mean = 0.5 * (local[..., 0] + local[..., 1])
    half_difference = 0.5 * (local[..., 0] - local[..., 1])
    shear = local[..., 2]
    cosine = np.cos(2.0 * np.asarray(angle))
    sine = np.sin(2.0 * np.asarray(angle))
    rotated_difference = half_difference * cosine - shear * sine
    rotated_shear = half_difference * sine + shear * cosine
    return np.stack([mean + rotated_difference, mean - rotated_difference, rotated_shear], axis=-1)
