"""The object that presses: its footprint and the notation for it.

`circle:1.0` (radius), `rectangle:4.0x2.0` (along x and y), `triangle:4.0` (equilateral side, a corner to +y),
`polygon:x,y;x,y;...` (convex), lengths in mm, each optionally rotated: `@30` (degrees, anticlockwise). The position of
a probe is the centroid of its footprint.
"""

import math
import re
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.errors import SceneError, cut
from isocharge.simulate.numerics.polygon import area_of, centroid_of, is_convex
from isocharge.simulate.sensor.size_check import check_length, tidy

NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"

NOTATION = re.compile(
    rf"(?:(?P<circle>circle):(?P<radius>{NUMBER})"
    rf"|(?P<rectangle>rectangle):(?P<width>{NUMBER})x(?P<height>{NUMBER})"
    rf"|(?P<triangle>triangle):(?P<side>{NUMBER})"
    rf"|(?P<polygon>polygon):(?P<corners>{NUMBER},{NUMBER}(?:;{NUMBER},{NUMBER})+))"
    rf"(?:@(?P<angle>{NUMBER}))?"
)

MOST_CORNERS = 64
"""Largest number of corners of a polygon: beyond it a circle gives the same charges with fewer unknowns."""

LEAST_REACH, LEAST_SIDE = 0.02, 1e-3
"""Smallest distance of a footprint's farthest point from its centroid, and smallest side, mm: smaller numbers are in
metres."""


@dataclass(frozen=True)
class Circle:
    """A circular footprint of `radius` (mm) that presses uniformly."""

    radius: float

    def __post_init__(self) -> None:
        check_length("probe radius", self.radius, LEAST_REACH, SceneError)

    @property
    def notation(self) -> str:
        """As on the command line, the radius in mm."""
        return f"circle:{tidy(self.radius)}"

    @property
    def area(self) -> float:
        """Area, mm^2."""
        return float(np.pi * self.radius**2)

    @property
    def reach(self) -> float:
        """Distance of the footprint's farthest point from its centroid, mm."""
        return self.radius

    @property
    def angle(self) -> float:
        """Rotation of the footprint, rad: zero for a circle."""
        return 0.0

    @property
    def period(self) -> float:
        """Smallest rotation that maps the footprint onto itself, rad: a circle looks the same at every angle."""
        return 0.0

    def rotated(self, _angle: float) -> "Circle":
        """The footprint rotated about its centroid."""
        return self


@dataclass(frozen=True)
class Polygon:
    """A convex polygonal footprint that presses uniformly.

    Attributes:
        corners: (x, y) relative to the centroid, anticlockwise, mm, before the rotation.
        angle: Rotation about the centroid, anticlockwise, rad.
        name: Kind of footprint: "rectangle", "triangle" or "polygon".
    """

    corners: tuple[tuple[float, float], ...]
    angle: float = 0.0
    name: str = "polygon"

    def __post_init__(self) -> None:
        at = np.array(self.corners, dtype=float)
        if at.ndim != 2 or at.shape[1:] != (2,) or not 3 <= len(at) <= MOST_CORNERS or not np.isfinite(at).all():
            raise SceneError(f"probe: expected 3 to {MOST_CORNERS} corners (x, y), got {self.corners}")
        if not np.isfinite(self.angle):
            raise SceneError(f"probe angle: expected a finite number, got {self.angle}")
        if not is_convex(at):
            raise SceneError(f"probe: expected a convex polygon with its corners anticlockwise, got {at.tolist()} mm")
        if not np.linalg.norm(centroid_of(at)) <= 1e-9 * np.linalg.norm(at, axis=1).max():
            raise SceneError(
                f"probe: expected corners relative to their centroid, got {at.tolist()} mm; use Polygon.of"
            )
        check_length("probe reach", self.reach, LEAST_REACH, SceneError)

    @classmethod
    def of(cls, corners: Array, angle: float = 0.0, name: str = "polygon") -> "Polygon":
        """From corners (x, y) anywhere, anticlockwise, shape (n, 2), mm: they are moved onto their centroid."""
        at = np.asarray(corners, dtype=float)
        if at.ndim == 2 and at.shape[0] >= 3 and at.shape[1] == 2 and np.isfinite(at).all() and is_convex(at):
            at = at - centroid_of(at)
        return cls(tuple((float(x), float(y)) for x, y in at), angle, name)

    @classmethod
    def rectangle(cls, width: float, height: float, angle: float = 0.0) -> "Polygon":
        """Sides along x and y, mm."""
        for name, value in (("width", width), ("height", height)):
            check_length(f"probe {name}", value, LEAST_SIDE, SceneError)
        x, y = 0.5 * width, 0.5 * height
        return cls(((x, y), (-x, y), (-x, -y), (x, -y)), angle, "rectangle")

    @classmethod
    def triangle(cls, side: float, angle: float = 0.0) -> "Polygon":
        """Equilateral, one corner to +y; side in mm."""
        check_length("probe side", side, LEAST_SIDE, SceneError)
        turn = np.exp(1j * (0.5 * np.pi + 2.0 * np.pi / 3.0 * np.arange(3))) * side / np.sqrt(3.0)
        return cls(tuple((float(z.real), float(z.imag)) for z in turn), angle, "triangle")

    @property
    def notation(self) -> str:
        """As on the command line, lengths in mm, without the angle."""
        at = np.array(self.corners)
        if self.name == "rectangle":
            return f"rectangle:{tidy(2.0 * at[0, 0])}x{tidy(2.0 * at[0, 1])}"
        if self.name == "triangle":
            return f"triangle:{tidy(float(np.linalg.norm(at[1] - at[0])))}"
        return "polygon:" + ";".join(f"{tidy(x)},{tidy(y)}" for x, y in at)

    @property
    def area(self) -> float:
        """Area, mm^2."""
        return area_of(np.array(self.corners))

    @property
    def reach(self) -> float:
        """Distance of the footprint's farthest point from its centroid, mm."""
        return float(np.linalg.norm(np.array(self.corners), axis=1).max())

    @property
    def outline(self) -> Complexes:
        """Corners as x + iy relative to the centroid, rotated, anticlockwise, shape (n,), mm."""
        return np.asarray(np.array(self.corners) @ np.array([1.0, 1j]) * np.exp(1j * self.angle))

    @property
    def period(self) -> float:
        """Smallest rotation that maps the footprint onto itself, rad."""
        z = np.array(self.corners) @ np.array([1.0, 1j])
        for step in range(1, z.size):
            turn = np.exp(2j * np.pi * step / z.size)
            if z.size % step == 0 and np.allclose(np.roll(z, -step), z * turn, rtol=0.0, atol=1e-9 * self.reach):
                return float(math.tau * step / z.size)
        return math.tau

    def rotated(self, angle: float) -> "Polygon":
        """The footprint rotated about its centroid by a further angle (rad)."""
        return replace(self, angle=self.angle + angle)


Probe: TypeAlias = Circle | Polygon


def parse_probe(text: str) -> Probe:
    """Read a probe's notation; see the module.

    Raises:
        SceneError: If the notation is wrong or the footprint impossible.
    """
    match = NOTATION.fullmatch(text.strip())
    if match is None:
        raise SceneError(
            f"probe {cut(text)!r}: expected 'circle:R', 'rectangle:WxH', 'triangle:S' or 'polygon:X,Y;X,Y;X,Y' in mm, "
            "each optionally rotated as in 'triangle:4.0@30' (degrees)"
        )
    angle = float(np.deg2rad(float(match["angle"] or 0.0)))
    if match["circle"]:
        return Circle(float(match["radius"]))
    if match["rectangle"]:
        return Polygon.rectangle(float(match["width"]), float(match["height"]), angle)
    if match["triangle"]:
        return Polygon.triangle(float(match["side"]), angle)
    corners = np.array([[float(value) for value in corner.split(",")] for corner in match["corners"].split(";")])
    return Polygon.of(corners, angle)


def farthest(probe: Probe, at: tuple[float, float]) -> float:
    """Distance of the footprint's farthest point from the film's centre, mm."""
    if isinstance(probe, Polygon):
        return float(np.abs(complex(*at) + probe.outline).max())
    return float(np.hypot(*at)) + probe.radius
