"""The sensor file: TOML with units in its keys, to and from `Sensor`. Unknown keys are errors, and missing ones too."""

import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from isocharge.errors import SensorError
from isocharge.simulate.sensor.electrode import Calibration, Electrode
from isocharge.simulate.sensor.film import Film, Piezo, Surface
from isocharge.simulate.sensor.sensor import Readout, Sensor

SECTIONS = ("name", "readout", "surface", "film", "piezo", "electrodes", "calibration")


def built_in_sensors() -> tuple[str, ...]:
    """Names of the sensors that come with the package."""
    folder = resources.files("isocharge.simulate") / "sensors"
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def load_sensor(sensor: str | Path) -> Sensor:
    """Read a sensor.

    Args:
        sensor: A built-in name such as "three-25um-biaxial", or the path of a TOML file.

    Raises:
        SensorError: If there is no such sensor or its file is wrong; the message names file and key.
    """
    if str(sensor) in built_in_sensors():
        text = (resources.files("isocharge.simulate") / "sensors" / f"{sensor}.toml").read_text("utf-8")
        return _parse(text, str(sensor))
    path = Path(sensor)
    if not path.is_file():
        names = ", ".join(built_in_sensors())
        raise SensorError(f"no sensor {str(sensor)!r}: it is neither a built-in name ({names}) nor a file")
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SensorError(f"{path}: cannot be read as text: {error}") from error
    return _parse(text, str(path))


def _parse(text: str, where: str) -> Sensor:
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SensorError(f"{where}: not a TOML file: {error}") from error
    return sensor_from_dict(table, where)


def sensor_from_dict(table: Mapping[str, Any], where: str = "sensor") -> Sensor:
    """Build a sensor from the tables of its file (units in the keys); `where` opens the error messages."""
    try:
        return _build(_Section(table, "", SECTIONS))
    except SensorError as error:
        raise SensorError(f"{where}: {error}") from error


def sensor_to_dict(sensor: Sensor) -> dict[str, Any]:
    """The tables of a sensor's file, ready for JSON: `sensor_from_dict` gives the sensor back to round-off."""
    film, piezo, calibration = sensor.film, sensor.piezo, sensor.calibration
    return {
        "name": sensor.name,
        "readout": sensor.readout,
        "surface": sensor.surface,
        "film": {
            "radius_mm": _tidy(film.radius * 1e3),
            "thickness_um": _tidy(film.thickness * 1e6),
            "young_GPa": _tidy(film.young * 1e-9),
            "poisson": film.poisson,
            "pretension_MPa": _tidy(film.pretension * 1e-6),
        },
        "piezo": {
            "d31": _tidy(piezo.d31 * 1e12),
            "d32": _tidy(piezo.d32 * 1e12),
            "d33": _tidy(piezo.d33 * 1e12),
            "pyro_uC_per_m2_K": _tidy(piezo.pyro * 1e6),
        },
        "electrodes": _electrode_tables(sensor),
        "calibration": {
            "gain": dict(calibration.gain),
            "shift_mm": [_tidy(1e3 * value) for value in calibration.shift],
            "rotation_deg": _tidy(float(np.rad2deg(calibration.rotation))),
        },
    }


def _electrode_tables(sensor: Sensor) -> dict[str, Any]:
    """Squares share one side in the file; those of another side than the first are written as polygons."""
    sides = {e.name: _tidy(1e3 * (e.corners[1][0] - e.corners[0][0])) for e in sensor.electrodes if e.square}
    if sensor.readout == "edge" and len(set(sides.values())) > 1:
        raise SensorError(
            f"readout 'edge' needs squares, and in a sensor file all squares have one side: got {sides} mm"
        )
    shared = next(iter(sides.values()), None)
    tables: dict[str, Any] = {} if shared is None else {"side_mm": shared}
    for electrode in sensor.electrodes:
        if sides.get(electrode.name) == shared is not None:
            tables[electrode.name] = [_tidy(1e3 * value) for value in electrode.centre]
        else:
            corners = [[_tidy(1e3 * value) for value in corner] for corner in electrode.corners]
            tables[electrode.name] = {"polygon_mm": corners}
    return tables


def _tidy(value: float) -> float:
    """Without the last digits that unit conversion leaves behind."""
    return float(f"{value:.12g}")


class _Section:
    """One table of the file, read key by key, that knows its name and what keys it may have."""

    def __init__(self, table: Any, name: str, keys: tuple[str, ...] | None) -> None:
        if not isinstance(table, Mapping):
            raise SensorError(f"{name + ': ' if name else ''}expected a table, got {table!r}")
        self.table, self.prefix = table, f"{name}." if name else ""
        unknown = [key for key in table if keys is not None and key not in keys]
        if unknown:
            raise SensorError(f"unknown key {self.prefix + unknown[0]!r}; known are {', '.join(keys or ())}")

    def value(self, key: str, default: Any = None) -> Any:
        if key in self.table:
            return self.table[key]
        if default is None:
            raise SensorError(f"key {self.prefix + key!r} is missing")
        return default

    def number(self, key: str, default: float | None = None) -> float:
        return _number(self.value(key, default), self.prefix + key)

    def choice(self, key: str, options: tuple[str, ...]) -> str:
        value = self.value(key, options[0])
        if value not in options:
            raise SensorError(f"{self.prefix + key}: expected one of {options}, got {value!r}")
        return str(value)

    def section(self, key: str, keys: tuple[str, ...] | None, optional: bool = False) -> "_Section":
        return _Section(self.value(key, {} if optional else None), self.prefix + key, keys)


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise SensorError(f"{where}: expected a finite number, got {value!r}")
    return float(value)


def _pair(value: Any, where: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise SensorError(f"{where}: expected [x, y] in mm, got {value!r}")
    return 1e-3 * _number(value[0], where), 1e-3 * _number(value[1], where)


def _build(file: _Section) -> Sensor:
    name = file.value("name")
    if not isinstance(name, str) or not name:
        raise SensorError(f"name: expected a text, got {name!r}")
    film = file.section("film", ("radius_mm", "thickness_um", "young_GPa", "poisson", "pretension_MPa"))
    piezo = file.section("piezo", ("d31", "d32", "d33", "pyro_uC_per_m2_K"))
    return Sensor(
        name=name,
        film=Film(
            radius=film.number("radius_mm") * 1e-3,
            thickness=film.number("thickness_um") * 1e-6,
            young=film.number("young_GPa") * 1e9,
            poisson=film.number("poisson"),
            pretension=film.number("pretension_MPa", 0.0) * 1e6,
        ),
        piezo=Piezo(
            d31=piezo.number("d31") * 1e-12,
            d32=piezo.number("d32") * 1e-12,
            d33=piezo.number("d33", 0.0) * 1e-12,
            pyro=piezo.number("pyro_uC_per_m2_K", 0.0) * 1e-6,
        ),
        electrodes=_electrodes(file.section("electrodes", None)),
        readout=cast(Readout, file.choice("readout", get_args(Readout))),
        surface=cast(Surface, file.choice("surface", get_args(Surface))),
        calibration=_calibration(file),
    )


def _electrodes(section: _Section) -> tuple[Electrode, ...]:
    names = [key for key in section.table if key != "side_mm"]
    return tuple(_electrode(section, name) for name in names)


def _electrode(section: _Section, name: str) -> Electrode:
    value, where = section.table[name], f"electrodes.{name}"
    if isinstance(value, Mapping):
        corners = _Section(value, where, ("polygon_mm",)).value("polygon_mm")
        if not isinstance(corners, list):
            raise SensorError(f"{where}.polygon_mm: expected a list of [x, y], got {corners!r}")
        return Electrode(name, tuple(_pair(corner, f"{where}.polygon_mm") for corner in corners))
    side = section.number("side_mm")
    if side <= 0.0:
        raise SensorError(f"electrodes.side_mm: expected a positive number, got {side}")
    return Electrode.of_square(name, _pair(value, where), side * 1e-3)


def _calibration(file: _Section) -> Calibration:
    section = file.section("calibration", ("gain", "shift_mm", "rotation_deg"), optional=True)
    gain = section.section("gain", None, optional=True)
    gains = {name: gain.number(name) for name in gain.table}
    for name, value in gains.items():
        if value <= 0.0:
            raise SensorError(f"calibration.gain.{name}: expected a positive number, got {value}")
    return Calibration(
        gain=gains,
        shift=_pair(section.value("shift_mm", [0.0, 0.0]), "calibration.shift_mm"),
        rotation=float(np.deg2rad(section.number("rotation_deg", 0.0))),
    )
