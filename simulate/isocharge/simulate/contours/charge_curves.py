"""Charges of presses on lines that start at an electrode (Mirbagheri and others 2007, figures 2, 4, 7).

The mapping scheme of the paper consists of presses on lines that start at the centre of an electrode. The angles
between neighbouring lines are equal, and so are the distances between neighbouring presses on a line. The paper fits a
polynomial to the charge as a function of the distance along each line. The module `graphical_method` draws contours
through the points at which these polynomials have a given charge.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.sensor.sensor import Sensor, electrode_index

STEP = 4.0
"""Default distance between neighbouring presses on a line, mm. The value is that of the paper."""

LENGTH = 20.0
"""Default length of the lines, mm. The paper does not state a length."""

ANGLE_STEP = np.deg2rad(10.0)
"""Default angle between neighbouring lines, rad. The value is that of the paper."""

HALF_ANGLE = np.deg2rad(70.0)
"""Default value of the largest angle between a line and the direction to the centre of the film, rad.

The paper does not state this angle.
"""


@dataclass(frozen=True)
class Mapping:
    """Mapping scheme: presses at equal distances on lines that start at an electrode.

    Attributes:
        electrode: Name of the electrode at which the lines start.
        origin: Centre (x, y) of this electrode, mm.
        angle: Angle of each line from the drawn direction, anticlockwise, shape (n_line,), rad.
        distance: Distances of the presses from the origin in ascending order, which are the same on all lines, shape
            (n_step,), mm.
    """

    electrode: str
    origin: tuple[float, float]
    angle: Array
    distance: Array

    @classmethod
    def lines(
        cls,
        sensor: Sensor,
        electrode: str,
        angles: tuple[float, float] | None = None,
        angle_step: float = ANGLE_STEP,
        step: float = STEP,
        length: float = LENGTH,
    ) -> "Mapping":
        """Create a mapping scheme with equal angles between neighbouring lines.

        The last line always has the last angle, even if the angle between the last two lines is then smaller than
        `angle_step`.

        Args:
            sensor: Sensor whose calibration determines the positions of the electrodes.
            electrode: Name of the electrode at which the lines start.
            angles: First and last angle of the lines, rad. If None, the lines cover `HALF_ANGLE` on both sides of the
                direction to the centre of the film.
            angle_step: Angle between neighbouring lines, rad.
            step: Distance between neighbouring presses on a line, and distance of the first press from the centre of
                the electrode, mm.
            length: Length of the lines, mm.

        Raises:
            SensorError: If the sensor has no such electrode.
            SceneError: If an angle, a step or the length is not valid.
        """
        centre = sensor.electrodes[electrode_index(sensor, electrode)].centre
        x, y = sensor.calibration.place(np.array(centre))
        inward_angle = np.arctan2(-y, -x) % (2.0 * np.pi)  # direction from the electrode to the centre of the film
        if angles is None:
            angles = (inward_angle - HALF_ANGLE, inward_angle + HALF_ANGLE)
        first_angle, last_angle = angles
        are_angles_valid = -np.inf < first_angle <= last_angle < np.inf and 0.0 < angle_step < np.inf
        if not (are_angles_valid and 0.0 < step <= length < np.inf):
            raise SceneError(
                f"expected first <= last angle and 0 < step <= length, got {np.rad2deg(first_angle):g} to "
                f"{np.rad2deg(last_angle):g} degrees in steps of {np.rad2deg(angle_step):g}, and lines of {length:g} "
                f"mm in steps of {step:g} mm"
            )

        # Rounding must neither duplicate the last angle nor remove the last press of a line.
        angles_before_last = np.arange(first_angle, last_angle - 1e-9, angle_step)
        angle = np.append(angles_before_last, last_angle)
        presses_per_line = int(length / step * (1.0 + 1e-9))
        distance: Array = step * np.arange(1.0, presses_per_line + 1.0)
        return cls(electrode, (float(x), float(y)), angle, distance)

    @property
    def points(self) -> Array:
        """Positions (x, y) of the presses, shape (n_line, n_step, 2), mm."""
        direction = np.stack([np.cos(self.angle), np.sin(self.angle)], axis=-1)
        return np.asarray(np.array(self.origin) + self.distance[None, :, None] * direction[:, None])

    @property
    def radius(self) -> float:
        """Distance between the centre of the film and the farthest press, mm.

        A charge map that computes the charges of the presses must have at least this radius.
        """
        return float(np.linalg.norm(self.points, axis=-1).max())

    def finer(self, count: int) -> "Mapping":
        """Return a mapping scheme with the same lines and another number of presses on each line.

        Args:
            count: Number of presses on each line. They are equally spaced from the first to the last press.
        """
        distance = np.linspace(self.distance[0], self.distance[-1], count)
        return Mapping(self.electrode, self.origin, self.angle, distance)


@dataclass(frozen=True)
class Curves:
    """Charges along the lines of a mapping scheme.

    Attributes:
        mapping: Positions of the presses.
        electrodes: Names of the electrodes in the order of the charges.
        force: Force of all presses, N.
        charge: Touch charges of the presses, shape (n_line, n_step, n_electrode), pC.
    """

    mapping: Mapping
    electrodes: tuple[str, ...]
    force: float
    charge: Array

    @classmethod
    def of(cls, charge_map: ChargeMap, mapping: Mapping, force: float) -> "Curves":
        """Compute the charges along the lines of a mapping scheme.

        Args:
            charge_map: Map that computes the charges of contacts.
            mapping: Positions of the presses.
            force: Force of all presses, N.

        Raises:
            SceneError: If a press or the force is outside the domain of the map.
        """
        points = mapping.points
        position = points.reshape(-1, 2)
        charge = charge_map.charges(np.column_stack([position, np.full(len(position), force)]))
        return cls(mapping, charge_map.electrodes, force, charge.reshape(*points.shape[:2], -1))

    @property
    def own_charge(self) -> Array:
        """Charge of the electrode at which the lines start, shape (n_line, n_step), pC."""
        return np.asarray(self.charge[..., self.electrodes.index(self.mapping.electrode)])

    def polynomials(self, degree: int) -> Sequence[Polynomial]:
        """Fit a polynomial to the charge along each line, as in the paper.

        The charge is that of the electrode at which the lines start.

        Args:
            degree: Degree of the polynomials.

        Returns:
            For each line, a polynomial that computes the charge (pC) from the distance (mm).

        Raises:
            SceneError: If a line has fewer presses than the polynomial has coefficients.
        """
        distance = self.mapping.distance
        if not 1 <= degree < distance.size:
            raise SceneError(
                f"degree: expected 1 to {distance.size - 1} for {distance.size} presses on a line, got {degree}"
            )
        return [Polynomial.fit(distance, line_charge, degree) for line_charge in self.own_charge]
