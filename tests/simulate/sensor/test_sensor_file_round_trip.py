"""The sensor file, written and read again: nothing changes, and nothing is overwritten."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import OutputExists, SensorError
from isocharge.simulate import (
    Calibration,
    Electrode,
    Film,
    Piezo,
    Sensor,
    built_in_sensors,
    load_sensor,
    sensor_from_dict,
    sensor_to_dict,
    write_sensor,
)


def same(first: Sensor, second: Sensor) -> bool:
    """Equal to round-off."""

    def numbers(sensor: Sensor) -> np.ndarray:
        film, piezo, calibration = sensor.film, sensor.piezo, sensor.calibration
        return np.array(
            [
                *(film.radius, film.thickness, film.young, film.poisson, film.pretension),
                *(1e12 * value for value in (piezo.d31, piezo.d32, piezo.d33, piezo.pyro)),
                *(value for electrode in sensor.electrodes for corner in electrode.corners for value in corner),
                *(*calibration.gain.values(), *calibration.shift, calibration.rotation),
            ]
        )

    def words(sensor: Sensor) -> tuple[object, ...]:
        squares = tuple(electrode.square for electrode in sensor.electrodes)
        return (
            sensor.name,
            sensor.readout,
            sensor.surface,
            sensor.electrode_names,
            squares,
            set(sensor.calibration.gain),
        )

    return words(first) == words(second) and np.allclose(numbers(first), numbers(second), rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize("name", built_in_sensors())
def test_round_trip_of_the_built_in_sensors_is_exact(name):
    sensor = load_sensor(name)
    assert sensor_from_dict(sensor_to_dict(sensor)) == sensor


@given(
    radius=st.floats(5e-3, 0.2),
    thickness=st.floats(1e-6, 1e-4),
    young=st.floats(1e6, 1e11),
    poisson=st.floats(0.0, 0.499),
    pretension=st.floats(0.0, 1e7),
    d31=st.floats(-1e-10, 1e-10),
    x=st.floats(-1e-3, 1e-3),
    rotation=st.floats(-np.pi, np.pi),
    gain=st.floats(0.5, 2.0),
    polygon=st.booleans(),
)
@settings(derandomize=True)
def test_round_trip(radius, thickness, young, poisson, pretension, d31, x, rotation, gain, polygon):
    base = load_sensor("three-25um-biaxial")
    film = replace(base.film, radius=radius, thickness=thickness, young=young, poisson=poisson, pretension=pretension)
    corners = ((x, 2e-3), (x + 1e-3, 2e-3), (x, 3e-3))
    second = Electrode("B", corners) if polygon else Electrode.of_square("B", (x, 2.5e-3), 1e-3)
    sensor = replace(
        base,
        film=film,
        piezo=Piezo(d31, 2e-12, -3e-11, 3e-5),
        electrodes=(Electrode.of_square("A", (x, 0.0), 1e-3), second),
        surface="bottom",
        calibration=Calibration({"B": gain}, (x, -x), rotation),
    )
    assert same(sensor_from_dict(sensor_to_dict(sensor)), sensor)


def test_squares_of_two_sizes_survive_as_polygons():
    """The file has one side for all squares."""
    base = load_sensor("three-25um-biaxial")
    squares = (Electrode.of_square("A", (0.0, 0.0), 3e-3), Electrode.of_square("B", (6e-3, 0.0), 2e-3))
    again = sensor_from_dict(sensor_to_dict(replace(base, electrodes=squares)))
    assert [electrode.area for electrode in again.electrodes] == pytest.approx([9e-6, 4e-6])
    with pytest.raises(
        SensorError, match=r"in a sensor file all squares have one side: got \{'A': 3\.0, 'B': 2\.0\} mm"
    ):
        sensor_to_dict(replace(base, electrodes=squares, readout="edge"))


@pytest.mark.parametrize("name", built_in_sensors())
def test_a_written_file_is_the_built_in_sensor(name, tmp_path):
    write_sensor(load_sensor(name), tmp_path / "mine.toml", ["as delivered", "", "pretension\nunknown"])
    text = (tmp_path / "mine.toml").read_text("utf-8")
    assert text.startswith("# as delivered\n#\n# pretension\n# unknown\n\nname = ")
    assert load_sensor(tmp_path / "mine.toml") == load_sensor(name)


NAMES = st.text(st.characters(codec="utf-8"), min_size=1, max_size=6) | st.sampled_from(
    ["a.b", "#", '"', "'", "\\", "\x7f", "\n", "[x]", "\u2028", "\U0001f600", " ", "gain", "name", "1e3", "=", "\ufeff"]
)


@st.composite
def electrodes(draw: st.DrawFn) -> tuple[Electrode, ...]:
    """Squares, of one side or of several, and convex polygons, none of which overlap; any names."""
    names = draw(st.lists(NAMES.filter(lambda name: name != "side_mm"), min_size=1, max_size=5, unique=True))
    places = draw(st.permutations([(x, y) for x in (-6e-3, 0.0, 6e-3) for y in (-6e-3, 0.0, 6e-3)]))
    shapes = []
    for name, (x, y) in zip(names, places, strict=False):
        x, y, size = x + draw(st.floats(-1e-3, 1e-3)), y + draw(st.floats(-1e-3, 1e-3)), draw(st.floats(0.5e-3, 1.5e-3))
        corners = draw(st.integers(2, 9))
        if corners == 2:
            shapes.append(Electrode.of_square(name, (x, y), draw(st.sampled_from([2e-3, size]))))
        else:
            angles = draw(st.floats(0.0, 6.0)) + 2.0 * np.pi * np.arange(corners) / corners
            points = zip(x + size * np.cos(angles), y + size * np.sin(angles), strict=True)
            shapes.append(Electrode(name, tuple((float(a), float(b)) for a, b in points)))
    return tuple(shapes)


@given(
    name=NAMES,
    shapes=electrodes(),
    film=st.builds(
        Film,
        radius=st.floats(15e-3, 0.2),
        thickness=st.floats(1e-6, 1e-3),
        young=st.floats(1e6, 1e11),
        poisson=st.floats(0.0, 0.499),
        pretension=st.floats(0.0, 1e7),
    ),
    piezo=st.tuples(*[st.floats(-1e-10, 1e-10)] * 3),
    gains=st.lists(st.none() | st.floats(0.01, 100.0), min_size=5, max_size=5),
    rotation=st.floats(-np.pi, np.pi),
    comment=st.lists(st.text(st.characters(codec="utf-8"), max_size=9), max_size=3),
    data=st.data(),
)
@settings(derandomize=True, max_examples=200, deadline=None)
def test_what_is_written_is_loaded(name, shapes, film, piezo, gains, rotation, comment, data, tmp_path_factory):
    gain = {shape.name: value for shape, value in zip(shapes, gains, strict=False) if value is not None}
    shift = data.draw(st.tuples(*[st.floats(-1e-3, 1e-3)] * 2))
    sensor = Sensor(
        name,
        film,
        Piezo(2e-12, *piezo),
        shapes,
        surface=data.draw(st.sampled_from(["middle", "top", "bottom"])),
        calibration=Calibration(gain, shift, rotation),
    )
    path = tmp_path_factory.mktemp("sensor") / "mine.toml"
    write_sensor(sensor, path, comment)
    again, table = load_sensor(path), sensor_to_dict(sensor)
    assert tomllib.loads(path.read_text("utf-8")) == table
    squares = {shape.name for shape in again.electrodes if shape.square}  # those of another side become polygons
    as_loaded = tuple(replace(shape, square=shape.name in squares) for shape in sensor.electrodes)
    assert squares <= {shape.name for shape in sensor.electrodes if shape.square}
    assert same(again, replace(sensor, electrodes=as_loaded))


def test_a_sensor_that_no_file_can_hold(tmp_path):
    base = load_sensor("three-25um-biaxial")
    with pytest.raises(SensorError, match="sensor '': name: expected a text, got ''"):
        write_sensor(replace(base, name=""), tmp_path / "mine.toml")
    with pytest.raises(SensorError, match="no text that UTF-8 can hold"):
        write_sensor(replace(base, name="\ud800"), tmp_path / "mine.toml")
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_not_overwritten(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("mine")
    with pytest.raises(OutputExists, match="is already there"):
        write_sensor(load_sensor("three-25um-biaxial"), path)
    assert path.read_text() == "mine"
