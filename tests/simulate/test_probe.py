"""The notation of probes."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.errors import SceneError
from isocharge.simulate import Circle, parse_probe


@pytest.mark.parametrize(
    ("text", "radius"),
    [
        ("circle:1.0", 1e-3),
        ("circle:1", 1e-3),
        ("circle:.5", 0.5e-3),
        ("circle:2.", 2e-3),
        ("circle:5e-1", 0.5e-3),
        (" circle:1.5 ", 1.5e-3),
        ("circle:1.0@30", 1e-3),
        ("circle:1.0@-12.5", 1e-3),
    ],
)
def test_notation(text, radius):
    assert parse_probe(text).radius == pytest.approx(radius, rel=1e-12)


@given(radius=st.floats(1e-9, 1e3))
@settings(derandomize=True)
def test_notation_round_trip(radius):
    """To twelve digits, and stable: reading and writing again changes nothing."""
    again = parse_probe(Circle(radius).notation)
    assert again.radius == pytest.approx(radius, rel=1e-11)
    assert again.notation == Circle(radius).notation


def test_notation_is_in_mm():
    assert Circle(1e-3).notation == "circle:1.0"
    assert Circle(0.3e-3).notation == "circle:0.3"


@pytest.mark.parametrize("text", ["rectangle:4.0x2.0", "triangle:4.0", "triangle:4.0@30", "polygon:3"])
def test_other_shapes_are_not_simulated_yet(text):
    with pytest.raises(SceneError, match=f"probe '{text}': this version simulates circles only; use 'circle:R'"):
        parse_probe(text)


@pytest.mark.parametrize(
    "text",
    ["", "circle", "circle:", "circle:1x2", "circle:one", "circle:1.0mm", "Circle:1", "circle:1@", "circle:nan", "1.0"],
)
def test_wrong_notation_is_shown(text):
    with pytest.raises(SceneError, match=f"probe '{text}': expected a notation like 'circle:1.0'"):
        parse_probe(text)


@given(text=st.text(max_size=12))
@settings(derandomize=True)
def test_any_text_is_a_probe_or_a_scene_error(text):
    with suppress(SceneError):
        assert parse_probe(text).radius > 0.0


@pytest.mark.parametrize("radius", [0.0, -1e-3, np.nan, np.inf])
def test_impossible_radius(radius):
    with pytest.raises(SceneError, match=f"probe radius: expected a positive number, got {radius}"):
        Circle(radius)


def test_impossible_radius_in_the_notation():
    with pytest.raises(SceneError, match="probe radius"):
        parse_probe("circle:0")
    with pytest.raises(SceneError, match="probe radius"):
        parse_probe("circle:1e999")
