"""A whole search, a small one: three electrodes over 4 mm."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from isocharge.simulate import ForwardMap
from isocharge.simulate.identifiability.layout_assessment import assess_layout
from isocharge.simulate.layout import case as case_module
from isocharge.simulate.layout import search as search_module
from isocharge.simulate.layout.case import KNOWN, DesignCase, WeightMap
from isocharge.simulate.layout.design import design
from isocharge.simulate.layout.search import Search, random_layouts


def case_of(sensor, **changes):
    return DesignCase(sensor, 3, 4.0, nuisances=KNOWN, **changes)


@pytest.fixture(scope="module", autouse=True)
def _coarse():
    """A quarter of the presses of the fine grid, and of the random layouts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(case_module, "CELLS", 25)
        patch.setattr(search_module, "STARTS", 6)
        yield


@pytest.fixture(scope="module")
def found(sensor, _coarse):
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
    assert found.unambiguous


def test_its_errors_are_those_of_the_forward_map(found):
    """Another road: solve the new sensor's forward map, make splines, and assess the layout."""
    forward_map = ForwardMap.build(found.sensor, found.case.probe, 4.0, (0.9, 1.1))
    other = assess_layout(forward_map, found.case.noise, spacing=0.16, search_pairs=False)
    assert found.after.known.max() == pytest.approx(other.worst, rel=5e-3)
    assert np.sqrt(np.mean(found.after.known**2)) == pytest.approx(other.rms, rel=5e-3)
    assert found.value == pytest.approx(other.worst, rel=5e-3)


def test_no_neighbour_is_much_better(found, centres, tables):
    """Electrodes that are moved a little make the worst error larger, or hardly smaller."""
    search, rng = Search(found.case, tables["four-25um-biaxial"]), np.random.default_rng(0)
    assert all(search.value(centres + rng.uniform(-0.4, 0.4, (3, 2))) > 0.99 * found.value for _ in range(20))


def test_other_goals_are_better_by_their_own_measure(centres, sensor, tables):
    """The root mean square, plain and of the right half alone."""
    right = WeightMap("right", np.array([[-4.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 1.0], [4.0, 0.0, 1.0]]))
    for goal in ("rms", right):
        search = Search(case_of(sensor, goal=goal), tables["four-25um-biaxial"])
        best = search.refine(search.optima(*random_layouts(search.case))[0])
        assert search.value(best) < 0.95 * search.value(centres)
        assert search.case.spare(best).min() > -1e-3


@pytest.mark.slow
def test_the_same_seed_gives_the_same_design_on_any_executor(sensor, found):
    with ThreadPoolExecutor(2) as executor:
        assert design(case_of(sensor), executor=executor).to_dict() == found.to_dict()
