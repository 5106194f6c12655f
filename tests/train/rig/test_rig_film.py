"""The film under a rig: calibration takes what physics explains, the correction what is left, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from tests.train.rig.conftest import DOMAIN, measured, systematic

from isocharge.simulate import noise_model
from isocharge.train.data.presses import draw_contacts
from isocharge.train.rig.rig_film import calibrated_film, corrected_film


def left(film, truth, share):
    """Errors of the charges on fresh contacts, percent rms: of the calibrated film, and corrected."""
    contact = draw_contacts(np.random.default_rng(8), DOMAIN, 1000)
    logs = np.log(truth.charges(contact)) + share * systematic(contact)
    errors = (np.log(charge_map.charges(contact)) - logs for charge_map in (film.forward_map, film))
    return [100.0 * float(np.sqrt(np.mean(error**2))) for error in errors]


@pytest.mark.slow
def test_what_calibration_cannot_take_the_correction_does(problem, truth):
    film = calibrated_film(measured(truth, 120), problem, DOMAIN)
    calibrated, corrected = left(film, truth, 1.0)
    assert calibrated > 1.0
    assert corrected < 0.5 * calibrated


def test_a_film_that_physics_explains_is_not_corrected(problem, truth, caplog):
    """Nor by a press that was misread: it is left out."""
    presses = measured(truth, 50, 0.0)
    presses.charge_pC[7, 2] *= 3.0
    film = calibrated_film(presses, problem, DOMAIN)
    assert film.calibration.bad_lines == (9,)
    assert "line 9: left out" in caplog.text
    assert film.correction.nothing
    assert left(film, truth, 0.0)[1] < 0.5
    assert not film.scattered
    assert film.scatter == pytest.approx(1.0, abs=0.3)


def test_a_described_film_is_corrected_by_many_presses(truth, caplog):
    """Scatter that noise and rig do not explain is known; presses unlike all others are left out."""
    presses = measured(truth, 300)
    presses.charge_pC[5] *= 4.0
    film = corrected_film(presses, truth, DOMAIN, noise_model("reference"))
    assert "1 presses are left out, which are nothing like the others (lines [7])" in caplog.text
    calibrated, corrected = left(film, truth, 1.0)
    assert corrected < 0.3 * calibrated
    assert film.correction_percent(presses.contact) == pytest.approx(calibrated, rel=0.2)
    at = draw_contacts(np.random.default_rng(2), DOMAIN, 20)
    step = np.array([0.01, 0.0, 0.0])
    ahead = film.charges(at + step) - film.charges(at - step)
    np.testing.assert_allclose(film.derivatives(at)[:, :, 0], ahead / 0.02, rtol=1e-2, atol=0.5)
    exact = replace(presses, position_std_mm=presses.position_std_mm / 10, force_std=presses.force_std / 10)
    assert not film.scattered
    assert corrected_film(exact, truth, DOMAIN, noise_model("reference")).scattered
