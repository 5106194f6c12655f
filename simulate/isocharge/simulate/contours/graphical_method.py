"""Contours and triangulation as Mirbagheri et al. (2007) draw them.

A polynomial is fitted to the charge along each line of a mapping scheme, its root is one point of the contour, and the
points are joined by a spline (AutoCAD's SPLINE: cubic, through its points, parameter the length of the chords, free
ends). Two contours are intersected as splines; the three crossings that lie together most closely are averaged.
`field_contours` and `triangulation` do the same from the field, without the error of the drawing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.contours.charge_curves import Curves
from isocharge.simulate.contours.fix import AMBIGUOUS, APART, TOLERANCE, Fix, Meeting, check_triangulation
from isocharge.simulate.forward.charge_map import as_charges

DEGREE = 4
"""Degree of the polynomial along a line: our choice, since lower degrees miss the charge near the electrode."""

NOWHERE = np.full(2, np.nan)
"""Position of a press whose contours do not meet."""

PER_SPAN = 8
"""Number of chords of each span of the spline, on which crossings are located before they are refined."""


@dataclass(frozen=True)
class DrawnContour:
    """A contour by the graphical method: a spline through the roots on the lines.

    Attributes:
        electrode: Name of the electrode.
        charge: Its charge on the contour, pC.
        knots: Roots on the lines, in the order of their angle, shape (n, 2), mm; n >= 2.
    """

    electrode: str
    charge: float
    knots: Array

    @property
    def points(self) -> Array:
        """Points along the spline, shape (n, 2), mm."""
        return np.asarray(self._spline(self._parameters))

    @cached_property
    def _spline(self) -> "scipy.interpolate.CubicSpline":
        chords = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.knots, axis=0), axis=1))])
        return scipy.interpolate.CubicSpline(chords, self.knots, bc_type="natural")

    @property
    def _parameters(self) -> Array:
        knots = self._spline.x
        inner = np.linspace(knots[:-1], knots[1:], PER_SPAN, endpoint=False, axis=1).ravel()
        return np.asarray(np.append(inner, knots[-1]))

    def crossings(self, other: "DrawnContour") -> Array:
        """Positions where two contours cross, shape (n, 2), mm."""
        crossings = []
        for mine, theirs in _chord_crossings(self.points, other.points):
            at = np.array([self._parameters[mine], other._parameters[theirs]])
            for _ in range(4):  # Newton's method on the splines, from where the chords begin
                gap = self._spline(at[0]) - other._spline(at[1])
                matrix = np.stack([self._spline(at[0], 1), -other._spline(at[1], 1)], axis=1)
                at = at - np.linalg.lstsq(matrix, gap, rcond=None)[0]
            crossings.append(self._spline(at[0]))
        return np.array(crossings).reshape(-1, 2)


def _chord_crossings(first: Array, second: Array) -> Integers:
    """Chords of two polylines that cross: index along the first, index along the second, shape (n, 2)."""
    a, b = np.diff(first, axis=0)[:, None], np.diff(second, axis=0)[None]
    between = second[None, :-1] - first[:-1, None]
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel chords do not cross
        area = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        s = (between[..., 0] * b[..., 1] - between[..., 1] * b[..., 0]) / area
        t = (between[..., 0] * a[..., 1] - between[..., 1] * a[..., 0]) / area
        return np.argwhere((s >= 0.0) & (s < 1.0) & (t >= 0.0) & (t < 1.0))


def draw_contour(curves: Curves, charge: float, degree: int = DEGREE) -> DrawnContour | None:
    """The contour of the mapping's electrode, or None if fewer than two lines reach the charge.

    Args:
        curves: Charges along the lines of a mapping.
        charge: Charge on the contour, pC.
        degree: Degree of the polynomial along each line.

    Raises:
        SceneError: If a line has too few presses for the degree.
    """
    mapping = curves.mapping
    roots = [_root(polynomial, charge, mapping.distance) for polynomial in curves.polynomials(degree)]
    direction = np.stack([np.cos(mapping.angle), np.sin(mapping.angle)], axis=1)
    knots = np.array(mapping.origin) + np.array(roots)[:, None] * direction
    knots = knots[np.isfinite(roots)]
    return DrawnContour(mapping.electrode, charge, knots) if len(knots) > 1 else None


def _root(polynomial: np.polynomial.Polynomial, charge: float, distance: Array) -> float:
    """Smallest distance at which a line's polynomial has the charge, mm; NaN if it has it nowhere.

    Distances from half of the first press's count.
    """
    roots = (polynomial - charge).roots()
    real = roots.real[np.abs(roots.imag) < 1e-9 * np.abs(distance[-1])]
    inside = real[(real >= 0.5 * distance[0]) & (real <= distance[-1])]
    return float(inside.min()) if inside.size else np.nan


@dataclass(frozen=True)
class DrawnTriangulation:
    """Triangulation with contours of the graphical method.

    Attributes:
        curves: One set for each electrode, each from that electrode, in the order of the charges.
        degree: Degree of the polynomials.
        tolerance: Largest distance of three crossings from their mean at which contours meet, mm.
    """

    curves: Sequence[Curves]
    degree: int = DEGREE
    tolerance: float = TOLERANCE

    def __post_init__(self) -> None:
        check_triangulation(self.electrodes, self.tolerance)

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the electrodes, in the order of the charges."""
        return tuple(curves.mapping.electrode for curves in self.curves)

    def contours(self, charge: Array) -> tuple[DrawnContour | None, ...]:
        """The contour of each charge, shape (n_electrode,), pC."""
        return tuple(draw_contour(c, float(q), self.degree) for c, q in zip(self.curves, charge, strict=True))

    def locate(self, charge: Array) -> Fix:
        """Positions of presses; their force must be that of the curves.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.

        Raises:
            ChargeError: If the charges are not finite or not one for each electrode.
        """
        charge = as_charges(charge, self.electrodes)
        rows = [self._locate_one(row) for row in charge]
        at, spread, status = (np.array([row[i] for row in rows]) for i in range(3))
        contact = np.column_stack([at.reshape(-1, 2), np.full(len(charge), self.curves[0].force)])
        return Fix(contact, spread, status.astype(np.intp))

    def _locate_one(self, charge: Array) -> tuple[Array, float, Meeting]:
        """Position, spread, and whether the contours meet."""
        contours = [contour for contour in self.contours(charge) if contour is not None]
        if len(contours) < len(charge):
            return NOWHERE, np.nan, Meeting.no_contour
        pairs = {(i, j): contours[i].crossings(contours[j]) for i, j in combinations(range(len(contours)), 2)}
        triples = combinations(range(len(contours)), 3)
        meetings = [self._meeting([pairs[pair] for pair in combinations(triple, 2)]) for triple in triples]
        good = [(mean, spread) for mean, spread, status in meetings if status is Meeting.met]
        if not good:
            return NOWHERE, np.nan, max(status for _, _, status in meetings)  # twice rather than apart
        return np.mean([mean for mean, _ in good], axis=0), max(spread for _, spread in good), Meeting.met

    def _meeting(self, pairs: list[Array]) -> tuple[Array, float, Meeting]:
        """Mean and spread of those crossings of three pairs of contours that lie together most closely."""
        corners = np.array([*product(*pairs)]).reshape(-1, 3, 2)
        means = corners.mean(axis=1)
        spreads = np.linalg.norm(corners - means[:, None], axis=2).max(axis=1)
        if spreads.min(initial=np.inf) > self.tolerance:
            return NOWHERE, np.nan, Meeting.apart
        best = spreads.argmin()
        rivals = spreads[np.linalg.norm(means - means[best], axis=1) > APART]
        if rivals.min(initial=np.inf) <= AMBIGUOUS * spreads[best]:
            return NOWHERE, np.nan, Meeting.twice
        return means[best], float(spreads[best]), Meeting.met
