"""The working area: the disk within which the charges determine the contact."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_model import ChargeModel, electrode_count
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.checks import check_determined
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.ambiguities import AmbiguousPairs, find_ambiguous_pairs
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.folds import find_folds
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import Rings

ERROR = 1e-3
"""Default of the largest Cramer-Rao position error in a working area, m: the radius of the usual probe."""

GRID = 1e-4
"""Step to which radii of working areas are rounded down, m."""

CONFIRMATIONS = 4
"""Rings within the area are tried at most so often, each time within a smaller one: beside electrodes the error rises
between one ring and the next."""

Why = Literal["fold", "twins", "error", "searched"]


@dataclass(frozen=True)
class WorkingArea:
    """The largest disk about the film's centre within which the charges determine the contact.

    Attributes:
        radius: Radius of the disk, m, rounded down to 0.1 mm; 0 if there is none.
        why: What bounds it: "fold", "twins" (an ambiguous pair), "error", or "searched" if none of these lies within
            the search radius. Near a fold the error grows without bounds, so "error" comes before "fold".
        fold_radius: Distance from the centre of the nearest fold, m; infinite if there is none. With more than three
            electrodes a fold is a point where the map loses rank.
        twin_radius: Radius of the smallest disk that holds two contacts with the same charges, m; infinite if none.
        error_radius: Radius within which the position error is at most `error` at every force, m.
        error: Allowed Cramer-Rao position error (root mean square), m.
        searched: Radius of the search, m.
        force_range: Smallest and largest force, N.
        folds: Positions on fold lines, or where rank is lost, shape (n, 2), m.
        twins: Pairs of contacts with the same charges.
        electrodes: Number of electrodes.
    """

    radius: float
    why: Why
    fold_radius: float
    twin_radius: float
    error_radius: float
    error: float
    searched: float
    force_range: tuple[float, float]
    folds: Array
    twins: AmbiguousPairs
    electrodes: int

    @property
    def unfolded(self) -> float:
        """Radius of the largest disk without folds and ambiguous pairs, whatever the error, m, to 0.1 mm."""
        return _round_down(min(self.fold_radius, self.twin_radius, self.searched))

    @property
    def words(self) -> str:
        """The working area in a few sentences."""
        low, high = self.force_range
        parts = [f"Working area: up to {_in_millimetres(self.radius)} from the centre, {low:g} to {high:g} N."]
        if self.error_radius < min(self.searched, self.fold_radius, self.twin_radius):
            parts.append(f"Farther out the position error exceeds {_in_millimetres(self.error)} at {low:g} N.")
        if np.isfinite(self.fold_radius):
            parts.append(_fold_sentence(self.fold_radius, self.electrodes))
        if len(self.twins):
            parts.append(self.twins.words)
        if self.why == "searched":
            parts.append(f"The search ended at {_in_millimetres(self.searched)}.")
        return " ".join(parts)


def working_area(
    charges: ForwardMap | ChargeModel,
    noise: NoiseModel,
    *,
    error: float = ERROR,
    twins: bool = True,
) -> WorkingArea:
    """Find the working area within the radius and the forces that the charges cover.

    From a forward map it takes some 10 s (4 s for the splines, 1 s for folds and errors, 3 s for ambiguous pairs); from
    a charge model, such as a fit to measured charges, 400,000 evaluations, or 130,000 without ambiguous pairs.

    Args:
        charges: A forward map, or any `ChargeModel`, such as `ChargeFunction(fitted, radius, force_range)`.
        noise: Noise of the readings, with white noise above zero.
        error: Allowed Cramer-Rao position error, m, at every force.
        twins: Whether to search for contacts far apart with the same charges, too.

    Raises:
        SceneError: If there are fewer than three charges.
    """
    model = ChargeSpline.of(charges) if isinstance(charges, ForwardMap) else charges
    electrodes = electrode_count(model)
    check_determined(electrodes)
    rings = Rings.spread(model.radius)
    low, high = model.force_range
    forces = sorted({low, float(np.sqrt(low * high)), high})
    searches = [find_folds(model, rings, force, noise) for force in forces]
    folds = np.concatenate([search.points for search in searches])
    fold_radius = float(np.hypot(*folds.T).min()) if len(folds) else np.inf
    error_radius = min(
        min(_within(model, rings, force, noise, error), _nearest_over(model, search.weakest, force, noise, error))
        for force, search in zip(forces, searches, strict=True)
    )
    error_radius = _confirmed(model, error_radius, forces, noise, error)
    pairs = find_ambiguous_pairs(model, noise, low) if twins else AmbiguousPairs.none()
    twin_radius = float(pairs.reach[0]) if len(pairs) else np.inf
    ends: dict[Why, float] = {
        "searched": model.radius,
        "fold": fold_radius,
        "twins": twin_radius,
        "error": error_radius if error_radius < model.radius else np.inf,
    }
    why = min(ends, key=lambda reason: ends[reason])
    return WorkingArea(
        _round_down(ends[why]),
        why,
        fold_radius,
        twin_radius,
        error_radius,
        error,
        model.radius,
        model.force_range,
        folds,
        pairs,
        electrodes,
    )


def _confirmed(model: ChargeModel, radius: float, forces: list[float], noise: NoiseModel, error: float) -> float:
    """The radius within which the error is allowed, m, or a smaller one where rings within it say so."""
    for _ in range(CONFIRMATIONS if radius < model.radius else 0):
        if (rounded := _round_down(radius)) <= 0.0:
            break
        within = min(_within(model, Rings.spread(rounded), force, noise, error) for force in forces)
        if within >= rounded * (1.0 - 1e-9):
            break
        radius = within
    return radius


def _within(model: ChargeModel, rings: Rings, force: float, noise: NoiseModel, error: float) -> float:
    """Distance at which the position error first exceeds the allowed one, m; between rings ln(error) is linear."""
    worst = rings.per_ring(limits_at(model, rings.contacts(force), noise).position).max(axis=1)
    over = np.flatnonzero(~(worst <= error))
    if not over.size:
        return float(rings.distance[-1])
    first = int(over[0])
    if first == 0:
        return 0.0
    logs = np.log(worst[first - 1 : first + 1])
    return float(np.interp(np.log(error), logs, rings.distance[first - 1 : first + 1]))


def _nearest_over(model: ChargeModel, position: Array, force: float, noise: NoiseModel, error: float) -> float:
    """Distance of the nearest position, shape (n, 2), at which the position error exceeds the allowed one, m."""
    limit = limits_at(model, np.column_stack([position, np.full(len(position), force)]), noise).position
    return float(np.hypot(*position.T).min(initial=np.inf, where=~(limit <= error)))


def _fold_sentence(radius: float, electrodes: int) -> str:
    sides = "the fold" if electrodes == 3 else "the points where it loses rank"
    return (
        f"The map folds {1e3 * radius:.1f} mm from the centre: contacts on both sides of {sides} give the same "
        "charges, and no method can tell them apart."
    )


def _round_down(radius: float) -> float:
    return float(f"{np.floor(radius / GRID * (1.0 + 1e-9)) * GRID:.12g}")


def _in_millimetres(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"
