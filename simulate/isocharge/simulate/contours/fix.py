"""The result of triangulation: positions, or the reason why a press has none."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import SceneError, SensorError

TOLERANCE = 1.0
"""Largest distance of three crossings from their mean at which the contours count as meeting there, mm."""

APART = 0.2
"""Smallest distance between two meetings, mm: nearer ones count as one."""

AMBIGUOUS, RESOLVED = 2.0, 0.01
"""A second meeting makes a fix ambiguous if its spread is at most AMBIGUOUS times that of the first (dimensionless), or
below RESOLVED, mm."""


class Meeting(IntEnum):
    """Whether contours meet in one point."""

    met = 0
    no_contour = 1
    apart = 2
    twice = 3

    @property
    def summary(self) -> str:
        """One sentence."""
        return {
            Meeting.met: "the contours meet",
            Meeting.no_contour: "no press within the radius gives one of the charges",
            Meeting.apart: "the contours do not meet within the tolerance",
            Meeting.twice: "the contours meet twice: two positions fit about as well",
        }[self]


@dataclass(frozen=True)
class Fix:
    """Positions of presses; NaN for those without one, and `status` says why.

    Attributes:
        contact: (x, y, F), shape (n, 3), mm and N; the force as it was given, or estimated.
        spread: Largest distance of a crossing from the mean of its triple, or, with the force unknown, root mean square
            distance of the contours from the position; shape (n,), mm.
        status: A `Meeting` for each press, shape (n,).
    """

    contact: Array
    spread: Array
    status: Integers

    @property
    def found(self) -> Booleans:
        """Whether each press has a position, shape (n,)."""
        return np.asarray(self.status == Meeting.met)


def check_triangulation(electrodes: tuple[str, ...], tolerance: float) -> None:
    """Refuse fewer than three electrodes: two contours cross wherever they cross, nothing tells which crossing it is.

    Raises:
        SensorError: If there are fewer than three.
        SceneError: If the tolerance (mm) is not positive.
    """
    if len(electrodes) < 3:
        raise SensorError(f"triangulation needs at least three electrodes, got {electrodes}")
    if not (np.isfinite(tolerance) and tolerance > 0.0):
        raise SceneError(f"tolerance: expected a positive length, got {tolerance} mm")
