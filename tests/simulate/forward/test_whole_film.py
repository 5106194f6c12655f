"""The coarse forward map of the whole film, compared with direct solves on a finer mesh."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, Domain, Resolution, SolveSettings, load_sensor, press
from isocharge.simulate.forward import whole_film
from isocharge.simulate.forward.family import check_family
from isocharge.simulate.forward.whole_film import COARSE_ERROR, COARSE_RESOLUTION, outermost_distance, whole_film_map
from isocharge.simulate.solver.load_case import check_press
from solved_charges import relative_error, solved_charge, with_film
from whole_films import whole_film_map_solved_once

PROBE = Circle(1.0)
SENSOR = load_sensor("four-25um-biaxial")
FINER = SolveSettings(resolution=Resolution(order=5, around=8, rings=6, rim=2))
PRESSES = [
    (11.0, 1.2, 0.005),
    (24.0, 0.08, 0.005),
    (29.0, 2.0, 0.01),
    (36.0, 0.3, COARSE_ERROR),
    (42.5, 1.2, COARSE_ERROR),
]
"""Distance from the centre, mm, force, N, and largest relative error of a charge."""


@pytest.mark.parametrize("pretension", [0.0, pytest.param(0.8, marks=pytest.mark.slow)])
def test_coarse_map_agrees_with_direct_solves_up_to_the_clamp(pretension):
    sensor = with_film(SENSOR, pretension=pretension)
    coarse = whole_film_map_solved_once(sensor, PROBE, (0.05, 2.0))
    for distance, force, error in PRESSES:
        at = (distance * np.cos(0.7), distance * np.sin(0.7))
        direct = solved_charge(sensor, PROBE, at, force, FINER)
        np.testing.assert_allclose(coarse.charges(np.array([[*at, force]]))[0], direct, rtol=error)


def test_coarse_map_of_a_taut_film_is_accurate_over_a_wide_range_of_forces(monkeypatch):
    """Between 0.005 and 5 N, the charges of this film change from the square of the force to its power of 2/3.

    To save time, the map ends at 11 mm.
    """
    monkeypatch.setattr(whole_film, "outermost_distance", lambda *_: 11.0)
    monkeypatch.setattr(whole_film, "COARSE_DISTANCES", 3)
    sensor = with_film(SENSOR, pretension=2.0)
    coarse = whole_film_map(sensor, PROBE, (0.005, 5.0))
    for contact in ((9.0, -5.0, 0.026), (-6.0, 4.0, 0.015)):
        direct = solved_charge(sensor, PROBE, contact[:2], contact[2], FINER)
        assert relative_error(coarse.charges(np.array([contact]))[0], direct) < 0.004


@pytest.mark.parametrize("film_radius", [12.0, 45.0])
@pytest.mark.parametrize("probe_radius", [0.15, 0.5, 0.9])
def test_outermost_press_of_a_small_probe_can_be_meshed(probe_radius, film_radius):
    film = replace(SENSOR.film, radius=film_radius, pretension=1.0)
    probe = Circle(probe_radius)
    solved = press(
        film, probe, (outermost_distance(film, probe), 0.0), 0.1, SolveSettings(resolution=COARSE_RESOLUTION)
    )
    assert solved.status == "converged"


@pytest.mark.parametrize("changes", [{"oval": 0.05}, {"oval": 0.05, "oval_axis": 1.6}, {"oval": -0.05}])
def test_presses_on_an_oval_film_stay_inside_the_shorter_axis(changes):
    film = replace(SENSOR.film, **changes)
    outermost = outermost_distance(film, PROBE)
    assert outermost == pytest.approx(0.95 * 45.0 - 2.2)
    check_family(film, PROBE, Domain(outermost, (0.1, 1.0)))
    for angle in np.linspace(0.0, np.pi, 9):
        check_press(film, PROBE, (outermost * np.cos(angle), outermost * np.sin(angle)), 1.0)
    with pytest.raises(SceneError, match="probe off the film"):
        check_family(film, PROBE, Domain(43.0, (0.1, 1.0)))
