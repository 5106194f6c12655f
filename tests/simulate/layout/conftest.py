"""Stress fields for presses within 4 mm, which the tests of layouts share."""

from dataclasses import replace

import pytest

from isocharge.simulate import Circle, load_sensor
from isocharge.simulate.forward.family import NodeCount
from isocharge.simulate.layout import stress_fields

RADIUS = 4.0


@pytest.fixture(scope="session")
def sensor():
    return load_sensor("four-25um-biaxial")


@pytest.fixture(scope="session")
def fields(sensor):
    """Stress fields of two sensors that have the same film, by the name of the sensor."""
    uniaxial = load_sensor("four-25um-uniaxial")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stress_fields, "NODE_COUNT", NodeCount(distances=4, forces=1))  # enough for so small a radius
        solved = stress_fields.solve_fields(sensor, Circle(1.0), 1.0, RADIUS)
    return {sensor.name: solved, uniaxial.name: replace(solved, sensor=uniaxial)}
