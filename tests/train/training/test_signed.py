"""A simulated film whose charges have both signs, against the Bayes limit: light presses on a taut uniaxial film."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.statistics import rms
from isocharge.serve import MeasuredPresses, Predictor
from isocharge.simulate import Circle, Domain, ForwardMap, Sweep, load_sensor, noise_model, read_dataset
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.train import BayesProblem, FitConfig, NetworkConfig, TrainingConfig, bayes_estimate, fit, release
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.rig.corrected_film import correct_film
from kept import kept

RADIUS = 1.5
FORCES = (0.1, 0.3)
QUICK = FitConfig(
    network=NetworkConfig(hidden=(32, 32), misfit_hidden=(24, 24)),
    training=TrainingConfig(steps=400, misfit_steps=600, misfit_charges=4_000, batch=256),
)


def taut(pretension):
    """In MPa."""
    sensor = load_sensor("four-25um-uniaxial")
    return replace(sensor, film=replace(sensor.film, pretension=pretension))


@pytest.fixture(scope="module")
def film():
    return kept(ForwardMap.build, taut(3.0), Circle(1.0), RADIUS, FORCES)


@pytest.fixture(scope="module")
def fitted(film, tmp_path_factory):
    sweep = Sweep(RADIUS, FORCES, samples=6_000)
    return fit(read_dataset(write_sweep(tmp_path_factory.mktemp("taut") / "presses", (film,), sweep)), QUICK)


@pytest.mark.slow
def test_presses_with_negative_charges_are_located_as_well_as_others(film, fitted):
    some = fitted.test[np.arange(150)]
    charge = some.noisy(fitted.noise, 1)
    least = bayes_estimate(BayesProblem(film.sensor, film.probe, RADIUS, FORCES), charge, charge_map=film)[0]
    contact, std, _ = fitted.predict(charge)
    negative = (some.charge < 0.0).any(axis=1)
    assert 0.3 < negative.mean() < 0.6
    for rows in (negative, ~negative):
        position, limit = (rms(np.hypot(*(given - some.contact)[rows, :2].T)) for given in (contact, least))
        force, of_force = (rms((given[:, 2] / some.contact[:, 2] - 1.0)[rows]) for given in (contact, least))
        assert position < 1.3 * limit
        assert force < 1.15 * of_force
        assert np.mean(np.abs(contact - some.contact)[rows] < std[rows]) == pytest.approx(0.68, abs=0.07)


@pytest.mark.slow
def test_its_model_is_served_and_its_misfit_sees_what_is_below_zero(fitted, tmp_path):
    """Four charges, three unknowns: 1 % of good presses exceed 2.58, the half-normal distribution's."""
    model = release(fitted, tmp_path / "models" / "taut")
    predictor = Predictor(model.folder)
    charge = fitted.test.noisy(fitted.noise, 2)
    np.testing.assert_allclose(predictor.predict(charge[0])[:3], fitted.predict(charge[:1])[0][0], rtol=1e-3, atol=1e-3)
    assert np.quantile(fitted.predict(charge)[2], 0.99) == pytest.approx(2.58, abs=0.6)
    lower = charge[charge[:, 1] < 0.0] - [0.0, 15.0, 0.0, 0.0]
    assert np.mean(fitted.predict(lower)[2] > model.metadata.errors["misfit_p99"]) > 0.9


def test_the_series_of_charges_of_both_signs(film):
    contact = draw_contacts(np.random.default_rng(0), film.domain, 5_000)
    presses = LabelledPresses(contact, film.charges(contact))
    field = ChargeField.fit(film.domain, film.electrodes, presses[np.arange(4_000)], presses[np.arange(4_000, 5_000)])
    assert np.abs(field.charges(contact) - presses.charge).max() < 0.05  # pC: a twentieth of the noise
    inner = contact[np.hypot(*contact[:, :2].T) < 0.95 * RADIUS][:200]
    slopes = film.derivatives(inner)
    assert np.abs(field.derivatives(inner) - slopes).max() < 5e-3 * np.abs(slopes).max()


def test_measured_presses_correct_charges_of_both_signs(film):
    """An amplifier that gives 4 % too much, seen through noise."""
    contact = draw_contacts(np.random.default_rng(1), Domain(1.4, (0.11, 0.28)), 300)
    charge = noise_model("reference").add(1.04 * film.charges(contact), np.random.default_rng(2))
    std = np.full(300, 1e-4), np.full(300, 1e-4)
    presses = MeasuredPresses(contact, charge, *std, film.electrodes, tuple(range(2, 302)))
    corrected = correct_film(presses, film, film.domain, noise_model("reference"))
    truth = 1.04 * film.charges(contact)
    assert rms((corrected.charges(contact) - truth) / noise_model("reference").sigma(truth)) < 0.3
    assert corrected.scatter == pytest.approx(1.0, abs=0.1)
