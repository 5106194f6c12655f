"""Every method against a map whose inverse is known, and its forms against each other."""

import re
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

from isocharge.train.baselines import (
    GaussianProcess,
    GaussNewton,
    GradientBoosting,
    InterpolatedTable,
    LinearBand,
    NearestEntry,
    NearestNeighbours,
    PolynomialRidge,
)
from isocharge.train.data.noise import noisy_charges
from isocharge.train.data.presses import position_error

ALLOWED_MM = {
    PolynomialRidge(): 0.1,
    GaussNewton(): 0.002,
    InterpolatedTable(): 0.15,
    GaussianProcess(): 0.4,
    LinearBand(): 0.01,
    NearestNeighbours(): 1.2,
    NearestEntry(): 1.2,
    GradientBoosting(): 1.5,
}
"""Root-mean-square position error on clean charges; a fit to 3,000 noisy presses has some of its own."""

TOLERANCES = {
    GaussNewton(): 2e-4,  # two minimisers stop at steps of 1e-5
    GradientBoosting(): 1e-7,  # ONNX gives the sums of trees in float32
}
"""Differences between the forms of a method, relative and in mm or N, where they are more than round-off."""

FITS = {}


def forms_of(estimator, task):
    """Fitted once for all tests."""
    key = estimator.name, task.train.charge_pC.shape[1]
    if key not in FITS:
        FITS[key] = estimator.fit(task)
    return FITS[key]


@pytest.fixture(params=ALLOWED_MM, ids=lambda estimator: estimator.name)
def estimator(request):
    return request.param


def test_the_known_map_is_its_inverse(known, test_presses):
    np.testing.assert_allclose(known.contact(test_presses.charge_pC), test_presses.contact, rtol=1e-10, atol=1e-10)


def test_close_to_the_closed_form_inverse(estimator, task, known, test_presses):
    truth = known.contact(test_presses.charge_pC)
    for form in forms_of(estimator, task):
        error = position_error(form.predict(test_presses.charge_pC), truth)
        assert np.sqrt(np.mean(error**2)) < ALLOWED_MM[estimator], form.form


def test_force_follows_but_for_the_linear_band(task, test_presses):
    limits = {GaussNewton(): 1e-3, PolynomialRidge(): 0.01, InterpolatedTable(): 0.02}
    for estimator, limit in limits.items():
        force = forms_of(estimator, task)[-1].predict(test_presses.charge_pC)[:, 2]
        assert np.sqrt(np.mean((force / test_presses.contact[:, 2] - 1.0) ** 2)) < limit
    band = forms_of(LinearBand(), task)[-1].predict(test_presses.charge_pC)[:, 2]
    assert np.sqrt(np.mean((band / test_presses.contact[:, 2] - 1.0) ** 2)) > 0.2  # Q goes with F^(2/3), not with F


def test_forms_agree_to_round_off(estimator, task, test_presses):
    charge = noisy_charges(test_presses, task.noise, 4)
    forms = forms_of(estimator, task)
    tolerance = TOLERANCES.get(estimator, 1e-8)
    for form in forms[1:]:
        np.testing.assert_allclose(form.predict(charge), forms[0].predict(charge), rtol=tolerance, atol=tolerance)


def test_one_press_is_a_batch_of_one(estimator, task, test_presses):
    charge = noisy_charges(test_presses, task.noise, 5)[:20]
    for form in forms_of(estimator, task):
        single = np.array([np.ravel(form.one(row)()) for row in charge])
        np.testing.assert_allclose(single, form.predict(charge), rtol=1e-9, atol=1e-9)


def test_a_batch_does_not_depend_on_its_company(estimator, task, test_presses):
    charge = noisy_charges(test_presses, task.noise, 6)
    for form in forms_of(estimator, task):
        np.testing.assert_allclose(form.predict(charge)[:7], form.predict(charge[:7]), rtol=1e-9, atol=1e-9)


def array_bytes(value):
    """Bytes of all arrays that a form holds as fields, at any depth."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, tuple):
        return sum(map(array_bytes, value))
    return sum(array_bytes(getattr(value, field.name)) for field in fields(value)) if is_dataclass(value) else 0


def test_memory_holds_the_arrays_and_nothing_that_follows_from_them(estimator, task, test_presses):
    """`replace` gives the form without what earlier predictions have cached."""
    for form in forms_of(estimator, task):
        fresh = replace(form)
        before = fresh.memory
        assert array_bytes(form) < before
        fresh.predict(test_presses.charge_pC[:3])
        fresh.one(test_presses.charge_pC[0])()
        assert fresh.memory == before


def test_choice_says_from_how_many_presses_a_method_learnt(estimator, task):
    for form in forms_of(estimator, task):
        counts = re.findall(r"(\d+) (?:noisy |clean )?(?:presses|entries)", form.choice)
        assert counts
        assert all(100 <= int(count) <= 2 * len(task.train) for count in counts)
        assert form.name == estimator.name
        assert not form.given_force


@pytest.mark.parametrize("estimator", [PolynomialRidge(), InterpolatedTable(), NearestNeighbours()])
def test_a_seed_gives_the_same_method(estimator, task, test_presses):
    first, again = (estimator.fit(task)[-1].predict(test_presses.charge_pC) for _ in range(2))
    np.testing.assert_array_equal(first, again)
