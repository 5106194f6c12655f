"""Every method against a map whose inverse is known, SciPy and brute force; networks cut out of whole models."""

import pickle

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from tests.train.baselines.conftest import DOMAIN, KnownMap

from isocharge.common.errors import DatasetError
from isocharge.serve import find_model
from isocharge.simulate import Domain, FunctionMap, noise_model
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.baselines.compared_methods import compared_methods, polynomial_ridge
from isocharge.train.baselines.gauss_newton import GaussNewton
from isocharge.train.baselines.learned import Logarithms
from isocharge.train.baselines.networks import OnnxContact, ReleasedModel
from isocharge.train.baselines.paper import Triangulate
from isocharge.train.data.presses import LabelledPresses, position_error
from isocharge.train.model_release.onnx_graph import write_contact_graph
from isocharge.train.training.config import NetworkConfig
from isocharge.train.training.features import WhitenedFeatures
from isocharge.train.training.network import InverseNetwork, fold_contact_mean

ALLOWED = {
    "polynomial ridge": (0.1, 0.01),
    "Gauss-Newton": (0.002, 1e-3),
    "lookup table, interpolated": (0.15, 0.02),
    "Gaussian process": (0.4, 0.01),
    "linear band": (0.01, 0.4),
    "k-nearest neighbours": (1.2, 0.005),
    "lookup table, nearest entry": (1.2, 0.2),
    "gradient boosting": (1.5, 0.005),
}
"""Root-mean-square errors on clean charges, position, mm, and force, relative; a fit to 3,000 noisy presses has some of
its own."""


@pytest.fixture(scope="module")
def fitted(task):
    """Every method, fitted once, by its name."""
    return {method.name: method.fit(task) for method in compared_methods(task)}


@pytest.mark.parametrize("name", ALLOWED)
def test_close_to_the_contacts_that_gave_the_charges(name, fitted, test_presses):
    method, charge, (most_mm, most_force) = fitted[name], test_presses.charge, ALLOWED[name]
    answers = method.regressor.predict(charge)
    assert rms(position_error(answers, test_presses.contact)) < most_mm
    assert rms(answers[:, 2] / test_presses.contact[:, 2] - 1.0) < most_force
    np.testing.assert_allclose(method.regressor.predict(charge[:1]), answers[:1], rtol=1e-9, atol=1e-9)
    restored = pickle.loads(pickle.dumps(method.regressor))  # the report counts these bytes
    np.testing.assert_array_equal(restored.predict(charge), answers)
    assert f"{3000} " in method.choice


def test_a_polynomial_does_not_explode_outside_of_what_it_saw(fitted, task):
    absurd = np.array([[0.0], [-5.0], [1e9]]) * np.ones(task.train.charge.shape[1])
    assert np.isfinite(fitted["polynomial ridge"].regressor.predict(absurd)).all()


def test_logarithms_of_charges_of_both_signs_are_asinh_of_twice_their_share_of_the_usual_size():
    charge = 300.0 * np.array([[1.0, -1.0], [-1.0, 1.0], [-1.0, -5.0]])
    np.testing.assert_allclose(Logarithms().fit_transform(charge), np.arcsinh(charge / 150.0))


@pytest.mark.parametrize(("electrodes", "degrees"), [(3, [10, 12]), (5, [4, 6]), (8, [4]), (40, [1])])
def test_many_electrodes_lower_the_degree(electrodes, degrees):
    task = KnownMap(electrodes).task()
    method = polynomial_ridge(task)
    assert method.candidates["regressor__monomials__degree"] == degrees
    if electrodes >= 8:
        assert np.isfinite(method.fit(task).regressor.predict(task.validation.charge)).all()


def test_validation_chooses_and_the_choice_is_said():
    task = KnownMap(3).task(quick=False)
    band = next(method for method in compared_methods(task) if method.name == "linear band").fit(task)
    assert "best of 3 by validation" in band.choice
    assert band.regressor.degree in (6, 10, 14)


def test_a_band_without_presses_is_refused(task):
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
    """On the map itself, with derivatives by finite differences."""
    charge_map = FunctionMap(known.charges, tuple("ABCD"[: known.count]), DOMAIN)
    return GaussNewton(DOMAIN, NOISE, charge_map).fit(task.train.charge, task.train.contact)


def cost(known, charge, contact):
    return (((known.charges(contact) - charge) / NOISE.sigma(charge)) ** 2).sum(axis=1)


def scipy_cost(known, charge, start):
    """The least sum of squares by scipy, in polar coordinates, where the domain is a box."""

    def residuals(polar):
        contact = np.array([[polar[0] * np.cos(polar[1]), polar[0] * np.sin(polar[1]), np.exp(polar[2])]])
        return ((known.charges(contact) - charge) / NOISE.sigma(charge))[0]

    polar = [np.hypot(*start[:2]), np.arctan2(start[1], start[0]), np.log(start[2])]
    bounds = ([0.0, -np.inf, np.log(0.05)], [8.0, np.inf, np.log(2.0)])
    return 2.0 * least_squares(residuals, np.clip(polar, *bounds), bounds=bounds, x_scale="jac", xtol=1e-10).cost


def test_the_same_minimum_as_scipy_finds(search, known):
    presses = known.presses(30, 7)
    charge = presses.noisy(NOISE, 8)
    expected = [scipy_cost(known, row[None], start) for row, start in zip(charge, presses.contact, strict=True)]
    np.testing.assert_allclose(cost(known, charge, search.predict(charge)), expected, rtol=1e-3, atol=1e-3)


def test_its_own_series_answers_as_the_map_itself(search, known, task):
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
    """Untrained: they have to agree on any weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        config = NetworkConfig(hidden=(24, 24), misfit_hidden=(8, 8))
        network = InverseNetwork(Domain(8.0, (0.05, 2.0)), WhitenedFeatures.fit_logarithms(CHARGE), config)
        torch.nn.init.normal_(network.contact.skip.weight, std=0.3)
        return network.eval()


def check_contact(alone, expected):
    np.testing.assert_allclose(alone.predict(CHARGE), expected, rtol=1e-4, atol=1e-4)
    single = np.array([np.ravel(alone.single(row)())[:3].copy() for row in CHARGE[:9]])
    np.testing.assert_allclose(single, expected[:9], rtol=1e-4, atol=1e-4)


def test_the_graph_gives_the_networks_contact(network):
    with torch.no_grad():
        expected = network(torch.tensor(CHARGE).float())[0].numpy()
    graph = write_contact_graph(fold_contact_mean(network))
    check_contact(OnnxContact(graph), expected)
    count = sum(parameter.numel() for parameter in network.contact.parameters())
    assert 4 * count < len(graph) < 4 * count + 8000
    absurd = np.array([[0.0, 0.0, 0.0], [-5.0, 1e9, 3.0], [1e-30, 500.0, 500.0]])
    assert np.isfinite(OnnxContact(graph).predict(absurd)).all()


def test_the_contact_cut_out_of_a_released_model():
    released = ReleasedModel(find_model("three-25um-biaxial"))
    check_contact(released.contact_only(), released.predict(CHARGE))
    assert len(released.contact_only().graph) < len(released.graph)
