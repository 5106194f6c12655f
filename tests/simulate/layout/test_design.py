"""Complete design of a small layout with three electrodes for presses within 4 mm."""

import re

import numpy as np
import pytest

from function_map import folded_map
from isocharge.common.errors import SolveError
from isocharge.simulate import ForwardMap, limits_at
from isocharge.simulate.layout import case as case_module
from isocharge.simulate.layout import design as design_module
from isocharge.simulate.layout.case import NO_NUISANCES, DesignCase
from isocharge.simulate.layout.design import (
    UNAMBIGUOUS,
    Layout,
    Search,
    describe_ambiguities,
    design,
    random_layouts,
)
from whole_films import build_from_default_map

FORCES = (0.5, 2.0)


def case_of(sensor, **changes):
    return DesignCase(sensor, 3, 4.0, nuisances=NO_NUISANCES, **changes)


@pytest.fixture(scope="module", autouse=True)
def _rough(fields):
    """Fewer presses, forces and layouts, and stress fields and a forward map that have already been solved."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name, value in (
            (case_module, "FINE_PRESSES", 100),
            (case_module, "SEARCH_PRESSES", 24),
            (design_module, "STARTS", 2),
            (design_module, "ROUNDS", 2),
            (design_module, "DEFAULT_FORCE_RANGE", FORCES),
        ):
            patch.setattr(module, name, value)
        patch.setattr(design_module, "solve_fields", lambda sensor, *_: fields[sensor.name])
        patch.setattr(ForwardMap, "build", build_from_default_map)
        yield


@pytest.fixture(scope="module")
def found(sensor, _rough):
    return design(case_of(sensor))


@pytest.fixture(scope="module")
def centres(found):
    return np.array([electrode.centre for electrode in found.sensor.electrodes])


def test_three_electrodes_form_an_equilateral_triangle(found, centres):
    """On an isotropic film the best layout is symmetric, and its electrodes lie farther out than the presses."""
    z = centres @ [1.0, 1j]
    assert np.abs(z) == pytest.approx(np.full(3, np.abs(z).mean()), rel=0.1)
    assert np.abs(z).min() > 7.0
    assert np.sort(np.mod(np.angle(z / z[0]), 2.0 * np.pi)) == pytest.approx(2.0 * np.pi / 3.0 * np.arange(3), abs=0.2)
    assert (found.summary, found.unambiguous, found.n_rejected) == (UNAMBIGUOUS, True, 0)


def test_errors_agree_with_the_limits_of_the_forward_map(found):
    """The limits are computed independently from the forward map of the new sensor."""
    forward_map = ForwardMap.build(found.sensor, found.case.probe, 4.0, FORCES)
    contact = np.column_stack([found.errors_after.presses, np.ones(len(found.errors_after.presses))])
    limits = limits_at(forward_map, contact, found.case.noise).position
    assert found.errors_after.noise_alone == pytest.approx(limits, rel=0.02)
    numbers = found.errors_after.to_dict()["noise_alone"]
    worst, rms = limits.max(), np.sqrt(np.mean(limits**2))
    assert (numbers["worst_mm"], numbers["rms_mm"]) == pytest.approx((worst, rms), rel=5e-3)


def test_no_neighbouring_layout_is_better_by_more_than_one_percent(found, centres, fields):
    """Small random moves of the electrodes do not reduce the largest error noticeably."""
    search, rng = Search(found.case, fields["four-25um-biaxial"]), np.random.default_rng(0)
    smallest = found.errors_after.with_nuisances.max()
    assert all(search.errors(centres + rng.uniform(-0.4, 0.4, (3, 2))).max() > 0.99 * smallest for _ in range(10))


def test_goal_rms_reduces_the_root_mean_square(centres, sensor, fields):
    search = Search(case_of(sensor, goal="rms"), fields["four-25um-biaxial"])
    start = random_layouts(search.case)[0]
    found = search.refine(search.optimum(start))
    squared_errors = [np.mean(search.errors(positions) ** 2) for positions in (found.positions, centres, start)]
    assert found.error == pytest.approx(np.sqrt(squared_errors[0]))
    assert squared_errors[0] <= min(squared_errors[1:])
    assert search.case.all_clearances(found.positions).min() > -1e-3


@pytest.mark.parametrize(("count", "side"), [(8, 13.0), (4, 20.0)])
def test_large_squares_are_placed_farther_from_the_centre(count, side, sensor):
    case = DesignCase(sensor, count, 8.0, side=side)
    assert min(case.all_clearances(positions).min() for positions in random_layouts(case)) >= 0.0


@pytest.fixture
def _random_layouts(monkeypatch):
    """Do not improve the random layouts."""
    monkeypatch.setattr(Search, "optimum", lambda search, start: Layout(start, search.errors(start).max()))
    monkeypatch.setattr(Search, "refine", lambda _, layout: layout)


@pytest.mark.usefixtures("_random_layouts")
def test_ambiguous_layout_is_rejected_for_the_next_one(sensor, monkeypatch):
    """If all layouts are ambiguous, the one with the smallest error is returned."""
    answers = iter(["it folds", UNAMBIGUOUS])
    monkeypatch.setattr(design_module, "describe_ambiguities", lambda *_: next(answers))
    second = design(case_of(sensor, seed=1))
    monkeypatch.setattr(design_module, "describe_ambiguities", lambda *_: "it folds")
    best = design(case_of(sensor, seed=1))
    assert (second.unambiguous, second.n_rejected, best.unambiguous, best.n_rejected) == (True, 1, False, 0)
    assert best.errors_after.with_nuisances.max() < second.errors_after.with_nuisances.max()


def test_ambiguities_reports_folds_and_pairs(sensor):
    text = describe_ambiguities(case_of(sensor), folded_map(radius=4.0))
    assert re.fullmatch(r"the map folds 3.0 mm from the centre; \d+ pairs of contacts have the same charges", text)


@pytest.mark.usefixtures("_random_layouts")
def test_design_reports_why_ambiguities_cannot_be_looked_for(sensor, monkeypatch):
    def refuse(*_, **__):
        raise SolveError("no equilibrium at 0.05 N")

    monkeypatch.setattr(ForwardMap, "build", refuse)
    found = design(case_of(sensor))
    assert found.summary == "folds and ambiguous pairs could not be looked for: no equilibrium at 0.05 N"
    assert not found.unambiguous
