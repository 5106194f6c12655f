"""The sensor file: built-in sensors as designed, and one clear error for every way to be wrong."""

import copy
import json
import re
import tomllib
from collections.abc import Iterator
from importlib import resources
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import SensorError
from isocharge.simulate import (
    Calibration,
    built_in_sensors,
    load_sensor,
    sensor_from_dict,
    sensor_to_dict,
    sensor_to_toml,
)

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
pyro_uC_per_m2_K = 30.0

[electrodes]
side_mm = 3.0
A = [0.0, -10.0]
B = [8.660254, 5.0]

[calibration]
gain = {A = 1.02}
shift_mm = [0.1, -0.2]
rotation_deg = 5.0
"""
OPTIONAL = {"readout", "surface", "pretension_MPa", "d33", "pyro_uC_per_m2_K", "calibration", *"AB"} | {
    "gain",
    "shift_mm",
    "rotation_deg",
}


def whole() -> dict[str, Any]:
    return tomllib.loads(WHOLE)


def tables(table: dict[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Paths of a table and all tables in it."""
    yield path
    for key, value in table.items():
        if isinstance(value, dict):
            yield from tables(value, (*path, key))


def at(table: dict[str, Any], path: tuple[str, ...]) -> dict[str, Any]:
    for key in path:
        table = table[key]
    return table


CLOSED = [path for path in tables(whole()) if path not in (("electrodes",), ("calibration", "gain"))]
"""Tables whose keys are fixed; in the other two they are the names of electrodes."""

KEYS = [(*path, key) for path in tables(whole()) for key in at(whole(), path)]


# The built-in sensors: design, section 3

LAYOUTS = {
    "three": {"A": (0.0, -10e-3), "B": (8.660254e-3, 5e-3), "C": (-8.660254e-3, 5e-3)},
    "four": {"A": (10e-3, 0.0), "B": (0.0, 10e-3), "C": (-10e-3, 0.0), "D": (0.0, -10e-3)},
}


@pytest.mark.parametrize("layout", ["three", "four"])
@pytest.mark.parametrize(("kind", "d31", "d32"), [("biaxial", 8e-12, 8e-12), ("uniaxial", 20e-12, 2e-12)])
def test_built_in_sensor(layout, kind, d31, d32):
    sensor = load_sensor(f"{layout}-25um-{kind}")
    assert sensor.name == f"{layout}-25um-{kind}"
    assert (sensor.readout, sensor.surface) == ("area", "middle")
    film, piezo = sensor.film, sensor.piezo
    assert (film.radius, film.thickness, film.young, film.poisson, film.pretension) == pytest.approx(
        (45e-3, 25e-6, 3e9, 0.34, 0.0)
    )
    assert (piezo.d31, piezo.d32, piezo.d33, piezo.pyro) == pytest.approx((d31, d32, 0.0, 0.0))
    assert sensor.electrode_names == tuple(LAYOUTS[layout])
    for electrode in sensor.electrodes:
        assert electrode.square
        assert electrode.area == pytest.approx(9e-6)
        assert electrode.centre == pytest.approx(LAYOUTS[layout][electrode.name], abs=1e-12)
        assert np.hypot(*electrode.centre) == pytest.approx(10e-3, rel=1e-6)
    assert sensor.calibration == Calibration()


def test_names_of_the_built_in_sensors():
    assert built_in_sensors() == (
        "four-25um-biaxial",
        "four-25um-biaxial-15mm",
        "four-25um-uniaxial",
        "three-25um-biaxial",
        "three-25um-biaxial-12mm",
        "three-25um-uniaxial",
    )


# Reading


def test_every_key_arrives_in_si_units(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(WHOLE)
    sensor = load_sensor(path)
    film, piezo, calibration = sensor.film, sensor.piezo, sensor.calibration
    assert (sensor.name, sensor.readout, sensor.surface) == ("mine", "edge", "top")
    assert (film.radius, film.thickness, film.young, film.poisson, film.pretension) == pytest.approx(
        (30e-3, 9e-6, 2.5e9, 0.34, 0.5e6)
    )
    assert (piezo.d31, piezo.d32, piezo.d33, piezo.pyro) == pytest.approx((20e-12, 2e-12, -30e-12, 30e-6))
    assert sensor.electrodes[1].centre == pytest.approx((8.660254e-3, 5e-3))
    assert calibration.gain == {"A": 1.02}
    assert calibration.shift == pytest.approx((0.1e-3, -0.2e-3))
    assert calibration.rotation == pytest.approx(np.deg2rad(5.0))


def test_optional_keys_may_be_left_out():
    table = whole()
    for path in KEYS:
        if path[-1] in OPTIONAL - set("AB") and path[0] in table:
            at(table, path[:-1]).pop(path[-1], None)
    sensor = sensor_from_dict(table)
    assert (sensor.readout, sensor.surface, sensor.film.pretension) == ("area", "middle", 0.0)
    assert (sensor.piezo.d33, sensor.piezo.pyro, sensor.calibration) == (0.0, 0.0, Calibration())


def test_polygon_electrodes():
    table = whole() | {"readout": "area"}
    table["electrodes"]["T"] = {"polygon_mm": [[-12, 4], [-8, 4], [-10, 8.0]]}
    triangle = sensor_from_dict(table).electrodes[2]
    assert not triangle.square
    assert triangle.corners == pytest.approx(np.array([[-12e-3, 4e-3], [-8e-3, 4e-3], [-10e-3, 8e-3]]))


def test_side_is_not_needed_for_polygons_alone():
    table = whole() | {"readout": "area", "electrodes": {"T": {"polygon_mm": [[-12, 4], [-8, 4], [-10, 8]]}}}
    table["calibration"] = {}
    assert sensor_from_dict(table).electrode_names == ("T",)


# Writing


def test_table_of_a_sensor_is_the_file():
    table = sensor_to_dict(sensor_from_dict(whole()))
    assert table == whole()


def test_a_written_file_reads_as_the_design_has_it():
    sections = sensor_to_toml(sensor_from_dict(whole())).split("\n\n")
    assert [section.splitlines()[0] for section in sections] == [
        *('name = "mine"', "[film]", "[piezo]", "[electrodes]", "[calibration]"),
    ]
    assert sections[3].splitlines()[1:] == ["side_mm = 3.0", "A = [0.0, -10.0]", "B = [8.660254, 5.0]"]
    assert "gain = {A = 1.02}" in sections[4]


# Errors


@given(path=st.sampled_from(CLOSED), key=st.text(min_size=1, max_size=12))
@settings(derandomize=True, max_examples=200)
def test_unknown_key_is_named(path, key):
    table = whole()
    if key in at(table, path):
        return
    at(table, path)[key] = 1.0
    with pytest.raises(SensorError) as caught:
        sensor_from_dict(table, "mine.toml")
    assert str(caught.value).startswith(f"mine.toml: unknown key {'.'.join((*path, key))!r}; known are ")


def test_unknown_key_of_an_electrode_is_named():
    table = whole()
    table["electrodes"]["A"] = {"polygon_mm": [[0, 0], [1, 0], [0, 1]], "colour": "red"}
    with pytest.raises(SensorError, match=r"unknown key 'electrodes\.A\.colour'; known are polygon_mm"):
        sensor_from_dict(table)


@pytest.mark.parametrize("path", [p for p in KEYS if p[-1] not in OPTIONAL], ids=".".join)
def test_missing_key_is_named(path):
    table = whole()
    del at(table, path[:-1])[path[-1]]
    with pytest.raises(SensorError, match=rf"^mine\.toml: key '{'.'.join(path)}' is missing$"):
        sensor_from_dict(table, "mine.toml")


WRONG = (None, "3.0", True, [], [1.0], [1.0, 2.0, 3.0], [1.0, "2"], {}, {"x": 1.0}, float("nan"), float("inf"))


@pytest.mark.parametrize("path", KEYS, ids=".".join)
@pytest.mark.parametrize("value", WRONG, ids=repr)
def test_wrong_type_is_named(path, value):
    """Every key with every kind of wrong value: a SensorError that names the key, never another exception."""
    table = whole()
    at(table, path[:-1])[path[-1]] = copy.deepcopy(value)
    harmless = (path == ("calibration",) and value == {}) or (path == ("calibration", "gain") and value == {})
    harmless |= path == ("name",) and value == "3.0"
    if harmless:
        sensor_from_dict(table)
        return
    with pytest.raises(SensorError) as caught:
        sensor_from_dict(table, "mine.toml")
    assert path[-1] in str(caught.value) or path == ("electrodes",)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("film", "poisson"), 0.5, "film poisson: expected 0 <= poisson < 0.5, got 0.5"),
        (("film", "thickness_um"), 0.0, r"film\.thickness_um: expected a positive number, got 0\.0"),
        (("film", "thickness_um"), -25.0, r"film\.thickness_um: expected a positive number, got -25\.0"),
        (("film", "radius_mm"), -45, r"film\.radius_mm: expected a number above 0 and at most 1e\+06, got -45"),
        (("film", "radius_mm"), 1e300, r"film\.radius_mm: expected a number above 0 and at most 1e\+06, got 1e\+300"),
        (("film", "young_GPa"), -3, r"film\.young_GPa: expected a positive number, got -3"),
        (("film", "pretension_MPa"), -1, r"film\.pretension_MPa: expected a number from 0, got -1"),
        (("film", "thickness_um"), 3000.3, r"film thickness: .* radius \(30\.0 mm\), got 3000\.3 um"),
        (("electrodes", "side_mm"), 0.0, "electrodes.side_mm: expected a positive number, got 0.0"),
        (("electrodes", "A"), [8.0, 5.0], "electrodes 'A' and 'B' overlap"),
        (("calibration", "gain"), {"A": 0.0}, "calibration.gain.A: expected a positive number, got 0.0"),
        (("calibration", "gain"), {"Z": 1.0}, "calibration gain: no electrode named"),
        (("readout",), "mean", r"readout: expected one of area, edge, got 'mean'"),
        (("surface",), "inside", r"surface: expected one of middle, top, bottom, got 'inside'"),
        (("name",), "", "name: expected a text, got ''"),
        (("electrodes", "A"), {"polygon_mm": 3}, r"electrodes\.A\.polygon_mm: expected a list of \[x, y\], got 3"),
        (("electrodes", "A"), {"polygon_mm": [3]}, r"electrodes\.A\.polygon_mm: expected \[x, y\] in mm, got 3"),
        (("electrodes", "A"), {"polygon_mm": []}, "electrode 'A': expected at least three corners"),
    ],
)
def test_impossible_values(path, value, message):
    table = whole()
    at(table, path[:-1])[path[-1]] = value
    with pytest.raises(SensorError, match=rf"^mine\.toml: {message}"):
        sensor_from_dict(table, "mine.toml")


def file_with(tmp_path, changes):
    """A sensor file with other lines."""
    text = WHOLE
    for line, other in changes.items():
        assert line in text
        text = text.replace(line, other)
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"d31 = 20.0": "d31 = 1e-12"}, r"piezo\.d31 is 1e-12 pC/N, beside 2 pC/N: expected 1 to 30 pC/N"),
        ({"d32 = 2.0": "d32 = -2e-12"}, r"piezo\.d32 is -2e-12 pC/N, beside 20 pC/N"),
        ({"d31 = 20.0": "d31 = 20e-12", "d32 = 2.0": "d32 = 0.0"}, r"piezo\.d31 is 2e-11 pC/N, beside 0 pC/N"),
        ({"B = [8.660254, 5.0]\n": ""}, r"one electrode \('A'\): .* three electrodes or more do"),
    ],
)
def test_what_can_hardly_be_meant_gets_a_warning(tmp_path, changes, said, command, caplog):
    path = file_with(tmp_path, changes)
    load_sensor(path)
    (message,) = caplog.messages
    assert re.match(f"{path}: {said}", message)
    code, out, err = command("simulate", "point", path, "--at", "1,2", "--json")
    assert code == 0
    assert json.loads(out)["status"] == "converged"
    (caution,) = (line for line in err.splitlines() if str(path) in line)
    assert re.match(rf"caution: {path}: {said}", caution)


@pytest.mark.parametrize(
    "changes", [{}, {"d31 = 20.0": "d31 = 0.0"}, {"d32 = 2.0": "d32 = 0"}, {"d32 = 2.0": "d32 = -0.03"}]
)
def test_what_is_unusual_gets_no_warning(tmp_path, changes, caplog):
    load_sensor(file_with(tmp_path, changes))
    assert caplog.messages == []


def test_electrode_off_the_film_in_a_file(tmp_path):
    """Word for word as in the style guide."""
    path = tmp_path / "mine.toml"
    path.write_text(WHOLE.replace("[8.660254, 5.0]", "[40.0, 25.0]").partition("[calibration]")[0])
    with pytest.raises(SensorError) as caught:
        load_sensor(path)
    assert str(caught.value) == (
        f"{path}: electrode 'B' lies outside the film: centre (40.0, 25.0) mm, half side 1.5 mm, film radius 30.0 mm"
    )


def test_no_such_sensor(tmp_path):
    with pytest.raises(
        SensorError, match=r"no sensor 'five': it is neither a built-in name \(four-25um-.*\) nor a file"
    ):
        load_sensor("five")
    with pytest.raises(SensorError, match="nor a file"):
        load_sensor(tmp_path)


def test_file_that_is_not_toml(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[film\nradius_mm = 45")
    with pytest.raises(SensorError, match=rf"^{path}: not a TOML file: .*line 1"):
        load_sensor(path)


def test_file_that_is_not_text(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_bytes(b"\xff\xfe\x00name")
    with pytest.raises(SensorError, match=rf"^{path}: not a TOML file: not text in UTF-8"):
        load_sensor(str(path))


@pytest.mark.parametrize("table", [None, [], "film", 3])
def test_value_that_is_no_table_is_refused(table):
    with pytest.raises(SensorError, match=r"^sensor: expected a table, got "):
        sensor_from_dict(table)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("count", [65, 1000, 200_000])
def test_too_many_electrodes_are_refused_at_once(tmp_path, count):
    path = tmp_path / "sensor.toml"
    good = (resources.files("isocharge.simulate") / "sensors/three-25um-biaxial.toml").read_text("utf-8")
    head, tail = good.split("side_mm = 3.0\n")
    path.write_text(head + "side_mm = 3.0\n" + "".join(f"e{k} = [0, 0]\n" for k in range(count)) + tail)
    with pytest.raises(SensorError, match=r"larger than|at most 64") as caught:
        load_sensor(path)
    assert len(str(caught.value)) < 500
