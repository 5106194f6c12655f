"""`isocharge simulate identify` and `sweep --radius auto` as a user meets them."""

import json

import pytest
from matplotlib.image import imread

UNIAXIAL = ("simulate", "identify", "three-25um-uniaxial", "--radius", "3.5", "--force", "1", "1")


def test_a_map_that_folds_is_reported_drawn_and_written(command, tmp_path):
    noise = tmp_path / "quiet.toml"
    noise.write_text("white_pC = 0.5\n")
    code, out, err = command(*UNIAXIAL, "--noise", noise, "--json", "-o", tmp_path / "out")
    assert code == 0
    numbers = json.loads(out)
    assert numbers == json.loads((tmp_path / "out" / "identify.json").read_text())
    assert 1.5 < numbers["working_area"]["fold_radius_mm"] < 5.0
    assert numbers["working_area"]["radius_mm"] < numbers["working_area"]["fold_radius_mm"]
    assert numbers["folds_mm"]
    assert "no method can tell them apart by one reading" in err
    assert f"on {100.0 * numbers['working_area']['determined_share']:.0f} % of the 3.5 mm searched" in err
    picture = imread(tmp_path / "out" / "identify.png")
    assert picture.shape[0] > 400
    assert picture.std() > 0.1
    code, out, err = command(*UNIAXIAL, "-o", tmp_path / "out")  # before anything is solved
    assert (code, out) == (1, "")
    assert "already there" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--noise", "clean"), "expected white noise"),
        (("--noise", "loud"), "noise level: expected one of"),
        (("--error", "nan"), "--error: expected a positive number"),
        (("--radius", "44.5"), "leave the film of radius 45 mm"),
    ],
)
def test_wrong_words_are_refused_at_once(command, words, message):
    code, out, err = command("simulate", "identify", "three-25um-biaxial", *words)
    assert (code, out) == (2, "")
    assert message in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--radius", "all"), "expected a number of mm or 'auto', got 'all'"),
        (("--workers", "2", "--cluster", "tcp://127.0.0.1:9"), "expected either --workers or --cluster, got both"),
    ],
)
def test_wrong_words_of_a_sweep(command, tmp_path, words, message):
    code, _, err = command("simulate", "sweep", "three-25um-biaxial", *words, "-o", tmp_path / "presses")
    assert code == 2
    assert message in err
