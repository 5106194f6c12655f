"""The methods of a report on a map with a known inverse, and Gauss-Newton against SciPy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from isocharge.common.errors import TrainingError
from isocharge.serve import Predictor, find_model
from isocharge.simulate import FunctionMap, noise_model
from isocharge.train.data.contact_errors import position_error, rms
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report.methods import FittingTask, fit_methods, least_squares, model_method

NOISE = noise_model("reference")

LARGEST_ERRORS = {
    "least squares, Gauss-Newton": (0.002, 1e-3),
}
"""Largest rms errors on charges without noise, by name of the method: position, mm, and relative force. The methods are
fitted to 3,000 presses without a charge map."""


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


def test_too_few_measured_presses_are_a_reason_and_too_few_simulated_presses_an_error(task):
    few = replace(task, presses=task.presses[:5])
    with pytest.raises(TrainingError, match="got 4"):
        fit_methods(few)
    methods, (reason,) = fit_methods(replace(few, presses=replace(few.presses, measured=True)))
    assert methods == []
    assert reason.startswith("least_squares: ")


def test_triangulation_and_least_squares_find_clean_presses(dataset, spline):
    presses = LabelledPresses.of(dataset)[np.arange(700)]
    methods, _ = fit_methods(FittingTask(presses, spline.domain, NOISE, spline))
    assert [method.name for method in methods] == ["triangulation", "least squares, Gauss-Newton"]
    for method in methods:
        contact = method.estimate(presses.charge[:20])
        is_found = np.isfinite(contact[:, 0])
        assert is_found.mean() > 0.8
        assert np.median(position_error(contact[is_found], presses.contact[:20][is_found])) < 0.02


def test_a_model_estimates_the_same_contact_alone_and_in_a_batch():
    folder = find_model("three-25um-biaxial")
    method = model_method(folder)
    charge = np.random.default_rng(0).uniform(300.0, 600.0, (5, 3))
    expected = Predictor(folder).predict(charge[0])
    np.testing.assert_allclose(method.estimate(charge)[0], [expected.x_mm, expected.y_mm, expected.force_N], rtol=1e-4)
    assert method.name == "network `three-25um-biaxial/1`"
    method.call_for(charge[0])()


@pytest.fixture(scope="module")
def search(known, task):
    """Gauss-Newton on the known map, with derivatives by finite differences."""
    charge_map = FunctionMap(known.charges, tuple("ABCD"[: known.count]), task.domain)
    return least_squares(replace(task, charge_map=charge_map))


def square_sum(known, charge, contact):
    """Compute the sum of squared residuals of contacts."""
    return (((known.charges(contact) - charge) / NOISE.sigma(charge)) ** 2).sum(axis=1)


def scipy_square_sum(known, charge, start):
    """Minimise the sum of squares with SciPy, in polar coordinates, in which the domain is a box."""

    def residuals(polar):
        contact = np.array([[polar[0] * np.cos(polar[1]), polar[0] * np.sin(polar[1]), np.exp(polar[2])]])
        return ((known.charges(contact) - charge) / NOISE.sigma(charge))[0]

    polar = [np.hypot(*start[:2]), np.arctan2(start[1], start[0]), np.log(start[2])]
    bounds = ([0.0, -np.inf, np.log(0.05)], [8.0, np.inf, np.log(2.0)])
    return (
        2.0 * optimize.least_squares(residuals, np.clip(polar, *bounds), bounds=bounds, x_scale="jac", xtol=1e-10).cost
    )


def test_the_same_minimum_as_scipy_finds(search, known):
    presses = known.presses(30, 7)
    charge = presses.noisy(NOISE, 8)
    expected = [scipy_square_sum(known, row[None], start) for row, start in zip(charge, presses.contact, strict=True)]
    np.testing.assert_allclose(square_sum(known, charge, search.estimate(charge)), expected, rtol=1e-3, atol=1e-3)
