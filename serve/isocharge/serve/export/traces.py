"""A recording of any length as traces that a picture can show: envelopes over time, spans of flags, the path.

Records are taken one by one. Envelopes hold the smallest and the largest value of groups of neighbouring records, and
the path those contacts that lie apart; both get coarser as the recording gets longer, so memory stays bounded and no
peak is lost.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import RecordingError
from isocharge.common.tables import Table

MOST_GROUPS = 4096
"""Groups of an envelope: two for each pixel of a wide picture. There are half as many or more."""

BLOCK = 1024
"""Records that are reduced to groups at once."""

MOST_POINTS = 20_000
"""Points of a path."""

STEP_MM = 0.01
"""Distance at which contacts of a short path lie apart, mm: less than a sensor resolves."""

MOST_ELECTRODES, MOST_FLAGS = 64, 62
"""Largest number of electrodes, as of a model, and of different words in `flags`."""

CONTACT = ("x_mm", "y_mm", "force_N")
"""Fields with a standard deviation."""

STD = ("x_std_mm", "y_std_mm", "force_std_N")
"""Their standard deviations."""

DOUBTS = frozenset({"outside", "misfit", "saturated", "blind", "invalid"})
"""Flags of a contact that is not to be taken as it stands."""


class Point(NamedTuple):
    """A contact on the path: time in s, position and deviations in mm, force in N, number of the press."""

    time: float
    x_mm: float
    y_mm: float
    force_N: float
    x_std_mm: float
    y_std_mm: float
    press: int


class Envelope(NamedTuple):
    """Attributes: low, high: Smallest and largest value of each group, shape (n,); NaN where there is none."""

    low: Array
    high: Array


@dataclass(frozen=True)
class Traces:
    """What a picture of a recording shows.

    Attributes:
        records: Number of records.
        begin: Time of the first one, unix seconds; all other times count from there.
        start, end: Time of the first and last record of each group, shape (n,), s.
        values: Envelope by field: CONTACT, `misfit`, and each of CONTACT with " - std" and " + std".
        charge_pC: Envelope of the touch charge by electrode.
        flags: Groups in which a flag occurs, by its word, shape (n,).
        path: Contacts that lie apart, in their order.
        step_mm: Distance in x or y at which they do, mm.
        doubts: Those contacts with a flag of DOUBTS that lie apart.
    """

    records: int
    begin: float
    start: Array
    end: Array
    values: dict[str, Envelope]
    charge_pC: dict[str, Envelope]
    flags: dict[str, np.ndarray]
    path: tuple[Point, ...]
    step_mm: float
    doubts: tuple[Point, ...]


class TraceCollector:
    """Takes records, gives traces."""

    def __init__(self, first: Table) -> None:
        """Begin with a record, which is not yet taken: it names the electrodes.

        Raises:
            RecordingError: If it is no record.
        """
        charges = first.get("charge_raw_pC", None)
        self._electrodes = tuple(charges) if isinstance(charges, dict) else ()
        if len(self._electrodes) > MOST_ELECTRODES:
            raise RecordingError(f"expected up to {MOST_ELECTRODES} electrodes, got {len(self._electrodes)}")
        self._begin = first.number("timestamp")
        self._records = 0
        self._block: list[tuple[float, ...]] = []
        self._groups = np.empty((0, 2, self._width))
        self._marks: list[int] = []
        self._group_marks = np.empty(0, dtype=np.int64)
        self._words: dict[str, int] = {}
        self._press, self._touches = 0, False
        self._path, self._doubts = _Path(), _Path()

    @property
    def _width(self) -> int:
        """Columns: time, CONTACT, these less and plus a standard deviation, misfit, charges."""
        return 1 + 3 * len(CONTACT) + 1 + len(self._electrodes)

    def add(self, record: Table) -> None:
        """Take a record.

        Raises:
            RecordingError: If a field is missing or of another kind.
        """
        contact, std = ([_number(record, name) for name in names] for names in (CONTACT, STD))
        time = record.number("timestamp") - self._begin
        low, high = ([v - sign * s for v, s in zip(contact, std, strict=True)] for sign in (1.0, -1.0))
        charges = record.table("charge_pC") if record.get("charge_pC") is not None else None
        charge = [math.nan if charges is None else _number(charges, name) for name in self._electrodes]
        words = record.texts("flags")
        self._block.append((time, *contact, *low, *high, _number(record, "misfit"), *charge))
        self._marks.append(sum(1 << self._word(word) for word in set(words)))
        self._records += 1
        self._follow(time, contact, std, not DOUBTS.isdisjoint(words))
        if len(self._block) == BLOCK:
            self._reduce()

    def traces(self) -> Traces:
        """What was taken until now."""
        self._reduce()
        low, high = self._groups[:, 0], self._groups[:, 1]
        names = [*CONTACT, *(f"{name} {sign} std" for sign in "-+" for name in CONTACT), "misfit"]
        envelopes = [Envelope(low[:, column], high[:, column]) for column in range(1, self._width)]
        return Traces(
            self._records,
            self._begin,
            low[:, 0],
            high[:, 0],
            dict(zip(names, envelopes, strict=False)),
            dict(zip(self._electrodes, envelopes[len(names) :], strict=True)),
            {word: self._group_marks >> bit & 1 == 1 for word, bit in self._words.items()},
            tuple(self._path.points),
            self._path.step_mm,
            tuple(self._doubts.points),
        )

    def _follow(self, time: float, contact: list[float], std: list[float], doubtful: bool) -> None:
        """Put a contact on the path, if there is one."""
        touches = not math.isnan(contact[0] + contact[1])
        self._press += touches and not self._touches
        self._touches = touches
        if touches:
            (x, y, force), (x_std, y_std, _) = contact, std
            point = Point(time, x, y, force, x_std, y_std, self._press)
            self._path.add(point)
            if doubtful:
                self._doubts.add(point)

    def _word(self, word: str) -> int:
        """The bit of a flag."""
        bit = self._words.setdefault(word, len(self._words))
        if bit >= MOST_FLAGS:
            raise RecordingError(f"expected up to {MOST_FLAGS} different flags, got one more: {word[:40]!r}")
        return bit

    def _reduce(self) -> None:
        """Make groups of the block; where there are too many, join neighbours."""
        if not self._block:
            return
        rows, marks = np.array(self._block), np.array(self._marks, dtype=np.int64)
        self._block, self._marks = [], []
        groups = np.stack([rows, rows], axis=1)
        share = max(1, min(BLOCK, self._records // MOST_GROUPS))
        while len(groups) > max(1, BLOCK // share):
            groups, marks = _joined(groups, marks)
        self._groups = np.concatenate([self._groups, groups])
        self._group_marks = np.concatenate([self._group_marks, marks])
        while len(self._groups) > MOST_GROUPS:
            self._groups, self._group_marks = _joined(self._groups, self._group_marks)


def _joined(groups: Array, marks: np.ndarray) -> tuple[Array, np.ndarray]:
    """Groups, shape (n, 2, columns), two by two; an odd one stays alone."""
    pairs = np.concatenate([groups, groups[len(groups) - len(groups) % 2 :]])
    flags = np.concatenate([marks, marks[len(marks) - len(marks) % 2 :]])
    low = np.fmin(pairs[0::2, 0], pairs[1::2, 0])
    high = np.fmax(pairs[0::2, 1], pairs[1::2, 1])
    return np.stack([low, high], axis=1), flags[0::2] | flags[1::2]


class _Path:
    """Points that lie apart by a step, in mm; where there are too many, fewer that lie farther apart."""

    def __init__(self) -> None:
        self.points: list[Point] = []
        self.step_mm = STEP_MM

    def add(self, point: Point) -> None:
        """Append a point that lies apart from the one before."""
        if not self.points or _apart(self.points[-1], point, self.step_mm):
            self.points.append(point)
        if len(self.points) > MOST_POINTS:
            self._thin()

    def _thin(self) -> None:
        """Double the step until half of the points are enough; take every second where that would leave too few."""
        while len(self.points) > MOST_POINTS // 2:
            apart: list[Point] = []
            for point in self.points:
                if not apart or _apart(apart[-1], point, 2.0 * self.step_mm):
                    apart.append(point)
            if len(apart) >= MOST_POINTS // 8:
                self.points, self.step_mm = apart, 2.0 * self.step_mm
            else:
                self.points = self.points[::2]


def _apart(before: Point, point: Point, step_mm: float) -> bool:
    return abs(point.x_mm - before.x_mm) >= step_mm or abs(point.y_mm - before.y_mm) >= step_mm


def _number(record: Table, name: str) -> float:
    """A number, NaN for null."""
    return math.nan if record.get(name) is None else record.number(name)
