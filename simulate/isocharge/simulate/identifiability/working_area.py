"""The working area: the disk within which the charges determine the contact."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import ChargeMap, check_determined
from isocharge.simulate.forward.charge_spline import with_fast_derivatives
from isocharge.simulate.identifiability.ambiguous_pairs import AmbiguousPairs, find_ambiguous_pairs
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.folds import find_folds
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import Rings

ERROR = 1.0
"""Default of the largest Cramer-Rao position error in a working area, mm: the radius of the usual probe."""

GRID = 0.1
"""Step to which radii of working areas are rounded down, mm."""

CONFIRMATIONS = 4
"""Most times that rings within the area are tried, each time within a smaller one: beside electrodes the error rises
between one ring and the next."""

Bound = Literal["fold", "ambiguous pair", "error", "search"]
"""What bounds a working area: "search" if nothing else does within the radius of the search. Near a fold the error
grows without bounds, so "error" comes before "fold"."""


@dataclass(frozen=True)
class WorkingArea:
    """The largest disk about the film's centre within which the charges determine the contact.

    Attributes:
        radius: Radius of the disk, mm, rounded down to 0.1 mm; 0 if there is none.
        bound: What bounds it.
        fold_radius: Distance from the centre of the nearest fold, mm; infinite if there is none. With more than three
            electrodes a fold is a point where the map loses rank.
        error_radius: Radius within which the position error is at most `error` at every force, mm.
        error: Allowed Cramer-Rao position error (root mean square), mm.
        searched: Radius of the search, mm.
        force_range: Smallest and largest force, N.
        folds: Positions on fold lines, or where rank is lost, shape (n, 2), mm.
        pairs: Pairs of contacts far apart with the same charges.
        electrodes: Number of electrodes.
    """

    radius: float
    bound: Bound
    fold_radius: float
    error_radius: float
    error: float
    searched: float
    force_range: tuple[float, float]
    folds: Array
    pairs: AmbiguousPairs
    electrodes: int

    @property
    def unambiguous_radius(self) -> float:
        """Radius of the largest disk without folds and ambiguous pairs, whatever the error, mm, to 0.1 mm."""
        return _round_down(min(self.fold_radius, self.pairs.radius, self.searched))

    @property
    def summary(self) -> str:
        """The working area in a few sentences."""
        low, high = self.force_range
        parts = [f"Working area: up to {self.radius:.3g} mm from the centre, {low:g} to {high:g} N."]
        if self.error_radius < min(self.searched, self.fold_radius, self.pairs.radius):
            parts.append(f"Farther out the position error exceeds {self.error:.3g} mm at {low:g} N.")
        if np.isfinite(self.fold_radius):
            sides = "the fold" if self.electrodes == 3 else "the points where it loses rank"
            parts.append(
                f"The map folds {self.fold_radius:.1f} mm from the centre: contacts on both sides of {sides} give the "
                "same charges, and no method can tell them apart by one reading."
            )
        if len(self.pairs):
            parts.append(self.pairs.summary)
        if self.bound == "search":
            parts.append(f"The search ended at {self.searched:.3g} mm.")
        return " ".join(parts)


def working_area(
    charge_map: ChargeMap, noise: NoiseModel, *, error: float = ERROR, search_pairs: bool = True
) -> WorkingArea:
    """Find the working area within the domain of a map.

    From a forward map it takes some 10 s (4 s for splines, 1 s for folds and errors, 3 s for ambiguous pairs); from any
    other map, such as a fit to measured charges, 400,000 evaluations, or 130,000 without ambiguous pairs.

    Args:
        charge_map: The charges.
        noise: Noise of the readings, with white noise above zero.
        error: Allowed Cramer-Rao position error, mm, at every force.
        search_pairs: Whether to search for contacts far apart with the same charges, too.

    Raises:
        SceneError: If there are fewer than three charges.
    """
    check_determined(len(charge_map.electrodes))
    charge_map = with_fast_derivatives(charge_map)
    searched, (low, high) = charge_map.domain.radius, charge_map.domain.force_range
    rings, forces = Rings.spread(searched), sorted({low, float(np.sqrt(low * high)), high})
    searches = [find_folds(charge_map, rings, force, noise) for force in forces]
    folds = np.concatenate([search.points for search in searches])
    fold_radius = float(np.hypot(*folds.T).min(initial=np.inf))
    error_radius = min(
        min(_within(charge_map, rings, force, noise, error), _nearest_over(charge_map, weakest, force, noise, error))
        for force, weakest in zip(forces, (search.weakest for search in searches), strict=True)
    )
    error_radius = _confirmed(charge_map, error_radius, forces, noise, error)
    pairs = find_ambiguous_pairs(charge_map, noise, low) if search_pairs else AmbiguousPairs.none()
    ends: dict[Bound, float] = {
        "search": searched,
        "fold": fold_radius,
        "ambiguous pair": pairs.radius,
        "error": error_radius if error_radius < searched else np.inf,
    }
    bound = min(ends, key=lambda each: ends[each])
    return WorkingArea(
        radius=_round_down(ends[bound]),
        bound=bound,
        fold_radius=fold_radius,
        error_radius=error_radius,
        error=error,
        searched=searched,
        force_range=(low, high),
        folds=folds,
        pairs=pairs,
        electrodes=len(charge_map.electrodes),
    )


def _confirmed(charge_map: ChargeMap, radius: float, forces: list[float], noise: NoiseModel, error: float) -> float:
    """The radius within which the error is allowed, mm, or a smaller one where rings within it say so."""
    for _ in range(CONFIRMATIONS if radius < charge_map.domain.radius else 0):
        if (rounded := _round_down(radius)) <= 0.0:
            break
        within = min(_within(charge_map, Rings.spread(rounded), force, noise, error) for force in forces)
        if within >= rounded * (1.0 - 1e-9):
            break
        radius = within
    return radius


def _within(charge_map: ChargeMap, rings: Rings, force: float, noise: NoiseModel, error: float) -> float:
    """Distance at which the position error first exceeds the allowed one, mm; between rings ln(error) is linear."""
    worst = rings.per_ring(limits_at(charge_map, rings.contacts(force), noise).position).max(axis=1)
    over = np.flatnonzero(~(worst <= error))
    if not over.size:
        return float(rings.distance[-1])
    first = int(over[0])
    if first == 0:
        return 0.0
    logs = np.log(worst[first - 1 : first + 1])
    return float(np.interp(np.log(error), logs, rings.distance[first - 1 : first + 1]))


def _nearest_over(charge_map: ChargeMap, position: Array, force: float, noise: NoiseModel, error: float) -> float:
    """Distance of the nearest position, shape (n, 2), at which the position error exceeds the allowed one, mm."""
    limit = limits_at(charge_map, np.column_stack([position, np.full(len(position), force)]), noise).position
    return float(np.hypot(*position.T).min(initial=np.inf, where=~(limit <= error)))


def _round_down(radius: float) -> float:
    return float(f"{np.floor(radius / GRID * (1.0 + 1e-9)) * GRID:.12g}")
