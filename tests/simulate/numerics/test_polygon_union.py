"""Union, intersection, validity and triangles of polygons, compared with closed forms."""

import numpy as np
import pytest

from isocharge.simulate.numerics.polygon import (
    area_of,
    is_simple,
    to_corners,
    trace_outline,
    union_triangles,
)

SQUARE = np.array([0, 4, 4 + 4j, 4j])
SQUARE_WITH_HOLE = np.array([0, 4, 4 + 4j, 4j, 0, 1 + 1j, 1 + 3j, 3 + 3j, 3 + 1j, 1 + 1j])
"""Square with a square hole, drawn as one line that runs twice along the cut between the two squares."""


def area(z: np.ndarray) -> float:
    return area_of(to_corners(z))


def total_area(front, back=()) -> float:
    """Area of the parts of a union of polygons x + iy."""
    parts = union_triangles(*([to_corners(z) for z in polygons] for polygons in (front, back)))
    return sum(area_of(part) for part in parts)


UNIONS = {
    "common edge": ([SQUARE, SQUARE + 4.0], 32.0),
    "common corner": ([SQUARE, SQUARE + (4.0 + 4.0j)], 32.0),
    "overlapping": ([SQUARE, SQUARE + (2.0 + 2.0j)], 28.0),
    "identical": ([SQUARE, SQUARE], 16.0),
    "separate": ([SQUARE, SQUARE + 10.0], 32.0),
    "hole": ([SQUARE_WITH_HOLE], 12.0),
    "island in a hole": ([SQUARE_WITH_HOLE, 2.0 + 2.0j + 0.25 * (SQUARE - 2.0 - 2.0j)], 13.0),
}
"""Polygons, and the area of their union."""


@pytest.mark.parametrize(("polygons", "expected"), UNIONS.values(), ids=UNIONS)
def test_union_area_in_closed_form(polygons, expected):
    assert total_area(polygons) == pytest.approx(expected, rel=1e-12)


def test_intersection_of_polygons_that_only_touch_is_empty():
    assert total_area([SQUARE], [SQUARE + 4.0]) == 0.0
    assert total_area([SQUARE], [SQUARE + 10.0]) == 0.0


@pytest.mark.parametrize("corners", [[0, 9, 4 + 7j], [0, 0.3, 20 + 5j], [0, 20, 20 + 5j, 5 + 5j, 5 + 20j, 20j]])
def test_triangles_with_divided_outlines_are_small_and_cover_the_polygon(corners):
    parts = union_triangles([to_corners(np.array(corners))], max_side=3.0)
    assert sum(area_of(part) for part in parts) == pytest.approx(area(np.array(corners)), rel=1e-12)
    assert all(area_of(part) > 0.0 for part in parts)
    assert max(np.ptp(part, axis=0).max() for part in parts) <= 6.0


POLYGONS = {
    "touches itself at a point": ([0, 1 + 1j, 2, 2 + 2j, 1 + 1j, 2j], True),
    "corner touches an edge": ([0, 4, 4 + 4j, 2, 4j], True),
    "touches itself along an edge": (SQUARE_WITH_HOLE, True),
    "double corner": ([0, 1, 1, 1 + 1j, 1j], True),
    "small and far from the origin": (4000.0 + 6000.3j + 0.01 * np.array([0, 2, 2 + 2j, 2j]), True),
    "bow tie": ([0, 1 + 1j, 1, 1j], False),
    "pentagram": (np.exp(4j * np.pi * np.arange(5) / 5), False),
    "clockwise": (SQUARE[::-1], False),
    "on one line": ([0, 1, 2], False),
    "a single point": (np.zeros(4), False),
}
"""Corners of polygons, and whether the polygon is simple."""


@pytest.mark.parametrize(("corners", "expected"), POLYGONS.values(), ids=POLYGONS)
def test_is_simple_of_polygons_that_touch_or_cross_themselves(corners, expected):
    assert is_simple(to_corners(np.array(corners, dtype=complex))) is expected


def test_trace_outline_has_the_given_width_and_mitred_bends():
    outline = trace_outline(np.array([0.0, 4.0, 4.0 + 3.0j, 8.0 + 6.0j]), 0.5)
    np.testing.assert_allclose(area(outline), 0.5 * 12.0, rtol=1e-12)
    np.testing.assert_allclose(outline[[1, -2]], [4.25 - 0.25j, 3.75 + 0.25j], atol=1e-12)
