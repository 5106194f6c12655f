"""Tests of models for a described film that is corrected by measured presses, on presses that were held out."""

from dataclasses import replace

import numpy as np
import pytest
from tests.train.rig.conftest import DOMAIN, measured_presses, systematic_error

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
    """Solve the described film once for all tests of this file."""
    build = ForwardMap.build
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ForwardMap, "build", lambda *arguments: kept(build, *arguments))
        yield


@pytest.fixture(scope="module")
def model(truth, tmp_path_factory):
    """A released model of the described film, corrected by measured presses, after a short training."""
    data = rig_data(Rig(measured_presses(truth, 300), DESCRIBED, PROBE), training_presses=4000)
    return release(fit(data, TINY), tmp_path_factory.mktemp("models") / "rig")


def test_stated_errors_are_those_of_serve_check_on_the_held_out_presses(model, truth):
    presses = measured_presses(truth, 300)
    is_held_out = held_out(presses.contact)
    training_presses = read_presses(model.folder / "presses.csv")
    held_out_presses = read_presses(model.folder / "held_out.csv")
    assert training_presses == presses[~is_held_out]
    assert held_out_presses == presses[is_held_out]
    check = check_presses(Predictor(model.folder), held_out_presses)
    errors = model.metadata.errors
    assert errors["measured_presses"] == len(held_out_presses) == check.compared >= 10
    assert errors["position_rms_mm"] == pytest.approx(check.position_mm.rms, rel=1e-3)
    assert errors["position_median_mm"] == pytest.approx(check.position_mm.median, rel=1e-3)
    assert errors["force_rms_percent"] == pytest.approx(check.force_percent.rms, rel=1e-3)


def test_card_and_metadata_state_the_measured_presses(model):
    card = (model.folder / "card.md").read_text("utf-8")
    errors = model.metadata.errors
    assert f"## Errors on {errors['measured_presses']:.0f} measured presses that were not used in the training" in card
    assert "places of the presses are known to 0.05 mm and the forces to 0.5 %" in card
    measurement = model.metadata.made_with["measured"]
    assert measurement["trained_on"] + measurement["held_out"] == 300


def test_errors_are_smaller_on_the_measured_film_than_on_the_described_film(model, truth):
    """The charges are those of new contacts without noise."""
    contact = draw_contacts(np.random.default_rng(77), DOMAIN.within(7.0), 500)

    def median_error_mm(forward_map):
        """Return the median position error on a film with the systematic error."""
        charge = forward_map.charges(contact) * np.exp(systematic_error(contact))
        answer = Predictor(model.folder).predict_batch(charge)
        return np.median(np.hypot(answer.x_mm - contact[:, 0], answer.y_mm - contact[:, 1]))

    measured_film_error_mm = median_error_mm(truth)
    assert measured_film_error_mm < 0.3
    assert median_error_mm(replace(truth, sensor=DESCRIBED)) > 2.0 * measured_film_error_mm


def test_unusable_presses_are_logged_and_too_few_presses_are_refused(truth, caplog):
    presses = measured_presses(truth, 60)
    presses.contact[:3, 0] = 30.0
    presses.charge_pC[3, 1] = np.nan
    assert len(rig_data(Rig(presses, DESCRIBED, PROBE), training_presses=1000).test) >= 10
    assert "4 of 60 presses are left out: 1 with an unknown place, force or charge; 3 beyond 8 mm" in caplog.text
    with pytest.raises(PressError, match=r"at least 50 presses .* got 49 of 53.*isocharge train calibrate"):
        rig_data(Rig(presses[:53], DESCRIBED, PROBE))
