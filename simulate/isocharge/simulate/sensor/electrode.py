"""Electrodes, and the calibration of their positions and gains on a real film."""

from dataclasses import dataclass, field

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SensorError
from isocharge.simulate.numerics.polygon import area_of, is_convex
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.size_check import check_millimetres

MOST_CORNERS = 256
"""Largest number of corners of an electrode."""

LEAST_EXTENT = 0.02
"""Smallest extent of an electrode along x or y, the larger of both, mm: smaller numbers are in metres."""


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
        placed: Array = points @ np.array([[c, s], [-s, c]]) + np.array(self.shift)
        return placed


def check_electrode(electrode: Electrode, film: Film, calibration: Calibration) -> None:
    """Refuse an electrode that cannot exist on a film.

    Raises:
        SensorError: If it is no convex polygon, tiny, a square that is none, or not wholly on the film.
    """
    if len(electrode.corners) > MOST_CORNERS:
        raise SensorError(
            f"electrode {electrode.name!r}: expected at most {MOST_CORNERS} corners, got {len(electrode.corners)}"
        )
    corners = np.array(electrode.corners)
    if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 2 or not np.isfinite(corners).all():
        raise SensorError(
            f"electrode {electrode.name!r}: expected at least three corners (x, y), got {corners.tolist()}"
        )
    if not is_convex(corners):
        raise SensorError(
            f"electrode {electrode.name!r}: expected a convex polygon with its corners anticlockwise, "
            f"got {corners.tolist()} mm"
        )
    check_millimetres(f"electrode {electrode.name!r}", float(np.ptp(corners, axis=0).max()), LEAST_EXTENT, SensorError)
    side = float(corners[1, 0] - corners[0, 0])
    square = Electrode.of_square(electrode.name, electrode.centre, side).corners
    if electrode.square and not (len(corners) == 4 and np.allclose(corners, square, rtol=0.0, atol=1e-9 * side)):
        raise SensorError(
            f"electrode {electrode.name!r}: expected the corners of a square along the axes, "
            f"got {corners.tolist()} mm; make squares with Electrode.of_square"
        )
    placed = calibration.place(corners)
    if not np.linalg.norm(placed, axis=1).max() < film.radius:
        x, y = placed.mean(axis=0)
        reach = np.linalg.norm(placed - placed.mean(axis=0), axis=1).max()
        size = f"half side {_short(0.5 * side)} mm" if electrode.square else f"corners up to {_short(reach)} mm from it"
        raise SensorError(
            f"electrode {electrode.name!r} lies outside the film: centre ({_short(x)}, {_short(y)}) mm, {size}, "
            f"film radius {_short(film.radius)} mm"
        )


def _short(value: float) -> str:
    """A number with six digits, for messages."""
    return str(float(f"{value:.6g}"))
