"""Notation of probes on the command line and in files.

Examples of the notation:

    circle:1.0             radius
    ellipse:4.0x2.0        axes along x and y
    rectangle:4.0x2.0      sides along x and y
    triangle:4.0           side of an equilateral triangle with one corner towards +y
    polygon:x,y;x,y;x,y    corners of a convex polygon, anticlockwise
    finger:6.0             radius of the contact area of a fingertip
    growing-finger:6.0     radius at 1 N of a contact area that grows with the cube root of the force

All lengths are in mm. The suffix `@30` rotates the footprint by 30 degrees anticlockwise.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from isocharge.common.errors import SceneError, cut
from isocharge.simulate.sensor.curved_probes import Circle, Ellipse, Finger, GrowingFinger
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.polygon_probe import Polygon

NUMBER_PATTERN = r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
"""Regular expression of a decimal number in the notation of a probe."""


@dataclass(frozen=True)
class ProbeNotation:
    """One notation of a probe shape on the command line and in files, such as `rectangle:WIDTHxHEIGHT`.

    Attributes:
        name: Word before the colon.
        parameters: Text after the colon. Each word of capital letters stands for a number (mm).
        build: Function that creates the probe without a rotation from the numbers.
        pattern: Regular expression of the text after the colon. If it is empty, it is derived from `parameters`.
    """

    name: str
    parameters: str
    build: Callable[..., "Probe"]
    pattern: str = ""

    @property
    def form(self) -> str:
        """Notation with placeholders for the numbers, for help texts and error messages."""
        return f"{self.name}:{self.parameters}"

    def parse(self, text: str) -> "Probe | None":
        """Create the probe that a text in this notation describes.

        Args:
            text: Notation of a probe, such as "rectangle:4.0x2.0@30".

        Returns:
            The probe; None if the text is in another notation.

        Raises:
            SceneError: If the text is in this notation, but no such footprint can exist.
        """
        # Each word of capital letters in `parameters`, such as "WIDTHxHEIGHT", is replaced by the pattern of a number.
        pattern = self.pattern or re.sub("[A-Z]+", lambda _: NUMBER_PATTERN, self.parameters)
        match = re.fullmatch(rf"{self.name}:(?P<parameters>{pattern})(?:@(?P<degrees>{NUMBER_PATTERN}))?", text)
        if match is None:
            return None
        numbers = [float(number) for number in re.findall(NUMBER_PATTERN, match["parameters"])]
        degrees = float(match["degrees"] or 0.0)
        return self.build(*numbers).rotated(float(np.deg2rad(degrees)))


PROBE_SHAPES = (
    ProbeNotation("circle", "RADIUS", Circle),
    ProbeNotation("rectangle", "WIDTHxHEIGHT", Polygon.rectangle),
    ProbeNotation("triangle", "SIDE", Polygon.triangle),
    ProbeNotation(
        "polygon",
        "X,Y;X,Y;X,Y",
        lambda *coordinates: Polygon.of(np.reshape(coordinates, (-1, 2))),
        pattern=rf"{NUMBER_PATTERN},{NUMBER_PATTERN}(?:;{NUMBER_PATTERN},{NUMBER_PATTERN})+",
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
        text: Notation such as "rectangle:4.0x2.0@30"; see the docstring of the module.

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
