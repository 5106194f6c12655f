"""Triangulation of presses. The position of a press is the point at which its contours meet (Mirbagheri et al. 2007).

The charge of an electrode restricts the position of the press to an isocharge contour (figures 9 and 10 of the paper).
The contours of three electrodes have three crossings near the press, and the paper uses the mean of these crossings as
the position. With four electrodes, the paper averages over the four triples of electrodes. `Triangulation.locate`
computes the same mean. The method `locate` searches for positions near all contours, and finds the crossing of each
pair of contours by Newton's method. `Fix.status` states whether a press has no position, or more than one position.

The contours of a press depend on its force. If the force is unknown, `Triangulation.locate_with_force` finds the
position and the force for which the mean square distance of the position from the contours is smallest.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.contours.candidates import MIN_SLOPE, Candidates, SeedGrid
from isocharge.simulate.contours.fix import (
    AMBIGUOUS_RATIO,
    AMBIGUOUS_SPREAD,
    MIN_DISTANCE,
    TOLERANCE,
    Fix,
    Meeting,
    check_triangulation,
)
from isocharge.simulate.forward.charge_map import ChargeMap, as_charges, check_forces, linearised
from isocharge.simulate.forward.charge_spline import with_fast_derivatives
from isocharge.simulate.numerics.disk import INNER_RADIUS, onto_disk

SECOND_START_DISTANCE = 2.0
"""Distance between a solution and the starting point of the search for a second solution, in units of the tolerance."""

MAX_SEEDS = 4
"""Largest number of starting points on the grid for each press."""

STEPS = 25
"""Number of Newton or Gauss-Newton steps of a search."""

CONVERGED_DISTANCE = 1e-5
"""Distance from a contour below which a point counts as lying on the contour, mm."""

MAX_STEP = 1.0
"""Largest length of a Gauss-Newton step, mm."""

DAMPING = 1e-10
"""Damping of the Gauss-Newton step, dimensionless. The damping keeps the step finite where contours touch."""

CHUNK = 512
"""Number of presses that are located together, which limits the required memory to about 100 MB."""


@dataclass(frozen=True)
class Triangulation:
    """Estimator that determines the position of a press as the point at which its contours meet.

    Attributes:
        charge_map: Map that computes the charges of contacts. A forward map is replaced by splines, whose fit takes a
            few seconds.
        tolerance: Largest distance between a crossing of two contours and the mean of three crossings at which the
            contours meet, mm.

    Raises:
        SensorError: If there are fewer than three electrodes.
        SceneError: If the tolerance is not positive.
    """

    charge_map: ChargeMap
    tolerance: float = TOLERANCE

    def __post_init__(self) -> None:
        check_triangulation(self.charge_map.electrodes, self.tolerance)

    def locate(self, charge: Array, force: Array | float) -> Fix:
        """Estimate the positions of presses whose forces are known.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), or one force for all presses, N.

        Returns:
            Position of each press; NaN where the status is not `Meeting.met`.

        Raises:
            ChargeError: If there is not one finite charge for each electrode.
            SceneError: If a force is outside the range of the charge map.
        """
        charge = as_charges(charge, self.charge_map.electrodes)
        force = np.broadcast_to(np.asarray(force, dtype=float), len(charge))
        check_forces(force, self.charge_map.domain.force_range, "charge map")
        return self._in_chunks(charge, force)

    def locate_with_force(self, charge: Array) -> Fix:
        """Estimate the positions and the forces of presses.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.

        Returns:
            Position and force of each press; NaN where the status is not `Meeting.met`.

        Raises:
            ChargeError: If there is not one finite charge for each electrode.
        """
        return self._in_chunks(as_charges(charge, self.charge_map.electrodes), None)

    def _in_chunks(self, charge: Array, force: Array | None) -> Fix:
        """Locate presses in chunks of `CHUNK` presses, in order to limit the required memory.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N; None if the forces are to be estimated.

        Returns:
            Positions of all presses in the order of the charges.
        """
        # The list starts with an empty result, because at least one array is needed for the concatenation.
        no_press = Fix(np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.intp))
        fixes = [no_press]
        for start in range(0, len(charge), CHUNK):
            chunk = slice(start, start + CHUNK)
            chunk_force = force[chunk] if force is not None else None
            fixes.append(self._locate_chunk(charge[chunk], chunk_force))
        return Fix(
            contact=np.concatenate([fix.contact for fix in fixes]),
            spread=np.concatenate([fix.spread for fix in fixes]),
            status=np.concatenate([fix.status for fix in fixes]),
        )

    def _locate_chunk(self, charge: Array, force: Array | None) -> Fix:
        """Locate the presses of one chunk.

        The method finds the contacts near which the contours of each press meet, and chooses one contact for each
        press. If the force is given, the position is the mean of the crossings of the contours near the contact.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N; None if the forces are to be estimated.

        Returns:
            Position of each press.
        """
        is_force_fixed = force is not None
        starts = self._starting_points(charge, force)
        first_contacts = self._minimise_distances(charge, starts, is_force_fixed=is_force_fixed)

        # Near a fold, the contours may also meet at a second contact beside each of these contacts.
        second_starts = self._second_starting_points(first_contacts, is_force_fixed=is_force_fixed)
        second_contacts = self._minimise_distances(charge, second_starts, is_force_fixed=is_force_fixed)
        candidates = first_contacts.joined_with(second_contacts).without_duplicates(MIN_DISTANCE)
        if is_force_fixed:
            candidates = self._replace_by_crossings(charge, candidates)
        return self._choose(charge, force, candidates)

    def _choose(self, charge: Array, force: Array | None, candidates: Candidates) -> Fix:
        """Choose the best candidate of each press, unless another candidate is almost as good.

        The candidates of a press are the contacts near which its contours meet. The best candidate is the one with the
        smallest spread.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N; None if the forces are estimated.
            candidates: Candidates, ordered by press and then by spread.

        Returns:
            Contact, spread and status of each press.
        """
        n_press = len(charge)
        n_candidates = np.bincount(candidates.press, minlength=n_press)

        # The candidates are ordered, so the first row of a press contains its best candidate, and the next row contains
        # the second-best one. For a press without candidates, these rows may lie beyond the end of the array. One
        # element is therefore appended, whose value is never used.
        spread = np.append(candidates.spread, np.inf)
        first_row = np.searchsorted(candidates.press, np.arange(n_press))
        second_row = np.minimum(first_row + 1, candidates.press.size)
        smallest_spread = np.where(n_candidates > 0, spread[first_row], np.nan)
        second_spread = np.where(n_candidates > 1, spread[second_row], np.inf)

        # A press without candidates has the status `apart`, which means that its contours do not meet. If no contact
        # causes such charges, the status is `no_contour` instead.
        status = np.where(n_candidates > 0, int(Meeting.met), int(Meeting.apart))
        has_no_contour = (n_candidates == 0) & self._grid.is_out_of_range(charge, force)
        status[has_no_contour] = Meeting.no_contour

        # A press is ambiguous if its second-best candidate is almost as good as the best one, or has a tiny spread. The
        # status `twice` means that the contours meet at two places.
        is_ambiguous = second_spread <= np.maximum(AMBIGUOUS_RATIO * smallest_spread, AMBIGUOUS_SPREAD)
        status[is_ambiguous] = Meeting.twice

        # Only presses with the status `met` have a position. The positions of all other presses are NaN, and so are
        # their forces, unless the forces are given.
        is_met = status == Meeting.met
        contact = np.full((n_press, 3), np.nan)
        contact[is_met] = candidates.contact[first_row[is_met]]
        if force is not None:
            contact[:, 2] = force
        return Fix(contact, smallest_spread, status)

    # Starting points

    @cached_property
    def _charges(self) -> ChargeMap:
        """Charge map that computes derivatives fast."""
        return with_fast_derivatives(self.charge_map)

    @cached_property
    def _grid(self) -> SeedGrid:
        """Grid of positions from which the starting points of the search are chosen."""
        return SeedGrid.from_charge_map(self._charges)

    def _starting_points(self, charge: Array, force: Array | None) -> Candidates:
        """Choose the nodes of the grid at which the distance from the contours of a press is a local minimum.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N. If None, the force is chosen at each node such that the total
                charge of all electrodes is correct.

        Returns:
            Starting points, at most `MAX_SEEDS` for each press.
        """
        # There is one force for each press and node, shape (n, n_node), or one force for each press, shape (n, 1).
        grid = self._grid
        forces = grid.matching_force(charge) if force is None else force[:, None]
        distance = grid.distance(charge, forces)  # shape (n, n_node)
        press, node = grid.local_minima(distance, MAX_SEEDS)
        start_force = np.broadcast_to(forces, distance.shape)[press, node]
        return Candidates.from_starting_points(press, np.column_stack([grid.position[node], start_force]))

    def _second_starting_points(self, solutions: Candidates, *, is_force_fixed: bool) -> Candidates:
        """Choose the starting points of a search for a second solution beside each solution.

        A solution is a contact near which the contours of a press meet. Near a fold of the charge map, two contacts
        that are close together have the same charges. The difference between the two contacts has the direction in
        which the distances from the contours change least. Two starting points are therefore placed in this direction,
        on opposite sides of each solution.

        Args:
            solutions: Solutions that have been found.
            is_force_fixed: Whether the force keeps its value.

        Returns:
            Two starting points for each solution.
        """
        any_charge = 0.0  # the derivatives do not depend on the charge
        _, derivatives = self._distances(solutions.contact, any_charge, is_force_fixed=is_force_fixed)
        _, _, right_singular_vectors = np.linalg.svd(derivatives)
        weakest_direction = right_singular_vectors[:, -1]  # belongs to the smallest singular value; (n, n_unknown)
        step = SECOND_START_DISTANCE * self.tolerance * weakest_direction
        backward = Candidates.from_starting_points(solutions.press, self._move(solutions.contact, -step))
        forward = Candidates.from_starting_points(solutions.press, self._move(solutions.contact, step))
        return backward.joined_with(forward)

    # Search from the starting points

    def _minimise_distances(self, charge: Array, starts: Candidates, *, is_force_fixed: bool) -> Candidates:
        """Minimise the mean square distance of contacts from the contours by the Gauss-Newton method.

        Args:
            charge: Charges of all presses, shape (n, n_electrode), pC.
            starts: Starting points of the searches.
            is_force_fixed: Whether the force keeps its value.

        Returns:
            The best contact of each search, without duplicates. Searches whose root mean square distance exceeds the
            tolerance are omitted.
        """
        contact = starts.contact
        best = starts
        for _ in range(STEPS):
            distance, derivatives = self._distances(contact, charge[starts.press], is_force_fixed=is_force_fixed)
            rms_distance = np.sqrt(np.mean(distance**2, axis=1))
            best = best.replaced_where_better(contact, rms_distance)
            contact = self._move(contact, gauss_newton_step(derivatives, distance))
        return best[best.spread <= self.tolerance].without_duplicates(MIN_DISTANCE)

    def _replace_by_crossings(self, charge: Array, candidates: Candidates) -> Candidates:
        """Replace the position of each candidate by the mean of the nearby crossings of contours.

        A triple of contours has three crossings, one for each pair of contours. The triple meets if all three crossings
        lie within the tolerance of their mean. Each triple that meets near a candidate yields such a mean. The new
        position of the candidate is the average of these means.

        Args:
            charge: Touch charges of all presses, shape (n, n_electrode), pC.
            candidates: Candidates near which crossings are searched for.

        Returns:
            The candidates near which at least one triple meets, with their new positions and without duplicates. The
            spread is the largest distance between a crossing and the mean of its triple.
        """
        n_electrode = len(self.charge_map.electrodes)
        pairs = combinations(range(n_electrode), 2)
        crossings = {pair: self._crossings_of_pair(charge, candidates, pair) for pair in pairs}

        # Accumulate the sum of the means, the number of triples that meet, and the largest spread for each candidate.
        position_sum = np.zeros((len(candidates.press), 2))
        n_meeting_triples = np.zeros_like(candidates.press)
        spread = np.zeros_like(candidates.spread)
        for triple in combinations(range(n_electrode), 3):
            triple_crossings = np.stack([crossings[pair] for pair in combinations(triple, 2)], axis=1)
            mean = triple_crossings.mean(axis=1)  # mean over the three crossings, shape (n_candidate, 2)
            distance = np.linalg.norm(triple_crossings - mean[:, None], axis=2).max(axis=1)
            is_meeting = distance <= self.tolerance  # False if a pair does not cross, because its distance is NaN
            position_sum[is_meeting] += mean[is_meeting]
            spread[is_meeting] = np.maximum(spread[is_meeting], distance[is_meeting])
            n_meeting_triples += is_meeting
        position = position_sum / np.maximum(n_meeting_triples, 1)[:, None]  # mean over the triples that meet
        contact = np.column_stack([position, candidates.contact[:, 2]])
        moved_candidates = Candidates(candidates.press, contact, spread)
        return moved_candidates[n_meeting_triples > 0].without_duplicates(MIN_DISTANCE)

    def _crossings_of_pair(self, charge: Array, candidates: Candidates, pair: tuple[int, int]) -> Array:
        """Use Newton's method to find the crossing of the contours of two electrodes near each candidate.

        The force of each candidate remains unchanged during the search.

        Args:
            charge: Charges of all presses, shape (n, n_electrode), pC.
            candidates: Candidates from which the searches start.
            pair: Indices of the two electrodes.

        Returns:
            Position (x, y) of the crossing near each candidate, shape (n_candidate, 2), mm; NaN if Newton's method does
            not converge, for example because the contours do not cross.
        """
        contact = candidates.contact.copy()
        crossing = np.full((len(candidates.press), 2), np.nan)
        active = np.arange(len(contact))  # indices of the candidates that have not converged
        for _ in range(STEPS):
            active_charge = charge[candidates.press[active]]
            distances, derivatives = self._distances(contact[active], active_charge, is_force_fixed=True)
            pair_distances = distances[:, pair]
            pair_derivatives = derivatives[:, pair]  # shape (n_active, 2, 2)

            # Store the positions that lie on both contours, and continue with the other candidates.
            is_moving = np.abs(pair_distances).max(axis=1) >= CONVERGED_DISTANCE
            converged = active[~is_moving]
            crossing[converged] = contact[converged, :2]
            active = active[is_moving]
            if active.size == 0:
                break

            # For two equations with two unknowns, the Gauss-Newton step is the Newton step.
            step = gauss_newton_step(pair_derivatives[is_moving], pair_distances[is_moving])
            contact[active] = self._move(contact[active], step)
        return crossing

    def _distances(self, contact: Array, charge: Array | float, *, is_force_fixed: bool) -> tuple[Array, Array]:
        """Estimate signed distances between contacts and the contours of electrodes, with their derivatives.

        To first order, the distance is the difference of the charges divided by the length of the gradient of the
        charge. The unknowns are x and y. If the force is not fixed, there is a third unknown: ln F times the radius of
        the domain. All unknowns are therefore lengths.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of the electrodes on their contours, shape (n, n_electrode), pC.
            is_force_fixed: Whether the derivative with respect to the third unknown is omitted.

        Returns:
            Distances, shape (n, n_electrode), mm. Derivatives of the distances with respect to the unknowns, shape (n,
            n_electrode, 2) if the force is fixed and (n, n_electrode, 3) otherwise, dimensionless.
        """
        predicted, charge_derivatives = linearised(self._charges, contact)

        # The typical slope of each electrode is its median slope on the grid, which was computed for the middle force.
        # The slopes at another force are larger or smaller by the same factor as the charges.
        slope_factor = self._grid.relative_rms_charge_at(contact[:, 2])[:, None]
        typical_slope = np.median(self._grid.slope, axis=0) * slope_factor  # shape (n, n_electrode), pC/mm

        # The slope is the length of the gradient with respect to x and y. Where the charge has an extremum, the
        # gradient is zero. The lower bound keeps the distance finite there.
        gradient_length = np.linalg.norm(charge_derivatives[..., :2], axis=2)
        slope = np.maximum(gradient_length, MIN_SLOPE * typical_slope)  # pC/mm
        distance = (predicted - charge) / slope

        # Convert the derivatives with respect to (x, y, ln F) into derivatives with respect to the unknowns, which are
        # x, y and ln F times the radius of the domain.
        unknown_scales = np.array([1.0, 1.0, self.charge_map.domain.radius])
        distance_derivatives = charge_derivatives / (slope[..., None] * unknown_scales)
        if is_force_fixed:
            distance_derivatives = distance_derivatives[..., :2]
        return distance, distance_derivatives

    def _move(self, contact: Array, step: Array) -> Array:
        """Return contacts that are moved by a step and kept within the domain of the charge map.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            step: Changes of x, y and, optionally, ln F times the radius of the domain, shape (n, 2) or (n, 3), mm.

        Returns:
            Moved contacts (x, y, F), shape (n, 3), mm and N.
        """
        domain = self.charge_map.domain
        position = onto_disk(contact[:, :2] + step[:, :2], INNER_RADIUS * domain.radius)
        force = contact[:, 2]
        if step.shape[1] == 3:
            force = np.clip(force * np.exp(step[:, 2] / domain.radius), *domain.force_range)
        return np.column_stack([position, force])


def gauss_newton_step(slopes: Array, distance: Array) -> Array:
    """Compute a damped Gauss-Newton step for each of n problems, each of which minimises a sum of squares.

    Args:
        slopes: Derivatives of the distances with respect to the unknowns, shape (n, n_distance, n_unknown),
            dimensionless and of order one.
        distance: Distances of each problem, shape (n, n_distance), mm.

    Returns:
        Step of each problem, shape (n, n_unknown), mm, not longer than `MAX_STEP`.
    """
    # Let J be the slopes of one problem (index n). The normal equations are (J' J + damping) step = -J' distance, with
    # sums over the distances (index i).
    normal_matrix = np.einsum("nij,nik->njk", slopes, slopes) + DAMPING * np.eye(slopes.shape[2])
    gradient = np.einsum("nij,ni->nj", slopes, distance)
    step: Array = -np.linalg.solve(normal_matrix, gradient[..., None])[..., 0]

    # Shorten steps that are longer than `MAX_STEP`.
    length = np.linalg.norm(step, axis=1)
    shortening = np.minimum(1.0, MAX_STEP / np.maximum(length, 1e-300))  # the lower bound avoids a division by zero
    step *= shortening[:, None]
    return step
