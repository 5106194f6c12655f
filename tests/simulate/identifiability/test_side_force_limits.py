"""Limits of contacts with an unknown side force, compared with the Fisher information of direct solves."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.simulate import (
    Circle,
    Domain,
    Electrode,
    ForwardMap,
    Sensor,
    load_sensor,
    noise_model,
)
from isocharge.simulate.forward.derivative_maps import SideForceMap
from isocharge.simulate.identifiability.identification import Identification
from isocharge.simulate.identifiability.side_force_limits import side_force_limits

REFERENCE = noise_model("reference")
PROBE = Circle(1.0)


def sensor_with_electrodes(count: int) -> Sensor:
    """Return a film of 0.8 MPa whose electrodes have alternating distances of 10 and 14 mm from the centre."""
    sensor = load_sensor("four-25um-biaxial")
    distance = np.where(np.arange(count) % 2, 14.0, 10.0)
    centres = distance * np.exp(2j * np.pi * np.arange(count) / count)
    electrodes = tuple(
        Electrode.of_square("ABCDEF"[number], (centre.real, centre.imag), 3.0) for number, centre in enumerate(centres)
    )
    return replace(sensor, film=replace(sensor.film, pretension=0.8), electrodes=electrodes)


@pytest.fixture(scope="module")
def forward_map(taut_map) -> ForwardMap:
    """Forward map of the sensor with six electrodes, up to 6 mm and from 0.2 to 1 N."""
    family = replace(taut_map.family, domain=Domain(6.0, (0.2, 1.0)))
    return replace(taut_map, sensor=sensor_with_electrodes(6), family=family)


@pytest.fixture(scope="module")
def side_force_map_with_six_electrodes(side_force_map) -> SideForceMap:
    """The solved side forces, read by the six electrodes: the solution does not depend on the electrodes."""
    sensor = sensor_with_electrodes(6)
    film = replace(side_force_map.film, sensor=sensor)
    return replace(side_force_map, film=film, fields=replace(side_force_map.fields, sensor=sensor))


@pytest.fixture(scope="module")
def identification(forward_map, side_force_map_with_six_electrodes) -> Identification:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SideForceMap, "build", lambda *_, **__: side_force_map_with_six_electrodes)
        return Identification.of(forward_map, REFERENCE)


def test_identify_reports_the_side_force_with_six_electrodes(identification):
    rows = identification.to_dict()["limits_with_side_force"]
    contact_rows = identification.to_dict()["limits_in_working_area"]
    assert [row["force_N"] for row in rows] == [0.2, 1.0]
    for row, contact_row in zip(rows, contact_rows, strict=True):
        assert row["position_median_mm"] > contact_row["position_median_mm"]
        assert row["side_force_is_estimable"] == (row["side_force_median_percent"] <= 10.0)
    assert "The side force of the probe can" in identification.summary


def test_identify_with_five_electrodes_omits_the_side_force(forward_map, identification):
    five = replace(forward_map, sensor=sensor_with_electrodes(5))
    limits = side_force_limits(five, five, REFERENCE, [0.2, 1.0], 6.0)
    assert limits == ()
    without_side_force = replace(identification, side_force=limits)
    assert without_side_force.to_dict()["limits_with_side_force"] == []
    assert "side force" not in without_side_force.summary
