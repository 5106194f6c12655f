"""Where the map folds: a made-up one with its fold known, and the layouts that are known for theirs."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, DatasetError
from isocharge.serve import Predictor
from isocharge.simulate import (
    ChargeFunction,
    Circle,
    Sweep,
    load_sensor,
    noise_model,
    read_dataset,
    run_sweep,
    sensor_from_dict,
    sensor_to_dict,
)
from isocharge.simulate.identifiability.ambiguities import AmbiguousPairs
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit_network, train_model
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.fold_free import FieldModel, fold_free_domain, probable_fold_mm, twins_within

TINY = FitConfig(NetworkConfig((8, 8), (8, 8)), TrainingConfig(steps=5, misfit_steps=5, misfit_charges=1_000))


def field_of(charges, radius=8.0, noise=0.0):
    rng = np.random.default_rng(0)
    reach, angle = radius * np.sqrt(rng.uniform(size=6000)), rng.uniform(-np.pi, np.pi, 6000)
    contact = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.exp(rng.uniform(-3, 0.7, 6000))], axis=1)
    domain = ContactDomain(radius, (np.exp(-3.0), np.exp(0.7)))
    charge = charges(*contact.T)
    charge = charge * np.exp(noise * rng.standard_normal(charge.shape))
    return ChargeField.fit(domain, contact[:5000], charge[:5000], (contact[5000:], charge[5000:]))


@pytest.mark.parametrize("fold", [2.0, 5.0, 9.0])
def test_a_fold_at_a_known_place(fold):
    """ln Q_1 - ln Q_0 = (x - 2 x^2 / (4 fold)): its slope changes sign at x = fold."""

    def charges(x, y, force):
        return force[:, None] ** 0.7 * np.exp(np.stack([0 * x, 0.1 * (x - x**2 / (2 * fold)), 0.1 * y], axis=1))

    domain = fold_free_domain(field_of(charges), noise_model("reference"))
    assert domain.radius_mm == pytest.approx(min(fold, 8.0), abs=0.11)


@pytest.mark.parametrize(("fold", "seen"), [(2.0, True), (5.0, True), (30.0, False)])
def test_noisy_charges_show_a_fold_but_not_for_certain(fold, seen):
    """Measured charges, 0.3 % of noise: the same map, whose fold is reported and not cut off."""

    def charges(x, y, force):
        return force[:, None] ** 0.7 * np.exp(np.stack([0 * x, 0.1 * (x - x**2 / (2 * fold)), 0.1 * y], axis=1))

    field, reference = field_of(charges, noise=3e-3), noise_model("reference")
    assert fold_free_domain(field, reference).radius_mm == 8.0
    probable = probable_fold_mm(field, reference)
    assert probable == (pytest.approx(fold, abs=0.5) if seen else np.inf)


def centre_electrode(samples, folder, noisy):
    """Presses on three electrodes, one of them at the centre, where the map folds at once (0.2 mm by `identify`)."""
    table = sensor_to_dict(load_sensor("three-25um-biaxial"))
    table["electrodes"] = {"side_mm": 3.0, "A": [0.0, 0.0], "B": [8.66, 5.0], "C": [-8.66, 5.0]}
    sensor = sensor_from_dict(table)
    swept = read_dataset(run_sweep(folder, sensor, (Circle(1e-3),), Sweep(samples=samples)))
    if not noisy:
        return swept
    charge = 1e12 * noise_model("reference").add(1e-12 * swept.samples.charge_pC, np.random.default_rng(2))
    return replace(swept, samples=replace(swept.samples, charge_pC=charge), manifest={})


@pytest.mark.parametrize("noisy", [False, True], ids=["simulated", "measured"])
def test_training_across_a_fold_is_in_card_and_metadata(tmp_path, noisy):
    said = []
    dataset = centre_electrode(2_000, tmp_path / "presses", noisy)
    release = train_model(dataset, tmp_path / "models" / "centre", TINY, warn=said.append)
    (caution,) = said
    assert "seems to fold about 0." in caution or "seems to fold about 1." in caution
    assert release.metadata.made_with["cautions"] == [caution]
    assert f"- {caution}." in (release.folder / "card.md").read_text("utf-8")


def crossing(x, y, force):
    """ln Q along a nodal cubic (u^2, u^3 - a^2 u): x = 3 mm and x = -3 mm have the same charges, and nothing folds."""
    u, v = 0.1 * x, 0.1 * y
    shapes = np.stack([0 * u, u**2, u * (u**2 - 0.09), v], axis=1)
    return 1e4 * force[:, None] ** 0.7 * np.exp(shapes)


def test_contacts_far_apart_with_the_same_charges_are_seen():
    field, reference = field_of(crossing), noise_model("reference")
    assert fold_free_domain(field, reference).radius_mm == 8.0
    twins = twins_within(field, reference, 8.0)
    assert len(twins)
    assert not len(twins_within(field, reference, 2.0))
    assert not len(twins_within(replace(field, error=1e-2), reference, 8.0))
    nearest = 1e3 * np.stack([twins.first[0, :2], twins.second[0, :2]])
    assert np.sort(nearest[:, 0]) == pytest.approx([-3.0, 3.0], abs=0.5)
    assert nearest[0, 1] == pytest.approx(nearest[1, 1], abs=0.5)


def inner_electrodes(count, radius, samples, folder):
    """Presses on a film with an electrode at the centre and the others on a circle of 12 mm: no folds."""
    angles = 2.0 * np.pi * np.arange(count - 1) / (count - 1)
    places = [[0.0, 0.0], *([12.0 * np.cos(a), 12.0 * np.sin(a)] for a in angles)]
    table = sensor_to_dict(load_sensor("three-25um-biaxial"))
    table["electrodes"] = {"side_mm": 3.0, **dict(zip("ABCDEFGH", places, strict=False))}
    sweep = Sweep(samples=samples, radius=radius)
    return read_dataset(run_sweep(folder, sensor_from_dict(table), (Circle(1e-3),), sweep))


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("count", [5, 8])
def test_five_and_eight_electrodes_with_one_in_the_middle(tmp_path, count):
    """From presses to the served model, without a word of folds: an electrode within the area is none."""
    said = []
    dataset = inner_electrodes(count, 5e-3, 3_000, tmp_path / "presses")
    release = train_model(dataset, tmp_path / "models" / "inner", TINY, warn=said.append)
    assert not said
    names = tuple("ABCDEFGH"[:count])
    assert release.metadata.electrodes == names
    predictor = Predictor(release.folder)
    assert predictor.metadata.electrodes == names
    contacts = predictor.predict_batch(dataset.samples.charge_pC[:50])
    assert np.isfinite(contacts.x_mm).all()
    assert np.isfinite(contacts.force_N).all()
    with pytest.raises(ChargeError, match=f"expected .*{count}"):
        predictor.predict(dataset.samples.charge_pC[0][:-1])


def test_twins_are_in_card_and_metadata(tmp_path, dataset, monkeypatch):
    pair = AmbiguousPairs(np.array([[3e-3, 0.0, 0.05]]), np.array([[-3e-3, 0.0, 0.06]]), np.array([1.2]))
    monkeypatch.setattr("isocharge.train.training.fit.twins_within", lambda *_: pair)
    said = []
    release = train_model(dataset, tmp_path / "models" / "twins", TINY, warn=said.append)
    (caution,) = said
    assert caution.startswith("contacts far apart can have the same charges: 0.05 N at (3.0, 0.0) mm and 0.06 N at")
    assert release.metadata.made_with["cautions"] == [caution]
    assert f"- {caution}." in (release.folder / "card.md").read_text("utf-8")


def test_the_derivatives_are_those_of_the_charges(fit):
    model = FieldModel(fit.field)
    differences = ChargeFunction(model.charge, model.radius, model.force_range, steps=(1e-6, 1e-6, 1e-4))
    contact = fit.held.contact[np.hypot(*fit.held.contact[:, :2].T) < 7.0][:100] * [1e-3, 1e-3, 1.0]
    contact[:, 2] = np.clip(contact[:, 2], 0.06, 1.9)  # the series ends at the domain's
    assert np.allclose(model.jacobian(contact), differences.jacobian(contact), rtol=1e-5, atol=1e-14)


def swept(tmp_path, name, samples, radius):
    sweep = Sweep(samples=samples, radius=radius)
    return read_dataset(run_sweep(tmp_path / "presses", load_sensor(name), (Circle(1e-3),), sweep))


def test_three_uniaxial_electrodes_fold_inside_five_mm_and_the_user_is_told(tmp_path):
    said = []
    dataset = swept(tmp_path, "three-25um-uniaxial", 6_000, 6e-3)
    fit = fit_network(dataset, TINY, warn=said.append)
    assert 1.0 < fit.network.domain.radius_mm < 5.0
    assert fit.asked.radius_mm == 6.0
    assert np.hypot(*fit.held.contact[:, :2].T).max() <= fit.network.domain.radius_mm
    (words,) = said
    assert f"folds beyond {fit.network.domain.radius_mm:g} mm" in words
    assert "6000 presses" in words


def test_where_nothing_is_left_it_is_refused(dataset, monkeypatch):
    monkeypatch.setattr(
        "isocharge.train.training.fit.fold_free_domain", lambda field, _: replace(field.domain, radius_mm=0.8)
    )
    with pytest.raises(DatasetError, match=r"folds 0\.8 mm from the centre, of 8 mm asked for"):
        fit_network(dataset, TINY)


def test_without_a_fold_nobody_is_told(dataset):
    said = []
    fit = fit_network(replace(dataset), TINY, warn=said.append)
    assert not said
    assert fit.asked == fit.network.domain
