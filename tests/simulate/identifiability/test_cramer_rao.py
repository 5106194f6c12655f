"""Cramer-Rao limits against closed forms and the scatter of an efficient estimator."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import least_squares
from scipy.stats import norm

from isocharge.simulate import ChargeFunction, NoiseModel, limits_at, noise_model
from isocharge.simulate.identifiability.cramer_rao import cramer_rao

AT = np.array([[8.0, 0.0], [0.0, 8.0], [-8.0, 0.0], [0.0, -8.0]]) * 1e-3


def far_field(contact):
    """Charges that fall with the distance from four electrodes and go with F^(2/3); C."""
    distance = np.linalg.norm(contact[:, None, :2] - AT, axis=2)
    return 1e-9 * contact[:, 2:] ** (2.0 / 3.0) / (1.0 + (distance / 1e-2) ** 2)


def far_field_jacobian(contact):
    away = contact[:, None, :2] - AT
    fall = 1.0 + (np.linalg.norm(away, axis=2) / 1e-2) ** 2
    charge = far_field(contact)
    place = -2e4 * away * (charge / fall)[..., None]
    return np.concatenate([place, (2.0 / 3.0) * charge[..., None]], axis=2)


MODEL = ChargeFunction(far_field, 6e-3, (0.05, 2.0))
CONTACT = np.array([[1e-3, -2e-3, 0.3], [4e-3, 3e-3, 1.5]])


def test_differences_are_derivatives():
    expected = far_field_jacobian(CONTACT)
    np.testing.assert_allclose(MODEL.jacobian(CONTACT), expected, rtol=1e-3, atol=1e-3 * np.abs(expected).min())


def test_what_a_reading_tells_by_integration():
    """Fisher's information is the mean square of the likelihood's slope; a strong gain makes sigma tell, too."""
    model, charge = NoiseModel("wild", 1e-12, 0.4), 3e-12

    def slope_squared(reading):
        step = 1e-15
        ahead, behind = (norm.logpdf(reading, q, model.sigma(q)) for q in (charge + step, charge - step))
        return ((ahead - behind) / (2.0 * step)) ** 2 * norm.pdf(reading, charge, model.sigma(charge)) * 1e-24

    wide = 12.0 * float(model.sigma(charge))
    expected = quad(slope_squared, charge - wide, charge + wide, points=[charge], epsabs=0.0, epsrel=1e-8)[0] * 1e24
    assert model.information(charge) == pytest.approx(expected, rel=1e-5)
    assert model.information(charge) > 1.1 / model.sigma(charge) ** 2


def test_linear_charges_give_the_covariance_of_least_squares():
    rng = np.random.default_rng(0)
    jacobian, white = rng.normal(size=(5, 4, 3)) * [1e-9, 1e-9, 1e-12], 2e-12
    limits = cramer_rao(np.zeros((5, 4)), jacobian, NoiseModel("white", white, 0.0))
    for each, covariance in zip(jacobian, limits.covariance, strict=True):
        np.testing.assert_allclose(covariance, white**2 * np.linalg.inv(each.T @ each), rtol=1e-8)


def test_position_and_force_are_read_from_the_covariance():
    limits = cramer_rao(np.zeros((1, 3)), np.diag([2e-9, 1e-9, 5e-12])[None], NoiseModel("white", 1e-12, 0.0))
    assert limits.position[0] == pytest.approx(np.hypot(0.5e-3, 1e-3))
    assert limits.force[0] == pytest.approx(0.2)


def test_an_efficient_estimator_scatters_as_much():
    """Least squares with weights, on a thousand noisy readings of two contacts."""
    reference, rng = noise_model("reference"), np.random.default_rng(1)
    limits = limits_at(MODEL, CONTACT, reference)
    scale = np.array([1e-3, 1e-3, 1.0])
    for number, contact in enumerate(CONTACT):
        charge = far_field(contact[None])
        sigma = reference.sigma(charge)[0]

        def miss(unit, reading, sigma=sigma):
            x, y, log_force = unit * scale
            return (far_field(np.array([[x, y, np.exp(log_force)]]))[0] - reading) / sigma

        start = np.append(contact[:2], np.log(contact[2])) / scale
        readings = reference.add(np.repeat(charge, 1000, axis=0), rng)
        estimates = np.array([least_squares(miss, start, args=(row,), method="lm").x for row in readings]) * scale
        position = np.sqrt(np.sum(estimates[:, :2].var(axis=0)))
        assert position == pytest.approx(limits.position[number], rel=0.06)
        assert estimates[:, 2].std() == pytest.approx(limits.force[number], rel=0.08)


def test_more_noise_less_known():
    quiet, loud = (limits_at(MODEL, CONTACT, NoiseModel("n", white, 0.0)).position for white in (1e-12, 3e-12))
    np.testing.assert_allclose(loud, 3.0 * quiet)


def test_what_the_charges_cannot_tell_has_a_huge_limit():
    """Charges that do not depend on y."""
    blind = replace(MODEL, function=lambda contact: far_field(contact * [1.0, 0.0, 1.0]))
    limits = limits_at(blind, CONTACT, noise_model("reference"))
    assert np.isfinite(limits.position).all()
    assert (limits.position > 1.0).all()
    assert (limits.parameter(0) < 1e-3).all()
