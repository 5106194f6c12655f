"""`isocharge simulate identify` and `sweep --radius auto` as a user meets them."""

import json
from importlib.resources import files

import pytest
from matplotlib.image import imread

from isocharge.cli.simulate.identify import probe_sentence

UNIAXIAL = ("simulate", "identify", "three-25um-uniaxial", "--radius", "4", "--force", "0.5", "1")


def test_a_map_that_folds_is_told_drawn_and_written(command, tmp_path):
    code, out, err = command(*UNIAXIAL, "--json", "-o", tmp_path / "out")
    assert code == 0
    numbers = json.loads(out)
    assert numbers == json.loads((tmp_path / "out" / "identify.json").read_text())
    assert 1.5 < numbers["working_area"]["fold_radius_mm"] < 5.0
    assert numbers["working_area"]["radius_mm"] < numbers["working_area"]["fold_radius_mm"]
    assert numbers["folds_mm"]
    assert "The map folds" in err
    assert "no method can tell them apart" in err
    picture = imread(tmp_path / "out" / "identify.png")
    assert picture.shape[0] > 400
    assert picture.std() > 0.1


@pytest.mark.slow
def test_other_probes_and_the_size(command):
    words = (
        "--force",
        "0.5",
        "1",
        "--radius",
        "6",
        "--probe",
        "circle:1.0",
        "--probe",
        "circle:2@30",
        "--size",
        "--json",
    )
    code, out, err = command("simulate", "identify", "four-25um-uniaxial", *words)
    assert code == 0
    rows = json.loads(out)["other_probes"]
    assert {row["probe"] for row in rows} == {"circle:2.0"}
    assert rows[-1]["told_apart_share"] > 0.2
    assert "circle:2.0 against circle:1.0" in err
    assert json.loads(out)["size"][-1]["radius_std_best_percent"] < 30.0
    assert "The radius at 1 N is known to" in err


def test_the_sentence_names_the_threshold_that_was_used(monkeypatch):
    """It once said three standard deviations whatever the threshold was."""
    row = {"probe": "circle:2.0", "force_N": 1.0, "within_mm": 8.0, "told_apart_share": 0.25, "sigmas_median": 2.0}
    row |= {"sigmas_most": 9.0, "position_error_median_mm": 0.1, "position_error_p95_mm": 0.2}
    threshold = "isocharge.simulate.identifiability.probe_discrimination.DISTINGUISHABLE_SIGMAS"
    monkeypatch.setattr(threshold, 4.5)
    assert "differ by 4.5 standard deviations or more at 25% of the positions" in probe_sentence(row, "circle:1.0")


@pytest.mark.slow
def test_a_picture_alone_and_noise_from_a_file(command, tmp_path):
    noise = tmp_path / "quiet.toml"
    noise.write_text("white_pC = 0.1\n")
    code, out, _ = command(*UNIAXIAL, "--noise", noise, "-o", tmp_path / "map.png")
    assert code == 0
    assert "1 N" in out
    assert imread(tmp_path / "map.png").shape[1] > 1000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.png", "quiet.toml"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--noise", "clean"), "expected white noise"),
        (("--noise", "loud"), "noise level: expected one of"),
        (("--error", "0"), "--error: expected a positive number"),
        (("--error", "nan"), "--error: expected a positive number"),
        (("--size", "--probe", "triangle:4.0"), "--size: expected a circle"),
        (("--radius", "44.5"), "leave the film of radius 45 mm"),
    ],
)
def test_wrong_words_are_refused_at_once(command, words, message):
    code, out, err = command("simulate", "identify", "three-25um-biaxial", *words)
    assert (code, out) == (2, "")
    assert message in err


def test_two_electrodes_are_refused_before_the_film_is_solved(command, tmp_path):
    text = (files("isocharge.simulate") / "sensors" / "three-25um-biaxial.toml").read_text("utf-8")
    sensor = tmp_path / "two.toml"
    sensor.write_text("\n".join(line for line in text.splitlines() if not line.startswith("C = ")))
    code, out, err = command("simulate", "identify", sensor)
    assert (code, out) == (2, "")
    assert "expected at least three electrodes, got 2" in err


def test_nothing_is_overwritten(command, tmp_path):
    (tmp_path / "map.png").write_text("mine")
    code, _, err = command(*UNIAXIAL, "-o", tmp_path / "map.png")
    assert code == 1
    assert "already there" in err
    assert (tmp_path / "map.png").read_text() == "mine"


@pytest.mark.slow
def test_a_sweep_over_the_working_area(command, tmp_path):
    words = (
        "--radius",
        "auto",
        "--force",
        "0.5",
        "1",
        "--samples",
        "200",
        "--workers",
        "1",
        "-o",
        tmp_path / "presses",
    )
    code, _, err = command("simulate", "sweep", "three-25um-biaxial", *words)
    assert code == 0
    radius = json.loads((tmp_path / "presses" / "manifest.json").read_text())["ranges"]["radius_mm"]
    assert 8.0 < radius < 9.9
    assert f"circle:1.0: Working area: up to {radius:g} mm" in err


def test_a_radius_is_a_number_or_auto(command, tmp_path):
    code, _, err = command("simulate", "sweep", "three-25um-biaxial", "--radius", "all", "-o", tmp_path / "presses")
    assert code == 2
    assert "expected a number of mm or 'auto', got 'all'" in err
