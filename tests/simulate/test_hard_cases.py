"""Presses from the whole range of the simulator. Each converges, or the error states why it has no solution."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from isocharge.common.errors import SceneError, SolveError
from isocharge.simulate import (
    Circle,
    Film,
    Polygon,
    Resolution,
    SolveSettings,
    deflection,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.solver.error_estimate import estimated_error

REASONS = (
    r"press at .* too near .*; press farther inside",
    r"force .* stretches a film of .* beyond small strains",
    r"no equilibrium at .* N, position .*: .*; the film is compressed to -.* MPa on the way: it wrinkles",
)
"""Messages of permitted errors: a press near the rim, large strains, and wrinkles."""


CASES = [
    (Film(45.0, 0.19727, 3000.0, 0.1026), Circle(4.39), (5.424, -12.738), 3.364),
    (Film(45.0, 0.96129, 3000.0, 0.2322), Circle(5.6275), (-24.4025, 16.1429), 3.78),
    (Film(45.0, 0.52162, 3000.0, 0.1104, 9.157), Polygon.rectangle(0.5874, 0.4585, 0.033), (-9.985, 28.849), 4.683e-4),
    (Film(45.0, 0.02007, 3000.0, 0.3583, 8.317), Circle(0.59075), (40.5557, -12.3005), 9.626e-4),
]
"""Film, probe, position, mm, and force, N. Some presses are close to the rim."""


@pytest.mark.first_cases(2)
@pytest.mark.parametrize(("film", "probe", "at", "force"), CASES)
def test_hard_cases_converge_or_raise_a_clear_error(film, probe, at, force):
    try:
        solved = press(film, probe, at, force)
    except (SceneError, SolveError) as error:
        if not any(re.match(reason, str(error)) for reason in REASONS):
            raise
        return
    assert solved.status == "converged"
    assert solved.residual <= 1e-7 or "round-off" in solved.message
    assert np.isfinite(solved.field).all()
    read_charges = partial(touch_charge, replace(load_sensor("four-25um-uniaxial"), film=film))
    assert np.isfinite(read_charges(solved)).all()
    assert deflection(solved, np.array([at]))[0] > 0.0
    assert 0.0 <= estimated_error(solved, read_charges) < 0.2


def test_more_force_is_advised_on_a_slack_film_and_stretches_it(monkeypatch):
    monkeypatch.setattr("isocharge.simulate.solver.newton.MAX_ITERATIONS", 6)  # no number suffices for 0.05 N
    film = Film(45.0, 0.025, 3000.0, 0.34, -2.0)
    mesh = SolveSettings(resolution=Resolution(4, 8, 5))
    with pytest.raises(SolveError, match=r"it wrinkles, .* with more force, or give the film a pretension"):
        press(film, Circle(1.0), (10.0, 0.0), 0.05, mesh)
    assert press(film, Circle(1.0), (10.0, 0.0), 0.5, mesh).status == "converged"
