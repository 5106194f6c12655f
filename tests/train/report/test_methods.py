"""The methods of a report."""

import numpy as np
import pytest

from isocharge.simulate import noise_model
from isocharge.train.data.contact_errors import position_error, rms
from isocharge.train.report.evaluation import METHOD_BUILDERS, FittingTask

LARGEST_ERRORS = {
    "triangulation": (0.02, 2e-3),
    "least squares, Gauss-Newton": (0.02, 2e-3),
}
"""Largest rms errors on charges without noise, by name of the method: position, mm, and relative force."""


@pytest.fixture(scope="module")
def fitted(split):
    """Every method, fitted to the presses for training and their charge map, by its name."""
    task = FittingTask(split.field, noise_model("reference"))
    methods = [build_method(task) for build_method in METHOD_BUILDERS]
    return {method.name: method for method in methods}


@pytest.mark.parametrize("name", LARGEST_ERRORS)
def test_methods_find_the_contacts_of_charges_without_noise(name, fitted, split):
    """Presses within 6 mm, because the charges hardly determine the contacts near the rim."""
    method = fitted[name]
    contact = split.test[:40].within(6.0).contact
    charge = split.field.charges(contact)
    largest_mm, largest_force = LARGEST_ERRORS[name]
    answers = method.estimate(charge)
    assert rms(position_error(answers, contact)) < largest_mm
    assert rms(answers[:, 2] / contact[:, 2] - 1.0) < largest_force
    call = method.call_in_turn(charge[:2])
    for answer in (answers[:1], answers[1:2], answers[:1]):
        np.testing.assert_allclose(call(), answer, rtol=1e-9, atol=1e-9)
