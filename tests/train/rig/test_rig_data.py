"""From measured presses to a model: judged by presses of a film that is not the described one, and by nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from tests.train.rig.conftest import DOMAIN, measured, systematic

from isocharge.common.errors import PressError
from isocharge.serve import Predictor, check_presses, read_presses
from isocharge.simulate import Circle, ForwardMap, load_sensor
from isocharge.train import FitConfig, NetworkConfig, Rig, TrainingConfig, fit, release, rig_data
from isocharge.train.data.presses import draw_contacts, held_out
from kept import kept

TINY = FitConfig(
    NetworkConfig((32, 32), (8, 8)), TrainingConfig(steps=400, misfit_steps=5, misfit_charges=1_000, batch=256)
)
DESCRIBED = load_sensor("four-25um-biaxial")
PROBE = Circle(1.0)


@pytest.fixture(scope="module", autouse=True)
def solved_once():
    """The described film is solved once for all tests of this file."""
    build = ForwardMap.build
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ForwardMap, "build", lambda *arguments: kept(build, *arguments))
        yield


@pytest.fixture(scope="module")
def model(truth, tmp_path_factory):
    """Trained without a network for all films: the presses correct the sensor as described."""
    data = rig_data(Rig(measured(truth, 300), DESCRIBED, PROBE), drawn=4000)
    return release(fit(data, TINY), tmp_path_factory.mktemp("models") / "rig")


def test_the_errors_are_what_serve_check_says_of_presses_that_nobody_trained_on(model, truth):
    presses = measured(truth, 300)
    seen, held = (read_presses(model.folder / name) for name in ("presses.csv", "held_out.csv"))
    assert held == presses[held_out(presses.contact)]
    assert seen == presses[~held_out(presses.contact)]
    check = check_presses(Predictor(model.folder), held)
    errors = model.metadata.errors
    assert errors["measured_presses"] == len(held) == check.compared >= 10
    message = [errors[name] for name in ("position_rms_mm", "position_median_mm", "force_rms_percent")]
    assert message == pytest.approx(
        [check.position_mm.rms, check.position_mm.median, check.force_percent.rms], rel=1e-3
    )


def test_card_and_metadata_say_that_it_was_fitted_to_measurements(model):
    card = (model.folder / "card.md").read_text("utf-8")
    errors = model.metadata.errors
    assert f"## Errors on {errors['measured_presses']:.0f} measured presses that were not used in the training" in card
    assert "places of the presses are known to 0.05 mm and the forces to 0.5 %" in card
    measurement = model.metadata.made_with["measured"]
    assert measurement["trained_on"] + measurement["held_out"] == 300


def test_the_model_is_right_about_the_film_and_not_about_the_described_one(model, truth):
    """On clean charges of the true film, which neither training nor card has seen."""
    contact = draw_contacts(np.random.default_rng(77), DOMAIN.within(7.0), 500)
    error = {}
    for name, forward_map in (("true", truth), ("described", replace(truth, sensor=DESCRIBED))):
        charge = forward_map.charges(contact) * np.exp(systematic(contact))
        answer = Predictor(model.folder).predict_batch(charge)
        error[name] = np.median(np.hypot(answer.x_mm - contact[:, 0], answer.y_mm - contact[:, 1]))
    assert error["true"] < 0.3
    assert error["described"] > 2.0 * error["true"]


def test_what_does_not_count_is_said_and_too_few_presses_are_refused(truth, caplog):
    presses = measured(truth, 60)
    presses.contact[:3, 0] = 30.0
    presses.charge_pC[3, 1] = np.nan
    assert len(rig_data(Rig(presses, DESCRIBED, PROBE), drawn=1000).test) >= 10
    assert "4 of 60 presses are left out: 1 with an unknown place, force or charge; 3 beyond 8 mm" in caplog.text
    with pytest.raises(PressError, match=r"at least 50 presses .* got 49 of 53.*isocharge train calibrate"):
        rig_data(Rig(presses[:53], DESCRIBED, PROBE))
