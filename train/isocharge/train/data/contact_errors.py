"""Statistics of the errors of estimated contacts.

Model cards, reports, the Bayes limit and the demo use these statistics.
"""

import numpy as np

from isocharge.common.arrays import Array


def rms(values: Array) -> float:
    """Compute the root mean square over all elements of an array."""
    return float(np.sqrt(np.mean(np.square(values))))


def rounded(value: float | np.floating) -> float:
    """Round a number to four significant digits, as in the metadata."""
    return float(f"{value:.4g}")


def position_error(contact: Array, truth: Array) -> Array:
    """Compute the distance between the estimated and the true position of each contact.

    Args:
        contact: Estimated contacts (x, y, F), shape (n, 3), mm and N.
        truth: True contacts, of the same shape and units.

    Returns:
        Distances, shape (n,), mm.
    """
    return np.asarray(np.linalg.norm(contact[:, :2] - truth[:, :2], axis=1))


def force_error_percent(contact: Array, truth: Array) -> Array:
    """Compute the relative error of the estimated force of each contact.

    Args:
        contact: Estimated contacts (x, y, F), shape (n, 3), mm and N.
        truth: True contacts, of the same shape and units.

    Returns:
        Relative errors, shape (n,), %, positive if the estimated force is larger than the true force.
    """
    return 100.0 * (contact[:, 2] / truth[:, 2] - 1.0)


def contact_error_statistics(contact: Array, truth: Array) -> dict[str, float]:
    """Compute medians, root mean squares and percentiles of the errors of estimated contacts.

    Args:
        contact: Estimated contacts (x, y, F), shape (n, 3), mm and N.
        truth: True contacts, of the same shape and units.

    Returns:
        Statistics by name, rounded to four significant digits: of the distance from the true position, mm, and of the
        magnitude of the relative error of the force, %.
    """
    position_mm = position_error(contact, truth)
    force_percent = np.abs(force_error_percent(contact, truth))
    position_median_mm, position_p95_mm, position_p99_mm = np.percentile(position_mm, [50, 95, 99])
    force_median_percent, force_p99_percent = np.percentile(force_percent, [50, 99])
    return {
        "position_median_mm": rounded(position_median_mm),
        "position_rms_mm": rounded(rms(position_mm)),
        "position_p95_mm": rounded(position_p95_mm),
        "position_p99_mm": rounded(position_p99_mm),
        "force_median_percent": rounded(force_median_percent),
        "force_rms_percent": rounded(rms(force_percent)),
        "force_p99_percent": rounded(force_p99_percent),
    }
