"""Triangulation: position of a press from the point at which contours meet (Mirbagheri and others 2007, figures 9, 10).

Each charge restricts the position of the press to an isocharge contour. The contours of three electrodes have three
crossings near the press, and the paper uses the mean of these crossings as the position. With four electrodes, the
paper averages over the four triples of electrodes. `Triangulation.locate` computes the same mean. This module searches
for positions near all contours, and finds the crossing of each pair of contours by Newton's method. `Fix.status` states
whether a press has no position, or more than one.

If the force is unknown, the contours depend on it. `Triangulation.locate_with_force` finds the position and the force
with the smallest mean square distance from the contours.
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
"""Distance from a meeting at which the search for a second meeting starts, in units of the tolerance, dimensionless."""

MAX_SEEDS = 4
"""Largest number of starting points for each press."""

STEPS = 25
"""Number of Newton steps."""

CONVERGED_DISTANCE = 1e-5
"""Distance from a contour below which a point counts as lying on the contour, mm."""

MAX_STEP = 1.0
"""Largest length of a Gauss-Newton step, mm."""

DAMPING = 1e-10
"""Damping of the Gauss-Newton step, dimensionless. It keeps the step finite where contours touch."""

CHUNK = 512
"""Number of presses that are located together, which limits the memory to about 100 MB."""


@dataclass(frozen=True)
class Triangulation:
    """Estimator of positions from the points at which contours meet.

    Attributes:
        charge_map: Charges as a function of the contact. A forward map is replaced by splines, which takes some
            seconds.
        tolerance: Largest distance of three crossings from their mean at which contours count as meeting, mm.

    Raises:
        SensorError: If there are fewer than three electrodes.
        SceneError: If the tolerance is not positive.
    """

    charge_map: ChargeMap
    tolerance: float = TOLERANCE

    def __post_init__(self) -> None:
        check_triangulation(self.charge_map.electrodes, self.tolerance)

    def locate(self, charge: Array, force: Array | float) -> Fix:
        """Locate presses whose force is known.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), or one force for all presses, N.

        Returns:
            Positions, which are NaN where `status` is not `Meeting.met`.

        Raises:
            ChargeError: If the charges are not finite, or their number is not that of the electrodes.
            SceneError: If a force is outside the range of the charge map.
        """
        charge = as_charges(charge, self.charge_map.electrodes)
        force = np.broadcast_to(np.asarray(force, dtype=float), len(charge))
        check_forces(force, self.charge_map.domain.force_range, "charge map")
        return self._in_chunks(charge, force)

    def locate_with_force(self, charge: Array) -> Fix:
        """Locate presses whose force is unknown, and estimate their force.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.

        Returns:
            Positions and forces, which are NaN where `status` is not `Meeting.met`.

        Raises:
            ChargeError: If the charges are not finite, or their number is not that of the electrodes.
        """
        return self._in_chunks(as_charges(charge, self.charge_map.electrodes), None)

    def _in_chunks(self, charge: Array, force: Array | None) -> Fix:
        """Locate presses in chunks of `CHUNK`, which limits the memory.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N; None if the forces are to be estimated.

        Returns:
            Positions of all presses in the order of the charges.
        """
        no_press = Fix(np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.intp))
        fixes = [no_press]  # without charges, there are no chunks, but arrays to concatenate are needed
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

        The search first finds the contacts at which the contours of a press meet, and then chooses one of these
        contacts. If the force is given, the contours are known curves, and the position is the mean of their crossings.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N; None if the forces are to be estimated.

        Returns:
            Position of each press.
        """
        is_force_fixed = force is not None
        seeds = self._seeds(charge, force)
        first_meetings = self._approach(charge, seeds, is_force_fixed=is_force_fixed)

        # Near a fold, there may be a second meeting beside each meeting.
        second_seeds = self._second_seeds(first_meetings, is_force_fixed=is_force_fixed)
        second_meetings = self._approach(charge, second_seeds, is_force_fixed=is_force_fixed)
        candidates = first_meetings.joined(second_meetings).distinct(MIN_DISTANCE)
        if is_force_fixed:
            candidates = self._cross(charge, candidates)
        return self._choose(charge, force, candidates)

    def _choose(self, charge: Array, force: Array | None, candidates: Candidates) -> Fix:
        """Choose the best candidate of each press, unless the second candidate is almost as good.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N; None if the forces are estimated.
            candidates: Candidates, ordered by press and then by spread.

        Returns:
            Contact, spread and status of each press.
        """
        n_press = len(charge)
        n_candidates = np.bincount(candidates.press, minlength=n_press)

        # The candidates are ordered, so the best candidate of a press is in its first row. The row after the last
        # candidate is valid, too, because presses without candidates may refer to it.
        spread = np.append(candidates.spread, np.inf)
        first_row = np.searchsorted(candidates.press, np.arange(n_press))
        second_row = np.minimum(first_row + 1, candidates.press.size)
        smallest_spread = np.where(n_candidates > 0, spread[first_row], np.nan)
        second_spread = np.where(n_candidates > 1, spread[second_row], np.inf)

        # Presses without candidates are `apart`, or `no_contour` if the map does not contain their charges.
        status = np.where(n_candidates > 0, int(Meeting.met), int(Meeting.apart))
        has_no_contour = (n_candidates == 0) & self._grid.is_out_of_range(charge, force)
        status[has_no_contour] = Meeting.no_contour

        # A press is ambiguous if its second candidate is almost as good as the best one, or fits almost exactly.
        is_ambiguous = second_spread <= np.maximum(AMBIGUOUS_RATIO * smallest_spread, AMBIGUOUS_SPREAD)
        status[is_ambiguous] = Meeting.twice

        # Ambiguous presses have no contact either.
        is_met = status == Meeting.met
        contact = np.full((n_press, 3), np.nan)
        contact[is_met] = candidates.contact[first_row[is_met]]
        if force is not None:
            contact[:, 2] = force
        return Fix(contact, smallest_spread, status)

    # Starting points

    @cached_property
    def _charges(self) -> ChargeMap:
        """Charge map with fast derivatives."""
        return with_fast_derivatives(self.charge_map)

    @cached_property
    def _grid(self) -> SeedGrid:
        """Grid of positions at which the search starts."""
        return SeedGrid.of(self._charges)

    def _seeds(self, charge: Array, force: Array | None) -> Candidates:
        """Select the nodes of the grid that are nearer to the contours than their neighbours.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Force of each press, shape (n,), N; None if the best force of each node is to be used.

        Returns:
            Starting points, at most `MAX_SEEDS` for each press.
        """
        # One force for each press and node, shape (n, n_node), or one force for each press, shape (n, 1)
        grid = self._grid
        forces = grid.matching_force(charge) if force is None else force[:, None]
        press, node = grid.lowest(grid.distance(charge, forces), MAX_SEEDS)
        seed_force = forces[press, node] if force is None else force[press]
        return Candidates.begin(press, np.column_stack([grid.position[node], seed_force]))

    def _second_seeds(self, meetings: Candidates, *, is_force_fixed: bool) -> Candidates:
        """Create starting points of a search for a second meeting of the contours beside each meeting.

        Near a fold of the charge map, two contacts that are close together have the same charges. They lie in the
        direction in which the distances from the contours change least. Two starting points are therefore placed in
        this direction, on opposite sides of each meeting.

        Args:
            meetings: Meetings of the contours that have been found.
            is_force_fixed: Whether the force keeps its value.

        Returns:
            Two starting points for each meeting.
        """
        any_charge = 0.0  # the derivatives do not depend on the charge
        _, derivatives = self._distances(meetings.contact, any_charge, is_force_fixed=is_force_fixed)
        _, _, right_singular_vectors = np.linalg.svd(derivatives)
        weakest_direction = right_singular_vectors[:, -1]  # of the smallest singular value, shape (n, n_unknown)
        step = SECOND_START_DISTANCE * self.tolerance * weakest_direction
        backward = Candidates.begin(meetings.press, self._moved(meetings.contact, -step))
        forward = Candidates.begin(meetings.press, self._moved(meetings.contact, step))
        return backward.joined(forward)

    # Search from the starting points

    def _approach(self, charge: Array, seeds: Candidates, *, is_force_fixed: bool) -> Candidates:
        """Minimise the mean square distance from the contours by the Gauss-Newton method.

        Args:
            charge: Charges of all presses, shape (n, n_electrode), pC.
            seeds: Starting points.
            is_force_fixed: Whether the force keeps its value.

        Returns:
            The best contact of each starting point whose distance from the contours is within the tolerance, without
            duplicates.
        """
        contact = seeds.contact
        best = seeds
        for _ in range(STEPS):
            distance, derivatives = self._distances(contact, charge[seeds.press], is_force_fixed=is_force_fixed)
            rms_distance = np.sqrt(np.mean(distance**2, axis=1))
            best = best.improved(contact, rms_distance)
            contact = self._moved(contact, gauss_newton_step(derivatives, distance))
        return best[best.spread <= self.tolerance].distinct(MIN_DISTANCE)

    def _cross(self, charge: Array, candidates: Candidates) -> Candidates:
        """Replace each candidate by the mean of the crossings of the contours near this candidate.

        Three contours have three crossings of two contours. The contours meet if all three crossings lie within the
        tolerance of their mean. The new position of a candidate is the average of this mean over all triples of
        contours that meet near the candidate.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            candidates: Candidates near which crossings are searched for.

        Returns:
            The candidates near which at least one triple meets, without duplicates.
        """
        n_electrode = len(self.charge_map.electrodes)
        crossings = {pair: self._crossing(charge, candidates, pair) for pair in combinations(range(n_electrode), 2)}

        # Sum of the means, largest spread and number of the triples that meet near each candidate
        position_sum = np.zeros((len(candidates.press), 2))
        n_meeting = np.zeros_like(candidates.press)
        spread = np.zeros_like(candidates.spread)
        for triple in combinations(range(n_electrode), 3):
            corners = np.stack([crossings[pair] for pair in combinations(triple, 2)], axis=1)  # (n_candidate, 3, 2)
            mean = corners.mean(axis=1)
            distance = np.linalg.norm(corners - mean[:, None], axis=2).max(axis=1)
            is_meeting = distance <= self.tolerance  # False if a pair does not cross, because its distance is NaN
            position_sum[is_meeting] += mean[is_meeting]
            spread[is_meeting] = np.maximum(spread[is_meeting], distance[is_meeting])
            n_meeting += is_meeting
        position = position_sum / np.maximum(n_meeting, 1)[:, None]  # mean over the triples that meet
        contact = np.column_stack([position, candidates.contact[:, 2]])
        return Candidates(candidates.press, contact, spread)[n_meeting > 0].distinct(MIN_DISTANCE)

    def _crossing(self, charge: Array, candidates: Candidates, pair: tuple[int, int]) -> Array:
        """Find the crossing of two contours by Newton's method from each candidate. The force keeps its value.

        Args:
            charge: Charges of all presses, shape (n, n_electrode), pC.
            candidates: Candidates from which the search starts.
            pair: Indices of the two electrodes.

        Returns:
            Positions, shape (n_candidate, 2), mm; NaN if the contours do not cross.
        """
        contact = candidates.contact.copy()
        crossing = np.full((len(candidates.press), 2), np.nan)
        active = np.arange(len(contact))  # indices of the candidates that have not converged
        for _ in range(STEPS):
            active_charge = charge[candidates.press[active]]
            distances, derivatives = self._distances(contact[active], active_charge, is_force_fixed=True)
            pair_distances = distances[:, pair]
            pair_derivatives = derivatives[:, pair]  # shape (n_active, 2, 2)

            # Store the contacts that lie on both contours, and continue with the others.
            is_moving = np.abs(pair_distances).max(axis=1) >= CONVERGED_DISTANCE
            converged = active[~is_moving]
            crossing[converged] = contact[converged, :2]
            active = active[is_moving]
            if active.size == 0:
                break

            # For two equations with two unknowns, the Gauss-Newton step is the Newton step.
            step = gauss_newton_step(pair_derivatives[is_moving], pair_distances[is_moving])
            contact[active] = self._moved(contact[active], step)
        return crossing

    def _distances(self, contact: Array, charge: Array | float, *, is_force_fixed: bool) -> tuple[Array, Array]:
        """Estimate the signed distances from contacts to the contours of given charges, and their derivatives.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of the contours, shape (n, n_electrode), pC.
            is_force_fixed: Whether the derivative with respect to the force is omitted.

        Returns:
            Distances, shape (n, n_electrode), mm. Dimensionless derivatives of the distances, shape (n, n_electrode, 2
            or 3): with respect to x and y, and with respect to ln F times the radius unless the force is fixed.
        """
        predicted, charge_derivatives = linearised(self._charges, contact)

        # The slope is the length of the gradient. Its lower bound keeps the distance finite where the charge has an
        # extremum. The typical slope increases with the force like the charges.
        typical_slope = np.median(self._grid.slope, axis=0) * self._grid.growth(contact[:, 2])[:, None]
        gradient_length = np.linalg.norm(charge_derivatives[..., :2], axis=2)
        slope = np.maximum(gradient_length, MIN_SLOPE * typical_slope)  # pC/mm

        # To first order, the distance from a contour is the difference of the charges over the slope.
        distance = (predicted - charge) / slope
        unknown_scales = np.array([1.0, 1.0, self.charge_map.domain.radius])  # the third unknown is ln F times radius
        distance_derivatives = charge_derivatives / (slope[..., None] * unknown_scales)
        if is_force_fixed:
            distance_derivatives = distance_derivatives[..., :2]
        return distance, distance_derivatives

    def _moved(self, contact: Array, step: Array) -> Array:
        """Move contacts by a step, and keep them within the domain of the charge map.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            step: Changes of x, y and, optionally, ln F times the radius, shape (n, 2) or (n, 3), mm.

        Returns:
            Contacts, shape (n, 3), mm and N.
        """
        domain = self.charge_map.domain
        position = onto_disk(contact[:, :2] + step[:, :2], INNER_RADIUS * domain.radius)
        force = contact[:, 2]
        if step.shape[1] == 3:
            force = np.clip(force * np.exp(step[:, 2] / domain.radius), *domain.force_range)
        return np.column_stack([position, force])


def gauss_newton_step(slopes: Array, distance: Array) -> Array:
    """Compute the Gauss-Newton step that minimises the sum of the squared distances.

    Args:
        slopes: Derivatives of the distances with respect to the unknowns, shape (n, n_distance, n_unknown),
            dimensionless and of order one.
        distance: Distances, shape (n, n_distance), mm.

    Returns:
        Step, shape (n, n_unknown), mm, not longer than `MAX_STEP`.
    """
    # Normal equations (J' J + damping) step = -J' distance, with sums over the distances i of each row n
    normal_matrix = np.einsum("nij,nik->njk", slopes, slopes) + DAMPING * np.eye(slopes.shape[2])
    gradient = np.einsum("nij,ni->nj", slopes, distance)
    step: Array = -np.linalg.solve(normal_matrix, gradient[..., None])[..., 0]

    # Shorten steps that are longer than `MAX_STEP`.
    length = np.linalg.norm(step, axis=1)
    factor = np.minimum(1.0, MAX_STEP / np.maximum(length, 1e-300))  # a step of length zero remains zero
    step *= factor[:, None]
    return step
