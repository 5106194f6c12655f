"""Union, intersection, validity and trapezoids of polygons, compared with point-in-polygon tests by matplotlib."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path

from isocharge.simulate.numerics.polygon import area_of, to_corners
from isocharge.simulate.numerics.polygon_union import is_simple, trace_outline, union_parts

GRID = np.stack(np.meshgrid(np.linspace(-4.0, 4.0, 97), np.linspace(-4.0, 4.0, 101)), axis=-1).reshape(-1, 2) + 1e-3 / 7
COMB = np.array([0, 7, 7 + 2j, 6 + 2j, 6 + 1j, 5 + 1j, 5 + 2j, 4 + 2j, 4 + 1j, 3 + 1j, 3 + 3j, 1 + 3j, 1 + 1j, 1j])
SQUARE = np.array([0, 4, 4 + 4j, 4j])
SQUARE_WITH_HOLE = np.array([0, 4, 4 + 4j, 4j, 0, 1 + 1j, 1 + 3j, 3 + 3j, 3 + 1j, 1 + 1j])
"""Square with a square hole, drawn as one line that runs twice along the cut between the two squares."""


@st.composite
def star_polygons(draw) -> np.ndarray:
    """A polygon with dents: corners at random distances about a random centre."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    angle = 2.0 * np.pi * (np.arange(draw(st.integers(5, 12))) + rng.uniform(0.0, 0.5)) / 12
    centre = complex(*rng.uniform(-1.0, 1.0, 2))
    return centre + rng.uniform(0.3, 2.0, angle.size) * np.exp(1j * angle)


def area(z: np.ndarray) -> float:
    return area_of(to_corners(z))


def total_area(polygons) -> float:
    return sum(area(z) for z in polygons)


def count_containing(polygons, points: np.ndarray) -> np.ndarray:
    """Number of polygons that contain each point."""
    count = np.zeros(len(points), dtype=int)
    for z in polygons:
        count += Path(to_corners(z)).contains_points(points)
    return count


@given(
    front=st.lists(star_polygons().filter(is_simple), min_size=1, max_size=3), back=star_polygons().filter(is_simple)
)
@settings(derandomize=True, deadline=None, max_examples=40)
def test_trapezoids_cover_each_point_of_the_union_and_intersection_once(front, back):
    in_front = count_containing(front, GRID) > 0
    in_back = count_containing([back], GRID) > 0
    np.testing.assert_array_equal(count_containing(union_parts(front), GRID), in_front)
    np.testing.assert_array_equal(count_containing(union_parts(front, [back]), GRID), in_front & in_back)


def test_union_area_agrees_with_monte_carlo():
    rng = np.random.default_rng(3)
    angle = 2.0 * np.pi * np.arange(60) / 60
    star = (1.0 + 0.3 * np.cos(7.0 * angle)) * np.exp(1j * angle)
    polygons = [star, star + 0.7, 0.8j + 1.3 * star]
    points = rng.uniform(-3.0, 3.0, (200_000, 2))
    inside = count_containing(polygons, points) > 0
    standard_error = 36.0 * inside.std() / np.sqrt(len(points))
    assert total_area(union_parts(polygons)) == pytest.approx(36.0 * inside.mean(), abs=4.0 * standard_error)


@pytest.mark.parametrize("rotation", [1.0, np.exp(1j)], ids=["edges along the axes", "rotated by 1 rad"])
def test_comb_is_simple_and_covers_its_area(rotation):
    assert is_simple(COMB * rotation)
    assert not is_simple(COMB[::-1] * rotation)
    assert total_area(union_parts([COMB * rotation])) == pytest.approx(7.0 + 1.0 + 1.0 + 4.0, rel=1e-12)


@pytest.mark.parametrize(
    ("polygons", "expected"),
    [
        pytest.param([SQUARE, SQUARE + 4.0], 32.0, id="common edge"),
        pytest.param([SQUARE, SQUARE + (4.0 + 4.0j)], 32.0, id="common corner"),
        pytest.param([SQUARE, SQUARE + (2.0 + 2.0j)], 28.0, id="overlapping"),
        pytest.param([SQUARE, SQUARE], 16.0, id="identical"),
        pytest.param([SQUARE, SQUARE + 10.0], 32.0, id="separate"),
        pytest.param([SQUARE_WITH_HOLE], 12.0, id="hole"),
        pytest.param([SQUARE_WITH_HOLE, 2.0 + 2.0j + 0.25 * (SQUARE - 2.0 - 2.0j)], 13.0, id="island in a hole"),
    ],
)
def test_union_area_in_closed_form(polygons, expected):
    assert total_area(union_parts(polygons)) == pytest.approx(expected, rel=1e-12)


def test_intersection_of_polygons_that_only_touch_is_empty():
    assert union_parts([SQUARE], [SQUARE + 4.0]) == []
    assert union_parts([SQUARE], [SQUARE + 10.0]) == []


@pytest.mark.parametrize(
    ("corners", "expected"),
    [
        pytest.param([0, 1 + 1j, 2, 2 + 2j, 1 + 1j, 2j], True, id="touches itself at a point"),
        pytest.param([0, 4, 4 + 4j, 2, 4j], True, id="corner touches an edge"),
        pytest.param(SQUARE_WITH_HOLE, True, id="touches itself along an edge"),
        pytest.param([0, 1, 1, 1 + 1j, 1j], True, id="double corner"),
        pytest.param([0, 1 + 1j, 1, 1j], False, id="bow tie"),
        pytest.param(np.exp(4j * np.pi * np.arange(5) / 5), False, id="pentagram"),
        pytest.param(SQUARE[::-1], False, id="clockwise"),
        pytest.param([0, 1, 2], False, id="on one line"),
        pytest.param(np.zeros(4), False, id="a single point"),
    ],
)
def test_is_simple_of_polygons_that_touch_or_cross_themselves(corners, expected):
    assert is_simple(np.array(corners, dtype=complex)) is expected


def test_trace_outline_has_the_given_width_and_mitred_bends():
    outline = trace_outline(np.array([0.0, 4.0, 4.0 + 3.0j, 8.0 + 6.0j]), 0.5)
    np.testing.assert_allclose(area(outline), 0.5 * 12.0, rtol=1e-12)
    np.testing.assert_allclose(outline[[1, -2]], [4.25 - 0.25j, 3.75 + 0.25j], atol=1e-12)
