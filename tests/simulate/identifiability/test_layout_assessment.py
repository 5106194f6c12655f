"""Layouts over a disk: limits on a grid, with nuisances, folds and ambiguous pairs."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import (
    ChargeSpline,
    Circle,
    Domain,
    Electrode,
    ForwardMap,
    FunctionMap,
    limits_at,
    load_sensor,
    noise_model,
)
from isocharge.simulate.identifiability.layout_assessment import assess_layout

REFERENCE = noise_model("reference")


def four_charges(extra: float = 0.3) -> FunctionMap:
    """Three charges that fold at x = 3 mm; the fourth rises with x by so much (1/mm)."""

    def charge(contact):
        x, y, force = contact.T
        columns = [3.0 + (x - x**2 / 6.0) / 3.0, 3.0 + 0.3 * y, np.full(len(x), 3.0), 3.0 + extra * x]
        return 300.0 * force[:, None] ** (2.0 / 3.0) * np.stack(columns, axis=1)

    return FunctionMap(charge, ("A", "B", "C", "D"), Domain(5.0, (0.05, 2.0)))


def test_limits_on_a_square_grid():
    model = four_charges()
    assessed = assess_layout(model, REFERENCE, radius=4.0, forces=(0.1, 1.0), spacing=0.5)
    steps = 0.5 * np.arange(-8, 9)
    inside = sum(np.hypot(x, y) <= 4.0 for x in steps for y in steps)
    assert assessed.position.shape == (inside, 2)
    assert assessed.limit.shape == assessed.relative_force.shape == (2, inside)
    contact = np.column_stack([assessed.position, np.full(inside, 1.0)])
    np.testing.assert_allclose(assessed.limit[1], limits_at(model, contact, REFERENCE).position)
    np.testing.assert_allclose(assessed.relative_force[1], limits_at(model, contact, REFERENCE).force)
    assert assessed.rms == pytest.approx(np.sqrt((assessed.limit**2).mean()))
    assert assessed.determined
    assert (assessed.fold_radius, assessed.pairs.radius) == (np.inf, np.inf)
    assert not replace(assessed, error=0.9 * assessed.limit.max()).determined


def test_folds_and_pairs_count_only_within_the_radius():
    wide, narrow = (assess_layout(four_charges(0.0), REFERENCE, radius=radius) for radius in (4.5, 2.5))
    assert wide.fold_radius == pytest.approx(3.0, abs=0.05)
    assert wide.pairs.radius < 4.5
    assert not wide.determined
    assert "folds 3.0 mm" in wide.summary
    assert "same charges" in wide.summary
    assert narrow.determined
    assert not len(narrow.folds)
    assert not len(assess_layout(four_charges(0.0), REFERENCE, search_pairs=False).pairs)


def test_nuisances_raise_the_limit():
    def gains(contact):
        return 0.002 * np.eye(4) * four_charges().charges(contact)[:, :, None]

    alone = assess_layout(four_charges(), REFERENCE, radius=2.0, search_pairs=False)
    unknown = assess_layout(four_charges(), REFERENCE, radius=2.0, search_pairs=False, nuisance=gains)
    assert (unknown.limit > 1.2 * alone.limit).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"radius": 6.0}, "expected up to the charge map's 5 mm, got 6 mm"),
        ({"forces": (3.0,)}, "expected 0.05 to 2 N"),
        ({"forces": ()}, "expected at least one force"),
    ],
)
def test_what_the_charges_do_not_cover_is_refused(words, message):
    with pytest.raises(SceneError, match=message):
        assess_layout(four_charges(), REFERENCE, **words)


def test_fewer_than_three_charges_are_refused():
    two = replace(four_charges(), electrodes=("A", "B"))
    with pytest.raises(SceneError, match="at least three electrodes, got 2"):
        assess_layout(two, REFERENCE)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(
    ("places", "worst", "rms"),
    [
        (((3.9, -14.5), (10.4, 10.7), (-14.2, 3.8)), 0.129, 0.088),
        (((0.5, -14.1), (-5.1, 6.3), (-0.2, -0.3), (8.6, 1.1)), 0.099, 0.043),
        pytest.param(((0.0, -10.0), (8.660254, 5.0), (-8.660254, 5.0)), 0.239, 0.091, marks=pytest.mark.slow),
        pytest.param(((10.0, 0.0), (0.0, 10.0), (-10.0, 0.0), (0.0, -10.0)), 0.098, 0.046, marks=pytest.mark.slow),
    ],
    ids=["three, free", "four, free", "three on a circle", "four on a circle"],
)
def test_layouts_whose_limits_are_known(film, places, worst, rms):
    """Within 8 mm at 1 N, from an independent search over layouts; the worst depends on the grid by 4 %."""
    electrodes = [Electrode.of_square(name, place, 3.0) for name, place in zip("ABCD", places, strict=False)]
    layout = replace(film, sensor=replace(film.sensor, electrodes=tuple(electrodes)))
    assessed = assess_layout(ChargeSpline.of(layout), REFERENCE)
    assert assessed.worst == pytest.approx(worst, rel=0.04)
    assert assessed.rms == pytest.approx(rms, rel=0.015)
    assert assessed.determined


@pytest.fixture(scope="module")
def film():
    return ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1.0), 8.0)
