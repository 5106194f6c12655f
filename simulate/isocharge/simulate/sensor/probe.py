"""List of all probe shapes, and a parser for the notation of probes on the command line and in files.

Examples of the notation:

    circle:1.0             radius
    ellipse:4.0x2.0        axes along x and y
    rectangle:4.0x2.0      sides along x and y
    triangle:4.0           side of an equilateral triangle with one corner towards +y
    polygon:x,y;x,y;x,y    corners of a convex polygon, anticlockwise
    finger:6.0             radius of the contact area of a fingertip
    growing-finger:6.0     radius at 1 N of a contact area that grows with the cube root of the force

All lengths are in mm. The suffix `@30` rotates the footprint by 30 degrees anticlockwise. The position of a probe is
the centroid of its footprint.
"""

import numpy as np

from isocharge.common.errors import SceneError, cut
from isocharge.simulate.sensor.probe_shapes.base import NUMBER, Probe, ProbeNotation
from isocharge.simulate.sensor.probe_shapes.ellipse import Ellipse
from isocharge.simulate.sensor.probe_shapes.polygon import Polygon
from isocharge.simulate.sensor.probe_shapes.round import Circle, Finger, GrowingFinger

__all__ = ["PROBE_HELP", "Circle", "Ellipse", "Finger", "GrowingFinger", "Polygon", "Probe", "parse_probe"]

PROBE_SHAPES = (
    ProbeNotation("circle", "RADIUS", Circle),
    ProbeNotation("rectangle", "WIDTHxHEIGHT", Polygon.rectangle),
    ProbeNotation("triangle", "SIDE", Polygon.triangle),
    ProbeNotation(
        "polygon",
        "X,Y;X,Y;X,Y",
        lambda *coordinates: Polygon.of(np.reshape(coordinates, (-1, 2))),
        pattern=rf"{NUMBER},{NUMBER}(?:;{NUMBER},{NUMBER})+",
    ),
    ProbeNotation("ellipse", "WIDTHxHEIGHT", Ellipse),
    ProbeNotation("finger", "RADIUS", Finger),
    ProbeNotation("growing-finger", "RADIUS", GrowingFinger),
)
"""Notations of all probe shapes. The parser, the help text and the error messages are derived from this list."""


def _join_with_or(forms: list[str]) -> str:
    """Join several texts into one text such as "a, b or c"."""
    return f"{', '.join(forms[:-1])} or {forms[-1]}"


PROBE_HELP = (
    f"Footprint, mm: {_join_with_or([notation.form for notation in PROBE_SHAPES])}; @DEGREES at the end rotates the "
    "footprint anticlockwise."
)
"""Help text of command-line options whose value is the notation of a probe."""


def parse_probe(text: str) -> Probe:
    """Create the probe that a notation describes.

    Args:
        text: Notation such as "rectangle:4.0x2.0@30"; see the docstring of this module.

    Raises:
        SceneError: If the text is not the notation of a probe, or no such footprint can exist.
    """
    for notation in PROBE_SHAPES:
        probe = notation.parse(text.strip())
        if probe is not None:
            return probe
    forms = [f"'{notation.form}'" for notation in PROBE_SHAPES]
    raise SceneError(
        f"probe {cut(text)!r}: expected {_join_with_or(forms)} in mm, each optionally rotated as in 'triangle:4.0@30' "
        "(degrees)"
    )
