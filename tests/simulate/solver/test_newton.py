"""Convergence of Newton's method from the flat film, and reports of failures."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SolveError
from isocharge.simulate import Circle, Polygon, Resolution, SolveSettings, Theory, deflection, press
from isocharge.simulate.solver.newton import NewtonResult

FORCES = (1e-5, 10.0)
MEMBRANE = Theory(bending=False)
FULL = Theory(bending=True)
CIRCLE = Circle(1.0)
RECTANGLE = Polygon.rectangle(4.0, 2.0, 0.4)
FAILING = SolveSettings(theory=MEMBRANE, resolution=Resolution(3, 8, 2), tolerance=1e-30)


@pytest.mark.parametrize(
    ("probe", "changes", "theory"),
    [
        (RECTANGLE, {}, MEMBRANE),
        (CIRCLE, {}, FULL),
        (CIRCLE, {"thickness": 1.0}, FULL),
        (RECTANGLE, {"pretension": 1e-3}, FULL),
        (CIRCLE, {"pretension": 20.0}, FULL),
    ],
    ids=str,
)
def test_newton_converges_from_the_flat_film_for_every_force(film, changes, theory, probe):
    """The user provides no load steps, no pretension and no starting equilibrium."""
    for force in FORCES:
        solved = press(replace(film, **changes), probe, (5.0, 3.0), force, SolveSettings(theory=theory))
        assert solved.residual <= 1e-7 or "round-off" in solved.message
        assert solved.iterations <= 20


def test_compressed_plate_buckles_and_is_refused_if_it_bulges_against_the_push(film):
    """Newton's steps alone lead to an unstable equilibrium, in which the plate is nearly flat."""
    plate = replace(film, thickness=0.5, pretension=-1.0)
    scene = plate, Circle(2.0), (0.0, 0.0)
    mesh = SolveSettings(resolution=Resolution(4, 8, 4, 2))
    with pytest.raises(SolveError, match="the film bulges against the push"):
        press(*scene, 0.006, mesh)
    assert deflection(press(*scene, 1.0, mesh), np.zeros((1, 2)))[0] > 0.0


@pytest.mark.parametrize("theory", [MEMBRANE, FULL])
def test_newton_converges_quadratically(film, theory):
    """The last step nearly squares the residual, because the tangent is exact near the solution."""
    residuals = [
        press(film, CIRCLE, (3.0, 0.0), 1.0, SolveSettings(theory=theory, tolerance=tolerance)).residual
        for tolerance in (1e-1, 1e-2, 1e-4)
    ]
    assert residuals[2] < 10.0 * residuals[1] ** 1.5


def test_failed_solve_raises_solve_error(film, monkeypatch):
    scene = film, CIRCLE, (2.0, -3.0), 1.5, FAILING
    message = r"no equilibrium at 1\.5 N, position \(2, -3\) mm: .*; residual .* \(expected 1e-30\) after \d+ steps"
    solved = press(*scene)  # a tolerance that no arithmetic reaches: as good as it gets is no failure
    assert solved.message == f"converged to round-off in {solved.iterations} steps"
    monkeypatch.setattr("isocharge.simulate.solver.newton.ROUND_OFF", 0.0)
    with pytest.raises(SolveError, match=message):
        press(*scene)


def test_start_with_nan_fails(film):
    """The press is then solved with increasing forces, with the same result."""
    good, bad = (press(film, CIRCLE, (0.0, 0.0), 1.0) for _ in range(2))
    bad.field[0, 2] = np.nan
    solved = press(film, CIRCLE, (0.0, 0.0), 1.0, start=bad)
    assert solved.message.endswith("the load in parts")
    np.testing.assert_allclose(solved.field, good.field, atol=1e-6)


def test_load_steps_end_when_the_full_force_is_out_of_reach(film, monkeypatch):
    """Every second solve fails. If all twelve forces were tried, a film that wrinkles would take a minute."""
    field = press(film, CIRCLE, (0.0, 0.0), 1.0).field
    statuses = []

    def every_second_solve(*_):
        statuses.append("converged" if len(statuses) % 2 else "failed")
        return NewtonResult(field=field, status=statuses[-1], message="", iterations=1, residual=1.0)

    monkeypatch.setattr("isocharge.simulate.solver.press.solve_newton", every_second_solve)
    with pytest.raises(SolveError):
        press(film, CIRCLE, (0.0, 0.0), 1.0)
    assert len(statuses) == 5


WRINKLES = r"no equilibrium at .* N, position \(.*\) mm: .* it wrinkles, which has many solutions; press farther"


def test_wrinkling_film_raises_solve_error(film, monkeypatch):
    """The message mentions the compression near the rim and of a slack film, but not at the centre of a flat film."""
    monkeypatch.setattr("isocharge.simulate.solver.newton.MAX_ITERATIONS", 2)
    mesh = SolveSettings(theory=FULL, resolution=Resolution(5, 8, 6, 1))
    with pytest.raises(SolveError, match=WRINKLES):
        press(film, CIRCLE, (0.0, 42.0), 5.0, mesh)
    with pytest.raises(SolveError, match=r"it wrinkles, .* with more force, or give the film a pretension"):
        press(replace(film, pretension=-2.0), CIRCLE, (10.0, 0.0), 0.05, mesh)
    with pytest.raises(SolveError, match=r"after 4 steps$"):
        press(film, CIRCLE, (0.0, 0.0), 5.0, mesh)
