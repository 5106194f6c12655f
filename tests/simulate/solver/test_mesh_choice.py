"""Choice of the mesh, and error estimates from two meshes."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SolveError
from isocharge.simulate import (
    Circle,
    Electrode,
    Film,
    Polygon,
    SolveSettings,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.solver.error_estimate import estimated_error, mesh_error
from isocharge.simulate.solver.load_case import LoadCase, needs_second_mesh
from isocharge.simulate.solver.press import needed_resolution
from solved_charges import relative_error, solved_charge, with_film

FILM = Film(45.0, 0.025, 3000.0, 0.34)
INNER = (Circle(1.0), (8.0, 2.0), 1.0)
NEAR_THE_RIM = (Circle(2.0), (28.0, 0.0), 0.1)


@pytest.mark.parametrize("scene", [INNER, NEAR_THE_RIM], ids=["inner", "rim"])
def test_needed_resolution_is_that_of_the_press(scene):
    assert needed_resolution(FILM, *scene) == press(FILM, *scene).mesh.resolution


def test_very_uneven_pretension_has_an_accurate_mesh_under_a_small_force():
    """The pretension along one axis is three times that along the other, and a small force hardly changes the stress.

    The mesh for comparison is finer in each direction.
    """
    sensor = with_film(load_sensor("four-25um-biaxial"), pretension=2.4, deviator=(1.2, 0.0))
    chosen = solved_charge(sensor, Circle(1.0), (3.0, 2.0), 0.05)
    finer = SolveSettings(resolution=Resolution(order=5, around=20, rings=7, rim=2))
    expected = solved_charge(sensor, Circle(1.0), (3.0, 2.0), 0.05, finer)
    assert relative_error(chosen, expected) <= 3e-4


@pytest.mark.parametrize("wrong", [(1, 8, 4, 0), (4, 3, 4, 0), (4, 8, 0, 0), (4, 8, 4, -1)])
def test_resolution_rejects_values_out_of_range(wrong):
    with pytest.raises(ValueError, match=f"got {wrong[0]}, {wrong[1]}, {wrong[2]}, {wrong[3]}"):
        Resolution(*wrong)


# Two meshes

SCENES = {
    "inside, a taut film under a needle": (0.01606, 18.99, 0.271, Circle(0.1916), 23.39, 4.0),
    "inside, a plate under a needle": (0.4, 0.0, 0.11, Circle(0.157), 25.5, 1.2e-5),
    "a taut film": (0.018, 16.0, 0.2, Circle(1.3), 37.5, 3e-5),
    "a plate": (1.1, 0.66, 0.3, Polygon.rectangle(1.0, 0.6, 0.4), 40.1, 0.044),
    "a long rectangle lying along the rim": (0.348, 1.2, 0.2, Polygon.rectangle(13.4, 2.5, 1.6), 37.9, 8e-3),
    "a small circle half a millimetre from it": (0.104, 0.0, 0.12, Circle(0.2), 44.3, 2.8),
    "a thin film without bending": (0.005, 1.5, 0.49, Polygon.triangle(0.2, 1.0), 34.1, 5.1),
}
"""Thickness, pretension, Poisson's ratio, probe, distance from the centre, force.

An estimate from the shapes of the elements would be at most 0.1 % for these presses. Near the rim, the error is up to
70 times this estimate, and slightly farther inside 1.3 times.
"""


def worst_error(film: Film, rough, fine) -> float:
    """Return the largest error of a charge of the built-in layouts, relative to the largest charge of the layout."""
    errors = []
    for name in ("three-25um-biaxial", "four-25um-uniaxial"):
        sensor = replace(load_sensor(name), film=film)
        errors.append(relative_error(touch_charge(sensor, rough), touch_charge(sensor, fine)))
    return max(errors)


@pytest.mark.first_cases(2)
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_mesh_error_bounds_the_difference_from_a_finer_mesh(scene):
    """The finer mesh has an order that is higher by two, and more rings."""
    thickness, pretension, poisson, probe, distance, force = scene
    film = Film(45.0, thickness, 3000.0, poisson, pretension)
    at = (distance * np.cos(0.34), distance * np.sin(0.34))
    solved = press(film, probe, at, force)
    mesh = solved.mesh.resolution
    finer = replace(mesh, order=mesh.order + 2, rings=mesh.rings + 1, rim=mesh.rim and mesh.rim + 1)
    settings = SolveSettings(theory=solved.theory, resolution=finer, layer=solved.mesh.layer)
    refined = press(film, probe, at, force, settings, start=solved)
    assert worst_error(film, solved, refined) <= mesh_error(solved) < 0.01


@pytest.mark.parametrize(
    ("probe", "distance", "accuracy", "needed"),
    [
        (Circle(0.4), 26.5, 1e-3, False),
        (Circle(0.6), 26.5, 1e-3, True),  # near the rim
        (Polygon.rectangle(4.0, 2.0), 9.0, 1e-3, False),
        (Polygon.rectangle(8.0, 2.0), 9.0, 1e-3, True),  # a large polygon
        (Circle(4.2), 9.0, 1e-3, False),
        (Circle(1.0), 9.0, 5e-4, True),  # more digits
    ],
)
def test_needs_second_mesh_near_the_rim_and_for_large_probes(probe, distance, accuracy, needed):
    case = LoadCase(FILM, probe, (distance, 0.0), 1.0, SolveSettings(accuracy=accuracy))
    assert needs_second_mesh(case) == needed


def test_meshes_with_different_equilibria_raise_solve_error(monkeypatch):
    """A difference above a tenth is an error. A smaller difference is the error estimate."""
    scene = FILM, *NEAR_THE_RIM
    monkeypatch.setattr("isocharge.simulate.solver.press.MAX_EXTRA_ORDERS", 1)
    monkeypatch.setattr("isocharge.simulate.solver.press.relative_difference", lambda *_: 0.09)
    assert estimated_error(press(*scene)) == pytest.approx(0.09)
    monkeypatch.setattr("isocharge.simulate.solver.press.relative_difference", lambda *_: 0.11)
    with pytest.raises(SolveError, match=r"order 5 and one of order 6 find charges that differ by 11%"):
        press(*scene)


@pytest.mark.parametrize(
    ("radius", "thickness", "pretension", "probe", "force"),
    [(14.0, 0.104, 0.64, 2.6, 1.0), (30.0, 0.05, 0.0, 1.0, 0.05)],
)
def test_film_that_bends_far_from_the_rim_equals_a_finer_mesh(radius, thickness, pretension, probe, force):
    """Under a small force, a thick film bends within 0.2 to 0.3 film radii from the rim."""
    nominal = load_sensor("four-25um-uniaxial")
    film = replace(nominal.film, radius=radius, thickness=thickness, pretension=pretension)
    centre = 0.45 * radius
    side = 0.2 * radius
    left = Electrode.of_square("A", (-centre, centre), side)
    right = Electrode.of_square("B", (centre, centre), side)
    sensor = replace(nominal, film=film, electrodes=(left, right))
    at = (0.2 * radius, 0.05 * radius)
    finer = SolveSettings(resolution=Resolution(order=7, around=8, rings=8, rim=4))
    expected = solved_charge(sensor, Circle(probe), at, force, finer)
    charge = solved_charge(sensor, Circle(probe), at, force)
    np.testing.assert_allclose(charge, expected, rtol=1e-4)
