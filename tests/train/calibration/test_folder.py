"""The folder of a calibrated film: read back by the predictor, the sensor reader and the next calibration."""

import json
import shutil

import numpy as np
import pytest
from tests.train.calibration.conftest import rig

from isocharge.common.errors import ModelError, PressError
from isocharge.serve import Predictor, load_model, read_presses, write_presses
from isocharge.simulate import Circle, Domain, ForwardMap, load_sensor
from isocharge.train import CalibrationProblem, calibrate, read_earlier, write_calibration
from isocharge.train.calibration.folder import calibration_folder
from isocharge.train.data.presses import draw_contacts
from kept import kept

CALIBRATE = ("train", "calibrate", "--sensor", "four-25um-biaxial")


@pytest.fixture(scope="module")
def film(tmp_path_factory, problem):
    """A film, presses on it, and the folder of its calibration."""
    truth, presses = rig(problem, 10, seed=31)
    result = calibrate(presses, problem)
    folder = tmp_path_factory.mktemp("films") / "mine"
    write_calibration(result, folder, "isocharge train calibrate ...")
    write_presses(folder.parent / "presses.csv", presses)
    return truth, result, folder


def test_the_model_is_right_about_the_film(film, problem):
    """On fresh charges, solved for this film and not by the family, with the model that a user opens."""
    truth, result, folder = film
    domain = Domain(5.0, (0.3, 1.0))
    rng = np.random.default_rng(1)
    forward_map = kept(ForwardMap.build, *problem.prior.film(truth), domain.radius, domain.force_range)
    at = draw_contacts(rng, domain, 400)
    charge = problem.noise.add(forward_map.charges(at), rng)

    def error_mm(model) -> float:
        answer = Predictor(model).predict_batch(charge)
        return float(np.sqrt(np.mean((answer.x_mm - at[:, 0]) ** 2 + (answer.y_mm - at[:, 1]) ** 2)))

    expected = np.hypot(result.error_left.position_mm, result.sensitivity.noise_error.position_mm)
    assert error_mm(folder) < 1.5 * expected
    assert error_mm("four-25um-biaxial") > 3.0 * error_mm(folder)


def test_every_file_is_there_and_reads_back(film, problem):
    _, result, folder = film
    table = json.loads((folder / "calibration.json").read_text("utf-8"))
    assert table["error_left"]["position_mm"] == pytest.approx(result.error_left.position_mm)
    assert table["parameters"]["pretension"]["value"] == pytest.approx(1e6 * result.posterior.parameters[0])  # Pa
    assert np.shape(table["correlations"]) == (13, 13)
    parameters = problem.prior.parameters_of(load_sensor(folder / "sensor.toml"), result.film[1])
    np.testing.assert_allclose(parameters, result.posterior.parameters, rtol=0.0, atol=1e-11)
    assert read_presses(folder / "1" / "presses.csv") == result.presses
    card = (folder / "card.md").read_text("utf-8")
    assert "do not determine" in card
    assert "\nisocharge train calibrate ...\n" in card
    assert (folder / "calibration.png").read_bytes()[:4] == b"\x89PNG"
    load_model(folder / "1")


def test_what_is_read_is_what_was_written_but_for_drift(film, problem):
    _, result, folder = film
    earlier = read_earlier(folder, problem)
    expected = result.posterior.drifted(problem.prior)
    np.testing.assert_allclose(earlier.parameters, expected.parameters, rtol=1e-12)
    np.testing.assert_allclose(earlier.covariance, expected.covariance, atol=2e-6)  # correlations have six digits


def test_deviations_cover_what_is_left_of_the_film(film, problem):
    """At each contact that which is left there, beside the noise; the network follows that within some percent."""
    _, result, folder = film
    contact = result.sensitivity.contact
    left = result.sensitivity.contact_covariance(result.posterior.joint)
    charge = problem.charges.charges(result.posterior.unknowns, contact)
    plain = problem.films.fold(result.posterior.parameters).predict(charge)[1]
    ratio = Predictor(folder).predict_batch(charge).x_std_mm / np.hypot(plain[:, 0], np.sqrt(left[:, 0, 0]))
    assert np.median(np.abs(np.log(ratio))) < 0.03
    assert np.abs(np.log(ratio)).max() < 0.5


def test_a_folder_of_something_else_is_left_alone(film, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ModelError, match="expected a new folder or one of an earlier calibration"):
        write_calibration(film[1], tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"parameters": {}, "sensor": "x"}', "[" * 5000])
def test_a_damaged_earlier_calibration_is_refused(problem, tmp_path, text):
    (tmp_path / "calibration.json").write_text(text)
    with pytest.raises(PressError, match=r"calibration\.json"):
        read_earlier(tmp_path, problem)


def test_an_earlier_calibration_of_another_sensor_is_refused(film):
    other = CalibrationProblem.of(load_sensor("three-25um-biaxial"), Circle(1.0))
    with pytest.raises(PressError, match="expected 'three-25um-biaxial'"):
        read_earlier(film[-1], other)


def test_the_command_says_what_is_known_and_where_to_press(film, command):
    folder = film[-1]
    code, out, err = command(*CALIBRATE, folder.parent / "presses.csv", "--next", 2)
    assert code == 0, err
    assert "The uncertainty of the film causes errors of" in out
    assert out.count("\npress ") == 2
    table = json.loads(command(*CALIBRATE, folder.parent / "presses.csv", "--json", "--from", folder)[1])
    assert (table["presses"], table["next"]) == (10, [])


def test_the_next_calibration_is_the_next_version_and_what_lies_above_is_repaired(
    film, problem, tmp_path, command, refused
):
    """Killed between the version and the files above it: nothing above, a draft, or the files of an older version."""
    _, result, folder = film
    presses = folder.parent / "presses.csv"
    killed = tmp_path / "mine"
    shutil.copytree(folder / "1", killed / "1")
    (killed / ".0a1b2c3d.draft").mkdir()
    (killed / "calibration.json").write_text("of an older version")
    assert read_earlier(killed, problem).parameters == pytest.approx(result.posterior.parameters)
    with calibration_folder(killed, problem):
        assert (killed / "sensor.toml").read_bytes() == (killed / "1" / "sensor.toml").read_bytes()
        assert (killed / "calibration.json").read_bytes() == (killed / "1" / "calibration.json").read_bytes()
        refused(*CALIBRATE, presses, "-o", killed, message="another process is at work", code=1)
    assert not list(killed.glob(".*"))
    assert command(*CALIBRATE, presses, "-o", killed)[0] == 0
    assert (killed / "calibration.json").read_bytes() == (killed / "2" / "calibration.json").read_bytes()
    assert (killed / "1" / "model.onnx").read_bytes() == (folder / "1" / "model.onnx").read_bytes()
    assert Predictor(killed).metadata.version == 2


def test_a_folder_is_checked_before_anything_is_read(film, tmp_path, refused):
    """Presses that are not there are not asked for, if the calibration could not be written."""
    shutil.copytree(film[-1], tmp_path / "copy")
    for name, message in (
        ("my film", "model name 'my film'"),
        ("copy", "names the model 'mine', its folder is 'copy'"),
    ):
        refused(*CALIBRATE, tmp_path / "none.csv", "-o", tmp_path / name, message=message)


def test_presses_are_proposed_before_the_first(command):
    proposed = json.loads(command(*CALIBRATE, "--next", 3, "--json")[1])["next"]
    assert [*proposed[0]] == ["x_mm", "y_mm", "force_N", "position_mm", "force_percent"]
    assert proposed[2]["position_mm"] < proposed[0]["position_mm"]
