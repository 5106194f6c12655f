"""Triangulation with circular contours and with the contours of simulated presses, and its error messages."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from drawn_contacts import draw_contacts
from function_map import round_map
from isocharge.common.errors import ChargeError, SceneError
from isocharge.simulate import (
    ChargeSpline,
    Domain,
    Triangulation,
    load_sensor,
    noise_model,
)
from whole_films import part_of

DOMAIN = Domain(8.0, (0.2, 2.0))
CENTRES = np.array([electrode.centre for electrode in load_sensor("four-25um-biaxial").electrodes])


def errors(fix, contact):
    """Return the distances between the found positions and the true positions, mm."""
    return np.hypot(*(fix.contact - contact)[fix.found, :2].T)


def test_triangulation_agrees_with_least_squares_of_scipy():
    """The four charges are not those of any press. The result is then the minimum that a general solver finds."""
    charge_map = round_map(CENTRES, DOMAIN)
    charge = charge_map.charges(np.array([[2.0, -1.0, 0.8]])) * (1.0 + 0.01 * np.array([1, 1, -1, -1.5]))
    fix = Triangulation(charge_map).locate(charge)

    def contour_distances(unknown):
        contact = np.array([[*unknown[:2], np.exp(unknown[2])]])
        predicted, derivatives = charge_map.linearised(contact)
        return ((predicted - charge) / np.linalg.norm(derivatives[..., :2], axis=2))[0]

    best = least_squares(contour_distances, [2.0, -1.0, np.log(0.8)], xtol=1e-12, ftol=1e-12)
    np.testing.assert_allclose(fix.contact[0, :2], best.x[:2], atol=5e-3)
    assert fix.spread[0] == pytest.approx(np.sqrt(0.5 * best.cost), rel=1e-2)


@pytest.fixture(scope="module")
def solved(three_map):
    return part_of(three_map, load_sensor("three-25um-biaxial"), 6.0, (1.0, 1.0))


@pytest.fixture(scope="module")
def on_film(solved):
    return Triangulation(ChargeSpline.of(solved, spacing=0.3))


def test_round_trip_of_presses_with_a_known_force(solved, on_film):
    """Without noise, the median error is below 1 um, and with noise it is 0.02 to 0.2 mm."""
    contact = draw_contacts(5, 300, 6.0, (1.0, 1.0))
    charge = solved.charges(contact)
    fix = on_film.locate(charge)
    assert fix.found.mean() > 0.98
    assert np.median(errors(fix, contact)) < 1e-3
    assert errors(fix, contact).max() < 0.05
    noisy = on_film.locate(noise_model("reference").add(charge, np.random.default_rng(7)))
    assert 0.02 < np.median(errors(noisy, contact)) < 0.2
    assert np.isnan(noisy.contact[~noisy.found]).all()


# Charges without a unique position


def test_contours_that_do_not_meet_have_no_contact(solved, on_film):
    charge = solved.charges(np.array([[1.0, 1.0, 1.0]]))
    fix = on_film.locate(np.concatenate([[[9e3, 9e3, 9e3], [1.0, 800.0, 800.0]], 1.3 * charge]))
    assert not fix.found.any()
    assert np.isnan(fix.contact).all()
    assert (fix.spread > 1.0).all()


def test_contours_that_meet_twice_have_no_contact():
    """If all electrodes lie on a line, the circles also meet at the mirror image of the position."""
    charge_map = round_map(np.array([[-9.0, 0.0], [0.0, 0.0], [9.0, 0.0]]), DOMAIN)
    fix = Triangulation(charge_map).locate(charge_map.charges(np.array([[1.0, 3.0, 1.0]])))
    assert np.isnan(fix.contact).all()
    assert fix.spread[0] < 1e-3


def test_triangulation_with_two_electrodes_raises_an_error():
    with pytest.raises(SceneError, match="at least three electrodes, got 2"):
        Triangulation(round_map(CENTRES[:2], DOMAIN))


@pytest.mark.parametrize("charge", [np.ones(3), np.ones((2, 4)), [[1.0, np.nan, 1.0]]])
def test_wrong_charges_raise_a_charge_error(charge):
    with pytest.raises(ChargeError, match=r"expected finite charges of shape \(n, 3\) for .*, got shape"):
        Triangulation(round_map(CENTRES[:3], DOMAIN)).locate(charge)
