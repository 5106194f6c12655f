"""Fixtures for the tests of forward maps."""

import pytest
from tests.simulate.conftest import COARSE

from isocharge.simulate import (
    ChargeSpline,
    Circle,
    ForwardMap,
    Sensor,
    load_sensor,
)
from kept import kept
from solved_charges import with_squares


@pytest.fixture(scope="session")
def near_electrodes() -> Sensor:
    """A uniaxial sensor with electrodes 5 mm from the centre, so that the probe can lie on them."""
    return with_squares(load_sensor("four-25um-uniaxial"), (5.0, 0.0), (0.0, 5.0), (-5.0, 0.0), (0.0, -5.0))


@pytest.fixture(scope="session")
def near_map(near_electrodes: Sensor) -> ForwardMap:
    """A forward map of a membrane with few solves. The probe can lie on the electrodes."""
    return kept(ForwardMap.build, near_electrodes, Circle(1.0), 5.0, (0.3, 1.0), COARSE)


@pytest.fixture(scope="session")
def near_spline(near_map: ForwardMap) -> ChargeSpline:
    return kept(ChargeSpline.of, near_map, spacing=0.25)
