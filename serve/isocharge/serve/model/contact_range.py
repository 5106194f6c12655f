"""Range of contacts for which a Chebyshev series in the files of a model is valid, and its scaled coordinates."""

import numpy as np

from isocharge.common.arrays import Array


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
