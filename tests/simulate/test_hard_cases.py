"""Random presses from the whole range of the simulator. Each converges, or the error states why it has no solution."""

import re
from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError, SolveError
from isocharge.simulate import Circle, Film, Polygon, Probe, deflection, load_sensor, press, touch_charge
from isocharge.simulate.solver.error_estimate import estimated_error

REASONS = (
    r"press at .* too near .*; press farther inside",
    r"force .* stretches a film of .* beyond small strains",
    r"no equilibrium at .* N, position .*: .*; the film is compressed to -.* MPa on the way: it wrinkles",
)
"""Messages of permitted errors: a press near the rim, large strains, and wrinkles."""


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number that is uniformly distributed in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_probe(rng: np.random.Generator) -> Probe:
    """Draw a circle, rectangle, triangle or polygon that reaches 0.1 to 8 mm."""
    reach = log_uniform(rng, 0.1, 8.0)
    kind = rng.integers(4)
    rotation = rng.uniform(0.0, 2.0 * np.pi)
    if kind == 0:
        return Circle(reach)
    if kind == 1:
        diagonal_angle = rng.uniform(0.1, 0.7853)
        length = 2.0 * reach * np.cos(diagonal_angle)
        width = 2.0 * reach * np.sin(diagonal_angle)
        return Polygon.rectangle(length, width, rotation)
    if kind == 2:
        return Polygon.triangle(np.sqrt(3.0) * reach, rotation)
    gaps = rng.uniform(0.3, 1.0, rng.integers(4, 9))
    angle = 2.0 * np.pi * np.cumsum(gaps) / gaps.sum()
    corners = 0.8 * reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Polygon.of(corners, rotation)


def draw(number: int) -> tuple[Film, Probe, tuple[float, float], float]:
    """Draw a press: film, probe, position, mm, and force, N. It depends on the number only.

    The film has a radius of 45 mm. Two of five films are slack, and one press of seven is close to the rim.
    """
    rng = np.random.default_rng([7, number])
    pretension = 0.0 if rng.random() < 0.4 else log_uniform(rng, 0.01, 20.0)
    thickness = log_uniform(rng, 0.005, 2.0)
    poisson = float(rng.uniform(0.0, 0.49))
    film = Film(45.0, thickness, 3000.0, poisson, pretension)
    probe = draw_probe(rng)
    largest_distance = film.radius - probe.reach
    if rng.random() < 0.85:
        distance = largest_distance * np.sqrt(rng.random())
    else:
        distance = largest_distance * (1.0 - log_uniform(rng, 1e-3, 0.2))
    position = distance * np.exp(2j * np.pi * rng.random())
    force = log_uniform(rng, 1e-5, 10.0)
    return film, probe, (float(position.real), float(position.imag)), force


@pytest.mark.first_cases(3)
@pytest.mark.parametrize("number", [3, 12, 21, 0, 17])
def test_hard_cases_converge_or_raise_a_clear_error(number):
    film, probe, at, force = draw(number)
    try:
        solved = press(film, probe, at, force)
    except (SceneError, SolveError) as error:
        if not any(re.match(reason, str(error)) for reason in REASONS):
            raise
        return
    assert solved.status == "converged"
    assert solved.residual <= 1e-7 or "round-off" in solved.message
    assert np.isfinite(solved.field).all()
    charge = touch_charge(replace(load_sensor("four-25um-uniaxial"), film=film), solved)
    assert np.isfinite(charge).all()
    assert deflection(solved, np.array([at]))[0] > 0.0
    assert 0.0 <= estimated_error(solved) < 0.2
