"""Where the fitted forward map folds: the largest disk in which charges still determine the contact.

With three electrodes det d(ln Q)/d(x, y, ln F) changes sign at a fold, and beyond it two contacts give the same charges.
With more electrodes there is no such sign; the map then counts as folded where the volume that it spans,
sqrt(det J' J), falls below a hundredth of what it is in the middle.
"""

import numpy as np

from isocharge.simulate.arrays import Array
from isocharge.train.charge_field import ChargeField, Domain

RINGS, ANGLES, FORCES = 81, 120, 5
"""Places where the map is looked at: distances, directions, forces."""

FLAT = 1e-2
"""Share of the middle's volume below which a map of more than three charges counts as folded."""

SMALLEST_SHARE = 0.2
"""Share of the asked radius that has to be left for a training to make sense."""


def fold_free_share(field: ChargeField) -> float:
    """Share of the domain's radius within which the map does not fold, 1 if nowhere."""
    reach = np.linspace(0.0, 1.0, RINGS)
    angle = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
    ring, turn, force = (axis.ravel() for axis in np.meshgrid(reach, angle, np.linspace(-1, 1, FORCES), indexing="ij"))
    unit = np.stack([ring * np.cos(turn), ring * np.sin(turn), force], axis=1)
    volume = signed_volume(field.log_charge(unit)[:, 1:]).reshape(RINGS, -1)
    middle = np.median(volume[0])
    least = FLAT if field.series.shape[-1] > 3 else 0.0
    folded = (volume / middle <= least).any(axis=1)
    return 1.0 if not folded.any() else float(reach[max(int(np.argmax(folded)) - 1, 0)])


def signed_volume(slope: Array) -> Array:
    """Volume that the derivatives (n, 3, n_electrode) span, shape (n,); signed for three electrodes."""
    if slope.shape[2] == 3:
        signed: Array = np.linalg.det(slope)
        return signed
    volume: Array = np.sqrt(np.maximum(np.linalg.det(slope @ slope.transpose(0, 2, 1)), 0.0))
    return volume


def shrunk(domain: Domain, share: float) -> Domain:
    """The domain with a share of its radius, rounded down to a tenth of a millimetre."""
    return Domain(np.floor(10.0 * share * domain.radius_mm) / 10.0, domain.force_range_N)
