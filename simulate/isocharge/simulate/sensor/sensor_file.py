"""The sensor file: TOML with units in its keys, to and from `Sensor`. Unknown keys are errors, and missing ones too."""

import logging
from collections.abc import Iterable, Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, field

from isocharge.common.errors import SensorError, error_prefix
from isocharge.common.files import refuse_existing, write_whole
from isocharge.common.structs import (
    Finite,
    NotNegative,
    Positive,
    Settings,
    Text,
    WrongKey,
    convert,
    parse_toml,
    read_toml,
)
from isocharge.common.toml_text import to_toml
from isocharge.simulate.sensor.film import Film, Piezo, Surface
from isocharge.simulate.sensor.sensor import Calibration, Corners, Electrode, Readout, Sensor
from isocharge.simulate.sensor.size_check import tidy

FARTHEST_MM = 1e6
"""Largest coordinate of a point, mm."""

log = logging.getLogger(__name__)

SIDE, COATING = "side_mm", "coating_N_per_mm"
"""Keys of the squares' side and of the stiffness of metal or ink, among the names of the electrodes."""

Coordinate = Annotated[float, Meta(ge=-FARTHEST_MM, le=FARTHEST_MM)]
Point = Annotated[tuple[Coordinate, Coordinate], Meta(description=f"[x, y] in mm, each at most {FARTHEST_MM:g}")]


class FilmTable(Settings, frozen=True):
    """The section `film`."""

    radius_mm: Annotated[float, Meta(gt=0.0, le=FARTHEST_MM)]
    thickness_um: Positive
    young_GPa: Positive | Annotated[list[Positive], Meta(min_length=2, max_length=2)]
    poisson: Finite
    pretension_MPa: Finite | Annotated[list[Finite], Meta(min_length=3, max_length=3)] = 0.0
    shear_GPa: Positive | None = None
    axis_deg: Finite = 0.0
    oval: Finite = 0.0
    oval_axis_deg: Finite = 0.0


class PiezoTable(Settings, frozen=True):
    """The section `piezo`: coefficients in pC/N."""

    d31: Finite
    d32: Finite
    d33: Finite = 0.0
    pyro_uC_per_m2_K: Finite = 0.0
    d12: Finite = 0.0


class PolygonTable(Settings, frozen=True):
    """An electrode that is no square: its pad, further polygons and a trace on the front, polygons on the back."""

    polygon_mm: tuple[Point, ...]
    more_mm: tuple[tuple[Point, ...], ...] = ()
    trace_mm: tuple[Point, ...] = ()
    width_mm: NotNegative = 0.0
    back_mm: tuple[tuple[Point, ...], ...] = ()


class CalibrationTable(Settings, frozen=True):
    """The section `calibration`."""

    gain: dict[str, Positive] = field(default_factory=dict)
    shift_mm: Point = (0.0, 0.0)
    rotation_deg: Finite = 0.0
    crosstalk: Finite = 0.0


class SensorTable(Settings, frozen=True):
    """A sensor file; `electrodes` has places of squares and polygons by name, the squares' side and the coating."""

    name: Text
    film: FilmTable
    piezo: PiezoTable
    electrodes: dict[str, float | Point | PolygonTable]
    readout: Readout = "area"
    surface: Surface = "middle"
    calibration: CalibrationTable = CalibrationTable()

    def __post_init__(self) -> None:
        for name, value in self.electrodes.items():
            if name not in (SIDE, COATING) and isinstance(value, float):
                raise WrongKey(f"electrodes.{name}", "[x, y] in mm or a table", value)
            if isinstance(value, PolygonTable) and bool(value.trace_mm) != (value.width_mm > 0.0):
                missing = "width_mm" if value.trace_mm else "trace_mm"
                raise WrongKey(f"electrodes.{name}.{missing}", "trace_mm and a width_mm above 0 together")
        coating = self.electrodes.get(COATING, 0.0)
        if not (isinstance(coating, float) and 0.0 <= coating <= FARTHEST_MM):
            raise WrongKey(f"electrodes.{COATING}", f"a number from 0 to {FARTHEST_MM:g}", coating)
        side = self.electrodes.get(SIDE)
        if side is not None and not (isinstance(side, float) and 0.0 < side <= FARTHEST_MM):
            raise WrongKey(f"electrodes.{SIDE}", f"a number above 0 and at most {FARTHEST_MM:g}", side)
        if side is None and any(isinstance(value, tuple) for value in self.electrodes.values()):
            raise WrongKey(f"electrodes.{SIDE}")


def built_in_sensors() -> tuple[str, ...]:
    """Names of the sensors that come with the package."""
    folder = resources.files("isocharge.simulate") / "sensors"
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def load_sensor(sensor: str | Path) -> Sensor:
    """Read a sensor; of one with a single electrode, a warning is logged.

    Args:
        sensor: A built-in name such as "three-25um-biaxial", or the path of a TOML file.

    Raises:
        SensorError: If there is no such sensor or its file is wrong; the message names file and key.
    """
    if str(sensor) in built_in_sensors():
        text = (resources.files("isocharge.simulate") / "sensors" / f"{sensor}.toml").read_text("utf-8")
        return sensor_from_dict(parse_toml(text, str(sensor), SensorError, dict[str, Any]), str(sensor))
    path = Path(sensor)
    if not path.is_file():
        names = ", ".join(built_in_sensors())
        raise SensorError(f"no sensor {str(sensor)!r}: it is neither a built-in name ({names}) nor a file")
    described = sensor_from_dict(read_toml(path, "a sensor file", SensorError, dict[str, Any]), str(path))
    if len(described.electrodes) == 1:
        log.warning(
            "%s: one electrode: its charge can be computed, but one charge does not determine x, y and force; three "
            "electrodes or more do",
            path,
        )
    return described


def sensor_from_dict(table: Mapping[str, Any], where: str = "sensor") -> Sensor:
    """Build a sensor from the tables of its file (units in the keys); `where` opens the error messages."""
    file = convert(table, SensorTable, where, SensorError)
    piezo, calibration, coating = file.piezo, file.calibration, file.electrodes.get(COATING)
    with error_prefix(f"{where}: ", SensorError):
        return Sensor(
            name=file.name,
            film=_film(file.film),
            piezo=Piezo(piezo.d31, piezo.d32, piezo.d33, piezo.pyro_uC_per_m2_K, piezo.d12),
            electrodes=tuple(_electrodes(file.electrodes)),
            coating=coating if isinstance(coating, float) else 0.0,
            readout=file.readout,
            surface=file.surface,
            calibration=Calibration(
                calibration.gain,
                calibration.shift_mm,
                float(np.deg2rad(calibration.rotation_deg)),
                calibration.crosstalk,
            ),
        )


def sensor_to_dict(sensor: Sensor) -> dict[str, Any]:
    """The tables of a sensor's file, ready for JSON: `sensor_from_dict` gives the sensor back to round-off."""
    piezo, calibration = sensor.piezo, sensor.calibration
    return {
        "name": sensor.name,
        "readout": sensor.readout,
        "surface": sensor.surface,
        "film": film_to_dict(sensor.film),
        "piezo": {
            "d31": tidy(piezo.d31),
            "d32": tidy(piezo.d32),
            "d33": tidy(piezo.d33),
            "pyro_uC_per_m2_K": tidy(piezo.pyro),
            **({"d12": tidy(piezo.d12)} if piezo.d12 else {}),
        },
        "electrodes": _electrode_tables(sensor),
        "calibration": {
            "gain": dict(calibration.gain),
            "shift_mm": [tidy(value) for value in calibration.shift],
            "rotation_deg": tidy(float(np.rad2deg(calibration.rotation))),
            **({"crosstalk": tidy(calibration.crosstalk)} if calibration.crosstalk else {}),
        },
    }


def film_to_dict(film: Film) -> dict[str, Any]:
    """The table of a film in the sensor file."""
    (difference, shear), ratio, mean = film.deviator, np.sqrt(film.young_ratio), film.pretension
    tension = [tidy(value) for value in (mean + difference, mean - difference, shear)]
    both = [tidy(film.young * 1e-3 * ratio), tidy(film.young * 1e-3 / ratio)]
    around = {
        "shear_GPa": None if film.shear is None else tidy(film.shear * 1e-3),
        "axis_deg": tidy(float(np.rad2deg(film.axis))),
        "oval": tidy(film.oval),
        "oval_axis_deg": tidy(float(np.rad2deg(film.oval_axis))),
    }
    return {
        "radius_mm": tidy(film.radius),
        "thickness_um": tidy(film.thickness * 1e3),
        "young_GPa": tidy(film.young * 1e-3) if film.young_ratio == 1.0 else both,
        "poisson": film.poisson,
        "pretension_MPa": tension if any(film.deviator) else tidy(mean),
        **{name: value for name, value in around.items() if value},
    }


def sensor_to_toml(sensor: Sensor, comment: Iterable[str] = ()) -> str:
    """The text of a sensor's file, from which `load_sensor` gives the sensor back to round-off.

    Args:
        sensor: The sensor.
        comment: Lines for the head of the file, without #.

    Raises:
        SensorError: If no file can hold this sensor: squares of several sides with the edge readout, an empty name.
    """
    text = to_toml(sensor_to_dict(sensor), comment)
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise SensorError(f"sensor {sensor.name!r}: a name is no text that UTF-8 can hold ({error})") from error
    where = f"sensor {sensor.name!r}"
    sensor_from_dict(parse_toml(text, where, SensorError, dict[str, Any]), where)
    return text


def write_sensor(sensor: Sensor, path: Path, comment: Iterable[str] = ()) -> None:
    """Write a sensor's file, as `sensor_to_toml`; it appears whole or not at all.

    Raises:
        SensorError: As `sensor_to_toml`.
        OutputExists: If there is something at `path` already.
    """
    refuse_existing(path)
    write_whole(path, sensor_to_toml(sensor, comment).encode())


def _electrode_tables(sensor: Sensor) -> dict[str, Any]:
    """Squares share one side in the file; those of another side than the first are written as polygons."""
    sides = {e.name: tidy(e.corners[1][0] - e.corners[0][0]) for e in sensor.electrodes if e.square}
    if sensor.readout == "edge" and len(set(sides.values())) > 1:
        raise SensorError(
            f"readout 'edge' needs squares, and in a sensor file all squares have one side: got {sides} mm"
        )
    shared = next(iter(sides.values()), None)
    tables: dict[str, Any] = {} if shared is None else {SIDE: shared}
    if sensor.coating:
        tables[COATING] = tidy(sensor.coating)
    for electrode in sensor.electrodes:
        if sides.get(electrode.name) == shared is not None:
            tables[electrode.name] = [tidy(value) for value in electrode.centre]
        else:
            more = {"more_mm": electrode.more, "back_mm": electrode.back}
            tables[electrode.name] = {
                "polygon_mm": _corners(electrode.corners),
                **{key: [_corners(polygon) for polygon in polygons] for key, polygons in more.items() if polygons},
            }
    return tables


def _corners(polygon: Corners) -> list[list[float]]:
    return [[tidy(value) for value in corner] for corner in polygon]


def _film(table: FilmTable) -> Film:
    young, tension = table.young_GPa, table.pretension_MPa
    first, second = young if isinstance(young, list) else (young, young)
    along, across, shear = tension if isinstance(tension, list) else (tension, tension, 0.0)
    return Film(
        radius=table.radius_mm,
        thickness=table.thickness_um * 1e-3,
        young=first * 1e3 if first == second else float(np.sqrt(first * second)) * 1e3,
        poisson=table.poisson,
        pretension=along if along == across else 0.5 * (along + across),
        deviator=(0.5 * (along - across), shear),
        young_ratio=first / second,
        shear=None if table.shear_GPa is None else table.shear_GPa * 1e3,
        axis=float(np.deg2rad(table.axis_deg)),
        oval=table.oval,
        oval_axis=float(np.deg2rad(table.oval_axis_deg)),
    )


def _electrodes(table: Mapping[str, float | Point | PolygonTable]) -> Iterator[Electrode]:
    side = table.get(SIDE)
    for name, value in table.items():
        if isinstance(value, PolygonTable):
            electrode = Electrode(name, value.polygon_mm, more=value.more_mm, back=value.back_mm)
            yield electrode.with_trace(value.trace_mm, value.width_mm) if value.trace_mm else electrode
        elif isinstance(value, tuple) and isinstance(side, float):
            yield Electrode.of_square(name, value, side)
