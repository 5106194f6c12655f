"""Small table of charges, for presses within 4 mm, that the tests of layouts share."""

from dataclasses import replace

import pytest

from isocharge.simulate import Circle, load_sensor
from isocharge.simulate.layout.charge_table import ChargeTable
from kept import kept

RADIUS = 4.0


@pytest.fixture(scope="session")
def sensor():
    return load_sensor("four-25um-biaxial")


@pytest.fixture(scope="session")
def tables(sensor):
    """Tables of two sensors that have the same film, by the name of the sensor."""
    table = kept(ChargeTable.solve, sensor, Circle(1.0), 1.0, RADIUS)
    uniaxial = load_sensor("four-25um-uniaxial")
    return {sensor.name: table, uniaxial.name: replace(table, piezo=(uniaxial.piezo.d31, uniaxial.piezo.d32))}
