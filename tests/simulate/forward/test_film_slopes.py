"""Change of the charges by properties and by the temperature of the film, compared with direct solves."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import (
    Circle,
    FilmPrior,
    FilmSlopes,
    ForwardMap,
    Polygon,
    Resolution,
    SideForceMap,
    SolveSettings,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.mechanics.film_temperature import warmed
from isocharge.simulate.solver.friction import friction_force
from kept import kept

PROBE = Circle(1.0)


def drawn_sensor():
    """Return a uniaxial film of 0.8 MPa that expands mostly across the drawn direction."""
    sensor = load_sensor("four-25um-uniaxial")
    return replace(sensor, film=replace(sensor.film, pretension=0.8, expansion=(-5e-6, 1e-4)))


@pytest.fixture(scope="module")
def film_slopes(taut_map) -> FilmSlopes:
    return FilmSlopes.build(replace(taut_map, sensor=drawn_sensor()))


STEPS = {
    "pretension": 0.05,
    "tension_difference": 0.02,
    "tension_shear": 0.02,
    "stiffness_x": 0.02,
    "stiffness_xy": 0.02,
    "oval_x": 0.002,
    "oval_xy": 0.002,
}
"""Steps of the finite differences, in the units of the properties."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in ("tension_shear", "stiffness_x", "oval_xy") else pytest.mark.slow)
        for name in STEPS
    ],
)
def test_derivatives_equal_differences_of_direct_solves(film_slopes, name):
    prior = FilmPrior(film_slopes.film.sensor, PROBE)
    contact = np.array([[3.0, -2.0, 0.5], [-2.5, 2.8, 0.9]])
    charges = []
    for sign in (1.0, -1.0):
        values = prior.described
        values[prior.index(name)] += sign * STEPS[name]
        sensor, probe = prior.film(values)
        solved = [press(sensor.film, probe, (x, y), force) for x, y, force in contact.tolist()]
        charges.append(np.array([touch_charge(sensor, one) for one in solved]))
    expected = (charges[0] - charges[1]) / (2.0 * STEPS[name])
    jacobian = film_slopes.jacobian(contact)[name]
    np.testing.assert_allclose(jacobian, expected, atol=1e-2 * np.abs(expected).max())


@pytest.mark.slow
def test_derivatives_of_an_uneven_film_equal_differences_of_direct_solves():
    """The film has two moduli, an uneven tension and an oval clamp."""
    film = replace(
        drawn_sensor().film, deviator=(0.3, -0.1), young_ratio=1.4, axis=0.3, shear=1100.0, oval=0.01, oval_axis=-0.5
    )
    sensor = replace(drawn_sensor(), film=film)
    forward_map = kept(ForwardMap.build, sensor, PROBE, 4.0, (0.3, 0.6), SolveSettings(resolution=Resolution(4, 8, 4)))
    x, y, force = 2.5, -1.5, 0.5

    def charges(half_difference: float, side_force: tuple[float, float]) -> np.ndarray:
        """Return the charges with a change of (T11 - T22) / 2 in MPa and a side force in N."""
        changed = replace(film, deviator=(0.3 + half_difference, -0.1))
        solved = press(changed, PROBE, (x, y), force, forward_map.settings, side_force=side_force)
        return touch_charge(replace(sensor, film=changed), solved)

    contact = np.array([[x, y, force]])
    t11, t22, _ = FilmSlopes.build(forward_map).tension_jacobian(contact)[0].T
    expected = (charges(0.02, (0.0, 0.0)) - charges(-0.02, (0.0, 0.0))) / 0.04
    np.testing.assert_allclose(t11 - t22, expected, atol=1e-2 * np.abs(expected).max())

    side_force_map = SideForceMap.build(forward_map)
    along_y = (charges(0.0, (0.0, 0.01)) - charges(0.0, (0.0, -0.01))) / 0.02
    np.testing.assert_allclose(side_force_map.jacobian(contact)[0, :, 1], along_y, atol=2e-2 * np.abs(along_y).max())
    holding = friction_force(press(film, PROBE, (x, y), force, forward_map.settings), 1.0)
    (interpolated,) = side_force_map.friction_forces(contact, 1.0)
    np.testing.assert_allclose(interpolated, holding, atol=2e-2 * np.hypot(*holding))


def test_temperature_jacobian_equals_the_difference_of_warmed_films(film_slopes):
    sensor = film_slopes.film.sensor
    charges = []
    for kelvin in (0.05, -0.05):
        warm_sensor = warmed(sensor, kelvin)
        solved = press(warm_sensor.film, PROBE, (3.0, -2.0), 0.5)
        charges.append(touch_charge(warm_sensor, solved))
    warm, cold = charges
    jacobian = film_slopes.temperature_jacobian(np.array([[3.0, -2.0, 0.5]]))[0]
    np.testing.assert_allclose(jacobian, (warm - cold) / 0.1, atol=1e-2 * np.abs(warm - cold).max() / 0.1)
    assert (jacobian > 0.0).all()  # a warm film has less tension, and its charges are larger


def test_film_slopes_of_a_square_probe_raises_a_scene_error(film_slopes):
    with pytest.raises(SceneError, match="properties of a film: expected a circular probe"):
        FilmSlopes.build(replace(film_slopes.film, probe=Polygon.rectangle(2.0, 2.0)))
