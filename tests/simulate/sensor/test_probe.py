"""Footprints and their notation."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, Polygon, Probe, parse_probe

SIZES = st.floats(0.05, 1e6)
COMMON = settings(derandomize=True)
HOUSE = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 2.0), (0.0, 1.0)])


@pytest.mark.parametrize(
    ("text", "radius"),
    [("circle:1", 1.0), ("circle:.5", 0.5), ("circle:2.", 2.0), ("circle:5e-1", 0.5), (" circle:1.5@-12.5 ", 1.5)],
)
def test_circle(text, radius):
    assert parse_probe(text) == Circle(radius)


@pytest.mark.parametrize(
    ("text", "outline"),
    [
        ("rectangle:4.0x2.0", [2 + 1j, -2 + 1j, -2 - 1j, 2 - 1j]),
        ("rectangle:4x2@90", [-1 + 2j, -1 - 2j, 1 - 2j, 1 + 2j]),
        ("triangle:3", [np.sqrt(3) * 1j, -1.5 - np.sqrt(3) / 2 * 1j, 1.5 - np.sqrt(3) / 2 * 1j]),
        ("triangle:3@-30", np.sqrt(3) * np.exp(2j * np.pi * np.array([1, 3, 5]) / 6)),
        ("polygon:0,0;3,0;0,3", [-1 - 1j, 2 - 1j, -1 + 2j]),
        ("polygon:-1,-1;1,-1;1,1;-1,1@45", np.sqrt(2) * np.array([-1j, 1, 1j, -1])),
    ],
)
def test_corners(text, outline):
    """About the centroid, anticlockwise, rotated by the angle after the @."""
    np.testing.assert_allclose(parse_probe(text).outline, outline, atol=1e-12)


def again(probe: Probe) -> Probe:
    """Written and read; the angle is not part of the notation."""
    return parse_probe(f"{probe.notation}@{np.rad2deg(probe.angle):.15g}")


@given(width=SIZES, height=SIZES, angle=st.floats(-10.0, 10.0))
@COMMON
def test_round_trip(width, height, angle):
    """To twelve digits, and stable: reading and writing again changes nothing."""
    for probe in (Polygon.rectangle(width, height, angle), Polygon.triangle(width, angle), Circle(width)):
        read = again(probe)
        assert read.notation == probe.notation
        assert read.reach == pytest.approx(probe.reach, rel=1e-11)
        if isinstance(probe, Polygon):
            np.testing.assert_allclose(read.outline, probe.outline, rtol=0.0, atol=1e-10 * probe.reach)


def test_notation_is_in_mm():
    probes = Circle(0.3), Polygon.rectangle(4.0, 2.0, 1.0), Polygon.triangle(4.0), parse_probe("polygon:0,0;3,0;0,3")
    three = "polygon:-1.0,-1.0;2.0,-1.0;-1.0,2.0"
    assert [probe.notation for probe in probes] == ["circle:0.3", "rectangle:4.0x2.0", "triangle:4.0", three]


@pytest.mark.parametrize(
    "text",
    ["", "circle:", "circle:1x2", "circle:1.0mm", "Circle:1", "circle:1@", "circle:nan", "1.0",
     "rectangle:4", "rectangle:4X2", "triangle:4x2", "polygon:1,2", "polygon:0,0;1,0;1", "square:1"],
)  # fmt: skip
def test_wrong_notation_is_shown(text):
    with pytest.raises(SceneError, match=f"probe '{text}': expected 'circle:R', 'rectangle:WxH', 'triangle:S'"):
        parse_probe(text)


NEARLY = st.from_regex(r"(circle|rectangle|triangle|polygon):[0-9.,;x@e+-]{0,14}", fullmatch=True)


@given(text=st.text(max_size=12) | NEARLY)
@COMMON
def test_any_text_is_a_probe_or_a_scene_error(text):
    with suppress(SceneError):
        assert parse_probe(text).reach > 0.0


CORNERS = "expected 3 to 64 corners"


@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        *((Circle, size, f"radius: expected at least 0.02 mm, got {size:g} mm") for size in (0.0, np.nan, np.inf)),
        *((Polygon.triangle, size, "side: expected at least 0.001 mm, got") for size in (0.0, -1.0, np.nan, np.inf)),
        (Circle, 1e-3, r"radius: expected at least 0\.02 mm, got 0\.001 mm; 0\.001 m are 1 mm"),
        (Polygon.triangle, 3e-3, r"reach: expected at least 0\.02 mm, got 0\.0017.* mm; .* are 1\.7.* mm"),
        (parse_probe, "circle:-1", "^probe radius: expected at least 0.02 mm, got -1 mm$"),
        (parse_probe, "rectangle:4x-1", "^probe height: expected at least 0.001 mm, got -1 mm"),
        (parse_probe, "triangle:1e999", "^probe side: expected at least 0.001 mm, got inf mm"),
        (parse_probe, "polygon:0,0;0,0;0,0", "convex polygon"),
        (parse_probe, "polygon:0,0;1e999,0;0,1", CORNERS),
        (Polygon.of, HOUSE[::-1], r"convex polygon with its corners anticlockwise, got \[\["),
        (Polygon.of, np.array([(0, 0), (2, 0), (0.5, 0.5), (0, 2)]), "convex polygon"),
        (Polygon.of, np.array([(0, 0), (1, 0), (2, 0), (0, 1)]), "convex polygon"),
        (Polygon.of, np.array([(0, 0), (1, 0), (1, 0), (0, 1)]), "convex polygon"),
        (Polygon.of, np.array([(np.cos(a), np.sin(a)) for a in 0.8 * np.pi * np.arange(5)]), "convex polygon"),
        (Polygon.of, HOUSE[:2], CORNERS),
        (Polygon.of, np.array([(0, 0), (1, 0), (np.nan, 1)]), CORNERS),
        (Polygon.of, np.stack([np.cos(np.arange(65) / 11), np.sin(np.arange(65) / 11)], axis=1), CORNERS),
        (Polygon, tuple(map(tuple, HOUSE.tolist())), r"corners relative to their centroid, got .*; use Polygon\.of"),
        (Polygon.triangle(1.0).rotated, np.nan, "probe angle: expected a finite number, got nan"),
    ],
)
def test_impossible_probes(make, given, message):
    """Sizes in metres among them: the message names the likely value."""
    with pytest.raises(SceneError, match=message):
        make(given)


@pytest.mark.parametrize(
    ("probe", "area", "reach", "period"),
    [
        (Circle(2.0), 4.0 * np.pi, 2.0, 0.0),
        (Polygon.rectangle(4.0, 2.0), 8.0, np.sqrt(5.0), np.pi),
        (Polygon.rectangle(2.0, 2.0), 4.0, np.sqrt(2.0), np.pi / 2),
        (Polygon.triangle(2.0), np.sqrt(3.0), 2.0 / np.sqrt(3.0), 2 * np.pi / 3),
        (Polygon.of(HOUSE), 3.0, None, 2 * np.pi),
    ],
)
def test_measures(probe, area, reach, period):
    """Closed forms; a rotation changes none of them, one by the period not even the outline, as a set of corners."""
    assert (probe.area, probe.period) == pytest.approx((area, period), rel=1e-12)
    assert reach is None or probe.reach == pytest.approx(reach, rel=1e-12)
    rotated = probe.rotated(0.3)
    assert (rotated.area, rotated.reach, rotated.period) == (probe.area, probe.reach, probe.period)
    if isinstance(probe, Polygon):
        full = probe.rotated(probe.period).outline
        assert np.abs(full[:, None] - probe.outline).min(axis=0).max() < 1e-12 * probe.reach
        np.testing.assert_allclose(rotated.outline, probe.outline * np.exp(0.3j), atol=1e-15)
