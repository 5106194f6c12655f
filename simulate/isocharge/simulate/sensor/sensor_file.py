"""Reader and writer of sensor files.

A sensor file is a TOML file whose keys contain the units of the values. Unknown keys and missing keys are errors.
"""

import logging
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import shapely
from msgspec import Meta, field

from isocharge.common.errors import SensorError, error_context
from isocharge.common.files import StrPath, new_file
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
from isocharge.simulate.sensor.film import ALUMINIUM_EXPANSION, FILM_NUMBERS, Film, Piezo, Surface, tidy
from isocharge.simulate.sensor.sensor import Calibration, Electrode, Readout, Sensor

MAX_COORDINATE_mm = 1e6
"""Largest accepted magnitude of a coordinate or a length in a sensor file, mm."""

BUILT_IN_FOLDER = Path(__file__).parents[1] / "sensors"
"""Folder of the sensor files that are part of the package."""

log = logging.getLogger(__name__)

SIDE = "side_mm"
"""Key in the section `electrodes` for the side length of all square electrodes."""

Coordinate = Annotated[float, Meta(ge=-MAX_COORDINATE_mm, le=MAX_COORDINATE_mm)]
Point = Annotated[tuple[Coordinate, Coordinate], Meta(description=f"[x, y] in mm, each at most {MAX_COORDINATE_mm:g}")]

Length = Annotated[float, Meta(gt=0.0, le=MAX_COORDINATE_mm)]

Pair = Meta(min_length=2, max_length=2, description="a list of two")
Triple = Meta(min_length=3, max_length=3, description="a list of three")


class FilmTable(Settings, frozen=True):
    """Content of the section `film` of a sensor file, with the mechanical properties of the film."""

    radius_mm: Length
    thickness_um: Length
    young_GPa: Positive | Annotated[list[Positive], Pair]
    poisson: Finite
    pretension_MPa: Finite | Annotated[list[Finite], Triple] = 0.0
    shear_GPa: Positive | None = None
    axis_deg: Finite = 0.0
    oval: Finite = 0.0
    oval_axis_deg: Finite = 0.0
    back_volume_mm3: Positive | None = None
    static_pressure_Pa: Finite = 0.0
    expansion_ppm_per_K: Finite | Annotated[list[Finite], Pair] | None = None
    ring_expansion_ppm_per_K: Finite = 1e6 * ALUMINIUM_EXPANSION


class PiezoTable(Settings, frozen=True):
    """Content of the section `piezo` of a sensor file, in the order of the attributes of `Piezo`.

    The piezoelectric coefficients are in pC/N.
    """

    d31: Finite
    d32: Finite
    d33: Finite = 0.0
    pyro_uC_per_m2_K: Finite = 0.0
    d12: Finite = 0.0


class PolygonTable(Settings, frozen=True):
    """Section of a sensor file that describes an electrode that is not a square.

    The electrode has a pad on the front of the film. The electrode may have further polygons and a trace on the front,
    and polygons on the back.
    """

    polygon_mm: tuple[Point, ...]
    more_mm: tuple[tuple[Point, ...], ...] = ()
    trace_mm: tuple[Point, ...] = ()
    width_mm: NotNegative = 0.0
    back_mm: tuple[tuple[Point, ...], ...] = ()


class CalibrationTable(Settings, frozen=True):
    """Content of the section `calibration` of a sensor file, with the gains and positions of the electrodes."""

    gain: dict[str, Positive] = field(default_factory=dict)
    shift_mm: Point = (0.0, 0.0)
    rotation_deg: Finite = 0.0
    crosstalk: Finite = 0.0


class SensorTable(Settings, frozen=True):
    """Content of a sensor file.

    In the section `electrodes`, the keys are the names of the electrodes. The value of a square electrode is its
    centre, and the value of every other electrode is a table of polygons. The section may also contain the side of the
    squares.
    """

    name: Text
    film: FilmTable
    piezo: PiezoTable
    electrodes: dict[str, float | Point | PolygonTable]
    readout: Readout = "area"
    surface: Surface = "middle"
    calibration: CalibrationTable = CalibrationTable()

    def __post_init__(self) -> None:
        """Check the section `electrodes`.

        Most keys of the section `electrodes` are the names of the electrodes. The value of a square electrode is its
        centre, a tuple (x, y). The value of any other electrode is a PolygonTable. The value of the key `SIDE` is the
        side of all squares, a float.

        Raises:
            WrongKey: If a value is not allowed, or if a key is missing.
        """
        for name, value in self.electrodes.items():
            if name != SIDE and isinstance(value, float):
                raise WrongKey(f"electrodes.{name}", "[x, y] in mm or a table", value)
            if isinstance(value, PolygonTable):  # a trace needs a width, and a width needs a trace
                has_trace = bool(value.trace_mm)
                has_width = value.width_mm > 0.0
                if has_trace != has_width:
                    missing = "width_mm" if has_trace else "trace_mm"
                    raise WrongKey(f"electrodes.{name}.{missing}", "trace_mm and a width_mm above 0 together")

        # The side must be a positive number. Only squares, whose value is their centre (x, y), need it.
        side = self.electrodes.get(SIDE)
        has_squares = any(isinstance(value, tuple) for value in self.electrodes.values())
        if side is None and has_squares:
            raise WrongKey(f"electrodes.{SIDE}")
        if side is not None and not (isinstance(side, float) and 0.0 < side <= MAX_COORDINATE_mm):
            raise WrongKey(f"electrodes.{SIDE}", f"a number above 0 and at most {MAX_COORDINATE_mm:g}", side)


def built_in_sensors() -> tuple[str, ...]:
    """Return the names of the sensors whose files are part of the package."""
    return tuple(sorted(path.stem for path in BUILT_IN_FOLDER.glob("*.toml")))


def load_sensor(sensor: StrPath) -> Sensor:
    """Read the file of a built-in sensor or a sensor file of the user, and return the sensor.

    A warning is logged if the file describes only one electrode, or an electrode with parts that do not touch each
    other.

    Args:
        sensor: Name of a built-in sensor such as "three-25um-biaxial", or path of a TOML file.

    Returns:
        The sensor that the file describes.

    Raises:
        SensorError: If the sensor does not exist, or if its file is invalid. The message names the file and the key.
    """
    names = built_in_sensors()
    path = BUILT_IN_FOLDER / f"{sensor}.toml" if str(sensor) in names else Path(sensor)
    if not path.is_file():
        raise SensorError(f"no sensor {str(sensor)!r}: it is neither a built-in name ({', '.join(names)}) nor a file")
    loaded_sensor = sensor_from_dict(read_toml(path, "a sensor file", SensorError, dict[str, Any]), str(path))
    if len(loaded_sensor.electrodes) == 1:
        log.warning(
            "%s: one electrode: its charge can be computed, but one charge does not determine x, y and force; three "
            "electrodes or more do",
            path,
        )
    for electrode in loaded_sensor.electrodes:
        # The metal is widened by 1 um, because parts that touch often have rounded coordinates.
        part_count = shapely.get_num_geometries(shapely.buffer(electrode.region, 1e-3))
        if part_count > 1:
            log.warning(
                "%s: electrode %r: its metal on the front consists of %d parts that do not touch, whose charges are "
                "added; if no wire connects them, check polygon_mm, trace_mm and more_mm",
                path,
                electrode.name,
                part_count,
            )
    return loaded_sensor


def sensor_from_dict(table: Mapping[str, Any], where: str = "sensor") -> Sensor:
    """Create a sensor from the tables of its file.

    Args:
        table: Tables of the file. The keys contain the units of the values.
        where: First words of the error messages, such as the path of the file.

    Raises:
        SensorError: If a key or a value is invalid.
    """
    file = convert(table, SensorTable, where, SensorError)
    calibration = file.calibration
    with error_context(SensorError, f"{where}: "):
        return Sensor(
            name=file.name,
            film=_film(file.film),
            piezo=Piezo(*msgspec.structs.astuple(file.piezo)),
            electrodes=tuple(_electrodes(file.electrodes)),
            readout=file.readout,
            surface=file.surface,
            calibration=Calibration(
                calibration.gain,
                calibration.shift_mm,
                math.radians(calibration.rotation_deg),
                calibration.crosstalk,
            ),
        )


def sensor_to_dict(sensor: Sensor) -> dict[str, Any]:
    """Convert a sensor into the tables of a sensor file. The tables can be written as JSON or TOML.

    The function `sensor_from_dict` converts the tables back into the same sensor, except for rounding errors.

    Args:
        sensor: Sensor to be converted.

    Raises:
        SensorError: If a sensor file cannot describe the sensor.
    """
    calibration = sensor.calibration
    return {
        "name": sensor.name,
        "readout": sensor.readout,
        "surface": sensor.surface,
        "film": film_to_dict(sensor.film),
        "piezo": {
            key: tidy(coefficient)
            for key, coefficient in zip(PiezoTable.__struct_fields__, vars(sensor.piezo).values(), strict=True)
            if key != "d12" or coefficient  # without a d12 of zero
        },
        "electrodes": _electrode_tables(sensor),
        "calibration": {
            "gain": dict(calibration.gain),
            "shift_mm": _tidy_all(calibration.shift),
            "rotation_deg": tidy(math.degrees(calibration.rotation)),
            **({"crosstalk": tidy(calibration.crosstalk)} if calibration.crosstalk else {}),
        },
    }


def film_to_dict(film: Film) -> dict[str, Any]:
    """Convert a film into the section `film` of a sensor file.

    This function is the inverse of `_film`. Young's modulus is a single number if it does not depend on the direction,
    and a list if it does. The same applies to the pretension. Optional keys whose values are the defaults are omitted.

    Args:
        film: Film to be converted.
    """
    values = dict(vars(film))
    if any(film.deviator):
        half_difference, shear_tension = film.deviator
        values["pretension"] = (film.pretension + half_difference, film.pretension - half_difference, shear_tension)
    if film.young_ratio != 1.0:
        # If E is the geometric mean of the moduli and r^2 = E1 / E2, the moduli are E1 = E r and E2 = E / r.
        root_of_ratio = math.sqrt(film.young_ratio)
        values["young"] = (film.young * root_of_ratio, film.young / root_of_ratio)

    # Convert all values into the units of the file: `number.factor` is the unit of `Film` divided by the unit of the
    # file. The function `_tidy_all` removes the rounding errors of the conversion.
    table = {
        number.key: _tidy_all(np.multiply(values[attribute], number.factor).tolist())
        for attribute, number in FILM_NUMBERS.items()
        if values[attribute] is not None
    }

    # Return the keys in the order of `FilmTable`, without those whose value is the default.
    defaults = {field.name: field.default for field in msgspec.structs.fields(FilmTable)}
    defaults["pretension_MPa"] = None  # the pretension is always written
    return {key: table[key] for key in defaults if key in table and table[key] != defaults[key]}


def sensor_to_toml(sensor: Sensor, comment: Iterable[str] = ()) -> str:
    """Convert a sensor into the text of a sensor file.

    If `load_sensor` reads a file with this text, the result is the same sensor, except for rounding errors.

    Args:
        sensor: Sensor to be converted.
        comment: Comment lines at the beginning of the text, without "#".

    Raises:
        SensorError: If a sensor file cannot describe the sensor, for example because its name is empty.
    """
    text = to_toml(sensor_to_dict(sensor), comment)
    try:
        data = text.encode()
    except UnicodeEncodeError as error:
        raise SensorError(f"sensor {sensor.name!r}: a name cannot be encoded in UTF-8 ({error})") from error

    # Parse the text, which raises an error if the file would not be valid.
    where = f"sensor {sensor.name!r}"
    sensor_from_dict(parse_toml(data, where, SensorError, dict[str, Any]), where)
    return text


def write_sensor(sensor: Sensor, path: StrPath, comment: Iterable[str] = ()) -> None:
    """Write a sensor file. If an error occurs, no file is written.

    Args:
        sensor: Sensor that the file describes.
        path: Path of the new file.
        comment: Comment lines at the beginning of the file, without "#".

    Raises:
        SensorError: If a sensor file cannot describe the sensor.
        OutputExists: If `path` exists.
        OutputError: If the file cannot be written.
    """
    with new_file(Path(path)) as draft:
        draft.write_text(sensor_to_toml(sensor, comment), "utf-8")


def _electrode_tables(sensor: Sensor) -> dict[str, Any]:
    """Convert the electrodes of a sensor into the section `electrodes` of a sensor file.

    In a sensor file, all squares have the same side length. A square that is larger or smaller than the first square is
    therefore described as a polygon.

    Args:
        sensor: Sensor with the electrodes.

    Raises:
        SensorError: If the readout requires squares, and the sides of the squares differ.
    """
    sides = {electrode.name: tidy(electrode.side) for electrode in sensor.electrodes if electrode.side is not None}
    if sensor.readout == "edge" and len(set(sides.values())) > 1:
        raise SensorError(
            f"readout 'edge' needs squares, and in a sensor file all squares have one side: got {sides} mm"
        )
    tables: dict[str, Any] = {}  # the key `SIDE` cannot be the name of an electrode
    if sides:
        tables[SIDE] = next(iter(sides.values()))  # side of the first square
    for electrode in sensor.electrodes:
        if electrode.name in sides and sides[electrode.name] == tables[SIDE]:
            tables[electrode.name] = _tidy_all(electrode.centre)
        else:
            further_polygons = {"more_mm": electrode.more, "back_mm": electrode.back}
            tables[electrode.name] = {
                "polygon_mm": _tidy_all(electrode.corners),
                **{key: _tidy_all(polygons) for key, polygons in further_polygons.items() if polygons},
            }
    return tables


def _tidy_all(values: Any) -> Any:
    """Round a number or all numbers in a nested tuple or list, and convert all tuples into lists."""
    if isinstance(values, tuple | list):
        return [_tidy_all(value) for value in values]
    return tidy(values)


def _film(table: FilmTable) -> Film:
    """Create a film from the section `film` of a sensor file.

    The section contains either one Young's modulus or the moduli (E1, E2). The section contains either one pretension
    or the components (T11, T22, T12).

    Args:
        table: Content of the section.

    Raises:
        SensorError: If a property is outside its accepted range.
    """
    # Replace Young's moduli along both axes by their geometric mean. The mean of equal values has no rounding error.
    values = msgspec.structs.asdict(table)
    young_1, young_2 = _along_axes(table.young_GPa)
    values["young_GPa"] = math.sqrt(young_1 * young_2)

    # Replace the components of the pretension by the mean of the components along x and y.
    tension = table.pretension_MPa
    tension_11, tension_22, tension_12 = tension if isinstance(tension, list) else (tension, tension, 0.0)
    values["pretension_MPa"] = 0.5 * (tension_11 + tension_22)
    deviator = (0.5 * (tension_11 - tension_22), tension_12)

    # Convert all numbers into the units of `Film`. An attribute of `Film` times `number.factor` is the number in the
    # file. Optional properties that the file omits are None. The thermal expansion, which may be a list, follows below.
    numbers = {
        attribute: values[number.key] / number.factor
        for attribute, number in FILM_NUMBERS.items()
        if isinstance(values.get(number.key), float)
    }
    if table.expansion_ppm_per_K is not None:
        along, across = _along_axes(table.expansion_ppm_per_K)
        numbers["expansion"] = (along / 1e6, across / 1e6)
    return Film(**numbers, deviator=deviator, young_ratio=young_1 / young_2)


def _along_axes(value: float | list[float]) -> list[float]:
    """Return the components of a property along both axes of the film.

    Both components are equal if the file contains only one number.

    Args:
        value: Value in the file: one number, or a list of both components.
    """
    return value if isinstance(value, list) else [value, value]


def _electrodes(section: Mapping[str, float | Point | PolygonTable]) -> Iterator[Electrode]:
    """Yield the electrodes that the section `electrodes` of a sensor file describes, one after the other.

    A value of the section is a PolygonTable, the centre (x, y) of a square, or the side of all squares, which belongs
    to the key `SIDE`. A PolygonTable contains the pad on the front, and optionally further polygons on the front
    (`more_mm`), polygons on the back (`back_mm`), and the centre line and the width of a trace.

    Args:
        section: Content of the section `electrodes`. If it contains squares, it also contains their side.
    """
    side = section.get(SIDE)  # side of all squares, mm; None without squares
    for name, value in section.items():  # the value of SIDE is a number and yields no electrode
        if isinstance(value, PolygonTable):
            electrode = Electrode(name, value.polygon_mm, more=value.more_mm, back=value.back_mm)
            if value.trace_mm:
                electrode = electrode.with_trace(value.trace_mm, value.width_mm)
            yield electrode
        elif isinstance(value, tuple) and isinstance(side, float):
            yield Electrode.of_square(name, value, side)
