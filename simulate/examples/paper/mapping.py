"""Charges of presses on lines that start at an electrode (figures 2, 4 and 7 of the paper)."""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate import ChargeMap, Sensor
from isocharge.simulate.sensor.sensor import electrode_index

STEP_MM = 4.0
STEP_DEG = 10.0
"""Distance between neighbouring presses on a line, and angle between neighbouring lines."""

HALF_ANGLE_DEG = 70.0
"""Largest angle between a line and the direction to the centre of the film. The paper does not state this angle."""


@dataclass(frozen=True)
class Mapping:
    """Mapping scheme: presses at equal distances on lines that start at an electrode.

    Attributes:
        electrode: Name of the electrode at which the lines start.
        origin: Centre (x, y) of this electrode, shape (2,), mm.
        angle: Angle of each line from the drawn direction, anticlockwise, shape (n_line,), rad.
        distance: Distances of the presses from the origin in ascending order, shape (n_step,), mm.
    """

    electrode: str
    origin: Array
    angle: Array
    distance: Array

    @classmethod
    def lines(
        cls, sensor: Sensor, electrode: str, length: float, degrees: tuple[float, float] | None = None
    ) -> "Mapping":
        """Create a mapping scheme with the steps of the paper.

        Args:
            sensor: Sensor with the electrode.
            electrode: Name of the electrode at which the lines start.
            length: Length of the lines, mm.
            degrees: First and last angle of the lines, degrees. If None, the lines cover `HALF_ANGLE_DEG` on both sides
                of the direction to the centre of the film.
        """
        origin = np.array(sensor.electrodes[electrode_index(sensor, electrode)].centre)
        if degrees is None:
            inward = np.rad2deg(np.arctan2(-origin[1], -origin[0])) % 360.0
            degrees = (inward - HALF_ANGLE_DEG, inward + HALF_ANGLE_DEG)
        first, last = degrees
        angle = np.deg2rad([*np.arange(first, last - 1e-9, STEP_DEG), last])
        return cls(electrode, origin, angle, np.arange(STEP_MM, length * (1.0 + 1e-9), STEP_MM))

    @property
    def direction(self) -> Array:
        """Unit vector of each line, shape (n_line, 2)."""
        return np.stack([np.cos(self.angle), np.sin(self.angle)], axis=1)

    @property
    def points(self) -> Array:
        """Positions (x, y) of the presses, shape (n_line, n_step, 2), mm."""
        return np.asarray(self.origin + self.distance[None, :, None] * self.direction[:, None])

    @property
    def radius(self) -> float:
        """Distance between the centre of the film and the farthest press, mm."""
        return float(np.linalg.norm(self.points, axis=2).max())

    def finer(self, count: int) -> "Mapping":
        """Return the same lines with another number of presses from the first to the last press."""
        return replace(self, distance=np.linspace(self.distance[0], self.distance[-1], count))


@dataclass(frozen=True)
class Curves:
    """Charge of the electrode at which the lines of a mapping scheme start.

    Attributes:
        mapping: Positions of the presses.
        charge: Touch charges of the presses, shape (n_line, n_step), pC.
    """

    mapping: Mapping
    charge: Array

    @classmethod
    def of(cls, charge_map: ChargeMap, mapping: Mapping, force: float) -> "Curves":
        """Compute the charges of presses with a force (N)."""
        points = mapping.points
        position = points.reshape(-1, 2)
        charge = charge_map.charges(np.column_stack([position, np.full(len(position), force)]))
        own = charge[:, charge_map.electrodes.index(mapping.electrode)]
        return cls(mapping, own.reshape(points.shape[:2]))
