"""What a layout of electrodes resolves over a disk, in some tenths of a second: limits, folds, ambiguous pairs.

For searches over layouts: `working_area` asks how far from the centre a sensor can be used, this asks how well it does
over a radius that is given.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.simulate.forward.charge_map import ChargeMap, within
from isocharge.simulate.forward.charge_spline import with_fast_derivatives
from isocharge.simulate.forward.checks import check_determined, check_forces, check_radius
from isocharge.simulate.identifiability.ambiguous_pairs import AmbiguousPairs, find_ambiguous_pairs
from isocharge.simulate.identifiability.cramer_rao import Nuisance, limits_at
from isocharge.simulate.identifiability.folds import find_folds
from isocharge.simulate.identifiability.working_area import ERROR
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import Rings, square_grid

SPACING = 0.3
"""Default spacing of the places, mm: the worst lies beside electrodes, and a coarse grid hides it."""


@dataclass(frozen=True)
class LayoutAssessment:
    """What the charges of a layout determine over a disk.

    Attributes:
        position: The places, shape (n, 2), mm.
        forces: The forces, N.
        limit: Cramer-Rao limit of the position, root mean square, shape (n_force, n), mm.
        relative_force: Cramer-Rao limit of the force over the force, shape (n_force, n).
        folds: Positions at which the map folds under any of the forces, shape (k, 2), mm, the nearest first.
        pairs: Pairs of contacts far apart with the same charges, the nearest first; none if not searched.
        error: Largest position error at which a contact counts as determined, mm.
    """

    position: Array
    forces: tuple[float, ...]
    limit: Array
    relative_force: Array
    folds: Array
    pairs: AmbiguousPairs
    error: float

    @property
    def worst(self) -> float:
        """Largest limit of the position, mm."""
        return float(self.limit.max())

    @property
    def rms(self) -> float:
        """Limit of the position, root mean square over places and forces, mm."""
        return float(np.sqrt(np.mean(self.limit**2)))

    @property
    def fold_radius(self) -> float:
        """Distance of the nearest fold from the centre, mm; infinite if there is none."""
        return float(np.hypot(*self.folds.T).min(initial=np.inf))

    @property
    def determined(self) -> bool:
        """Whether the charges determine every contact: no folds, no ambiguous pairs, no error above the allowed one."""
        return not len(self.folds) and not len(self.pairs) and self.worst <= self.error

    @property
    def summary(self) -> str:
        """For people."""
        parts = [f"position error {self.worst:.3f} mm at worst, {self.rms:.3f} mm rms"]
        if len(self.folds):
            parts.append(f"the map folds {self.fold_radius:.1f} mm from the centre")
        if len(self.pairs):
            parts.append(f"{len(self.pairs)} pairs of contacts have the same charges")
        return "; ".join(parts)


def assess_layout(
    charge_map: ChargeMap,
    noise: NoiseModel,
    *,
    radius: float | None = None,
    forces: Sequence[float] = (1.0,),
    spacing: float = SPACING,
    error: float = ERROR,
    search_pairs: bool = True,
    nuisance: Nuisance | None = None,
) -> LayoutAssessment:
    """Limits, folds and ambiguous pairs over a disk.

    With splines over 15 mm it takes 0.15 s for each force, and 0.7 s for each force's ambiguous pairs; a forward map is
    made into splines first, which takes seconds.

    Args:
        charge_map: The charges.
        noise: Noise of the readings, with white noise above zero.
        radius: Of the disk, mm; that of the map if absent.
        forces: Forces of the contacts, N.
        spacing: Of the places, mm: a square grid through the centre.
        error: Largest position error at which a contact counts as determined, mm.
        search_pairs: Whether to search for contacts far apart with the same charges.
        nuisance: What else is unknown, for the limits; folds and ambiguous pairs do not regard it.

    Raises:
        SceneError: If the map does not cover the radius or the forces, or has fewer than three charges.
    """
    domain = charge_map.domain
    radius = domain.radius if radius is None else radius
    check_radius(radius, domain.radius, "charge map")
    if not forces:
        raise SceneError("forces: expected at least one force, got none")
    check_forces(np.array(forces), domain.force_range, "charge map")
    check_determined(len(charge_map.electrodes))
    charge_map = with_fast_derivatives(charge_map)
    disk, rings, at = within(charge_map, radius), Rings.spread(radius), square_grid(radius, spacing)
    limits = [limits_at(charge_map, np.column_stack([at, np.full(len(at), f)]), noise, nuisance) for f in forces]
    folds = np.concatenate([find_folds(disk, rings, force, noise).points for force in forces])
    pairs = [find_ambiguous_pairs(disk, noise, force) for force in forces] if search_pairs else []
    return LayoutAssessment(
        position=at,
        forces=tuple(forces),
        limit=np.stack([limit.position for limit in limits]),
        relative_force=np.stack([limit.force for limit in limits]),
        folds=folds[np.argsort(np.hypot(*folds.T), kind="stable")],
        pairs=AmbiguousPairs.joined(pairs),
        error=error,
    )
