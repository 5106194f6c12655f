"""Reading an equilibrium: frames, refusals, and what it says about itself."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import (
    Circle,
    Film,
    Polygon,
    Resolution,
    SolveSettings,
    Theory,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.mechanics.stress import stress, turn_stress
from isocharge.simulate.solver.equilibrium import LINEAR_STRESS

FULL = Theory(stretching=True, bending=True, pretensioned=False)
MEMBRANE = Theory(stretching=True, bending=False, pretensioned=False)


@pytest.mark.parametrize(
    ("at_mm", "radius_mm", "message"),
    [
        ((44.5, 0.0), 1.0, r"probe off the film: centre \(44\.5, 0\) mm, farthest point of circle:1\.0 45\.5 mm from"),
        ((0.0, -44.0), 1.0, "probe off the film"),
        ((0.0, 0.0), 45.0, "probe off the film"),
        ((60.0, 0.0), 1.0, "probe off the film"),
        ((np.nan, 0.0), 1.0, r"position: expected two finite numbers, got \(nan, 0\.0\)"),
        ((0.0, np.inf), 1.0, r"position: expected two finite numbers"),
        ((0.0, 0.0), 1e-5, r"probe: expected a reach of at least 1e-05 of the film's radius \(45 mm\), got 1e-05 mm"),
    ],
)
def test_impossible_places_are_refused(film, at_mm, radius_mm, message):
    with pytest.raises(SceneError, match=message):
        press(film, Circle(radius_mm * 1e-3), (at_mm[0] * 1e-3, at_mm[1] * 1e-3), 1.0)


def test_corner_over_the_rim_is_refused(film):
    """A turned rectangle fits where an unturned one does not."""
    long, at = Polygon.rectangle(10e-3, 1e-3), (39.9e-3, 5e-3)
    with pytest.raises(SceneError, match=r"probe off the film: centre \(39\.9, 5\) mm, farthest point of rectangle"):
        press(film, long, at, 1.0)
    assert press(film, long.turned(0.5 * np.pi), at, 1e-3, SolveSettings(accuracy=0.05)).status == "converged"


@pytest.mark.parametrize("force", [0.0, -1.0, np.inf, np.nan])
def test_impossible_forces_are_refused(film, force):
    with pytest.raises(SceneError, match=f"force: expected a positive number of newtons .* got {force}"):
        press(film, Circle(1e-3), (0.0, 0.0), force)


def test_strains_beyond_the_theory_are_refused(film):
    with pytest.raises(SceneError, match=r"force 200 N stretches a film of 25 um beyond small strains: .* got 0\.152"):
        press(film, Circle(1e-3), (0.0, 0.0), 200.0)


@pytest.mark.parametrize("point", [(46e-3, 0.0), (-40e-3, 30e-3), (np.nan, 0.0)])
def test_points_off_the_film_are_refused(film, point):
    solved = press(film, Circle(1e-3), (0.0, 0.0), 1.0)
    points = np.array([(0.0, 0.0), (0.0, 45e-3), point])
    for read in (solved.deflection, solved.touch_stress):
        with pytest.raises(SceneError, match=rf"point \({point[0] * 1e3:.4g}, .*\) mm is off the film of radius 45 mm"):
            read(points)
        read(points[:2])


# Made-up fields


@pytest.mark.parametrize("at", [(0.0, 0.0), (12e-3, 0.0), (-9e-3, 14e-3)])
def test_stress_of_a_linear_field_is_constant_and_turned(film, made_up, at):
    """The patch test through the public function: the field is linear in the frame of the press."""
    gradient = np.array([[0.3, -0.1, 0.4], [0.2, 0.1, -0.6]])
    solved = made_up(lambda x: x @ gradient, at)
    f = np.eye(3, 2) + (gradient * np.array([0.1, 0.1, np.sqrt(0.1)])).T
    green = 0.5 * (f.T @ f - np.eye(2)) / 0.1
    local = film.young * 0.1 * stress(np.array([green[0, 0], green[1, 1], 2.0 * green[0, 1]]), film.poisson)
    points = np.random.default_rng(0).uniform(-25e-3, 25e-3, (50, 2))
    expected = turn_stress(local, np.arctan2(at[1], at[0]))
    np.testing.assert_allclose(solved.touch_stress(points) / expected, 1.0, rtol=1e-9)
    nodal = film.young * 0.1 * solved.nodal_stress()
    np.testing.assert_allclose(nodal - local, 0.0, atol=1e-9 * np.abs(local).max())


def test_deflection_of_a_linear_field_is_linear(made_up):
    """To the mesh's accuracy: points are found by the exact map, the field lives on its interpolant."""
    at, points = (-3e-3, 4e-3), np.random.default_rng(1).uniform(-25e-3, 25e-3, (50, 2))
    angle = np.arctan2(at[1], at[0])
    along = points @ [np.cos(angle), np.sin(angle)]
    across = points @ [-np.sin(angle), np.cos(angle)]
    solved = made_up(lambda x: x @ np.array([[0.0, 0.0, 0.4], [0.0, 0.0, -0.6]]), at)
    np.testing.assert_allclose(solved.deflection(points), np.sqrt(0.1) * (0.4 * along - 0.6 * across), atol=5e-7)


@pytest.mark.parametrize("surface", ["middle", "top"])
def test_rigid_turn_has_no_stress_and_no_charge(film, made_up, surface):
    """Out of plane by 50 degrees, then by 20 in the plane."""
    a, b, amplitude2 = np.deg2rad(50.0), np.deg2rad(20.0), 0.1
    tilt = np.array([[np.cos(a), 0.0], [0.0, 1.0], [np.sin(a), 0.0]])
    turn = np.array([[np.cos(b), -np.sin(b), 0.0], [np.sin(b), np.cos(b), 0.0], [0.0, 0.0, 1.0]])
    gradient = ((turn @ tilt - np.eye(3, 2)) / np.array([[0.1], [0.1], [np.sqrt(0.1)]])).T
    moved = made_up(lambda x: x @ gradient, (4e-3, 3e-3), amplitude2=amplitude2)
    assert np.abs(moved.touch_stress(np.zeros((1, 2)), surface)).max() < 1e-10 * film.young
    sensor = replace(load_sensor("four-25um-uniaxial"), surface=surface)
    assert np.abs(touch_charge(sensor, moved)).max() < 1e-10 * film.young * 20e-12 * 9e-6


# Real ones


@pytest.mark.parametrize("probe", [Circle(1e-3), Polygon.triangle(4e-3, 0.3)], ids=["circle", "triangle"])
def test_clamped_rim_does_not_move(film, probe):
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    rim = film.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.abs(press(film, probe, (6e-3, -5e-3), 1.0).deflection(rim)).max() < 1e-15


@pytest.mark.parametrize("at", [(0.0, 0.0), (6e-3, -5e-3)])
@pytest.mark.parametrize("probe", [Circle(1e-3), Polygon.rectangle(4e-3, 2e-3, 0.3)], ids=["circle", "rectangle"])
def test_vertical_forces_balance_round_the_probe(film, at, probe):
    """The membrane's pull through a circle round the probe carries the force: F = integral of (S grad w) . n h ds.

    Independent of the solver's own residual: stress and deflection are read as a user reads them.
    """
    centre, radius, step = np.array(at), 5e-3, 1e-6
    solved = press(film, probe, at, 1.0, SolveSettings(theory=MEMBRANE, resolution=Resolution(7, 8, 6)))
    angle = 2.0 * np.pi * np.arange(64) / 64
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = centre + radius * normal
    s11, s22, s12 = solved.touch_stress(points).T
    traction = np.stack([s11 * normal[:, 0] + s12 * normal[:, 1], s12 * normal[:, 0] + s22 * normal[:, 1]], axis=1)
    slope = np.stack(
        [(solved.deflection(points + e) - solved.deflection(points - e)) / (2 * step) for e in step * np.eye(2)], axis=1
    )
    pull = -np.sum(traction * slope, axis=1).mean() * 2.0 * np.pi * radius * film.thickness
    assert pull == pytest.approx(1.0, rel=1e-5)


def test_tension_is_positive_up_to_half_the_radius_and_not_at_the_rim(film):
    """No wrinkles where the forward map works; near the rim the film is compressed, and says so."""
    for distance, taut in ((0.0, True), (0.5, True), (0.75, False)):
        solved = press(film, Circle(1e-3), (distance * film.radius, 0.0), 1.0, SolveSettings(theory=MEMBRANE))
        warned = [warning for warning in solved.warnings if "may wrinkle" in warning]
        assert (solved.principal_stress[0] > 0.0) == taut
        assert bool(warned) == (not taut)
        assert taut or f"compressed to {solved.principal_stress[0] * 1e-6:.3g} MPa" in warned[0]


def test_stress_beyond_what_pvdf_bears_is_warned_of(film):
    small, large = (press(film, Circle(1e-3), (2e-3, 0.0), force) for force in (0.01, 5.0))
    assert not small.warnings
    assert large.principal_stress[1] > LINEAR_STRESS == 40e6
    assert large.warnings == (
        f"the film is stressed to {large.principal_stress[1] * 1e-6:.3g} MPa; PVDF is linear up to 40 MPa",
    )


def test_pretension_counts_in_the_largest_stress(film):
    taut = press(replace(film, pretension=39.99e6), Circle(1e-3), (2e-3, 0.0), 0.01)
    slack = press(replace(film, pretension=1e6), Circle(1e-3), (2e-3, 0.0), 0.01)
    assert len(taut.warnings) == 1
    assert not slack.warnings
    assert slack.principal_stress[0] > 0.9e6


def test_principal_stress_is_that_of_the_points(film):
    """No point of the film is stressed beyond what the result says, at either surface."""
    solved = press(film, Circle(1e-3), (6e-3, 2e-3), 1.0)
    z = film.radius * np.sqrt(np.linspace(0.0, 1.0, 4000)) * np.exp(2.4j * np.arange(4000))
    near = complex(6e-3, 2e-3) + 0.05 * z
    points = np.concatenate([z, near])
    points = np.stack([points.real, points.imag], axis=1)
    smallest, largest = solved.principal_stress
    for surface in ("middle", "top", "bottom"):
        s11, s22, s12 = solved.touch_stress(points, surface).T
        top = (0.5 * (s11 + s22) + np.hypot(0.5 * (s11 - s22), s12)).max()
        assert top <= largest * 1.02
        if surface == "middle":
            assert (0.5 * (s11 + s22) - np.hypot(0.5 * (s11 - s22), s12)).min() >= smallest - 0.02 * largest


def test_result_says_what_was_solved(film):
    probe = Polygon.triangle(4e-3)
    solved = press(film, probe, (1e-3, 2e-3), 0.7)
    assert (solved.film, solved.probe, solved.at, solved.force) == (film, probe, (1e-3, 2e-3), 0.7)
    assert solved.theory == FULL
    assert solved.message == f"converged in {solved.iterations} steps"
    assert solved.status == "converged"
    assert solved.seconds > 0.0
    assert 0.0 < solved.mesh_error <= solved.estimated_error < 1e-3


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("seed", range(6))
def test_mesh_error_is_a_bound(film, seed):
    """Against a refined solve, for the worst charge over the press's largest, probes on electrodes and far out too."""
    rng = np.random.default_rng([17, seed])
    size = float(np.exp(rng.uniform(np.log(0.3e-3), np.log(4e-3))))
    probe = (Circle(size), Polygon.rectangle(2 * size, size, rng.uniform(0, 3)), Polygon.triangle(2 * size, 1.0))[
        seed % 3
    ]
    z = 33e-3 * np.sqrt(rng.random()) * np.exp(2j * np.pi * rng.random())
    film = replace(film, thickness=float(np.exp(rng.uniform(np.log(10e-6), np.log(1e-3)))))
    at, force = (float(z.real), float(z.imag)), float(np.exp(rng.uniform(np.log(0.01), np.log(2.0))))
    solved = press(film, probe, at, force)
    finer = replace(solved.resolution, order=solved.resolution.order + 2, rim=2 * solved.resolution.rim)
    refined = press(film, probe, at, force, SolveSettings(theory=solved.theory, resolution=finer, layer=solved.layer))
    for name in ("three-25um-uniaxial", "four-25um-biaxial"):
        sensor = replace(load_sensor(name), film=film)
        exact = touch_charge(sensor, refined)
        error = np.abs(touch_charge(sensor, solved) - exact).max() / np.abs(exact).max()
        assert error <= solved.mesh_error


def test_accuracy_is_reached(film):
    """And costs: a finer mesh for more digits."""
    sensor, probe, at = load_sensor("four-25um-uniaxial"), Circle(1e-3), (9e-3, 1e-3)
    exact = touch_charge(
        sensor, press(film, probe, at, 1.0, SolveSettings(theory=FULL, resolution=Resolution(10, 8, 8, 3)))
    )
    sizes = []
    for accuracy in (1e-2, 1e-3, 1e-4):
        solved = press(film, probe, at, 1.0, SolveSettings(accuracy=accuracy, theory=FULL))
        assert np.abs(touch_charge(sensor, solved) / exact - 1.0).max() < accuracy
        sizes.append(solved.field.size)
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[-1]


def test_mesh_error_of_a_smooth_field_is_a_number(film):
    """Where the highest modes hold nothing but round-off."""
    taut, theory = replace(film, pretension=1e7), Theory(stretching=False, bending=False, pretensioned=True)
    solved = press(
        taut, Circle(0.9 * film.radius), (0.0, 0.0), 1e-3, SolveSettings(theory=theory, resolution=Resolution(12, 8, 3))
    )
    assert 0.0 <= solved.mesh_error < 1e-4


def test_estimated_error_of_a_thick_film_as_a_membrane_is_infinite(film: Film):
    """The membrane is wrong by factors there, so no number is given."""
    thick = replace(film, thickness=1e-3)
    assert press(thick, Circle(1e-3), (0.0, 0.0), 1.0, SolveSettings(theory=MEMBRANE)).estimated_error == np.inf
