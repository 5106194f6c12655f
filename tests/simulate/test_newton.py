"""A flat, slack film converges for every force; failures are told, never hidden."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.errors import SolveError
from isocharge.simulate import STANDARD, Circle, Resolution, press
from isocharge.simulate.equilibrium import dimensionless
from isocharge.simulate.newton import schwerin_start
from isocharge.simulate.template import Placement, template

FORCES = (1e-4, 1e-3, 1e-2, 0.1, 1.0, 5.0)
RADII_MM = (0.2, 1.0, 5.0)


@pytest.mark.parametrize("radius_mm", RADII_MM)
@pytest.mark.parametrize("distance_mm", [0.0, 8.0, 13.0, 20.0])
def test_every_force_converges_from_flat(film, distance_mm, radius_mm):
    """No help from the user: no force steps, no tension, no start."""
    for force in FORCES:
        solved = press(film, Circle(radius_mm * 1e-3), (0.0, distance_mm * 1e-3), force)
        assert solved.status == "converged"
        assert solved.residual <= 1e-9
        assert solved.iterations <= 7


@pytest.mark.parametrize("distance_mm", [30.0, 36.0])
def test_near_the_rim(film, distance_mm):
    for force in (1e-4, 5.0):
        assert press(film, Circle(1e-3), (0.0, distance_mm * 1e-3), force).iterations <= 10


@pytest.mark.slow
@pytest.mark.parametrize("radius_mm", RADII_MM)
@pytest.mark.parametrize("distance_mm", [25.0, 30.0, 34.0, 36.0])
def test_every_force_near_the_rim(film, distance_mm, radius_mm):
    for force in FORCES:
        assert press(film, Circle(radius_mm * 1e-3), (0.0, distance_mm * 1e-3), force).iterations <= 12


@pytest.mark.slow
def test_where_the_membrane_wants_to_wrinkle(film):
    """At nine tenths of the radius the equations are hardly well-posed any more; still solved, and doubted."""
    for force in FORCES:
        solved = press(film, Circle(1e-3), (40e-3, 0.0), force)
        assert solved.status == "converged"
        assert solved.estimated_error > 0.04


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_large_probes_converge(film, share):
    for force in (1e-4, 5.0):
        assert press(film, Circle(share * film.radius), (1e-3, 1e-3), force).iterations <= 8


@pytest.mark.parametrize("pretension", [1e3, 1e5, 1e6, 1e7])
def test_every_pretension_converges(film, pretension):
    """From hardly any to one that makes the film linear."""
    for force in FORCES:
        assert press(replace(film, pretension=pretension), Circle(1e-3), (5e-3, 2e-3), force).iterations <= 12


@pytest.mark.parametrize(
    "resolution", [Resolution(2, 8, 3), Resolution(3, 8, 4), Resolution(6, 8, 6), Resolution(5, 16, 8)]
)
def test_every_mesh_converges(film, resolution):
    assert press(film, Circle(1e-3), (8e-3, 0.0), 1.0, resolution=resolution).iterations <= 8


def test_end_of_newton_is_quadratic(film):
    """Each of the last steps squares the residual: the tangent is the true one at the end."""
    residuals = [
        press(film, Circle(1e-3), (3e-3, 0.0), 1.0, tolerance=tolerance).residual for tolerance in (1e-1, 1e-2, 1e-4)
    ]
    assert residuals[2] < 10.0 * residuals[1] ** 1.5


def test_neighbour_is_a_better_start(film):
    first = press(film, Circle(1e-3), (5e-3, 0.0), 1.0)
    near = press(film, Circle(1e-3), (5.2e-3, 1e-3), 1.1, start=first)
    cold = press(film, Circle(1e-3), (5.2e-3, 1e-3), 1.1)
    assert near.iterations <= 3 < cold.iterations
    np.testing.assert_allclose(near.field, cold.field, atol=1e-7)


def test_start_of_another_mesh_is_not_used(film):
    coarse = press(film, Circle(1e-3), (5e-3, 0.0), 1.0, resolution=Resolution(3, 8, 4))
    assert press(film, Circle(1e-3), (5e-3, 0.0), 1.0, start=coarse).status == "converged"


def test_failure_raises_a_full_sentence(film):
    with pytest.raises(
        SolveError, match=r"no equilibrium at 1\.5 N, position \(2, -3\) mm: .*; residual .* > 1e-30 after \d+ steps"
    ):
        press(film, Circle(1e-3), (2e-3, -3e-3), 1.5, tolerance=1e-30)


def test_failure_is_told_if_asked_not_to_raise(film):
    failed = press(film, Circle(1e-3), (2e-3, -3e-3), 1.5, tolerance=1e-30, throw=False)
    assert failed.status == "failed"
    assert failed.message == "no step lowers the energy any more"
    assert 0.0 < failed.residual < 1e-9


def test_steps_are_limited(film, monkeypatch):
    monkeypatch.setattr("isocharge.simulate.newton.MAX_ITERATIONS", 2)
    failed = press(film, Circle(1e-3), (0.0, 0.0), 1.0, throw=False)
    assert (failed.status, failed.message, failed.iterations) == ("failed", "stopped after 2 steps", 2)


def test_a_start_that_is_not_finite_is_told(film):
    bad = press(film, Circle(1e-3), (0.0, 0.0), 1.0)
    bad.field[0, 2] = np.nan
    failed = press(film, Circle(1e-3), (0.0, 0.0), 1.0, start=bad, throw=False)
    assert (failed.status, failed.message) == ("failed", "the residual is not a finite number")


@pytest.mark.parametrize("pretension", [0.0, 1e5, 1e7])
def test_start_has_about_the_right_height(film, pretension):
    """Within a factor of two of the solution in slack and taut films alike; flat on the rim."""
    film = replace(film, pretension=pretension)
    solved, place = press(film, Circle(1e-3), (0.0, 0.0), 0.1), Placement.of_circle(0.0, 1.0 / 45.0)
    z = template(STANDARD).node_points(place.rho)
    start = schwerin_start(z, place.rho, 1.0 / 45.0, dimensionless(film, 0.1))
    assert 0.5 < start[:, 2].max() / solved.field[:, 2].max() < 2.0
    assert not start[np.abs(z) > 1.0 - 1e-9].any()
