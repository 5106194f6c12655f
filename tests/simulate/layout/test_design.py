"""A whole search, a small one: three electrodes over 4 mm."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SolveError
from isocharge.simulate import ChargeSpline, Domain, ForwardMap, FunctionMap, limits_at
from isocharge.simulate.layout import case as case_module
from isocharge.simulate.layout import design as design_module
from isocharge.simulate.layout import search as search_module
from isocharge.simulate.layout.case import KNOWN, DesignCase, WeightMap
from isocharge.simulate.layout.charge_table import ChargeTable
from isocharge.simulate.layout.design import UNAMBIGUOUS, ambiguities, design
from isocharge.simulate.layout.search import Search, random_layouts
from kept import kept


def case_of(sensor, **changes):
    return DesignCase(sensor, 3, 4.0, nuisances=KNOWN, **changes)


@pytest.fixture(scope="module", autouse=True)
def _rough(tables, sensor):
    """Fewer presses, places and layouts; a table and a film that are solved already, and read by other electrodes."""
    build = ForwardMap.build
    with pytest.MonkeyPatch.context() as patch:
        for module, name, value in (
            (case_module, "CELLS", 10),
            (case_module, "PRESSES", 60),
            (search_module, "STARTS", 3),
            (search_module, "GRID", 12),
        ):
            patch.setattr(module, name, value)
        patch.setattr(ChargeTable, "solve", staticmethod(lambda sensor, *_: tables[sensor.name]))
        patch.setattr(ForwardMap, "build", lambda new, *domain: replace(kept(build, sensor, *domain), sensor=new))
        yield


@pytest.fixture(scope="module")
def found(sensor, _rough):
    return design(case_of(sensor))


@pytest.fixture(scope="module")
def centres(found):
    return np.array([electrode.centre for electrode in found.sensor.electrodes])


def test_three_electrodes_come_to_lie_on_a_wide_triangle(found, centres):
    """On a film that is the same in all directions the best three are symmetric, and farther out than they press."""
    z = centres @ [1.0, 1j]
    assert np.abs(z) == pytest.approx(np.full(3, np.abs(z).mean()), rel=0.1)
    assert np.abs(z).min() > 7.0
    assert np.sort(np.mod(np.angle(z / z[0]), 2.0 * np.pi)) == pytest.approx(2.0 * np.pi / 3.0 * np.arange(3), abs=0.2)
    assert (found.summary, found.unambiguous, found.refused) == (UNAMBIGUOUS, True, 0)


def test_its_errors_are_those_of_the_forward_map(found):
    """Another road: solve the new sensor's forward map, make splines, and take their limits."""
    charges = ChargeSpline.of(ForwardMap.build(found.sensor, found.case.probe, 4.0, (1.0, 1.0)))
    contact = np.column_stack([found.after.presses, np.ones(len(found.after.presses))])
    limits = limits_at(charges, contact, found.case.noise).position
    assert found.after.known == pytest.approx(limits, rel=0.02)
    numbers = found.after.to_dict()["noise_alone"]
    worst, rms = limits.max(), np.sqrt(np.mean(limits**2))
    assert (numbers["worst_mm"], numbers["rms_mm"], found.value) == pytest.approx((worst, rms, worst), rel=5e-3)


def test_no_neighbour_is_much_better(found, centres, tables):
    """Electrodes that are moved a little make the worst error larger, or hardly smaller."""
    search, rng = Search(found.case, tables["four-25um-biaxial"]), np.random.default_rng(0)
    assert all(search.value(centres + rng.uniform(-0.4, 0.4, (3, 2))) > 0.99 * found.value for _ in range(20))


def test_other_goals_are_better_by_their_own_measure(centres, sensor, tables, monkeypatch):
    """The root mean square, plain and of the right half alone."""
    monkeypatch.setattr(search_module, "ROUNDS", 2)
    right = WeightMap("right", np.array([[-4.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 1.0], [4.0, 0.0, 1.0]]))
    for goal in ("rms", right):
        search = Search(case_of(sensor, goal=goal), tables["four-25um-biaxial"])
        start = search.optima(*random_layouts(search.case))[0]
        value, *numbers = search.refine(start)
        best = np.reshape(numbers, (-1, 2))
        assert value == pytest.approx(search.value(best))
        assert value < min(0.95 * search.value(centres), search.value(start))
        assert search.case.spare(best).min() > -1e-3


def test_an_ambiguous_layout_is_refused(sensor, monkeypatch):
    """The next one is taken; where all are ambiguous, the best."""
    answers = iter(["it folds", UNAMBIGUOUS])
    monkeypatch.setattr(Search, "refine", lambda _, places: np.append(places[0, 0], places))
    monkeypatch.setattr(design_module, "ambiguities", lambda *_: next(answers))
    second = design(case_of(sensor))
    monkeypatch.setattr(design_module, "ambiguities", lambda *_: "it folds")
    best = design(case_of(sensor))
    assert (second.unambiguous, second.refused, best.unambiguous, best.refused) == (True, 1, False, 0)
    assert best.value < second.value


def test_what_is_ambiguous_is_said(sensor, monkeypatch):
    """Charges that fold at x = 3 mm, with pairs on both sides; and charges that cannot be interpolated."""

    def charges(contact):
        x, y, force = contact.T
        shapes = np.stack([4.0 + (x - x**2 / 6.0) / 3.0, 4.0 + 0.3 * y, np.full(len(x), 3.0)], axis=1)
        return 300.0 * force[:, None] ** (2.0 / 3.0) * shapes

    monkeypatch.setattr(ForwardMap, "build", lambda *_: FunctionMap(charges, ("A", "B", "C"), Domain(4.0, (0.05, 2.0))))
    monkeypatch.setattr(ChargeSpline, "of", lambda charge_map: charge_map)
    monkeypatch.setattr(design_module, "find_ambiguous_pairs", lambda *_: [1, 2])
    text = "the map folds 3.0 mm from the centre; 6 pairs of contacts have the same charges"
    assert ambiguities(case_of(sensor), sensor) == text

    def refuse(*_):
        raise SolveError("rough")

    monkeypatch.setattr(ForwardMap, "build", refuse)
    assert "could not be looked for" in ambiguities(case_of(sensor), sensor)
