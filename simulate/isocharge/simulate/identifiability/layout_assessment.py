"""What a layout of electrodes resolves over a disk, in some tenths of a second: limits, folds, twins.

For searches over layouts: `working_area` asks how far from the centre a sensor can be used, this asks how well it does
over a radius that is given.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.simulate.forward.charge_model import ChargeModel, electrode_count, within_radius
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.checks import check_determined, check_forces, check_radius
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.ambiguities import AmbiguousPairs, find_ambiguous_pairs
from isocharge.simulate.identifiability.cramer_rao import Nuisance, limits_at
from isocharge.simulate.identifiability.folds import fold_points
from isocharge.simulate.identifiability.working_area import ERROR
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import Rings, square_grid

SPACING = 0.3e-3
"""Default spacing of the places, m: the worst lies beside electrodes, and a coarse grid hides it."""


@dataclass(frozen=True)
class LayoutAssessment:
    """What the charges of a layout determine over a disk.

    Attributes:
        position: The places, shape (n, 2), m.
        forces: The forces, N.
        limit: Cramer-Rao limit of the position, root mean square, shape (n_force, n), m.
        relative_force: Cramer-Rao limit of the force over the force, shape (n_force, n).
        folds: Positions at which the map folds under any of the forces, shape (k, 2), m, the nearest first.
        twins: Pairs of contacts far apart with the same charges, the nearest first; none if not searched.
        error: Largest position error at which a contact counts as determined, m.
    """

    position: Array
    forces: tuple[float, ...]
    limit: Array
    relative_force: Array
    folds: Array
    twins: AmbiguousPairs
    error: float

    @property
    def worst(self) -> float:
        """Largest limit of the position, m."""
        return float(self.limit.max())

    @property
    def rms(self) -> float:
        """Limit of the position, root mean square over places and forces, m."""
        return float(np.sqrt(np.mean(self.limit**2)))

    @property
    def fold_radius(self) -> float:
        """Distance of the nearest fold from the centre, m; infinite if there is none."""
        return float(np.hypot(*self.folds[0])) if len(self.folds) else np.inf

    @property
    def twin_radius(self) -> float:
        """Radius of the smallest disk that holds two contacts with the same charges, m; infinite if there are none."""
        return float(self.twins.reach[0]) if len(self.twins) else np.inf

    @property
    def determined(self) -> bool:
        """Whether the charges determine every contact: no folds, no twins, no error above the allowed one."""
        return not len(self.folds) and not len(self.twins) and self.worst <= self.error

    @property
    def words(self) -> str:
        """For people."""
        parts = [f"position error {1e3 * self.worst:.3f} mm at worst, {1e3 * self.rms:.3f} mm rms"]
        parts += [f"the map folds {1e3 * self.fold_radius:.1f} mm from the centre"] * bool(len(self.folds))
        parts += [f"{len(self.twins)} pairs of contacts have the same charges"] * bool(len(self.twins))
        return "; ".join(parts)


def assess_layout(
    charges: ForwardMap | ChargeModel,
    noise: NoiseModel,
    *,
    radius: float | None = None,
    forces: Sequence[float] = (1.0,),
    spacing: float = SPACING,
    error: float = ERROR,
    twins: bool = True,
    nuisance: Nuisance | None = None,
) -> LayoutAssessment:
    """Limits, folds and twins over a disk.

    With splines over 15 mm 0.15 s for each force, and 0.7 s for each force's twins; a forward map is made into splines
    first, which takes seconds.

    Args:
        charges: A forward map, or any `ChargeModel`.
        noise: Noise of the readings, with white noise above zero.
        radius: Of the disk, m; as far as the charges reach if absent.
        forces: Forces of the contacts, N.
        spacing: Of the places, m: a square grid through the centre.
        error: Largest position error at which a contact counts as determined, m.
        twins: Whether to search for contacts far apart with the same charges.
        nuisance: What else is unknown, for the limits; folds and twins do not regard it.

    Raises:
        SceneError: If the charges do not reach so far or hold at these forces, or there are fewer than three.
    """
    reach = charges.radius if radius is None else radius
    check_radius(reach, charges.radius, "charge model")
    if not forces:
        raise SceneError("forces: expected at least one force, got none")
    check_forces(np.array(forces), charges.force_range, "charge model")
    model = ChargeSpline.of(charges) if isinstance(charges, ForwardMap) else charges
    check_determined(electrode_count(model))
    disk, rings, at = within_radius(model, reach), Rings.spread(reach), square_grid(reach, spacing)
    limits = [limits_at(model, np.column_stack([at, np.full(len(at), f)]), noise, nuisance) for f in forces]
    folds = np.concatenate([fold_points(disk, rings, force, noise) for force in forces])
    pairs = [find_ambiguous_pairs(disk, noise, force) for force in forces] if twins else []
    return LayoutAssessment(
        at,
        tuple(forces),
        np.stack([limit.position for limit in limits]),
        np.stack([limit.force for limit in limits]),
        folds[np.argsort(np.hypot(*folds.T), kind="stable")],
        AmbiguousPairs.joined(pairs),
        error,
    )
