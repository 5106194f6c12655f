"""Second-order effect of an uneven tension on the charges of a film.

A membrane with the tensions T + e and T - e along two axes deflects under a press like one with the tension
sqrt(T^2 - e^2) in all directions. An uneven tension therefore increases all charges alike to second order, and less so
if the press itself stretches the film. With x = -d ln Q / d ln T, the logarithm of the charges increases by

    (1 - sqrt(1 - (e / T)^2)) x (1 - (1 - x / 2)^STRETCHING_EXPONENT).

The first factor is the unevenness of the tension.
"""

import numpy as np

from isocharge.common.arrays import Array

MAX_SQUARED_RATIO = 0.9
"""Largest squared ratio e / T for which the unevenness is computed; beyond it, the unevenness is constant."""

STRETCHING_EXPONENT = 1.75
"""Exponent of the formula, fitted to complete solutions for 0.6 to 2 MPa, 0.05 to 1.6 N and two positions. The formula
agrees with them to 5 % where x exceeds 0.1."""

MIN_TENSION_MPa = 1e-3
"""Pretension by which the uneven tension is divided at least, MPa."""


def unevenness(pretension: float, tension_stds: Array, coefficients: Array) -> tuple[float, Array]:
    """Return the unevenness of the tension and its derivatives by the coefficients of the modes.

    Args:
        pretension: Mean tension T, MPa.
        tension_stds: Uneven tension of each mode per unit of its coefficient, shape (n_mode,), MPa; zero for modes
            that are no uneven tension.
        coefficients: Coefficients of the modes, shape (n_mode,).

    Returns:
        The unevenness, dimensionless, and its derivatives, shape (n_mode,).
    """
    relative_stds = tension_stds / max(pretension, MIN_TENSION_MPa)
    squared_ratio = float(((relative_stds * coefficients) ** 2).sum())
    root = np.sqrt(1.0 - min(squared_ratio, MAX_SQUARED_RATIO))
    if squared_ratio >= MAX_SQUARED_RATIO:
        return 1.0 - root, np.zeros_like(coefficients)
    return 1.0 - root, relative_stds**2 * coefficients / root


def log_charge_by_unevenness(relative_decrease: Array) -> Array:
    """Return the derivative of the logarithm of the charges by the unevenness.

    Args:
        relative_decrease: Decrease of ln Q with ln T, the x of the formula, of any shape.
    """
    stretched_share = np.clip(1.0 - 0.5 * relative_decrease, 0.0, 1.0) ** STRETCHING_EXPONENT
    return np.asarray(relative_decrease * (1.0 - stretched_share))
