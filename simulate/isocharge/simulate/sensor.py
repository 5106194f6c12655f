"""What a sensor is: film, piezoelectric coefficients, electrodes, readout, calibration. SI units throughout.

Frame: origin at the film's centre, x along the drawn direction (1), y transverse (2), z the way the probe pushes.
"""

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import SensorError
from isocharge.simulate.polygon import area_of, is_convex, overlap

Readout = Literal["area", "edge"]
Surface = Literal["middle", "top", "bottom"]


@dataclass(frozen=True)
class Film:
    """The clamped circular film.

    Attributes:
        radius: m.
        thickness: m.
        young: Young's modulus, Pa.
        poisson: Poisson's ratio, 0 <= poisson < 0.5.
        pretension: Uniform second Piola-Kirchhoff stress without load, Pa, tension positive.
    """

    radius: float
    thickness: float
    young: float
    poisson: float
    pretension: float = 0.0

    def __post_init__(self) -> None:
        for name, unit in (("radius", "m"), ("thickness", "m"), ("young", "Pa")):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise SensorError(f"film {name}: expected a positive number, got {value:.6g} {unit}")
        if not 0.0 <= self.poisson < 0.5:
            raise SensorError(f"film poisson: expected 0 <= poisson < 0.5, got {self.poisson}")
        if not (np.isfinite(self.pretension) and self.pretension >= 0.0):
            raise SensorError(f"film pretension: expected zero or tension (>= 0 Pa), got {self.pretension}")
        if self.thickness > 0.1 * self.radius:
            raise SensorError(
                f"film thickness: expected at most a tenth of the radius ({self.radius * 1e3} mm), "
                f"got {self.thickness * 1e6} um; this is a solid, not a film"
            )


@dataclass(frozen=True)
class Piezo:
    """Piezoelectric strain coefficients d31, d32, d33 in C/N and the pyroelectric one in C/(m^2 K)."""

    d31: float
    d32: float
    d33: float = 0.0
    pyro: float = 0.0

    def __post_init__(self) -> None:
        for name in ("d31", "d32", "d33", "pyro"):
            if not np.isfinite(getattr(self, name)):
                raise SensorError(f"piezo {name}: expected a finite number, got {getattr(self, name)}")
        if self.d31 == 0.0 and self.d32 == 0.0:
            raise SensorError("piezo d31 and d32 are both 0: such a film gives no charge")


@dataclass(frozen=True)
class Electrode:
    """One sensing element.

    Attributes:
        name: As in the sensor file.
        corners: Corners of a convex polygon, anticlockwise, m.
        square: Whether it was made by `of_square`; only squares have the edges that the edge readout averages over.
    """

    name: str
    corners: tuple[tuple[float, float], ...]
    square: bool = False

    @classmethod
    def of_square(cls, name: str, centre: tuple[float, float], side: float) -> "Electrode":
        """A square along the axes, centre and side in m; the first corner is the lower left one."""
        (x, y), half = centre, 0.5 * side
        corners = ((x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half))
        return cls(name, corners, square=True)

    @property
    def area(self) -> float:
        """m^2."""
        return area_of(np.array(self.corners))

    @property
    def centre(self) -> tuple[float, float]:
        """Mean of the corners, m."""
        x, y = np.mean(self.corners, axis=0)
        return float(x), float(y)


@dataclass(frozen=True)
class Calibration:
    """What calibration found on a real film.

    Attributes:
        gain: Charge read over charge collected, by electrode name; missing names count as 1.
        shift: How far the electrodes sit from where the layout says, m.
        rotation: How far they are turned about the film's centre before the shift, rad, anticlockwise.
    """

    gain: dict[str, float] = field(default_factory=dict)
    shift: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0

    def place(self, points: Array) -> Array:
        """Layout positions, shape (..., 2), to positions on the real film."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        placed: Array = points @ np.array([[c, s], [-s, c]]) + np.array(self.shift)
        return placed


@dataclass(frozen=True)
class Sensor:
    """A film with electrodes; see `isocharge.simulate.sensor_file` for its file."""

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
        names = self.electrode_names
        if len(set(names)) < len(names) or not all(names) or "side_mm" in names:
            raise SensorError(f"electrodes: expected different names, none empty or 'side_mm', got {names}")
        if not all(np.isfinite(gain) and gain > 0.0 for gain in self.calibration.gain.values()):
            raise SensorError(f"calibration gain: expected positive numbers, got {self.calibration.gain}")
        if not self.electrodes:
            raise SensorError("electrodes: expected at least one, got none")
        for electrode in self.electrodes:
            _check_electrode(electrode, self.film, self.calibration)
            if self.readout == "edge" and not electrode.square:
                raise SensorError(f"readout 'edge' needs square electrodes, but {electrode.name!r} is a polygon")
        for i, first in enumerate(self.electrodes):
            for second in self.electrodes[i + 1 :]:
                if overlap(np.array(first.corners), np.array(second.corners)):
                    raise SensorError(f"electrodes {first.name!r} and {second.name!r} overlap; move one of them")
        unknown = set(self.calibration.gain) - set(self.electrode_names)
        if unknown:
            raise SensorError(f"calibration gain: no electrode named {sorted(unknown)}, have {self.electrode_names}")

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Names in the order of the charges."""
        return tuple(electrode.name for electrode in self.electrodes)

    @property
    def gains(self) -> Array:
        """Calibrated gain of each electrode, shape (n_electrode,)."""
        return np.array([self.calibration.gain.get(name, 1.0) for name in self.electrode_names])


def _check_electrode(electrode: Electrode, film: Film, calibration: Calibration) -> None:
    corners = np.array(electrode.corners)
    if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 2 or not np.isfinite(corners).all():
        raise SensorError(
            f"electrode {electrode.name!r}: expected at least three corners (x, y), got {corners.tolist()}"
        )
    if not is_convex(corners):
        raise SensorError(
            f"electrode {electrode.name!r}: expected a convex polygon with its corners anticlockwise, "
            f"got {(corners * 1e3).tolist()} mm"
        )
    side = float(corners[1, 0] - corners[0, 0])
    square = Electrode.of_square(electrode.name, electrode.centre, side).corners
    if electrode.square and not (len(corners) == 4 and np.allclose(corners, square, rtol=0.0, atol=1e-9 * side)):
        raise SensorError(
            f"electrode {electrode.name!r}: expected the corners of a square along the axes, "
            f"got {(corners * 1e3).tolist()} mm; make squares with Electrode.of_square"
        )
    placed = calibration.place(corners)
    if not np.linalg.norm(placed, axis=1).max() < film.radius:
        x, y = 1e3 * placed.mean(axis=0)
        reach = 1e3 * np.linalg.norm(placed - placed.mean(axis=0), axis=1).max()
        size = f"half side {_mm(500.0 * side)} mm" if electrode.square else f"corners up to {_mm(reach)} mm from it"
        raise SensorError(
            f"electrode {electrode.name!r} lies outside the film: centre ({_mm(x)}, {_mm(y)}) mm, {size}, "
            f"film radius {_mm(1e3 * film.radius)} mm"
        )


def _mm(value: float) -> str:
    """For messages, the value already in mm."""
    return str(float(f"{value:.6g}"))
