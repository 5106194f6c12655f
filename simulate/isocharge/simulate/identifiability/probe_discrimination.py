"""Whether the charges determine the size or the shape of the probe.

The charges of a contact under one probe are explained by the best contact under another. The remaining difference, in
standard deviations of the noise, is all that distinguishes the two probes; the distance between the true and the
explaining contact is the error of taking one probe for the other. For small changes of a circle's radius, the radius is
a fourth unknown of the Cramer-Rao limit, which needs four charges.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.common.progress import Progress
from isocharge.simulate.forward.charge_model import ChargeModel
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.cramer_rao import cramer_rao
from isocharge.simulate.identifiability.nearest_contact import nearest_contact
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import sunflower
from isocharge.simulate.sensor.probe import Circle

DISTINGUISHABLE_SIGMAS = 3.0
"""Smallest difference of the charges at which one press distinguishes two probes, standard deviations of the noise."""

INSIDE = 1.3
"""Ratio between the ends of the force range and the compared forces, dimensionless: the explaining contact may need
another force."""

RADIUS_STEP = 0.1
"""Step of the derivative by the probe's radius, relative to the radius."""


@dataclass(frozen=True)
class ProbeConfusion:
    """One probe taken for another, at some contacts.

    Attributes:
        contact: True (x, y, F), shape (n, 3), m and N.
        sigmas: Remaining difference of the charges, standard deviations of the noise, shape (n,).
        shift: Distance between the true and the explaining position, shape (n,), m.
        force: Explaining over true force, dimensionless, shape (n,).
    """

    contact: Array
    sigmas: Array
    shift: Array
    force: Array

    def to_dict(self) -> dict[str, float]:
        """For JSON."""
        return {
            "force_N": float(self.contact[0, 2]),
            "told_apart_share": float(np.mean(self.sigmas >= DISTINGUISHABLE_SIGMAS)),
            "sigmas_median": float(np.median(self.sigmas)),
            "sigmas_most": float(self.sigmas.max()),
            "position_error_median_mm": 1e3 * float(np.median(self.shift)),
            "position_error_p95_mm": 1e3 * float(np.percentile(self.shift, 95)),
            "force_error_median_percent": 1e2 * float(np.median(np.abs(self.force - 1.0))),
            "force_error_p95_percent": 1e2 * float(np.percentile(np.abs(self.force - 1.0), 95)),
        }


def explain_with_other_probe(
    true: ChargeModel, taken: ChargeModel, noise: NoiseModel, contact: Array
) -> ProbeConfusion:
    """Explain the charges of contacts (x, y, F), shape (n, 3), under the true probe by contacts under the other."""
    explained, sigmas = nearest_contact(taken, noise, true.charge(contact), contact)
    shift = np.hypot(*(explained - contact)[:, :2].T)
    return ProbeConfusion(contact, sigmas, shift, explained[:, 2] / contact[:, 2])


def size_limit(
    smaller: ChargeModel, middle: ChargeModel, larger: ChargeModel, noise: NoiseModel, contact: Array
) -> Array:
    """Cramer-Rao limit of the radius, with x, y and F unknown too.

    Args:
        smaller: Charges under a circle whose radius is smaller by `RADIUS_STEP`.
        middle: Charges under the circle.
        larger: Charges under a circle whose radius is larger by `RADIUS_STEP`.
        noise: Noise of the readings.
        contact: (x, y, F), shape (n, 3), m and N.

    Returns:
        Standard deviation of the radius over the radius, shape (n,).

    Raises:
        SceneError: If there are fewer than four electrodes.
    """
    charge, jacobian = middle.charge(contact), middle.jacobian(contact)
    if charge.shape[1] < 4:
        raise _too_few(charge.shape[1])
    by_radius = (larger.charge(contact) - smaller.charge(contact)) / (2.0 * RADIUS_STEP)
    return cramer_rao(charge, np.concatenate([jacobian, by_radius[..., None]], axis=2), noise).parameter(3)


def inner_forces(force_range: tuple[float, float]) -> list[float]:
    """Forces at which probes are compared, N: near both ends of the range, and the force nearest to 1 N."""
    low, high = INSIDE * force_range[0], force_range[1] / INSIDE
    return sorted({low, float(np.clip(1.0, low, high)), high}) if low < high else [float(np.sqrt(low * high))]


def spread_contacts(radius: float, force: float, count: int = 1000) -> Array:
    """Contacts (x, y, F) of one force, evenly over a disk: shape (count, 3)."""
    at = radius * sunflower(count)
    return np.stack([at.real, at.imag, np.full(count, force)], axis=1)


@dataclass(frozen=True)
class RadiusLimit:
    """Limits of the estimated radius of a circle under one force.

    Attributes:
        contact: (x, y, F), shape (n, 3), m and N.
        deviation: Standard deviation of the radius over the radius, shape (n,).
    """

    contact: Array
    deviation: Array

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        best = int(np.argmin(self.deviation))
        return {
            "force_N": float(self.contact[0, 2]),
            "radius_std_median_percent": 1e2 * float(np.median(self.deviation)),
            "radius_std_best_percent": 1e2 * float(self.deviation[best]),
            "best_at_mm": (1e3 * self.contact[best, :2]).round(2).tolist(),
            "told_share": float(np.mean(DISTINGUISHABLE_SIGMAS * self.deviation <= 1.0)),
        }


def radius_limits(
    forward_map: ForwardMap,
    charges: ChargeModel,
    noise: NoiseModel,
    forces: Sequence[float],
    reach: float,
    progress: Progress | None = None,
) -> list[RadiusLimit]:
    """Limits of the radius of a circle over contacts in a disk: 10 s, for two more forward maps.

    Args:
        forward_map: Charges under the circle.
        charges: The same charges as a charge model.
        noise: Noise of the readings.
        forces: Forces of the contacts, N.
        reach: Radius of the disk, m.
        progress: Called with the number of solves of a map that are done, and all.

    Raises:
        SceneError: If the probe is not a circle, or there are fewer than four electrodes.
    """
    sensor, probe = forward_map.sensor, forward_map.probe
    if not isinstance(probe, Circle):
        raise SceneError(f"size: expected a circle, whose radius is its size, got {probe.notation}")
    if len(sensor.electrodes) < 4:
        raise _too_few(len(sensor.electrodes))
    smaller, larger = (
        ChargeSpline.of(_of_radius(forward_map, probe.radius * (1.0 + sign * RADIUS_STEP), progress))
        for sign in (-1.0, 1.0)
    )
    contacts = [spread_contacts(reach, force) for force in forces]
    return [RadiusLimit(each, size_limit(smaller, charges, larger, noise, each)) for each in contacts]


def _of_radius(forward_map: ForwardMap, radius: float, progress: Progress | None) -> ForwardMap:
    """Forward map of another radius with the same mesh and theory, so that only the radius differs."""
    settings = forward_map.settings
    return ForwardMap.build(
        forward_map.sensor,
        Circle(radius),
        forward_map.radius,
        forward_map.force_range,
        settings,
        progress=progress,
    )


def _too_few(electrodes: int) -> SceneError:
    return SceneError(f"size: expected at least four charges for x, y, F and the radius, got {electrodes}")
