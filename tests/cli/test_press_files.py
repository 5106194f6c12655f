"""Commands that read a file of presses: names of columns in messages, and long files."""

from pathlib import Path

import pytest

from isocharge.cli.train import calibrate as calibrate_module
from isocharge.common.defaults import MAX_BATCH
from isocharge.serve import Predictor
from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationProblem
from isocharge.train.calibration.folder import film_table, json_text


def test_a_missing_column_of_a_training_is_named(refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.csv").write_text("force_N,A,B,C,D\n1,100,200,300,400\n")
    refused("train", "fit", "p.csv", "-o", "models/pad", message="add the column 'x_mm', 'y_mm'")
    assert list(tmp_path.iterdir()) == [tmp_path / "p.csv"]


def test_a_long_table_is_predicted_in_pieces(command, tmp_path, monkeypatch):
    """The memory must not grow with the number of presses that the model computes at the same time."""
    predict_batch = Predictor.predict_batch
    sizes = []

    def recorded(self, charge_pC):
        sizes.append(len(charge_pC))
        return predict_batch(self, charge_pC)

    monkeypatch.setattr(Predictor, "predict_batch", recorded)
    path = tmp_path / "p.csv"
    for count in (MAX_BATCH + 1, 0):
        path.write_text("A,B,C,D\n" + "500,500,500,500\n" * count)
        _, out, _ = command("serve", "predict", "four-25um-biaxial", path)
        _, *rows = out.splitlines()
        assert (len(rows), len(set(rows))) == (count, min(count, 1))
    assert sizes == [MAX_BATCH, 1]


@pytest.mark.parametrize("setting", ['noise = "measured"', "hold_out = 0.2"])
def test_a_setting_without_effect_on_measured_presses_is_refused(refused, tmp_path, setting):
    (tmp_path / "p.csv").write_text("x_mm,y_mm,force_N,A,B,C\n1,2,1,100,200,300\n")
    (tmp_path / "c.toml").write_text(f"[training]\n{setting}\n")
    words = "train", "fit", tmp_path / "p.csv", "--config", tmp_path / "c.toml", "-o", tmp_path / "models" / "pad"
    refused(*words, message=f"training.{setting.split()[0]} has no effect on measured presses")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("calibrate old/1/presses.csv -o film --held-out old/1/presses.csv", "held-out presses that are not among"),
        ("calibrate old/1/presses.csv --from old", "presses that are not among those of the earlier calibration old/1"),
        ("calibrate new.csv --from old -o new --held-out old/1/presses.csv", "presses that are not among those of"),
        ("press -o old/1/presses.csv --from old --port none", "presses that are not among those of the earlier"),
    ],
)
def test_presses_that_would_count_twice_are_refused(words, message, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(calibrate_module, "calibrate", None)  # a call would be an error: the film must not be solved
    problem = CalibrationProblem(load_sensor("four-25um-biaxial"), Circle(1.0))
    for version in ("old/1", "old/2"):  # the second calibration continued the first
        Path(version).mkdir(parents=True)
        Path(version, "calibration.json").write_text(json_text(film_table(problem, problem.film_before)))
    Path("old/1/presses.csv").write_text("x_mm,y_mm,force_N,A,B,C,D\n1,2,1,500,500,500,500\n")
    Path("new.csv").write_text("x_mm,y_mm,force_N,A,B,C,D\n1,2,1,400,500,500,500\n")
    refused("train", *words.split(), "--sensor", "four-25um-biaxial", message=f"line 2: expected {message}")
