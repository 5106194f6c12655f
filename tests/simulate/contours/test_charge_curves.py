"""Charge curves compared with direct solves and with polynomials of NumPy, and lines compared with the paper."""

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
from kept import kept

SENSOR = load_sensor("three-25um-biaxial")
MEMBRANE = Theory(stretching=True, bending=False, pretensioned=False)
DEG = np.pi / 180.0


@pytest.fixture(scope="module")
def film() -> ForwardMap:
    settings = SolveSettings(theory=MEMBRANE, resolution=Resolution(4, 8, 4))
    return kept(ForwardMap.build, SENSOR, Circle(1.0), 9.0, (1.0, 1.0), settings)


def test_mapping_lines_follow_the_scheme_of_the_paper():
    """The lines of Fig. 6 have angles of 35, 45, ..., 85 and 90 degrees, and presses every 4 mm."""
    mapping = Mapping.lines(SENSOR, "A", (35 * DEG, 90 * DEG))
    np.testing.assert_allclose(mapping.angle / DEG, [35, 45, 55, 65, 75, 85, 90])
    np.testing.assert_allclose(mapping.distance, [4.0, 8.0, 12.0, 16.0, 20.0])
    np.testing.assert_allclose(mapping.points[6, 2], [0.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(mapping.points - [0.0, -10.0], axis=2), np.tile(mapping.distance, (7, 1)))


def test_curves_are_the_charges_of_presses(film):
    curves = Curves.of(film, Mapping.lines(SENSOR, "A", (60 * DEG, 90 * DEG), length=16.0), 1.0)
    for line, step in ((0, 0), (3, 3)):
        at = tuple(curves.mapping.points[line, step])
        direct = touch_charge(SENSOR, press(SENSOR.film, Circle(1.0), at, 1.0, SolveSettings(theory=MEMBRANE)))
        np.testing.assert_allclose(curves.charge[line, step], direct, rtol=2e-3)
    np.testing.assert_array_equal(curves.own_charge, curves.charge[..., 0])


def test_polynomials_agree_with_numpy(film):
    curves = Curves.of(film, Mapping.lines(SENSOR, "A", (60 * DEG, 90 * DEG), length=16.0), 1.0)
    for line, polynomial in zip(curves.own_charge, curves.polynomials(2), strict=True):
        expected = np.polyval(np.polyfit(curves.mapping.distance, line, 2), [5.0, 13.0])
        np.testing.assert_allclose(polynomial(np.array([5.0, 13.0])), expected, rtol=1e-9)
    with pytest.raises(SceneError, match="degree: expected 1 to 3 for 4 presses on a line, got 4"):
        curves.polynomials(4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"angles": (90 * DEG, 35 * DEG)}, "expected first <= last angle .*, got 90 to 35 degrees"),
        ({"angles": (np.nan, 1.0)}, "expected first <= last angle"),
        ({"angle_step": 0.0}, "degrees in steps of 0"),
        ({"step": 0.0}, "0 < step <= length, got .* in steps of 0 mm"),
        ({"step": 30.0}, "lines of 20 mm in steps of 30 mm"),
        ({"electrode": "E"}, "no electrode 'E' on three-25um-biaxial: it has A, B, C"),
    ],
)
def test_impossible_mapping_lines_raise_scene_error(change, message):
    with pytest.raises((SceneError, SensorError), match=message):
        Mapping.lines(SENSOR, **{"electrode": "A"} | change)
