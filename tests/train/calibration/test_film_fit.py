"""The fit of a film: derivatives, the joint problem solved by SciPy, errors that are as large as they say."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2
from tests.train.calibration.conftest import contacts, rig

from isocharge.train.calibration.contacts import RigData, adjust_contacts
from isocharge.train.calibration.film_fit import fit_film


def data_of(scene, presses) -> RigData:
    return RigData.of(
        presses.contact, presses.charge_pC, presses.position_std_mm, presses.force_std, scene.noise, scene.charges
    )


def test_derivatives_are_those_of_the_charges(layout):
    """Every column against central differences of the forward map of a film built from its parameters."""
    charges = layout.scene.charges
    rng = np.random.default_rng(3)
    parameters, at = charges.prior.draw(rng, 1)[0], contacts(rng, 6, 7.0)
    by_contact = charges.by_contact(charges.forward_map(parameters), at)
    by_parameter = charges.by_parameter(parameters, at, by_contact)
    size = np.abs(charges.charge_pC(parameters, at)).max(axis=1)[:, None]
    for number, std in enumerate(charges.prior.std):
        step = np.zeros_like(parameters)
        step[number] = 0.01 * std
        change = charges.charge_pC(parameters + step, at) - charges.charge_pC(parameters - step, at)
        np.testing.assert_allclose(by_parameter[:, :, number] / size, change / 0.02 / size, atol=1e-3)
    ahead = at * [1.0, 1.0, np.exp(1e-3)]
    by_force = (charges.charge_pC(parameters, ahead) - charges.charge_pC(parameters, at)) / 1e-3
    np.testing.assert_allclose(by_contact[:, :, 2] / size, by_force / size, atol=2e-3)


def test_it_is_the_minimum_of_the_joint_problem(scene):
    """SciPy over parameters and contacts together, with differences for derivatives, finds the same film."""
    charges = scene.charges
    truth, presses = rig(charges, 4, seed=11)
    data = data_of(scene, presses)
    ours = fit_film(charges, data)
    prior, n = charges.prior, len(presses)

    def residual(unknown):
        parameters, contact = unknown[: truth.size] * prior.std, unknown[truth.size :].reshape(n, 3)
        at = np.column_stack([contact[:, :2], np.exp(contact[:, 2])])
        by_charge = data.weight * (charges.charge_pC(parameters, at) - data.charge_pC)
        by_rig = data.contact_weight * (contact - data.contact)
        prior_miss = (parameters - prior.mean) / prior.std
        return np.concatenate([by_charge.ravel(), by_rig.ravel(), prior_miss])

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
    """Over films, the misses of the parameters in their own covariance add up to a chi-squared."""
    charges, scene = layout.scene.charges, layout.scene
    total, count = 0.0, 0
    for seed in range(6):
        truth, presses = rig(charges, 10, seed=100 + seed)
        posterior = fit_film(charges, data_of(scene, presses))
        assert not posterior.bad.any()
        miss = (posterior.parameters - truth) / charges.prior.std
        total += float(miss @ np.linalg.solve(posterior.covariance, miss))
        count += truth.size
    assert chi2.ppf(0.001, count) < total < chi2.ppf(0.999, count)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("row", [0, 4])
def test_a_bad_press_is_left_out_and_moves_nothing(scene, row):
    _, presses = rig(scene.charges, 10, seed=21)
    clean = fit_film(scene.charges, data_of(scene, presses))
    presses.charge_pC[row] *= [1.0, 1.3, 1.0, 1.0]
    spoilt = fit_film(scene.charges, data_of(scene, presses))
    assert np.flatnonzero(spoilt.bad).tolist() == [row]
    std = np.sqrt(np.diag(clean.covariance))
    assert np.abs((spoilt.parameters - clean.parameters) / scene.charges.prior.std / std).max() < 1.2


def test_contacts_are_adjusted_between_rig_and_charges(scene):
    """With the film known, a contact read by a poor rig is found from its charges."""
    charges = scene.charges
    truth, presses = rig(charges, 20, seed=5, position_std_mm=0.5, force_std=0.2)
    data = data_of(scene, presses)
    adjusted = adjust_contacts(charges, truth, data, data.contact)
    rng = np.random.default_rng(5)
    charges.prior.draw(rng, 1)
    real = contacts(rng, 20)
    error = np.hypot(*(adjusted.contact[:, :2] - real[:, :2]).T)
    assert np.median(error) < 0.1
    assert chi2.ppf(1e-4, 20 * 4) < adjusted.chi2.sum() < chi2.ppf(1.0 - 1e-4, 20 * 4)


def test_a_place_that_is_not_known_is_found(scene):
    _, presses = rig(scene.charges, 8, seed=6, force_std=0.003)
    known = presses.contact.copy()
    presses.contact[:, :2] = np.nan
    posterior = fit_film(scene.charges, data_of(scene, presses))
    assert np.hypot(*(posterior.contact[:, :2] - known[:, :2]).T).max() < 2.0
