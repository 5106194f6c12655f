"""Side forces and friction, compared with a closed form, a reciprocity and the symmetry of the film."""

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, Polygon, Resolution, SolveSettings, Theory, load_sensor, press
from isocharge.simulate.solver.sensitivity import friction_force, holding_force
from solved_charges import relative_error, solved_charge, with_film

PROBE = Circle(1.0)
FULL = SolveSettings(theory=Theory(bending=True), resolution=Resolution(4, 8, 5))


def taut(pretension: float):
    """Return the biaxial sensor with four electrodes and a pretension, MPa."""
    return with_film(load_sensor("four-25um-biaxial"), pretension=pretension)


def test_a_side_force_on_a_film_with_pretension_gives_the_charges_of_a_clamped_disk_in_its_plane():
    """The stress is that of Muskhelishvili's potential for a force in the plane at the centre of a clamped disk.

    The potential is phi' = -C (1 / z + 2 z / (kappa a^2)), and s11 + s22 = 4 Re phi'. This is a harmonic function. Its
    mean over a square is its value at the centre of the square, up to terms of the fourth derivative.
    """
    sensor = taut(1.0)
    film = sensor.film
    side_force = 1e-5
    pulled = solved_charge(sensor, Circle(0.5), (0.0, 0.0), 1e-5, FULL, side_force=(side_force, 0.0))
    pushed = solved_charge(sensor, Circle(0.5), (0.0, 0.0), 1e-5, FULL)
    kappa = (3.0 - film.poisson) / (1.0 + film.poisson)
    strength = side_force / (2.0 * np.pi * film.thickness * (1.0 + kappa))
    centres = np.array([complex(*electrode.centre) for electrode in sensor.electrodes])
    potential = -strength * (1.0 / centres + 2.0 * centres / (kappa * film.radius**2))
    expected = sensor.piezo.d31 * 9.0 * 4.0 * potential.real
    assert relative_error(pulled - pushed, expected) <= 2e-3


def test_holding_force_and_slip_are_reciprocal_to_the_deflection():
    """By Betti's theorem, the derivatives of two displacements under the probe are equal.

    They are the derivative of the deflection with respect to the side force, and that of the displacement in the plane
    with respect to the force.
    """
    film = taut(0.8).film
    at = (6.0, 0.0)

    def displacement(force: float, side_force: float) -> np.ndarray:
        """Return the mean displacement (u, v, w) of the film under the probe, mm."""
        solved = press(film, PROBE, at, force, FULL, side_force=(side_force, 0.0))
        mesh = solved.mesh
        mean = mesh.template.copies * mesh.load @ solved.field
        return film.radius * mean * np.sqrt(solved.groups.squared_amplitude) ** [2, 2, 1]

    step = 0.01
    along_film = displacement(0.5 + step, 0.0)[0] - displacement(0.5 - step, 0.0)[0]
    into_film = displacement(0.5, step)[2] - displacement(0.5, -step)[2]
    assert into_film == pytest.approx(along_film, rel=1e-2)
    outward_force, _ = holding_force(press(film, PROBE, at, 0.5, FULL))
    assert abs(displacement(0.5, outward_force)[0]) < 0.03 * abs(displacement(0.5, 0.0)[0])


def test_friction_pulls_the_film_inwards_and_sticks_near_the_centre():
    film = taut(0.8).film
    slipping = friction_force(press(film, PROBE, (3.0, -4.0), 0.5, FULL), 0.2)
    np.testing.assert_allclose(slipping, [-0.06, 0.08], atol=1e-9)  # 0.2 F towards the centre
    sticking_x, sticking_y = friction_force(press(film, PROBE, (0.4, 0.3), 0.5, FULL), 0.2)
    assert -0.1 < sticking_x < 0.0
    assert sticking_y == pytest.approx(0.75 * sticking_x, rel=1e-6)


def test_a_rotated_side_force_of_a_square_probe_gives_rotated_charges():
    """If a press and its side force are rotated by 90 degrees, each electrode has the charge of its neighbour."""
    sensor = taut(0.5)
    square = Polygon.rectangle(2.0, 2.0)
    first = solved_charge(sensor, square, (4.0, 1.0), 0.3, FULL, side_force=(0.05, -0.02))
    turned = solved_charge(sensor, square, (-1.0, 4.0), 0.3, FULL, side_force=(0.02, 0.05))
    np.testing.assert_allclose(turned, np.roll(first, 1), rtol=1e-3)


@pytest.mark.parametrize("side_force", [(0.8, 0.8), (np.nan, 0.0), (0.0, np.inf)])
def test_invalid_side_forces_raise_scene_errors(film, side_force):
    with pytest.raises(SceneError, match="side force: expected at most 1 times the force of 1 N"):
        press(film, PROBE, (3.0, 0.0), 1.0, side_force=side_force)


def test_invalid_coefficient_of_friction_raises_a_scene_error(film):
    with pytest.raises(SceneError, match=r"coefficient of friction: expected 0 to 1, got 1\.5"):
        friction_force(press(film, PROBE, (3.0, 0.0), 0.01), 1.5)
