"""Whether the charges tell what presses: its size, or its shape.

The charges of a contact under one probe are explained as well as they can be by a contact under another. What remains,
in standard deviations of the noise, is all that tells the two apart; how far the explaining contact lies from the true
one is the error of taking the one for the other. For the radius of a circle the same is asked of small changes: it
is a fourth unknown of the Cramer-Rao limit. Three charges have nothing left for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import SceneError
from isocharge.progress import Progress
from isocharge.simulate.forward.charge_model import ChargeModel
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.ambiguities import nearest_contact
from isocharge.simulate.identifiability.cramer_rao import cramer_rao
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import sunflower
from isocharge.simulate.sensor.probe import Circle

DISTINGUISHABLE_SIGMAS = 3.0
"""Standard deviations by which charges must differ to tell two probes apart from one press."""

INSIDE = 1.3
"""Factor by which forces keep off the ends of the range: the explaining contact's may differ."""

RADIUS_STEP = 0.1
"""Relative step in the probe's radius of its derivative."""


@dataclass(frozen=True)
class ProbeConfusion:
    """One probe taken for another, at some contacts.

    Attributes:
        contact: True (x, y, F), shape (n, 3), m and N.
        sigmas: By how many standard deviations of the noise the charges still differ, shape (n,).
        shift: Distance between the true and the explaining position, shape (n,), m.
        force: Explaining over true force, shape (n,).
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
        larger: Under one that is larger by `RADIUS_STEP`.
        noise: Of the readings.
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
    """Forces to compare probes under: near both ends of the range, and 1 N or what is nearest to it, N."""
    low, high = INSIDE * force_range[0], force_range[1] / INSIDE
    return sorted({low, float(np.clip(1.0, low, high)), high}) if low < high else [float(np.sqrt(low * high))]


def spread_contacts(radius: float, force: float, count: int = 1000) -> Array:
    """Contacts (x, y, F) of one force, evenly over a disk: shape (count, 3)."""
    at = radius * sunflower(count)
    return np.stack([at.real, at.imag, np.full(count, force)], axis=1)


@dataclass(frozen=True)
class RadiusLimit:
    """How well the charges tell a circle's radius under one force.

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
    """How well the charges tell the radius of a circle within a disk: 10 s, for two more forward maps.

    Args:
        forward_map: Of the circle.
        charges: The same as a charge model.
        noise: Of the readings.
        forces: N.
        reach: Radius of the disk, m.
        progress: Told how many solves of a map are done.

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
    """On the same mesh and with the same theory, so that what differs is the radius alone."""
    made = forward_map
    return ForwardMap.build(
        made.sensor,
        Circle(radius),
        made.radius,
        made.force_range,
        made.settings,
        progress=progress,
    )


def _too_few(electrodes: int) -> SceneError:
    return SceneError(f"size: expected at least four charges for x, y, F and the radius, got {electrodes}")
