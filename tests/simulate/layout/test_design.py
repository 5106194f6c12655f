"""A whole search, a small one: three electrodes over 4 mm."""

import numpy as np
import pytest

from isocharge.simulate import ChargeSpline, DesignTask, ForwardMap, Nuisances, run_design
from isocharge.simulate.identifiability.layout_assessment import assess_layout
from isocharge.simulate.layout.costs import ErrorMap, rows_of, tolerance_costs, trade_off
from isocharge.simulate.layout.position_error import ErrorModel
from isocharge.simulate.numerics.disk import square_grid
from isocharge.simulate.plots.figure import picture_bytes
from isocharge.simulate.plots.layout_maps import trade_off_picture

KNOWN = Nuisances.none()
SMALL = {"starts": 3, "presses": 50}


@pytest.fixture(scope="module")
def found(sensor):
    return run_design(DesignTask(sensor, 3, 4e-3, nuisances=KNOWN), **SMALL)


def test_three_electrodes_come_to_lie_on_a_wide_triangle(found):
    """On a film that is the same in all directions the best three are symmetric, and farther out than they press."""
    z = found.chosen.centres @ [1.0, 1j]
    assert np.abs(z) == pytest.approx(np.full(3, np.abs(z).mean()), rel=0.1)
    assert np.abs(z).min() > 7e-3
    turns = np.sort(np.mod(np.angle(z / z[0]), 2.0 * np.pi))
    assert turns == pytest.approx([0.0, 2.0 * np.pi / 3.0, 4.0 * np.pi / 3.0], abs=0.1)
    assert found.chosen.unambiguous


def test_its_errors_are_those_of_the_forward_map(found):
    """Another road: solve the written sensor's forward map, make splines, and assess the layout."""
    charges = ChargeSpline.of(ForwardMap.build(found.sensor, found.task.probes[0], 4.2e-3, (0.9, 1.1)))
    other = assess_layout(charges, found.task.noise, radius=4e-3, twins=False)
    ours = ErrorMap.of(found.sensor, found.charges[0], found.task)
    assert ours.noise_alone.max() == pytest.approx(other.worst, rel=5e-3)
    assert np.sqrt(np.mean(ours.noise_alone**2)) == pytest.approx(other.rms, rel=5e-3)
    assert found.chosen.value == pytest.approx(other.worst, rel=5e-3)


def test_no_neighbour_is_much_better(found):
    """Electrodes that are moved a little make the worst error larger, or hardly smaller."""
    at, model = square_grid(4e-3, 0.3e-3), ErrorModel.of(found.task.noise, KNOWN)
    pressed, rng = found.charges[0].under(at), np.random.default_rng(0)

    def worst(centres):
        return np.sqrt(model.squared(pressed.layout(centres, found.chosen.sides)).max())

    here = worst(found.chosen.centres)
    assert all(worst(found.chosen.centres + rng.uniform(-4e-4, 4e-4, (3, 2))) > 0.99 * here for _ in range(20))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_design(sensor, found):
    again = run_design(DesignTask(sensor, 3, 4e-3, nuisances=KNOWN), **SMALL)
    assert again.chosen.centres.tolist() == found.chosen.centres.tolist()


@pytest.mark.slow
def test_electrodes_stay_and_rules_are_kept(sensor):
    """Two electrodes stay; the third one keeps its distance although it may choose its size."""
    task = DesignTask(sensor, 3, 4e-3, keep=("A", "B"), nuisances=KNOWN, side=(2e-3, 3e-3))
    design = run_design(task, starts=2, presses=60)
    stay = {electrode.name: electrode for electrode in sensor.electrodes}
    assert all(design.sensor.electrodes[i] == stay[name] for i, name in enumerate("AB"))
    broken, _ = task.rules.violations(design.chosen.centres, design.chosen.sides)
    assert broken.max() < 1e-6
    rows = rows_of(design.sensor, design.charges[0], square_grid(4e-3, 0.3e-3))
    worst = np.sqrt(ErrorModel.of(task.noise, KNOWN).squared(rows).max())
    assert worst == pytest.approx(design.chosen.value, rel=1e-3)


def test_tolerances_cost_more_the_wider_they_are(found):
    costs = tolerance_costs(found)
    added = [cost.unmeasured for cost in costs]
    assert added == pytest.approx([added[0] * i for i in range(1, 6)])
    assert 0.0 < added[0] < 0.1e-3
    assert costs[0].measured >= 0.98 * found.chosen.value


@pytest.mark.slow
def test_a_trade_off_is_a_table_and_a_picture(sensor, monkeypatch):
    """One radius, one size, the roughest search: the two points are the same task, so the same error."""
    for name, value in {"TRADE_STARTS": 1, "TRADE_PRESSES": 20, "RADII": (1.0,), "SIZES": (1.0,)}.items():
        monkeypatch.setattr(f"isocharge.simulate.layout.costs.{name}", value)
    trade = trade_off(DesignTask(sensor, 3, 4e-3, nuisances=KNOWN), numbers=(3,))
    assert trade.by_number[3] == pytest.approx(trade.by_side)
    assert 0.01 < trade.to_dict()["error_mm_by_electrodes"]["3"][0] < 0.5
    assert picture_bytes(trade_off_picture(trade, "worst", 3e-3)).startswith(b"\x89PNG")
