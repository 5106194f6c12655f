"""Gauss-Newton against SciPy and a dense grid, on its series and on any charge map; triangulation on clean charges."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from tests.train.baselines.conftest import DOMAIN

from isocharge.simulate import FunctionMap, noise_model
from isocharge.train.baselines.gauss_newton import GaussNewton
from isocharge.train.baselines.paper import Triangulate
from isocharge.train.data.presses import LabelledPresses, position_error

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


def test_the_same_minimum_on_the_edge(search, known):
    contact = known.presses(20, 11).contact
    contact[:, :2] *= (8.0 * 1.02 / np.hypot(contact[:, 0], contact[:, 1]))[:, None]
    contact[::3, 2] = 2.05
    charge = known.charges(contact)
    expected = [scipy_cost(known, row[None], start) for row, start in zip(charge, contact, strict=True)]
    assert np.median(expected) > 1.0
    found = search.predict(charge)
    np.testing.assert_allclose(cost(known, charge, found), expected, rtol=0.01, atol=0.01)
    assert np.hypot(*found[:, :2].T).max() <= 8.0 + 1e-9
    assert found[:, 2].max() <= 2.0 + 1e-9


def test_no_contact_of_a_dense_grid_fits_better(search, known):
    charge = known.presses(5, 9).noisy(NOISE, 10)
    steps = np.stack(np.meshgrid(*[np.linspace(-0.05, 0.05, 21)] * 3), axis=-1).reshape(-1, 3)
    for row, found in zip(charge, search.predict(charge), strict=True):
        around = DOMAIN.to_contact(DOMAIN.to_unit(found[None]) + steps)
        around = around[(np.hypot(*around[:, :2].T) <= 8.0) & (np.abs(np.log(around[:, 2] / 0.3162)) <= np.log(40) / 2)]
        assert cost(known, row, found[None])[0] <= cost(known, row, around).min() + 1e-6


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
