"""Presses from all over what the simulator is made for: each converges, or says precisely why there is no answer."""

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
"""What a refusal may say: the rim, the strains, wrinkles; anything else is a failure of ours."""


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Evenly in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def any_probe(rng: np.random.Generator, size: float) -> Probe:
    """Circle, rectangle, triangle or another convex polygon that reaches up to `size`, turned by any angle."""
    turn, kind = float(rng.uniform(0.0, 2.0 * np.pi)), rng.integers(4)
    if kind == 0:
        return Circle(size)
    if kind == 1:
        share = between(rng, 0.1, 1.0)
        return Polygon.rectangle(2.0 * size / np.hypot(1.0, share), 2.0 * size * share / np.hypot(1.0, share), turn)
    if kind == 2:
        return Polygon.triangle(np.sqrt(3.0) * size, turn)
    gaps = rng.uniform(0.4, 1.0, rng.integers(4, 9))
    angle = 2.0 * np.pi * np.cumsum(gaps) / gaps.sum()
    return Polygon.of(0.8 * size * np.stack([np.cos(angle), np.sin(angle)], axis=1), turn)


def draw(seed: int) -> tuple[Film, Probe, tuple[float, float], float]:
    """5 um to 2 mm thick, pretension up to 20 MPa, Poisson up to 0.49, probe 0.1 to 8 mm, 1e-5 to 10 N, any place."""
    rng = np.random.default_rng([7, seed])
    pretension = 0.0 if rng.random() < 0.4 else between(rng, 0.01, 20.0)
    film = Film(45.0, between(rng, 0.005, 2.0), 3000.0, float(rng.uniform(0.0, 0.49)), pretension)
    probe = any_probe(rng, between(rng, 0.1, 8.0))
    room = film.radius - probe.reach
    distance = room * np.sqrt(rng.random()) if rng.random() < 0.7 else room * (1.0 - between(rng, 1e-3, 0.2))
    z = distance * np.exp(2j * np.pi * rng.random())
    return film, probe, (float(z.real), float(z.imag)), between(rng, 1e-5, 10.0)


def check(seed: int) -> str:
    """What became of a draw: "converged" or the reason; fails on anything that is neither."""
    film, probe, at, force = draw(seed)
    try:
        solved = press(film, probe, at, force)
    except (SceneError, SolveError) as error:
        if not any(re.match(reason, str(error)) for reason in REASONS):
            raise
        return type(error).__name__
    assert solved.status == "converged"
    assert solved.residual <= 1e-7 or "round-off" in solved.message, (seed, solved.residual)
    assert np.isfinite(solved.field).all()
    charge = touch_charge(replace(load_sensor("four-25um-uniaxial"), film=film), solved)
    assert np.isfinite(charge).all()
    assert deflection(solved, np.array([at]))[0] > 0.0
    assert 0.0 <= estimated_error(solved) < 0.2, (seed, estimated_error(solved))
    return "converged"


@pytest.mark.parametrize("seed", [0, 2, 3, 12, 17])
def test_converges_or_says_why(seed):
    check(seed)
