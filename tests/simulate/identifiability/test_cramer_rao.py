"""Cramer-Rao limits compared with closed forms and with results of an independent search."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from function_map import round_map
from isocharge.simulate import ChargeSpline, Domain, NoiseModel, limits_at, noise_model
from isocharge.simulate.identifiability.cramer_rao import cramer_rao
from solved_charges import with_squares

REFERENCE = noise_model("reference")
AT = np.array([[8.0, 0.0], [0.0, 8.0], [-8.0, 0.0], [0.0, -8.0]])


MAP = round_map(AT, Domain(6.0, (0.05, 2.0)))
CONTACT = np.array([[1.0, -2.0, 0.3], [4.0, 3.0, 1.5]])


def test_information_of_a_reading_agrees_with_numerical_integration():
    """The Fisher information is the mean square of the derivative of the log likelihood.

    If the noise depends strongly on the charge, the size of the noise also provides information.
    """
    model = NoiseModel("wild", 1.0, 0.4)
    charge = 3.0

    def slope_squared(reading):
        step = 1e-3
        ahead, behind = (norm.logpdf(reading, q, model.sigma(q)) for q in (charge + step, charge - step))
        return ((ahead - behind) / (2.0 * step)) ** 2 * norm.pdf(reading, charge, model.sigma(charge))

    wide = 12.0 * float(model.sigma(charge))
    expected = quad(slope_squared, charge - wide, charge + wide, points=[charge], epsabs=0.0, epsrel=1e-8)[0]
    assert model.information(charge) == pytest.approx(expected, rel=1e-5)


def test_limits_of_charges_that_each_depend_on_one_parameter():
    limits = cramer_rao(np.zeros((1, 3)), np.diag([2.0, 1.0, 5.0])[None], NoiseModel("white", 1.0, 0.0))
    assert limits.position[0] == pytest.approx(np.hypot(0.5, 1.0))
    assert limits.force[0] == pytest.approx(0.2)


def test_nuisances_are_equivalent_to_correlated_noise():
    """Unknowns with a prior act like correlated noise with the covariance diag(1/i) + N N' (Woodbury's identity)."""
    rng = np.random.default_rng(3)
    charge = rng.uniform(100.0, 1000.0, (20, 5))
    jacobian = rng.normal(size=(20, 5, 3)) * [100.0, 100.0, 1000.0]
    nuisance = 10.0 * rng.normal(size=(20, 5, 2))
    limits = cramer_rao(charge, jacobian, REFERENCE, nuisance)
    for i in range(20):
        noise = np.diag(1.0 / REFERENCE.information(charge[i])) + nuisance[i] @ nuisance[i].T
        expected = np.linalg.inv(jacobian[i].T @ np.linalg.inv(noise) @ jacobian[i])
        np.testing.assert_allclose(limits.covariance[i, :3, :3], expected, rtol=1e-6)


def test_limit_of_an_unobservable_parameter_is_large():
    """The charges do not depend on y."""
    blind = replace(MAP, function=lambda contact: MAP.charges(contact * [1.0, 0.0, 1.0]))
    limits = limits_at(blind, CONTACT, REFERENCE)
    assert np.isfinite(limits.position).all()
    assert (limits.position > 1000.0).all()
    assert (np.sqrt(limits.covariance[:, 0, 0]) < 1.0).all()


def test_limits_of_a_layout_agree_with_an_independent_search(three_map):
    """The expected errors within 8 mm at 1 N are from an independent search over layouts.

    The largest error differs by up to 4 % between grids.
    """
    sensor = with_squares(three_map.sensor, (0.5, -14.1), (-5.1, 6.3), (-0.2, -0.3), (8.6, 1.1))
    charges = ChargeSpline.of(replace(three_map, sensor=sensor), spacing=0.3)
    steps = 0.3 * np.arange(-26, 27)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    at = grid[np.hypot(*grid.T) <= 8.0]
    position = limits_at(charges, np.column_stack([at, np.ones(len(at))]), REFERENCE).position
    assert position.max() == pytest.approx(0.099, rel=0.04)
    assert np.sqrt(np.mean(position**2)) == pytest.approx(0.043, rel=0.015)
