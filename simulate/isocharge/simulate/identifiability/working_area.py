"""Computation of the working area: the disk in which the charges determine the contact.

Charges Q determine a contact only where the map from (x, y, ln F) to the charges is one to one. Near a fold, different
contacts have the same charges. At a fold, the derivative J = d(Q)/d(x, y, ln F) is singular, so that the Cramer-Rao
limit of the position is infinite. Across a fold, the map reverses its orientation. With three electrodes, folds are
lines at which det J changes its sign. With more electrodes, J is not square and is singular only at isolated points
(Whitney 1944).

The search refines the maxima of the position error on a grid. A maximum is a fold if the orientation of the map is
reversed across it. The orientation is reversed between two contacts a and b if det(J(a)' W J(b)) < 0, where the
diagonal matrix W contains the inverse variances of the charges. For more than three electrodes, this criterion is
reliable only for contacts that are close to each other. Beside an electrode, the directions of the derivatives may
change by more than a right angle within 0.1 mm although there is no fold.

If all electrodes of an isotropic film lie on one circle, a press and its mirror image in this circle cause nearly the
same charges. The map therefore has a fold near the circle for any number of electrodes.

Even without folds, two distant contacts may have the same charges. The search for such pairs covers the whole domain of
the map.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.forward.charge_map import ChargeMap, check_electrode_count
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.nearest_contact import local_minima
from isocharge.simulate.noise import NoiseModel
from isocharge.simulate.numerics.disk import INNER_RADIUS, Rings, contacts_at, onto_disk, sunflower
from isocharge.simulate.numerics.polygon import to_corners
from isocharge.simulate.sensor.film import tidy

FOLD_WIDTH = 0.02
"""Distance between two contacts on opposite sides of a fold, mm.

Beside an electrode, the orientation may be reversed within 0.1 mm although there is no fold. At a true fold, such as
the fold on a circle through four electrodes, the orientation is reversed within about 0.01 mm.
"""


def find_folds(charge_map: ChargeMap, rings: Rings, force: float, noise: NoiseModel) -> tuple[Array, Array]:
    """Find the folds of a charge map for contacts that all have the same force.

    At a fold, the map from contacts to charges turns back, so that contacts on both sides of the fold have the same
    charges. At a fold, the position error of an estimate from noisy charges is infinite (Cramer-Rao limit).

    Args:
        charge_map: Map that computes the charges of contacts (x, y, F).
        rings: Positions at which the search starts.
        force: Force of the contacts, N.
        noise: Noise of the readings.

    Returns:
        Positions (x, y) on folds, ordered by the distance from the centre, shape (n, 2), mm. With three electrodes, the
        positions lie on fold lines. With more electrodes, folds are single points. The second array contains the
        position errors on the rings, shape (n_ring, n_angle), mm.
    """
    radius = INNER_RADIUS * charge_map.domain.radius  # smaller by a rounding error

    def position_error(position: Array) -> Array:
        """Return the Cramer-Rao position error at positions of shape (..., 2), which is infinite at a fold."""
        contact = contacts_at(position.reshape(-1, 2), force)
        return limits_at(charge_map, contact, noise).position.reshape(position.shape[:-1])

    # The search for folds starts where the reciprocal of the error is small, because it is zero at a fold. The initial
    # step of each position is the distance of its farther neighbour on the rings, shape (n,), mm.
    error_on_rings = position_error(onto_disk(rings.position, radius))
    position, step = _starting_points(rings, 1.0 / error_on_rings)

    # Refine the maxima of the error. In each round, the step is halved, and each position moves to the point with the
    # largest error among 25 points: itself and the 24 points that are up to two steps away along x and y.
    grid_y, grid_x = np.indices((5, 5)) - 2  # from -2 to 2
    neighbours = np.column_stack([grid_x.ravel(), grid_y.ravel()])  # in steps, shape (25, 2)
    while step.max() > 0.05 * FOLD_WIDTH:
        step *= 0.5
        trial = onto_disk(position[:, None] + step[:, None, None] * neighbours, radius)  # shape (n, 25, 2)
        largest_error = position_error(trial).argmax(axis=1)  # index of the point, shape (n,)
        position = trial[np.arange(len(trial)), largest_error]

    # A position is on a fold if the charge map reverses its orientation between two opposite points of a small circle
    # around the position. Four pairs of opposite points are tried. The angles of their first points cover half a turn.
    angle = np.pi * np.arange(4) / 4.0
    offset = 0.5 * FOLD_WIDTH * to_corners(np.exp(1j * angle))  # from the position to a point, shape (4, 2)
    opposite_points = np.stack([position[:, None] + offset, position[:, None] - offset])  # shape (2, n, 4, 2)
    is_reversed = _reverses_orientation(charge_map, onto_disk(opposite_points, radius), force, noise)  # shape (n, 4)
    folds = position[is_reversed.any(axis=1)]
    distance = np.hypot(*folds.T)
    return folds[np.argsort(distance, kind="stable")], error_on_rings


def _reverses_orientation(charge_map: ChargeMap, pairs: Array, force: float, noise: NoiseModel) -> Booleans:
    """Return whether a charge map reverses its orientation between the two positions of each pair.

    Let J1 and J2 be the derivatives of the charges at the two positions, divided by the noise of the charges. The
    orientation is reversed if det(J1' J2) is negative. With three electrodes, det(J1' J2) is the product of det(J1) and
    det(J2), and is negative if they have different signs. With more electrodes, J1 and J2 are not square and have no
    determinants.

    Args:
        charge_map: Map that computes the charges of contacts.
        pairs: Positions (x, y), shape (2, ..., 2), mm. The first axis is the position of a pair.
        force: Force of the contacts, N.
        noise: Noise of the readings.

    Returns:
        Whether the orientation is reversed, shape (...).
    """
    charge, jacobian = charge_map.linearised(contacts_at(pairs.reshape(-1, 2), force))
    scaled_jacobian = jacobian / noise.sigma(charge)[..., None]
    jacobian_1, jacobian_2 = scaled_jacobian.reshape(*pairs.shape[:-1], -1, 3)  # each of shape (..., n_electrode, 3)
    determinant: Array = np.linalg.det(jacobian_1.swapaxes(-1, -2) @ jacobian_2)
    return determinant < 0.0


def _starting_points(rings: Rings, precision: Array) -> tuple[Array, Array]:
    """Choose the positions on rings near which a fold may lie.

    At a fold, contacts on both sides have the same charges, and the position error is infinite.

    Args:
        rings: Positions on concentric rings, whose distances are equal. Each ring is closed.
        precision: Inverse of the position error at each position, shape (n_ring, n_angle); zero at a fold.

    Returns:
        Positions (x, y), shape (n, 2), mm, and the distance of each position from its farthest neighbour, shape (n,),
        mm.
    """
    # A position is chosen if none of its eight neighbours has a smaller precision. The neighbours are on the same ring,
    # which is closed ("wrap"), and on the two adjacent rings. The first and the last ring take the place of the
    # adjacent ring that they do not have ("nearest").
    smallest_around = scipy.ndimage.minimum_filter(precision, 3, mode=("nearest", "wrap"))
    is_chosen = precision == smallest_around

    # Along a fold line, the precision has a kink: it decreases to zero and increases again. There may be no minimum at
    # the position nearest to the fold, because the precision also changes along the fold line. Two opposite neighbours
    # are therefore compared. Where the precision is smooth, it is about half of their sum. If it is at most a third of
    # the sum, it has a kink, and the position is also chosen. First, the neighbours on the same ring are compared, then
    # those on the two adjacent rings.
    sum_along_ring = np.roll(precision, 1, axis=1) + np.roll(precision, -1, axis=1)
    is_chosen |= 3.0 * precision <= sum_along_ring
    sum_across_rings = precision[:-2] + precision[2:]
    is_chosen[1:-1] |= 3.0 * precision[1:-1] <= sum_across_rings

    # Compute the distance of the farther neighbour, which is on the same ring or on the adjacent ring.
    ring_of_chosen, _ = np.nonzero(is_chosen)
    spacing_between_rings = rings.distance[0]
    spacing_on_ring = rings.distance * math.tau / precision.shape[1]
    neighbour_distance = np.maximum(spacing_between_rings, spacing_on_ring)  # shape (n_ring,)
    return rings.position[is_chosen], neighbour_distance[ring_of_chosen]


INDISTINGUISHABLE_SIGMAS = 3.0
"""Difference of the charges below which two contacts are indistinguishable, in standard deviations of the noise."""

MIN_DISTANCE = 1.0
"""Smallest distance between the contacts of an ambiguous pair, mm. On a small film, `MIN_RELATIVE_DISTANCE` applies."""

MIN_RELATIVE_DISTANCE = 0.1
"""Smallest distance between the contacts of an ambiguous pair if the domain is small, in radii of the domain."""

MIN_DISTANCE_SIGMAS = 6.0
"""Smallest distance between the contacts of an ambiguous pair, in standard deviations of the position.

If the distance is smaller, the two contacts count as a single contact with a large uncertainty.
"""

STARTS = 3
"""Number of searches for a second contact with the charges of a first contact.

Mostly, one of the searches finds the first contact itself.
"""


@dataclass(frozen=True)
class AmbiguousPairs:
    """Pairs of distant contacts that have the same charges.

    The outer contact of a pair is the contact that is farther from the centre of the film. The pairs are ordered by the
    distance of the outer contact from the centre.

    Attributes:
        first: First contact (x, y, F) of each pair, shape (n, 3), mm and N.
        second: Second contact (x, y, F) of each pair, shape (n, 3), mm and N.
        charge_difference: Norm of the difference between the charges of the two contacts of each pair, shape (n,), in
            standard deviations of the noise.
    """

    first: Array
    second: Array
    charge_difference: Array

    def __len__(self) -> int:
        return len(self.first)

    @property
    def outer_radius(self) -> Array:
        """Distance between the centre of the film and the outer contact of each pair, shape (n,), mm."""
        contacts = np.stack([self.first, self.second])
        return np.asarray(np.linalg.norm(contacts[:, :, :2], axis=2).max(axis=0))

    @property
    def radius(self) -> float:
        """Radius of the smallest disk around the centre that contains both contacts of a pair, mm.

        The radius is infinite if there are no pairs.
        """
        return float(self.outer_radius.min(initial=np.inf))

    @property
    def summary(self) -> str:
        """Sentence about the pair whose outer contact is nearest to the centre of the film, which is the first pair.

        If there are no pairs, the property is an empty text.
        """
        if not len(self):
            return ""
        x, y, force = self.first[0]
        other_x, other_y, other_force = self.second[0]
        return (
            f"Contacts far apart can have the same charges: the charges of {force:.3g} N at ({x:.1f}, {y:.1f}) mm and "
            f"of {other_force:.3g} N at ({other_x:.1f}, {other_y:.1f}) mm differ by {self.charge_difference[0]:.1f} "
            "standard deviations."
        )


NO_PAIRS = AmbiguousPairs(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
"""Result without ambiguous pairs."""


def find_ambiguous_pairs(
    charge_map: ChargeMap, noise: NoiseModel, forces: Sequence[float], places: int = 1000
) -> AmbiguousPairs:
    """Find pairs of distant contacts whose charges cannot be distinguished because of the noise.

    The first contact of a pair is a press with one of the given forces at one of several positions. For each first
    contact, several searches start at distant contacts with similar charges, and look for contacts with equal charges.

    Args:
        charge_map: Map that computes the charges of contacts.
        noise: Noise of the readings.
        forces: Forces of the first contacts, N. The second contact of a pair may have any force of the map.
        places: Number of positions of the first contacts, which are distributed evenly over the disk.

    Returns:
        The pairs, ordered by the distance of the outer contact from the centre. The outer contact is the contact that
        is farther from the centre.
    """
    # Choose n first contacts (x, y, F). For each of them, several searches find a second contact with similar charges.
    # Their tolerance is coarse, because one digit of the difference of the charges is sufficient.
    domain_radius = charge_map.domain.radius
    first_position = INNER_RADIUS * domain_radius * sunflower(places)
    contact = np.concatenate([contacts_at(first_position, force) for force in forces])  # shape (n, 3)
    charge = charge_map.charges(contact)
    # The residual is the difference of the charges in standard deviations, shape (n, STARTS, n_electrode).
    second, residual = local_minima(charge_map, charge, noise.sigma(charge), starts=STARTS, min_change=1e-4)
    first = np.broadcast_to(contact[:, None], second.shape)  # shape (n, STARTS, 3), like `second`

    # Select the pairs whose positions are distant, and whose charges agree within the noise. The results of searches
    # that find the first contact again are thus discarded.
    second_position = second[:, :, :2]
    distance = np.linalg.norm(second_position - first[:, :, :2], axis=2)  # shape (n, STARTS), mm
    position_std = limits_at(charge_map, contact, noise).position  # of an estimated position, shape (n,), mm
    min_distance = min(MIN_DISTANCE, MIN_RELATIVE_DISTANCE * domain_radius)
    min_distance_of_contact = np.maximum(min_distance, MIN_DISTANCE_SIGMAS * position_std)
    is_distant = distance > min_distance_of_contact[:, None]
    charge_difference = np.linalg.norm(residual, axis=2)  # in standard deviations of the noise
    is_ambiguous = is_distant & (charge_difference < INDISTINGUISHABLE_SIGMAS)

    # Several searches of a first contact often find the same second contact, which counts once.
    is_ambiguous &= ~_is_repeated(second_position, is_ambiguous, position_std)
    pairs = AmbiguousPairs(first[is_ambiguous], second[is_ambiguous], charge_difference[is_ambiguous])
    order = np.argsort(pairs.outer_radius, kind="stable")
    return AmbiguousPairs(pairs.first[order], pairs.second[order], pairs.charge_difference[order])


def _is_repeated(position: Array, is_selected: Booleans, tolerance: Array) -> Booleans:
    """Return for each position whether it repeats an earlier selected position in the same row.

    Args:
        position: Positions (x, y), shape (n_row, n, 2), mm.
        is_selected: Whether each position is selected, shape (n_row, n).
        tolerance: Distance below which two positions of a row are the same, shape (n_row,), mm.

    Returns:
        Whether each position is repeated, shape (n_row, n).
    """
    is_repeated = np.zeros_like(is_selected)
    for earlier, later in combinations(range(position.shape[1]), 2):
        distance = np.linalg.norm(position[:, later] - position[:, earlier], axis=1)
        is_repeated[:, later] |= (distance < tolerance) & is_selected[:, earlier]
    return is_repeated


DEFAULT_ERROR = 1.0
"""Default value of the largest Cramer-Rao position error in a working area, mm.

This value is the radius of the default probe.
"""

RADIUS_STEP = 0.1
"""The radius of a working area is rounded down to a multiple of this step, mm."""

MAX_RINGS = 200
"""Largest number of rings on which the position error is evaluated.

On a large disk, the distance between the rings is a larger multiple of `RADIUS_STEP`.
"""

Bound = Literal["fold", "twins", "error", "searched"]
"""Reason for the radius of a working area.

"twins" stands for an ambiguous pair, and "searched" means that only the radius of the search bounds the area. The error
grows without limit towards a fold. An area that ends just before a fold therefore mostly has the bound "error".
"""


@dataclass(frozen=True)
class WorkingArea:
    """Largest disk around the centre of the film within which the charges determine the contact.

    Attributes:
        radius: Radius of the disk, rounded down to a multiple of 0.1 mm, mm; 0 if there is no working area.
        bound: Reason for the radius.
        fold_radius: Distance of the nearest fold from the centre, mm; infinite if there are no folds.
        error_radius: Radius within which the position error is at most `error` for every force, mm.
        error_force: Force with the largest error at the distance where the position error first exceeds `error`, N.
        error: Largest allowed Cramer-Rao position error (root mean square), mm.
        search_radius: Radius of the disk that was searched for the working area, mm.
        force_range: Smallest and largest force of the contacts, N.
        folds: Positions (x, y) on folds, shape (n, 2), mm.
        pairs: Pairs of distant contacts with the same charges.
        electrodes: Number of electrodes of the sensor.
    """

    radius: float
    bound: Bound
    fold_radius: float
    error_radius: float
    error_force: float
    error: float
    search_radius: float
    force_range: tuple[float, float]
    folds: Array
    pairs: AmbiguousPairs
    electrodes: int

    @property
    def unambiguous_radius(self) -> float:
        """Radius of the largest disk without folds and ambiguous pairs, mm. The position error may exceed its limit."""
        return _round_down(min(self.fold_radius, self.pairs.radius, self.search_radius))

    @property
    def summary(self) -> str:
        """Sentences that describe the working area and the reason for its radius.

        The attribute `bound` is the reason: "error" if the position error exceeds the limit `error` (mm) beyond the
        radius, "fold" or "twins" (an ambiguous pair), or "searched" if only the radius of the search bounds the area.
        """
        min_force, max_force = self.force_range
        sentences = [f"Working area: up to {self.radius:.3g} mm from the centre, {min_force:g} to {max_force:g} N."]
        if self.bound == "error":
            if self.unambiguous_radius > self.radius:
                sentences.append(f"Up to {self.unambiguous_radius:.3g} mm, the charges determine the contact uniquely.")
            sentences.append(
                f"Beyond {self.radius:.3g} mm, the position error exceeds {self.error:.3g} mm at "
                f"{self.error_force:.3g} N."
            )
        if np.isfinite(self.fold_radius):
            # With three electrodes, folds are lines. With more electrodes, they are single points.
            fold = "the fold" if self.electrodes == 3 else "the points where it loses rank"
            sentences.append(
                f"The map folds {self.fold_radius:.1f} mm from the centre: contacts on both sides of {fold} give the "
                "same charges, and no method can distinguish these contacts by one reading."
            )
        if len(self.pairs):
            sentences.append(self.pairs.summary)
        if self.bound == "searched":
            sentences.append(f"The search ended at {self.search_radius:.3g} mm.")
        return " ".join(sentences)


def working_area(
    charge_map: ChargeMap, noise: NoiseModel, *, error: float = DEFAULT_ERROR, search_pairs: bool = True
) -> WorkingArea:
    """Find the working area of a sensor: the largest disk in which the charges determine the contact.

    The radius of the working area is the smallest of four radii: the distance from the centre at which the position
    error first exceeds its limit, the distance of the nearest fold, the radius of the nearest ambiguous pair, and the
    radius of the domain. At a fold, the map from contacts to charges turns back. An ambiguous pair consists of two
    distant contacts with the same charges.

    The errors, folds and pairs are computed at several forces, each at most 1.7 times the previous one. On a taut film,
    the charges change their sign with increasing force, and a fold or an ambiguous pair may exist at only one of the
    forces.

    For forces from 0.05 to 2 N, the charge map is evaluated for about 500,000 contacts, or for about 200,000 contacts
    without the search for ambiguous pairs. Use a `ChargeSpline` instead of a forward map, which would take minutes.

    Args:
        charge_map: Map that computes the charges of contacts.
        noise: Noise of the readings. The white noise must be positive.
        error: Largest Cramer-Rao position error that is allowed for every force, mm.
        search_pairs: Whether to search for pairs of distant contacts with the same charges.

    Raises:
        SceneError: If the map has fewer than three electrodes, or if there is no white noise.
    """
    check_electrode_count(len(charge_map.electrodes))
    noise.check_white()
    search_radius = charge_map.domain.radius
    min_force, max_force = charge_map.domain.force_range
    n_force = 1 + math.ceil(2.0 * math.log(max_force / min_force))  # two for each factor of e
    forces = np.geomspace(min_force, max_force, n_force).tolist()

    # The distances of the rings are multiples of the step to which the radius of the working area is rounded.
    step = RADIUS_STEP * np.ceil(search_radius / (MAX_RINGS * RADIUS_STEP))
    n_rings = max(1, round(_round_down(search_radius, step) / step))
    rings = Rings.spread(min(n_rings * step, search_radius), n_rings)

    # Find the folds, the largest error on each ring for each force, and the ambiguous pairs.
    results = [find_folds(charge_map, rings, force, noise) for force in forces]
    folds = np.concatenate([folds_of_force for folds_of_force, _ in results])
    ring_errors = np.array([error_on_rings.max(axis=1) for _, error_on_rings in results])  # shape (n_force, n_rings)
    fold_radius = float(np.hypot(*folds.T).min(initial=np.inf))
    pairs = find_ambiguous_pairs(charge_map, noise, forces) if search_pairs else NO_PAIRS

    # Find the last ring before the error first exceeds its limit. An error that is NaN exceeds it.
    is_within_limit = (ring_errors <= error).all(axis=0)
    first_exceeding = is_within_limit.argmin()  # index of the ring; 0 if there is none
    error_radius = search_radius
    if not is_within_limit.all():
        radius_before_ring = np.append(0.0, rings.distance)
        error_radius = float(radius_before_ring[first_exceeding])

    # The smallest of the following radii bounds the working area. The first of several equal radii is the bound: if the
    # error never exceeds its limit, `error_radius` is the radius of the search.
    radii: dict[Bound, float] = {
        "searched": search_radius,
        "fold": fold_radius,
        "twins": pairs.radius,
        "error": error_radius,
    }
    bound = min(radii, key=lambda reason: radii[reason])
    return WorkingArea(
        radius=_round_down(radii[bound]),
        bound=bound,
        fold_radius=fold_radius,
        error_radius=error_radius,
        error_force=forces[ring_errors[:, first_exceeding].argmax()],
        error=error,
        search_radius=search_radius,
        force_range=(min_force, max_force),
        folds=folds,
        pairs=pairs,
        electrodes=len(charge_map.electrodes),
    )


def _round_down(radius: float, step: float = RADIUS_STEP) -> float:
    """Round a radius down to a multiple of a step, mm."""
    # The factor compensates the rounding error of the quotient. The function `tidy` removes the error of the product.
    n_step = np.floor(radius / step * (1.0 + 1e-9))
    return tidy(n_step * step)
