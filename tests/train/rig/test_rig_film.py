"""The film under a rig: calibration takes what physics explains, the correction what is left, and nothing else."""

import numpy as np
import pytest

from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, ForwardMap, load_sensor, virtual_film
from isocharge.train import films_for
from isocharge.train.calibration.film_charges import charges_of
from isocharge.train.data.domain import ContactDomain
from isocharge.train.films.film_presses import draw_contacts
from isocharge.train.rig.rig_film import calibrated_film

DOMAIN = ContactDomain(7.5, (0.06, 1.9))
SENSOR, PROBE = load_sensor("four-25um-biaxial"), Circle(1e-3)


@pytest.fixture(scope="module")
def films():
    return films_for(SENSOR, PROBE)


@pytest.fixture(scope="module")
def truth():
    return ForwardMap.build(*virtual_film(SENSOR, PROBE, 0), 8.1e-3, (0.05, 2.0))


def systematic(contact):
    x, y, _ = contact.T
    return 0.03 * np.column_stack([np.sin(x / 4 + k) * np.cos(y / 5) for k in range(4)])


def measured(truth, count, share):
    rng = np.random.default_rng(3)
    contact = draw_contacts(rng, DOMAIN, count)
    charge = charges_of(truth, contact) * np.exp(share * systematic(contact))
    charge += np.hypot(1.0, 0.002 * charge) * rng.standard_normal(charge.shape)
    contact[:, :2] += 0.05 * rng.standard_normal((count, 2))
    contact[:, 2] *= np.exp(0.005 * rng.standard_normal(count))
    stds = np.full(count, 0.05), np.full(count, 0.005)
    return MeasuredPresses(contact, charge, *stds, SENSOR.electrode_names, tuple(range(2, count + 2)))


def left(film, truth, share):
    """Errors of the charges on fresh contacts, percent rms: of the calibrated film, and corrected."""
    contact = draw_contacts(np.random.default_rng(8), DOMAIN, 1000)
    logs = np.log(charges_of(truth, contact)) + share * systematic(contact)
    errors = (np.log(charge) - logs for charge in (charges_of(film.forward_map, contact), film.charge_pC(contact)))
    return [100.0 * float(np.sqrt(np.mean(error**2))) for error in errors]


@pytest.mark.slow
def test_what_calibration_cannot_take_the_correction_does(films, truth):
    film = calibrated_film(measured(truth, 120, 1.0), films, DOMAIN, lambda _: None)
    calibrated, corrected = left(film, truth, 1.0)
    assert calibrated > 1.0
    assert corrected < 0.5 * calibrated


def test_a_film_that_physics_explains_is_not_corrected(films, truth):
    film = calibrated_film(measured(truth, 60, 0.0), films, DOMAIN, lambda _: None)
    assert film.correction.nothing
    assert left(film, truth, 0.0)[1] < 0.5
    assert not film.scattered
    assert film.scatter == pytest.approx(1.0, abs=0.25)


@pytest.mark.slow
def test_a_press_that_was_misread_is_left_out(films, truth):
    presses = measured(truth, 60, 0.0)
    presses.charge_pC[7, 2] *= 3.0
    film = calibrated_film(presses, films, DOMAIN, lambda _: None)
    assert film.calibration.bad_lines == (9,)
    assert left(film, truth, 0.0)[1] < 0.5
