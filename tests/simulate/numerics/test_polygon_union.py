"""Unions of polygons with dents: which points lie in them says matplotlib."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path

from isocharge.simulate.numerics.polygon import area_of, to_corners
from isocharge.simulate.numerics.polygon_union import is_simple, pieces, trace_outline, union_parts

GRID = np.stack(np.meshgrid(np.linspace(-4.0, 4.0, 97), np.linspace(-4.0, 4.0, 101)), axis=-1).reshape(-1, 2) + 1e-3 / 7
COMB = np.array([0, 7, 7 + 2j, 6 + 2j, 6 + 1j, 5 + 1j, 5 + 2j, 4 + 2j, 4 + 1j, 3 + 1j, 3 + 3j, 1 + 3j, 1 + 1j, 1j])


@st.composite
def stars(draw) -> np.ndarray:
    """A polygon with dents: corners at random distances about a place."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    angle = 2.0 * np.pi * (np.arange(draw(st.integers(5, 12))) + rng.uniform(0.0, 0.5)) / 12
    return complex(*rng.uniform(-1.0, 1.0, 2)) + rng.uniform(0.3, 2.0, angle.size) * np.exp(1j * angle)


def area(z: np.ndarray) -> float:
    return area_of(to_corners(z))


def count_inside(polygons) -> np.ndarray:
    """How many polygons each point of the grid lies in."""
    return np.sum([Path(to_corners(z)).contains_points(GRID) for z in polygons] or [np.zeros(len(GRID))], axis=0)


@given(polygons=st.lists(stars().filter(is_simple), min_size=1, max_size=3), back=stars().filter(is_simple))
@settings(derandomize=True, deadline=None, max_examples=40)
def test_parts_cover_the_union_once(polygons, back):
    """Cut in pieces, whose sides are short and whose areas add up, or not; alone or where there is something behind."""
    parts, union, behind = union_parts(polygons), count_inside(polygons) > 0, count_inside([back]) > 0
    np.testing.assert_array_equal(count_inside(parts), union)
    np.testing.assert_array_equal(count_inside(union_parts(polygons, [back])), union & behind)
    short = [piece for part in parts for piece in pieces(part, 0.5)]
    assert sum(map(area, short)) == pytest.approx(sum(map(area, parts)), rel=1e-9)
    assert max(np.abs(np.roll(piece, -1) - piece).max() for piece in short) <= 0.5 + 1e-9


@pytest.mark.parametrize("turn", [1.0, np.exp(1j)])
def test_a_comb_covers_its_area(turn):
    """Edges in one line; turned by one radian no edge is level."""
    assert is_simple(COMB * turn)
    assert not is_simple(COMB[::-1] * turn)
    assert sum(map(area, union_parts([COMB * turn]))) == pytest.approx(7.0 + 1.0 + 1.0 + 4.0, rel=1e-12)


def test_a_trace_is_as_wide_as_said_beyond_its_bends():
    outline = trace_outline(np.array([0.0, 4.0, 4.0 + 3.0j, 8.0 + 6.0j]), 0.5)
    np.testing.assert_allclose(area(outline), 0.5 * 12.0, rtol=1e-12)
    np.testing.assert_allclose(outline[[1, -2]], [4.25 - 0.25j, 3.75 + 0.25j], atol=1e-12)
