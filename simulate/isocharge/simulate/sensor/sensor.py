"""Description of a sensor: a film with electrodes, their readout and their calibration.

The origin of the coordinates is the centre of the film. The x axis is the drawn direction (1) of the film, and the y
axis is the transverse direction (2). The film is seen from the side of the probe. Force and deflection are positive in
the direction of the push. The units are mm, N, MPa and pC.
"""

import cmath
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import combinations
from typing import Any, Literal, get_args

import numpy as np
import shapely
from numpy.typing import ArrayLike

from isocharge.common.arrays import Array
from isocharge.common.errors import SensorError, cut, is_printable, shown
from isocharge.simulate.numerics.polygon import (
    MERGE_DISTANCE,
    area_of,
    is_convex,
    is_simple,
    region_of,
    to_complex,
    to_corners,
    trace_outline,
    union_triangles,
)
from isocharge.simulate.sensor.film import Film, Piezo, Surface, check_range

Readout = Literal["area", "edge"]
"""Part of an electrode over which the stress is averaged: the area or the edges (Mirbagheri et al. 2007, eq. 2, 3)."""

MAX_CORNERS = 256
"""Largest number of corners of a polygon."""

MAX_ELECTRODE_CORNERS = 2048
"""Largest number of corners of all polygons of an electrode together.

The number is limited because all pairs of edges are searched for intersections.
"""

MIN_EXTENT = 0.02
"""Smallest accepted size of an electrode, mm. The size is the larger of the extents along x and along y.

A smaller value was probably given in metres.
"""

MAX_PART_SIDE = 3.0
"""Largest length of a triangle side that lies on the outline of an electrode, mm.

Metal that is not convex is divided into triangles. The layout design keeps new electrodes away from the bounding box of
each triangle, so the triangles must be small.
"""

MAX_CROSSTALK = 0.2
"""Largest accepted magnitude of the crosstalk, dimensionless."""

MAX_NAME_LENGTH = 100
"""Largest number of characters of the name of an electrode."""

RESERVED_NAMES = (
    *("side_mm", "x_mm", "y_mm", "force_N", "position_std_mm", "force_std", "temperature_C"),
    *("probe", "orientation_deg", "t_us", "t_ms", "t_s", "seq"),
)
"""Names that an electrode cannot have, because they have another meaning in a file or a frame.

The reserved names are keys of the sensor file, columns in tables of presses, or fields of a frame.
"""

MAX_ELECTRODES = 64
"""Largest number of electrodes on a film.

The number is limited because each electrode is compared with all other electrodes.
"""


Corners = tuple[tuple[float, float], ...]
"""Corners (x, y) of a polygon that does not cross itself, anticlockwise, mm. The polygon need not be convex."""


@dataclass(frozen=True)
class Electrode:
    """Electrode that collects charge where its metal on the front of the film overlaps its metal on the back.

    Attributes:
        name: Name of the electrode in the sensor file.
        corners: Corners of the pad, which is the first polygon of metal on the front.
        more: Further polygons of metal on the front, such as traces. Overlapping areas count once.
        back: Polygons of metal on the back; empty if the back is completely covered with metal.
    """

    name: str
    corners: Corners
    more: tuple[Corners, ...] = ()
    back: tuple[Corners, ...] = ()

    def __post_init__(self) -> None:
        """Convert the corners into nested tuples, which can be compared and hashed."""
        for attribute in ("corners", "more", "back"):
            object.__setattr__(self, attribute, _as_tuples(getattr(self, attribute)))  # the dataclass is frozen

    @classmethod
    def of_square(cls, name: str, centre: tuple[float, float], side: float) -> "Electrode":
        """Create a square electrode whose sides are parallel to the axes.

        Args:
            name: Name of the electrode.
            centre: Centre (x, y) of the square, mm.
            side: Length of the sides, mm.

        Returns:
            The electrode. Its first corner is the lower left corner.
        """
        directions = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        corners = np.array(centre) + 0.5 * side * directions
        return cls(name, corners.tolist())

    def with_trace(self, path: Corners, width: float) -> "Electrode":
        """Return a copy of the electrode whose metal on the front includes a trace.

        A trace is a strip of metal with a constant width. The copy contains the outline of the trace as the last
        polygon of `more`.

        Args:
            path: Points (x, y) of the centre line of the trace, mm. Straight lines connect the points.
            width: Width of the trace, mm.

        Raises:
            SensorError: If the path has too few or too many points, if it repeats a point or turns back, or if the
                trace crosses itself.
        """
        where = f"trace of electrode {self.name!r}"  # first words of the error messages
        if not 2 <= len(path) <= MAX_CORNERS // 2:
            raise SensorError(f"{where}: expected 2 to {MAX_CORNERS // 2} points (x, y), got {shown(path)}")
        # The outline has one corner on the right of each point of the path, and then one on the left of each point. The
        # corners are NaN at two successive points that are equal, and at a point at which the path turns back.
        outline = trace_outline(to_complex(np.array(path)), width)
        is_bad_point = np.isnan(outline[: len(path)])
        if is_bad_point.any():
            first = int(is_bad_point.argmax())
            raise SensorError(
                f"{where}: expected a path that neither repeats a point nor turns back, got {path[first]} mm as point "
                f"{first + 1}"
            )
        corners = to_corners(outline)
        if not is_simple(corners):
            raise SensorError(
                f"{where}: expected a path that does not cross itself and whose bends are farther apart than the "
                f"width of {width:g} mm, got {shown(path)} mm"
            )
        return replace(self, more=(*self.more, corners.tolist()))

    @cached_property
    def side(self) -> float | None:
        """Side length of a square electrode with sides parallel to the axes, mm; None for any other electrode.

        The corners of the square must begin at the lower left and follow anticlockwise, as `of_square` creates them.
        The square must be the only metal on the front (no polygons in `more`). The back must be completely covered with
        metal (no polygons in `back`).
        """
        has_other_polygons = self.more or self.back
        if has_other_polygons or len(self.corners) != 4:
            return None

        # Compare the corners with those of a square whose lower side has the same length.
        (lower_left_x, _), (lower_right_x, _), *_upper_corners = self.corners
        side = lower_right_x - lower_left_x
        square = Electrode.of_square(self.name, self.centre, side)
        tolerance = 1e-9 * side  # for rounding errors
        is_square = side > 0.0 and np.allclose(self.corners, square.corners, rtol=0.0, atol=tolerance)
        return side if is_square else None

    @property
    def front(self) -> tuple[Corners, ...]:
        """All polygons of metal on the front: the pad, and further metal such as traces."""
        return (self.corners, *self.more)

    @cached_property
    def collecting_polygons(self) -> tuple[Array, ...]:
        """Non-overlapping polygons that together form the collecting area of the electrode.

        The collecting area consists of one convex polygon, the pad, or of several triangles. The corners (x, y) of a
        polygon are an array of shape (n, 2), mm.

        Raises:
            SensorError: If a polygon crosses itself, or if the number of corners is too small or too large.
        """
        polygons = (*self.front, *self.back)
        for polygon in polygons:
            check_polygon(f"electrode {self.name!r}", polygon)
        count = sum(map(len, polygons))
        if count > MAX_ELECTRODE_CORNERS:
            raise SensorError(
                f"electrode {self.name!r}: expected at most {MAX_ELECTRODE_CORNERS} corners of all polygons, got "
                f"{count}"
            )
        if self._is_convex:  # the pad is convex, and it is the only metal on the front, with a complete back
            return (np.array(self.corners),)

        # Charge is collected where metal on the front overlaps metal on the back. Without polygons on the back, the
        # whole back is metal.
        return tuple(union_triangles(self.front, self.back))

    @property
    def _is_convex(self) -> bool:
        """Whether the pad is convex and the collecting area is the whole pad."""
        return not (self.more or self.back) and is_convex(np.array(self.corners))

    @property
    def area(self) -> float:
        """Size of the collecting area, mm^2."""
        return sum(area_of(polygon) for polygon in self.collecting_polygons)

    @cached_property
    def metal(self) -> tuple[Array, ...]:
        """Convex parts of all metal on the front, including metal that collects no charge.

        A convex pad without further metal is one part. All other metal is divided into triangles. The triangle sides on
        the outline are at most `MAX_PART_SIDE` long. The corners (x, y) of a part are an array of shape (n, 2), mm.
        """
        if replace(self, back=())._is_convex:
            return (np.array(self.corners),)
        return tuple(union_triangles(self.front, max_side=MAX_PART_SIDE))

    @cached_property
    def region(self) -> shapely.Geometry:
        """Region of the film that the metal on the front covers."""
        return region_of(self.front)

    @property
    def centre(self) -> tuple[float, float]:
        """Centre (x, y) of the electrode, mm. The centre is the mean of the corners of the pad."""
        x, y = np.mean(self.corners, axis=0)
        return float(x), float(y)


@dataclass(frozen=True)
class Calibration:
    """Measured gains and positions of the electrodes of a real film.

    Attributes:
        gain: Gain of each electrode by its name. The gain is the charge that is read, divided by the charge that is
            collected. An electrode without an entry has the gain 1.
        shift: Displacement (x, y) of the electrodes from their nominal positions in the layout, mm.
        rotation: Rotation of the electrodes about the centre of the film, anticlockwise, rad. The rotation is applied
            before the shift.
        crosstalk: Fraction of the charge of each electrode that is added to the charges of all other electrodes,
            dimensionless.
    """

    gain: dict[str, float] = field(default_factory=dict)
    shift: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    crosstalk: float = 0.0

    def read(self, charge: Array) -> Array:
        """Add the crosstalk to the charges of the electrodes.

        Args:
            charge: Charges without crosstalk, shape (..., n_electrode), pC.

        Returns:
            Charges with crosstalk, of the same shape, pC.
        """
        charge_of_others = charge.sum(axis=-1, keepdims=True) - charge
        return np.asarray(charge + self.crosstalk * charge_of_others)

    def place(self, points: Array) -> Array:
        """Convert nominal positions in the layout into calibrated positions on the real film.

        Args:
            points: Nominal positions (x, y), shape (..., 2), mm.

        Returns:
            Calibrated positions (x, y), of the same shape, mm.
        """
        rotated_points = to_complex(points) * cmath.rect(1.0, self.rotation)
        return to_corners(rotated_points + complex(*self.shift))


@dataclass(frozen=True)
class Sensor:
    """Description of a film with electrodes, including the readout and the calibration of the electrodes.

    The module `sensor_file` reads and writes the files that describe sensors.

    Attributes:
        name: Name of the sensor.
        film: Film. Its stiffness does not include the metal of the electrodes.
        piezo: Piezoelectric coefficients of the film.
        electrodes: Electrodes, in the order of the charges.
        readout: "area" if the stress is averaged over the area of an electrode, "edge" if it is averaged over its
            edges.
        surface: Surface at which the stress is read: "middle", "top" or "bottom" of the film.
        calibration: Gains and electrode positions that were measured on a real film.
    """

    name: str
    film: Film
    piezo: Piezo
    electrodes: tuple[Electrode, ...]
    readout: Readout = "area"
    surface: Surface = "middle"
    calibration: Calibration = field(default_factory=Calibration)

    def __post_init__(self) -> None:
        """Check the names, the gains and the positions of the electrodes.

        Raises:
            SensorError: If a value is not allowed, or if an electrode overlaps another electrode or the rim.
        """
        # A list of electrodes becomes a tuple, which can be compared and hashed. The dataclass is frozen.
        object.__setattr__(self, "electrodes", _as_tuples(self.electrodes))

        # Check the readout and the surface, the names of the electrodes, and the calibration.
        for value, options in ((self.readout, get_args(Readout)), (self.surface, get_args(Surface))):
            if value not in options:
                raise SensorError(f"expected one of {options}, got {value!r}")
        names = self.electrode_names
        gains = self.calibration.gain
        has_duplicates = len(set(names)) < len(names)
        if has_duplicates or not 1 <= len(names) <= MAX_ELECTRODES:
            raise SensorError(
                f"electrodes: expected 1 to {MAX_ELECTRODES} different names, got {len(names)}: {cut(str(names))}"
            )
        for name in names:
            _check_name(name)
        if not all(np.isfinite(gain) and gain > 0.0 for gain in gains.values()):
            raise SensorError(f"calibration gain: expected positive numbers, got {shown(gains)}")
        limits = (-MAX_CROSSTALK, MAX_CROSSTALK)
        check_range("calibration crosstalk", self.calibration.crosstalk, limits, "", SensorError)
        unknown_names = sorted(set(gains) - set(names))
        if unknown_names:
            raise SensorError(f"calibration gain: no electrode named {shown(unknown_names)}, have {cut(str(names))}")

        # Check the shapes and positions of the electrodes.
        _check_layout(self.electrodes)
        for electrode in self.electrodes:
            _check_on_film(electrode, self.film, self.calibration)
            if self.readout == "edge" and electrode.side is None:
                raise SensorError(f"readout 'edge' needs square electrodes, but {electrode.name!r} is a polygon")

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Names of the electrodes, in the order of the charges."""
        return tuple(electrode.name for electrode in self.electrodes)

    @property
    def gains(self) -> Array:
        """Calibrated gain of each electrode, shape (n_electrode,), dimensionless."""
        return np.array([self.calibration.gain.get(name, 1.0) for name in self.electrode_names])


def electrode_index(sensor: Sensor, name: str) -> int:
    """Return the index of an electrode in the order of the charges.

    Args:
        sensor: Sensor with the electrode.
        name: Name of the electrode.

    Raises:
        SensorError: If the sensor has no electrode with this name.
    """
    if name not in sensor.electrode_names:
        raise SensorError(f"no electrode {name!r} on {sensor.name}: it has {', '.join(sensor.electrode_names)}")
    return sensor.electrode_names.index(name)


def outermost_corner(sensor: Sensor, polygons: Sequence[ArrayLike]) -> float:
    """Return the distance from the centre of the film to the outermost corner of several polygons, mm.

    The polygons are first moved from their nominal positions to their calibrated positions on the real film.

    Args:
        sensor: Sensor with the calibrated positions.
        polygons: Corners (x, y) of each polygon at their nominal positions, each of shape (n, 2), mm.
    """
    corners = sensor.calibration.place(np.concatenate(polygons))
    return float(np.linalg.norm(corners, axis=1).max())


def _as_tuples(value: Any) -> Any:
    """Convert nested lists and arrays into nested tuples, which can be compared and hashed.

    All other values are returned unchanged.
    """
    if isinstance(value, list | tuple | np.ndarray):
        return tuple(_as_tuples(item) for item in value)
    return value


def _check_name(name: str) -> None:
    """Raise an error if the name of an electrode cannot be the header of a column in a table of charges.

    Args:
        name: Name of the electrode.

    Raises:
        SensorError: If the name is empty, too long or reserved, if it contains a comma or unprintable characters, or if
            it begins or ends with a blank.
    """
    has_valid_length = 0 < len(name) <= MAX_NAME_LENGTH
    has_valid_characters = is_printable(name) and "," not in name and name == name.strip()
    if not (has_valid_length and has_valid_characters):
        raise SensorError(
            f"electrode {shown(name)}: expected a name of 1 to {MAX_NAME_LENGTH} printable characters, without commas "
            "and without blanks at its ends, because it is the header of a column in CSV files"
        )
    if name in RESERVED_NAMES:
        raise SensorError(
            f"electrode {name!r}: this name is reserved for another column in files of charges; choose another one"
        )


@lru_cache(maxsize=64)
def _check_layout(electrodes: tuple[Electrode, ...]) -> None:
    """Raise an error if a layout of electrodes is invalid for every film.

    The result is cached, because many films have the same layout.

    Args:
        electrodes: Electrodes of the layout.

    Raises:
        SensorError: If a polygon crosses itself, if an electrode is too small or collects no charge, or if two
            electrodes overlap.
    """
    for electrode in electrodes:
        name = f"electrode {electrode.name!r}"
        if not electrode.collecting_polygons:  # this property also checks that no polygon crosses itself
            raise SensorError(f"{name}: its front and its back have no area in common, so nothing collects; move one")
        corners = np.array(electrode.corners)
        check_range(name, float(np.ptp(corners, axis=0).max()), (MIN_EXTENT, np.inf), "mm", SensorError)
    for first, second in combinations(electrodes, 2):
        # Because of rounding errors, electrodes that only touch share a narrow strip along their outlines. The strip is
        # at most as long as the shorter perimeter.
        touching_area = MERGE_DISTANCE * min(first.region.length, second.region.length)
        if shapely.intersection(first.region, second.region).area > touching_area:
            raise SensorError(f"electrodes {first.name!r} and {second.name!r} overlap; move one of them")


def _check_on_film(electrode: Electrode, film: Film, calibration: Calibration) -> None:
    """Raise an error if an electrode does not lie completely on a film.

    Args:
        electrode: Electrode at its nominal position.
        film: Film on which the electrode must lie.
        calibration: Shift and rotation of the electrodes on the film.

    Raises:
        SensorError: If a part of the electrode lies on or beyond the rim.
    """
    placed_corners = calibration.place(np.concatenate(electrode.collecting_polygons))  # shape (n, 2), mm
    relative_distance = film.relative_distance(to_complex(placed_corners))  # 1 on the rim
    if not (relative_distance < 1.0).all():
        x, y = placed_corners[np.argmax(relative_distance)]
        hint = "; end its traces before the rim" if electrode.more else ""  # further polygons, mostly traces
        raise SensorError(
            f"electrode {electrode.name!r} lies outside the film: corner ({x:.6g}, {y:.6g}) mm, film radius "
            f"{film.rim_distance(np.arctan2(y, x)):.6g} mm{hint}"
        )


def check_polygon(where: str, polygon: Corners) -> None:
    """Raise an error unless a polygon has finite corners in anticlockwise order and does not cross itself.

    Args:
        where: First words of the error message, which name the polygon.
        polygon: Corners (x, y) of the polygon, mm.

    Raises:
        SensorError: If the polygon crosses itself, is clockwise, has too few or too many corners, or has a coordinate
            that is not finite.
    """
    corners = np.array(polygon)
    if corners.shape[1:] != (2,) or not 3 <= len(corners) <= MAX_CORNERS:
        raise SensorError(f"{where}: expected 3 to {MAX_CORNERS} corners (x, y), got {shown(corners.tolist())}")
    # The function `is_simple` returns False if the polygon crosses itself, or if its corners are clockwise.
    if not (np.isfinite(corners).all() and is_simple(corners)):
        raise SensorError(
            f"{where}: expected a polygon that does not cross itself, with its corners anticlockwise, got "
            f"{shown(corners.tolist())} mm"
        )
