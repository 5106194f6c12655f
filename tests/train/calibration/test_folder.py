"""Tests of the folder of a calibrated film, on a film whose charges are a closed formula, with a short training."""

import json
import shutil
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from tests.train.calibration.conftest import rig, uneven_film, use_few_hypotheses
from tests.train.short_training import short_training

from isocharge.common.errors import ModelError, OutputError, PressError
from isocharge.serve import Predictor, read_presses
from isocharge.simulate import NoiseModel, load_sensor
from isocharge.train import calibrate, fit
from isocharge.train.calibration import calibrate as calibrate_module
from isocharge.train.calibration import compact_map, film_network
from isocharge.train.calibration import folder as folder_module
from isocharge.train.calibration.folder import check_calibration_folder, read_earlier, write_calibration
from kept import kept

QUICK = short_training(24, 16, 200, 30, 1_000)


@pytest.fixture(scope="module")
def written(problem, synthetic, tmp_path_factory):
    """Folder of a calibrated film, the result of the calibration, and the properties of the film."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibrate_module, "SAME_FILM_STD", np.inf)
        patch.setattr(compact_map, "_nodes", lambda _: np.zeros(1))
        patch.setattr(film_network, "N_PRESSES", 6_000)
        patch.setattr(film_network, "_outside_presses", lambda *_: None)
        use_few_hypotheses(patch)
        patch.setattr(film_network, "yield_force", lambda *_: 0.9)
        patch.setattr(folder_module, "fit", partial(kept, fit))
        values, _, presses = rig(problem, synthetic, 20, seed=31)
        result = calibrate(presses, problem, start=synthetic, accurate=False)
        path = tmp_path_factory.mktemp("calibrated") / "film"
        write_calibration(result, str(path), "make it", config=QUICK)
        yield SimpleNamespace(path=path, result=result, values=values)


def test_model_of_the_folder_finds_contacts_on_the_film(written, problem, synthetic):
    _, contact, presses = rig(problem, synthetic, 500, seed=32, values=written.values)
    predictor = Predictor(written.path)
    assert predictor.metadata.probes == ("circle:1.0",)
    answers = predictor.predict_batch(presses.charge_pC)
    error = np.hypot(answers.x_mm - contact[:, 0], answers.y_mm - contact[:, 1])
    assert np.median(error) < 0.3
    assert np.median(np.abs(answers.force_N / contact[:, 2] - 1.0)) < 0.03


def test_folder_contains_the_presses_the_sensor_and_the_estimate(written, problem):
    version = written.path / "1"
    read = read_presses(version / "presses.csv", problem.electrodes)
    np.testing.assert_equal(read.columns, written.result.presses.columns)
    assert load_sensor(version / "sensor.toml").film.pretension == pytest.approx(
        written.result.film.value("pretension")
    )
    film = read_earlier(str(written.path), problem)
    drifted = written.result.film.drifted()
    np.testing.assert_array_equal(film.values, drifted.values)
    np.testing.assert_allclose(film.covariance, drifted.covariance, atol=2e-6 * drifted.covariance.max())
    table = json.loads((version / "calibration.json").read_text())
    assert table["error_left"]["position_mm"] == pytest.approx(written.result.film_error.position_mm)
    card = (version / "card.md").read_text()
    assert written.result.summary[0] in card
    for name in ("sensor.toml", "calibration.json", "card.md", "calibration.png"):
        assert (written.path / name).read_bytes() == (version / name).read_bytes()


def test_network_is_trained_with_the_noise_of_the_presses(written, tmp_path):
    film = replace(written.result.film, noise=NoiseModel("presses", 1.0, 0.016))
    result = replace(written.result, estimation=replace(written.result.estimation, film=film))
    few_steps = short_training(16, 16, 60, 30, 1_000)
    noisy = Predictor(write_calibration(result, tmp_path / "film", config=few_steps))
    quiet = Predictor(written.path)
    assert noisy.metadata.noise.gain == 0.016
    charge_pC = written.result.presses.charge_pC[0]
    assert noisy.predict(charge_pC).force_std_N > 1.5 * quiet.predict(charge_pC).force_std_N


@pytest.mark.usefixtures("written")
def test_charges_after_a_session_differ_by_half_of_its_drift(problem, synthetic):
    film = uneven_film(problem)
    film.values[film.layout.index("drift")] = 0.2
    series = compact_map.compact_charges(problem.domain, synthetic, film, None)
    assert series.charge_std < film.noise.gain  # the error of the series decides whether a fold is certain
    presses = film_network.training_data(synthetic, film, series, None).presses
    assert np.std(presses.charge / series.charges(presses.contact)) == pytest.approx(0.1, rel=0.05)


def test_next_version_has_wider_regions_that_hold_for_held_out_presses(
    written, problem, synthetic, tmp_path, monkeypatch
):
    _, contact, presses = rig(problem, synthetic, 130, seed=33, values=written.values)
    # The rig is twenty times as inaccurate as the model.
    moved = contact + np.random.default_rng(34).normal(0.0, [2.0, 2.0, 0.0], contact.shape)
    inaccurate = replace(presses, contact=moved)[~problem.domain.is_outside(moved)]
    held_out, others = inaccurate[:30], inaccurate[30:]
    # The columns of the file have another order.
    held_out = replace(held_out, charge_pC=held_out.charge_pC[:, ::-1], electrodes=held_out.electrodes[::-1])
    plain = Predictor(written.path)
    path = tmp_path / "film"
    shutil.copytree(written.path, path)
    assert write_calibration(written.result, path, held_out=held_out, config=QUICK) == path / "2"
    wide = Predictor(path)

    factor = wide.metadata.made_with["std_factor"]["factor"]
    assert wide.metadata.made_with["std_factor"]["presses"] == 30
    answers, plain_answers = (np.array(one.predict_batch(others.charge_pC)).T for one in (wide, plain))
    np.testing.assert_allclose(answers[:3], plain_answers[:3], atol=1e-3)
    np.testing.assert_allclose(answers[3:6], factor * plain_answers[3:6], rtol=1e-4)
    error = ((answers[:3] - others.contact.T) / answers[3:6]) ** 2
    assert np.mean(error.sum(axis=0) < 7.815) >= 0.85
    assert f"{factor:.3g} times as large" in (path / "card.md").read_text()
    with_a_copy = held_out[[*range(21), 0]]
    with pytest.raises(PressError, match=r"at least 22 held-out presses within 8 mm.*without copies, got 21 of 22"):
        write_calibration(written.result, tmp_path / "few", held_out=with_a_copy, config=QUICK)
    # The map folds beyond 4 mm, where half of the held-out presses are.
    monkeypatch.setattr(folder_module, "fit", lambda *_: SimpleNamespace(domain=problem.domain.within(4.0)))
    with pytest.raises(PressError, match=r"at least 22 held-out presses within 4 mm.*got \d+ of 30"):
        write_calibration(written.result, tmp_path / "few", held_out=held_out, config=QUICK)
    assert not (tmp_path / "few").exists()


def test_unsuitable_folders_are_refused_and_left_as_they_are(written, problem, tmp_path):
    (tmp_path / "mine" / "1").mkdir(parents=True)
    with pytest.raises(ModelError, match="expected a new folder or one of an earlier calibration"):
        write_calibration(written.result, tmp_path / "mine")
    with pytest.raises(ModelError):
        check_calibration_folder(written.path, tuple("ABC"))
    with pytest.raises(OutputError, match=r"card\.md is not a writable folder"):
        check_calibration_folder(written.path / "card.md" / "film", problem.electrodes)
    assert list(tmp_path.iterdir()) == [tmp_path / "mine"]
    with pytest.raises(PressError, match=r"calibration\.json"):
        read_earlier(tmp_path / "mine", problem)
