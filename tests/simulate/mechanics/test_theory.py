"""Names of the theories, and the error of omitted bending."""

import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, SolveSettings, Theory, load_sensor, press, touch_charge
from isocharge.simulate.mechanics.theory import theory_by_name
from isocharge.simulate.solver.error_estimate import estimated_error, modelling_error
from solved_charges import relative_error, solved_charge, with_film

MEMBRANE = Theory(bending=False)


@pytest.mark.parametrize("bending", [False, True])
def test_theory_by_name_finds_the_theory_with_this_name(bending):
    assert theory_by_name(Theory(bending).name) == Theory(bending)
    with pytest.raises(SceneError, match=r"theory: expected one of .*'nonlinear membrane', .*, got 'linear plate'"):
        theory_by_name("linear plate")


@pytest.mark.parametrize(
    ("thickness", "poisson", "radius", "at", "force"),
    [
        (0.097, 0.14, 2.9, (-13.0, 8.4), 0.081),
        (0.0059, 0.32, 0.34, (16.3, -2.7), 5.0),
        (0.137, 0.24, 3.2, (-5.8, -2.1), 0.028),
    ],
)
def test_modelling_error_is_an_upper_bound_of_the_effect_of_bending(thickness, poisson, radius, at, force):
    """The charges without bending differ from those with bending by a sixth to the whole of the modelling error.

    The difference is relative to the largest charge of the press, and both theories use the same mesh.
    """
    sensor = with_film(load_sensor("three-25um-uniaxial"), thickness=thickness, poisson=poisson)
    probe = Circle(radius)
    full = press(sensor.film, probe, at, force)
    same_mesh = SolveSettings(theory=MEMBRANE, resolution=full.mesh.resolution, layer=full.mesh.layer)
    charge = solved_charge(sensor, probe, at, force, same_mesh)
    difference = relative_error(charge, touch_charge(sensor, full))
    assert difference <= modelling_error(sensor.film, probe, force) <= 6.0 * difference


@pytest.mark.parametrize(("pretension", "thickness"), [(0.0, 0.11), (0.5, 0.11), (5.0, 0.025)])
def test_estimated_error_of_a_membrane_holds_for_an_electrode_beside_a_small_probe(pretension, thickness):
    sensor = with_film(load_sensor("four-25um-biaxial"), pretension=pretension, thickness=thickness)
    at = (0.0, -9.5)
    exact = solved_charge(sensor, Circle(1.0), at, 0.05)
    membrane = press(sensor.film, Circle(1.0), at, 0.05, SolveSettings(theory=MEMBRANE))
    assert relative_error(touch_charge(sensor, membrane), exact) <= estimated_error(membrane)


def test_estimated_error_includes_the_averaged_bending_stiffness_of_an_orthotropic_film():
    """A Ritz solution with the bending stiffness of each direction differs by up to 2.8 % from one with the mean."""
    film = with_film(load_sensor("four-25um-biaxial"), thickness=0.5, young_ratio=2.0, axis=0.5).film
    assert 0.028 < estimated_error(press(film, Circle(5.0), (6.0, 4.0), 1.0)) < 0.3
