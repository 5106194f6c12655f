"""Output and error messages of `isocharge simulate design`."""

import json
from dataclasses import replace

import pytest

from isocharge.simulate import Calibration, ChargeSpline, load_sensor, write_sensor
from isocharge.simulate.forward.family import NodeCount
from isocharge.simulate.layout import case as case_module
from isocharge.simulate.layout import design as design_module
from isocharge.simulate.layout import stress_fields

DESIGN = ("simulate", "design", "three-25um-biaxial", "--electrodes")
FILES = ["design.json", "design.png", "layout.dxf", "layout.svg", "sensor.toml"]


@pytest.fixture
def _rough(monkeypatch):
    """The search is coarse and does not search for folds in a map of its own, because this would take half a minute."""
    monkeypatch.setattr(case_module, "FINE_PRESSES", 60)
    monkeypatch.setattr(case_module, "SEARCH_PRESSES", 20)
    monkeypatch.setattr(design_module, "STARTS", 1)
    monkeypatch.setattr(design_module, "ROUNDS", 1)
    monkeypatch.setattr(stress_fields, "NODE_COUNT", NodeCount(distances=2, forces=1))
    monkeypatch.setattr(design_module, "describe_ambiguities", lambda *_: design_module.UNAMBIGUOUS)
    monkeypatch.setattr(design_module, "_solve_forward_map", lambda case, _: case)
    monkeypatch.setattr(ChargeSpline, "of", lambda _: None)


@pytest.mark.usefixtures("_rough")
def test_a_design_is_a_folder_that_other_commands_read(command, tmp_path, monkeypatch):
    folder = tmp_path / "mine"
    words = (*DESIGN, "3", "--radius", "4", "--keep", "A", "--known", "--workers", "1", "-o", folder)
    with monkeypatch.context() as patch:
        patch.setattr(design_module, "solve_fields", lambda *_: exec("raise KeyboardInterrupt"))
        assert command(*words)[0] == 130
    assert list(tmp_path.iterdir()) == []
    code, out, err = command(*words)
    messages = "no folds, no ambiguous pairs", "caution: 1 N under circle:1.0 stress the film to 48.9 MPa"
    assert (code, all(words in err for words in messages)) == (0, True), err
    assert sorted(path.name for path in folder.iterdir()) == FILES
    numbers = json.loads((folder / "design.json").read_text())
    sensor, before = load_sensor(folder / "sensor.toml"), load_sensor("three-25um-biaxial")
    assert sensor.electrodes[0] == before.electrodes[0]
    assert replace(sensor, name="", electrodes=before.electrodes) == replace(before, name="")
    places = {name: list(place) for name, place in numbers["electrodes_mm"].items()}
    assert places == {e.name: pytest.approx(e.centre, abs=1e-3) for e in sensor.electrodes}
    assert numbers["after"]["noise_alone"]["worst_mm"] < numbers["before"]["noise_alone"]["worst_mm"]
    assert f"{numbers['after']['noise_alone']['worst_mm']:.5g}" in out
    assert (folder / "design.png").read_bytes().startswith(b"\x89PNG")
    assert command(*words)[0] == 1  # nothing is overwritten


def test_kept_names_may_contain_blanks(command, tmp_path):
    """The error is raised after the kept electrodes have been found."""
    sensor = load_sensor("three-25um-biaxial")
    first, *others = sensor.electrodes
    renamed = replace(
        sensor, electrodes=(replace(first, name="left pad"), *others), calibration=Calibration(rotation=0.1)
    )
    write_sensor(renamed, tmp_path / "mine.toml")
    words = ("--electrodes", "4", "--keep", "left pad, B", "--radius", "4", "-o", tmp_path / "new")
    code, _, err = command("simulate", "design", tmp_path / "mine.toml", *words)
    assert (code, "is calibrated" in err) == (2, True), err
