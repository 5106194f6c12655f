"""The methods of a report."""

import numpy as np
import pytest

from isocharge.simulate import noise_model
from isocharge.train import LabelledPresses
from isocharge.train.data.contact_errors import position_error, rms
from isocharge.train.report.evaluation import METHOD_BUILDERS, FittingTask

LARGEST_ERRORS = {
    "triangulation": (0.02, 2e-3),
    "least squares, Gauss-Newton": (0.02, 2e-3),
}
"""Largest rms errors on charges without noise, by name of the method: position, mm, and relative force."""


@pytest.fixture(scope="module")
def presses(dataset):
    return LabelledPresses.of(dataset.samples)


@pytest.fixture(scope="module")
def fitted(presses, spline):
    """Every method, fitted to some of the presses and their charge map, by its name."""
    task = FittingTask(presses[np.arange(3_000)], spline, noise_model("reference"))
    methods = [build_method(task) for build_method in METHOD_BUILDERS]
    return {method.name: method for method in methods}


@pytest.mark.parametrize("name", LARGEST_ERRORS)
def test_methods_find_the_contacts_of_charges_without_noise(name, fitted, presses):
    """Presses within 6 mm, because the charges hardly determine the contacts near the rim."""
    method = fitted[name]
    test_presses = presses[np.arange(3_000, 3_040)].within(6.0)
    charge = test_presses.charge
    largest_mm, largest_force = LARGEST_ERRORS[name]
    answers = method.estimate(charge)
    assert rms(position_error(answers, test_presses.contact)) < largest_mm
    assert rms(answers[:, 2] / test_presses.contact[:, 2] - 1.0) < largest_force
    call = method.call_in_turn(charge[:2])
    for answer in (answers[:1], answers[1:2], answers[:1]):
        np.testing.assert_allclose(call(), answer, rtol=1e-9, atol=1e-9)
