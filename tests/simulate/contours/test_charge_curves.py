"""Charge curves against direct presses and numpy's polynomials; the scheme against the paper's numbers."""

import numpy as np
import pytest

from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate import (
    Circle,
    ForwardMap,
    Resolution,
    SolveSettings,
    Theory,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.contours.charge_curves import Curves, Mapping

SENSOR = load_sensor("three-25um-biaxial")
MEMBRANE = Theory(stretching=True, bending=False, pretensioned=False)
DEG = np.pi / 180.0


@pytest.fixture(scope="module")
def film() -> ForwardMap:
    return ForwardMap.build(
        SENSOR, Circle(1.0), 17.0, (1.0, 1.0), SolveSettings(theory=MEMBRANE, resolution=Resolution(5, 8, 5))
    )


def test_the_papers_scheme():
    """Fig. 6: 35, 45, ..., 85 and 90 degrees, every 4 mm."""
    mapping = Mapping.lines(SENSOR, "A", (35 * DEG, 90 * DEG))
    np.testing.assert_allclose(mapping.angle / DEG, [35, 45, 55, 65, 75, 85, 90])
    np.testing.assert_allclose(mapping.distance, [4.0, 8.0, 12.0, 16.0, 20.0])
    np.testing.assert_allclose(mapping.points[6, 2], [0.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(mapping.points - [0.0, -10.0], axis=2), np.tile(mapping.distance, (7, 1)))


def test_without_angles_lines_go_to_both_sides_of_the_centre():
    mapping = Mapping.lines(SENSOR, "B")
    middle = mapping.angle[len(mapping.angle) // 2]
    assert middle / DEG == pytest.approx(210.0, abs=1e-4)
    np.testing.assert_allclose(mapping.angle - middle, -(mapping.angle - middle)[::-1], atol=1e-12)


def test_curves_are_presses(film):
    curves = Curves.of(film, Mapping.lines(SENSOR, "A", (35 * DEG, 90 * DEG), length=16.0), 1.0)
    for line, step in ((0, 0), (3, 1), (6, 3)):
        at = tuple(curves.mapping.points[line, step])
        direct = touch_charge(SENSOR, press(SENSOR.film, Circle(1.0), at, 1.0, SolveSettings(theory=MEMBRANE)))
        np.testing.assert_allclose(curves.charge[line, step], direct, rtol=2e-3)
    np.testing.assert_array_equal(curves.own, curves.charge[..., 0])


def test_lines_of_a_mirror_image_are_mirrored(film):
    """B and C lie symmetric about the y axis, and so does a circle."""
    b = Curves.of(film, Mapping.lines(SENSOR, "B", (150 * DEG, 270 * DEG), length=12.0), 1.0)
    c = Curves.of(film, Mapping.lines(SENSOR, "C", (-90 * DEG, 30 * DEG), length=12.0), 1.0)
    np.testing.assert_allclose(b.own, c.own[::-1], rtol=1e-5)


def test_polynomials_are_numpys(film):
    curves = Curves.of(film, Mapping.lines(SENSOR, "A", (40 * DEG, 80 * DEG), length=16.0), 1.0)
    for line, polynomial in zip(curves.own, curves.polynomials(2), strict=True):
        expected = np.polyval(np.polyfit(curves.mapping.distance, line, 2), [5.0, 13.0])
        np.testing.assert_allclose(polynomial(np.array([5.0, 13.0])), expected, rtol=1e-9)
    with pytest.raises(SceneError, match="degree: expected 1 to 3 for 4 presses on a line, got 4"):
        curves.polynomials(4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"angles": (90 * DEG, 35 * DEG)}, "expected MIN <= MAX, got 90 to 35 degrees"),
        ({"angles": (np.nan, 1.0)}, "expected MIN <= MAX"),
        ({"angle_step": 0.0}, "expected a positive number, got 0 degrees"),
        ({"step": 0.0}, "0 < step <= length, got a step of 0 mm"),
        ({"step": 30.0}, "a step of 30 mm and lines of 20 mm"),
        ({"step": 1e-6}, "at most 100000 presses"),
        ({"electrode": "E"}, "no electrode 'E' on three-25um-biaxial: it has A, B, C"),
    ],
)
def test_impossible_lines_are_refused(change, message):
    with pytest.raises((SceneError, SensorError), match=message):
        Mapping.lines(SENSOR, **{"electrode": "A"} | change)
