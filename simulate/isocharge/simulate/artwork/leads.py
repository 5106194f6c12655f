"""Straight leads from the electrodes to the rim that cross neither each other nor another electrode."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.sensor.sensor import Electrode, Sensor

SAMPLE = 0.1
"""Distance of the points of a lead at which its clearance is checked, mm."""

TURNS = np.deg2rad([0.0, *(sign * degrees for degrees in range(1, 90) for sign in (1.0, -1.0))])
"""Directions that are tried, against that straight outwards, rad: the nearest to it that is free is taken."""


@dataclass(frozen=True)
class Leads:
    """The leads of a layout.

    Attributes:
        paths: By the name of its electrode, from the electrode's centre to the rim, shape (2, 2), mm.
        without: Names of electrodes that have no straight way to the rim.
        width: mm.
    """

    paths: dict[str, Array]
    without: tuple[str, ...]
    width: float

    @property
    def summary(self) -> str:
        """For people."""
        if not self.without:
            return f"all {len(self.paths)} leads go straight to the rim"
        return f"no straight way to the rim for {', '.join(self.without)}: lead them out on another layer"


def straight_leads(sensor: Sensor, width: float = 0.3, clearance: float = 0.3) -> Leads:
    """Leads of all electrodes at their nominal places, those near the rim first.

    Args:
        sensor: The layout.
        width: Of a lead, mm.
        clearance: Smallest distance of a lead from other leads and electrodes, mm.
    """
    paths: dict[str, Array] = {}
    radius, centres = sensor.film.radius, {e.name: np.array(e.centre) for e in sensor.electrodes}
    for electrode in sorted(sensor.electrodes, key=lambda one: -float(np.hypot(*one.centre))):
        others = [other for other in sensor.electrodes if other != electrode]
        for path in _ways(centres[electrode.name], radius):
            count = int(np.ceil(np.hypot(*(path[1] - path[0])) / SAMPLE)) + 1
            points = path[0] + np.linspace(0.0, 1.0, count)[:, None] * (path[1] - path[0])
            away = [_from_box(points, other) - 0.5 * width for other in others]
            away += [_from_lead(points, lead) - width for lead in paths.values()]
            if min(away, default=np.inf) >= clearance:
                paths[electrode.name] = path
                break
    without = tuple(name for name in centres if name not in paths)
    return Leads({name: paths[name] for name in centres if name in paths}, without, width)


def _ways(centre: Array, radius: float) -> Array:
    """Straight ways from a place to the rim, the shortest first, shape (n, 2, 2), mm."""
    angle = np.arctan2(centre[1], centre[0]) + TURNS
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = direction @ centre
    length = np.sqrt(radius**2 - centre @ centre + along**2) - along
    return np.stack([np.broadcast_to(centre, direction.shape), centre + length[:, None] * direction], axis=1)


def _from_box(points: Array, electrode: Electrode) -> float:
    """Smallest distance of points from the boxes round the parts of an electrode, mm."""
    low, high = (corners[:, None] for corners in electrode.boxes)
    return float(np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=2).min())


def _from_lead(points: Array, lead: Array) -> float:
    """Smallest distance of points from a lead, mm."""
    start, along = lead[0], lead[1] - lead[0]
    share = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
    return float(np.hypot(*(points - start - share[:, None] * along).T).min())
