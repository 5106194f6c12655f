"""The forward map as splines: against the map."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import ChargeSpline, Circle, ForwardMap, Resolution, SolveSettings, Theory, load_sensor
from isocharge.simulate.numerics.disk import sunflower

RADIUS, FORCES = 4.0, (0.2, 1.0)
MEMBRANE = Theory(stretching=True, bending=False, pretensioned=False)


@pytest.fixture(scope="module")
def forward_map(near_electrodes):
    settings = SolveSettings(theory=MEMBRANE, resolution=Resolution(4, 8, 4))
    return ForwardMap.build(near_electrodes, Circle(1.0), RADIUS, FORCES, settings)


@pytest.fixture(scope="module")
def spline(forward_map):
    return ChargeSpline.of(forward_map, spacing=0.25)


def spread(count: int, within: float = 1.0) -> np.ndarray:
    at = within * RADIUS * sunflower(count)
    force = FORCES[0] * (FORCES[1] / FORCES[0]) ** np.linspace(0.02, 0.98, count)
    return np.stack([at.real, at.imag, force], axis=1)


def test_charges_are_the_maps(forward_map, spline):
    contact = spread(300)
    expected = forward_map.charges(contact)
    assert np.abs(spline.charges(contact) - expected).max() < 6e-4 * np.abs(expected).max()
    assert spline.error < 6e-4
    assert ChargeSpline.of(forward_map, spacing=0.125).error < 0.5 * spline.error


def test_contact_pressure_on_electrodes_is_in(forward_map):
    """d33 adds charges that go with the force itself, not with the amplitude's square."""
    sensor = forward_map.sensor
    pressed = replace(forward_map, sensor=replace(sensor, piezo=replace(sensor.piezo, d33=-30.0)))
    spline, contact = ChargeSpline.of(pressed, spacing=0.25), spread(200)
    expected = pressed.charges(contact)
    assert np.abs(expected - forward_map.charges(contact)).max() > 10.0
    assert np.abs(spline.charges(contact) - expected).max() < 0.01 * np.abs(expected).max()


def test_first_order_is_charges_and_derivatives_and_beyond_the_edge_those_of_the_edge(spline):
    contact = spread(100)
    value, slope, by_force = spline.first_order(contact[:, :2], contact[:, 2])
    np.testing.assert_allclose(value, spline.charges(contact), rtol=1e-13)
    np.testing.assert_array_equal(np.dstack([slope, by_force]), spline.derivatives(contact))
    out, edge = (spline.first_order(np.array([[0.0, y]]), 1.0) for y in (1.2 * RADIUS, RADIUS))
    for beyond, expected in zip(out, edge, strict=True):
        np.testing.assert_allclose(beyond, expected, rtol=1e-13)


def test_of_the_whole_working_area():
    """By default, out to where the probe comes close to the electrodes, forces over a decade."""
    settings = SolveSettings(theory=MEMBRANE, resolution=Resolution(5, 8, 5))
    forward_map = ForwardMap.build(load_sensor("four-25um-uniaxial"), Circle(1.0), 10.0, (0.1, 1.0), settings)
    rng, table = np.random.default_rng(1), ChargeSpline.of(forward_map)
    at = np.concatenate([10.0 * np.sqrt(rng.random(800)), np.full(200, 10.0)]) * np.exp(2j * np.pi * rng.random(1000))
    contact = np.stack([at.real, at.imag, np.exp(rng.uniform(np.log(0.1), 0.0, 1000))], axis=1)
    error = np.abs(table.charges(contact) / forward_map.charges(contact) - 1.0).max(axis=1)
    assert np.median(error) < 3e-5
    assert error.max() < 5e-3
    assert table.error < 5e-4


@pytest.mark.parametrize("radius", [0.0, 5.0, np.nan])
def test_impossible_radius_is_refused(forward_map, radius):
    with pytest.raises(SceneError, match=r"radius: expected up to the forward map's 4 mm"):
        ChargeSpline.of(forward_map, radius)
