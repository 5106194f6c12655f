"""Computation of the working area: the disk in which the charges determine the contact."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import ChargeMap, check_electrode_count
from isocharge.simulate.identifiability.ambiguous_pairs import AmbiguousPairs, find_ambiguous_pairs
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.folds import find_folds
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import Rings

DEFAULT_ERROR = 1.0
"""Default value of the largest Cramer-Rao position error in a working area, mm.

This value is the radius of the default probe.
"""

RADIUS_STEP = 0.1
"""The radius of a working area is rounded down to a multiple of this step, mm."""

MAX_RINGS = 200
"""Largest number of rings on which the position error is evaluated. Larger disks have a multiple of `RADIUS_STEP`."""

Bound = Literal["fold", "twins", "error", "searched"]
"""Reason for the radius of a working area.

"twins" are an ambiguous pair, and "searched" means that only the radius of the search bounds the area.
The error grows without limit towards a fold. An area that ends just before a fold therefore mostly has the bound
"error".
"""


@dataclass(frozen=True)
class WorkingArea:
    """Largest disk around the centre of the film within which the charges determine the contact.

    Attributes:
        radius: Radius of the disk, mm, rounded down to 0.1 mm; 0 if there is no such disk.
        bound: Reason for the radius.
        fold_radius: Distance of the nearest fold from the centre, mm; infinite if there are no folds.
        error_radius: Radius within which the position error is at most `error` for every force, mm.
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
        """Sentences that describe the working area and the reason for its radius."""
        min_force, max_force = self.force_range
        sentences = [f"Working area: up to {self.radius:.3g} mm from the centre, {min_force:g} to {max_force:g} N."]
        is_limited_by_error = self.error_radius < min(self.search_radius, self.fold_radius, self.pairs.radius)
        if is_limited_by_error:
            if self.unambiguous_radius > self.radius:
                sentences.append(f"Up to {self.unambiguous_radius:.3g} mm, the charges determine the contact uniquely.")
            sentences.append(
                f"Beyond {self.radius:.3g} mm, the position error exceeds {self.error:.3g} mm at {min_force:g} N."
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
    """Find the working area within the domain of a charge map.

    The radius of the working area is the smallest of four radii. Two of them are the distance from the centre at which
    the position error first exceeds its limit, and the distance of the nearest fold. The other two are the radius of
    the nearest ambiguous pair, and the radius of the domain.

    A forward map is first replaced by splines, because splines are faster. Any other charge map, such as a fit to
    measured charges, is evaluated for about 400,000 contacts. Without the search for ambiguous pairs, the charge map is
    evaluated for about 130,000 contacts.

    Args:
        charge_map: Map that computes the charges of contacts.
        noise: Noise of the readings. The white noise must be positive.
        error: Largest Cramer-Rao position error that is allowed for every force, mm.
        search_pairs: Whether to search for pairs of distant contacts with the same charges.

    Raises:
        SceneError: If the map has fewer than three electrodes.
    """
    from isocharge.simulate.forward.charge_spline import with_fast_derivatives  # imports the solver

    check_electrode_count(len(charge_map.electrodes))
    charge_map = with_fast_derivatives(charge_map)
    search_radius = charge_map.domain.radius
    min_force, max_force = charge_map.domain.force_range
    middle_force = float(np.sqrt(min_force * max_force))
    forces = sorted({min_force, middle_force, max_force})

    # The distances of the rings are multiples of the step to which the radius of the working area is rounded.
    step = RADIUS_STEP * np.ceil(search_radius / (MAX_RINGS * RADIUS_STEP))
    n_rings = max(1, int(_round_down(search_radius, step) / step + 0.5))
    rings = Rings.spread(min(n_rings * step, search_radius), n_rings)

    # Find the folds, and the last ring before the error first exceeds its limit. An error that is NaN exceeds it.
    folds = np.concatenate([find_folds(charge_map, rings, force, noise) for force in forces])
    fold_radius = float(np.hypot(*folds.T).min(initial=np.inf))
    errors = [rings.per_ring(limits_at(charge_map, rings.contacts(force), noise).position) for force in forces]
    is_within_limit = (np.array(errors) <= error).all(axis=(0, 2))
    error_radius = search_radius
    if not is_within_limit.all():
        error_radius = float(np.append(0.0, rings.distance)[is_within_limit.argmin()])
    pairs = find_ambiguous_pairs(charge_map, noise, min_force) if search_pairs else AmbiguousPairs.none()

    # The smallest of the following radii bounds the working area. If the error never exceeds its limit, `error_radius`
    # is the radius of the search, and the error is not a bound.
    radii: dict[Bound, float] = {
        "searched": search_radius,
        "fold": fold_radius,
        "twins": pairs.radius,
        "error": error_radius if error_radius < search_radius else np.inf,
    }
    bound = min(radii, key=lambda reason: radii[reason])
    return WorkingArea(
        radius=_round_down(radii[bound]),
        bound=bound,
        fold_radius=fold_radius,
        error_radius=error_radius,
        error=error,
        search_radius=search_radius,
        force_range=(min_force, max_force),
        folds=folds,
        pairs=pairs,
        electrodes=len(charge_map.electrodes),
    )


def _round_down(radius: float, step: float = RADIUS_STEP) -> float:
    """Round a radius down to a multiple of a step, mm."""
    # The factor compensates the rounding error of the quotient. The conversion into decimal digits removes the rounding
    # error of the product.
    steps = np.floor(radius / step * (1.0 + 1e-9))
    return float(f"{steps * step:.12g}")
