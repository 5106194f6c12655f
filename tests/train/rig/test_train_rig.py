"""From measured presses to a model: judged by presses of a film that is not the described one, and by nothing else."""

import json
from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import PressError
from isocharge.serve import MeasuredPresses, Predictor, check_presses, read_presses
from isocharge.simulate import Circle, ForwardMap, load_sensor, virtual_film
from isocharge.train import FitConfig, NetworkConfig, Rig, TrainingConfig, train_rig
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.measured import held_out
from isocharge.train.films.film_presses import draw_contacts

TINY = FitConfig(
    NetworkConfig((32, 32), (8, 8)), TrainingConfig(steps=400, misfit_steps=5, misfit_charges=1_000, batch=256)
)
DOMAIN = ContactDomain(7.5, (0.06, 1.9))
PROBE = Circle(1e-3)


def systematic(contact):
    """3 % times smooth functions of place, another for each electrode."""
    x, y, _ = contact.T
    return 0.03 * np.column_stack([np.sin(x / 4 + k) * np.cos(y / 5) for k in range(3)])


@pytest.fixture(scope="module")
def described():
    return load_sensor("three-25um-biaxial")


@pytest.fixture(scope="module")
def truth(described):
    """The forward map of a film that nobody described, solved for itself."""
    return ForwardMap.build(*virtual_film(described, PROBE, 4), 8.1e-3, (0.05, 2.0))


def measured(truth, count, seed=0, **changed):
    """Presses as a rig reads them: places to 0.05 mm, forces to 0.5 %, charges with noise."""
    rng = np.random.default_rng(seed)
    contact = draw_contacts(rng, DOMAIN, count)
    charge = 1e12 * truth.forward(*(contact * [1e-3, 1e-3, 1.0]).T) * np.exp(systematic(contact))
    charge += np.hypot(1.0, 0.002 * charge) * rng.standard_normal(charge.shape)
    contact[:, :2] += 0.05 * rng.standard_normal((count, 2))
    contact[:, 2] *= np.exp(0.005 * rng.standard_normal(count))
    stds = np.full(count, 0.05), np.full(count, 0.005)
    columns = {"contact": contact, "charge_pC": charge} | changed
    return MeasuredPresses(columns["contact"], columns["charge_pC"], *stds, ("A", "B", "C"), tuple(range(2, count + 2)))


@pytest.fixture(scope="module")
def release(truth, described, tmp_path_factory):
    """Trained without a network for all films: the presses correct the sensor as described."""
    folder = tmp_path_factory.mktemp("models") / "rig"
    return train_rig(Rig(measured(truth, 300), described, PROBE), None, folder, TINY, drawn=4000, warn=lambda _: None)


def test_the_errors_are_what_serve_check_says_of_the_held_out_presses(release):
    held = read_presses(release.folder / "held_out.csv", ("A", "B", "C"))
    check = check_presses(Predictor(release.folder), held)
    errors = release.metadata.errors
    assert errors["measured_presses"] == len(held) == check.counted >= 10
    assert errors["position_rms_mm"] == pytest.approx(check.position_mm.rms, rel=1e-3)
    assert errors["position_median_mm"] == pytest.approx(check.position_mm.median, rel=1e-3)
    assert errors["force_rms_percent"] == pytest.approx(check.force_percent.rms, rel=1e-3)


def test_no_press_is_both_trained_on_and_held_out(release, truth):
    seen, held = (read_presses(release.folder / name, ("A", "B", "C")) for name in ("presses.csv", "held_out.csv"))
    assert not {tuple(row) for row in seen.contact} & {tuple(row) for row in held.contact}
    presses = measured(truth, 300)
    assert held == presses[held_out(presses.contact)]


def test_card_and_metadata_say_that_it_was_fitted_to_measurements(release):
    card = (release.folder / "card.md").read_text("utf-8")
    errors = release.metadata.errors
    assert f"## Errors on {errors['measured_presses']:.0f} measured presses that training never saw" in card
    assert f"{errors['position_median_mm']:g} mm" in card
    assert "## Fitted to measured presses" in card
    assert "The film was not calibrated" in card
    assert "simulator, not a film" not in card
    assert "clean" not in card
    measurement = json.loads(json.dumps(release.metadata.made_with["measured"]))
    assert measurement["trained_on"] + measurement["held_out"] == 300
    assert not measurement["calibrated"]


def test_the_model_is_right_about_the_film_and_not_about_the_described_one(release, truth, described):
    """On clean charges of the true film, which neither training nor card has seen."""
    contact = draw_contacts(np.random.default_rng(77), replace(DOMAIN, radius_mm=7.0), 500)
    answer = {}
    for name, forward_map in (("true", truth), ("described", replace(truth, sensor=described))):
        charge = 1e12 * forward_map.forward(*(contact * [1e-3, 1e-3, 1.0]).T) * np.exp(systematic(contact))
        found_contacts = np.stack(Predictor(release.folder).predict_batch(charge), axis=1)[:, :3]
        answer[name] = np.median(np.hypot(*(found_contacts - contact)[:, :2].T))
    assert answer["true"] < 0.3
    assert answer["described"] > 2.0 * answer["true"]


def test_too_few_presses_are_told_to_calibrate(truth, described, tmp_path):
    contact = measured(truth, 52).contact
    contact[:3, 0] = 30.0
    with pytest.raises(PressError, match=r"at least 50 presses .* got 49 of 52.*isocharge train calibrate"):
        train_rig(Rig(measured(truth, 52, contact=contact), described, PROBE), None, tmp_path / "rig")
    assert not list(tmp_path.iterdir())
