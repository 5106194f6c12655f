"""The forward map as splines: against the map, and its derivatives against finite differences of the map."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import ChargeSpline, Circle, ForwardMap, Resolution, SolveSettings, Theory, load_sensor
from isocharge.simulate.numerics.disk import sunflower

RADIUS, FORCES = 4e-3, (0.2, 1.0)
MEMBRANE = Theory(stretching=True, bending=False, pretensioned=False)


def near_electrodes(d33: float = 0.0):
    """The electrodes 5 mm from the centre, so that the probe comes to lie on them."""
    sensor = load_sensor("four-25um-uniaxial")
    inward = tuple(
        replace(e, corners=tuple((x - 0.5 * e.centre[0], y - 0.5 * e.centre[1]) for x, y in e.corners))
        for e in sensor.electrodes
    )
    return replace(sensor, electrodes=inward, piezo=replace(sensor.piezo, d33=d33))


@pytest.fixture(scope="module")
def forward_map():
    return ForwardMap.build(
        near_electrodes(), Circle(1e-3), RADIUS, FORCES, SolveSettings(theory=MEMBRANE, resolution=Resolution(4, 8, 4))
    )


@pytest.fixture(scope="module")
def spline(forward_map):
    return ChargeSpline.of(forward_map, spacing=2.5e-4)


def spread(count: int, within: float = 1.0) -> np.ndarray:
    at = within * RADIUS * sunflower(count)
    force = FORCES[0] * (FORCES[1] / FORCES[0]) ** np.linspace(0.02, 0.98, count)
    return np.stack([at.real, at.imag, force], axis=1)


def test_charges_are_the_maps(forward_map, spline):
    contact = spread(300)
    expected = forward_map.forward(*contact.T)
    error = np.abs(spline.charge(contact) - expected).max() / np.abs(expected).max()
    assert error < 6e-4
    assert spline.error < 6e-4
    assert spline.electrodes == 4


def test_a_finer_table_is_nearer(forward_map, spline):
    assert ChargeSpline.of(forward_map, spacing=1.25e-4).error < 0.5 * spline.error


def test_derivatives_are_those_of_the_map(forward_map, spline):
    contact, step = spread(100, within=0.98), 2e-5
    jacobian = spline.jacobian(contact)
    for axis, change in enumerate([[step, 0.0, 0.0], [0.0, step, 0.0]]):
        ahead, behind = forward_map.forward(*(contact + change).T), forward_map.forward(*(contact - change).T)
        expected = (ahead - behind) / (2.0 * step)
        assert np.abs(jacobian[..., axis] - expected).max() < 0.02 * np.abs(expected).max()
    grown = [forward_map.forward(*(contact * [1.0, 1.0, np.exp(s)]).T) for s in (1e-4, -1e-4)]
    np.testing.assert_allclose(jacobian[..., 2], (grown[0] - grown[1]) / 2e-4, rtol=0.01, atol=1e-14)


def test_derivatives_at_the_very_centre(spline):
    centre, beside = (spline.jacobian(np.array([[x, 0.0, 0.5]])) for x in (0.0, 1e-6))
    np.testing.assert_allclose(centre[..., :2], beside[..., :2], atol=0.01 * np.abs(beside[..., :2]).max())


def test_contact_pressure_on_electrodes_is_in(forward_map):
    """d33 adds charges that go with the force itself, not with the amplitude's square."""
    pressed = replace(forward_map, sensor=near_electrodes(d33=-30e-12))
    spline, contact = ChargeSpline.of(pressed, spacing=2.5e-4), spread(200)
    expected = pressed.forward(*contact.T)
    assert np.abs(expected - forward_map.forward(*contact.T)).max() > 10e-12
    assert np.abs(spline.charge(contact) - expected).max() < 0.01 * np.abs(expected).max()


def test_first_order_is_charge_and_jacobian(spline):
    contact = spread(100)
    value, slope, by_force = spline.first_order(contact[:, :2], contact[:, 2])
    np.testing.assert_allclose(value, spline.charge(contact), rtol=1e-13)
    np.testing.assert_array_equal(np.dstack([slope, by_force]), spline.jacobian(contact))


def test_beyond_the_edge_is_the_edge(spline):
    out, edge = (spline.first_order(np.array([[0.0, y]]), 1.0) for y in (1.2 * RADIUS, RADIUS))
    for beyond, expected in zip(out, edge, strict=True):
        np.testing.assert_allclose(beyond, expected, rtol=1e-13)


def test_slopes_are_differences_of_the_splines(spline):
    """Wherever, the edge included: sharper than against the map."""
    contact, step = spread(100, within=0.999), 1e-7
    jacobian = spline.jacobian(contact)
    for axis, aside in enumerate(step * np.eye(3)[:2]):
        difference = (spline.charge(contact + aside) - spline.charge(contact - aside)) / (2.0 * step)
        np.testing.assert_allclose(jacobian[..., axis], difference, atol=1e-5 * np.abs(jacobian[..., :2]).max())
    ratio = np.array([1.0, 1.0, np.exp(1e-4)])
    difference = (spline.charge(contact * ratio) - spline.charge(contact / ratio)) / 2e-4
    np.testing.assert_allclose(jacobian[..., 2], difference, rtol=1e-6)


def test_of_the_whole_working_area():
    """By default, out to where the probe comes close to the electrodes, forces over a decade."""
    forward_map = ForwardMap.build(
        load_sensor("four-25um-uniaxial"),
        Circle(1e-3),
        10e-3,
        (0.1, 1.0),
        SolveSettings(theory=MEMBRANE, resolution=Resolution(5, 8, 5)),
    )
    rng, table = np.random.default_rng(1), ChargeSpline.of(forward_map)
    at, edge = 10e-3 * np.sqrt(rng.random(800)), 10e-3 * np.ones(200)
    at = np.concatenate([at, edge]) * np.exp(2j * np.pi * rng.random(1000))
    contact = np.stack([at.real, at.imag, np.exp(rng.uniform(np.log(0.1), 0.0, 1000))], axis=1)
    error = np.abs(table.charge(contact) / forward_map.forward(*contact.T) - 1.0).max(axis=1)
    assert np.median(error) < 3e-5
    assert error.max() < 5e-3
    assert table.error < 5e-4


@pytest.mark.parametrize("radius", [0.0, -1e-3, 5e-3, np.nan])
def test_impossible_radius_is_refused(forward_map, radius):
    with pytest.raises(SceneError, match=r"radius: expected up to the forward map's 4 mm"):
        ChargeSpline.of(forward_map, radius)


@pytest.mark.parametrize("contact", [[4.1e-3, 0.0, 0.5], [0.0, 0.0, 1.1], [0.0, 0.0, 0.1], [np.nan, 0.0, 0.5]])
def test_outside_is_refused(spline, contact):
    with pytest.raises(SceneError, match=r"outside the table: expected at most 4 mm from the centre and 0\.2 to 1 N"):
        spline.charge(np.array([contact]))
    with pytest.raises(SceneError, match="outside the table"):
        spline.jacobian(np.array([contact]))
