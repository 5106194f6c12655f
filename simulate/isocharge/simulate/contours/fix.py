"""Result of a triangulation: the position of each press, or the reason why no position was found."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import SceneError, SensorError

TOLERANCE = 1.0
"""Default value of the tolerance, mm.

Three contours meet if each of their three crossings lies within the tolerance of the mean of the crossings.
"""

MIN_DISTANCE = 0.2
"""Distance below which two positions at which contours meet count as the same position, mm."""

AMBIGUOUS_RATIO = 2.0
"""Ratio of the second-smallest to the smallest spread up to which a position is ambiguous, dimensionless.

The spreads are those of the two best positions at which the contours of a press meet.
"""

AMBIGUOUS_SPREAD = 0.01
"""Spread of the second-best position up to which a position is always ambiguous, mm."""


class Meeting(IntEnum):
    """Status of one press after the search for the position at which its contours meet."""

    met = 0
    no_contour = 1
    apart = 2
    twice = 3

    @property
    def summary(self) -> str:
        """Description of the status for users."""
        return {
            Meeting.met: "the contours meet",
            Meeting.no_contour: "no press within the radius gives one of the charges",
            Meeting.apart: "the contours do not meet within the tolerance",
            Meeting.twice: "the contours meet twice: two positions fit about as well",
        }[self]


@dataclass(frozen=True)
class Fix:
    """Positions of presses that a triangulation found.

    If no position was found for a press, its position is NaN, and `status` contains the reason.

    Attributes:
        contact: Contact (x, y, F) of each press, shape (n, 3), mm and N. The force is given or estimated.
        spread: Length that measures how far the contours are from meeting in one point, shape (n,), mm. If the force is
            given, the spread is the largest distance between a crossing of two contours and the mean of three
            crossings. If the force is estimated, the spread is the root mean square distance of the contours from the
            position.
        status: Value of `Meeting` for each press, shape (n,).
    """

    contact: Array
    spread: Array
    status: Integers

    @property
    def found(self) -> Booleans:
        """Whether each press has a position, shape (n,)."""
        return np.asarray(self.status == Meeting.met)


def check_triangulation(electrodes: tuple[str, ...], tolerance: float) -> None:
    """Raise an error if the number of electrodes or the tolerance of a triangulation is not valid.

    At least three electrodes are necessary, because two contours may cross in several points.

    Args:
        electrodes: Names of the electrodes.
        tolerance: Largest distance between a crossing of two contours and the mean of three crossings, mm.

    Raises:
        SensorError: If there are fewer than three electrodes.
        SceneError: If the tolerance is not positive.
    """
    if len(electrodes) < 3:
        raise SensorError(f"triangulation needs at least three electrodes, got {electrodes}")
    if not (np.isfinite(tolerance) and tolerance > 0.0):
        raise SceneError(f"tolerance: expected a positive length, got {tolerance} mm")
