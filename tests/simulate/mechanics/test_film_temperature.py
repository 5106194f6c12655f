"""Pretension at other temperatures of film and ring, compared with closed forms of plane stress."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.simulate import load_sensor
from isocharge.simulate.mechanics.film_temperature import tension_change, warmed

YOUNG = 3000.0
POISSON = 0.34


def film_with(**changes):
    """Return the film of a built-in sensor with other attributes."""
    return replace(load_sensor("four-25um-biaxial").film, **{"pretension": 0.8, **changes})


def test_a_warm_film_loses_tension_and_a_warm_ring_adds_tension():
    film = film_with(expansion=(1e-4, 1e-4))
    per_kelvin = 1e-4 * YOUNG / (1.0 - POISSON)
    np.testing.assert_allclose(tension_change(film, 1.0, 0.0), [-per_kelvin, -per_kelvin, 0.0], rtol=1e-12)
    by_ring = 23e-6 * YOUNG / (1.0 - POISSON)
    np.testing.assert_allclose(tension_change(film, 0.0, 1.0), [by_ring, by_ring, 0.0], rtol=1e-12)


def test_tension_of_a_drawn_film_on_aluminium_changes_mostly_across_the_drawn_direction():
    film = film_with(expansion=(-5e-6, 100e-6))
    change = tension_change(film, 1.0, 1.0)
    plane = YOUNG / (1.0 - POISSON**2)
    strain = 23e-6 - np.array([-5e-6, 100e-6])
    expected = [plane * (strain[0] + POISSON * strain[1]), plane * (strain[1] + POISSON * strain[0]), 0.0]
    np.testing.assert_allclose(change, expected, rtol=1e-12)
    assert abs(change[0]) < 0.02
    assert change[1] == pytest.approx(-0.23, abs=0.01)


def test_tension_turns_with_the_axis_of_an_orthotropic_film():
    """Return the compliance S in the axes of the film (strain = S stress), where nu12 / E1 = poisson / sqrt(E1 E2)."""
    film = film_with(expansion=(-5e-6, 100e-6), young_ratio=2.0, axis=np.deg2rad(30.0))
    first = YOUNG * np.sqrt(2.0)
    second = YOUNG / np.sqrt(2.0)
    compliance = np.array([[1.0 / first, -POISSON / YOUNG], [-POISSON / YOUNG, 1.0 / second]])
    along, across = np.linalg.solve(compliance, [5e-6, -100e-6])
    rotation = np.array([[np.cos(film.axis), -np.sin(film.axis)], [np.sin(film.axis), np.cos(film.axis)]])
    expected = rotation @ np.diag([along, across]) @ rotation.T
    change = tension_change(film, 1.0, 0.0)
    np.testing.assert_allclose(change, [expected[0, 0], expected[1, 1], expected[0, 1]], rtol=1e-9)


def test_warmed_sensor_of_a_biaxial_film_stays_axisymmetric():
    sensor = load_sensor("four-25um-biaxial")
    sensor = replace(sensor, film=film_with(expansion=(1e-4, 1e-4)))
    warm = warmed(sensor, 0.5)
    assert warm.film.is_axisymmetric
    assert warm.film.pretension == pytest.approx(0.8 - 0.5e-4 * YOUNG / (1.0 - POISSON))
    assert warmed(load_sensor("four-25um-biaxial"), 5.0) == load_sensor("four-25um-biaxial")
