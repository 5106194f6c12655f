"""What can be made: gaps between electrodes, distance from the rim, keep-out zones, electrodes that stay, symmetry.

A layout is a vector of free numbers; a linear map gives the places of all new electrodes, so symmetric layouts have
fewer free numbers and no constraint of their own.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.simulate.sensor.electrode import Electrode

MILLIMETRE = 1e-3
"""Unit of violations in the penalty, m."""

TOUCHING = 1e-9
"""Overlap up to which a given electrode beside a zone counts as outside, m."""


@dataclass(frozen=True)
class Zone:
    """A disk that electrodes keep out of: a lens, a hole.

    Attributes:
        centre: (x, y), m.
        radius: m.
    """

    centre: tuple[float, float]
    radius: float

    def __post_init__(self) -> None:
        if not (np.isfinite([*self.centre, self.radius]).all() and self.radius > 0.0):
            x, y, radius = (f"{1e3 * value:g}" for value in (*self.centre, self.radius))
            raise InputError(
                f"keep-out zone: expected finite x, y and a radius above 0 in mm, got ({x}, {y}) and {radius} mm"
            )


@dataclass(frozen=True)
class Rules:
    """What a layout must keep to.

    Attributes:
        film_radius: m.
        gap: Smallest distance between two electrodes, along x or along y, m.
        rim: Smallest distance of an electrode from the film's rim, m.
        zones: Where no electrode lies.
        stay: Electrodes that are given.
    """

    film_radius: float
    gap: float = 0.5e-3
    rim: float = 1e-3
    zones: tuple[Zone, ...] = ()
    stay: tuple[Electrode, ...] = ()

    def violations(self, centres: Array, sides: Array) -> tuple[Array, Array]:
        """How far squares break the rules.

        Args:
            centres: Shape (n, 2), m.
            sides: Shape (n,), m.

        Returns:
            For each rule the excess, positive where broken, shape (n_rule,), m; and its derivatives by x, y and side of
            each square, shape (n_rule, n, 3).
        """
        parts = [*self._rim(centres, sides), *self._zones(centres, sides), *self._gaps(centres, sides)]
        values = np.array([value for value, _ in parts])
        return values, np.stack([slope for _, slope in parts])

    def in_zone(self, electrode: Electrode) -> bool:
        """Whether the box round an electrode reaches into a zone."""
        corners = np.array(electrode.corners)
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        return any(_apart(0, 1, middle - zone.centre, half, zone.radius, 0.5)[0] > TOUCHING for zone in self.zones)

    def _rim(self, centres: Array, sides: Array) -> list[tuple[float, Array]]:
        parts = []
        for i, (centre, side) in enumerate(zip(centres, sides, strict=True)):
            outward = np.where(centre < 0.0, -1.0, 1.0)
            corner = centre + 0.5 * side * outward
            length = float(np.hypot(*corner))
            slope = np.zeros((len(centres), 3))
            slope[i, :2] = corner / length
            slope[i, 2] = 0.5 * outward @ corner / length
            parts.append((length - (self.film_radius - self.rim), slope))
        return parts

    def _zones(self, centres: Array, sides: Array) -> list[tuple[float, Array]]:
        parts = []
        for zone in self.zones:
            for i, (centre, side) in enumerate(zip(centres, sides, strict=True)):
                away = centre - np.array(zone.centre)
                parts.append(_apart(i, len(centres), away, 0.5 * side, zone.radius, 0.5))
        return parts

    def _gaps(self, centres: Array, sides: Array) -> list[tuple[float, Array]]:
        parts = []
        for i, j in combinations(range(len(centres)), 2):
            value, slope = _apart(i, len(centres), centres[i] - centres[j], 0.5 * (sides[i] + sides[j]), self.gap, 0.5)
            slope[j] = [-slope[i, 0], -slope[i, 1], slope[i, 2]]
            parts.append((value, slope))
        for electrode in self.stay:
            corners = np.array(electrode.corners)
            low, high = corners.min(axis=0), corners.max(axis=0)
            for i, (centre, side) in enumerate(zip(centres, sides, strict=True)):
                away, half = centre - 0.5 * (low + high), 0.5 * (high - low)
                parts.append(_apart(i, len(centres), away, 0.5 * side + half, self.gap, 0.5))
        return parts


def _apart(i: int, count: int, away: Array, half: Array | float, gap: float, by_side: float) -> tuple[float, Array]:
    """By how much two boxes are nearer than `gap`: the distance is the larger one along x and y, or between corners.

    Args:
        i: Number of the square that moves.
        count: Number of squares.
        away: Vector between the centres, m.
        half: Sum of the half sides, along x and along y or for both, m.
        gap: m.
        by_side: Derivative of `half` by the square's side.
    """
    between = np.abs(away) - half
    slope = np.zeros((count, 3))
    if (between > 0.0).all():
        distance = float(np.hypot(*between))
        direction = between / distance
    else:
        direction = (between == between.max()).astype(float)
        direction /= direction.sum()
        distance = float(between.max())
    slope[i, :2] = -direction * np.where(away < 0.0, -1.0, 1.0)
    slope[i, 2] = by_side * direction.sum()
    return gap - distance, slope


@dataclass(frozen=True)
class Parameters:
    """Free numbers of a layout: places, and sides if they may vary, all in m.

    Attributes:
        places: Matrix from the free numbers of places to (x, y) of all new electrodes, shape (2 n, n_place).
        side: Smallest and largest side, m; equal if the side is given.
    """

    places: Array
    side: tuple[float, float]

    @classmethod
    def of(cls, count: int, side: tuple[float, float], symmetry: str = "none", axial: int = 0) -> "Parameters":
        """Parameters of layouts with `count` new electrodes.

        Args:
            count: Number of electrodes that are placed.
            side: Smallest and largest side, m.
            symmetry: "none", "mirror" in the x axis, or a number of turns such as "3-fold".
            axial: With "mirror", number of electrodes on the axis; "n-fold", whether one lies in the centre.
        """
        return cls(_symmetric_places(count, symmetry, axial), side)

    @property
    def count(self) -> int:
        """Number of electrodes."""
        return len(self.places) // 2

    @property
    def sized(self) -> bool:
        """Whether the sides vary."""
        return self.side[1] > self.side[0]

    @property
    def free(self) -> int:
        """Number of free numbers."""
        return int(self.places.shape[1]) + (self.count if self.sized else 0)

    def layout(self, free: Array) -> tuple[Array, Array]:
        """Centres, shape (n, 2), and sides, shape (n,), m, of free numbers of shape (n_free,)."""
        count = self.places.shape[1]
        centres = (self.places @ free[:count]).reshape(-1, 2)
        return centres, free[count:] if self.sized else np.full(self.count, self.side[0])

    def back(self, by_layout: Array) -> Array:
        """Derivatives by x, y and side of each electrode, shape (..., n, 3), as derivatives by the free numbers."""
        flat = by_layout[..., :2].reshape(*by_layout.shape[:-2], -1) @ self.places
        return np.concatenate([flat, by_layout[..., 2]], axis=-1) if self.sized else flat


def axial_choices(count: int, symmetry: str) -> tuple[int, ...]:
    """Numbers of electrodes that a symmetric layout may have on its axis or in its centre.

    Raises:
        InputError: If the symmetry is unknown or cannot hold so many electrodes.
    """
    if symmetry == "none":
        return (0,)
    if symmetry == "mirror":
        return tuple(range(count % 2, count, 2)) or (count,)
    turns = _turns(symmetry)
    choices = tuple(centre for centre in (0, 1) if count > centre and (count - centre) % turns == 0)
    if not choices:
        raise InputError(
            f"symmetry {symmetry!r}: expected a multiple of {turns} electrodes, or one more, to place; got {count}"
        )
    return choices


def _turns(symmetry: str) -> int:
    number = symmetry.removesuffix("-fold")
    if number == symmetry or not number.isdigit() or not 2 <= int(number) <= 8:
        raise InputError(f"symmetry: expected 'none', 'mirror' or '2-fold' to '8-fold', got {symmetry!r}")
    return int(number)


def _symmetric_places(count: int, symmetry: str, axial: int) -> Array:
    if symmetry == "none":
        return np.eye(2 * count)
    if symmetry == "mirror":
        pairs = (count - axial) // 2
        places = np.zeros((2 * count, axial + 2 * pairs))
        for i in range(axial):
            places[2 * i, i] = 1.0
        for k in range(pairs):
            row, column = 2 * axial + 4 * k, axial + 2 * k
            places[row : row + 4, column : column + 2] = [[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, -1.0]]
        return places
    turns = _turns(symmetry)
    orbits = (count - axial) // turns
    places = np.zeros((2 * count, 2 * orbits))
    for k in range(orbits):
        for turn in range(turns):
            c, s = np.cos(2.0 * np.pi * turn / turns), np.sin(2.0 * np.pi * turn / turns)
            row = 2 * axial + 2 * (k * turns + turn)
            places[row : row + 2, 2 * k : 2 * k + 2] = [[c, -s], [s, c]]
    return places
