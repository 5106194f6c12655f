"""The fit of a film: derivatives, the joint problem solved by SciPy, errors that are as large as they say."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2
from tests.train.calibration.conftest import rig

from isocharge.train.calibration.contacts import PressData, adjust_contacts, with_force
from isocharge.train.calibration.film_fit import fit_film
from isocharge.train.data.presses import draw_contacts


def data_of(problem, presses) -> PressData:
    return PressData.of(presses, problem.noise, problem.charges)


def fit(problem, presses):
    return fit_film(problem.charges, data_of(problem, presses), problem.before)


def test_derivatives_are_those_of_the_charges(layout):
    """Every column against central differences of the forward map of a film built from its parameters."""
    charges, rng = layout.charges, np.random.default_rng(3)
    parameters, at = layout.prior.draw(rng, 1)[0], draw_contacts(rng, layout.domain.within(7.0), 6)
    by_contact = charges.by_contact(parameters, at)
    by_parameter = charges.by_parameter(parameters, at, by_contact)
    size = np.abs(charges.charges(parameters, at)).max(axis=1)[:, None]
    for number, std in enumerate(layout.prior.std):
        step = np.zeros_like(parameters)
        step[number] = 0.01 * std
        change = charges.charges(parameters + step, at) - charges.charges(parameters - step, at)
        np.testing.assert_allclose(by_parameter[:, :, number] / size, change / 0.02 / size, atol=1e-3)
    by_map = charges.forward_map(parameters).derivatives(at)
    np.testing.assert_allclose(by_contact / size[:, :, None], by_map / size[:, :, None], atol=2e-3)


def test_it_is_the_minimum_of_the_joint_problem(problem):
    """SciPy over parameters and contacts together, with differences for derivatives, finds the same film."""
    charges, prior = problem.charges, problem.prior
    truth, presses = rig(problem, 4, seed=11)
    data, ours, n = data_of(problem, presses), fit(problem, presses), len(presses)

    def residual(unknown):
        parameters, contact = unknown[: truth.size] * prior.std, unknown[truth.size :].reshape(n, 3)
        by_charge = data.weight * (charges.charges(parameters, with_force(contact)) - data.charge)
        by_rig = data.contact_weight * (contact - data.contact)
        return np.concatenate([by_charge.ravel(), by_rig.ravel(), (parameters - prior.mean) / prior.std])

    start = np.concatenate([prior.mean / prior.std, data.contact.ravel()])
    low, high = (
        np.concatenate([bound / prior.std, np.full(3 * n, end)])
        for bound, end in zip(prior.bounds, (-50.0, 50.0), strict=True)
    )
    joint = least_squares(residual, start, bounds=(low, high), x_scale="jac", xtol=1e-9, ftol=1e-9, diff_step=1e-4)
    std = np.sqrt(np.diag(ours.covariance))
    apart = (ours.parameters / prior.std - joint.x[: truth.size]) / std
    assert np.abs(apart).max() < 0.1
    joint_covariance = np.linalg.inv(joint.jac.T @ joint.jac)[: truth.size, : truth.size]
    np.testing.assert_allclose(std, np.sqrt(np.diag(joint_covariance)), rtol=0.05)


@pytest.mark.first_cases(1)
def test_errors_are_as_large_as_they_say(layout):
    """Over films, the deviations of the parameters in their own covariance add up to a chi-squared."""
    total, count = 0.0, 0
    for seed in range(6):
        truth, presses = rig(layout, 10, seed=100 + seed)
        posterior = fit(layout, presses)
        assert not posterior.bad.any()
        deviation = (posterior.parameters - truth) / layout.prior.std
        total += float(deviation @ np.linalg.solve(posterior.covariance, deviation))
        count += truth.size
    assert chi2.ppf(0.001, count) < total < chi2.ppf(0.999, count)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("row", [0, 4])
def test_a_bad_press_is_left_out_and_moves_nothing(problem, row):
    _, presses = rig(problem, 10, seed=21)
    clean = fit(problem, presses)
    presses.charge_pC[row] *= [1.0, 1.3, 1.0, 1.0]
    spoilt = fit(problem, presses)
    assert np.flatnonzero(spoilt.bad).tolist() == [row]
    std = np.sqrt(np.diag(clean.covariance))
    assert np.abs((spoilt.parameters - clean.parameters) / problem.prior.std / std).max() < 1.2


def test_contacts_are_adjusted_between_rig_and_charges(problem):
    """With the film known, a contact read by a poor rig is found from its charges."""
    truth, presses = rig(problem, 20, seed=5, position_std_mm=0.5, force_std=0.2)
    _, real = rig(problem, 20, seed=5, position_std_mm=1e-9, force_std=1e-9)
    data = data_of(problem, presses)
    adjusted = adjust_contacts(problem.charges, truth, data, data.contact)
    error = np.hypot(*(adjusted.contact[:, :2] - real.contact[:, :2]).T)
    assert np.median(error) < 0.1
    assert chi2.ppf(1e-4, 20 * 4) < adjusted.chi2.sum() < chi2.ppf(1.0 - 1e-4, 20 * 4)


def test_a_place_that_is_not_known_is_found(problem):
    _, presses = rig(problem, 8, seed=6, force_std=0.003)
    known = presses.contact[:, :2]
    posterior = fit(problem, replace(presses, contact=presses.contact * [np.nan, np.nan, 1.0]))
    assert np.hypot(*(posterior.contact[:, :2] - known).T).max() < 2.0
