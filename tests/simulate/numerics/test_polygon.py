"""Areas and centroids of polygons, and their overlaps, compared with closed forms and with properties of areas."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from isocharge.simulate.numerics.polygon import area_in_disk, is_convex, to_corners

COMMON = settings(derandomize=True, deadline=None, max_examples=40)


@st.composite
def convex(draw) -> np.ndarray:
    """A convex polygon with anticlockwise corners x + iy: the hull of random points."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    points = draw(st.floats(0.05, 2.0)) * rng.standard_normal((draw(st.integers(4, 12)), 2)) + rng.uniform(-1, 1, 2)
    return points[ConvexHull(points).vertices] @ np.array([1.0, 1.0j])


@given(a=convex(), x=st.floats(-2, 2), y=st.floats(-2, 2), radius=st.floats(1e-3, 3.0))
@COMMON
def test_area_in_a_disk_is_the_limit_of_areas_in_polygons(a, x, y, radius):
    corners = to_corners(a)
    assert is_convex(corners)
    assert not is_convex(corners[::-1])
    disk = shapely.Point(x, y).buffer(radius, quad_segs=1000)
    common = shapely.intersection(shapely.Polygon(corners), disk).area
    assert area_in_disk(a, complex(x, y), radius) == pytest.approx(common, abs=5e-6 * np.pi * radius**2)


@pytest.mark.parametrize(
    "corners",
    [
        [0, 1, 2, 2 + 1j, 1j],  # straight corner
        [0, 1, 1 + 1j, 0.5 + 0.2j, 1j],  # reentrant corner
        [0, 1, 1, 1j],
        np.exp(0.8j * np.pi * np.arange(5)),  # it turns left at every corner, but it crosses itself
    ],
)
def test_polygon_is_not_convex(corners):
    assert not is_convex(to_corners(np.array(corners)))
