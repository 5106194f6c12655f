"""The deflection table compared with direct solves between its entries, and its file."""

import json
import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from isocharge.cli.shared.forward_maps import write_deflection
from isocharge.common.errors import InputError
from isocharge.serve.viewer.deflection_field import DeflectionField, read_deflection_field
from isocharge.simulate import Circle, deflection, load_sensor, press
from isocharge.simulate.forward.deflection import deflection_table
from isocharge.simulate.sensor.sensor_file import film_to_dict, sensor_to_toml

FILM = load_sensor("three-25um-biaxial").film
PROBE = Circle(1.0)


@pytest.fixture(scope="module")
def field():
    properties = film_to_dict(FILM)
    table = deflection_table(FILM, PROBE, (0.2, 1.0), distances=5)
    return DeflectionField.of(properties, **table._asdict())


def interpolated(field, x_mm, y_mm, distance_mm, force_N):
    """Deflection under a press on the x axis, as the docstring of the file says."""
    p = distance_mm / 45.0
    r = 1.0 / 45.0
    c = math.tanh(0.5 * (math.atanh(p + r) + math.atanh(p - r)))
    place = (x_mm + 1j * y_mm) / 45.0
    z = (place - c) / (1.0 - c * place)
    scaled = field.deflection_mm / np.cbrt(field.force_N)[:, None, None, None]
    axes = (np.log(field.force_N), field.distance_mm, field.rings, np.linspace(0.0, math.pi, scaled.shape[3]))
    points = np.stack(
        [np.full(len(z), math.log(force_N)), np.full(len(z), distance_mm), abs(z), abs(np.angle(z))], axis=1
    )
    return RegularGridInterpolator(axes, scaled)(points) * np.cbrt(force_N)


@pytest.mark.parametrize(("distance_mm", "force_N"), [(0.0, 0.5), (5.0, 0.2), (11.0, 1.0)])
def test_deflection_table_interpolates_direct_solves(field, distance_mm, force_N):
    solved = press(FILM, PROBE, (distance_mm, 0.0), force_N)
    rng = np.random.default_rng(1)
    x_mm, y_mm = rng.uniform(-30, 30, 300), rng.uniform(-30, 30, 300)
    x_mm[:100] = distance_mm + rng.normal(0, 2, 100)
    y_mm[:100] = rng.normal(0, 2, 100)
    expected = deflection(solved, np.stack([x_mm, y_mm], axis=1))
    error = np.abs(interpolated(field, x_mm, y_mm, distance_mm, force_N) - expected)
    assert error.max() < 0.02 * expected.max()


def test_deflection_file_round_trip(field, tmp_path):
    path = tmp_path / "deflection.json"
    path.write_bytes(msgspec.json.encode(field))
    read = read_deflection_field(path)
    assert np.abs(read.deflection_mm - field.deflection_mm).max() < 1e-4 * field.deflection_mm.max()
    film = {"radius_mm": 45, "thickness_um": 25.0, "young_GPa": 3.0, "poisson": 0.34}
    assert [read.fits(other) for other in (film, film | {"thickness_um": 110.0}, film | {"oval": 0.1}, None)] == [
        True,
        False,
        False,
        False,
    ]


def test_deflection_json_is_written_for_a_film_without_an_included_table(tmp_path, monkeypatch, capsys, command):
    def quick_table(film, probe):
        return deflection_table(film, probe, (1.0,), distances=2)

    monkeypatch.setattr("isocharge.simulate.forward.deflection.deflection_table", quick_table)
    path = tmp_path / "deflection.json"
    large_probe = Circle(30.0)  # leaves the film off the centre
    for film, probe in [
        (FILM, PROBE),
        (replace(FILM, young_ratio=1.2), PROBE),
        (replace(FILM, radius=44.0), large_probe),
    ]:
        write_deflection(tmp_path, film, [probe])
        assert not path.exists()
    assert "cannot draw this film in relief" in capsys.readouterr().err

    sensor = load_sensor("three-25um-biaxial")
    own_sensor = tmp_path / "own.toml"
    own_film = replace(FILM, thickness=0.03)
    own_sensor.write_text(sensor_to_toml(replace(sensor, film=own_film)), "utf-8")
    words = "--radius", "3", "--force", "1", "1", "--samples", "5", "--workers", "1", "-o", tmp_path / "presses"
    assert command("simulate", "sweep", own_sensor, *words)[0] == 0
    assert read_deflection_field(tmp_path / "presses" / "deflection.json").fits(film_to_dict(own_film))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"isocharge_deflection": 2}, "the version 1"),
        ({"film": {"radius_mm": 45.0}}, "expected the keys"),
        ({"force_N": [1.0, 0.2]}, "increasing"),
        ({"angles": 10**9}, "at most"),
        ({"deflection": "no base64"}, "base64"),
        ({"scale_mm": -1.0}, "scale_mm"),
    ],
)
def test_damaged_deflection_file_raises_error(field, tmp_path, changes, reason):
    path = tmp_path / "deflection.json"
    path.write_text(json.dumps(msgspec.to_builtins(field) | changes))
    with pytest.raises(InputError, match=reason):
        read_deflection_field(path)
