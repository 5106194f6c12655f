"""Tests of the recognition of a closed back behind the film, with directly solved presses."""

from dataclasses import replace

import numpy as np
import pytest
from tests.benchmarks.measured_films import measured_presses

from isocharge.common.errors import PressError
from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, load_sensor, press, touch_charge
from isocharge.train import CalibrationProblem, calibrate
from isocharge.train.calibration.closed_back import has_closed_back
from isocharge.train.data.presses import draw_contacts
from kept import kept

CAVITY = 15.0 * np.pi * 45.0**2
"""Volume of a cavity of 15 mm behind the film, mm^3."""


def presses_with(
    problem: CalibrationProblem, back_volume: float | None, pretension: float, count: int = 8
) -> MeasuredPresses:
    """Return noisy presses of a film of this pretension (MPa) and back volume (mm^3)."""
    rng = np.random.default_rng(7)
    contact = draw_contacts(rng, problem.domain.within(7.5), count)
    film = replace(problem.sensor.film, pretension=pretension, back_volume=back_volume)
    sensor = replace(problem.sensor, film=film)
    exact_charge = kept(solved_charges, sensor, contact.tolist())
    return measured_presses(problem, contact, problem.noise.add(exact_charge, rng))


def solved_charges(sensor, contacts):
    """Solve each press (x, y, F), mm and N, and return the charges, shape (n, n_electrode), pC."""
    return np.array([touch_charge(sensor, press(sensor.film, Circle(1.0), (x, y), force)) for x, y, force in contacts])


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("pretension", [0.3])
def test_closed_back_is_recognised(layout, pretension):
    assert has_closed_back(presses_with(layout, CAVITY, pretension, count=5), layout.charges)


@pytest.mark.first_cases(2)
@pytest.mark.parametrize("pretension", [0.0, 1.6])
def test_vented_back_is_not_taken_for_a_closed_back(layout, pretension):
    assert not has_closed_back(presses_with(layout, None, pretension), layout.charges)


@pytest.mark.slow
def test_calibration_names_a_closed_back(problem):
    result = calibrate(presses_with(problem, CAVITY, 1.1), problem)
    assert any("vent the back and press again" in sentence for sentence in result.cautions)


@pytest.mark.slow
def test_calibration_of_a_uniaxial_film_with_a_closed_back_is_refused():
    problem = CalibrationProblem.of(load_sensor("four-25um-uniaxial"), Circle(1.0))
    with pytest.raises(PressError, match="air is trapped behind the film; vent the back and press again"):
        calibrate(presses_with(problem, CAVITY, 1.1), problem)
