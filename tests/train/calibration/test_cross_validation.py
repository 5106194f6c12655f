"""Tests of the held-out errors of a calibration, against calibrations without the held-out presses."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.train.calibration.conftest import rig

from isocharge.common.contact_errors import position_error
from isocharge.serve import Predictor, load_model, write_presses
from isocharge.train import calibrate, write_calibration
from isocharge.train.calibration.cross_validation import FEWEST_MEASURED, FOLD_COUNT
from isocharge.train.data.presses import folds_by_place
from isocharge.train.model_release.evaluate import evaluate

pytestmark = pytest.mark.usefixtures("no_closed_backs")

PRESS_COUNT = 60


@pytest.fixture(scope="module")
def session(problem):
    """A film, and sixty presses on it, one of them with a wrong place."""
    truth, presses = rig(problem, PRESS_COUNT, seed=31)
    presses.contact[7, :2] += 3.0
    return truth, presses


@pytest.fixture(scope="module")
def result(problem, session):
    return calibrate(session[1], problem)


def test_held_out_answers_are_those_of_a_calibration_without_the_fold(problem, session, result):
    """The film is calibrated by the public function to all presses that are not in the first fold."""
    _, presses = session
    good = presses[~result.posterior.bad]
    assert result.bad_lines == (presses.lines[7],)
    held_out = result.held_out
    is_judged = np.hypot(good.contact[:, 0], good.contact[:, 1]) <= problem.domain.radius
    low, high = problem.domain.force_range
    is_judged &= (good.contact[:, 2] >= low) & (good.contact[:, 2] <= high)
    np.testing.assert_array_equal(held_out.presses.contact, good.contact[is_judged])

    in_first_fold = np.zeros(len(good), dtype=bool)
    in_first_fold[is_judged] = folds_by_place(good.contact[is_judged], FOLD_COUNT) == 0
    independent = calibrate(good[~in_first_fold], problem)
    network = independent.fitted_film(independent.posterior.parameters)
    expected_contact, std, _ = network.predict(good.charge_pC[in_first_fold])
    contact = held_out.answers.contact[in_first_fold[is_judged]]
    np.testing.assert_array_less(np.abs(contact - expected_contact), 0.2 * std + 1e-3)


def test_held_out_errors_are_about_those_on_new_presses(problem, session, result):
    """The new presses are made on the same film and measured with the same errors."""
    truth, _ = session
    same_film, fresh = rig(problem, 1000, seed=31)
    assert np.array_equal(same_film, truth)
    contact, _, _ = result.fitted_film(result.posterior.parameters).predict(fresh.charge_pC)
    fresh_rms_mm = np.sqrt(np.mean(position_error(contact, fresh.contact) ** 2))
    errors = result.held_out.errors
    assert errors["position_rms_mm"] == pytest.approx(fresh_rms_mm, rel=0.4)
    assert 0.85 < errors["coverage_95"] <= 1.0


def test_card_and_calibration_file_state_the_held_out_errors(result, tmp_path):
    folder = tmp_path / "mine"
    write_calibration(result, folder)
    count = len(result.held_out.presses)
    table = json.loads((folder / "calibration.json").read_text("utf-8"))["held_out"]
    assert table["presses"] == count >= 50
    assert table["folds"] == FOLD_COUNT
    card = (folder / "card.md").read_text("utf-8")
    assert f"On {count} measured presses. They are divided by their places into 5 parts" in card
    assert f"| position, rms | {table['position_rms_mm']:g} mm |" in card
    errors = load_model(folder / "1").metadata.errors
    assert errors["measured_presses"] == count
    assert errors["position_rms_mm"] == table["position_rms_mm"]


def test_few_presses_have_no_held_out_errors(session, result):
    _, presses = session
    few = np.flatnonzero(~result.posterior.bad)[: FEWEST_MEASURED - 1]
    posterior = replace(result.posterior, bad=result.posterior.bad[few])
    calibration = replace(result, presses=presses[few], posterior=posterior)
    assert calibration.held_out is None
    assert "measured_presses" not in evaluate(calibration.fitted)


@pytest.mark.slow
def test_fit_with_a_sensor_is_the_same_as_calibrate(problem, session, command, refused, tmp_path):
    _, presses = session
    path = tmp_path / "presses.csv"
    write_presses(path, presses[20:32])
    words = [path, "--sensor", problem.sensor.name]
    assert command("train", "fit", *words, "-o", tmp_path / "a" / "film")[0] == 0
    assert command("train", "calibrate", *words, "-o", tmp_path / "b" / "film")[0] == 0
    for name in ("calibration.json", "sensor.toml"):
        assert (tmp_path / "a/film/1" / name).read_bytes() == (tmp_path / "b/film/1" / name).read_bytes()
    answers = [Predictor(tmp_path / folder / "film").predict_batch(presses.charge_pC).x_mm for folder in "ab"]
    np.testing.assert_array_equal(*answers)
    options = ["-o", tmp_path / "c", "--version", 2]
    refused("train", "fit", *words, *options, message="--version: each calibration is the next")
