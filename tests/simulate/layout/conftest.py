"""Stress fields for presses within 4 mm, which the tests of layouts share."""

from dataclasses import replace

import pytest

from isocharge.simulate import Circle, load_sensor
from isocharge.simulate.layout.stress_fields import solve_fields
from kept import kept

RADIUS = 4.0


@pytest.fixture(scope="session")
def sensor():
    return load_sensor("four-25um-biaxial")


@pytest.fixture(scope="session")
def fields(sensor):
    """Stress fields of two sensors that have the same film, by the name of the sensor."""
    uniaxial = load_sensor("four-25um-uniaxial")
    solved = kept(solve_fields, sensor, Circle(1.0), 1.0, RADIUS)
    return {sensor.name: solved, uniaxial.name: replace(solved, sensor=uniaxial)}
