"""What a sensor is: film, piezoelectric coefficients, electrodes, readout, calibration. mm, N, MPa and pC throughout.

Frame: origin at the film's centre, x along the drawn direction (1), y transverse (2), z the way the probe pushes.
"""

from dataclasses import dataclass, field
from itertools import combinations
from typing import Literal, get_args

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SensorError, cut, shown
from isocharge.simulate.numerics.polygon import area_of, is_convex, overlap
from isocharge.simulate.sensor.film import Film, Piezo, Surface
from isocharge.simulate.sensor.size_check import check_length

Readout = Literal["area", "edge"]

MOST_CORNERS = 256
"""Largest number of corners of an electrode."""

LEAST_EXTENT = 0.02
"""Smallest extent of an electrode along x or y, the larger of both, mm: smaller numbers are in metres."""

LONGEST_NAME = 100
"""Longest name of an electrode, characters."""

MOST_ELECTRODES = 64
"""Largest number of electrodes on a film; each is checked against all others."""


@dataclass(frozen=True)
class Electrode:
    """One sensing element.

    Attributes:
        name: As in the sensor file.
        corners: Corners of a convex polygon, anticlockwise, mm.
        square: Whether it comes from `of_square`; only squares have the edges that the edge readout averages over.
    """

    name: str
    corners: tuple[tuple[float, float], ...]
    square: bool = False

    @classmethod
    def of_square(cls, name: str, centre: tuple[float, float], side: float) -> "Electrode":
        """A square along the axes, centre and side in mm; the first corner is the lower left one."""
        (x, y), half = centre, 0.5 * side
        corners = ((x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half))
        return cls(name, corners, square=True)

    @property
    def area(self) -> float:
        """Area, mm^2."""
        return area_of(np.array(self.corners))

    @property
    def centre(self) -> tuple[float, float]:
        """Mean of the corners, mm."""
        x, y = np.mean(self.corners, axis=0)
        return float(x), float(y)


@dataclass(frozen=True)
class Calibration:
    """Gains and positions measured on a real film.

    Attributes:
        gain: Charge read over charge collected, by electrode name; missing names count as 1.
        shift: Displacement of the electrodes from the layout, mm.
        rotation: Angle by which they are rotated about the film's centre before the shift, rad, anticlockwise.
    """

    gain: dict[str, float] = field(default_factory=dict)
    shift: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0

    def place(self, points: Array) -> Array:
        """Layout positions, shape (..., 2), to positions on the real film."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        return np.asarray(points @ np.array([[c, s], [-s, c]]) + np.array(self.shift))


@dataclass(frozen=True)
class Sensor:
    """A film with electrodes; see `isocharge.simulate.sensor.sensor_file` for its file."""

    name: str
    film: Film
    piezo: Piezo
    electrodes: tuple[Electrode, ...]
    readout: Readout = "area"
    surface: Surface = "middle"
    calibration: Calibration = field(default_factory=Calibration)

    def __post_init__(self) -> None:
        for value, options in ((self.readout, get_args(Readout)), (self.surface, get_args(Surface))):
            if value not in options:
                raise SensorError(f"expected one of {options}, got {value!r}")
        names, gains = self.electrode_names, self.calibration.gain
        valid = all(0 < len(name) <= LONGEST_NAME and name != "side_mm" for name in names)
        if not (valid and 1 <= len(names) <= MOST_ELECTRODES and len(set(names)) == len(names)):
            raise SensorError(
                f"electrodes: expected 1 to {MOST_ELECTRODES} different names of 1 to {LONGEST_NAME} characters, not "
                f"'side_mm', got {len(names)}: {cut(str(names))}"
            )
        if not all(np.isfinite(gain) and gain > 0.0 for gain in gains.values()):
            raise SensorError(f"calibration gain: expected positive numbers, got {shown(gains)}")
        if not set(gains) <= set(names):
            unknown = sorted(set(gains) - set(names))
            raise SensorError(f"calibration gain: no electrode named {shown(unknown)}, have {cut(str(names))}")
        for electrode in self.electrodes:
            _check_electrode(electrode, self.film, self.calibration)
            if self.readout == "edge" and not electrode.square:
                raise SensorError(f"readout 'edge' needs square electrodes, but {electrode.name!r} is a polygon")
        for first, second in combinations(self.electrodes, 2):
            if overlap(np.array(first.corners), np.array(second.corners)):
                raise SensorError(f"electrodes {first.name!r} and {second.name!r} overlap; move one of them")

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Names in the order of the charges."""
        return tuple(electrode.name for electrode in self.electrodes)

    @property
    def gains(self) -> Array:
        """Calibrated gain of each electrode, shape (n_electrode,)."""
        return np.array([self.calibration.gain.get(name, 1.0) for name in self.electrode_names])


def electrode_index(sensor: Sensor, name: str) -> int:
    """Place of an electrode in the order of the charges.

    Raises:
        SensorError: If the sensor has no electrode of that name.
    """
    if name not in sensor.electrode_names:
        raise SensorError(f"no electrode {name!r} on {sensor.name}: it has {', '.join(sensor.electrode_names)}")
    return sensor.electrode_names.index(name)


def _check_electrode(electrode: Electrode, film: Film, calibration: Calibration) -> None:
    """Refuse an electrode that cannot exist on a film.

    Raises:
        SensorError: If it is no convex polygon, tiny, a square that is none, or not wholly on the film.
    """
    corners, name = np.array(electrode.corners), f"electrode {electrode.name!r}"
    if corners.ndim != 2 or not 3 <= len(corners) <= MOST_CORNERS or corners.shape[1] != 2:
        raise SensorError(f"{name}: expected 3 to {MOST_CORNERS} corners (x, y), got {shown(corners.tolist())}")
    if not (np.isfinite(corners).all() and is_convex(corners)):
        raise SensorError(
            f"{name}: expected a convex polygon with its corners anticlockwise, got {shown(corners.tolist())} mm"
        )
    check_length(name, float(np.ptp(corners, axis=0).max()), LEAST_EXTENT, SensorError)
    side = float(corners[1, 0] - corners[0, 0])
    square = Electrode.of_square(electrode.name, electrode.centre, side).corners
    if electrode.square and not (len(corners) == 4 and np.allclose(corners, square, rtol=0.0, atol=1e-9 * side)):
        raise SensorError(
            f"{name}: expected the corners of a square along the axes, got {corners.tolist()} mm; make squares with "
            "Electrode.of_square"
        )
    placed = calibration.place(corners)
    if not np.linalg.norm(placed, axis=1).max() < film.radius:
        x, y = placed.mean(axis=0)
        reach = np.linalg.norm(placed - placed.mean(axis=0), axis=1).max()
        size = f"half side {_short(0.5 * side)} mm" if electrode.square else f"corners up to {_short(reach)} mm from it"
        raise SensorError(
            f"{name} lies outside the film: centre ({_short(x)}, {_short(y)}) mm, {size}, "
            f"film radius {_short(film.radius)} mm"
        )


def _short(value: float) -> str:
    """A number with six digits, for messages."""
    return str(float(f"{value:.6g}"))
