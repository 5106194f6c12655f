"""Triangulation: where the isocharge contours of the electrodes meet (Mirbagheri et al. 2007, Fig. 9 and 10).

Each charge confines the press to a contour. Two contours cross in points; the paper takes the three crossings of three
electrodes' contours that lie together and calls their mean the position, and with four electrodes averages over the
four triples. So does `Triangulation.locate`: it searches for positions near all contours, follows each pair of contours
to its crossing by Newton's method, and says in `Fix.status` if there is no such position, or more than one.

With the force unknown the contours move with it, and the press is where, over all forces, they come closest to meeting:
the point and the force with the least mean square distance to the contours (`Triangulation.locate_with_force`).
"""

from dataclasses import dataclass, fields
from functools import cached_property
from itertools import combinations

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.contours.candidates import FLAT, Candidates, SeedGrid
from isocharge.simulate.contours.fix import AMBIGUOUS, APART, RESOLVED, TOLERANCE, Fix, Meeting, check_triangulation
from isocharge.simulate.forward.charge_map import ChargeMap, as_charges, check_forces, linearised
from isocharge.simulate.forward.charge_spline import with_fast_derivatives
from isocharge.simulate.numerics.disk import INNER_RADIUS, onto_disk

SECOND_SEARCH = 2.0
"""Distance from a meeting at which the search for a second one starts, in tolerances."""

SEEDS = 4
"""Largest number of starting points for each press, those nearest to all contours first."""

STEPS, CONVERGED = 25, 1e-5
"""Number of Newton steps, and the distance from a contour at which a point counts as on it, mm."""

LARGEST_STEP, DAMPING = 1.0, 1e-10
"""Largest length of a Gauss-Newton step, mm; damping that keeps it finite where contours touch, dimensionless."""

CHUNK = 512
"""Number of presses located together: keeps the working arrays within some 100 MB."""


@dataclass(frozen=True)
class Triangulation:
    """Charges to positions by the meeting of contours.

    Attributes:
        charge_map: The charges; of a forward map splines are made, which takes seconds.
        tolerance: Largest distance of three crossings from their mean at which contours meet, mm.

    Raises:
        SensorError: If there are fewer than three electrodes.
        SceneError: If the tolerance is not positive.
    """

    charge_map: ChargeMap
    tolerance: float = TOLERANCE

    def __post_init__(self) -> None:
        check_triangulation(self.charge_map.electrodes, self.tolerance)

    def locate(self, charge: Array, force: Array | float) -> Fix:
        """Positions of presses of known force.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            force: Shape (n,) or a number, N.

        Returns:
            One fix for each press; no position where `status` is not `Meeting.met`.

        Raises:
            ChargeError: If the charges are not finite or not one for each electrode.
            SceneError: If a force lies outside the map's.
        """
        charge = as_charges(charge, self.charge_map.electrodes)
        force = np.broadcast_to(np.asarray(force, dtype=float), len(charge))
        check_forces(force, self.charge_map.domain.force_range, "charge map")
        return self._in_chunks(charge, force)

    def locate_with_force(self, charge: Array) -> Fix:
        """Positions and forces of presses: where the contours over all forces come closest to meeting.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.

        Returns:
            One fix for each press; neither position nor force where `status` is not `Meeting.met`.

        Raises:
            ChargeError: If the charges are not finite or not one for each electrode.
        """
        return self._in_chunks(as_charges(charge, self.charge_map.electrodes), None)

    def _in_chunks(self, charge: Array, force: Array | None) -> Fix:
        parts = [Fix(np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.intp))]
        for start in range(0, len(charge), CHUNK):
            rows = slice(start, start + CHUNK)
            parts.append(self._located(charge[rows], None if force is None else force[rows]))
        return Fix(*(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(Fix)))

    def _located(self, charge: Array, force: Array | None) -> Fix:
        fixed = force is not None
        closest = self._approach(charge, self._seeds(charge, force), fixed=fixed)
        second = self._approach(charge, self._second_seeds(closest, fixed=fixed), fixed=fixed)
        closest = closest.joined(second).distinct(APART)
        return self._choose(charge, force, self._cross(charge, closest) if fixed else closest)

    def _choose(self, charge: Array, force: Array | None, candidates: Candidates) -> Fix:
        """The best candidate of each press, if it has one and it is not ambiguous."""
        count = len(charge)
        first = np.searchsorted(candidates.press, np.arange(count))
        matches = np.bincount(candidates.press, minlength=count)
        spread = np.append(candidates.spread, np.inf)  # a press without candidates points behind the last one
        best = np.where(matches > 0, spread[first], np.nan)
        second = np.where(matches > 1, spread[np.minimum(first + 1, candidates.press.size)], np.inf)
        status = np.where(matches > 0, int(Meeting.met), int(Meeting.apart))
        status[(matches == 0) & self._grid.out_of_reach(charge, force)] = Meeting.no_contour
        status[second <= np.maximum(AMBIGUOUS * best, RESOLVED)] = Meeting.twice
        met = status == Meeting.met
        contact = np.full((count, 3), np.nan)
        contact[met] = candidates.contact[first[met]]
        if force is not None:
            contact[:, 2] = force
        return Fix(contact, best, status)

    # Starting points

    @cached_property
    def _charges(self) -> ChargeMap:
        return with_fast_derivatives(self.charge_map)

    @cached_property
    def _grid(self) -> SeedGrid:
        return SeedGrid.of(self._charges)

    def _seeds(self, charge: Array, force: Array | None) -> Candidates:
        """Nodes that are nearer to all contours than their neighbours are."""
        grid = self._grid
        forces = grid.matching_force(charge) if force is None else force[:, None]
        press, node = grid.lowest(grid.distance(charge, forces), SEEDS)
        chosen = forces[press, node] if force is None else force[press]
        return Candidates.begin(press, np.column_stack([grid.at[node], chosen]))

    def _second_seeds(self, closest: Candidates, *, fixed: bool) -> Candidates:
        """Starting points for a second meeting across a fold: on both sides, in the direction of least change."""
        _, slopes = self._distances(closest.contact, 0.0, fixed=fixed)
        softest = np.linalg.svd(slopes)[2][:, -1]
        aside = SECOND_SEARCH * self.tolerance
        one, other = (
            Candidates.begin(closest.press, self._moved(closest.contact, sign * aside * softest)) for sign in (-1, 1)
        )
        return one.joined(other)

    # From the starting points to the meeting

    def _approach(self, charge: Array, seeds: Candidates, *, fixed: bool) -> Candidates:
        """Gauss-Newton to the point (and, unless fixed, the force) of least mean square distance to the contours."""
        contact, best = seeds.contact, seeds
        for _ in range(STEPS):
            away, slopes = self._distances(contact, charge[seeds.press], fixed=fixed)
            best = best.improved(contact, np.sqrt(np.mean(away**2, axis=1)))
            contact = self._moved(contact, gauss_newton_step(slopes, away))
        return best[best.spread <= self.tolerance].distinct(APART)

    def _cross(self, charge: Array, near: Candidates) -> Candidates:
        """The mean of each triple's crossings near a candidate, averaged over the triples that meet there."""
        count = len(self.charge_map.electrodes)
        crossing = {pair: self._crossing(charge, near, pair) for pair in combinations(range(count), 2)}
        total, met, spread = np.zeros((len(near.press), 2)), np.zeros_like(near.press), np.zeros_like(near.spread)
        for triple in combinations(range(count), 3):
            corners = np.stack([crossing[pair] for pair in combinations(triple, 2)], axis=1)
            mean = corners.mean(axis=1)
            distance = np.linalg.norm(corners - mean[:, None], axis=2).max(axis=1)
            good = distance <= self.tolerance  # False for the NaN of a pair that does not cross
            total[good] += mean[good]
            spread[good] = np.maximum(spread[good], distance[good])
            met += good
        contact = np.column_stack([total / np.maximum(met, 1)[:, None], near.contact[:, 2]])
        return Candidates(near.press, contact, spread)[met > 0].distinct(APART)

    def _crossing(self, charge: Array, near: Candidates, pair: tuple[int, int]) -> Array:
        """Crossing of two contours, by Newton's method from each candidate; shape (n, 2), NaN if they do not cross."""
        contact, crossing = near.contact.copy(), np.full((len(near.press), 2), np.nan)
        active = np.arange(len(contact))
        for _ in range(STEPS):
            away, slopes = self._distances(contact[active], charge[near.press[active]], fixed=True)
            away, slopes = away[:, pair], slopes[:, pair]
            moving = np.abs(away).max(axis=1) >= CONVERGED
            crossing[active[~moving]] = contact[active[~moving], :2]
            active = active[moving]
            if active.size == 0:
                break
            contact[active] = self._moved(contact[active], gauss_newton_step(slopes[moving], away[moving]))
        return crossing

    def _distances(self, contact: Array, charge: Array | float, *, fixed: bool) -> tuple[Array, Array]:
        """Distances from contacts (n, 3) to the contours of charges (n, n_electrode), mm, with derivatives.

        Returns:
            Distances, shape (n, n_electrode); their derivatives by x, y and, unless the force is fixed, ln F times the
            radius, shape (n, n_electrode, 2 or 3).
        """
        known, slopes = linearised(self._charges, contact)
        usual = np.median(self._grid.slope, axis=0) * self._grid.growth(contact[:, 2])[:, None]
        slope = np.maximum(np.linalg.norm(slopes[..., :2], axis=2), FLAT * usual)
        lengths = slopes / (slope[..., None] * np.array([1.0, 1.0, self.charge_map.domain.radius]))
        return (known - charge) / slope, lengths[..., :2] if fixed else lengths

    def _moved(self, contact: Array, step: Array) -> Array:
        """Contacts after a step by x, y and, if it has a third component, ln F times the radius; within the domain."""
        domain = self.charge_map.domain
        at, force = onto_disk(contact[:, :2] + step[:, :2], INNER_RADIUS * domain.radius), contact[:, 2]
        if step.shape[1] == 3:
            force = np.clip(force * np.exp(step[:, 2] / domain.radius), *domain.force_range)
        return np.column_stack([at, force])


def gauss_newton_step(slopes: Array, away: Array) -> Array:
    """The step of Gauss and Newton towards the least sum of squared distances.

    Args:
        slopes: Derivatives of the distances by the unknowns, shape (n, n_distance, n_unknown), of order one.
        away: Distances, shape (n, n_distance), mm.

    Returns:
        Step, shape (n, n_unknown), mm, no longer than LARGEST_STEP.
    """
    square = np.einsum("nij,nik->njk", slopes, slopes) + DAMPING * np.eye(slopes.shape[2])
    step: Array = -np.linalg.solve(square, np.einsum("nij,ni->nj", slopes, away)[..., None])[..., 0]
    step *= np.minimum(1.0, LARGEST_STEP / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
    return step
