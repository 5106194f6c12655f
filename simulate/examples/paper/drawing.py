"""Contours and triangulation in the way in which the paper draws them.

A polynomial is fitted to the charge along each line of a mapping scheme. On each line, the point at which the
polynomial is equal to the given charge belongs to the contour. A cubic spline with free ends connects the points of all
lines, like the command SPLINE of AutoCAD. The position of a press is the mean of the three crossings of three contours.
If two contours cross several times, the three crossings that are nearest to each other are used. With four electrodes,
the position is the mean over the triples of electrodes whose contours meet.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import shapely
from mapping import Curves
from numpy.polynomial import Polynomial
from scipy.interpolate import CubicSpline

from isocharge.common.arrays import Array
from isocharge.simulate.identifiability.triangulation import AMBIGUOUS_RATIO, Fix

CHORDS = 64
"""Number of chords by which the spline between two neighbouring points is approximated."""

TOLERANCE_MM = 1.0
"""Largest distance between a crossing of two contours and the mean of three crossings at which the contours meet."""

ELSEWHERE_MM = 0.2
"""Smallest distance between two positions at which contours meet."""


@dataclass(frozen=True)
class DrawnContour:
    """Spline through one point on each line of a mapping scheme.

    Attributes:
        electrode: Name of the electrode.
        charge: Charge of the electrode on the contour, pC.
        knots: Points (x, y) on the lines at which the electrode has this charge, shape (n, 2), mm.
        points: Ends (x, y) of the chords of the spline, shape (m, 2), mm.
    """

    electrode: str
    charge: float
    knots: Array
    points: Array

    def crossings(self, other: "DrawnContour") -> Array:
        """Return the positions (x, y) at which this contour crosses another contour, shape (n, 2), mm."""
        lines = (shapely.LineString(self.points), shapely.LineString(other.points))
        return np.asarray(shapely.get_coordinates(shapely.intersection(*lines)))


def draw_contour(curves: Curves, charge: float, degree: int) -> DrawnContour | None:
    """Draw the contour of a charge.

    Args:
        curves: Charges along the lines of the mapping scheme.
        charge: Charge of the electrode on the contour, pC.
        degree: Degree of the polynomial along each line.

    Returns:
        The contour; None if the charge occurs on fewer than two lines.
    """
    mapping = curves.mapping
    knots = []
    for direction, line_charge in zip(mapping.direction, curves.charge, strict=True):
        roots = (Polynomial.fit(mapping.distance, line_charge, degree) - charge).roots()
        real_roots = roots.real[np.abs(roots.imag) < 1e-9 * mapping.distance[-1]]
        # The polynomial describes the charge from about the first press to the last press.
        on_line = real_roots[(real_roots >= 0.5 * mapping.distance[0]) & (real_roots <= mapping.distance[-1])]
        if on_line.size:
            knots.append(mapping.origin + on_line.min() * direction)
    if len(knots) < 2:
        return None
    knot = np.array(knots)
    parameter = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knot, axis=0), axis=1))])
    fine_parameter = np.interp(np.linspace(0, len(knot) - 1, CHORDS * (len(knot) - 1) + 1), range(len(knot)), parameter)
    points = CubicSpline(parameter, knot, bc_type="natural")(fine_parameter)
    return DrawnContour(mapping.electrode, charge, knot, points)


@dataclass(frozen=True)
class DrawnTriangulation:
    """Estimator that determines the positions of presses by drawing contours.

    Attributes:
        curves: Charges along lines from each electrode, in the order of the charges.
        degree: Degree of the polynomials along the lines.
    """

    curves: Sequence[Curves]
    degree: int

    def contours(self, charge: Array) -> tuple[DrawnContour | None, ...]:
        """Draw the contours of all electrodes for the charges of one press, shape (n_electrode,), pC."""
        pairs = zip(self.curves, charge.tolist(), strict=True)
        return tuple(draw_contour(curves, electrode_charge, self.degree) for curves, electrode_charge in pairs)

    def locate(self, charge: Array) -> Fix:
        """Estimate the positions of presses that have the force of the curves.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.

        Returns:
            Positions (x, y) in place of contacts, shape (n, 2). The spread is the largest distance between a crossing
            and the mean of three crossings; infinite if a contour cannot be drawn.
        """
        located = [self._locate_one(press_charge) for press_charge in charge]
        return Fix(np.array([position for position, _ in located]), np.array([spread for _, spread in located]))

    def _locate_one(self, charge: Array) -> tuple[Array, float]:
        """Return the position (NaN if the contours do not meet) and the spread of one press, mm."""
        contours = [contour for contour in self.contours(charge) if contour is not None]
        if len(contours) < len(charge):
            return np.full(2, np.nan), np.inf
        crossings = {
            (first, second): contours[first].crossings(contours[second])
            for first, second in combinations(range(len(contours)), 2)
        }
        triples = [
            meeting([crossings[pair] for pair in combinations(triple, 2)])
            for triple in combinations(range(len(contours)), 3)
        ]
        met = [(position, spread) for position, spread in triples if np.isfinite(position).all()]
        if not met:
            return np.full(2, np.nan), min(spread for _, spread in triples)
        return np.mean([position for position, _ in met], axis=0), max(spread for _, spread in met)


def meeting(crossings: Sequence[Array]) -> tuple[Array, float]:
    """Find the position at which three contours meet.

    Args:
        crossings: Crossings (x, y) of each of the three pairs of contours, each of shape (m, 2), mm.

    Returns:
        Mean of the three crossings that are nearest to each other, shape (2,), mm, and its spread, mm. The position is
        NaN if the spread exceeds `TOLERANCE_MM`, or if three crossings elsewhere are nearly as close to each other.
    """
    combined = np.array(list(product(*crossings))).reshape(-1, 3, 2)
    mean = combined.mean(axis=1)
    spread = np.linalg.norm(combined - mean[:, None], axis=2).max(axis=1)
    smallest = float(spread.min(initial=np.inf))
    if smallest > TOLERANCE_MM:
        return np.full(2, np.nan), smallest
    best = mean[spread.argmin()]
    is_elsewhere = np.linalg.norm(mean - best, axis=1) > ELSEWHERE_MM
    if spread.min(where=is_elsewhere, initial=np.inf) <= AMBIGUOUS_RATIO * smallest:
        return np.full(2, np.nan), smallest
    return best, smallest
