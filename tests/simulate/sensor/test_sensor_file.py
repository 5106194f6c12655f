"""Sensor files: built-in sensors, error messages for invalid files, and round trips."""

import copy
import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import OutputError, OutputExists, SensorError
from isocharge.simulate import (
    Calibration,
    Electrode,
    Film,
    Piezo,
    Sensor,
    built_in_sensors,
    load_sensor,
    write_sensor,
)
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict

SENSOR = load_sensor("three-25um-biaxial")
WHOLE = """
name = "mine"
readout = "edge"
surface = "top"

[film]
radius_mm = 30.0
thickness_um = 9
young_GPa = 2.5
poisson = 0.34
pretension_MPa = 0.5

[piezo]
d31 = 20.0
d32 = 2.0
d33 = -30.0
pyro_uC_per_m2_K = -30.0

[electrodes]
side_mm = 3.0
A = [0.0, -10.0]
B = [8.660254, 5.0]

[calibration]
gain = {A = 1.02}
shift_mm = [0.1, -0.2]
rotation_deg = 5.0
"""


def whole():
    return tomllib.loads(WHOLE)


def tables(table, path=()):
    """Paths of a table and all tables in it."""
    yield path
    for key, value in table.items():
        if isinstance(value, dict):
            yield from tables(value, (*path, key))


def at(table, path):
    for key in path:
        table = table[key]
    return table


KEYS = [(*path, key) for path in tables(whole()) for key in at(whole(), path)]


# Reading

LAYOUTS = {
    "three": {"A": (0.0, -10.0), "B": (8.660254, 5.0), "C": (-8.660254, 5.0)},
    "four": {"A": (10.0, 0.0), "B": (0.0, 10.0), "C": (-10.0, 0.0), "D": (0.0, -10.0)},
}


@pytest.mark.parametrize("layout", ["three", "four"])
@pytest.mark.parametrize(("kind", "d31", "d32"), [("biaxial", 8.0, 8.0), ("uniaxial", 20.0, 2.0)])
def test_built_in_sensors_can_be_loaded(layout, kind, d31, d32):
    name = f"{layout}-25um-{kind}"
    electrodes = tuple(Electrode.of_square(*place, 3.0) for place in LAYOUTS[layout].items())
    assert load_sensor(name) == Sensor(name, Film(45.0, 0.025, 3000.0, 0.34), Piezo(d31, d32), electrodes)


def test_traces_and_back_metal_are_read():
    """A trace is written as a polygon."""
    pad = ((8.0, 0.0), (12.0, 0.0), (10.0, 4.0))
    back = (((0.0, -9.0), (9.0, -9.0), (9.0, 9.0), (0.0, 9.0)),)
    table = {"polygon_mm": pad, "trace_mm": [[10, 0], [10, -5]], "width_mm": 0.5, "back_mm": back}
    (electrode,) = sensor_from_dict(whole() | {"readout": "area", "electrodes": {"A": table}}).electrodes
    trace = ((9.75, 0.0), (9.75, -5.0), (10.25, -5.0), (10.25, 0.0))
    assert electrode == Electrode("A", pad, more=(trace,), back=back)


# Errors


WRONG = (None, "3.0", True, [1.0], [1.0, "2"], {}, {"x": 1.0}, float("nan"), float("inf"))


@pytest.mark.parametrize("path", KEYS, ids=".".join)
def test_error_message_names_the_key_of_the_wrong_type(path):
    """Each wrong value of each key raises a SensorError that names the key."""
    for value in WRONG:
        if (path[-1] in ("calibration", "gain") and value == {}) or (path == ("name",) and value == "3.0"):
            continue
        table = whole()
        at(table, path[:-1])[path[-1]] = copy.deepcopy(value)
        with pytest.raises(SensorError) as caught:
            sensor_from_dict(table, "mine.toml")
        assert path[-1] in str(caught.value) or path == ("electrodes",)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("piezo", "d32"), -2e-4, r"piezo d32: expected pC/N, got -0\.0002 pC/N"),
        (("film", "thickness_um"), -25.0, r"film\.thickness_um: expected a number above 0.*, got -25\.0"),
        (("film", "thickness_um"), 0.025, r"film\.thickness_um: expected at least 0\.1 um, .* 0\.025 mm are 25 um"),
        (("film", "young_GPa"), [3.0] * 3, "film.young_GPa: expected a positive number or a list of two, got"),
        (("film", "young_GPa"), [3.0, 0.2], r"film\.young_GPa, E1 / E2: expected 0\.1 to 10, got 15"),
        (("electrodes", "side_mm"), 0.0, "electrodes.side_mm: expected a number above 0"),
        (("calibration", "gain"), {"A": 0.0}, "calibration.gain.A: expected a positive number, got 0.0"),
        (("name",), "", "name: expected a text"),
        (
            ("electrodes", "A"),
            {"polygon_mm": [3]},
            r"electrodes\.A\.polygon_mm\[0\]: expected \[x, y\] in mm",
        ),
        (
            ("electrodes", "A"),
            {"polygon_mm": [[0, 0], [1, 0], [0, 1]], "trace_mm": [[0, 0], [9, 0]]},
            r"electrodes\.A\.width_mm: expected trace_mm and a width_mm above 0 together",
        ),
        (
            ("electrodes", "A"),
            {"polygon_mm": [[0, 0], [1, 0], [0, 1]], "back_mm": [[0, 0]]},
            r"electrodes\.A\.back_mm\[0\]\[0\]: expected \[x, y\] in mm",
        ),
    ],
)
def test_invalid_values_raise_error(path, value, message):
    table = whole()
    at(table, path[:-1])[path[-1]] = value
    with pytest.raises(SensorError, match=rf"^mine\.toml: {message}"):
        sensor_from_dict(table, "mine.toml")


def test_sensor_with_one_electrode_logs_a_warning(tmp_path, command, caplog):
    path = tmp_path / "mine.toml"
    path.write_text(WHOLE.replace("B = [8.660254, 5.0]\n", ""))
    load_sensor(path)
    (message,) = caplog.messages
    assert message.startswith(f"{path}: one electrode: its charge can be computed")
    code, out, err = command("simulate", "point", path, "--at", "1,2", "--json")
    assert (code, json.loads(out)["status"]) == (0, "converged")
    assert message in err


@pytest.mark.parametrize(
    ("more", "count"),
    [
        ("[[10.728, 3.364], [14.0, 8.0], [10.455, 3.728]]", 0),  # beside the pad by 0.8 um, because of rounding
        ("[[10.8, 3.4], [14.0, 8.0], [10.6, 3.8]]", 1),
    ],
)
def test_polygon_that_does_not_touch_its_pad_logs_a_warning(tmp_path, caplog, more, count):
    path = tmp_path / "mine.toml"
    polygons = f"{{polygon_mm = [[8.0, 3.0], [11.0, 3.0], [8.0, 7.0]], more_mm = [{more}]}}"
    path.write_text(WHOLE.replace("edge", "area").replace("[8.660254, 5.0]", polygons))
    load_sensor(path)
    assert caplog.text.count("electrode 'B': its metal on the front consists of 2 parts that do not touch") == count


# Writing


@pytest.mark.parametrize("name", built_in_sensors())
def test_written_sensor_file_reads_as_the_built_in_sensor(name, tmp_path):
    path = tmp_path / "mine.toml"
    write_sensor(load_sensor(name), str(path), ["as delivered", "", "pretension\nunknown"])
    assert path.read_text("utf-8").startswith("# as delivered\n#\n# pretension\n# unknown\n\nname = ")
    assert load_sensor(path) == load_sensor(name)


def test_every_property_of_a_film_is_written_in_the_unit_of_its_key():
    film = Film(
        *(45.0, 0.025, 3000.0, 0.34, 1.0, (0.33, 0.2)),
        young_ratio=1.44,
        shear=1000.0,
        axis=np.pi / 6.0,
        oval=0.02,
        oval_axis=-np.pi / 4.0,
        back_volume=127000.0,
        static_pressure=2e-6,
        expansion=(-5e-6, 1e-4),
        ring_expansion=0.0,
    )
    calibration = Calibration(crosstalk=0.01)
    table = sensor_to_dict(replace(SENSOR, film=film, piezo=replace(SENSOR.piezo, d12=0.5), calibration=calibration))
    assert table["film"] == {
        "radius_mm": 45.0,
        "thickness_um": 25.0,
        "young_GPa": [3.6, 2.5],
        "poisson": 0.34,
        "pretension_MPa": [1.33, 0.67, 0.2],
        "shear_GPa": 1.0,
        "axis_deg": 30.0,
        "oval": 0.02,
        "oval_axis_deg": -45.0,
        "back_volume_mm3": 127000.0,
        "static_pressure_Pa": 2.0,
        "expansion_ppm_per_K": [-5.0, 100.0],
        "ring_expansion_ppm_per_K": 0.0,
    }
    assert (table["piezo"]["d12"], table["calibration"]["crosstalk"]) == (0.5, 0.01)
    again = sensor_from_dict(table)
    assert sensor_to_dict(again) == table
    np.testing.assert_allclose([*again.film.expansion, again.film.axis], [-5e-6, 1e-4, np.pi / 6.0])
    assert list(sensor_to_dict(SENSOR)["film"]) == list(table["film"])[:5]  # optional keys are omitted


def test_squares_of_a_second_size_are_written_as_polygons():
    """The file has one side for all squares."""
    squares = (Electrode.of_square("A", (0.0, 0.0), 3.0), Electrode.of_square("B", (6.0, 0.0), 2.0))
    again = sensor_from_dict(sensor_to_dict(replace(SENSOR, electrodes=squares)))
    assert [electrode.area for electrode in again.electrodes] == pytest.approx([9.0, 4.0])
    with pytest.raises(SensorError, match=r"all squares have one side: got \{'A': 3\.0, 'B': 2\.0\} mm"):
        sensor_to_dict(replace(SENSOR, electrodes=squares, readout="edge"))


@pytest.mark.parametrize(
    ("name", "file", "error", "message"),
    [
        ("", "mine.toml", SensorError, "name: expected a text"),
        ("\ud800", "mine.toml", SensorError, "cannot be encoded in UTF-8"),
        ("mine", "none/mine.toml", OutputError, "none/mine.toml cannot be written: No such file or directory"),
        ("mine", ".", OutputExists, "is already there"),
    ],
)
def test_sensor_that_cannot_be_written_raises_error(tmp_path, name, file, error, message):
    with pytest.raises(error, match=message):
        write_sensor(replace(SENSOR, name=name), tmp_path / file)
    assert not any(tmp_path.iterdir())


def test_write_and_load_round_trip(tmp_path):
    """The sensor has names that TOML must quote, a polygon with a trace and metal on the back, and a calibration."""
    pad = ((-12.0, 4.0), (-8.0, 4.0), (-10.0, 8.0))
    traced = replace(Electrode("a.b", pad).with_trace(((-10.0, 5.0), (-10.0, 20.0)), 0.5), back=(pad,))
    electrodes = (traced, Electrode.of_square('"#]', (6.0, 0.0), 3.0))
    calibration = Calibration({"a.b": 1.5}, (0.5, -0.25), float(np.deg2rad(5.0)))
    sensor = replace(SENSOR, electrodes=electrodes, calibration=calibration)
    write_sensor(sensor, tmp_path / "mine.toml")
    assert load_sensor(tmp_path / "mine.toml") == sensor
