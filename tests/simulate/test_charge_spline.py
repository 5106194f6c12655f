"""The forward map as splines: against the map, and its derivatives against finite differences of the map."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.errors import SceneError
from isocharge.simulate import ChargeSpline, Circle, ForwardMap, Resolution, Theory, load_sensor
from isocharge.simulate.sampling import sunflower

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
def film():
    return ForwardMap.build(
        near_electrodes(), Circle(1e-3), RADIUS, FORCES, theory=MEMBRANE, resolution=Resolution(4, 8, 4)
    )


@pytest.fixture(scope="module")
def made(film):
    return ChargeSpline.of(film, 2.5e-4)


def spread(count: int, within: float = 1.0) -> np.ndarray:
    at = within * RADIUS * sunflower(count)
    force = FORCES[0] * (FORCES[1] / FORCES[0]) ** np.linspace(0.02, 0.98, count)
    return np.stack([at.real, at.imag, force], axis=1)


def test_charges_are_the_maps(film, made):
    contact = spread(300)
    expected = film.forward(*contact.T)
    error = np.abs(made.charge(contact) - expected).max() / np.abs(expected).max()
    assert error < 6e-4
    assert made.error < 6e-4
    assert made.electrodes == 4


def test_a_finer_table_is_nearer(film, made):
    assert ChargeSpline.of(film, 1.25e-4).error < 0.3 * made.error


def test_derivatives_are_those_of_the_map(film, made):
    contact, step = spread(100, within=0.98), 2e-5
    jacobian = made.jacobian(contact)
    for axis, change in enumerate([[step, 0.0, 0.0], [0.0, step, 0.0]]):
        ahead, behind = film.forward(*(contact + change).T), film.forward(*(contact - change).T)
        expected = (ahead - behind) / (2.0 * step)
        assert np.abs(jacobian[..., axis] - expected).max() < 0.02 * np.abs(expected).max()
    grown = [film.forward(*(contact * [1.0, 1.0, np.exp(s)]).T) for s in (1e-4, -1e-4)]
    np.testing.assert_allclose(jacobian[..., 2], (grown[0] - grown[1]) / 2e-4, rtol=0.01, atol=1e-14)


def test_derivatives_at_the_very_centre(made):
    centre, beside = (made.jacobian(np.array([[x, 0.0, 0.5]])) for x in (0.0, 1e-6))
    np.testing.assert_allclose(centre[..., :2], beside[..., :2], atol=0.01 * np.abs(beside[..., :2]).max())


def test_contact_pressure_on_electrodes_is_in(film):
    """d33 adds charges that go with the force itself, not with the amplitude's square."""
    pressed = replace(film, sensor=near_electrodes(d33=-30e-12))
    made, contact = ChargeSpline.of(pressed, 2.5e-4), spread(200)
    expected = pressed.forward(*contact.T)
    assert np.abs(expected - film.forward(*contact.T)).max() > 10e-12
    assert np.abs(made.charge(contact) - expected).max() < 0.01 * np.abs(expected).max()


@pytest.mark.parametrize("contact", [[4.1e-3, 0.0, 0.5], [0.0, 0.0, 1.1], [0.0, 0.0, 0.1], [np.nan, 0.0, 0.5]])
def test_outside_is_refused(made, contact):
    with pytest.raises(SceneError, match=r"outside the table: expected at most 4 mm and 0\.2 to 1 N"):
        made.charge(np.array([contact]))
    with pytest.raises(SceneError, match="outside the table"):
        made.jacobian(np.array([contact]))
