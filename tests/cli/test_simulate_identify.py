"""Output and error messages of `isocharge simulate identify`."""

import json

import pytest
from matplotlib.image import imread

from isocharge.simulate import ForwardMap
from whole_films import build_from_default_map

UNIAXIAL = ("simulate", "identify", "three-25um-uniaxial", "--radius", "3.5", "--force", "0.9", "1.1", "--workers", "1")


def test_a_map_that_folds_is_reported_drawn_and_written(command, refused, tmp_path, monkeypatch):
    monkeypatch.setattr(ForwardMap, "build", build_from_default_map)
    monkeypatch.setattr("isocharge.simulate.identifiability.mirror_region.N_SECTORS", 12)
    noise = tmp_path / "quiet.toml"
    noise.write_text("white_pC = 0.5\n")
    code, out, err = command(*UNIAXIAL, "--noise", noise, "--json", "-o", tmp_path / "out")
    numbers = json.loads(out)
    assert (code, numbers) == (0, json.loads((tmp_path / "out" / "identify.json").read_text()))
    area = numbers["working_area"]
    assert max(1.5, area["radius_mm"]) < area["fold_radius_mm"] < 5.0
    assert numbers["folds_mm"]
    assert (
        "on both sides of the fold give the same charges, and no method can distinguish these contacts by one reading"
        in err
    )
    mirror = numbers["mirror_region"]
    assert (mirror["from_mm"], mirror["to_mm"]) == (area["radius_mm"], pytest.approx(42.8))
    assert mirror["words"] in err
    for name in ("identify.png", "mirror.png"):
        assert imread(tmp_path / "out" / name).std() > 0.1
    refused(*UNIAXIAL, "-o", tmp_path / "out", message="already there", code=1)  # before anything is solved
