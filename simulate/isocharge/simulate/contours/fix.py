"""The result of triangulation: positions, or the reason why a press has none."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.common.errors import SensorError

TOLERANCE = 1e-3
"""Largest distance of three crossings from their mean at which the contours count as meeting there, m."""

APART = 0.2e-3
"""Smallest distance between two meetings, m: nearer ones count as one."""

AMBIGUOUS, RESOLVED = 2.0, 1e-5
"""A second meeting makes a fix ambiguous if its spread is at most AMBIGUOUS times that of the first (dimensionless), or
below RESOLVED, m."""


class Meeting(IntEnum):
    """Whether contours meet in one point."""

    met = 0
    no_contour = 1
    apart = 2
    twice = 3

    @property
    def words(self) -> str:
        """One sentence."""
        return {
            Meeting.met: "the contours meet",
            Meeting.no_contour: "a charge that no contour reaches at this force, within the radius",
            Meeting.apart: "the contours have no intersection: they do not meet within the tolerance",
            Meeting.twice: "the contours meet twice: two positions fit about as well",
        }[self]


@dataclass(frozen=True)
class Fix:
    """Positions of presses; NaN for those without one, and `status` says why.

    Attributes:
        x: Shape (n,), m.
        y: Shape (n,), m.
        force: Known or estimated, shape (n,), N.
        spread: Largest distance of a crossing from the mean of its triple, or, with the force unknown, root mean square
            distance of the contours from the position; shape (n,), m.
        status: A `Meeting` for each press, shape (n,).
        triples: How many triples of electrodes the position is the average of; 0 with the force unknown; shape (n,).
    """

    x: Array
    y: Array
    force: Array
    spread: Array
    status: Integers
    triples: Integers

    @property
    def found(self) -> np.ndarray:
        """Whether each press has a position, shape (n,)."""
        found: np.ndarray = self.status == Meeting.met
        return found

    def to_dict(self, press: int) -> dict[str, Any]:
        """The fix of one press, for JSON; without a position `at_mm` is None."""
        status = Meeting(int(self.status[press]))
        position = [1e3 * float(self.x[press]), 1e3 * float(self.y[press])] if status is Meeting.met else None
        return {"status": status.name, "words": status.words, "at_mm": position}


def check_electrodes(electrode_names: tuple[str, ...]) -> None:
    """Refuse fewer than three electrodes: two contours cross wherever they cross, nothing tells which crossing it is.

    Raises:
        SensorError: If there are fewer than three.
    """
    if len(electrode_names) < 3:
        raise SensorError(f"triangulation needs at least three electrodes, got {electrode_names}")
