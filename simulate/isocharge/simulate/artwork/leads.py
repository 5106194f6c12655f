"""Leads from the electrodes to the rim that cross neither each other nor another electrode.

A simple router. The film is covered with a grid; a path of fewest steps from an electrode to the rim avoids cells that
are too near other electrodes, keep-out zones and leads that lie already (Lee 1961). Electrodes near the rim go first,
straight outwards; those in the middle find their way between. What finds none is said, not drawn.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.simulate.sensor.electrode import Electrode
from isocharge.simulate.sensor.sensor import Sensor

CELL = 0.5e-3
"""Step of the grid, m."""

NEIGHBOURS = ((1, 0), (0, 1), (1, 1), (1, -1))
"""Steps to half of a cell's neighbours; the others are the same steps back."""


@dataclass(frozen=True)
class Lead:
    """A lead.

    Attributes:
        electrode: Name of its electrode.
        path: From the electrode's centre to the rim, shape (n, 2), m.
    """

    electrode: str
    path: Array

    @property
    def length(self) -> float:
        """Length, m."""
        return float(np.hypot(*np.diff(self.path, axis=0).T).sum())


@dataclass(frozen=True)
class Leads:
    """The leads of a layout.

    Attributes:
        leads: Those that found a way.
        without: Names of electrodes that did not.
        width: m.
        clearance: Between a lead and anything else, m.
    """

    leads: tuple[Lead, ...]
    without: tuple[str, ...]
    width: float
    clearance: float

    @property
    def words(self) -> str:
        """For people."""
        if not self.without:
            return f"all {len(self.leads)} leads reach the rim without crossing"
        return f"no way to the rim was found for {', '.join(self.without)}: lead them out on another layer"


def route(
    sensor: Sensor,
    width: float = 0.3e-3,
    clearance: float = 0.3e-3,
    keep_out: tuple[tuple[float, float, float], ...] = (),
) -> Leads:
    """Leads of all electrodes at their nominal places.

    Args:
        sensor: The layout.
        width: Of a lead, m.
        clearance: Smallest distance of a lead from other leads, electrodes and zones, m.
        keep_out: Disks (x, y, radius), m.
    """
    x, y = _grid(sensor.film.radius)
    room = 0.5 * width + clearance
    blocked = np.zeros(x.shape, dtype=bool)
    for at_x, at_y, radius in keep_out:
        blocked |= np.hypot(x - at_x, y - at_y) < radius + room
    near = {electrode.name: _near(electrode, x, y, room) for electrode in sensor.electrodes}
    leads, without = [], []
    for electrode in sorted(sensor.electrodes, key=lambda one: -float(np.hypot(*one.centre))):
        others = [cells for name, cells in near.items() if name != electrode.name]
        free = ~(blocked | np.logical_or.reduce(others, initial=np.False_))
        path = _path(electrode, x, y, free, sensor.film.radius)
        if path is None:
            without.append(electrode.name)
            continue
        leads.append(Lead(electrode.name, path))
        blocked |= _along(path, x, y) < 2.0 * room - clearance + CELL
    order = {name: number for number, name in enumerate(sensor.electrode_names)}
    return Leads(tuple(sorted(leads, key=lambda lead: order[lead.electrode])), tuple(without), width, clearance)


def _grid(radius: float) -> tuple[Array, Array]:
    half = int(np.ceil(radius / CELL))
    axis = CELL * np.arange(-half, half + 1)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return x, y


def _near(electrode: Electrode, x: Array, y: Array, room: float) -> Booleans:
    """Cells within `room` of the box round an electrode."""
    corners = np.array(electrode.corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    outside = np.hypot(np.maximum(np.maximum(low[0] - x, x - high[0]), 0.0),
                       np.maximum(np.maximum(low[1] - y, y - high[1]), 0.0))  # fmt: skip
    near: Booleans = outside < room
    return near


def _path(electrode: Electrode, x: Array, y: Array, free: Booleans, radius: float) -> Array | None:
    """The shortest way over free cells from an electrode's centre to the rim, straightened; None if there is none."""
    distance = np.hypot(x, y)
    usable = free & (distance <= radius)
    start = int(np.argmin(np.hypot(x - electrode.centre[0], y - electrode.centre[1])))
    if not usable.ravel()[start]:
        return None
    lengths, before = dijkstra(_links(usable), directed=False, indices=start, return_predecessors=True)
    rim = np.flatnonzero((usable & (distance > radius - 1.5 * CELL)).ravel() & np.isfinite(lengths))
    if not rim.size:
        return None
    cells = _back(before, int(rim[np.argmin(lengths[rim])]))
    points = np.stack([x.ravel()[cells], y.ravel()[cells]], axis=1)
    straight = _straighten(points, usable, x)
    straight[0] = electrode.centre
    direction = straight[-1] / np.hypot(*straight[-1])
    return np.concatenate([straight, radius * direction[None]])


def _links(usable: Booleans) -> coo_array:
    """Lengths between neighbouring usable cells, in cells."""
    number = np.arange(usable.size).reshape(usable.shape)
    rows, columns, lengths = [], [], []
    count = usable.shape[1]
    for i, j in NEIGHBOURS:
        a = np.s_[: usable.shape[0] - i, max(-j, 0) : count - max(j, 0)]
        b = np.s_[i:, max(j, 0) : count - max(-j, 0)]
        both = usable[a] & usable[b]
        rows.append(number[a][both])
        columns.append(number[b][both])
        lengths.append(np.full(both.sum(), np.hypot(i, j)))
    entries = (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns)))
    return coo_array(entries, shape=(usable.size, usable.size))


def _back(before: Integers, last: int) -> list[int]:
    cells = [last]
    while before[cells[-1]] >= 0:
        cells.append(int(before[cells[-1]]))
    return cells[::-1]


def _straighten(points: Array, usable: Booleans, x: Array) -> Array:
    """The same way with as few corners as the free cells allow."""
    corners, at = [0], 0
    while at < len(points) - 1:
        at = next(i for i in range(len(points) - 1, at, -1) if i == at + 1 or _clear(points[at], points[i], usable, x))
        corners.append(at)
    return points[corners]


def _clear(start: Array, end: Array, usable: Booleans, x: Array) -> bool:
    """Whether all cells under a straight line are usable."""
    steps = int(np.ceil(4.0 * np.abs(end - start).max() / CELL)) + 1
    line = start + np.linspace(0.0, 1.0, steps)[:, None] * (end - start)
    i, j = np.round((line - x[0, 0]) / CELL).astype(int).T
    return bool(usable[i, j].all())


def _along(path: Array, x: Array, y: Array) -> Array:
    """Distance of all cells from a path, m."""
    nearest = np.full(x.shape, np.inf)
    for start, end in pairwise(path):
        along = end - start
        share = ((x - start[0]) * along[0] + (y - start[1]) * along[1]) / max(float(along @ along), 1e-300)
        share = np.clip(share, 0.0, 1.0)
        nearest = np.minimum(nearest, np.hypot(x - start[0] - share * along[0], y - start[1] - share * along[1]))
    return nearest
