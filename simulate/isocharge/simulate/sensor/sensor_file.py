"""Reader and writer of sensor files. The files are TOML, and the names of the keys contain the units.

Unknown and missing keys are errors.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
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
from isocharge.simulate.sensor.film import ALUMINIUM_EXPANSION, Film, Piezo, Surface
from isocharge.simulate.sensor.sensor import Calibration, Corners, Electrode, Readout, Role, Sensor
from isocharge.simulate.sensor.size_check import tidy

MAX_COORDINATE_mm = 1e6
"""Largest absolute value of a coordinate, mm."""

PPM = 1e6
"""Parts per million in one."""

PASCAL_PER_MPA = 1e6
"""Pascal per megapascal."""

log = logging.getLogger(__name__)

SIDE = "side_mm"
"""Key of the section `electrodes` for the side of all square electrodes."""

COATING = "coating_N_per_mm"
"""Key of the section `electrodes` for the stiffness of their metal or ink."""

Coordinate = Annotated[float, Meta(ge=-MAX_COORDINATE_mm, le=MAX_COORDINATE_mm)]
Point = Annotated[tuple[Coordinate, Coordinate], Meta(description=f"[x, y] in mm, each at most {MAX_COORDINATE_mm:g}")]


class FilmTable(Settings, frozen=True):
    """The section `film` of a sensor file."""

    radius_mm: Annotated[float, Meta(gt=0.0, le=MAX_COORDINATE_mm)]
    thickness_um: Positive
    young_GPa: Positive | Annotated[list[Positive], Meta(min_length=2, max_length=2)]
    poisson: Finite
    pretension_MPa: Finite | Annotated[list[Finite], Meta(min_length=3, max_length=3)] = 0.0
    shear_GPa: Positive | None = None
    axis_deg: Finite = 0.0
    oval: Finite = 0.0
    oval_axis_deg: Finite = 0.0
    back_volume_mm3: Positive | None = None
    static_pressure_Pa: Finite = 0.0
    expansion_ppm_per_K: Finite | Annotated[list[Finite], Meta(min_length=2, max_length=2)] | None = None
    ring_expansion_ppm_per_K: Finite = PPM * ALUMINIUM_EXPANSION


class PiezoTable(Settings, frozen=True):
    """The section `piezo` of a sensor file. The piezoelectric coefficients are in pC/N."""

    d31: Finite
    d32: Finite
    d33: Finite = 0.0
    pyro_uC_per_m2_K: Finite = 0.0
    d12: Finite = 0.0


class PolygonTable(Settings, frozen=True):
    """Description of an electrode that is not a square.

    The electrode has a pad on the front. It may also have further polygons and a trace on the front, and polygons on
    the back.
    """

    polygon_mm: tuple[Point, ...]
    more_mm: tuple[tuple[Point, ...], ...] = ()
    trace_mm: tuple[Point, ...] = ()
    width_mm: NotNegative = 0.0
    back_mm: tuple[tuple[Point, ...], ...] = ()


class CalibrationTable(Settings, frozen=True):
    """The section `calibration` of a sensor file."""

    gain: dict[str, Positive] = field(default_factory=dict)
    shift_mm: Point = (0.0, 0.0)
    rotation_deg: Finite = 0.0
    crosstalk: Finite = 0.0


class SensorTable(Settings, frozen=True):
    """Content of a sensor file.

    The keys of the section `electrodes` are the names of the electrodes. The value of a square electrode is its centre,
    and the value of any other electrode is a table. The section also contains the side of the squares and the stiffness
    of the coating.
    """

    name: Text
    film: FilmTable
    piezo: PiezoTable
    electrodes: dict[str, float | Point | PolygonTable]
    readout: Readout = "area"
    surface: Surface = "middle"
    calibration: CalibrationTable = CalibrationTable()
    roles: dict[str, Role] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the section `electrodes` and the names of the section `roles`.

        The keys of `electrodes` are not declared, because they are the names of the electrodes. Only two keys have
        another meaning: `SIDE` and `COATING` are numbers that apply to all electrodes.

        Raises:
            WrongKey: If a value has the wrong type, or a key is missing.
        """
        for name, value in self.electrodes.items():
            if name not in (SIDE, COATING) and isinstance(value, float):
                raise WrongKey(f"electrodes.{name}", "[x, y] in mm or a table", value)
            if isinstance(value, PolygonTable):
                has_trace = bool(value.trace_mm)
                has_width = value.width_mm > 0.0
                if has_trace != has_width:
                    missing = "width_mm" if has_trace else "trace_mm"
                    raise WrongKey(f"electrodes.{name}.{missing}", "trace_mm and a width_mm above 0 together")

        coating = self.electrodes.get(COATING, 0.0)
        if not (isinstance(coating, float) and 0.0 <= coating <= MAX_COORDINATE_mm):
            raise WrongKey(f"electrodes.{COATING}", f"a number from 0 to {MAX_COORDINATE_mm:g}", coating)
        side = self.electrodes.get(SIDE)
        if side is not None and not (isinstance(side, float) and 0.0 < side <= MAX_COORDINATE_mm):
            raise WrongKey(f"electrodes.{SIDE}", f"a number above 0 and at most {MAX_COORDINATE_mm:g}", side)
        if side is None and any(isinstance(value, tuple) for value in self.electrodes.values()):
            raise WrongKey(f"electrodes.{SIDE}")
        for name in self.roles:
            if name in (SIDE, COATING) or name not in self.electrodes:
                raise WrongKey(f"roles.{name}", "the name of an electrode of the section `electrodes`", name)


def built_in_sensors() -> tuple[str, ...]:
    """Return the names of the sensors in the package."""
    folder = resources.files("isocharge.simulate") / "sensors"
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def load_sensor(sensor: str | Path) -> Sensor:
    """Read a sensor file. If the sensor has only one electrode, log a warning.

    Args:
        sensor: A built-in name such as "three-25um-biaxial", or the path of a TOML file.

    Raises:
        SensorError: If there is no such sensor, or its file is invalid. The message contains the file and the key.
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
    """Create a sensor from the tables of its file.

    Args:
        table: Tables of the file, with the units in the keys.
        where: Beginning of the error messages.

    Raises:
        SensorError: If a key or a value is invalid.
    """
    file = convert(table, SensorTable, where, SensorError)
    piezo = file.piezo
    calibration = file.calibration
    coating = file.electrodes.get(COATING)
    with error_prefix(f"{where}: ", SensorError):
        return Sensor(
            name=file.name,
            film=_film(file.film),
            piezo=Piezo(piezo.d31, piezo.d32, piezo.d33, piezo.pyro_uC_per_m2_K, piezo.d12),
            electrodes=tuple(_electrodes(file.electrodes, file.roles)),
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
    """Return a sensor as the tables of a sensor file. The tables can be written as JSON or TOML.

    If `sensor_from_dict` reads these tables, the result is the same sensor, except for rounding errors.

    Args:
        sensor: The sensor.

    Raises:
        SensorError: If no file can describe the sensor.
    """
    piezo = sensor.piezo
    calibration = sensor.calibration
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
        **({"roles": dict.fromkeys(sensor.guard_names, "guard")} if sensor.guard_names else {}),
        "calibration": {
            "gain": dict(calibration.gain),
            "shift_mm": [tidy(value) for value in calibration.shift],
            "rotation_deg": tidy(float(np.rad2deg(calibration.rotation))),
            **({"crosstalk": tidy(calibration.crosstalk)} if calibration.crosstalk else {}),
        },
    }


def film_to_dict(film: Film) -> dict[str, Any]:
    """Return the section `film` of a sensor file. This is the inverse of `_film`.

    Young's modulus and the pretension are single numbers if they do not depend on the direction, and lists otherwise.
    """
    half_difference, shear_tension = film.deviator
    mean_tension = film.pretension
    tension_components = (mean_tension + half_difference, mean_tension - half_difference, shear_tension)
    tension_MPa = [tidy(component) for component in tension_components]

    # The moduli along the axes are E1 = E r and E2 = E / r, with r^2 = E1 / E2.
    root_of_ratio = np.sqrt(film.young_ratio)
    young_GPa = [tidy(film.young * 1e-3 * root_of_ratio), tidy(film.young * 1e-3 / root_of_ratio)]

    # Optional keys are omitted if their value is zero or None.
    optional: dict[str, Any] = {
        "shear_GPa": None if film.shear is None else tidy(film.shear * 1e-3),
        "axis_deg": tidy(float(np.rad2deg(film.axis))),
        "oval": tidy(film.oval),
        "oval_axis_deg": tidy(float(np.rad2deg(film.oval_axis))),
        "back_volume_mm3": None if film.back_volume is None else tidy(film.back_volume),
        "static_pressure_Pa": tidy(film.static_pressure * PASCAL_PER_MPA),
    }
    if film.expansion is not None:
        optional["expansion_ppm_per_K"] = [tidy(PPM * coefficient) for coefficient in film.expansion]
        optional["ring_expansion_ppm_per_K"] = tidy(PPM * film.ring_expansion)
    return {
        "radius_mm": tidy(film.radius),
        "thickness_um": tidy(film.thickness * 1e3),
        "young_GPa": tidy(film.young * 1e-3) if film.young_ratio == 1.0 else young_GPa,
        "poisson": film.poisson,
        "pretension_MPa": tension_MPa if any(film.deviator) else tidy(mean_tension),
        **{name: value for name, value in optional.items() if value},
    }


def sensor_to_toml(sensor: Sensor, comment: Iterable[str] = ()) -> str:
    """Return a sensor as the text of a sensor file.

    If `load_sensor` reads this text, the result is the same sensor, except for rounding errors.

    Args:
        sensor: The sensor.
        comment: Comment lines at the beginning of the file, without "#".

    Raises:
        SensorError: If no file can describe the sensor, for example because its name is empty.
    """
    text = to_toml(sensor_to_dict(sensor), comment)
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise SensorError(f"sensor {sensor.name!r}: a name cannot be encoded in UTF-8 ({error})") from error

    # Read the text again, which raises an error if the file would not be valid.
    where = f"sensor {sensor.name!r}"
    sensor_from_dict(parse_toml(text, where, SensorError, dict[str, Any]), where)
    return text


def write_sensor(sensor: Sensor, path: Path, comment: Iterable[str] = ()) -> None:
    """Write the file of a sensor. If an error occurs, no file is written.

    Args:
        sensor: The sensor.
        path: Path of the new file.
        comment: Comment lines at the beginning of the file, without "#".

    Raises:
        SensorError: If no file can describe the sensor.
        OutputExists: If `path` exists.
    """
    refuse_existing(path)
    write_whole(path, sensor_to_toml(sensor, comment).encode())


def _electrode_tables(sensor: Sensor) -> dict[str, Any]:
    """Return the section `electrodes` of a sensor file.

    All squares of a file have the same side. A square whose side differs from that of the first square is described as
    a polygon.

    Raises:
        SensorError: If the readout needs squares, and their sides differ.
    """
    squares = [electrode for electrode in sensor.electrodes if electrode.square]
    sides = {square.name: tidy(square.corners[1][0] - square.corners[0][0]) for square in squares}
    if sensor.readout == "edge" and len(set(sides.values())) > 1:
        raise SensorError(
            f"readout 'edge' needs squares, and in a sensor file all squares have one side: got {sides} mm"
        )
    shared_side = next(iter(sides.values()), None)  # side of the first square; None if there are no squares
    tables: dict[str, Any] = {}
    if shared_side is not None:
        tables[SIDE] = shared_side
    if sensor.coating:
        tables[COATING] = tidy(sensor.coating)
    for electrode in sensor.electrodes:
        if electrode.square and sides[electrode.name] == shared_side:
            tables[electrode.name] = [tidy(value) for value in electrode.centre]
        else:
            tables[electrode.name] = _polygon_table(electrode)
    return tables


def _polygon_table(electrode: Electrode) -> dict[str, Any]:
    """Return the table of an electrode that is described by polygons."""
    table: dict[str, Any] = {"polygon_mm": _corners(electrode.corners)}
    if electrode.more:
        table["more_mm"] = [_corners(polygon) for polygon in electrode.more]
    if electrode.back:
        table["back_mm"] = [_corners(polygon) for polygon in electrode.back]
    return table


def _corners(polygon: Corners) -> list[list[float]]:
    """Return the corners of a polygon as lists of rounded numbers, mm."""
    return [[tidy(value) for value in corner] for corner in polygon]


def _film(table: FilmTable) -> Film:
    """Create the film from the section `film` of a sensor file.

    The section contains either one Young's modulus or the moduli (E1, E2), and either one pretension or the components
    (T11, T22, T12).
    """
    # Young's moduli along both axes, and their geometric mean
    if isinstance(table.young_GPa, list):
        young_1, young_2 = table.young_GPa
    else:
        young_1 = young_2 = table.young_GPa
    # The mean of equal values is not computed, because it would have rounding errors.
    mean_young = young_1 if young_1 == young_2 else float(np.sqrt(young_1 * young_2))

    # Components of the pretension, and the mean of the components along both axes
    if isinstance(table.pretension_MPa, list):
        tension_11, tension_22, tension_12 = table.pretension_MPa
    else:
        tension_11 = tension_22 = table.pretension_MPa
        tension_12 = 0.0
    mean_tension = tension_11 if tension_11 == tension_22 else 0.5 * (tension_11 + tension_22)

    return Film(
        radius=table.radius_mm,
        thickness=table.thickness_um * 1e-3,
        young=mean_young * 1e3,
        poisson=table.poisson,
        pretension=mean_tension,
        deviator=(0.5 * (tension_11 - tension_22), tension_12),
        young_ratio=young_1 / young_2,
        shear=None if table.shear_GPa is None else table.shear_GPa * 1e3,
        axis=float(np.deg2rad(table.axis_deg)),
        oval=table.oval,
        oval_axis=float(np.deg2rad(table.oval_axis_deg)),
        back_volume=table.back_volume_mm3,
        static_pressure=table.static_pressure_Pa / PASCAL_PER_MPA,
        expansion=_expansion(table),
        ring_expansion=table.ring_expansion_ppm_per_K / PPM,
    )


def _expansion(table: FilmTable) -> tuple[float, float] | None:
    """Return the expansion coefficients of the film along its axes, 1/K; None if the section has none."""
    coefficients = table.expansion_ppm_per_K
    if coefficients is None:
        return None
    if isinstance(coefficients, list):
        along, across = coefficients
        return along / PPM, across / PPM
    return coefficients / PPM, coefficients / PPM


def _electrodes(table: Mapping[str, float | Point | PolygonTable], roles: Mapping[str, Role]) -> Iterator[Electrode]:
    """Yield the electrodes of the section `electrodes`.

    A value of the section is a table of polygons, the centre of a square, or a number that applies to all electrodes.

    Args:
        table: The section `electrodes`.
        roles: The section `roles`. An electrode that it does not contain determines the position.
    """
    side = table.get(SIDE)  # of all squares
    for name, value in table.items():
        role = roles.get(name, "position")
        if isinstance(value, PolygonTable):
            electrode = Electrode(name, value.polygon_mm, more=value.more_mm, back=value.back_mm, role=role)
            if value.trace_mm:
                electrode = electrode.with_trace(value.trace_mm, value.width_mm)
            yield electrode
        elif isinstance(value, tuple) and isinstance(side, float):
            yield replace(Electrode.of_square(name, value, side), role=role)
