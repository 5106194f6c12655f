"""The film under a rig: calibration takes what physics explains, the correction what is left, and nothing else."""

import numpy as np
import pytest
from tests.train.rig.conftest import DOMAIN, measured, systematic

from isocharge.simulate import Circle, ForwardMap, load_sensor, virtual_film
from isocharge.train import CalibrationProblem
from isocharge.train.data.presses import draw_contacts
from isocharge.train.rig.rig_film import calibrated_film

SENSOR, PROBE = load_sensor("four-25um-biaxial"), Circle(1.0)


@pytest.fixture(scope="module")
def problem():
    return CalibrationProblem.of(SENSOR, PROBE)


@pytest.fixture(scope="module")
def truth():
    return ForwardMap.build(*virtual_film(SENSOR, PROBE, 0), 8.1, (0.05, 2.0))


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
    at = draw_contacts(np.random.default_rng(2), DOMAIN, 20)
    step = np.array([0.01, 0.0, 0.0])
    ahead = film.charges(at + step) - film.charges(at - step)
    np.testing.assert_allclose(film.derivatives(at)[:, :, 0], ahead / 0.02, rtol=1e-2, atol=0.5)


def test_a_film_that_physics_explains_is_not_corrected(problem, truth):
    film = calibrated_film(measured(truth, 60, 0.0), problem, DOMAIN)
    assert film.correction.nothing
    assert left(film, truth, 0.0)[1] < 0.5
    assert not film.scattered
    assert film.scatter == pytest.approx(1.0, abs=0.25)


@pytest.mark.slow
def test_a_press_that_was_misread_is_left_out(problem, truth):
    presses = measured(truth, 60, 0.0)
    presses.charge_pC[7, 2] *= 3.0
    film = calibrated_film(presses, problem, DOMAIN)
    assert film.calibration.bad_lines == (9,)
    assert left(film, truth, 0.0)[1] < 0.5
