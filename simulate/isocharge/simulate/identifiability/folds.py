"""Search for the folds of a charge map.

Charges Q determine a contact only where the map from (x, y, ln F) to the charges is one to one. Near a fold, different
contacts have the same charges. At a fold, the derivative J = d(Q)/d(x, y, ln F) is singular, and the map reverses its
orientation across the fold. With three electrodes, folds are lines at which det J changes its sign. With more
electrodes, J is not square and is singular only at isolated points. The map intersects itself at a singular point.
Contacts on opposite sides of a singular point therefore have the same charges (Whitney 1944).

The orientation is reversed between two contacts a and b if det(J(a)' W J(b)) < 0, where the diagonal matrix W contains
the inverse variances of the charges. For three electrodes, this determinant has the same sign as the product det J(a)
det J(b). For more electrodes, the criterion is reliable only if the two contacts are close to each other. Between
distant contacts, the directions of the derivatives may change by more than a right angle even if there is no fold. An
example are contacts on opposite sides of an electrode. If the orientation is reversed between the ends of a segment,
the segment is therefore bisected. The bisection ends when the segment is shorter than `SEGMENT_LENGTH`, or when the
orientation is reversed in neither half. A fold may be smaller than the spacing of the grid. In order to find such
folds, the module searches for positions where the smallest singular value of J has a minimum.

If all electrodes of an isotropic film lie on one circle, a press and its mirror image in this circle cause nearly the
same charges. The map therefore has a fold near the circle for any number of electrodes.

Even without folds, two distant contacts may have the same charges. The module `ambiguous_pairs` finds such contacts.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.forward.charge_map import ChargeMap, linearised
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import INNER_RADIUS, Rings, onto_disk

SEGMENT_LENGTH = 0.02
"""Length of a segment with reversed orientation below which the segment counts as a fold, mm.

Beside an electrode, the orientation may be reversed within 0.1 mm without a fold. At a true fold, such as that on a
circle of four electrodes, the orientation is reversed within about 0.01 mm.
"""

MAX_STEPS = 40
"""Largest number of steps of the compass search.

The search for most minima needs 8 to 20 steps. For a minimum in a narrow valley, it needs more steps.
"""

MIN_COMPASS_STEP = 0.1 * SEGMENT_LENGTH
"""Length of a step below which the compass search ends, mm."""

_COMPASS_ANGLE = np.pi * np.arange(8) / 4.0

COMPASS = np.stack([np.cos(_COMPASS_ANGLE), np.sin(_COMPASS_ANGLE)], axis=1)
"""Unit vectors in eight directions, shape (8, 2). The vectors i and i + 4 are opposite."""


def has_reversed_orientation(first: Array, second: Array) -> Booleans:
    """Return whether the charge map reverses its orientation between the two contacts of each pair.

    Args:
        first: Derivatives of the charges with respect to (x, y, ln F) at the first contact of each pair, divided by the
            standard deviations of the charges, shape (..., n_electrode, 3).
        second: Scaled derivatives at the second contact of each pair, shape (..., n_electrode, 3).

    Returns:
        Whether the orientation is reversed, shape (...).
    """
    first_directions = _unit_columns(first)
    second_directions = _unit_columns(second)

    # Scalar products of the columns (i of the first, j of the second contact): sums over the electrodes (index e)
    products = np.einsum("...ei,...ej->...ij", first_directions, second_directions)
    return np.asarray(np.linalg.det(products) < 0.0)


def _unit_columns(jacobian: Array) -> Array:
    """Scale the columns of matrices to unit length.

    Without this scaling, rounding errors could change the sign of the determinant of their products.

    Args:
        jacobian: Matrices of derivatives, shape (..., n_electrode, 3).

    Returns:
        Matrices with columns of length 1, of the same shape. Columns of zeros remain zero.
    """
    length = np.linalg.norm(jacobian, axis=-2, keepdims=True)
    return np.asarray(jacobian / np.maximum(length, np.finfo(float).tiny))


def scaled_derivatives(charge_map: ChargeMap, contact: Array, noise: NoiseModel) -> Array:
    """Compute derivatives of charges, and divide the derivatives by the standard deviations of the charges.

    Args:
        charge_map: Map that computes the charges of contacts.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        noise: Noise of the readings.

    Returns:
        Scaled derivatives with respect to x (1/mm), y (1/mm) and ln F (dimensionless), shape (n, n_electrode, 3).
    """
    charge, jacobian = linearised(charge_map, contact)
    return np.asarray(jacobian / noise.sigma(charge)[..., None])


def singular_values(scaled_jacobian: Array) -> Array:
    """Compute how strongly the charges depend on the position if the force is unknown.

    A change of the charges contains no information about the position if a change of the force could also have caused
    it. The derivatives with respect to x and y are therefore projected onto the subspace that is orthogonal to the
    derivative with respect to ln F. The singular values of the projected derivatives are the inverses of two standard
    deviations: those of the position in the best direction and in the worst direction. At a fold, the second singular
    value is zero.

    Args:
        scaled_jacobian: Derivatives of the charges with respect to x, y and ln F, divided by the standard deviations of
            the charges, shape (n, n_electrode, 3).

    Returns:
        Two singular values for each contact in descending order, shape (n, 2), 1/mm.
    """
    position_derivative = scaled_jacobian[:, :, :2]
    force_derivative = scaled_jacobian[:, :, 2]
    force_length = np.linalg.norm(force_derivative, axis=1, keepdims=True)
    force_direction = force_derivative / np.maximum(force_length, np.finfo(float).tiny)  # unit vectors

    # Subtract the component along `force_direction`. It is a scalar product, which is a sum over the electrodes (e).
    component = np.einsum("ne,nei->ni", force_direction, position_derivative)  # shape (n, 2)
    across_force = position_derivative - force_direction[:, :, None] * component[:, None, :]
    return np.asarray(np.linalg.svd(across_force, compute_uv=False))


@dataclass(frozen=True)
class Folds:
    """Folds of a charge map for one force, and the positions about which the charges contain least information.

    Attributes:
        points: Positions (x, y) on folds, ordered by the distance from the centre, shape (n, 2), mm. With three
            electrodes, the positions lie on fold lines. With more electrodes, they are points where the derivative of
            the charges is singular.
        weakest: Positions (x, y) where the smallest singular value of the derivative has a local minimum, shape (k, 2),
            mm. The position error has local maxima at these positions, which may lie between the positions of a grid.
    """

    points: Array
    weakest: Array


def find_folds(charge_map: ChargeMap, rings: Rings, force: float, noise: NoiseModel) -> Folds:
    """Find the folds of a charge map for contacts that all have the same force.

    Args:
        charge_map: Map that computes the charges of contacts.
        rings: Positions between which folds are searched for. A fold may be smaller than the spacing of the positions.
        force: Force of the contacts, N.
        noise: Noise of the readings.

    Returns:
        The folds, and the positions where the charges contain least information about the position.
    """
    search = _FoldSearch(charge_map, noise, force)
    jacobian_of_positions = search.scaled_jacobian(rings.position.reshape(-1, 2))
    scaled_jacobian = rings.per_ring(jacobian_of_positions)  # shape (n_ring, n_angle, n_electrode, 3)
    weakest = search.weakest_positions(rings, scaled_jacobian)

    # Large folds lie between neighbouring positions. A small fold may lie at one of the weakest positions.
    points = np.concatenate([search.folds_between(rings, scaled_jacobian), search.folds_near(weakest)])

    # Sort the folds by their distance from the centre.
    x, y = points.T
    ascending_distance = np.argsort(np.hypot(x, y), kind="stable")
    return Folds(points[ascending_distance], weakest)


class _FoldSearch:
    """Search for the folds of a charge map for contacts that all have the same force.

    Scaled derivatives are the derivatives of the charges with respect to (x, y, ln F), divided by the standard
    deviations of the charges.
    """

    def __init__(self, charge_map: ChargeMap, noise: NoiseModel, force: float) -> None:
        """Prepare the search.

        Args:
            charge_map: Map that computes the charges of contacts.
            noise: Noise of the readings.
            force: Force of all contacts, N.
        """
        self.charge_map = charge_map
        self.noise = noise
        self.force = force
        self.radius = INNER_RADIUS * charge_map.domain.radius

    def scaled_jacobian(self, position: Array) -> Array:
        """Compute the scaled derivatives at positions.

        Args:
            position: Positions (x, y), shape (n, 2), mm. Positions outside the domain are moved to its edge.

        Returns:
            Scaled derivatives, shape (n, n_electrode, 3).
        """
        inside = onto_disk(position, self.radius)
        contact = np.column_stack([inside, np.full(len(inside), self.force)])
        return scaled_derivatives(self.charge_map, contact, self.noise)

    def smallest_singular_value(self, position: Array) -> Array:
        """Compute the smaller of the two `singular_values` at each position.

        Args:
            position: Positions (x, y), shape (n, 2), mm.

        Returns:
            Smaller singular value, shape (n,), 1/mm.
        """
        return singular_values(self.scaled_jacobian(position))[:, 1]

    def folds_between(self, rings: Rings, scaled_jacobian: Array) -> Array:
        """Find folds between neighbouring positions on the same ring or on neighbouring rings.

        A fold lies between two positions if the charge map has opposite orientations at these positions.

        Args:
            rings: Positions between which folds are searched for.
            scaled_jacobian: Scaled derivatives at all positions, shape (n_ring, n_angle, n_electrode, 3).

        Returns:
            Positions (x, y) on folds, shape (n, 2), mm.
        """
        position = rings.position
        next_on_ring = np.roll(position, -1, axis=1)
        next_jacobian_on_ring = np.roll(scaled_jacobian, -1, axis=1)

        # A radial fold lies between two neighbouring rings. A ring fold lies between two positions on the same ring.
        has_radial_fold = has_reversed_orientation(scaled_jacobian[:-1], scaled_jacobian[1:])
        has_ring_fold = has_reversed_orientation(scaled_jacobian, next_jacobian_on_ring)
        first_end = np.concatenate([position[:-1][has_radial_fold], position[has_ring_fold]])
        second_end = np.concatenate([position[1:][has_radial_fold], next_on_ring[has_ring_fold]])
        return self._bisect(first_end, second_end)

    def _bisect(self, first: Array, second: Array) -> Array:
        """Bisect segments until they are shorter than `SEGMENT_LENGTH`.

        The charge map has opposite orientations at the two ends of a segment. In each round, a segment is replaced by
        the half in which the orientation is reversed.

        Args:
            first: First ends (x, y) of the segments, shape (n, 2), mm.
            second: Second ends (x, y) of the segments, shape (n, 2), mm.

        Returns:
            Centres (x, y) of the final segments, shape (m, 2), mm. Segments with a fold in neither half are omitted.
        """
        if not len(first):
            return np.empty((0, 2))
        points = []
        first_jacobian = self.scaled_jacobian(first)
        second_jacobian = self.scaled_jacobian(second)
        while len(first):
            # Store the centres of short segments.
            middle = 0.5 * (first + second)
            x_length, y_length = (second - first).T
            is_short = np.hypot(x_length, y_length) <= SEGMENT_LENGTH
            points.append(middle[is_short])

            # Find the half of each other segment in which the orientation is reversed. A segment is dropped if the
            # orientation is reversed in neither half. If it is reversed in both halves, the first half is used.
            middle_jacobian = self.scaled_jacobian(middle)
            in_first_half = has_reversed_orientation(first_jacobian, middle_jacobian)
            in_second_half = has_reversed_orientation(middle_jacobian, second_jacobian)
            remaining = ~is_short & (in_first_half | in_second_half)
            use_second_half = (in_second_half & ~in_first_half)[remaining]

            # Shorten each remaining segment to the half that is used. The middle becomes the first end of the second
            # half, or the second end of the first half. The scaled derivatives at the ends are replaced accordingly.
            use_second_position = use_second_half[:, None]  # broadcasts with shape (n, 2)
            first = np.where(use_second_position, middle[remaining], first[remaining])
            second = np.where(use_second_position, second[remaining], middle[remaining])
            use_second_matrix = use_second_half[:, None, None]  # broadcasts with shape (n, n_electrode, 3)
            first_jacobian = np.where(use_second_matrix, middle_jacobian[remaining], first_jacobian[remaining])
            second_jacobian = np.where(use_second_matrix, second_jacobian[remaining], middle_jacobian[remaining])
        return np.concatenate(points)

    def weakest_positions(self, rings: Rings, scaled_jacobian: Array) -> Array:
        """Find the positions where the smallest singular value of the scaled derivatives has a local minimum.

        A search starts at each position on the rings if no neighbouring position has a smaller singular value.

        Args:
            rings: Positions from which the starting positions are chosen.
            scaled_jacobian: Scaled derivatives at all positions, shape (n_ring, n_angle, n_electrode, 3).

        Returns:
            Positions (x, y) of the minima, shape (n, 2), mm.
        """
        n_ring, n_angle, _, _ = scaled_jacobian.shape
        jacobian_of_positions = scaled_jacobian.reshape(-1, *scaled_jacobian.shape[2:])
        _, smaller_singular_value = singular_values(jacobian_of_positions).T
        value_on_rings = smaller_singular_value.reshape(n_ring, n_angle)

        # The filter returns the smallest value among 3 x 3 positions: the position itself and its neighbours on the
        # same ring and on the two neighbouring rings. The angles are periodic.
        neighbourhood_minimum = scipy.ndimage.minimum_filter(value_on_rings, 3, mode=("nearest", "wrap"))
        is_minimum = value_on_rings == neighbourhood_minimum

        # The first step of a search is the larger distance between neighbouring positions: on the same ring or between
        # rings. The distance between rings is equal to the radius of the innermost ring.
        spacing_on_ring = rings.distance * 2.0 * np.pi / n_angle
        spacing_between_rings = rings.distance[0]
        first_step = np.maximum(spacing_between_rings, spacing_on_ring)
        ring, _ = np.nonzero(is_minimum)
        return self._minimise(rings.position[is_minimum], value_on_rings[is_minimum], first_step[ring])

    def folds_near(self, position: Array) -> Array:
        """Select the positions at which the orientation of the charge map is reversed.

        The orientations are compared at opposite points of a circle around each position. The diameter of the circle is
        `SEGMENT_LENGTH`.

        Args:
            position: Positions (x, y), shape (n, 2), mm.

        Returns:
            Selected positions (x, y), shape (m, 2), mm.
        """
        circle_points = position[:, None] + 0.5 * SEGMENT_LENGTH * COMPASS  # shape (n, 8, 2)
        scaled_jacobian = self.scaled_jacobian(circle_points.reshape(-1, 2))
        jacobian_on_circle = scaled_jacobian.reshape(len(position), len(COMPASS), *scaled_jacobian.shape[1:])
        half = len(COMPASS) // 2  # the points i and i + half are opposite
        is_reversed = has_reversed_orientation(jacobian_on_circle[:, :half], jacobian_on_circle[:, half:])
        return np.asarray(position[is_reversed.any(axis=1)])  # `is_reversed` has the shape (n, 4)

    def _minimise(self, start: Array, start_value: Array, first_step: Array) -> Array:
        """Find local minima of the smallest singular value by a compass search (Kolda, Lewis and Torczon 2003).

        One search starts at each position, and all searches run together. In each round, a search evaluates the
        singular value at eight points around its position. If the best of the eight points has a smaller singular value
        than the position, the search moves to the best point. If no point has a smaller singular value, the search
        halves its step length. A search ends when its step length is at most `MIN_COMPASS_STEP`.

        Args:
            start: Starting positions (x, y), shape (n, 2), mm.
            start_value: Smallest singular value at these positions, shape (n,), 1/mm.
            first_step: First step length of each search, shape (n,), mm.

        Returns:
            Positions (x, y) of the minima, shape (n, 2), mm.
        """
        position = start.copy()
        value = start_value.copy()
        step_length = first_step.copy()
        active = np.flatnonzero(step_length > MIN_COMPASS_STEP)  # indices of the searches that have not ended
        for _ in range(MAX_STEPS):
            if not active.size:
                break

            # Find the best of the eight neighbours of the position of each active search.
            compass_steps = step_length[active, None, None] * COMPASS  # shape (n_active, 8, 2)
            compass_points = position[active, None] + compass_steps
            neighbours = onto_disk(compass_points.reshape(-1, 2), self.radius)  # shape (n_active * 8, 2)
            neighbour_values = self.smallest_singular_value(neighbours).reshape(-1, len(COMPASS))
            best_direction = neighbour_values.argmin(axis=1)
            active_rows = np.arange(active.size)
            best_neighbour = neighbours.reshape(-1, len(COMPASS), 2)[active_rows, best_direction]
            best_value = neighbour_values[active_rows, best_direction]

            # Move to this neighbour if its value is smaller than that of the position. Otherwise halve the step length.
            is_lower = best_value < value[active]
            moving = active[is_lower]
            position[moving] = best_neighbour[is_lower]
            value[moving] = best_value[is_lower]
            step_length[active[~is_lower]] *= 0.5
            active = active[step_length[active] > MIN_COMPASS_STEP]
        return position
