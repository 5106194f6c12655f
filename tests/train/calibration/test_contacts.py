"""Contacts of presses that are adjusted to a film with imperfections."""

import numpy as np
import pytest
from tests.benchmarks.measured_films import measured_presses
from tests.train.calibration.conftest import film_of

from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationProblem
from isocharge.train.calibration.contacts import adjust_contacts, best_adjusted_contacts, from_log_contact
from isocharge.train.calibration.press_data import PressData
from isocharge.train.data.presses import draw_contacts


@pytest.fixture(scope="module")
def problem() -> CalibrationProblem:
    return CalibrationProblem.of(load_sensor("four-25um-biaxial"), Circle(1.0))


@pytest.fixture(scope="module")
def uneven_film(problem):
    """The unknowns of a film with an uneven tension."""
    unknowns = np.zeros(problem.charges.layout.film_count)
    unknowns[problem.charges.layout.parameters] = film_of(problem)
    unknowns[problem.charges.layout.modes][:2] = [2.0, -1.5]
    return unknowns


def touch_data(problem, unknowns, seed):
    """Draw the true contacts of 100 touches on a film, and return them with the data without positions and forces."""
    rng = np.random.default_rng(seed)
    contact = draw_contacts(rng, problem.domain, 100)
    charge = problem.noise.add(problem.charges.charges(unknowns, contact), rng)
    presses = measured_presses(problem, np.full_like(contact, np.nan), charge)
    return contact, PressData.from_presses(presses, problem.noise, problem.charges.domain)


@pytest.fixture(scope="module")
def touches(problem, uneven_film):
    """The true contacts of touches on the uneven film, and the data of the touches without positions and forces."""
    return touch_data(problem, uneven_film, seed=3)


def test_residuals_of_unknown_contacts_are_those_of_the_film_at_these_contacts(problem, uneven_film, touches):
    """The search uses a linear approximation of the imperfections, which is inaccurate far from its start."""
    _, data = touches
    adjusted = best_adjusted_contacts(problem.charges, uneven_film, data)
    charge = problem.charges.charges(uneven_film, from_log_contact(adjusted.contact))
    np.testing.assert_allclose(adjusted.residual, data.residual(charge, adjusted.contact), atol=0.15)


@pytest.mark.parametrize("change_MPa", [0.0, -0.35], ids=["same pretension", "lower pretension"])
def test_unknown_contacts_are_found_as_well_as_from_the_true_contacts(problem, uneven_film, change_MPa):
    """From a single start, one touch on the film with the lower pretension ends in a wrong minimum."""
    pressed_film = uneven_film.copy()
    pressed_film[problem.prior.index("pretension")] += change_MPa
    contact, data = touch_data(problem, pressed_film, seed=5)
    true_start = np.column_stack([contact[:, :2], np.log(contact[:, 2])])
    from_truth = adjust_contacts(problem.charges, uneven_film, data, true_start)
    adjusted = best_adjusted_contacts(problem.charges, uneven_film, data)
    assert np.all(adjusted.chi2 < from_truth.chi2 + 0.3)


def test_measured_contacts_need_only_one_search(problem, uneven_film, touches):
    """The search begins at the measured contact, which is so close that no further start is tried."""
    contact, data = touches
    presses = measured_presses(problem, contact, data.charge)
    measured = PressData.from_presses(presses, problem.noise, problem.charges.domain)
    start = np.column_stack([contact[:, :2], np.log(contact[:, 2])])
    from_measured = adjust_contacts(problem.charges, uneven_film, measured, start)
    best = best_adjusted_contacts(problem.charges, uneven_film, measured)
    np.testing.assert_array_equal(best.contact, from_measured.contact)
