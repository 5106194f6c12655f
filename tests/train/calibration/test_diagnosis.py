"""Tests of the search for mistakes in presses that no film explains, and of the errors that name them."""

import re
from dataclasses import replace

import numpy as np
import pytest
from tests.benchmarks.measured_films import measured_presses
from tests.train.calibration.conftest import rig_presses

from isocharge.common.errors import PressError
from isocharge.train import calibrate
from isocharge.train.calibration.diagnosis import (
    OFFSET_STD,
    SCATTER_STD,
    check_places,
    expected_charges,
    find_mistakes,
    misfit,
)

pytestmark = pytest.mark.usefixtures("never_solved")

EXPLAINED = {
    "columns": (lambda c, q: (c, q[:, [1, 2, 0, 3]]), "columns are swapped: those named A, B, C, D hold B, C, A, D"),
    "rotated": (lambda c, q: (c[:, [1, 0, 2]] * [-1.0, 1.0, 1.0], q), "turned by -?90 degrees"),
    "mirrored": (lambda c, q: (c * [-1.0, 1.0, 1.0], q), "x is mirrored"),
    "millinewtons": (lambda c, q: (c / [1.0, 1.0, 1e-3], q), "forces are in mN, not N"),
    "gain": (lambda c, q: (c, q * [1.0, 1.0, 9.0, 1.0]), r"the gain of C is about \d\.\d times"),
    "nanocoulombs": (lambda c, q: (c, q / 1e3), "charges are in nC, not pC"),
    "microcoulombs": (lambda c, q: (c, q / 1e6), "charges are in uC, not pC"),
}
"""Functions that put a mistake into contacts and charges, and the sentence that names the mistake."""

IMPOSSIBLE = {
    "metres": (lambda c, q: (c / [1e3, 1e3, 1.0], q), "positions are in m, not mm"),
    "micrometres": (lambda c, q: (c * [1e3, 1e3, 1.0], q), "off the film"),
    "dead": (lambda c, q: (c, np.where(np.arange(4) == 2, 0.4, q)), r"electrode 'C' is dead.* 0\.4 pC, 0\.\d+ % of"),
    "negative": (
        lambda c, q: (c, q * [1.0, -1.0, 1.0, 1.0]),
        "electrode 'B': 12 of its 12 charges have the opposite sign",
    ),
    "all negative": (lambda c, q: (c, -q), "all electrodes have the opposite sign.* d31 and d32"),
    "missing": (lambda c, q: (c, np.where(np.arange(4) == 3, np.nan, q)), "electrode 'D': no press has a charge"),
    "inches": (lambda c, q: (c / [25.4, 25.4, 1.0], q), "positions are in inch, not mm"),
    "crosstalk": (
        lambda c, q: (c, np.where(np.arange(4) == 2, 0.03 * q.mean(axis=1, keepdims=True), q)),
        "electrode 'C' is dead: .* 3.* % of those of the others",
    ),
    "too strong": (
        lambda c, q: (c * [1.0, 1.0, 100.0], q),
        "A film would explain them if the forces are in g",
    ),
}


def with_mistake(problem, synthetic, make_mistake):
    """Return twelve presses of a rig, after a function has changed their contacts and charges."""
    presses = rig_presses(problem, synthetic, 12, seed=7)
    return measured_presses(problem, *make_mistake(presses.contact, presses.charge_pC))


@pytest.mark.parametrize("name", EXPLAINED)
def test_mistake_in_the_presses_is_found(problem, synthetic, name):
    """On this layout, rotated axes and swapped columns have the same effect, so that both are named."""
    make_mistake, message = EXPLAINED[name]
    assert find_mistakes(with_mistake(problem, synthetic, lambda *presses: presses), synthetic) == []
    mistakes = find_mistakes(with_mistake(problem, synthetic, make_mistake), synthetic)
    assert re.search(message, "; ".join(mistakes))


def test_mistake_that_explains_the_presses_exactly_is_the_only_one_that_is_named(problem, synthetic):
    """Forces in pounds would explain the presses better than forces in newtons, but not as well as kilograms."""
    contact = rig_presses(problem, synthetic, 12, seed=7).contact
    _, charge, _ = expected_charges(synthetic, contact)
    in_kg = measured_presses(problem, contact / [1.0, 1.0, 9.80665], charge)
    assert find_mistakes(in_kg, synthetic) == ["the forces are in kg, not N"]
    assert not find_mistakes(with_mistake(problem, synthetic, IMPOSSIBLE["negative"][0]), synthetic)  # is no gain


def test_misfit_of_one_usual_offset_and_one_usual_scatter_is_two(problem, synthetic):
    contact = rig_presses(problem, synthetic, 12, seed=7).contact
    charge = expected_charges(synthetic, contact)[0] * np.exp(
        OFFSET_STD + SCATTER_STD * np.array([1.0, -1.0, -1.0, 1.0])
    )
    assert misfit(measured_presses(problem, contact, charge), synthetic) == pytest.approx(2.0)


@pytest.mark.usefixtures("few_hypotheses")
@pytest.mark.parametrize(
    ("unit", "message"),
    [([10.0, 10.0, 1.0], "positions are in cm, not mm"), ([1.0, 1.0, 4.45], "forces are in lbf, not N")],
)
def test_wrong_unit_is_refused_although_the_charges_hardly_differ_from_those_of_a_film(
    problem, synthetic, unit, message
):
    def mistaken(contact, _charge):
        contact = 0.4 * contact + 0.3  # positions near the centre, and moderate forces
        return contact / unit, synthetic.charges(synthetic.values, contact)

    presses = with_mistake(problem, synthetic, mistaken)
    with pytest.raises(PressError, match=message):
        calibrate(presses, problem, start=synthetic, accurate=False)


def test_places_near_the_rim_of_an_oval_film(problem, synthetic):
    """The half axes are 45.9 and 44.1 mm."""
    presses = rig_presses(problem, synthetic, 12, seed=7)
    oval_film = replace(problem.sensor.film, oval=0.02)
    presses.contact[3, :2] = (45.5, 0.0)
    check_places(presses, oval_film)
    presses.contact[3, :2] = (0.0, 44.5)
    with pytest.raises(PressError, match=r"\(0, 44\.5\) mm is off the film, whose radius there is 44\.1 mm"):
        check_places(presses, oval_film)


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_impossible_presses_are_refused_with_the_reason(problem, synthetic, name):
    make_mistake, message = IMPOSSIBLE[name]
    with pytest.raises(PressError, match=message):
        calibrate(with_mistake(problem, synthetic, make_mistake), problem, start=synthetic, accurate=False)
