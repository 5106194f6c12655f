"""A table of charges that the tests of layouts share, a small one: presses within 4 mm."""

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
    sensors = (sensor, load_sensor("four-25um-uniaxial"))
    return {s.name: kept(ChargeTable.solve, s, Circle(1.0), 1.0, RADIUS) for s in sensors}
