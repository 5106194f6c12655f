"""Where the map folds: a made-up one with its fold known, and the layouts that are known for theirs."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.errors import DatasetError
from isocharge.simulate import ChargeFunction, Circle, Sweep, load_sensor, noise_model, read_dataset, run_sweep
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit_network
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.fold_free import FieldModel, fold_free_domain

TINY = FitConfig(NetworkConfig((8, 8), (8, 8)), TrainingConfig(steps=5, misfit_steps=5, misfit_charges=1_000))


def field_of(charges, radius=8.0):
    rng = np.random.default_rng(0)
    reach, angle = radius * np.sqrt(rng.uniform(size=6000)), rng.uniform(-np.pi, np.pi, 6000)
    contact = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.exp(rng.uniform(-3, 0.7, 6000))], axis=1)
    domain = ContactDomain(radius, (np.exp(-3.0), np.exp(0.7)))
    charge = charges(*contact.T)
    return ChargeField.fit(domain, contact[:5000], charge[:5000], (contact[5000:], charge[5000:]))


@pytest.mark.parametrize("fold", [2.0, 5.0, 9.0])
def test_a_fold_at_a_known_place(fold):
    """ln Q_1 - ln Q_0 = (x - 2 x^2 / (4 fold)): its slope changes sign at x = fold."""

    def charges(x, y, force):
        return force[:, None] ** 0.7 * np.exp(np.stack([0 * x, 0.1 * (x - x**2 / (2 * fold)), 0.1 * y], axis=1))

    domain = fold_free_domain(field_of(charges), noise_model("reference"))
    assert domain.radius_mm == pytest.approx(min(fold, 8.0), abs=0.11)


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
