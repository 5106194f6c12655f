"""Folds, ambiguous pairs and working areas of synthetic charge maps with known folds, and of built-in sensors."""

import re
from dataclasses import replace

import numpy as np
import pytest

from function_map import FOLD_X, FunctionMap, folded_map, shaped_charges
from isocharge.common.errors import SceneError
from isocharge.simulate import (
    ChargeSpline,
    Domain,
    load_sensor,
    noise_model,
    working_area,
)
from isocharge.simulate.forward.charge_map import differences, within
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.working_area import (
    FOLD_WIDTH,
    find_ambiguous_pairs,
    find_folds,
)
from isocharge.simulate.numerics.disk import Rings
from solved_charges import with_squares
from whole_films import part_of

REFERENCE = noise_model("reference")
FORCES = (0.05, 2.0)


def constant(x, _):
    return 0.0 * x


def rising(x, _):
    return x


def folds_of(charge_map, rings=None):
    """Positions on folds at 1 N, shape (n, 2), mm."""
    return find_folds(charge_map, rings or Rings.spread(charge_map.domain.radius), 1.0, REFERENCE)[0]


INNER = ((-0.9, 1.4), (8.7, 11.4), (15.2, -18.1), (-14.7, -5.3))
"""Positions of four electrodes that do not lie on a circle, one of them within the area, mm. There is no fold up to
15 mm."""


@pytest.fixture(scope="module")
def inner(three_map):
    """Charges of square electrodes at the positions `INNER` under small forces."""
    return ChargeSpline.of(part_of(three_map, with_squares(three_map.sensor, *INNER), 4.0, (0.05, 0.06)))


@pytest.mark.parametrize(
    ("charge_map", "axis"),
    [
        (folded_map(), 0),
        (folded_map(constant), 0),  # a fourth charge
        (shaped_charges(lambda x, _: x, lambda _, y: y - y**2 / (2.0 * FOLD_X)), 1),
    ],
)
def test_find_folds_finds_a_known_fold_line(charge_map, axis):
    """Both sides of a line are compared across the line."""
    points = folds_of(charge_map)
    assert len(points) > 50
    assert points[:, axis] == pytest.approx(FOLD_X, abs=0.1)
    assert np.ptp(points[:, 1 - axis]) > 7.0
    assert (np.diff(np.hypot(*points.T)) >= 0.0).all()


def test_find_folds_finds_nothing_without_a_fold_line():
    """A fourth charge distinguishes both sides of the fold line."""
    assert len(folds_of(folded_map(rising))) == 0


def test_find_folds_finds_a_fold_smaller_than_the_rings():
    """The slope of the first charge is negative only within 0.1 mm of a point. The grid has a spacing of 0.2 mm."""
    at = np.array([1.141, 0.974])
    width = 0.1

    def pocket(x, y):
        bump = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2.0 * width**2))
        return x - 2.0 * (x - at[0]) * bump

    model = shaped_charges(pocket, lambda _, y: y)
    points = folds_of(model, Rings.spread(5.0, 25, 40))
    assert np.hypot(*(points - at).T).max() < 2.0 * width


def test_error_does_not_exceed_its_limit_on_finer_rings_within_the_working_area(inner):
    """Beside an electrode within the area, the error may be larger between two rings than on both rings."""
    working = working_area(inner, REFERENCE, search_pairs=False, error=0.3)
    assert limits_at(inner, Rings.spread(working.radius).contacts(0.05), REFERENCE).position.max() <= 0.3
    assert working.radius == pytest.approx(working.error_radius, abs=0.101)


def test_derivative_of_four_charges_is_singular_at_a_point():
    """The cross-cap (u^2, u v, v) loses rank at u = v = 0 and nowhere else (Whitney 1944)."""
    model = shaped_charges(lambda x, _: (x - 1) ** 2, lambda x, y: (x - 1) * (y + 2), lambda _, y: y)
    points = folds_of(model)
    assert len(points)
    assert points == pytest.approx(np.broadcast_to([1.0, -2.0], points.shape), abs=2.0 * FOLD_WIDTH)


def test_find_folds_finds_nothing_in_a_sharply_bent_map():
    """The map is a sheet that is bent around a cylinder with a radius of 0.2 mm.

    Its orientation is reversed at a distance of 0.4 mm, but the map has no fold, and all charges are different.
    """
    bend = 0.2
    model = shaped_charges(lambda x, _: bend * np.cos(x / bend), lambda x, _: bend * np.sin(x / bend), lambda _, y: y)
    for rings in (Rings.spread(0.5, 2, 8), Rings.spread(0.5, 20, 40)):
        assert len(folds_of(within(model, 0.5), rings)) == 0


def test_find_folds_finds_nothing_beside_an_electrode(inner):
    """The orientation seems reversed between rings with a spacing of 0.3 mm, but not between ten times as many."""
    assert len(find_folds(inner, Rings.spread(4.0, 13, 60), 0.05, REFERENCE)[0]) == 0


def test_nearest_fold_agrees_with_signs_of_the_determinant_on_a_fine_grid(three_map):
    """The determinant of J is computed by finite differences on a grid. Folds separate regions of different sign."""
    model = ChargeSpline.of(part_of(three_map, load_sensor("three-25um-uniaxial"), 5.5, FORCES), spacing=0.4)
    steps = 0.1 * np.arange(-38, 39)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    contact = np.stack([x, y, np.full(x.size, 0.316)], axis=1)
    sign = np.sign(np.linalg.det(differences(model.charges, contact, (0.01, 0.01, 1e-3))))
    is_beyond_fold = sign != sign[x.size // 2]
    folds, _ = find_folds(model, Rings.spread(5.5), 0.316, REFERENCE)
    assert np.hypot(*folds[0]) == pytest.approx(np.hypot(x, y)[is_beyond_fold].min(), abs=0.1)


@pytest.mark.parametrize("forces", [FORCES, (0.5, 0.5)])
def test_ambiguous_pairs_are_mirror_images_in_the_fold_line(forces):
    pairs = find_ambiguous_pairs(folded_map(forces=forces), REFERENCE, [0.5], places=400)
    assert pairs.first[:, 0] + pairs.second[:, 0] == pytest.approx(2.0 * FOLD_X, abs=0.5)
    assert pairs.first[:, 1] == pytest.approx(pairs.second[:, 1], abs=0.5)
    assert (pairs.charge_difference < 3.0).all()
    assert np.median(pairs.charge_difference) < 0.01
    assert len(set(pairs.first[:, 0])) == len(pairs) > 20  # several searches find the same mirror image
    assert (np.diff(pairs.outer_radius) >= 0.0).all()


def test_ambiguous_pairs_of_a_small_film_are_those_of_a_large_one():
    large = folded_map()
    small = FunctionMap(
        lambda contact: large.charges(contact * [20.0, 20.0, 1.0]), large.electrodes, Domain(0.25, FORCES)
    )
    pairs = find_ambiguous_pairs(large, REFERENCE, [0.5], places=100)
    small_pairs = find_ambiguous_pairs(small, REFERENCE, [0.5], places=100)
    assert len(pairs) > 0
    found, expected = (20.0 * small_pairs.second[:, :2]) @ [1.0, 1j], pairs.second[:, :2] @ [1.0, 1j]
    np.testing.assert_allclose(np.sort_complex(found.round(5)), np.sort_complex(expected.round(5)), atol=1e-5)


def test_no_ambiguous_pairs_where_a_charge_distinguishes_the_sides():
    assert len(find_ambiguous_pairs(folded_map(rising), REFERENCE, [0.5], places=400)) == 0


def test_fold_line_and_pairs_bound_the_working_area_if_they_are_near_the_centre_at_a_single_force():
    """As on a taut film, the fold moves inwards and outwards again with increasing force."""
    model = folded_map(forces=(0.05, 1.0))

    def moving(contact):
        shift = [FOLD_X - 1.0, 0.0, 0.0] * (abs(contact[:, 2:] - 0.136) < 0.01)
        return model.charges(contact + shift)

    working = working_area(replace(model, function=moving), REFERENCE, error=10.0)
    assert 0.7 < working.radius < working.fold_radius < 1.1 < working.pairs.radius < 2.0
    assert "exceeds 10 mm at 0.136 N" in working.summary


def test_working_area_without_white_noise_raises_scene_error():
    with pytest.raises(SceneError, match="white noise above 0 pC, got that of 'clean'"):
        working_area(folded_map(), noise_model("clean"))


def test_allowed_error_bounds_the_working_area():
    working = working_area(folded_map(), REFERENCE, error=0.2, search_pairs=False)
    assert working.bound == "error"
    [unique_radius] = re.findall(r"Up to (\S+) mm, the charges determine the contact uniquely\.", working.summary)
    assert float(unique_radius) == pytest.approx(FOLD_X, abs=0.11)
    for radius, exceeds in ((working.error_radius, False), (working.error_radius + 0.1, True)):
        contact = Rings.spread(radius, 1, 360).contacts(0.05)
        assert (limits_at(folded_map(), contact, REFERENCE).position.max() > 0.2) == exceeds


def test_where_nothing_ends_it_the_search_does():
    working = working_area(folded_map(radius=1.0), REFERENCE, error=1000.0)
    assert (working.radius, working.bound) == (1.0, "searched")
    assert working.summary.endswith("The search ended at 1 mm.")
