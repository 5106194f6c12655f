"""The folder of a calibrated film: read back by the predictor, the sensor reader and the next calibration."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.train.calibration.conftest import contacts, rig
from typer.testing import CliRunner

from isocharge.cli import app
from isocharge.common.errors import InputError, ModelError, PressError
from isocharge.serve import Predictor, load_model, read_presses, write_presses
from isocharge.simulate import Circle, ForwardMap, load_sensor
from isocharge.train import calibrate, films_for, read_earlier, write_calibration

SENSOR = ["--sensor", "four-25um-biaxial"]


@pytest.fixture(scope="module")
def bench(tmp_path_factory, four):
    """A film, presses on it, and the folder of its calibration."""
    truth, presses = rig(four.scene.charges, 10, seed=31)
    calibration = calibrate(presses, four.scene, four.described, warn=lambda _: None)
    folder = tmp_path_factory.mktemp("films") / "mine"
    write_calibration(folder, calibration, four.films, "isocharge train calibrate ...")
    write_presses(folder.parent / "presses.csv", presses)
    return truth, presses, calibration, folder


def run(*arguments: str | Path, code: int = 0):
    result = CliRunner().invoke(app, ["train", "calibrate", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result


def test_the_model_is_right_about_the_film(bench, four):
    """On fresh charges, solved for this film and not by the family, with the model that a user opens."""
    truth, _, calibration, folder = bench
    sensor, probe = four.films.prior.film(truth)
    forward_map = ForwardMap.build(sensor, probe, 8.1e-3)
    rng = np.random.default_rng(1)
    at = contacts(rng, 400)
    charge = 1e12 * forward_map.forward(1e-3 * at[:, 0], 1e-3 * at[:, 1], at[:, 2])
    charge = charge + np.hypot(1.0, 0.002 * charge) * rng.standard_normal(charge.shape)

    def error_mm(model) -> float:
        answer = Predictor(model).predict_batch(charge)
        return float(np.sqrt(np.mean((answer.x_mm - at[:, 0]) ** 2 + (answer.y_mm - at[:, 1]) ** 2)))

    expected = np.hypot(calibration.left.position_mm, calibration.sensitivity.of_noise().position_mm)
    assert error_mm(folder) < 1.5 * expected
    assert error_mm("four-25um-biaxial") > 3.0 * error_mm(folder)


def test_the_sensor_file_is_the_calibrated_sensor(bench, four):
    _, _, calibration, folder = bench
    sensor = load_sensor(folder / "sensor.toml")
    parameters = four.films.prior.parameters_of(sensor, calibration.film[1])
    np.testing.assert_allclose(parameters, calibration.posterior.parameters, rtol=1e-9, atol=1e-12)
    assert Predictor(folder).metadata.sensor["film"] == pytest.approx(json.loads(json.dumps(_film_table(sensor))))


def _film_table(sensor):
    film = sensor.film
    return {
        "radius_mm": 1e3 * film.radius,
        "thickness_um": 1e6 * film.thickness,
        "young_GPa": 1e-9 * film.young,
        "poisson": film.poisson,
        "pretension_MPa": 1e-6 * film.pretension,
    }


def test_every_file_is_there_and_reads_back(bench):
    _, presses, calibration, folder = bench
    table = json.loads((folder / "calibration.json").read_text("utf-8"))
    assert table["error_left"]["position_mm"] == pytest.approx(calibration.left.position_mm)
    assert np.shape(table["correlations"]) == (13, 13)
    assert read_presses(folder / "1" / "presses.csv", ("A", "B", "C", "D")) == presses
    assert "cannot tell" in (folder / "card.md").read_text("utf-8")
    assert (folder / "calibration.png").read_bytes()[:4] == b"\x89PNG"
    load_model(folder / "1")


def test_deviations_cover_what_is_left_of_the_film(bench, four):
    _, presses, calibration, folder = bench
    plain = four.films.fold(calibration.posterior.parameters).predict(presses.charge_pC)[1]
    answer = Predictor(folder).predict_batch(presses.charge_pC)
    noise = calibration.sensitivity.of_noise()
    np.testing.assert_allclose(
        answer.x_std_mm / plain[:, 0], np.hypot(1.0, calibration.left.position_mm / noise.position_mm), rtol=1e-4
    )


def test_the_next_calibration_is_the_next_version(bench, four):
    _, presses, _, folder = bench
    earlier = read_earlier(folder, four.scene)
    again = calibrate(presses, four.scene, earlier, warn=lambda _: None)
    first = (folder / "1" / "model.onnx").read_bytes()
    assert write_calibration(folder, again, four.films) == folder / "2"
    assert (folder / "1" / "model.onnx").read_bytes() == first
    assert Predictor(folder).metadata.version == 2
    assert (folder / "calibration.json").read_bytes() == (folder / "2" / "calibration.json").read_bytes()


def test_a_folder_of_something_else_is_left_alone(bench, four, tmp_path):
    *_, calibration, _ = bench
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ModelError, match="expected a new folder or one of an earlier calibration"):
        write_calibration(tmp_path, calibration, four.films)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt"]


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"parameters": {}, "sensor": "x"}', "[" * 5000])
def test_a_damaged_earlier_calibration_is_refused(four, tmp_path, text):
    (tmp_path / "calibration.json").write_text(text)
    with pytest.raises(PressError, match=r"calibration\.json"):
        read_earlier(tmp_path, four.scene)


def test_an_earlier_calibration_of_another_sensor_is_refused(bench):
    other = films_for(load_sensor("three-25um-biaxial"), Circle(1e-3))
    with pytest.raises(PressError, match="expected 'three-25um-biaxial'"):
        read_earlier(bench[-1], other.scene)


def test_the_command_does_it_all(bench, tmp_path):
    folder = bench[-1]
    result = run(folder.parent / "presses.csv", *SENSOR, "-o", tmp_path / "film", "--next", 2)
    assert "Not knowing the film leaves" in result.stdout
    assert result.stdout.count("\npress ") == 2
    table = json.loads(run(folder.parent / "presses.csv", *SENSOR, "--json", "--from", tmp_path / "film").stdout)
    assert table["presses"] == 10
    assert table["next"] == []
    assert len(Predictor(tmp_path / "film").metadata.electrodes) == 4


def test_presses_are_proposed_before_the_first():
    proposed = json.loads(run(*SENSOR, "--next", 3, "--json").stdout)["next"]
    assert len(proposed) == 3
    assert proposed[-1]["position_mm"] < proposed[0]["position_mm"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "expected PRESSES.csv, or --next K"),
        (["--next", "2", "-o", "film"], "nothing is calibrated without PRESSES.csv"),
        (["--next", "2", "--probe", "triangle:4.0"], "expected a round one"),
    ],
)
def test_wrong_usage_is_said(arguments, words):
    result = CliRunner().invoke(app, ["train", "calibrate", *SENSOR, *arguments])
    assert isinstance(result.exception, InputError)
    assert words in str(result.exception)


def test_a_refused_file_leaves_no_folder(bench, tmp_path):
    _, presses, _, _ = bench
    swapped = replace(presses, charge_pC=presses.charge_pC[:, [1, 0, 2, 3]])
    write_presses(tmp_path / "swapped.csv", swapped)
    result = CliRunner().invoke(
        app, ["train", "calibrate", str(tmp_path / "swapped.csv"), *SENSOR, "-o", str(tmp_path / "film")]
    )
    assert isinstance(result.exception, PressError)
    assert not (tmp_path / "film").exists()
