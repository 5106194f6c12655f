"""Properties that every probe shape must have, compared with closed forms, grids of points and polygons."""

from typing import NamedTuple

import numpy as np
import pytest
import shapely
from tests.simulate.sensor.test_probe import HOUSE

from isocharge.simulate import (
    Circle,
    Ellipse,
    Finger,
    GrowingFinger,
    Polygon,
    Probe,
    SolveSettings,
    Theory,
    load_sensor,
)
from isocharge.simulate.numerics.polygon import area_of, to_corners
from solved_charges import solved_charge

SENSOR = load_sensor("three-25um-biaxial")
MEMBRANE = Theory(bending=False)


class ShapeCase(NamedTuple):
    """A probe and its measures in closed form.

    Attributes:
        probe: The probe.
        area: Area, mm^2.
        reach: Distance of the farthest point from the centroid, mm.
        period: Smallest rotation that maps the footprint onto itself, rad.
    """

    probe: Probe
    area: float
    reach: float
    period: float


SHAPES = {
    "circle": ShapeCase(Circle(2.0), 4.0 * np.pi, 2.0, 0.0),
    "rectangle": ShapeCase(Polygon.rectangle(4.0, 2.0, 0.5), 8.0, np.sqrt(5.0), np.pi),
    "square": ShapeCase(Polygon.rectangle(2.0, 2.0), 4.0, np.sqrt(2.0), np.pi / 2),
    "triangle": ShapeCase(Polygon.triangle(2.0), np.sqrt(3.0), 2.0 / np.sqrt(3.0), 2 * np.pi / 3),
    "polygon": ShapeCase(Polygon.of(HOUSE), 3.0, np.sqrt(130.0) / 9.0, 2 * np.pi),
    "ellipse": ShapeCase(Ellipse(4.0, 2.0, 0.5), 2.0 * np.pi, 2.0, np.pi),
    "finger": ShapeCase(Finger(2.0), 4.0 * np.pi, 2.0, 0.0),
    "growing finger": ShapeCase(GrowingFinger(2.0), 4.0 * np.pi, 2.0, 0.0),
}


@pytest.fixture(params=SHAPES.values(), ids=SHAPES)
def shape(request):
    return request.param


def boundary_points(probe, count):
    """Return the corners of a polygon, or points of a curve at evenly spaced parameters, shape (n,), mm."""
    if not probe.topology.is_curved:
        return probe.outline
    return probe.boundary(2.0 * np.pi * np.arange(count) / count)


def grid_in(probe: Probe, count: int = 801) -> np.ndarray:
    """Return the points of a square grid that lie in the footprint, shape (n,), mm."""
    line = 1.01 * probe.reach * np.linspace(-1.0, 1.0, count)
    points = (line[:, None] + 1j * line).ravel()
    footprint = shapely.Polygon(to_corners(boundary_points(probe, 4000)))
    shapely.prepare(footprint)  # old versions of shapely are very slow otherwise
    return points[shapely.contains_xy(footprint, points.real, points.imag)]


def test_area_reach_and_period_are_the_closed_forms(shape):
    assert (shape.probe.area, shape.probe.period) == pytest.approx((shape.area, shape.period), rel=1e-12)
    assert shape.probe.reach == pytest.approx(shape.reach, rel=1e-12)


def test_core_of_a_curved_footprint_has_the_rotational_symmetry_of_the_footprint():
    class Trefoil(Ellipse):
        period = 2.0 * np.pi / 3.0

    assert Trefoil(4.0, 4.0).topology.n_corner == 3


def test_farthest_distance_is_that_of_the_farthest_boundary_point(shape):
    at = (5.0, -3.0)
    expected = np.abs(complex(*at) + boundary_points(shape.probe, 20000)).max()
    assert shape.probe.farthest_distance(at) == pytest.approx(expected, rel=3e-5)


def test_mean_of_the_relative_pressure_is_one_and_its_centre_is_the_centroid(shape):
    inside = grid_in(shape.probe)
    pressure = shape.probe.pressure(inside)
    assert pressure.mean() == pytest.approx(1.0, rel=5e-3)
    assert abs((pressure * inside).mean()) < 5e-3 * shape.reach


def test_force_share_of_a_triangle_is_that_of_a_grid(shape):
    """The triangle is the part below two lines through the footprint."""
    at = 0.3 - 0.2j
    size = 10.0 * shape.reach
    corners = np.array([(at.real - size, at.imag - size), (at.real + size, at.imag - size), (at.real, at.imag + 0.2)])
    inside = grid_in(shape.probe)
    pressure = shape.probe.pressure(inside)
    below = inside.imag < np.interp(inside.real, [-size, 0.0, size], [-size, 0.2, -size])
    expected = pressure[below].sum() / pressure.sum()
    assert shape.probe.force_share(corners, at) == pytest.approx(expected, abs=3e-3)


UNIFORM_CURVED = {
    name: shape for name, shape in SHAPES.items() if shape.probe.topology.is_curved and shape.probe.has_uniform_pressure
}


@pytest.mark.parametrize("shape", UNIFORM_CURVED.values(), ids=UNIFORM_CURVED)
def test_curved_probe_has_the_charges_of_a_polygon_with_many_corners(shape):
    """The corners lie on the boundary, and the polygon is enlarged to the area of the footprint."""
    corners = to_corners(boundary_points(shape.probe, 24))
    polygon = Polygon.of(corners * np.sqrt(shape.area / area_of(corners)))
    settings = SolveSettings(theory=MEMBRANE)
    curved_charge = solved_charge(SENSOR, shape.probe, (5.0, 3.0), 1.0, settings)
    polygon_charge = solved_charge(SENSOR, polygon, (5.0, 3.0), 1.0, settings)
    np.testing.assert_allclose(curved_charge, polygon_charge, rtol=3e-4)
