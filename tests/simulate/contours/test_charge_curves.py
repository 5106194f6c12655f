"""Charge curves against direct presses and numpy's polynomials; the scheme against the paper's numbers."""

import json

import numpy as np
import pytest

from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate import (
    Circle,
    Curves,
    ForwardMap,
    Mapping,
    Resolution,
    SolveSettings,
    Theory,
    load_sensor,
    press,
    touch_charge,
)

SENSOR = load_sensor("three-25um-biaxial")
MEMBRANE = Theory(stretching=True, bending=False, pretensioned=False)
DEG = np.pi / 180.0


@pytest.fixture(scope="module")
def film() -> ForwardMap:
    return ForwardMap.build(
        SENSOR, Circle(1e-3), 17e-3, (1.0, 1.0), SolveSettings(theory=MEMBRANE, resolution=Resolution(5, 8, 5))
    )


def test_the_papers_scheme():
    """Fig. 6: 35, 45, ..., 85 and 90 degrees, every 4 mm."""
    mapping = Mapping.lines(SENSOR, "A", (35 * DEG, 90 * DEG))
    np.testing.assert_allclose(mapping.angle / DEG, [35, 45, 55, 65, 75, 85, 90])
    np.testing.assert_allclose(mapping.distance, [4e-3, 8e-3, 12e-3, 16e-3, 20e-3])
    np.testing.assert_allclose(mapping.points[6, 2], [0.0, 2e-3], atol=1e-15)
    np.testing.assert_allclose(
        np.linalg.norm(mapping.points - [0.0, -10e-3], axis=2), np.tile(mapping.distance, (7, 1))
    )


def test_without_angles_lines_go_to_both_sides_of_the_centre():
    mapping = Mapping.lines(SENSOR, "B")
    middle = mapping.angle[len(mapping.angle) // 2]
    assert middle / DEG == pytest.approx(210.0, abs=1e-4)
    np.testing.assert_allclose(mapping.angle - middle, -(mapping.angle - middle)[::-1], atol=1e-12)


def test_curves_are_presses(film):
    curves = Curves.of(film, Mapping.lines(SENSOR, "A", (35 * DEG, 90 * DEG), length=16e-3), 1.0)
    for line, step in ((0, 0), (3, 1), (6, 3)):
        at = tuple(curves.mapping.points[line, step])
        direct = touch_charge(SENSOR, press(SENSOR.film, Circle(1e-3), at, 1.0, SolveSettings(theory=MEMBRANE)))
        np.testing.assert_allclose(curves.charge[line, step], direct, rtol=2e-3)
    np.testing.assert_array_equal(curves.own, curves.charge[..., 0])


def test_curves_as_json_are_in_mm_and_pC(film):
    curves = Curves.of(film, Mapping.lines(SENSOR, "B", (200 * DEG, 220 * DEG), length=8e-3), 1.0)
    report = json.loads(json.dumps(curves.to_dict()))
    assert list(report) == ["electrode", "probe", "force_N", "lines"]
    assert (report["electrode"], report["probe"], report["force_N"]) == ("B", "circle:1.0", 1.0)
    assert [line["angle_deg"] for line in report["lines"]] == pytest.approx([200.0, 210.0, 220.0])
    for number, line in enumerate(report["lines"]):
        assert list(line) == ["angle_deg", "distance_mm", "x_mm", "y_mm", "charge_pC"]
        assert line["distance_mm"] == pytest.approx([4.0, 8.0])
        np.testing.assert_allclose(np.transpose([line["x_mm"], line["y_mm"]]), 1e3 * curves.mapping.points[number])
        np.testing.assert_allclose(list(line["charge_pC"].values()), 1e12 * curves.charge[number].T)
        assert list(line["charge_pC"]) == ["A", "B", "C"]


def test_charge_falls_with_the_distance(film):
    curves = Curves.of(film, Mapping.lines(SENSOR, "C", length=12e-3), 1.0)
    assert np.all(np.diff(curves.own, axis=1) < 0.0)


def test_lines_of_a_mirror_image_are_mirrored(film):
    """B and C lie symmetric about the y axis, and so does a circle."""
    b = Curves.of(film, Mapping.lines(SENSOR, "B", (150 * DEG, 270 * DEG), length=12e-3), 1.0)
    c = Curves.of(film, Mapping.lines(SENSOR, "C", (-90 * DEG, 30 * DEG), length=12e-3), 1.0)
    np.testing.assert_allclose(b.own, c.own[::-1], rtol=1e-5)


def test_polynomials_are_numpys(film):
    curves = Curves.of(film, Mapping.lines(SENSOR, "A", (40 * DEG, 80 * DEG), length=16e-3), 1.0)
    for line, polynomial in zip(curves.own, curves.polynomials(2), strict=True):
        expected = np.polyval(np.polyfit(curves.mapping.distance * 1e3, line * 1e12, 2), [5.0, 13.0])
        np.testing.assert_allclose(1e12 * polynomial(np.array([5e-3, 13e-3])), expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"angles": (90 * DEG, 35 * DEG)}, "expected MIN <= MAX, got 90 to 35 degrees"),
        ({"angles": (np.nan, 1.0)}, "expected MIN <= MAX"),
        ({"angle_step": 0.0}, "expected a positive number, got 0 degrees"),
        ({"step": 0.0}, "0 < step <= length, got a step of 0 mm"),
        ({"step": 30e-3}, "a step of 30 mm and lines of 20 mm"),
        ({"step": 1e-9}, "at most 100000 presses"),
    ],
)
def test_impossible_lines_are_refused(change, message):
    with pytest.raises(SceneError, match=message):
        Mapping.lines(SENSOR, "A", **change)


def test_unknown_electrode_is_named():
    with pytest.raises(SensorError, match=r"no electrode 'E' on three-25um-biaxial: it has A, B, C"):
        Mapping.lines(SENSOR, "E")


def test_too_few_presses_for_a_polynomial(film):
    curves = Curves.of(film, Mapping.lines(SENSOR, "A", (40 * DEG, 80 * DEG), length=12e-3), 1.0)
    with pytest.raises(SceneError, match="degree: expected 1 to 2 for 3 presses on a line, got 3"):
        curves.polynomials(3)


def test_map_that_does_not_cover_the_lines_says_so(film):
    with pytest.raises(SceneError, match="outside the forward map"):
        Curves.of(film, Mapping.lines(SENSOR, "A"), 1.0)
