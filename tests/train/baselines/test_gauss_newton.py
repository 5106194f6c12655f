"""Gauss-Newton against SciPy, finite differences and a search on a dense grid."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from isocharge.train.baselines import GaussNewton
from isocharge.train.data.noise import noisy_charges


@pytest.fixture(scope="module")
def fits(task):
    return GaussNewton().fit(task)


def test_slopes_by_finite_differences(fits, known):
    problem = fits[1].problem
    charge = np.full(known.electrodes, 700.0)
    sigma = problem.sigma(charge)
    for unit in np.array([[0.1, -0.3, 0.2], [0.72, -0.71, 0.4], [0.3, 0.4, -0.9]]):
        slopes = problem.residuals(unit, charge, sigma)[1]
        expected = approx_fprime(unit, lambda at: problem.residuals(at, charge, sigma)[0], 1e-7)
        np.testing.assert_allclose(slopes.T, expected, rtol=1e-3, atol=0.1)


def test_known_charges_of_the_fitted_map(fits, test_presses):
    charge, _ = fits[1].problem.known(fits[1].domain.to_unit(test_presses.contact))
    np.testing.assert_allclose(charge, test_presses.charge_pC, rtol=1e-3)


def costs_of(fits, task, charge):
    problem, sigma = fits[1].problem, fits[1].problem.sigma(charge)
    units = [task.domain.to_unit(form.predict(charge)) for form in fits]
    return [(problem.residuals(unit, charge, sigma)[0] ** 2).sum(axis=1) for unit in units]


def test_the_same_minimum_as_scipy_finds(fits, task, known):
    charge = noisy_charges(known.presses(200, 7), task.noise, 8)
    library, plain = costs_of(fits, task, charge)
    np.testing.assert_allclose(plain, library, rtol=1e-3, atol=1e-3)


def test_the_same_minimum_on_the_edge(fits, task, known):
    contact = known.presses(100, 11).contact
    contact[:, :2] *= (8.0 * 1.02 / np.hypot(contact[:, 0], contact[:, 1]))[:, None]
    contact[::3, 2] = 2.05
    library, plain = costs_of(fits, task, known.charge_pC(contact))
    assert np.median(library) > 1.0
    np.testing.assert_allclose(plain, library, rtol=0.01, atol=0.01)


def test_no_contact_of_a_dense_grid_fits_better(fits, task, known):
    presses = known.presses(5, 9)
    charge = noisy_charges(presses, task.noise, 10)
    plain = fits[1]
    found = task.domain.to_unit(plain.predict(charge))
    steps = np.stack(np.meshgrid(*[np.linspace(-0.05, 0.05, 21)] * 3), axis=-1).reshape(-1, 3)
    for number, row in enumerate(charge):
        sigma = plain.problem.sigma(row)
        around = found[number] + steps
        around = around[(np.hypot(around[:, 0], around[:, 1]) <= 1.0) & (np.abs(around[:, 2]) <= 1.0)]
        costs = (plain.problem.residuals(around, row, sigma)[0] ** 2).sum(axis=1)
        best = (plain.problem.residuals(found[number], row, sigma)[0] ** 2).sum()
        assert best <= costs.min() + 1e-6


def test_answers_stay_in_the_domain(fits, known):
    absurd = known.charge_pC(np.array([[7.9, 0.0, 1.9]])) * np.array([[0.5, *[3.0] * (known.electrodes - 1)]])
    for form in fits:
        x, y, force = form.predict(absurd)[0]
        assert np.hypot(x, y) <= 8.0 + 1e-9
        assert 0.05 - 1e-9 <= force <= 2.0 + 1e-9
