"""Every method against a map whose inverse is known."""

import pickle

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from tests.train.baselines.conftest import KnownMap

from isocharge.common.errors import DatasetError
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.baselines.learned import stretched, whitening
from isocharge.train.baselines.paper import affine_maps
from isocharge.train.baselines.rivals import polynomial_ridge, rivals
from isocharge.train.data.presses import LabelledPresses, position_error

ALLOWED = {
    "polynomial ridge": 0.1,
    "Gauss-Newton": 0.002,
    "lookup table, interpolated": 0.15,
    "Gaussian process": 0.4,
    "linear band": 0.01,
    "k-nearest neighbours": 1.2,
    "lookup table, nearest entry": 1.2,
    "gradient boosting": 1.5,
}
"""Root-mean-square position error on clean charges, mm; a fit to 3,000 noisy presses has some of its own."""


@pytest.fixture(scope="module")
def fitted(task):
    """Every method, fitted once, by its name."""
    return {rival.name: rival.fit(task) for rival in rivals(task)}


def test_the_known_map_is_its_inverse(known, test_presses):
    np.testing.assert_allclose(known.contacts(test_presses.charge), test_presses.contact, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ALLOWED)
def test_close_to_the_closed_form_inverse(name, fitted, known, test_presses):
    rival, charge = fitted[name], test_presses.charge
    answers = rival.regressor.predict(charge)
    assert rms(position_error(answers, known.contacts(charge))) < ALLOWED[name]
    np.testing.assert_allclose(rival.regressor.predict(charge[:1]), answers[:1], rtol=1e-9, atol=1e-9)
    restored = pickle.loads(pickle.dumps(rival.regressor))  # the report counts these bytes
    np.testing.assert_array_equal(restored.predict(charge), answers)
    assert f"{3000} " in rival.choice


def test_every_method_is_tested(fitted):
    assert set(fitted) == set(ALLOWED)


def test_force_follows_but_for_the_linear_band(fitted, test_presses):
    def force_error(name):
        answers = fitted[name].regressor.predict(test_presses.charge)
        return rms(answers[:, 2] / test_presses.contact[:, 2] - 1.0)

    for name, limit in {"Gauss-Newton": 1e-3, "polynomial ridge": 0.01, "lookup table, interpolated": 0.02}.items():
        assert force_error(name) < limit
    assert force_error("linear band") > 0.2  # Q goes with F^(2/3), not with F


def test_nearest_neighbours_by_brute_force(fitted, task, test_presses):
    """The mean of the nearest sixteen residuals about a linear fit, with the rulers of the quick choice."""
    noisy, charge = task.presses(5), test_presses.charge[:40]
    features = whitening().fit(noisy.charge)
    known, asked = (stretched(features.transform(each), 0.1, 0.03) for each in (noisy.charge, charge))
    unit = task.domain.to_unit(noisy.contact)
    plane = LinearRegression().fit(known, unit)
    rows = np.argsort(np.linalg.norm(asked[:, None] - known[None], axis=2), axis=1)[:, :16]
    found = plane.predict(asked) + (unit - plane.predict(known))[rows].mean(axis=1)
    expected = np.column_stack([8.0 * found[:, :2], np.exp(np.log(np.sqrt(0.1)) + 0.5 * np.log(40.0) * found[:, 2])])
    answers = fitted["k-nearest neighbours"].regressor.predict(charge)
    np.testing.assert_allclose(answers, expected, rtol=1e-9, atol=1e-9)


def test_the_nearest_entry_by_brute_force(fitted, task, test_presses):
    features = whitening().fit(task.train.charge)
    entries, asked = (features.transform(each) for each in (task.train.charge, test_presses.charge[:40]))
    nearest = np.linalg.norm(asked[:, None] - entries[None], axis=2).argmin(axis=1)
    answers = fitted["lookup table, nearest entry"].regressor.predict(test_presses.charge[:40])
    np.testing.assert_allclose(answers, task.train.contact[nearest], rtol=1e-9)


def test_affine_maps_find_an_affine_map():
    rng = np.random.default_rng(0)
    offset, slope, shift = rng.normal(size=(50, 20, 3)), rng.normal(size=(3, 3)), rng.normal(size=3)
    maps = affine_maps(offset, offset @ slope + shift)
    np.testing.assert_allclose(maps[:, -1], np.broadcast_to(shift, (50, 3)), atol=1e-4)
    np.testing.assert_allclose(maps[:, :-1], np.broadcast_to(slope, (50, 3, 3)), atol=1e-4)


def test_a_polynomial_does_not_explode_outside_of_what_it_saw(fitted, task):
    absurd = np.array([[0.0], [-5.0], [1e9]]) * np.ones(task.train.charge.shape[1])
    assert np.isfinite(fitted["polynomial ridge"].regressor.predict(absurd)).all()


@pytest.mark.parametrize(("electrodes", "degrees"), [(3, [10, 12]), (5, [4, 6]), (8, [4]), (40, [1])])
def test_many_electrodes_lower_the_degree(electrodes, degrees):
    task = KnownMap(electrodes).task()
    rival = polynomial_ridge(task)
    assert rival.candidates["regressor__monomials__degree"] == degrees
    if electrodes >= 8:
        assert np.isfinite(rival.fit(task).regressor.predict(task.validation.charge)).all()


def test_validation_chooses_and_the_choice_is_said():
    task = KnownMap(3).task(quick=False)
    band = next(rival for rival in rivals(task) if rival.name == "linear band").fit(task)
    assert "best of 3 by validation" in band.choice
    assert band.regressor.degree in (6, 10, 14)


def test_a_band_without_presses_is_refused(task):
    strong = task.train[task.train.contact[:, 2] > 0.5]
    band = next(rival for rival in rivals(task) if rival.name == "linear band")
    with pytest.raises(DatasetError, match=r"at least 200 presses of at most 0.5 N, got 0"):
        band.regressor.fit(strong.charge, strong.contact)


def test_noise_is_added_to_clean_presses_and_not_to_measured_ones(task):
    noisy = task.presses(5)
    assert len(noisy) == len(task.train)  # a quick task takes one copy
    sigma = np.hypot(1.0, 0.002 * task.train.charge)
    assert 0.97 < rms((noisy.charge - task.train.charge) / sigma) < 1.03
    measured = LabelledPresses(task.train.contact, task.train.charge, measured=True)
    rig = type(task)(measured, measured, task.domain, task.noise)
    assert rig.presses(5) is measured
    assert rig.validation_charge is measured.charge
