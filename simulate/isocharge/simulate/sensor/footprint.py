"""Footprint of a probe: the area on which the probe presses, with its pressure and the topology of its mesh.

Points of a footprint are complex numbers x + iy in mm, relative to the centroid of the footprint. The position of a
probe is the centroid of its footprint.

The mesh of a polygonal footprint consists of blocks with straight sides. Probes whose footprints have smooth boundaries
are subclasses of `CurvedProbe`. A footprint with a smooth boundary contains a core polygon. Inside the core polygon,
the blocks of the mesh have straight sides. Between the core polygon and the boundary, each block has one curved side.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import shapely

from isocharge.common.arrays import Array, Complexes
from isocharge.common.errors import SceneError
from isocharge.simulate.numerics.polygon import to_corners
from isocharge.simulate.sensor.film import check_range

MIN_LENGTH = 0.02
"""Smallest accepted radius, side, axis or diameter of a footprint, mm. A smaller value was probably in metres."""

CORE_SHARE = 0.45 * math.sqrt(2.0)
"""Size of the core polygon relative to the footprint, dimensionless.

The value is a ratio of two distances from the centroid in the same direction: the distance of a corner of the core
polygon, divided by the distance of the boundary.
"""

OUTLINE_POINTS = 1024
"""Number of points of the outline of a curved footprint. The relative error of its area is below 1e-5."""


def with_rotation(notation: str, angle_deg: float) -> str:
    """Return the notation of a probe, followed by its rotation unless the rotation is zero."""
    return f"{notation}@{angle_deg:g}" if angle_deg else notation


@dataclass(frozen=True)
class FootprintTopology:
    """Number and kind of the mesh blocks that a footprint needs.

    Probes with the same topology use the same mesh template.

    Attributes:
        n_corner: Number of corners of the core polygon. The core polygon of a polygonal footprint is the whole
            footprint.
        is_curved: Whether blocks with a curved outer side lie between the core polygon and the boundary of the
            footprint.
        fills_circle: Whether the boundary of the footprint is the innermost circle of the mesh. Otherwise there is a
            gap between the footprint and the innermost circle.
    """

    n_corner: int
    is_curved: bool
    fills_circle: bool


class Probe(ABC):
    """Base class of all probes. A probe is a body that presses on the film within its footprint.

    The distribution of the pressure over the footprint does not depend on the film. The pressure is uniform unless a
    subclass overrides `has_uniform_pressure`, `pressure` and `force_share`. Subclasses, such as `Circle`, `Ellipse`,
    `Finger` and `Polygon`, are frozen dataclasses.
    """

    @property
    @abstractmethod
    def angle(self) -> float:
        """Rotation of the footprint about its centroid, anticlockwise, rad."""

    @property
    @abstractmethod
    def notation(self) -> str:
        """Notation of this probe for `parse_probe`, without the rotation of the probe."""

    @property
    def rotated_notation(self) -> str:
        """Notation of this probe. If the probe is rotated, the notation ends with `@` and the angle in degrees."""
        return with_rotation(self.notation, round(math.degrees(self.angle), 9) % 360.0)

    @property
    @abstractmethod
    def area(self) -> float:
        """Area of the footprint, mm^2."""

    @property
    @abstractmethod
    def reach(self) -> float:
        """Distance from the centroid of the footprint to the farthest point of the footprint, mm."""

    @property
    def half_width(self) -> float:
        """Half of the width of a narrow footprint, or the radius of a circle, mm."""
        return self.area / (math.pi * self.reach)

    @property
    @abstractmethod
    def period(self) -> float:
        """Smallest rotation that maps the footprint onto itself, rad.

        The period of a circle is zero, because every rotation maps a circle onto itself.
        """

    @property
    @abstractmethod
    def topology(self) -> FootprintTopology:
        """Number and kind of the mesh blocks for this footprint."""

    @property
    @abstractmethod
    def outline(self) -> Complexes:
        """Points x + iy along the boundary, anticlockwise, shape (n,), mm.

        For a polygon, the points are its corners. For a curved footprint, the points lie on the curved boundary.
        """

    @abstractmethod
    def core(self) -> Complexes:
        """Return the corners x + iy of the core polygon, anticlockwise, shape (topology.n_corner,), mm.

        For a curved footprint, the corners are evenly spaced in the boundary parameter. The parameter of the first
        corner is half of the spacing.
        """

    def rotated(self, angle: float) -> Self:
        """Return a copy of the probe after a further rotation about its centroid.

        Args:
            angle: Further rotation, anticlockwise, rad.
        """
        if self.is_axisymmetric:  # a rotation does not change a circle
            return self
        return replace(self, angle=self.angle + angle)  # type: ignore[type-var]

    grows = False
    """Whether the footprint becomes larger with the force."""

    def under(self, force: float) -> "Probe":  # noqa: ARG002
        """Return a probe with the footprint that this probe has under a force (N)."""
        return self

    def farthest_distance(self, at: tuple[float, float]) -> float:
        """Return the distance from the centre of the film to the farthest point of the outline, mm.

        Args:
            at: Position (x, y) of the centroid relative to the centre of the film, mm.
        """
        return float(np.abs(complex(*at) + self.outline).max())

    has_uniform_pressure = True
    """Whether the pressure is the same at all points of the footprint."""

    def pressure(self, points: Complexes) -> Array:
        """Return the pressure at points of the footprint, divided by the mean pressure.

        Args:
            points: Points x + iy relative to the centroid, any shape, mm.

        Returns:
            Relative pressure, of the shape of `points`, dimensionless. The mean over the footprint is 1, and the centre
            of pressure is the centroid.
        """
        return np.ones(points.shape)

    def force_share(self, corners: Array, at: complex) -> float:
        """Return the fraction of the force that acts on a convex polygon of the film, from 0 to 1.

        For a curved footprint, the fraction is computed from its outline.

        Args:
            corners: Corners (x, y) of the polygon, anticlockwise, shape (n, 2), mm.
            at: Position of the centroid of the footprint as x + iy, mm.
        """
        outline = shapely.Polygon(to_corners(at + self.outline))
        return float(shapely.intersection(shapely.Polygon(corners), outline).area / outline.area)

    @property
    def is_axisymmetric(self) -> bool:
        """Whether every rotation maps the footprint onto itself."""
        return self.period == 0.0


class CurvedProbe(Probe):
    """Base class of probes with a convex footprint whose boundary is smooth.

    A subclass has a field `angle` and implements `boundary`, `notation`, `area`, `reach` and `period`. The class
    `CurvedProbe` implements all other methods of `Probe`. A subclass may override these methods with closed formulas.
    """

    @abstractmethod
    def boundary(self, parameter: Array) -> Complexes:
        """Return points on the boundary of the footprint, including the rotation by `angle`.

        Args:
            parameter: Values from 0 to 2 pi, any shape. If the parameter increases, the point moves anticlockwise along
                the boundary. An increase of the parameter by `period` must rotate the point by `period`.

        Returns:
            Points x + iy relative to the centroid, of the shape of `parameter`, mm.
        """

    @property
    def topology(self) -> FootprintTopology:
        """Topology with a core polygon, and a layer of blocks between the core polygon and the boundary.

        The core polygon has the rotational symmetry of the footprint. The layer around a circular footprint reaches up
        to the innermost circle of the mesh.
        """
        # The core of a circle has four corners. The same holds if only a half turn or a full turn maps the footprint
        # onto itself.
        n_corner = 4
        if 0.0 < self.period < 0.9 * math.pi:
            n_corner = round(math.tau / self.period)
        return FootprintTopology(n_corner, is_curved=True, fills_circle=self.is_axisymmetric)

    @property
    def outline(self) -> Complexes:
        """Points x + iy of the boundary at evenly spaced parameters, shape (OUTLINE_POINTS,), mm."""
        return self.boundary(math.tau * np.arange(OUTLINE_POINTS) / OUTLINE_POINTS)

    def core(self) -> Complexes:
        """Return the corners x + iy of the core polygon, shape (n_corner,), mm."""
        n_corner = self.topology.n_corner
        parameter = math.tau * (np.arange(n_corner) + 0.5) / n_corner
        return CORE_SHARE * self.boundary(parameter)


def check_angle(angle: float) -> None:
    """Raise an error if the rotation of a footprint is not a finite number.

    Args:
        angle: Rotation, rad.

    Raises:
        SceneError: If `angle` is infinite or not a number.
    """
    if not np.isfinite(angle):
        raise SceneError(f"probe angle: expected a finite number, got {angle}")


def check_length(what: str, length: float) -> None:
    """Raise an error if a length of a footprint is infinite, or so small that it was probably given in metres.

    Args:
        what: Name of the length in the error message.
        length: Radius, side, axis or diameter of the footprint, mm.

    Raises:
        SceneError: If `length` is below `MIN_LENGTH` or infinite.
    """
    check_range(what, length, (MIN_LENGTH, np.inf), "mm", SceneError)
