"""Tests of the correction of a forward map by measured presses: errors are corrected, and noise is not."""

from dataclasses import replace

import numpy as np
import pytest
from tests.train.rig.conftest import DOMAIN, measured_presses, systematic_error

from isocharge.common.contact_domain import Domain
from isocharge.common.statistics import rms
from isocharge.simulate import noise_model
from isocharge.train.data.presses import draw_contacts
from isocharge.train.rig import correction as correction_module
from isocharge.train.rig.corrected_film import correct_film
from isocharge.train.rig.correction import Residuals, fit_correction

REFERENCE = noise_model("reference")


def draw(rng, count, radius=8.0):
    """Draw contacts with a distance of up to `radius` from the centre, mm, and forces from 0.05 to 2 N."""
    return draw_contacts(rng, Domain(radius, (0.05, 2.0)), count)


def draw_residuals(seed, count, log_error, std=0.004):
    """Draw logarithms of measured over simulated charges, with correlated noise as of wrong positions.

    Args:
        seed: Seed of contacts and noise.
        count: Number of presses.
        log_error: Function from contacts to the logarithms without noise, shape (n, 4).
        std: Standard deviation of the part of the noise that is not correlated.
    """
    rng = np.random.default_rng(seed)
    contact = draw(rng, count)
    position_slopes = rng.normal(size=(count, 4, 2))
    covariance = std**2 * (np.eye(4) + 4.0 * position_slopes @ position_slopes.transpose(0, 2, 1))
    noise = np.einsum("nef,nf->ne", np.linalg.cholesky(covariance), rng.normal(size=(count, 4)))
    return Residuals(contact, log_error(contact) + noise, covariance)


@pytest.mark.parametrize("seed", range(2))
def test_systematic_error_is_corrected(seed):
    correction = fit_correction(draw_residuals(seed, 200, systematic_error))
    fresh = draw(np.random.default_rng(100 + seed), 1000, 7.5)
    remaining_error = correction.log_factor(fresh) - systematic_error(fresh)
    assert rms(remaining_error) < 0.25 * rms(systematic_error(fresh))
    assert 4.0 < correction.effective_count < 200.0


def test_noise_alone_is_not_corrected():
    """A correction counts as real from two standard errors on, so one of six draws may have a small correction."""

    def no_error(contact):
        return np.zeros((len(contact), 4))

    corrections = [fit_correction(draw_residuals(seed, 60, no_error)) for seed in range(6)]
    nonzero_corrections = [correction for correction in corrections if not correction.is_zero]
    assert len(nonzero_corrections) <= 1
    fresh = draw(np.random.default_rng(5), 500)
    assert all(rms(correction.log_factor(fresh)) < 0.004 for correction in nonzero_corrections)


def test_correction_does_not_depend_on_the_size_of_the_chunks(monkeypatch):
    residuals = draw_residuals(0, 200, systematic_error)
    expected = fit_correction(residuals)
    monkeypatch.setattr(correction_module, "CHUNK_SIZE", 64)
    correction = fit_correction(residuals)
    np.testing.assert_allclose(correction.coefficients, expected.coefficients, rtol=1e-6, atol=1e-9)
    assert correction.effective_count == pytest.approx(expected.effective_count)


def test_correction_outside_the_domain_is_that_of_the_nearest_contact():
    correction = fit_correction(draw_residuals(0, 200, systematic_error))
    outside = np.array([[12.0, 5.0, 1.0], [3.0, 4.0, 50.0]])
    nearest = outside.copy()
    nearest[0, :2] *= correction.domain.radius / np.hypot(12.0, 5.0)
    nearest[1, 2] = correction.domain.force_range[1]
    np.testing.assert_allclose(correction.log_factor(outside), correction.log_factor(nearest), rtol=1e-12)


def test_described_film_is_corrected_and_a_different_press_is_left_out(truth, caplog):
    presses = measured_presses(truth, 300)
    presses.charge_pC[5] *= 4.0
    film = correct_film(presses, truth, DOMAIN, REFERENCE)
    assert "line 7: left out, since these presses differ from all others" in caplog.text

    fresh = draw_contacts(np.random.default_rng(8), DOMAIN, 1000)
    true_log_charge = np.log(truth.charges(fresh)) + systematic_error(fresh)
    error_before_percent = 100.0 * rms(np.log(film.forward_map.charges(fresh)) - true_log_charge)
    error_after_percent = 100.0 * rms(np.log(film.charges(fresh)) - true_log_charge)
    assert error_after_percent < 0.3 * error_before_percent
    assert film.correction_percent(presses.contact) == pytest.approx(error_before_percent, rel=0.2)


def test_scatter_is_reported_if_the_stated_errors_of_the_rig_are_too_small(truth):
    presses = measured_presses(truth, 300)
    assert not correct_film(presses, truth, DOMAIN, REFERENCE).is_scattered
    too_exact = replace(presses, position_std_mm=presses.position_std_mm / 10, force_std=presses.force_std / 10)
    assert correct_film(too_exact, truth, DOMAIN, REFERENCE).is_scattered
