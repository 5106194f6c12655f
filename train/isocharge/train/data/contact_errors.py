"""Statistics of the errors of estimated contacts.

Model cards, reports, the Bayes limit and the demo use these statistics.
"""

from dataclasses import dataclass

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
    return np.asarray(np.hypot(contact[:, 0] - truth[:, 0], contact[:, 1] - truth[:, 1]))


def force_error_percent(contact: Array, truth: Array) -> Array:
    """Compute the relative error of the estimated force of each contact.

    Args:
        contact: Estimated contacts (x, y, F), shape (n, 3), mm and N.
        truth: True contacts, of the same shape and units.

    Returns:
        Relative errors, shape (n,), %, positive if the estimated force is larger than the true force.
    """
    return np.asarray(100.0 * (contact[:, 2] / truth[:, 2] - 1.0))


@dataclass(frozen=True)
class ContactErrorStatistics:
    """Medians, root mean squares and percentiles of the errors of estimated contacts.

    Attributes:
        presses: Number of presses.
        position_median_mm: Median of the distance from the true position, mm.
        position_rms_mm: Root mean square of the distance from the true position, mm.
        position_p95_mm: 95th percentile of the distance from the true position, mm.
        position_p99_mm: 99th percentile of the distance from the true position, mm.
        force_median_percent: Median of the absolute relative error of the force, %.
        force_rms_percent: Root mean square of the relative error of the force, %.
        force_p99_percent: 99th percentile of the absolute relative error of the force, %.
    """

    presses: int
    position_median_mm: float
    position_rms_mm: float
    position_p95_mm: float
    position_p99_mm: float
    force_median_percent: float
    force_rms_percent: float
    force_p99_percent: float

    @classmethod
    def of(cls, contact: Array, truth: Array) -> "ContactErrorStatistics":
        """Compute the statistics of the errors of estimated contacts.

        Args:
            contact: Estimated contacts (x, y, F), shape (n, 3), mm and N.
            truth: True contacts, of the same shape and units.
        """
        position_mm = position_error(contact, truth)
        force_percent = np.abs(force_error_percent(contact, truth))
        position_median_mm, position_p95_mm, position_p99_mm = np.percentile(position_mm, [50, 95, 99]).tolist()
        force_median_percent, force_p99_percent = np.percentile(force_percent, [50, 99]).tolist()
        return cls(
            presses=len(truth),
            position_median_mm=position_median_mm,
            position_rms_mm=rms(position_mm),
            position_p95_mm=position_p95_mm,
            position_p99_mm=position_p99_mm,
            force_median_percent=force_median_percent,
            force_rms_percent=rms(force_percent),
            force_p99_percent=force_p99_percent,
        )

    def rounded(self) -> dict[str, float]:
        """Return the statistics by name, rounded to four significant digits."""
        return {name: rounded(value) for name, value in vars(self).items()}
