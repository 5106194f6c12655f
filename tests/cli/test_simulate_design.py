"""`isocharge simulate design` as a user meets it."""

import json
from dataclasses import replace

import pytest

from isocharge.cli.simulate.design import _sides, _zone
from isocharge.common.errors import InputError
from isocharge.simulate import load_sensor
from isocharge.simulate.layout import design as design_module

DESIGN = ("simulate", "design", "three-25um-biaxial", "--electrodes")
FILES = ["design.html", "design.json", "layout.dxf", "layout.svg", "sensor.toml"]


@pytest.fixture
def _small(monkeypatch):
    """A rough search: the command's own takes a minute."""
    search = design_module.run_design

    def rough(task, **choices):
        return search(task, presses=50, **choices)

    monkeypatch.setattr(design_module, "run_design", rough)


@pytest.mark.usefixtures("_small")
def test_a_design_is_a_folder_that_other_commands_read(command, tmp_path):
    folder = tmp_path / "mine"
    words = (
        *DESIGN,
        "3",
        "--radius",
        "4",
        "--keep",
        "A",
        "--known",
        "--starts",
        "2",
        "--workers",
        "1",
        "--json",
        "-o",
        folder,
    )
    code, out, err = command(*words)
    assert code == 0, err
    numbers = json.loads(out)
    assert sorted(path.name for path in folder.iterdir()) == FILES
    assert numbers == json.loads((folder / "design.json").read_text())
    sensor, before = load_sensor(folder / "sensor.toml"), load_sensor("three-25um-biaxial")
    assert sensor.electrodes[0] == before.electrodes[0]
    assert replace(sensor, name="", electrodes=before.electrodes) == replace(before, name="")
    places = {name: list(place) for name, place in numbers["electrodes_mm"].items()}
    assert places == {e.name: pytest.approx([1e3 * v for v in e.centre], abs=1e-3) for e in sensor.electrodes}
    scene = numbers["scenes"][0]
    assert scene["after"]["noise_alone"]["worst_mm"] < scene["before"]["noise_alone"]["worst_mm"]
    page = (folder / "design.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert 'id="electrode-A"' in page
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")
    assert "no folds, no twins; all 3 leads reach the rim" in err
    assert command(*words)[0] == 1  # nothing is overwritten


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("2", "--radius", "8"), "two electrodes give two numbers"),
        (("3", "--radius", "60"), "leave the film of radius 45 mm"),
        (("8", "--radius", "8", "--side", "30"), "do not fit"),
        (("3", "--radius", "8", "--keep-out", "0,0"), "expected X,Y,RADIUS"),
        (("3", "--radius", "8", "--keep-out", "0,0,44"), "do not fit"),
        (("3", "--radius", "8", "--goal", "best"), "expected 'worst', 'rms' or a CSV file"),
        (("3", "--radius", "8", "--keep", "Q"), "no electrode 'Q'"),
        (("3", "--radius", "nan"), "radius: expected a positive number"),
        (("3", "--radius", "8", "--side", "3:x"), "--side: expected numbers of mm"),
        (("3", "--radius", "8", "--workers", "1", "--cluster", "tcp://x"), "either --workers or --cluster"),
    ],
)
def test_bad_input_is_refused_before_the_search(command, tmp_path, words, message):
    code, _, err = command(*DESIGN, *words, "-o", tmp_path / "mine")
    assert code == 2
    assert message in " ".join(err.split())
    assert list(tmp_path.iterdir()) == []


def test_sides_and_zones_are_read_in_mm():
    assert _sides(None) is None
    assert _sides("3") == pytest.approx((3e-3, 3e-3))
    assert _sides("2:4") == pytest.approx((2e-3, 4e-3))
    zone = _zone("1, -2,3")
    assert (*zone.centre, zone.radius) == pytest.approx((1e-3, -2e-3, 3e-3))
    with pytest.raises(InputError, match="--keep-out"):
        _zone("1,2,x")
