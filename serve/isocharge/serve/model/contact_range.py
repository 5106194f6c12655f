"""Range of contacts for which a Chebyshev series in the files of a model is valid, and its scaled coordinates."""

from collections.abc import Mapping

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.npz import finite_array, finite_number
from isocharge.serve.model.charge_series import MAX_RADIUS_mm

MIN_FORCE_RATIO = 1.01
"""Smallest ratio of the largest force to the smallest force."""


def clipped_unit_contact(contacts: Array, radius_mm: float, force_N: tuple[float, float]) -> Array:
    """Convert contacts to the variables of a series, which are coordinates between -1 and 1.

    A contact beyond the radius, or outside the range of forces, is replaced by the nearest contact within the range.

    Args:
        contacts: Contacts (x, y, F), shape (n, 3), mm and N.
        radius_mm: Largest distance of a contact from the centre, mm.
        force_N: Smallest and largest force, N.

    Returns:
        Coordinates of x, of y and of the logarithm of the force, shape (n, 3), dimensionless.
    """
    # Logarithm of the force, scaled to [-1, 1]
    min_force_N, max_force_N = force_N
    min_log_force, max_log_force = np.log(force_N)
    log_force = np.log(np.clip(contacts[:, 2], min_force_N, max_force_N))
    unit_force = (2.0 * log_force - min_log_force - max_log_force) / (max_log_force - min_log_force)

    # Positions in multiples of the radius; positions beyond the radius are moved onto the circle.
    distance_mm = np.hypot(contacts[:, 0], contacts[:, 1])
    unit_position = contacts[:, :2] / np.maximum(distance_mm, radius_mm)[:, None]
    return np.column_stack([unit_position, unit_force])


def read_contact_range(arrays: Mapping[str, np.ndarray]) -> tuple[float, tuple[float, float]]:
    """Read the range of contacts for which a series is valid from the arrays `radius_mm` and `force_N` of a file.

    Args:
        arrays: Arrays of the file by name.

    Returns:
        The largest distance of a contact from the centre, mm, and the smallest and the largest force, N.

    Raises:
        ValueError: If an array is missing or not valid.
    """
    radius_mm = finite_number(arrays, "radius_mm")
    if not 0.0 < radius_mm <= MAX_RADIUS_mm:
        raise ValueError(f"radius_mm: expected a radius up to {MAX_RADIUS_mm:g} mm, got {radius_mm:g}")
    min_force_N, max_force_N = finite_array(arrays, "force_N", (2,)).tolist()
    if not (min_force_N > 0.0 and max_force_N >= MIN_FORCE_RATIO * min_force_N):
        raise ValueError(
            f"force_N: expected a smallest force above 0 and a largest force of at least {MIN_FORCE_RATIO:g} times the "
            f"smallest, got {min_force_N:g} and {max_force_N:g} N"
        )
    return radius_mm, (min_force_N, max_force_N)
