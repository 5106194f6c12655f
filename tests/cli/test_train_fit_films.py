"""`train fit --films`: what it refuses, before any work."""

import pytest


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["presses", "--films"], "--films: expected --sensor SENSOR alone, got presses"),
        (
            ["--sensor", "four-25um-biaxial", "--films", "--radius", "auto"],
            "--films: expected --radius in mm, got auto",
        ),
        (
            ["--sensor", "four-25um-biaxial", "--films", "--probe", "rectangle:4x2"],
            "--films: expected one round probe",
        ),
        (
            ["--sensor", "four-25um-biaxial", "--films", "--probe", "circle:1", "--probe", "circle:2"],
            "--films: expected one round probe",
        ),
        (["--sensor", "four-25um-biaxial", "--films", "--config", "quick.toml"], "--films: expected no --config"),
        (["--films"], "expected either a DATASET folder or --sensor"),
    ],
)
def test_what_films_refuse(command, tmp_path, words, said):
    code, _, err = command("train", "fit", *words, "-o", str(tmp_path / "mine"))
    assert code == 2
    assert said in err
    assert not (tmp_path / "mine").exists()
