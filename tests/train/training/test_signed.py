"""Tests of a film whose charges have both signs: light presses on a taut uniaxial film."""

from dataclasses import replace

import numpy as np
import pytest
from bayes.limit import BayesProblem, bayes_estimate

from isocharge.serve import Predictor
from isocharge.simulate import Circle, ForwardMap, Sweep, load_sensor, noise_model, read_dataset
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit, release
from isocharge.train.data.contact_errors import ContactErrorStatistics
from kept import kept

RADIUS_mm = 1.5
FORCE_RANGE_N = (0.1, 0.3)
REFERENCE = noise_model("reference")
QUICK = FitConfig(
    network=NetworkConfig(hidden=(32, 32), misfit_hidden=(24, 24)),
    training=TrainingConfig(steps=400, misfit_steps=600, misfit_charges=4_000, batch=256),
)


@pytest.fixture(scope="module")
def film():
    """The forward map of a uniaxial film with a pretension of 3 MPa."""
    sensor = load_sensor("four-25um-uniaxial")
    taut_sensor = replace(sensor, film=replace(sensor.film, pretension=3.0))
    return kept(ForwardMap.build, taut_sensor, Circle(1.0), RADIUS_mm, FORCE_RANGE_N)


@pytest.fixture(scope="module")
def fitted(film, tmp_path_factory):
    """A network after a short training on presses on the film."""
    sweep = Sweep(RADIUS_mm, FORCE_RANGE_N, samples=6_000)
    folder = write_sweep(tmp_path_factory.mktemp("taut") / "presses", (film,), sweep)
    return fit(read_dataset(folder), QUICK)


@pytest.mark.slow
def test_presses_with_negative_charges_are_located_as_well_as_others(film, fitted):
    """The errors of presses with and without negative charges are both compared with the Bayes limit."""
    presses = fitted.test[np.arange(150)]
    charge = presses.noisy(fitted.noise, 1)
    problem = BayesProblem(film.sensor, film.probe, RADIUS_mm, FORCE_RANGE_N)
    bayes_contact, _ = bayes_estimate(problem, charge, charge_map=film)
    contact, std, _ = fitted.predict(charge)
    has_negative = (presses.charge < 0.0).any(axis=1)
    assert 0.3 < has_negative.mean() < 0.6
    for rows in (has_negative, ~has_negative):
        truth = presses.contact[rows]
        error = ContactErrorStatistics.of(contact[rows], truth)
        limit = ContactErrorStatistics.of(bayes_contact[rows], truth)
        assert error.position_rms_mm < 1.3 * limit.position_rms_mm
        assert error.force_rms_percent < 1.15 * limit.force_rms_percent
        assert np.mean(np.abs(contact[rows] - truth) < std[rows]) == pytest.approx(0.68, abs=0.07)


@pytest.mark.slow
def test_served_model_has_a_large_misfit_for_a_charge_that_is_too_negative(fitted, tmp_path):
    """Four charges determine three unknowns, so the misfit is the absolute value of one normal deviate.

    The 99th percentile of this distribution is 2.58.
    """
    model = release(fitted, tmp_path / "models" / "taut")
    predictor = Predictor(model.folder)
    charge = fitted.test.noisy(fitted.noise, 2)
    contact, _, misfit = fitted.predict(charge)
    np.testing.assert_allclose(predictor.predict(charge[0])[:3], contact[0], rtol=1e-3, atol=1e-3)
    assert np.quantile(misfit, 0.99) == pytest.approx(2.58, abs=0.6)
    too_negative = charge[charge[:, 1] < 0.0] - [0.0, 15.0, 0.0, 0.0]
    _, _, large_misfit = fitted.predict(too_negative)
    assert np.mean(large_misfit > model.metadata.errors["misfit_p99"]) > 0.9
