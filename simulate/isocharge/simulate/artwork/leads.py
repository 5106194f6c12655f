"""Search for straight leads, which are conductors from the electrodes to the rim of the film.

A lead crosses neither another lead nor another electrode.
"""

from dataclasses import dataclass

import numpy as np
import shapely

from isocharge.common.arrays import Array
from isocharge.simulate.sensor.sensor import Sensor

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
        # The distances are measured from the centre lines of the leads.
        others = shapely.union_all([other.region for other in sensor.electrodes if other is not electrode])
        leads = shapely.MultiLineString(list(paths.values()))
        possible_paths = _possible_paths(np.array(electrode.centre), sensor.film.radius)
        lines = shapely.linestrings(possible_paths)
        # The distance from an empty geometry is NaN.
        is_too_near = shapely.distance(lines, others) < 0.5 * width + clearance
        is_too_near |= shapely.distance(lines, leads) < width + clearance

        # Use the first path with a sufficient clearance. If there is none, the electrode has no lead.
        if not is_too_near.all():
            paths[electrode.name] = possible_paths[is_too_near.argmin()]

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
