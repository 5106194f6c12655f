"""Strain, stress, principal stresses, and a stress seen from a rotated frame."""

import numpy as np

from isocharge.common.arrays import Array


def principal_stresses(total: Array) -> tuple[float, float]:
    """Smallest and largest principal value of (S11, S22, S12), shape (..., 3)."""
    mean = 0.5 * (total[..., 0] + total[..., 1])
    radius = np.hypot(0.5 * (total[..., 0] - total[..., 1]), total[..., 2])
    return float((mean - radius).min()), float((mean + radius).max())


def strain(slope: Array, amplitude2: float) -> Array:
    """Scaled Green-Lagrange strain E' from grad (U1, U2, W).

    Args:
        slope: d(U1, U2, W)/d(X1, X2), shape (..., 2, 3): derivative first, component second.
        amplitude2: A^2.

    Returns:
        (E11, E22, 2 E12), shape (..., 3).
    """
    first, second = slope[..., 0, :], slope[..., 1, :]
    scale = np.array([amplitude2, amplitude2, 1.0])
    return np.stack(
        [
            first[..., 0] + 0.5 * (first**2) @ scale,
            second[..., 1] + 0.5 * (second**2) @ scale,
            second[..., 0] + first[..., 1] + (first * second) @ scale,
        ],
        axis=-1,
    )


def stress(strain: Array, poisson: float, more: Array | None = None) -> Array:
    """C : E' in units of E_young A^2, plane stress; (S11, S22, S12), shape (..., 3), without pretension.

    `more` is added to the isotropic C over E_young, as a symmetric matrix from (E11, E22, 2 E12), shape (3, 3).
    """
    e11, e22, shear = strain[..., 0], strain[..., 1], strain[..., 2]
    plane = 1.0 / (1.0 - poisson**2)
    isotropic = np.stack(
        [plane * (e11 + poisson * e22), plane * (e22 + poisson * e11), 0.5 * shear / (1.0 + poisson)], axis=-1
    )
    return isotropic if more is None else isotropic + strain @ more


def stress_turn(angle: float) -> Array:
    """Matrix of `rotate_stress` for one angle, shape (3, 3); T C T^T turns an elasticity matrix."""
    return rotate_stress(np.eye(3), angle).T


def rotate_stress(local: Array, angle: float | Array) -> Array:
    """Stress (s11, s22, s12), shape (..., 3), of a frame rotated by `angle` (rad), in the unrotated frame."""
    mean, half, shear = (
        0.5 * (local[..., 0] + local[..., 1]),
        0.5 * (local[..., 0] - local[..., 1]),
        local[..., 2],
    )
    c, s = np.cos(2.0 * np.asarray(angle)), np.sin(2.0 * np.asarray(angle))
    first, second = half * c - shear * s, half * s + shear * c
    return np.stack([mean + first, mean - first, second], axis=-1)
