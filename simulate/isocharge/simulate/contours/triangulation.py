"""Triangulation: position of a press from the meeting of contours (Mirbagheri et al. 2007, Fig. 9 and 10).

Each charge restricts the position of the press to an isocharge contour. The paper takes three crossings of the contours
of three electrodes that are near each other, and uses their mean as the position; with four electrodes, it averages
over the four triples. `Triangulation.locate` does the same: it searches for positions near all contours, finds the
crossing of each pair of contours by Newton's method, and reports in `Fix.status` if there is no position or more than
one.

If the force is unknown, the contours depend on it. `Triangulation.locate_with_force` finds the position and the force
with the smallest mean square distance from the contours.
"""

from dataclasses import dataclass, fields
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
    """Estimator of positions by the meeting of contours.

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
        """Locate presses in chunks of `CHUNK`."""
        parts = [Fix(np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.intp))]
        for start in range(0, len(charge), CHUNK):
            rows = slice(start, start + CHUNK)
            chunk_force = force[rows] if force is not None else None
            parts.append(self._locate_chunk(charge[rows], chunk_force))
        return Fix(*(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(Fix)))

    def _locate_chunk(self, charge: Array, force: Array | None) -> Fix:
        """Locate presses; the force is estimated if it is None."""
        fixed = force is not None
        closest = self._approach(charge, self._seeds(charge, force), fixed=fixed)
        second = self._approach(charge, self._second_seeds(closest, fixed=fixed), fixed=fixed)
        closest = closest.joined(second).distinct(MIN_DISTANCE)
        if fixed:
            closest = self._cross(charge, closest)
        return self._choose(charge, force, closest)

    def _choose(self, charge: Array, force: Array | None, candidates: Candidates) -> Fix:
        """Choose the best candidate of each press, unless it is ambiguous."""
        count = len(charge)
        first = np.searchsorted(candidates.press, np.arange(count))
        matches = np.bincount(candidates.press, minlength=count)
        spread = np.append(candidates.spread, np.inf)  # the last value is for presses without candidates
        best = np.where(matches > 0, spread[first], np.nan)
        second = np.where(matches > 1, spread[np.minimum(first + 1, candidates.press.size)], np.inf)
        status = np.where(matches > 0, int(Meeting.met), int(Meeting.apart))
        status[(matches == 0) & self._grid.is_out_of_range(charge, force)] = Meeting.no_contour
        status[second <= np.maximum(AMBIGUOUS_RATIO * best, AMBIGUOUS_SPREAD)] = Meeting.twice
        met = status == Meeting.met
        contact = np.full((count, 3), np.nan)
        contact[met] = candidates.contact[first[met]]
        if force is not None:
            contact[:, 2] = force
        return Fix(contact, best, status)

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
        """Select the nodes of the grid that are nearer to the contours than their neighbours."""
        grid = self._grid
        forces = grid.matching_force(charge) if force is None else force[:, None]
        press, node = grid.lowest(grid.distance(charge, forces), MAX_SEEDS)
        chosen = forces[press, node] if force is None else force[press]
        return Candidates.begin(press, np.column_stack([grid.position[node], chosen]))

    def _second_seeds(self, closest: Candidates, *, fixed: bool) -> Candidates:
        """Create starting points for a second meeting across a fold.

        They lie on both sides of each meeting in the direction in which the distances from the contours change least.
        """
        _, slopes = self._distances(closest.contact, 0.0, fixed=fixed)
        right_singular_vectors = np.linalg.svd(slopes)[2]
        weakest_direction = right_singular_vectors[:, -1]
        step = SECOND_START_DISTANCE * self.tolerance * weakest_direction
        backward = Candidates.begin(closest.press, self._moved(closest.contact, -step))
        forward = Candidates.begin(closest.press, self._moved(closest.contact, step))
        return backward.joined(forward)

    # From the starting points to the meeting

    def _approach(self, charge: Array, seeds: Candidates, *, fixed: bool) -> Candidates:
        """Minimise the mean square distance from the contours by the Gauss-Newton method.

        Args:
            charge: Charges of all presses, shape (n, n_electrode), pC.
            seeds: Starting points.
            fixed: Whether the force keeps its value.
        """
        contact = seeds.contact
        best = seeds
        for _ in range(STEPS):
            distance, slopes = self._distances(contact, charge[seeds.press], fixed=fixed)
            best = best.improved(contact, np.sqrt(np.mean(distance**2, axis=1)))
            contact = self._moved(contact, gauss_newton_step(slopes, distance))
        return best[best.spread <= self.tolerance].distinct(MIN_DISTANCE)

    def _cross(self, charge: Array, near: Candidates) -> Candidates:
        """Average the crossings of each triple of contours near the candidates, over the triples that meet there."""
        count = len(self.charge_map.electrodes)
        crossing = {pair: self._crossing(charge, near, pair) for pair in combinations(range(count), 2)}
        total = np.zeros((len(near.press), 2))
        met = np.zeros_like(near.press)
        spread = np.zeros_like(near.spread)
        for triple in combinations(range(count), 3):
            corners = np.stack([crossing[pair] for pair in combinations(triple, 2)], axis=1)
            mean = corners.mean(axis=1)
            distance = np.linalg.norm(corners - mean[:, None], axis=2).max(axis=1)
            meets = distance <= self.tolerance  # False if a pair does not cross, because its distance is NaN
            total[meets] += mean[meets]
            spread[meets] = np.maximum(spread[meets], distance[meets])
            met += meets
        contact = np.column_stack([total / np.maximum(met, 1)[:, None], near.contact[:, 2]])
        return Candidates(near.press, contact, spread)[met > 0].distinct(MIN_DISTANCE)

    def _crossing(self, charge: Array, near: Candidates, pair: tuple[int, int]) -> Array:
        """Find the crossing of two contours by Newton's method from each candidate.

        Args:
            charge: Charges of all presses, shape (n, n_electrode), pC.
            near: Candidates from which the search starts.
            pair: Numbers of the two electrodes.

        Returns:
            Positions, shape (n_candidate, 2), mm; NaN if the contours do not cross.
        """
        contact = near.contact.copy()
        crossing = np.full((len(near.press), 2), np.nan)
        active = np.arange(len(contact))
        for _ in range(STEPS):
            distance, slopes = self._distances(contact[active], charge[near.press[active]], fixed=True)
            distance = distance[:, pair]
            slopes = slopes[:, pair]
            moving = np.abs(distance).max(axis=1) >= CONVERGED_DISTANCE
            crossing[active[~moving]] = contact[active[~moving], :2]
            active = active[moving]
            if active.size == 0:
                break
            contact[active] = self._moved(contact[active], gauss_newton_step(slopes[moving], distance[moving]))
        return crossing

    def _distances(self, contact: Array, charge: Array | float, *, fixed: bool) -> tuple[Array, Array]:
        """Estimate the signed distances of contacts from the contours of given charges, and their derivatives.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of the contours, shape (n, n_electrode), pC.
            fixed: Whether the derivative with respect to the force is omitted.

        Returns:
            Distances, shape (n, n_electrode), mm, and their derivatives with respect to x, y and, unless the force is
            fixed, ln F times the radius, shape (n, n_electrode, 2 or 3), dimensionless.
        """
        predicted, slopes = linearised(self._charges, contact)
        typical_slope = np.median(self._grid.slope, axis=0) * self._grid.growth(contact[:, 2])[:, None]
        slope = np.maximum(np.linalg.norm(slopes[..., :2], axis=2), MIN_SLOPE * typical_slope)
        lengths = slopes / (slope[..., None] * np.array([1.0, 1.0, self.charge_map.domain.radius]))
        if fixed:
            lengths = lengths[..., :2]
        return (predicted - charge) / slope, lengths

    def _moved(self, contact: Array, step: Array) -> Array:
        """Move contacts by a step, and keep them within the domain of the charge map.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            step: Changes of x, y and, optionally, ln F times the radius, shape (n, 2) or (n, 3), mm.
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
    square = np.einsum("nij,nik->njk", slopes, slopes) + DAMPING * np.eye(slopes.shape[2])
    step: Array = -np.linalg.solve(square, np.einsum("nij,ni->nj", slopes, distance)[..., None])[..., 0]
    step *= np.minimum(1.0, MAX_STEP / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
    return step
