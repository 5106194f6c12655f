"""Contours and triangulation by the graphical method of Mirbagheri and others (2007).

A polynomial is fitted to the charge along each line of a mapping scheme. On each line, the point at which the
polynomial is equal to the given charge belongs to the contour. A cubic spline connects the points of all lines. The
spline has free ends and is parametrised by the chord length, like the command SPLINE of AutoCAD. The splines of three
electrodes form three pairs, and the two splines of a pair cross. The position of a press is the mean of three
crossings, with one crossing for each pair. If two splines cross several times, the three crossings that are nearest to
each other are used. In contrast to the graphical method, the modules `field_contours` and `triangulation` compute
contours and positions directly from the charge map.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.contours.charge_curves import Curves
from isocharge.simulate.contours.fix import AMBIGUOUS_RATIO, MIN_DISTANCE, TOLERANCE, Fix, Meeting, check_triangulation
from isocharge.simulate.forward.charge_map import as_charges

DEGREE = 4
"""Default degree of the polynomial along a line.

The paper does not state a degree. Polynomials of a lower degree do not describe the charge near the electrode.
"""

NOWHERE = np.full(2, np.nan)
"""Position of a press whose contours do not meet."""

CHORDS_PER_SPAN = 8
"""Number of chords by which the spline between two neighbouring knots is approximated.

The search for a crossing of two splines starts at a crossing of their chords.
"""

NEWTON_STEPS = 4
"""Number of steps of Newton's method from a crossing of chords to the crossing of the splines."""


@dataclass(frozen=True)
class DrawnContour:
    """Contour of the graphical method: a spline through one point on each line of a mapping scheme.

    Attributes:
        electrode: Name of the electrode.
        charge: Charge of the electrode on the contour, pC.
        knots: Points (x, y) on the lines at which the electrode has this charge, shape (n, 2), mm, with n >= 2. The
            points are in the order of the angles of the lines.
    """

    electrode: str
    charge: float
    knots: Array

    @property
    def points(self) -> Array:
        """Points (x, y) on the spline at which its chords end, shape (n, 2), mm."""
        return np.asarray(self._spline(self._parameters))

    @cached_property
    def _spline(self) -> "scipy.interpolate.CubicSpline":
        """Spline that converts the cumulative chord length of the knots (mm) into the position (x, y), mm."""
        chord_lengths = np.linalg.norm(np.diff(self.knots, axis=0), axis=1)
        parameter = np.concatenate([[0.0], np.cumsum(chord_lengths)])
        return scipy.interpolate.CubicSpline(parameter, self.knots, bc_type="natural")

    @property
    def _parameters(self) -> Array:
        """Parameters of the spline at the ends of its chords in ascending order, shape (n,), mm."""
        knots = self._spline.x
        inner = np.linspace(knots[:-1], knots[1:], CHORDS_PER_SPAN, endpoint=False, axis=1).ravel()
        return np.asarray(np.append(inner, knots[-1]))

    def crossings(self, other: "DrawnContour") -> Array:
        """Find the positions at which this contour crosses another contour.

        Both splines are approximated by chords. Each crossing of two chords is improved by Newton's method.

        Args:
            other: The other contour.

        Returns:
            Positions (x, y), shape (n, 2), mm.
        """
        crossings = []
        for own_chord, other_chord in _chord_crossings(self.points, other.points):
            start = np.array([self._parameters[own_chord], other._parameters[other_chord]])
            crossings.append(self._crossing_near(other, start))
        return np.array(crossings).reshape(-1, 2)

    def _crossing_near(self, other: "DrawnContour", start: Array) -> Array:
        """Find a crossing of this contour and another contour by Newton's method, starting near the crossing.

        Newton's method solves the equation own_spline(p) = other_spline(q) for the parameters p and q of both splines.

        Args:
            other: The other contour.
            start: Parameters of the own spline and of the other spline at which the search starts, shape (2,), mm.

        Returns:
            Position (x, y), shape (2,), mm.
        """
        parameters = start
        for _ in range(NEWTON_STEPS):
            own_parameter, other_parameter = parameters
            gap = self._spline(own_parameter) - other._spline(other_parameter)
            own_tangent = self._spline(own_parameter, 1)  # 1 stands for the first derivative
            other_tangent = other._spline(other_parameter, 1)
            jacobian = np.stack([own_tangent, -other_tangent], axis=1)
            # If the tangents are parallel, the matrix is singular. Therefore the step is the least-squares solution.
            step, *_ = np.linalg.lstsq(jacobian, gap, rcond=None)
            parameters = parameters - step
        own_parameter, _ = parameters
        return np.asarray(self._spline(own_parameter))


def _chord_crossings(first: Array, second: Array) -> Integers:
    """Find all crossings between the chords of two polylines.

    A chord connects two successive points of a polyline.

    Args:
        first: Points (x, y) of the first polyline, shape (n_first, 2), mm.
        second: Points (x, y) of the second polyline, shape (n_second, 2), mm.

    Returns:
        For each crossing, the index of the chord of the first polyline and the index of the chord of the second
        polyline, shape (n, 2).
    """
    # Combine every chord of the first polyline (axis 0) with every chord of the second polyline (axis 1). The shapes
    # broadcast to (n_first - 1, n_second - 1, 2).
    first_chord = np.diff(first, axis=0)[:, None]
    second_chord = np.diff(second, axis=0)[None]
    start_difference = second[None, :-1] - first[:-1, None]  # start of the second chord minus that of the first chord

    # Compute the fractions of the lengths of both chords at which their lines cross (Cramer's rule). For parallel
    # chords, the determinant is zero, and the fractions are infinite or NaN. Such chords do not cross. The fraction 1
    # is excluded, because the end of a chord is the start of the next chord.
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = _cross_product(first_chord, second_chord)
        first_fraction = _cross_product(start_difference, second_chord) / determinant
        second_fraction = _cross_product(start_difference, first_chord) / determinant
        is_on_first = (first_fraction >= 0.0) & (first_fraction < 1.0)
        is_on_second = (second_fraction >= 0.0) & (second_fraction < 1.0)
        return np.argwhere(is_on_first & is_on_second)


def _cross_product(first: Array, second: Array) -> Array:
    """Compute the cross products x1 y2 - y1 x2 of vectors (x1, y1) and (x2, y2) in the plane.

    Args:
        first: First vectors, shape (..., 2).
        second: Second vectors, shape (..., 2).

    Returns:
        Cross products, shape (...).
    """
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def draw_contour(curves: Curves, charge: float, degree: int = DEGREE) -> DrawnContour | None:
    """Draw a contour of the electrode at which the lines of a mapping scheme start.

    The charge along each line is approximated by a polynomial. The contour passes through the points of the lines at
    which the polynomials have the given charge.

    Args:
        curves: Charges along the lines of the mapping scheme.
        charge: Charge of the electrode on the contour, pC.
        degree: Degree of the polynomial along each line.

    Returns:
        The contour; None if the charge occurs on fewer than two lines.

    Raises:
        SceneError: If a line has too few presses for the degree.
    """
    # Find the distance from the electrode on each line; NaN if the charge does not occur on the line.
    mapping = curves.mapping
    polynomials = curves.polynomials(degree)
    distances = np.array([_distance_with_charge(polynomial, charge, mapping.distance) for polynomial in polynomials])
    direction = np.stack([np.cos(mapping.angle), np.sin(mapping.angle)], axis=1)  # unit vectors, shape (n_line, 2)
    points = np.array(mapping.origin) + distances[:, None] * direction
    knots = points[np.isfinite(distances)]
    return DrawnContour(mapping.electrode, charge, knots) if len(knots) > 1 else None


def _distance_with_charge(polynomial: np.polynomial.Polynomial, charge: float, distance: Array) -> float:
    """Find the smallest distance on a line at which the polynomial of the line has a given charge.

    The distance must lie between half of the distance of the first press and the distance of the last press. Outside
    this range, the polynomial does not describe the charge.

    Args:
        polynomial: Polynomial that computes the charge (pC) from the distance (mm).
        charge: Given charge, pC.
        distance: Distances of the presses on the line in ascending order, shape (n_step,), mm.

    Returns:
        Distance, mm; NaN if the charge does not occur in this range.
    """
    roots = (polynomial - charge).roots()
    is_real = np.abs(roots.imag) < 1e-9 * np.abs(distance[-1])  # allows for rounding errors
    real_roots = roots.real[is_real]
    is_on_line = (real_roots >= 0.5 * distance[0]) & (real_roots <= distance[-1])
    roots_on_line = real_roots[is_on_line]
    return float(roots_on_line.min()) if roots_on_line.size else np.nan


class _Location(NamedTuple):
    """Position of one press, or of the point at which three contours meet.

    Attributes:
        position: Position (x, y), shape (2,), mm; NaN if no position was found.
        spread: Largest distance between a crossing of two contours and the mean of three crossings, mm; NaN if no
            position was found.
        status: Whether a position was found, and otherwise the reason.
    """

    position: Array
    spread: float
    status: Meeting


@dataclass(frozen=True)
class DrawnTriangulation:
    """Estimator that determines the positions of presses by drawing contours according to the graphical method.

    Attributes:
        curves: Charges along lines that start at the first electrode, at the second electrode, and so on, in the order
            of the charges.
        degree: Degree of the polynomials along the lines.
        tolerance: Largest distance between a crossing of two contours and the mean of three crossings at which the
            contours meet, mm.
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
        """Draw the contours of all electrodes for the charges of one press.

        Args:
            charge: Touch charges, shape (n_electrode,), pC.

        Returns:
            The contour of each electrode; None for a contour that cannot be drawn.
        """
        return tuple(
            draw_contour(curves, float(electrode_charge), self.degree)
            for curves, electrode_charge in zip(self.curves, charge, strict=True)
        )

    def locate(self, charge: Array) -> Fix:
        """Estimate the positions of presses that have the same force as the presses of the curves.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.

        Returns:
            Position of each press; NaN where the status is not `Meeting.met`.

        Raises:
            ChargeError: If there is not one finite charge for each electrode.
        """
        charge = as_charges(charge, self.electrodes)
        locations = [self._locate_one(press_charge) for press_charge in charge]
        position = np.array([location.position for location in locations]).reshape(-1, 2)
        force = np.full(len(charge), self.curves[0].force)  # all curves and presses have the same force
        return Fix(
            contact=np.column_stack([position, force]),
            spread=np.array([location.spread for location in locations]),
            status=np.array([location.status for location in locations], dtype=np.intp),
        )

    def _locate_one(self, charge: Array) -> _Location:
        """Estimate the position of one press.

        Each triple of contours that meets results in a position with a spread. The position of the press is the mean of
        these positions, and its spread is the largest of these spreads. If a contour cannot be drawn, or no triple
        meets, the position is NaN.

        Args:
            charge: Touch charges, shape (n_electrode,), pC.
        """
        contours = [contour for contour in self.contours(charge) if contour is not None]
        if len(contours) < len(charge):
            return _Location(NOWHERE, np.nan, Meeting.no_contour)

        # A triple of contours has three pairs. It meets if one crossing of each pair is close to the other two.
        indices = range(len(contours))
        crossings = {}
        for first, second in combinations(indices, 2):
            crossings[first, second] = contours[first].crossings(contours[second])
        triple_locations = []
        for triple in combinations(indices, 3):
            crossings_of_pairs = [crossings[pair] for pair in combinations(triple, 2)]
            triple_locations.append(self._locate_triple(crossings_of_pairs))

        met_locations = [location for location in triple_locations if location.status is Meeting.met]
        if not met_locations:
            # Report `Meeting.twice` rather than `Meeting.apart`, which is the smaller number.
            status = max(location.status for location in triple_locations)
            return _Location(NOWHERE, np.nan, status)
        mean_position = np.mean([location.position for location in met_locations], axis=0)
        largest_spread = max(location.spread for location in met_locations)
        return _Location(mean_position, largest_spread, Meeting.met)

    def _locate_triple(self, crossings_of_pairs: list[Array]) -> _Location:
        """Find the point at which three contours meet.

        For each of the three pairs of contours, one crossing is chosen, such that the three crossings are nearest to
        each other. The point at which the contours meet is the mean of these crossings.

        Args:
            crossings_of_pairs: Crossings (x, y) of each of the three pairs of contours, each of shape (m, 2), mm.

        Returns:
            The point with its spread, or the reason why there is no such point.
        """
        # Create all combinations of one crossing of each pair, shape (n_combination, 3, 2). There are none if the
        # contours of a pair do not cross.
        combined_crossings = np.array(list(product(*crossings_of_pairs))).reshape(-1, 3, 2)
        mean = combined_crossings.mean(axis=1)
        spread = np.linalg.norm(combined_crossings - mean[:, None], axis=2).max(axis=1)
        if spread.min(initial=np.inf) > self.tolerance:
            return _Location(NOWHERE, np.nan, Meeting.apart)

        # The point is ambiguous if three crossings at another position are nearly as close together.
        best = spread.argmin()
        is_elsewhere = np.linalg.norm(mean - mean[best], axis=1) > MIN_DISTANCE
        second_smallest_spread = spread[is_elsewhere].min(initial=np.inf)
        if second_smallest_spread <= AMBIGUOUS_RATIO * spread[best]:
            return _Location(NOWHERE, np.nan, Meeting.twice)
        return _Location(mean[best], float(spread[best]), Meeting.met)
