"""The compared methods on a map with a known inverse, Gauss-Newton against SciPy, and parts of whole networks."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from tests.train.baselines.conftest import DOMAIN, KnownMap

from isocharge.common.contact_errors import position_error
from isocharge.common.errors import DatasetError
from isocharge.common.statistics import rms
from isocharge.serve import find_model
from isocharge.simulate import Domain, FunctionMap, noise_model
from isocharge.train.baselines.compared_methods import compared_methods, polynomial_ridge
from isocharge.train.baselines.gauss_newton import GaussNewton
from isocharge.train.baselines.learned import Logarithms
from isocharge.train.baselines.networks import OnnxContact, StoredModel
from isocharge.train.baselines.paper import Triangulate
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.model_release.onnx_graph import write_contact_graph
from isocharge.train.training.config import NetworkConfig
from isocharge.train.training.features import WhitenedFeatures
from isocharge.train.training.network import InverseNetwork, fold_contact_mean

LARGEST_ERRORS = {
    "polynomial ridge": (0.1, 0.01),
    "Gauss-Newton": (0.002, 1e-3),
    "lookup table, interpolated": (0.15, 0.02),
    "Gaussian process": (0.4, 0.01),
    "linear band": (0.01, 0.4),
    "k-nearest neighbours": (1.2, 0.005),
    "lookup table, nearest entry": (1.2, 0.2),
    "gradient boosting": (1.5, 0.005),
}
"""Largest rms errors on charges without noise, by name of the method: position, mm, and relative force. The methods are
fitted to 3,000 presses with noise."""


@pytest.fixture(scope="module")
def fitted(task):
    """Every method, fitted once, by its name."""
    return {method.name: method.fit(task) for method in compared_methods(task)}


@pytest.mark.parametrize("name", LARGEST_ERRORS)
def test_methods_find_the_contacts_of_charges_without_noise(name, fitted, test_presses):
    method = fitted[name]
    charge = test_presses.charge
    largest_mm, largest_force = LARGEST_ERRORS[name]
    answers = method.regressor.predict(charge)
    assert rms(position_error(answers, test_presses.contact)) < largest_mm
    assert rms(answers[:, 2] / test_presses.contact[:, 2] - 1.0) < largest_force
    np.testing.assert_allclose(method.regressor.predict(charge[:1]), answers[:1], rtol=1e-9, atol=1e-9)
    restored = pickle.loads(pickle.dumps(method.regressor))  # the report counts these bytes
    np.testing.assert_array_equal(restored.predict(charge), answers)
    assert f"{3000} " in method.choice


def test_a_polynomial_is_finite_far_from_the_training_presses(fitted, task):
    absurd = np.array([[0.0], [-5.0], [1e9]]) * np.ones(task.train.charge.shape[1])
    assert np.isfinite(fitted["polynomial ridge"].regressor.predict(absurd)).all()


def test_features_of_charges_of_both_signs_are_inverse_hyperbolic_sines():
    charge = 300.0 * np.array([[1.0, -1.0], [-1.0, 1.0], [-1.0, -5.0]])
    np.testing.assert_allclose(Logarithms().fit_transform(charge), np.arcsinh(charge / 150.0))


@pytest.mark.parametrize(("electrodes", "degrees"), [(3, [10, 12]), (5, [4, 6]), (8, [4]), (40, [1])])
def test_many_electrodes_lower_the_degree(electrodes, degrees):
    task = KnownMap(electrodes).task()
    method = polynomial_ridge(task)
    assert method.candidates["regressor__monomials__degree"] == degrees
    if electrodes >= 8:
        assert np.isfinite(method.fit(task).regressor.predict(task.validation.charge)).all()


def test_the_parameters_are_chosen_by_validation():
    task = KnownMap(3).task(quick=False)
    band = next(method for method in compared_methods(task) if method.name == "linear band").fit(task)
    assert "best of 3 by validation" in band.choice
    assert band.regressor.degree in (6, 10, 14)


def test_the_choice_calls_presses_clean_noisy_or_measured():
    task = KnownMap(3).task()
    measured_presses = replace(task.train, measured=True)
    measured_task = replace(task, train=measured_presses, validation=replace(task.validation, measured=True))
    linear_band = next(method for method in compared_methods(task) if method.name == "linear band")
    assert linear_band.copies == 0
    assert "3000 clean presses" in linear_band.fit(task).choice
    assert "3000 noisy presses" in replace(linear_band, copies=1).fit(task).choice
    for copies in (0, 1):
        choice = replace(linear_band, copies=copies).fit(measured_task).choice
        assert "3000 measured presses" in choice


def test_a_linear_band_without_presses_is_refused(task):
    strong = task.train[task.train.contact[:, 2] > 0.5]
    band = next(method for method in compared_methods(task) if method.name == "linear band")
    with pytest.raises(DatasetError, match=r"at least 200 presses of at most 0.5 N, got 0"):
        band.regressor.fit(strong.charge, strong.contact)


def test_noise_is_added_to_clean_presses_and_not_to_measured_ones(task):
    noisy = task.presses(5)
    assert len(noisy) == len(task.train)  # a quick task takes one copy
    assert 0.97 < rms((noisy.charge - task.train.charge) / np.hypot(1.0, 0.002 * task.train.charge)) < 1.03
    measured = LabelledPresses(task.train.contact, task.train.charge, measured=True)
    rig = type(task)(measured, measured, task.domain, task.noise)
    assert rig.presses(5) is measured
    assert rig.validation_charge is measured.charge


NOISE = noise_model("reference")


@pytest.fixture(scope="module")
def search(known, task):
    """Gauss-Newton on the known map, with derivatives by finite differences."""
    charge_map = FunctionMap(known.charges, tuple("ABCD"[: known.count]), DOMAIN)
    return GaussNewton(DOMAIN, NOISE, charge_map).fit(task.train.charge, task.train.contact)


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
    return 2.0 * least_squares(residuals, np.clip(polar, *bounds), bounds=bounds, x_scale="jac", xtol=1e-10).cost


def test_the_same_minimum_as_scipy_finds(search, known):
    presses = known.presses(30, 7)
    charge = presses.noisy(NOISE, 8)
    expected = [scipy_square_sum(known, row[None], start) for row, start in zip(charge, presses.contact, strict=True)]
    np.testing.assert_allclose(square_sum(known, charge, search.predict(charge)), expected, rtol=1e-3, atol=1e-3)


def test_gauss_newton_on_a_fitted_series_answers_as_on_the_map(search, known, task):
    series = GaussNewton(DOMAIN, NOISE).fit(task.train.charge, task.train.contact)
    charge = known.presses(200, 12).noisy(NOISE, 13)
    assert np.median(position_error(series.predict(charge), search.predict(charge))) < 0.002


def test_triangulation_finds_clean_presses(dataset, spline):
    presses = LabelledPresses.of(dataset)[np.arange(20)]
    for given in (False, True):
        method = Triangulate(spline, given_force=given).fit(presses.charge, presses.contact)
        inputs = np.column_stack([presses.charge, presses.contact[:, 2]]) if given else presses.charge
        contact = method.predict(inputs)
        found = np.isfinite(contact[:, 0])
        assert found.mean() > 0.8
        assert np.median(position_error(contact[found], presses.contact[found])) < 0.02


CHARGE = np.random.default_rng(0).uniform(100.0, 1500.0, (400, 3))


@pytest.fixture(scope="module")
def network():
    """An untrained network, because the comparisons hold for any weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        config = NetworkConfig(hidden=(24, 24), misfit_hidden=(8, 8))
        network = InverseNetwork(Domain(8.0, (0.05, 2.0)), WhitenedFeatures.fit_logarithms(CHARGE), config)
        torch.nn.init.normal_(network.contact.skip.weight, std=0.3)
        return network.eval()


def check_contact(contact_only, expected):
    """Check the contacts of a batch and of single presses."""
    np.testing.assert_allclose(contact_only.predict(CHARGE), expected, rtol=1e-4, atol=1e-4)
    for charge, contact in zip(CHARGE[:9], expected, strict=False):
        compute = contact_only.single_press_function(charge)
        np.testing.assert_allclose(np.ravel(compute())[:3], contact, rtol=1e-4, atol=1e-4)


def test_the_contact_graph_gives_the_contact_of_the_network(network):
    with torch.no_grad():
        expected = network(torch.tensor(CHARGE).float())[0].numpy()
    folded = fold_contact_mean(network)
    graph = write_contact_graph(folded)
    check_contact(OnnxContact(graph), expected)
    layers = (*folded.layers.hidden, folded.layers.last)
    count = folded.layers.skip.size + sum(layer.weight.size + layer.bias.size for layer in layers)
    assert 4 * count < len(graph) < 4 * count + 8000
    absurd = np.array([[0.0, 0.0, 0.0], [-5.0, 1e9, 3.0], [1e-30, 500.0, 500.0]])
    assert np.isfinite(OnnxContact(graph).predict(absurd)).all()


def test_the_part_of_a_released_model_that_computes_the_contact():
    released = StoredModel(find_model("three-25um-biaxial"))
    check_contact(released.contact_only(), released.predict(CHARGE))
    assert len(released.contact_only().graph) < len(released.graph)
