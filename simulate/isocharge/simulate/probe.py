"""The object that presses: its footprint and the notation for it, `circle:1.0` (radius in mm)."""

import re
from dataclasses import dataclass

import numpy as np

from isocharge.errors import SceneError

NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
NOTATION = re.compile(rf"(?P<shape>[a-z]+):(?P<size>{NUMBER}(?:x{NUMBER})?)(?:@(?P<angle>{NUMBER}))?")


@dataclass(frozen=True)
class Circle:
    """A circular footprint of `radius` (m) that presses uniformly."""

    radius: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.radius) and self.radius > 0.0):
            raise SceneError(f"probe radius: expected a positive number, got {self.radius} m")

    @property
    def notation(self) -> str:
        """As on the command line, the radius in mm."""
        return f"circle:{float(f'{self.radius * 1e3:.12g}')}"


def parse_probe(text: str) -> Circle:
    """Read a probe's notation.

    Args:
        text: `circle:R` with the radius R in mm; an angle (`@30`) is allowed and means nothing to a circle.

    Raises:
        SceneError: If the notation is wrong or names a shape that cannot be simulated yet.
    """
    match = NOTATION.fullmatch(text.strip())
    if match is None or (match["shape"] == "circle" and "x" in match["size"]):
        raise SceneError(f"probe {text!r}: expected a notation like 'circle:1.0' (radius in mm)")
    if match["shape"] != "circle":
        raise SceneError(f"probe {text!r}: this version simulates circles only; use 'circle:R' with R in mm")
    return Circle(float(match["size"]) * 1e-3)
