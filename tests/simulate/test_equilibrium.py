"""Reading an equilibrium: frames, refusals, and what it says about its own error."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.errors import SceneError
from isocharge.simulate import (
    STANDARD,
    Circle,
    Film,
    Resolution,
    built_in_sensors,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.equilibrium import (
    DISCRETISATION_ERROR,
    MESH_TOLERANCE,
    bending_share,
    resolution_for,
    turn_stress,
)
from isocharge.simulate.membrane import stress


@pytest.mark.parametrize(
    ("at_mm", "radius_mm", "message"),
    [
        ((44.5, 0.0), 1.0, r"probe off the film: centre \(44\.5, 0\) mm, probe radius 1 mm, film radius 45 mm"),
        ((0.0, -44.0), 1.0, "probe off the film"),
        ((0.0, 0.0), 45.0, "probe off the film"),
        ((60.0, 0.0), 1.0, "probe off the film"),
        ((np.nan, 0.0), 1.0, r"position: expected two finite numbers, got \(nan, 0\.0\)"),
        ((43.5, 0.0), 1.0, r"press at \(43\.5, 0\) mm is too near the rim for a mesh of order 8 with 8 elements"),
    ],
)
def test_impossible_places_are_refused(film, at_mm, radius_mm, message):
    at = (at_mm[0] * 1e-3, at_mm[1] * 1e-3)
    with pytest.raises(SceneError, match=message):
        press(film, Circle(radius_mm * 1e-3), at, 1.0)


def test_scenes_beyond_the_theory_are_refused(film):
    """Strains too large for St. Venant-Kirchhoff, and a probe that the grading of the mesh cannot reach."""
    with pytest.raises(SceneError, match=r"force 200 N stretches a film of 25 um beyond small strains: .* got 0\.152"):
        press(film, Circle(1e-3), (0.0, 0.0), 200.0)
    with pytest.raises(
        SceneError, match=r"probe radius: expected at least 1e-05 of the film's \(45 mm\), got 0\.0004 mm"
    ):
        press(film, Circle(4e-7), (0.0, 0.0), 1.0)
    assert press(film, Circle(5e-7), (0.0, 0.0), 1e-3).status == "converged"


@pytest.mark.parametrize("point", [(46e-3, 0.0), (-40e-3, 30e-3), (np.nan, 0.0)])
def test_points_off_the_film_are_refused(film, point):
    solved = press(film, Circle(1e-3), (0.0, 0.0), 1.0)
    points = np.array([(0.0, 0.0), (0.0, 45e-3), point])
    with pytest.raises(SceneError, match=rf"point \({point[0] * 1e3:.4g}, .*\) mm is off the film of radius 45 mm"):
        solved.deflection(points)
    with pytest.raises(SceneError, match="is off the film"):
        solved.touch_stress(points)
    solved.touch_stress(points[:2])


@pytest.mark.parametrize("force", [0.0, -1.0, np.inf, np.nan])
def test_impossible_forces_are_refused(film, force):
    with pytest.raises(SceneError, match=f"force: expected a positive number of newtons .* got {force}"):
        press(film, Circle(1e-3), (0.0, 0.0), force)


@given(
    angle=st.floats(-7.0, 7.0),
    s11=st.floats(-5.0, 5.0),
    s22=st.floats(-5.0, 5.0),
    s12=st.floats(-5.0, 5.0),
)
@settings(derandomize=True)
def test_turned_stress_is_the_rotated_tensor(angle, s11, s22, s12):
    q = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    tensor = q @ np.array([[s11, s12], [s12, s22]]) @ q.T
    turned = turn_stress(np.array([s11, s22, s12]), angle)
    np.testing.assert_allclose(turned, [tensor[0, 0], tensor[1, 1], tensor[0, 1]], atol=1e-12)


@pytest.mark.parametrize("at", [(0.0, 0.0), (12e-3, 0.0), (-9e-3, 14e-3)])
def test_stress_of_a_linear_field_is_constant_and_turned(film, linear_equilibrium, at):
    """The patch test through the public function: the field is linear in the frame of the press."""
    gradient = np.array([[0.3, -0.1, 0.4], [0.2, 0.1, -0.6]])
    solved = linear_equilibrium(gradient, at)
    f = np.eye(3, 2) + (gradient * np.array([0.1, 0.1, np.sqrt(0.1)])).T
    green = 0.5 * (f.T @ f - np.eye(2)) / 0.1
    local = film.young * 0.1 * stress(np.array([green[0, 0], green[1, 1], 2.0 * green[0, 1]]), film.poisson)
    points = np.random.default_rng(0).uniform(-25e-3, 25e-3, (50, 2))
    expected = turn_stress(local, np.arctan2(at[1], at[0]))
    np.testing.assert_allclose(solved.touch_stress(points) / expected, 1.0, rtol=1e-9)


def test_deflection_of_a_linear_field_is_linear(linear_equilibrium):
    """To the mesh's accuracy: points are found by the exact map, the field lives on its interpolant."""
    at, points = (-3e-3, 4e-3), np.random.default_rng(1).uniform(-25e-3, 25e-3, (50, 2))
    gradient = np.array([[0.0, 0.0, 0.4], [0.0, 0.0, -0.6]])
    angle = np.arctan2(at[1], at[0])
    along = points @ [np.cos(angle), np.sin(angle)]
    across = points @ [-np.sin(angle), np.cos(angle)]
    np.testing.assert_allclose(
        linear_equilibrium(gradient, at).deflection(points), np.sqrt(0.1) * (0.4 * along - 0.6 * across), atol=2e-7
    )


def test_a_rigid_turn_has_no_stress_and_no_charge(film, linear_equilibrium):
    """Out of plane by 50 degrees, then by 20 in the plane."""
    a, b, amplitude2 = np.deg2rad(50.0), np.deg2rad(20.0), 0.1
    tilt = np.array([[np.cos(a), 0.0], [0.0, 1.0], [np.sin(a), 0.0]])
    turn = np.array([[np.cos(b), -np.sin(b), 0.0], [np.sin(b), np.cos(b), 0.0], [0.0, 0.0, 1.0]])
    gradient = ((turn @ tilt - np.eye(3, 2)) / np.array([[0.1], [0.1], [np.sqrt(0.1)]])).T
    moved = linear_equilibrium(gradient, (4e-3, 3e-3), amplitude2)
    assert np.abs(moved.touch_stress(np.zeros((1, 2)))).max() < 1e-12 * film.young
    assert np.abs(touch_charge(load_sensor("four-25um-uniaxial"), moved)).max() < 1e-12 * film.young * 20e-12 * 9e-6


def test_clamped_rim_does_not_move(film):
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    rim = film.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.abs(press(film, Circle(1e-3), (6e-3, -5e-3), 1.0).deflection(rim)).max() < 1e-16


@pytest.mark.parametrize("at", [(0.0, 0.0), (6e-3, -5e-3)])
def test_vertical_forces_balance_round_the_probe(at):
    """The film's pull through a circle round the probe carries the force: F = closed integral of (S grad w) . n h ds.

    Independent of the solver's own residual: stress and deflection are read as a user reads them.
    """
    film, centre, radius, step = load_sensor("three-25um-biaxial").film, np.array(at), 5e-3, 1e-6
    solved = press(film, Circle(1e-3), at, 1.0, resolution=Resolution(7, 8, 6))
    angle = 2.0 * np.pi * np.arange(64) / 64
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = centre + radius * normal
    s11, s22, s12 = solved.touch_stress(points).T
    traction = np.stack([s11 * normal[:, 0] + s12 * normal[:, 1], s12 * normal[:, 0] + s22 * normal[:, 1]], axis=1)
    slope = np.stack(
        [(solved.deflection(points + e) - solved.deflection(points - e)) / (2 * step) for e in step * np.eye(2)], axis=1
    )
    pull = -np.sum(traction * slope, axis=1).mean() * 2.0 * np.pi * radius * film.thickness
    assert pull == pytest.approx(1.0, rel=1e-6)


def test_tension_is_positive_up_to_half_the_radius(film):
    """No wrinkles where the forward map works; near the rim the membrane asks for compression (README, limits)."""
    turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 120))
    disk = (np.linspace(0.02, 0.999, 40)[:, None] * turn).ravel()
    points = film.radius * np.stack([disk.real, disk.imag], axis=1)

    def smallest(distance: float) -> float:
        solved = press(film, Circle(1e-3), (distance, 0.0), 1.0, resolution=Resolution(6, 8, 6))
        s11, s22, s12 = solved.touch_stress(points).T
        return float((0.5 * (s11 + s22) - np.hypot(0.5 * (s11 - s22), s12)).min())

    assert smallest(0.0) > 0.0
    assert smallest(0.5 * film.radius) > 0.0
    assert smallest(0.75 * film.radius) < 0.0


def test_result_says_what_was_solved(film):
    solved = press(film, Circle(1e-3), (1e-3, 2e-3), 0.7)
    assert (solved.film, solved.probe, solved.at, solved.force) == (film, Circle(1e-3), (1e-3, 2e-3), 0.7)
    assert solved.resolution == STANDARD
    assert solved.theory == "nonlinear membrane"
    assert solved.message == f"converged in {solved.iterations} steps"
    assert solved.seconds > 0.0


@pytest.mark.parametrize("resolution", [STANDARD, None], ids=["standard", "chosen"])
@pytest.mark.parametrize("distance", [4e-3, 13e-3, 20e-3, 25e-3])
def test_mesh_error_is_honest(film, distance, resolution):
    """A bound for the worst charge, against a refined solve: of the standard mesh anywhere, and of the mesh chosen."""
    sensors = [load_sensor(name) for name in built_in_sensors()]
    at = (distance * np.cos(1.0), distance * np.sin(1.0))
    solved = press(film, Circle(1e-3), at, 1.0, resolution=resolution)
    refined = press(film, Circle(1e-3), at, 1.0, resolution=Resolution(8, 8, 8))
    error = max(np.abs(touch_charge(s, solved) / touch_charge(s, refined) - 1.0).max() for s in sensors)
    assert error < solved.mesh_error < solved.estimated_error
    assert solved.mesh_error >= DISCRETISATION_ERROR


def test_mesh_is_chosen_by_place(film):
    """The standard one up to a quarter of the radius; then as much as the error asks for, until nothing helps."""

    def chosen(distance: float) -> Resolution:
        return resolution_for(film, Circle(1e-3), (0.0, distance))

    assert chosen(0.0) == chosen(12e-3) == STANDARD
    orders = [chosen(distance).order for distance in (12e-3, 20e-3, 25e-3, 28e-3, 36e-3)]
    assert orders == [4, 5, 6, 7, 8]
    assert press(film, Circle(1e-3), (20e-3, 0.0), 1.0).mesh_error < MESH_TOLERANCE
    assert press(film, Circle(1e-3), (20e-3, 0.0), 1.0, resolution=STANDARD).mesh_error > MESH_TOLERANCE


def test_mesh_that_folds_is_refused(film):
    with pytest.raises(SceneError, match=r"too near the rim for a mesh of order 4 with 8 elements"):
        press(film, Circle(1e-3), (42e-3, 0.0), 1.0, resolution=STANDARD)


def test_bending_share_follows_thickness_and_force(film):
    """l / a with l = sqrt(D / (h s)): doubling thickness at one stress doubles it, tension lowers it."""
    assert bending_share(replace(film, thickness=50e-6), 1e-3) == pytest.approx(2.0 * bending_share(film, 1e-3))
    assert bending_share(film, 4e-3) == pytest.approx(0.5 * bending_share(film, 1e-3))
    assert bending_share(replace(film, pretension=1e6), 1e-3) < bending_share(film, 1e-3)


def test_equilibrium_of_a_thick_film_admits_it(film: Film):
    """The membrane is wrong by factors there, so no number is given."""
    assert press(replace(film, thickness=1e-3), Circle(1e-3), (0.0, 0.0), 1.0).estimated_error == np.inf
