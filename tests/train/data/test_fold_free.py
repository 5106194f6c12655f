"""Where the map folds: a made-up one with its fold known, and the layouts that are known for theirs."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import DatasetError
from isocharge.simulate import Circle, Domain, Sweep, load_sensor, noise_model, read_dataset, run_sweep
from isocharge.simulate.identifiability.ambiguous_pairs import AmbiguousPairs
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit, release
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.fold_free import ambiguous_pairs, fold_free_domain, probable_fold
from isocharge.train.data.presses import LabelledPresses, draw_contacts

TINY = FitConfig(
    network=NetworkConfig(hidden=(8, 8), misfit_hidden=(8, 8)),
    training=TrainingConfig(steps=5, misfit_steps=5, misfit_charges=1_000),
)
REFERENCE = noise_model("reference")


def field_of(charges, noise=0.0):
    rng, domain = np.random.default_rng(0), Domain(8.0, (0.05, 2.0))
    contact = draw_contacts(rng, domain, 6000)
    charge = charges(*contact.T)
    presses = LabelledPresses(contact, charge * np.exp(noise * rng.standard_normal(charge.shape)))
    return ChargeField.fit(domain, ("A", "B", "C"), presses[np.arange(5000)], presses[np.arange(5000, 6000)])


def folded_at(fold):
    """ln Q_1 - ln Q_0 = 0.1 (x - x^2 / (2 fold)): its slope changes sign at x = fold."""

    def charges(x, y, force):
        return force[:, None] ** 0.7 * np.exp(np.stack([0 * x, 0.1 * (x - x**2 / (2 * fold)), 0.1 * y], axis=1))

    return charges


@pytest.mark.parametrize("fold", [2.0, 5.0, 9.0])
def test_a_fold_at_a_known_place(fold):
    assert fold_free_domain(field_of(folded_at(fold)), REFERENCE).radius == pytest.approx(min(fold, 8.0), abs=0.11)


@pytest.mark.parametrize(("fold", "seen"), [(2.0, True), (30.0, False)])
def test_noisy_charges_show_a_fold_but_not_for_certain(fold, seen):
    """Measured charges, 0.3 % of noise: the same map, whose fold is reported and not cut off."""
    field = field_of(folded_at(fold), noise=3e-3)
    assert fold_free_domain(field, REFERENCE).radius == 8.0
    assert probable_fold(field, REFERENCE) == (pytest.approx(fold, abs=0.5) if seen else np.inf)


def crossing(x, y, force):
    """ln Q along a nodal cubic (u^2, u^3 - a^2 u): x = 3 mm and x = -3 mm have the same charges, and nothing folds."""
    u, v = 0.1 * x, 0.1 * y
    shapes = np.stack([0 * u, u**2, u * (u**2 - 0.09), v], axis=1)
    return 1e4 * force[:, None] ** 0.7 * np.exp(shapes)


def test_contacts_far_apart_with_the_same_charges_are_seen():
    field = field_of(crossing)
    assert fold_free_domain(field, REFERENCE).radius == 8.0
    pairs = ambiguous_pairs(field, REFERENCE, 8.0)
    assert np.sort([pairs.first[0, 0], pairs.second[0, 0]]) == pytest.approx([-3.0, 3.0], abs=0.5)
    assert pairs.first[0, 1] == pytest.approx(pairs.second[0, 1], abs=0.5)
    assert not len(ambiguous_pairs(field, REFERENCE, 2.0))
    assert not len(ambiguous_pairs(replace(field, error=1e-2), REFERENCE, 8.0))


def swept(folder, sensor, samples, radius=8.0):
    return read_dataset(run_sweep(folder, sensor, (Circle(1.0),), Sweep(samples=samples, radius=radius)))


@pytest.mark.parametrize("noisy", [False, True], ids=["simulated", "measured"])
def test_a_fit_across_a_fold_is_in_log_card_and_metadata(tmp_path, caplog, noisy):
    """One of three electrodes at the centre, where the map folds at once (0.2 mm by `identify`)."""
    table = sensor_to_dict(load_sensor("three-25um-biaxial"))
    table["electrodes"] = {"side_mm": 3.0, "A": [0.0, 0.0], "B": [8.66, 5.0], "C": [-8.66, 5.0]}
    dataset = swept(tmp_path / "presses", sensor_from_dict(table), 2_000)
    if noisy:
        charge = REFERENCE.add(dataset.samples.charge_pC, np.random.default_rng(2))
        dataset = replace(dataset, samples=replace(dataset.samples, charge_pC=charge), manifest={})
    model = release(fit(dataset, TINY), tmp_path / "models" / "centre")
    (caution,) = caplog.messages
    assert "seems to fold about 0." in caution or "seems to fold about 1." in caution
    assert model.metadata.made_with["cautions"] == [caution]
    assert f"- {caution}." in (model.folder / "card.md").read_text("utf-8")


def test_five_electrodes_with_one_in_the_middle_do_not_fold(tmp_path, caplog):
    places = [[0.0, 0.0], [12.0, 0.0], [0.0, 12.0], [-12.0, 0.0], [0.0, -12.0]]
    table = sensor_to_dict(load_sensor("three-25um-biaxial"))
    table["electrodes"] = {"side_mm": 3.0, **dict(zip("ABCDE", places, strict=True))}
    dataset = swept(tmp_path / "presses", sensor_from_dict(table), 3_000, radius=5.0)
    fitted = fit(dataset, TINY)
    assert not caplog.messages
    assert all(np.isfinite(part).all() for part in fitted.predict(dataset.samples.charge_pC[:50]))


def test_three_uniaxial_electrodes_fold_inside_five_mm(tmp_path, caplog):
    fitted = fit(swept(tmp_path / "presses", load_sensor("three-25um-uniaxial"), 6_000, radius=6.0), TINY)
    assert 1.0 < fitted.domain.radius < 5.0
    assert fitted.asked.radius == 6.0
    assert np.hypot(*fitted.test.contact[:, :2].T).max() <= fitted.domain.radius
    (caution,) = caplog.messages
    assert f"folds beyond {fitted.domain.radius:g} mm" in caution
    assert "6000 presses" in caution


def test_ambiguous_pairs_are_a_caution(dataset, monkeypatch):
    pair = AmbiguousPairs(np.array([[3.0, 0.0, 0.05]]), np.array([[-3.0, 0.0, 0.06]]), np.array([1.2]))
    monkeypatch.setattr("isocharge.train.training.fit.ambiguous_pairs", lambda *_: pair)
    (caution,) = fit(dataset, TINY).cautions
    assert caution.startswith("contacts far apart can have the same charges: 0.05 N at (3.0, 0.0) mm and 0.06 N at")


def test_where_nothing_is_left_it_is_refused(dataset, monkeypatch):
    monkeypatch.setattr("isocharge.train.training.fit.fold_free_domain", lambda field, _: field.domain.within(0.8))
    with pytest.raises(DatasetError, match=r"folds 0\.8 mm from the centre, of 8 mm asked for"):
        fit(dataset, TINY)
