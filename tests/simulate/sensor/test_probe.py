"""Notation of probes: parsing, writing and error messages."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, Ellipse, Finger, GrowingFinger, Polygon, Probe, parse_probe

SIZES = st.floats(0.02, 1e6)
COMMON = settings(derandomize=True)
HOUSE = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 2.0), (0.0, 1.0)])


@pytest.mark.parametrize(
    ("text", "radius"),
    [("circle:1", 1.0), ("circle:.5", 0.5), ("circle:5e-1", 0.5), (" circle:1.5@-12.5 ", 1.5)],
)
def test_parse_probe_reads_circles(text, radius):
    assert parse_probe(text) == Circle(radius)


@pytest.mark.parametrize(
    ("text", "outline"),
    [
        ("triangle:3", [np.sqrt(3) * 1j, -1.5 - np.sqrt(3) / 2 * 1j, 1.5 - np.sqrt(3) / 2 * 1j]),
        ("polygon:-1,-1;1,-1;1,1;-1,1@45", np.sqrt(2) * np.array([-1j, 1, 1j, -1])),
    ],
)
def test_parse_probe_reads_the_corners_of_polygons(text, outline):
    """Corners are relative to the centroid, anticlockwise and rotated by the angle after the @."""
    np.testing.assert_allclose(parse_probe(text).outline, outline, atol=1e-12)


def parsed_again(probe: Probe) -> Probe:
    """Return the probe that is parsed from the notation and the angle of a probe."""
    return parse_probe(f"{probe.notation}@{np.rad2deg(probe.angle):.15g}")


@given(width=SIZES, height=SIZES, angle=st.floats(-10.0, 10.0))
@COMMON
def test_notation_round_trip(width, height, angle):
    """Parsing the notation of a probe returns the probe to twelve digits."""
    for probe in (
        Polygon.rectangle(width, height, angle),
        Polygon.triangle(width, angle),
        Circle(width),
        Finger(width),
        GrowingFinger(width),
        Ellipse(width, height, angle),
    ):
        read = parsed_again(probe)
        assert read.notation == probe.notation
        assert read.reach == pytest.approx(probe.reach, rel=1e-11)
        np.testing.assert_allclose(read.outline, probe.outline, rtol=0.0, atol=1e-10 * probe.reach)
        read = parse_probe(probe.rotated_notation)  # with six digits of the rotation
        np.testing.assert_allclose(read.outline, probe.outline, rtol=0.0, atol=2e-5 * probe.reach)


@pytest.mark.parametrize(
    "text",
    ["", "circle:1x2", "circle:1.0mm", "Circle:1", "circle:1@", "circle:nan", "rectangle:4X2", "polygon:0,0;1,0;1"],
)  # fmt: skip
def test_error_message_shows_the_wrong_notation(text):
    with pytest.raises(SceneError, match=f"probe '{text}': expected 'circle:RADIUS', 'rectangle:WIDTHxHEIGHT',"):
        parse_probe(text)


NEARLY = st.from_regex(r"(circle|ellipse|rectangle|triangle|polygon):[0-9.,;x@e+-]{0,14}", fullmatch=True)


@given(text=st.text(max_size=12) | NEARLY)
@COMMON
def test_any_text_is_a_probe_or_a_scene_error(text):
    with suppress(SceneError):
        assert parse_probe(text).reach > 0.0


CORNERS = "expected 3 to 64 corners"


@pytest.mark.timeout(10)
@pytest.mark.parametrize("end", ["", "!"])
def test_thousands_of_corners_are_refused_at_once(end):
    """The regular expression reads each number in one way only, so a wrong end is found without trying others."""
    with pytest.raises(SceneError, match="probe") as caught:
        parse_probe("polygon:0,0" + ";10,10;20,30" * 5_000 + end)
    assert len(str(caught.value)) < 1_000


@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        *((Circle, size, f"radius: expected at least 0.02 mm, got {size:g} mm") for size in (0.0, np.nan, np.inf)),
        (Circle, 1e-3, r"radius: expected at least 0\.02 mm, got 0\.001 mm; 0\.001 m are 1 mm"),
        (parse_probe, "polygon:0,0;.01,0;0,.01", r"diameter: expected at least 0\.02 mm, got 0\.0149"),
        (Polygon.of, HOUSE[::-1], r"convex polygon with its corners anticlockwise, got \[\["),
        (Polygon.of, np.array([(0, 0), (2, 0), (0.5, 0.5), (0, 2)]), "convex polygon"),
        (Polygon.of, np.array([(0, 0), (1, 0), (2, 0), (0, 1)]), "convex polygon"),
        (Polygon.of, HOUSE[:2], CORNERS),
        (Polygon.triangle(1.0).rotated, np.nan, "probe angle: expected a finite number, got nan"),
        (parse_probe, "ellipse:-1x2", "^probe width: expected at least 0.02 mm, got -1 mm"),
    ],
)
def test_impossible_probes_raise_scene_error(make, given, message):
    """For sizes that are probably in metres, the message gives the size in mm."""
    with pytest.raises(SceneError, match=message):
        make(given)
