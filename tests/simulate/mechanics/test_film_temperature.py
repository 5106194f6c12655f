"""Pretension at other temperatures of film and ring, compared with closed forms of plane stress."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.simulate import load_sensor
from isocharge.simulate.mechanics.warming import tension_change, warmed, warming_limits
from solved_charges import with_film

SENSOR = load_sensor("four-25um-biaxial")
YOUNG = 3000.0
POISSON = 0.34


def test_tension_turns_with_the_axis_of_an_orthotropic_film():
    """In the axes of the film, strain = S stress with the compliance S, where nu12 / E1 = poisson / sqrt(E1 E2).

    The strain is the expansion of the ring, which is of aluminium, minus that of the film.
    """
    film = replace(SENSOR.film, expansion=(-5e-6, 100e-6), young_ratio=2.0, axis=np.deg2rad(30.0))
    first = YOUNG * np.sqrt(2.0)
    second = YOUNG / np.sqrt(2.0)
    compliance = np.array([[1.0 / first, -POISSON / YOUNG], [-POISSON / YOUNG, 1.0 / second]])
    along, across = np.linalg.solve(compliance, [2.0 * 23e-6 + 5e-6, 2.0 * 23e-6 - 100e-6])
    rotation = np.array([[np.cos(film.axis), -np.sin(film.axis)], [np.sin(film.axis), np.cos(film.axis)]])
    expected = rotation @ np.diag([along, across]) @ rotation.T
    change = tension_change(film, 1.0, 2.0)
    np.testing.assert_allclose(change, [expected[0, 0], expected[1, 1], expected[0, 1]], rtol=1e-9)


def test_warmed_sensor_of_a_biaxial_film_stays_axisymmetric_and_may_slacken_to_10_MPa_of_compression():
    expanding = with_film(SENSOR, pretension=0.8, expansion=(1e-4, 1e-4))
    slackening_per_K = 1e-4 * YOUNG / (1.0 - POISSON)
    warm = warmed(expanding, 0.5)
    assert warm.film.is_axisymmetric
    assert warm.film.pretension == pytest.approx(0.8 - 0.5 * slackening_per_K)
    assert warming_limits(expanding.film) == pytest.approx((-150.0, 10.8 / slackening_per_K))
    assert warmed(SENSOR, 5.0) == SENSOR
