"""Search for straight leads, which are conductors from the electrodes to the rim of the film.

A lead crosses neither another lead nor another electrode.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.sensor.sensor import Electrode, Sensor

SAMPLE_DISTANCE = 0.1
"""Largest distance between neighbouring points of a lead at which the clearance is checked, mm."""

_DEGREES = np.arange(1.0, 90.0)

TRIED_ANGLES = np.deg2rad(np.concatenate([[0.0], np.stack([_DEGREES, -_DEGREES], axis=1).ravel()]))
"""Directions in which a lead is tried, as angles from the outward radial direction, rad.

The angles are ordered by magnitude. The first lead without a conflict therefore deviates least from the radial
direction.
"""


@dataclass(frozen=True)
class Leads:
    """Straight leads of the electrodes of a layout.

    Attributes:
        paths: Start and end (x, y) of each lead, by the name of its electrode, shape (2, 2), mm. A lead starts at the
            centre of the electrode and ends at the rim.
        unconnected: Names of the electrodes for which no straight lead was found.
        width: Width of the leads, mm.
    """

    paths: dict[str, Array]
    unconnected: tuple[str, ...]
    width: float

    @property
    def summary(self) -> str:
        """Text that names the electrodes for which no straight lead was found."""
        if not self.unconnected:
            return f"all {len(self.paths)} leads go straight to the rim"
        return f"no straight lead to the rim for {', '.join(self.unconnected)}: use another layer for their leads"


def straight_leads(sensor: Sensor, width: float = 0.3, clearance: float = 0.3) -> Leads:
    """Find straight leads for all electrodes at their nominal positions.

    The leads are placed one after the other, beginning with the electrode that is farthest from the centre. The leads
    of outer electrodes are short, and therefore obstruct few other leads.

    Args:
        sensor: Sensor with the layout.
        width: Width of the leads, mm.
        clearance: Smallest allowed gap between a lead and other leads or electrodes, mm.

    Returns:
        The leads, and the names of the electrodes for which no straight lead was found.
    """
    paths: dict[str, Array] = {}
    outermost_first = sorted(sensor.electrodes, key=lambda electrode: float(np.hypot(*electrode.centre)), reverse=True)
    for electrode in outermost_first:
        other_electrodes = [other for other in sensor.electrodes if other != electrode]
        placed_leads = list(paths.values())

        # Use the first path with a sufficient clearance. If there is none, the electrode has no lead.
        for path in _possible_paths(np.array(electrode.centre), sensor.film.radius):
            if _clearance(path, width, other_electrodes, placed_leads) >= clearance:
                paths[electrode.name] = path
                break

    # Return the leads in the order of the electrodes of the sensor.
    ordered_paths = {name: paths[name] for name in sensor.electrode_names if name in paths}
    electrodes_without_lead = tuple(name for name in sensor.electrode_names if name not in paths)
    return Leads(ordered_paths, electrodes_without_lead, width)


def _possible_paths(centre: Array, radius: float) -> Array:
    """Return straight paths from a position to the rim of the film in different directions.

    The first path is radial. Each further path deviates from the radial direction at least as much as the previous
    path; see `TRIED_ANGLES`.

    Args:
        centre: Start (x, y) of all paths, shape (2,), mm.
        radius: Radius of the rim, mm.

    Returns:
        Start and end (x, y) of each path, shape (n, 2, 2), mm.
    """
    x, y = centre
    angle = np.arctan2(y, x) + TRIED_ANGLES
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    # A path ends at the rim. Its length is the positive solution of |centre + length * direction|^2 = radius^2, where
    # `direction` is a unit vector.
    projection = direction @ centre
    length = np.sqrt(radius**2 - centre @ centre + projection**2) - projection
    start = np.broadcast_to(centre, direction.shape)
    end = centre + length[:, None] * direction
    return np.stack([start, end], axis=1)


def _clearance(path: Array, width: float, electrodes: list[Electrode], leads: list[Array]) -> float:
    """Return the smallest gap between a lead and electrodes or other leads.

    An electrode is represented by the bounding boxes of its polygons. The gap may therefore be underestimated.

    Args:
        path: Start and end (x, y) of the centre line of the lead, shape (2, 2), mm.
        width: Width of this lead and of the other leads, mm.
        electrodes: Electrodes to which the lead does not belong.
        leads: Centre lines of the other leads, each of shape (2, 2), mm.

    Returns:
        Smallest gap, mm; infinite if there are neither electrodes nor other leads.
    """
    # Choose points on the centre line of the lead that are at most `SAMPLE_DISTANCE` apart.
    start, end = path
    x_length, y_length = end - start
    n_points = int(np.ceil(np.hypot(x_length, y_length) / SAMPLE_DISTANCE)) + 1
    points = start + np.linspace(0.0, 1.0, n_points)[:, None] * (end - start)

    # The distances are measured from the centre lines. Subtract half of the width of this lead, and, for another lead,
    # also half of the width of the other lead.
    electrode_clearances = [_distance_from_boxes(points, electrode) - 0.5 * width for electrode in electrodes]
    lead_clearances = [_distance_from_lead(points, lead) - width for lead in leads]
    return min([*electrode_clearances, *lead_clearances], default=np.inf)


def _distance_from_boxes(points: Array, electrode: Electrode) -> float:
    """Return the smallest distance between points and the bounding boxes of an electrode, mm.

    Args:
        points: Points (x, y), shape (n, 2), mm.
        electrode: Electrode with the bounding boxes.
    """
    lower_left, upper_right = (corners[:, None] for corners in electrode.boxes)  # each of shape (n_box, 1, 2)

    # Distances along x and y between each box and each point, shape (n_box, n, 2). A distance is zero if the coordinate
    # of the point lies within the box.
    offset = np.maximum(np.maximum(lower_left - points, points - upper_right), 0.0)
    return float(np.linalg.norm(offset, axis=2).min())


def _distance_from_lead(points: Array, lead: Array) -> float:
    """Return the smallest distance between points and the centre line of a lead, mm.

    Args:
        points: Points (x, y), shape (n, 2), mm.
        lead: Start and end (x, y) of the centre line, shape (2, 2), mm.
    """
    start, end = lead
    direction = end - start

    # Find the point of the lead that is nearest to each point, first as a fraction of the length of the lead from 0
    # (start) to 1 (end).
    fraction_of_length = np.clip((points - start) @ direction / (direction @ direction), 0.0, 1.0)
    nearest_points = start + fraction_of_length[:, None] * direction
    x_distance, y_distance = (points - nearest_points).T
    return float(np.hypot(x_distance, y_distance).min())
