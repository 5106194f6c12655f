"""Scenes that the tests of layouts share, small ones: presses within 4 mm."""

from dataclasses import replace

import pytest

from isocharge.simulate import Circle, load_sensor
from isocharge.simulate.layout.scene import DesignScene
from isocharge.simulate.layout.square_charges import solve_square_charges

RADIUS = 4e-3


@pytest.fixture(scope="session")
def sensor():
    return load_sensor("four-25um-biaxial")


@pytest.fixture(scope="session")
def scene(sensor):
    return DesignScene.of(sensor.film, Circle(1e-3), 1.0, RADIUS)


@pytest.fixture(scope="session")
def charges(sensor, scene):
    return solve_square_charges(sensor, scene)


@pytest.fixture(scope="session")
def uniaxial(scene):
    return solve_square_charges(load_sensor("four-25um-uniaxial"), scene)


@pytest.fixture(scope="session")
def edge(scene):
    return solve_square_charges(replace(load_sensor("four-25um-uniaxial"), readout="edge"), scene)
