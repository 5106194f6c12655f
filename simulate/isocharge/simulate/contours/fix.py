"""A position fix: what triangulation gives, and why there may be none."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from isocharge.arrays import Array, Integers
from isocharge.errors import SensorError

TOLERANCE = 1e-3
"""Distance (m) of crossings from their mean up to which contours meet there."""

APART = 0.2e-3
"""Distance (m) from which two places where contours meet are two."""

AMBIGUOUS, RESOLVED = 2.0, 1e-5
"""A second meeting counts if its spread is up to so many times the first one's, or below this length (m)."""


class Meeting(IntEnum):
    """How contours met."""

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
    """Positions found; those that were not are NaN, and `status` says why.

    Attributes:
        x: Shape (n,), m.
        y: Shape (n,), m.
        force: Given or found, shape (n,), N.
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
        """Which presses have a position, shape (n,)."""
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
