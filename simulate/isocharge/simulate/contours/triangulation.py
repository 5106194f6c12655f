"""Triangulation: where the isocharge contours of the electrodes meet (Mirbagheri et al. 2007, Fig. 9 and 10).

Each charge confines the press to a contour. Two contours cross in points; the paper takes the three crossings of three
electrodes' contours that lie together and calls their mean the position, and with four electrodes averages over the
four triples. So does `Triangulation.locate`: it searches for positions near all contours, follows each pair of contours
to its crossing by Newton's method, and says in `Fix.status` if there is no such position, or more than one.

With the force unknown the contours move with it, and the press is where, over all forces, they come closest to meeting:
the point and the force with the least mean square distance to the contours (`Triangulation.locate_with_force`).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.simulate.contours.candidates import FLAT, Candidates, SeedGrid, gauss_newton_step
from isocharge.simulate.contours.fix import AMBIGUOUS, APART, RESOLVED, TOLERANCE, Fix, Meeting, check_electrodes
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.checks import as_charges, check_forces
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.numerics.disk import onto_disk

SECOND_SEARCH = 2.0
"""Distance from a meeting at which the search for a second one starts, in tolerances."""

SEEDS = 4
"""Largest number of starting points for each press, those nearest to all contours first."""

STEPS, CONVERGED = 25, 1e-8
"""Number of Newton steps, and the distance from a contour at which a point counts as on it, m."""

CHUNK = 512
"""Number of presses located together: keeps the working arrays within some 100 MB."""


@dataclass(frozen=True)
class Triangulation:
    """Charges to positions by the meeting of contours.

    Attributes:
        table: The charges.
        tolerance: Largest distance of three crossings from their mean at which contours meet, m.
    """

    table: ChargeSpline
    tolerance: float = TOLERANCE

    def __post_init__(self) -> None:
        check_electrodes(self.table.electrode_names)
        if not (np.isfinite(self.tolerance) and self.tolerance > 0.0):
            raise SceneError(f"tolerance: expected a positive length, got {self.tolerance * 1e3} mm")

    @classmethod
    def from_map(
        cls,
        forward_map: ForwardMap,
        *,
        radius: float | None = None,
        spacing: float | None = None,
        tolerance: float = TOLERANCE,
    ) -> "Triangulation":
        """From a forward map, whose probe keeps the angle it has.

        Args:
            forward_map: Charges of the sensor under the probe.
            radius: Largest distance of a position from the centre, m; that of the map if absent.
            spacing: Distance of the knots of the tabulated charges, m; that of `ChargeSpline.of` if absent.
            tolerance: See the class.

        Raises:
            SensorError: If there are fewer than three electrodes.
            SceneError: If the radius reaches beyond the map.
        """
        check_electrodes(forward_map.electrode_names)
        return cls(ChargeSpline.of(forward_map, radius, spacing), tolerance)

    def locate(self, charge: Array, force: Array | float) -> Fix:
        """Positions of presses of known force.

        Args:
            charge: Touch charges, shape (n, n_electrode), C.
            force: Shape (n,) or a number, N.

        Returns:
            One fix for each press; NaN where `status` is not `Meeting.met`.

        Raises:
            ChargeError: If the charges are not finite or not one for each electrode.
            SceneError: If a force lies outside the table.
        """
        charge = as_charges(charge, self.table.electrode_names)
        force = np.broadcast_to(np.asarray(force, dtype=float), len(charge))
        check_forces(force, self.table.force_range, "table")
        return self._in_chunks(charge, force)

    def locate_with_force(self, charge: Array) -> Fix:
        """Positions and forces of presses: where the contours over all forces come closest to meeting.

        Args:
            charge: Touch charges, shape (n, n_electrode), C.

        Returns:
            One fix for each press; NaN, the force included, where `status` is not `Meeting.met`.

        Raises:
            ChargeError: If the charges are not finite or not one for each electrode.
        """
        return self._in_chunks(as_charges(charge, self.table.electrode_names), None)

    def _in_chunks(self, charge: Array, force: Array | None) -> Fix:
        if len(charge) == 0:
            empty = np.zeros(0)
            return Fix(empty, empty, empty, empty, empty.astype(np.intp), empty.astype(np.intp))
        parts = []
        for start in range(0, len(charge), CHUNK):
            rows = slice(start, start + CHUNK)
            known = None if force is None else force[rows]
            candidates = self._candidates(charge[rows], known)
            parts.append(self._choose(charge[rows], known, candidates))
        return Fix(*(np.concatenate([getattr(part, name) for part in parts]) for name in Fix.__dataclass_fields__))

    def _candidates(self, charge: Array, force: Array | None) -> Candidates:
        seeds = self._seeds(charge, force)
        closest = self._approach(charge, seeds, fixed=force is not None)
        closest = closest.within(self.tolerance).distinct(APART)
        second = self._approach(charge, self._second_seeds(closest, fixed=force is not None), fixed=force is not None)
        closest = closest.joined(second.within(self.tolerance)).distinct(APART)
        return closest if force is None else self._cross(charge, closest)

    def _choose(self, charge: Array, force: Array | None, candidates: Candidates) -> Fix:
        """The best candidate of each press, if it has one and it is not ambiguous."""
        count = len(charge)
        order = np.lexsort((candidates.spread, candidates.press))
        press, spread = candidates.press[order], candidates.spread[order]
        first = np.searchsorted(press, np.arange(count))
        matches = np.bincount(press, minlength=count)
        best = np.full(count, np.nan)
        best[matches > 0] = spread[first[matches > 0]]
        second = np.full(count, np.inf)
        second[matches > 1] = spread[first[matches > 1] + 1]
        status = np.where(matches > 0, int(Meeting.met), int(Meeting.apart))
        status[(matches == 0) & self._out_of_reach(charge, force)] = Meeting.no_contour
        status[second <= np.maximum(AMBIGUOUS * best, RESOLVED)] = Meeting.twice
        met = np.flatnonzero(status == Meeting.met)
        chosen = order[first[met]]
        columns = np.full((3, count), np.nan)
        columns[:, met] = np.stack([*candidates.at[chosen].T, candidates.force[chosen]])
        triples = np.zeros(count, dtype=np.intp)
        triples[met] = candidates.triples[chosen]
        return Fix(columns[0], columns[1], columns[2] if force is None else force, best, status, triples)

    # Starting points

    @cached_property
    def _nodes(self) -> SeedGrid:
        return SeedGrid.of(self.table)

    def _seeds(self, charge: Array, force: Array | None) -> Candidates:
        """Nodes that are nearer to all contours than their neighbours are."""
        nodes = self._nodes
        forces = nodes.matching_force(charge) if force is None else force[:, None]
        distance = nodes.distance(charge, forces)
        press, node = nodes.lowest(distance, SEEDS)
        chosen = forces[press, node] if force is None else force[press]
        return Candidates.begin(press, nodes.at[node], chosen)

    def _out_of_reach(self, charge: Array, force: Array | None) -> np.ndarray:
        """Whether each press has a charge that no node of the grid has, shape (n,)."""
        low, high = self._nodes.reach(force if force is not None else np.array(self.table.force_range))
        if force is None:
            low, high = low.min(axis=0), high.max(axis=0)
        slack = 0.02 * (high - low)
        return np.asarray(((charge < low - slack) | (charge > high + slack)).any(axis=1))

    # From the starting points to the meeting

    def _second_seeds(self, closest: Candidates, *, fixed: bool) -> Candidates:
        """Starting points for a second meeting across a fold: on both sides, in the direction of least change."""
        _, slope, by_force = self.table.first_order(closest.at, closest.force)
        free = self._unit_slopes(slope, by_force, closest.force, fixed=fixed)
        softest = np.linalg.svd(free)[2][:, -1]
        sides = []
        for aside in (-SECOND_SEARCH * self.tolerance, SECOND_SEARCH * self.tolerance):
            force = closest.force * (1.0 if fixed else np.exp(aside * softest[:, -1] / self.table.radius))
            sides.append(Candidates.begin(closest.press, closest.at + aside * softest[:, :2], force))
        return sides[0].joined(sides[1])

    def _approach(self, charge: Array, seeds: Candidates, *, fixed: bool) -> Candidates:
        """Gauss-Newton to the point (and, unless fixed, the force) of least mean square distance to the contours."""
        at, force, best = seeds.at, seeds.force, seeds
        for _ in range(STEPS):
            value, slope, by_force = self.table.first_order(at, force)
            away = (value - charge[seeds.press]) / self._gauge(slope, force)
            best = best.improved(at, force, np.sqrt(np.mean(away**2, axis=1)))
            step = gauss_newton_step(self._unit_slopes(slope, by_force, force, fixed=fixed), away)
            at = onto_disk(at + step[:, :2], self.table.radius)
            if not fixed:
                force = np.clip(force * np.exp(step[:, 2] / self.table.radius), *self.table.force_range)
        return best

    def _unit_slopes(self, slope: Array, by_force: Array, force: Array, *, fixed: bool) -> Array:
        """Derivatives of distances by lengths, shape (n, n_electrode, 2 or 3): ln F counts as ln F times the radius."""
        gauge = self._gauge(slope, force)
        units = slope / gauge[..., None]
        return units if fixed else np.concatenate([units, (by_force / gauge / self.table.radius)[..., None]], axis=2)

    def _cross(self, charge: Array, near: Candidates) -> Candidates:
        """The mean of each triple's crossings near a candidate, averaged over the triples that meet there."""
        count = self.table.electrodes
        pairs = list(combinations(range(count), 2))
        crossing = np.stack([self._crossing(charge, near, pair) for pair in pairs], axis=1)
        total, met = np.zeros_like(near.at), np.zeros(len(near.press), dtype=np.intp)
        spread = np.zeros(len(near.press))
        for triple in combinations(range(count), 3):
            corners = crossing[:, [pairs.index(pair) for pair in combinations(triple, 2)]]
            mean = corners.mean(axis=1)
            distance = np.linalg.norm(corners - mean[:, None], axis=2).max(axis=1)
            good = distance <= self.tolerance  # False for the NaN of a pair that does not cross
            total[good] += mean[good]
            spread[good] = np.maximum(spread[good], distance[good])
            met += good
        some = met > 0
        means = Candidates(near.press[some], total[some] / met[some, None], near.force[some], spread[some], met[some])
        return means.distinct(APART)

    def _crossing(self, charge: Array, near: Candidates, pair: tuple[int, int]) -> Array:
        """Crossing of two contours, by Newton's method from each candidate; shape (n, 2), NaN if they do not cross."""
        at, charges = near.at.copy(), charge[near.press][:, pair]
        crossing = np.full_like(at, np.nan)
        active = np.arange(len(at))
        for _ in range(STEPS):
            force = near.force[active]
            value, slope, _ = self.table.first_order(at[active], force)
            gauge = self._gauge(slope, force)[:, pair]
            away = (value[:, pair] - charges[active]) / gauge
            moving = np.abs(away).max(axis=1) >= CONVERGED
            crossing[active[~moving]] = at[active[~moving]]
            active = active[moving]
            if active.size == 0:
                break
            step = gauss_newton_step((slope[:, pair] / gauge[..., None])[moving], away[moving])
            at[active] = onto_disk(at[active] + step, self.table.radius)
        return crossing

    def _gauge(self, slope: Array, force: Array) -> Array:
        """Length of the slopes, at least FLAT of the electrode's median; shape (n, n_electrode), C/m."""
        usual = np.median(self._nodes.gauge, axis=0) * self.table.scale(force)[:, None]
        gauge: Array = np.maximum(np.linalg.norm(slope, axis=2), FLAT * usual)
        return gauge
