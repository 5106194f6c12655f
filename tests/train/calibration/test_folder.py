"""Tests of the folder of a calibrated film, which predictor, sensor reader and further calibrations read."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from tests.train.calibration.conftest import rig

from isocharge.common.deflection_field import read_deflection_field
from isocharge.common.errors import ModelError, PressError
from isocharge.common.statistics import rms
from isocharge.serve import Predictor, load_model, read_presses, write_presses
from isocharge.simulate import Circle, Domain, ForwardMap, load_sensor
from isocharge.train import CalibrationProblem, calibrate, read_earlier, write_calibration
from isocharge.train.calibration import contact_error
from isocharge.train.calibration.contact_error import ContactSensitivity
from isocharge.train.calibration.folder import calibration_folder
from isocharge.train.data.presses import draw_contacts
from kept import kept

pytestmark = pytest.mark.usefixtures("no_closed_backs")

CALIBRATE = ("train", "calibrate", "--sensor", "four-25um-biaxial")


@pytest.fixture(scope="module")
def film(tmp_path_factory, problem):
    """The true parameters of a film, its calibration by ten presses, and the folder of the calibration."""
    truth, presses = rig(problem, 10, seed=31)
    result = calibrate(presses, problem)
    folder = tmp_path_factory.mktemp("films") / "mine"
    write_calibration(result, folder, "isocharge train calibrate ...")
    write_presses(folder.parent / "presses.csv", presses)
    return truth, result, folder


def test_calibrated_model_has_the_expected_errors_on_the_film(film, problem):
    """The charges come from a forward map that is solved for the true film."""
    truth, result, folder = film
    domain = Domain(5.0, (0.3, 1.0))
    rng = np.random.default_rng(1)
    forward_map = kept(ForwardMap.build, *problem.prior.film(truth), domain.radius, domain.force_range)
    contact = draw_contacts(rng, domain, 400)
    charge = problem.noise.add(forward_map.charges(contact), rng)

    def rms_error_mm(model) -> float:
        answer = Predictor(model).predict_batch(charge)
        return rms(np.hypot(answer.x_mm - contact[:, 0], answer.y_mm - contact[:, 1]))

    expected_mm = np.hypot(result.film_error.position_mm, result.sensitivity.noise_error.position_mm)
    assert rms_error_mm(folder) < 1.5 * expected_mm
    assert rms_error_mm("four-25um-biaxial") > 3.0 * rms_error_mm(folder)


def test_all_files_are_written_and_read_back(film, problem):
    _, result, folder = film
    table = json.loads((folder / "calibration.json").read_text("utf-8"))
    assert table["error_left"]["position_mm"] == pytest.approx(result.film_error.position_mm)
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


def test_earlier_calibration_is_read_with_the_uncertainty_of_a_drift(film, problem):
    _, result, folder = film
    earlier = read_earlier(folder, problem)
    expected = result.posterior.drifted(problem.prior)
    np.testing.assert_allclose(earlier.parameters, expected.parameters, rtol=1e-12)
    np.testing.assert_allclose(earlier.covariance, expected.covariance, atol=2e-6)  # correlations have six digits


def test_standard_deviations_include_the_uncertainty_of_the_film(film, problem):
    """The variance of x is the sum of the variance by noise and of the variance by the uncertainty of the film."""
    _, result, folder = film
    contact = result.sensitivity.contact
    charge = problem.charges.charges(result.posterior.unknowns, contact)
    _, noise_std, _ = problem.films.fold(result.posterior.parameters).predict(charge)
    film_covariance = result.sensitivity.contact_covariance(result.posterior.joint)
    expected_std = np.sqrt(noise_std[:, 0] ** 2 + film_covariance[:, 0, 0])
    log_ratio = np.log(Predictor(folder).predict_batch(charge).x_std_mm / expected_std)
    assert np.median(np.abs(log_ratio)) < 0.03
    assert np.abs(log_ratio).max() < 0.5


def ellipse_coverage(result, network, monkeypatch):
    """Return the shares of the errors within the 95 % ellipses of (x, y) and within the 95 % ellipsoids of (x, y, F).

    The errors are caused by noise and by films that are drawn from the posterior of the calibration. They are computed
    at other contacts than those from which the calibration computes the covariances.
    """
    problem, posterior = result.problem, result.posterior
    monkeypatch.setattr(contact_error, "N_CONTACTS", 300)
    sensitivity = ContactSensitivity.for_film(problem, posterior.unknowns)
    exact_charge = problem.charges.charges(posterior.unknowns, sensitivity.contact)
    copies = np.arange(9000) % 300  # each copy has its own noise and its own film
    contact = sensitivity.contact[copies]
    rng = np.random.default_rng(4)
    charge = problem.noise.add(exact_charge[copies], rng)
    estimate, std, correlation, _ = network.outputs(charge)
    film = rng.multivariate_normal(np.zeros(len(posterior.joint)), posterior.joint, len(contact))
    error = np.column_stack([estimate[:, :2] - contact[:, :2], np.log(estimate[:, 2] / contact[:, 2])])
    error += np.einsum("nip,np->ni", sensitivity.contact_jacobian[copies], film)
    deviation = error / np.column_stack([std[:, :2], std[:, 2] / estimate[:, 2]])
    matrices = np.tile(np.eye(3), (len(contact), 1, 1))
    for column, (row, other) in enumerate(((0, 1), (0, 2), (1, 2))):
        matrices[:, row, other] = matrices[:, other, row] = correlation[:, column]
    return [
        np.mean(
            np.sum(deviation[:, :n] * np.linalg.solve(matrices[:, :n, :n], deviation[:, :n, None])[..., 0], 1) < limit
        )
        for n, limit in ((2, 5.991), (3, 7.815))  # 95 % quantiles of chi-squared
    ]


def test_95_percent_ellipses_contain_95_percent_of_the_errors_of_film_and_noise(film, monkeypatch):
    monkeypatch.setattr(contact_error, "N_CONTACTS", 200)  # as in use, not as few as the fixture `coarse` sets
    result = replace(film[1])  # without the results that were computed from few contacts
    network = result.fitted_film(result.posterior.parameters, release=True).network
    assert ellipse_coverage(result, network, monkeypatch) == pytest.approx([0.95, 0.95], abs=0.02)


def test_folder_with_other_files_is_refused_and_not_changed(film, tmp_path):
    _, result, _ = film
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ModelError, match="expected a new folder or one of an earlier calibration"):
        write_calibration(result, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"parameters": {}, "sensor": "x"}', "[" * 5000])
def test_a_damaged_earlier_calibration_is_refused(problem, tmp_path, text):
    (tmp_path / "calibration.json").write_text(text)
    with pytest.raises(PressError, match=r"calibration\.json"):
        read_earlier(tmp_path, problem)


def test_an_earlier_calibration_of_another_sensor_is_refused(film):
    _, _, folder = film
    other = CalibrationProblem.of(load_sensor("three-25um-biaxial"), Circle(1.0))
    with pytest.raises(PressError, match="expected 'three-25um-biaxial'"):
        read_earlier(folder, other)


def test_command_prints_the_remaining_error_and_the_next_presses(film, command):
    _, _, folder = film
    code, out, err = command(*CALIBRATE, folder.parent / "presses.csv", "--next", 2)
    assert code == 0, err
    assert "The uncertainty of the film causes errors of" in out
    assert out.count("\npress ") == 2
    table = json.loads(command(*CALIBRATE, folder.parent / "presses.csv", "--json", "--from", folder)[1])
    assert table["presses"] == 10
    assert table["next"] == []


@pytest.fixture
def interrupted(film, tmp_path):
    """A folder as a killed process leaves it: a whole version, an unfinished draft, and old copies of its files."""
    _, _, folder = film
    interrupted = tmp_path / "mine"
    shutil.copytree(folder / "1", interrupted / "1")
    (interrupted / ".0a1b2c3d.draft").mkdir()
    (interrupted / "calibration.json").write_text("of an older version")
    return interrupted


def test_folder_of_a_killed_process_is_repaired_and_locked(film, problem, interrupted, refused):
    _, result, folder = film
    assert read_earlier(interrupted, problem).parameters == pytest.approx(result.posterior.parameters)
    with calibration_folder(interrupted, problem):
        for name in ("sensor.toml", "calibration.json"):
            assert (interrupted / name).read_bytes() == (interrupted / "1" / name).read_bytes()
        presses = folder.parent / "presses.csv"
        refused(*CALIBRATE, presses, "-o", interrupted, message="another process is at work", code=1)
    assert not list(interrupted.glob(".*"))


def test_next_calibration_is_the_next_version(film, interrupted, command):
    _, _, folder = film
    assert command(*CALIBRATE, folder.parent / "presses.csv", "-o", interrupted)[0] == 0
    calibrated_film = load_model(interrupted / "2").metadata.sensor["film"]
    assert read_deflection_field(interrupted / "2" / "deflection.json").fits(calibrated_film)
    assert (interrupted / "calibration.json").read_bytes() == (interrupted / "2" / "calibration.json").read_bytes()
    assert (interrupted / "1" / "model.onnx").read_bytes() == (folder / "1" / "model.onnx").read_bytes()
    assert Predictor(interrupted).metadata.version == 2


def test_output_folder_is_checked_before_the_presses_are_read(film, tmp_path, refused):
    """The file of presses does not exist, and the error is about the output folder."""
    _, _, folder = film
    shutil.copytree(folder, tmp_path / "copy")
    missing = tmp_path / "none.csv"
    refused(*CALIBRATE, missing, "-o", tmp_path / "my film", message="model name 'my film'")
    refused(*CALIBRATE, missing, "-o", tmp_path / "copy", message="names the model 'mine', its folder is 'copy'")


def test_presses_are_proposed_without_a_first_press(command):
    _, out, _ = command(*CALIBRATE, "--next", 3, "--json")
    proposed = json.loads(out)["next"]
    assert [*proposed[0]] == ["x_mm", "y_mm", "force_N", "position_mm", "force_percent"]
    assert proposed[2]["position_mm"] < proposed[0]["position_mm"]
