"""The methods of a report."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import TrainingError
from isocharge.serve import Predictor, find_model
from isocharge.simulate import noise_model
from isocharge.train import LabelledPresses
from isocharge.train.data.contact_errors import position_error, rms
from isocharge.train.report.methods import FittingTask, fit_methods, model_method

LARGEST_ERRORS = {
    "least squares, Gauss-Newton": (0.02, 2e-3),
}
"""Largest rms errors on charges without noise, by name of the method: position, mm, and relative force. The methods are
fitted to 3,000 presses without a charge map."""


@pytest.fixture(scope="module")
def task(dataset, spline):
    """Simulated presses without a charge map, as if they had been measured."""
    return FittingTask(LabelledPresses.of(dataset)[np.arange(3_000)], spline.domain, noise_model("reference"))


@pytest.fixture(scope="module")
def test_presses(dataset):
    """Presses within 6 mm, because the charges hardly determine the contacts near the rim."""
    return LabelledPresses.of(dataset)[np.arange(3_000, 3_200)].within(6.0)


@pytest.fixture(scope="module")
def fitted(task):
    """Every method that needs no charge map, by its name."""
    methods, failure_reasons = fit_methods(task)
    assert not failure_reasons
    return {method.name: method for method in methods}


@pytest.mark.parametrize("name", LARGEST_ERRORS)
def test_methods_find_the_contacts_of_charges_without_noise(name, fitted, test_presses):
    method = fitted[name]
    charge = test_presses.charge
    largest_mm, largest_force = LARGEST_ERRORS[name]
    answers = method.estimate(charge)
    assert rms(position_error(answers, test_presses.contact)) < largest_mm
    assert rms(answers[:, 2] / test_presses.contact[:, 2] - 1.0) < largest_force
    np.testing.assert_allclose(method.call_for(charge[0])(), answers[:1], rtol=1e-9, atol=1e-9)


def test_triangulation_and_least_squares_on_a_charge_map_find_clean_presses(task, spline, test_presses):
    methods, _ = fit_methods(replace(task, charge_map=spline))
    presses = test_presses[np.arange(20)]
    by_name = {method.name: method for method in methods}
    for name in ("triangulation", "least squares, Gauss-Newton"):
        contact = by_name[name].estimate(presses.charge)
        is_found = np.isfinite(contact[:, 0])
        assert is_found.mean() > 0.8
        assert np.median(position_error(contact[is_found], presses.contact[is_found])) < 0.02


def test_too_few_measured_presses_are_a_reason_and_too_few_simulated_presses_an_error(task):
    few = replace(task, presses=task.presses[:5])
    with pytest.raises(TrainingError, match="got 4"):
        fit_methods(few)
    methods, (reason,) = fit_methods(replace(few, presses=replace(few.presses, measured=True)))
    assert methods == []
    assert reason.startswith("least_squares: ")


def test_a_model_estimates_the_same_contact_alone_and_in_a_batch():
    folder = find_model("three-25um-biaxial")
    method = model_method(folder)
    charge = np.random.default_rng(0).uniform(300.0, 600.0, (5, 3))
    expected = Predictor(folder).predict(charge[0])
    np.testing.assert_allclose(method.estimate(charge)[0], [expected.x_mm, expected.y_mm, expected.force_N], rtol=1e-4)
    assert method.name == "network `three-25um-biaxial/1`"
    method.call_for(charge[0])()
