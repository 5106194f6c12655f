"""What a sensor is: film, piezoelectric coefficients, electrodes, readout, calibration. mm, N, MPa and pC throughout.

Coordinates: origin at the film's centre, x along the drawn direction (1), y transverse (2), seen from the side of the
probe. Force and deflection are positive in the direction of the push (README.md, Coordinates).
"""

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import combinations
from typing import Literal, get_args

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.errors import SensorError, cut, shown
from isocharge.common.printable_text import is_printable
from isocharge.simulate.numerics.polygon import area_of, is_convex, overlap, to_complex, to_corners
from isocharge.simulate.numerics.polygon_union import is_simple, pieces, trace_outline, union_parts
from isocharge.simulate.sensor.film import Coat, Film, Piezo, Surface
from isocharge.simulate.sensor.size_check import check_length

Readout = Literal["area", "edge"]

MOST_CORNERS = 256
"""Largest number of corners of a polygon."""

MOST_OF_ALL = 2048
"""Largest number of corners of all polygons of an electrode: where their edges cross is looked for pair by pair."""

LEAST_EXTENT = 0.02
"""Smallest extent of an electrode along x or y, the larger of both, mm: smaller numbers are in metres."""

LONGEST_PART = 3.0
"""Longest side of the parts into which what is no convex polygon is cut, mm."""

MOST_CROSSTALK = 0.2
"""Largest crosstalk, dimensionless: beyond, the wires are wrong."""

LONGEST_NAME = 100
"""Longest name of an electrode, characters."""

OTHER_COLUMNS = (
    *("side_mm", "coating_N_per_mm", "x_mm", "y_mm", "force_N", "position_std_mm", "force_std", "temperature_C"),
    *("probe", "orientation_deg", "t_us", "t_ms", "t_s", "seq"),
)
"""What else stands among the names of electrodes: keys of the sensor file, columns of presses, fields of a frame."""

MOST_ELECTRODES = 64
"""Largest number of electrodes on a film; each is checked against all others."""


Corners = tuple[tuple[float, float], ...]
"""Corners (x, y) of a polygon, anticlockwise, mm; it may have dents, but not cross itself."""


@dataclass(frozen=True)
class Electrode:
    """One sensing element: what its metal on the front and that on the back have in common collects.

    Attributes:
        name: As in the sensor file.
        corners: The pad.
        square: Whether it comes from `of_square`; only squares have the edges that the edge readout averages over.
        more: Further metal of the front, such as traces; where polygons overlap, their area counts once.
        back: Metal of the back; none stands for a back that is metal all over.
    """

    name: str
    corners: Corners
    square: bool = False
    more: tuple[Corners, ...] = ()
    back: tuple[Corners, ...] = ()

    def __post_init__(self) -> None:
        for polygons in ("corners", "more", "back"):
            object.__setattr__(self, polygons, _as_tuples(getattr(self, polygons)))

    @classmethod
    def of_square(cls, name: str, centre: tuple[float, float], side: float) -> "Electrode":
        """A square along the axes, centre and side in mm; the first corner is the lower left one."""
        (x, y), half = centre, 0.5 * side
        corners = ((x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half))
        return cls(name, corners, square=True)

    def with_trace(self, path: Corners, width: float) -> "Electrode":
        """The electrode with a trace on its front, a line through the points of `path` with a width, mm.

        Raises:
            SensorError: If the path has fewer than two points or the same twice, or the trace crosses itself.
        """
        outline = to_corners(trace_outline(to_complex(np.array(path)), width))
        polygon = tuple((float(x), float(y)) for x, y in outline)
        check_polygon(f"trace of electrode {self.name!r}", polygon)
        return replace(self, square=False, more=(*self.more, polygon))

    @property
    def front(self) -> tuple[Corners, ...]:
        """The pad and the further metal of the front."""
        return (self.corners, *self.more)

    @cached_property
    def uncut(self) -> tuple[Array, ...]:
        """What collects, without common area: a convex polygon, or trapezoids; (n, 2) each, mm.

        Raises:
            SensorError: If a polygon crosses itself, or there are too few or too many corners.
        """
        for polygon in (*self.front, *self.back):
            check_polygon(f"electrode {self.name!r}", polygon)
        if (count := sum(map(len, (*self.front, *self.back)))) > MOST_OF_ALL:
            raise SensorError(
                f"electrode {self.name!r}: expected at most {MOST_OF_ALL} corners of all polygons, got {count}"
            )
        if self._is_convex:
            return (np.array(self.corners),)
        front, back = ([to_complex(np.array(polygon)) for polygon in side] for side in (self.front, self.back))
        return tuple(to_corners(part) for part in union_parts(front, back))

    @cached_property
    def parts(self) -> tuple[Array, ...]:
        """What collects, as `uncut`, but trapezoids are cut into quadrilaterals and triangles of `LONGEST_PART`."""
        if self._is_convex:
            return self.uncut
        return tuple(to_corners(piece) for part in self.uncut for piece in pieces(to_complex(part), LONGEST_PART))

    @property
    def _is_convex(self) -> bool:
        return not (self.more or self.back) and is_convex(np.array(self.corners))

    @property
    def area(self) -> float:
        """Area that collects, mm^2."""
        return sum(area_of(part) for part in self.parts)

    @cached_property
    def metal(self) -> tuple[Array, ...]:
        """What is metal on the front, whether it collects or not, as `parts`."""
        return replace(self, back=()).parts if self.back else self.parts

    @cached_property
    def boxes(self) -> tuple[Array, Array]:
        """Lower left and upper right corners of the boxes round `metal`, each of shape (n_part, 2), mm."""
        low, high = (np.array([end(part, axis=0) for part in self.metal]) for end in (np.min, np.max))
        return low, high

    def overlaps(self, other: "Electrode", within: float = 0.0) -> bool:
        """Whether the metal of the two touches on the front, or is apart by less than `within`, mm."""
        (low, high), (other_low, other_high) = self.boxes, other.boxes
        near = (low[:, None] <= other_high + within) & (other_low - within <= high[:, None])
        return any(overlap(self.metal[i], other.metal[j], within) for i, j in np.argwhere(near.all(axis=2)))

    @property
    def centre(self) -> tuple[float, float]:
        """Mean of the pad's corners, mm."""
        x, y = np.mean(self.corners, axis=0)
        return float(x), float(y)


@dataclass(frozen=True)
class Calibration:
    """Gains and positions measured on a real film.

    Attributes:
        gain: Charge read over charge collected, by electrode name; missing names count as 1.
        shift: Displacement of the electrodes from the layout, mm.
        rotation: Angle by which they are rotated about the film's centre before the shift, rad, anticlockwise.
        crosstalk: Share of every other electrode's charge that an electrode reads, dimensionless.
    """

    gain: dict[str, float] = field(default_factory=dict)
    shift: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    crosstalk: float = 0.0

    def read(self, charge: Array) -> Array:
        """What is read of charges (..., n_electrode), pC, with the crosstalk."""
        if self.crosstalk == 0.0:
            return charge
        return np.asarray(charge + self.crosstalk * (charge.sum(axis=-1, keepdims=True) - charge))

    def place(self, points: Array) -> Array:
        """Layout positions, shape (..., 2), to positions on the real film."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        return np.asarray(points @ np.array([[c, s], [-s, c]]) + np.array(self.shift))


@dataclass(frozen=True)
class Sensor:
    """A film with electrodes; see `isocharge.simulate.sensor.sensor_file` for its file.

    Attributes:
        name: Its name.
        film: The bare film.
        piezo: Its coefficients.
        electrodes: What collects.
        readout: Mean over an electrode or over its edges.
        surface: Where in the thickness the stress is read.
        calibration: What was measured on a real film.
        coating: Young's modulus times thickness of the electrodes' metal or ink, N/mm, on the front and on a back that
            is not metal all over; 0 where it does not stiffen the film.
    """

    name: str
    film: Film
    piezo: Piezo
    electrodes: tuple[Electrode, ...]
    readout: Readout = "area"
    surface: Surface = "middle"
    calibration: Calibration = field(default_factory=Calibration)
    coating: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "electrodes", _as_tuples(self.electrodes))
        for value, options in ((self.readout, get_args(Readout)), (self.surface, get_args(Surface))):
            if value not in options:
                raise SensorError(f"expected one of {options}, got {value!r}")
        names, gains = self.electrode_names, self.calibration.gain
        if not (1 <= len(names) <= MOST_ELECTRODES and len(set(names)) == len(names)):
            raise SensorError(
                f"electrodes: expected 1 to {MOST_ELECTRODES} different names, got {len(names)}: {cut(str(names))}"
            )
        for name in names:
            _check_name(name)
        if not all(np.isfinite(gain) and gain > 0.0 for gain in gains.values()):
            raise SensorError(f"calibration gain: expected positive numbers, got {shown(gains)}")
        if not abs(self.calibration.crosstalk) <= MOST_CROSSTALK:
            raise SensorError(
                f"calibration crosstalk: expected a share up to {MOST_CROSSTALK:g}, got {self.calibration.crosstalk}"
            )
        if not set(gains) <= set(names):
            unknown = sorted(set(gains) - set(names))
            raise SensorError(f"calibration gain: no electrode named {shown(unknown)}, have {cut(str(names))}")
        _check_layout(self.electrodes)
        for electrode in self.electrodes:
            _check_on_film(electrode, self.film, self.calibration)
            if self.readout == "edge" and not electrode.square:
                raise SensorError(f"readout 'edge' needs square electrodes, but {electrode.name!r} is a polygon")

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Names in the order of the charges."""
        return tuple(electrode.name for electrode in self.electrodes)

    @cached_property
    def coated_film(self) -> Film:
        """The film with the metal of the electrodes, as it is pressed; the bare one if that does not stiffen it."""
        if self.coating == 0.0:
            return self.film
        once = [replace(e, more=(*e.more, *e.back), back=(), square=False) for e in self.electrodes]
        twice = [electrode for electrode in self.electrodes if electrode.back]
        layers = [[self.calibration.place(part) for e in layer for part in e.parts] for layer in (once, twice) if layer]
        corners = tuple(tuple(tuple((float(x), float(y)) for x, y in part) for part in layer) for layer in layers)
        return replace(self.film, coat=Coat(self.coating, corners))

    @cached_property
    def part_circles(self) -> tuple[tuple[Complexes, Array], ...]:
        """Circles round the parts of each electrode, at their calibrated positions.

        Returns:
            For each electrode the centres x + iy and the radii, each of shape (n_part,), mm.
        """
        part_circles = []
        for electrode in self.electrodes:
            parts = [self.calibration.place(part) for part in electrode.parts]
            centre = np.array([part.mean(axis=0) for part in parts])
            reach = [np.linalg.norm(part - at, axis=1).max() for part, at in zip(parts, centre, strict=True)]
            part_circles.append((to_complex(centre), np.array(reach)))
        return tuple(part_circles)

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


def _as_tuples(value: object) -> object:
    """Lists and arrays as tuples all the way down, so that layouts can be compared; other values as they are."""
    return tuple(map(_as_tuples, value)) if isinstance(value, list | tuple | np.ndarray) else value


def _check_name(name: str) -> None:
    """Refuse a name that cannot head a column of charges.

    Raises:
        SensorError: If it is empty or too long, has a comma or what cannot be printed, or means something else there.
    """
    if not (0 < len(name) <= LONGEST_NAME and is_printable(name) and name == name.strip() and "," not in name):
        raise SensorError(
            f"electrode {shown(name)}: expected a name of 1 to {LONGEST_NAME} printable characters, without commas and "
            "without blanks at its ends: it heads a column of CSV files"
        )
    if name in OTHER_COLUMNS:
        raise SensorError(f"electrode {name!r}: this name means something else in files of charges; choose another one")


@lru_cache(maxsize=64)
def _check_layout(electrodes: tuple[Electrode, ...]) -> None:
    """Refuse electrodes that cannot exist on any film; the many films of one layout are looked at once.

    Raises:
        SensorError: If a polygon crosses itself, nothing collects, one is tiny, a square is none, or two overlap.
    """
    for electrode in electrodes:
        name = f"electrode {electrode.name!r}"
        if not electrode.uncut:
            raise SensorError(f"{name}: its front and its back have no area in common, so nothing collects; move one")
        corners = np.array(electrode.corners)
        check_length(name, float(np.ptp(corners, axis=0).max()), LEAST_EXTENT, SensorError)
        side = float(corners[1, 0] - corners[0, 0])
        square = Electrode.of_square(electrode.name, electrode.centre, side).corners
        alone = len(corners) == 4 and not (electrode.more or electrode.back)
        if electrode.square and not (alone and np.allclose(corners, square, rtol=0.0, atol=1e-9 * side)):
            raise SensorError(
                f"{name}: expected the corners of a square along the axes, got {corners.tolist()} mm; make squares "
                "with Electrode.of_square"
            )
    for first, second in combinations(electrodes, 2):
        if first.overlaps(second):
            raise SensorError(f"electrodes {first.name!r} and {second.name!r} overlap; move one of them")


def _check_on_film(electrode: Electrode, film: Film, calibration: Calibration) -> None:
    """Refuse an electrode that does not lie wholly on a film.

    Raises:
        SensorError: If a part of it lies beyond the rim.
    """
    placed = calibration.place(np.concatenate(electrode.uncut))
    if not np.linalg.norm(placed, axis=1).max() < film.radius:
        x, y = placed.mean(axis=0)
        reach = np.linalg.norm(placed - placed.mean(axis=0), axis=1).max()
        half = 0.5 * (electrode.corners[1][0] - electrode.corners[0][0])
        size = f"half side {_short(half)} mm" if electrode.square else f"corners up to {_short(reach)} mm from it"
        raise SensorError(
            f"electrode {electrode.name!r} lies outside the film: centre ({_short(x)}, {_short(y)}) mm, {size}, "
            f"film radius {_short(film.radius)} mm" + "; end its traces before the rim" * bool(electrode.more)
        )


def check_polygon(where: str, polygon: Corners) -> None:
    """Refuse what is no simple polygon.

    Raises:
        SensorError: If it crosses itself, runs clockwise, or has too few or too many corners.
    """
    corners = np.array(polygon)
    if corners.ndim != 2 or not 3 <= len(corners) <= MOST_CORNERS or corners.shape[1] != 2:
        raise SensorError(f"{where}: expected 3 to {MOST_CORNERS} corners (x, y), got {shown(corners.tolist())}")
    if not (np.isfinite(corners).all() and (is_convex(corners) or is_simple(to_complex(corners)))):
        raise SensorError(
            f"{where}: expected a polygon that does not cross itself, with its corners anticlockwise, got "
            f"{shown(corners.tolist())} mm"
        )


def _short(value: float) -> str:
    """A number with six digits, for messages."""
    return str(float(f"{value:.6g}"))
