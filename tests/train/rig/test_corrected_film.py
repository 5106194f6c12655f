"""Correction of a forward map by measured presses: planted corrections are found, and noise is not corrected."""

from dataclasses import replace

import numpy as np
import pytest
from tests.train.rig.conftest import DOMAIN, measured, systematic

from isocharge.simulate import noise_model
from isocharge.simulate.forward.charge_map import Domain
from isocharge.train.data.presses import draw_contacts
from isocharge.train.rig import correction as correction_module
from isocharge.train.rig.corrected_film import correct_film
from isocharge.train.rig.correction import Residuals, fit_correction


def contacts(rng, count, radius=8.0):
    return draw_contacts(rng, Domain(radius, (0.05, 2.0)), count)


def residuals(seed, count, truth, std=0.004):
    """Log ratios with correlated errors, as a rig that misreads places makes them."""
    rng = np.random.default_rng(seed)
    contact = contacts(rng, count)
    slopes = rng.normal(size=(count, 4, 2))
    covariance = std**2 * (np.eye(4) + 4.0 * slopes @ slopes.transpose(0, 2, 1))
    noise = np.einsum("nef,nf->ne", np.linalg.cholesky(covariance), rng.normal(size=(count, 4)))
    return Residuals(contact, truth(contact) + noise, covariance)


@pytest.mark.parametrize("seed", range(2))
def test_a_planted_correction_comes_back(seed):
    correction = fit_correction(residuals(seed, 200, systematic))
    fresh = contacts(np.random.default_rng(100 + seed), 1000, 7.5)
    left = correction.log_factor(fresh) - systematic(fresh)
    assert np.sqrt(np.mean(left**2)) < 0.25 * np.sqrt(np.mean(systematic(fresh) ** 2))
    assert 4.0 < correction.freedom < 200.0


def test_noise_alone_is_not_corrected():
    """At two standard errors, at most one of six draws may look like a correction; then a tiny one."""
    corrections = [fit_correction(residuals(seed, 60, lambda contact: 0.0 * systematic(contact))) for seed in range(6)]
    real = [correction for correction in corrections if not correction.is_zero]
    assert len(real) <= 1
    fresh = contacts(np.random.default_rng(5), 500)
    assert all(np.sqrt(np.mean(each.log_factor(fresh) ** 2)) < 0.004 for each in real)


def test_presses_in_pieces_ask_for_the_same_correction(monkeypatch):
    presses = residuals(0, 200, systematic)
    whole = fit_correction(presses)
    monkeypatch.setattr(correction_module, "CHUNK_SIZE", 64)
    pieces = fit_correction(presses)
    np.testing.assert_allclose(pieces.coefficients, whole.coefficients, rtol=1e-6, atol=1e-9)
    assert pieces.freedom == pytest.approx(whole.freedom)


def test_beyond_the_presses_it_stays():
    correction = fit_correction(residuals(0, 200, systematic))
    far = np.array([[12.0, 5.0, 1.0], [3.0, 4.0, 50.0]])
    nearest = far.copy()
    nearest[0, :2] *= correction.domain.radius / np.hypot(*far[0, :2])
    nearest[1, 2] = correction.domain.force_range[1]
    np.testing.assert_allclose(correction.log_factor(far), correction.log_factor(nearest), rtol=1e-12)


def left(film, truth, share):
    """Errors of the charges on fresh contacts, percent rms: of the calibrated film, and corrected."""
    contact = draw_contacts(np.random.default_rng(8), DOMAIN, 1000)
    logs = np.log(truth.charges(contact)) + share * systematic(contact)
    errors = (np.log(charge_map.charges(contact)) - logs for charge_map in (film.forward_map, film))
    return [100.0 * float(np.sqrt(np.mean(error**2))) for error in errors]


def test_a_described_film_is_corrected_by_many_presses(truth, caplog):
    """Scatter that noise and rig do not explain is known; presses unlike all others are left out."""
    presses = measured(truth, 300)
    presses.charge_pC[5] *= 4.0
    film = correct_film(presses, truth, DOMAIN, noise_model("reference"))
    assert "line 7: left out, since these presses differ from all others" in caplog.text
    calibrated, corrected = left(film, truth, 1.0)
    assert corrected < 0.3 * calibrated
    assert film.correction_percent(presses.contact) == pytest.approx(calibrated, rel=0.2)
    exact = replace(presses, position_std_mm=presses.position_std_mm / 10, force_std=presses.force_std / 10)
    assert not film.is_scattered
    assert correct_film(exact, truth, DOMAIN, noise_model("reference")).is_scattered
