"""Result of a triangulation: the positions of presses, and for each press without a position the reason."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import SceneError, SensorError

TOLERANCE = 1.0
"""Default of the largest distance of three crossings from their mean at which contours count as meeting, mm."""

MIN_DISTANCE = 0.2
"""Distance below which two meetings of contours count as the same, mm."""

AMBIGUOUS_RATIO = 2.0
"""Ratio of the spread of the second-best meeting to that of the best meeting up to which a fix is ambiguous,
dimensionless."""

AMBIGUOUS_SPREAD = 0.01
"""Spread of the second-best meeting up to which a fix is ambiguous in any case, mm."""


class Meeting(IntEnum):
    """Result of the search for the point at which the contours of one press meet."""

    met = 0
    no_contour = 1
    apart = 2
    twice = 3

    @property
    def summary(self) -> str:
        """Description of the result."""
        return {
            Meeting.met: "the contours meet",
            Meeting.no_contour: "no press within the radius gives one of the charges",
            Meeting.apart: "the contours do not meet within the tolerance",
            Meeting.twice: "the contours meet twice: two positions fit about as well",
        }[self]


@dataclass(frozen=True)
class Fix:
    """Positions of presses. Presses without a position have NaN, and `status` contains the reason.

    Attributes:
        contact: Contacts (x, y, F), shape (n, 3), mm and N. The force is the given force or the estimated force.
        spread: Measure of the disagreement of the contours, shape (n,), mm. If the force is given, this is the largest
            distance of a crossing from the mean of its triple. If the force is estimated, it is the root mean square
            distance of the contours from the position.
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
    """Check the number of electrodes and the tolerance of a triangulation.

    At least three electrodes are necessary, because two contours may cross in several points.

    Args:
        electrodes: Names of the electrodes.
        tolerance: Largest distance of three crossings from their mean, mm.

    Raises:
        SensorError: If there are fewer than three electrodes.
        SceneError: If the tolerance is not positive.
    """
    if len(electrodes) < 3:
        raise SensorError(f"triangulation needs at least three electrodes, got {electrodes}")
    if not (np.isfinite(tolerance) and tolerance > 0.0):
        raise SceneError(f"tolerance: expected a positive length, got {tolerance} mm")
