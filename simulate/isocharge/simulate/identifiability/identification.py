"""How well the charges of a sensor determine a contact: limits over the film, folds and the working area."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SolveError
from isocharge.common.json_values import finite_or_none
from isocharge.common.progress import Progress
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.checks import check_determined
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.folds import scaled_jacobian, singular_values
from isocharge.simulate.identifiability.working_area import ERROR, WorkingArea, working_area
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import Rings
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor

CLEAR = 0.75
"""Largest search radius over the film's radius, dimensionless: presses nearer to the rim take ever longer to solve."""

RETREAT, RETREATS = 0.9, 3
"""Factor on the search radius if the charges cannot be interpolated that far, and the largest number of reductions."""


@dataclass(frozen=True)
class LimitMap:
    """Cramer-Rao limits under one force on rings about the centre.

    Attributes:
        force: Force, N.
        rings: Positions.
        position: Position error, root mean square, shape (n_ring, n_angle), m.
        relative_force: Error of the force over the force, shape (n_ring, n_angle).
        condition: Largest over smallest standard deviation of the position by direction, shape (n_ring, n_angle).
    """

    force: float
    rings: Rings
    position: Array
    relative_force: Array
    condition: Array

    @classmethod
    def of(cls, charges: ChargeSpline, noise: NoiseModel, force: float, rings: Rings) -> "LimitMap":
        """Limits at every position of the rings."""
        contact = rings.contacts(force)
        limits = limits_at(charges, contact, noise)
        largest, smallest = singular_values(scaled_jacobian(charges, contact, noise)).T
        values = (limits.position, limits.force, largest / np.maximum(smallest, 1e-12 * largest))
        return cls(force, rings, *(rings.per_ring(value) for value in values))

    def summary(self) -> dict[str, float]:
        """Errors, each position weighted with its area."""
        area = np.repeat(self.rings.distance, self.position.shape[1])
        position, force = 1e3 * self.position.ravel(), 1e2 * self.relative_force.ravel()
        return {
            "force_N": self.force,
            "position_median_mm": _quantile(position, area, 0.5),
            "position_rms_mm": float(np.sqrt(np.average(position**2, weights=area))),
            "position_worst_mm": float(position.max()),
            "force_median_percent": _quantile(force, area, 0.5),
            "force_rms_percent": float(np.sqrt(np.average(force**2, weights=area))),
            "force_worst_percent": float(force.max()),
            "condition_worst": float(self.condition.max()),
        }


@dataclass(frozen=True)
class Identification:
    """How well the charges determine a contact.

    Attributes:
        sensor: The sensor.
        probe: The footprint.
        noise: Noise of the readings.
        charges: Charges of the sensor as splines.
        area: The working area, with folds and ambiguous pairs.
        maps: Limits under the smallest force, 1 N if that is in the range, and the largest.
        inside: The same within the working area; none where that is a point.
    """

    sensor: Sensor
    probe: Probe
    noise: NoiseModel
    charges: ChargeSpline = field(repr=False)
    area: WorkingArea
    maps: tuple[LimitMap, ...] = field(repr=False)
    inside: tuple[LimitMap, ...] = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        """For JSON; infinite radii are None."""
        area, rings = self.area, self.maps[0].rings
        return {
            "sensor": self.sensor.name,
            "probe": self.probe.notation,
            "noise": self.noise.to_dict(),
            "force_N": list(area.force_range),
            "working_area": {
                "radius_mm": 1e3 * area.radius,
                "why": area.why,
                "fold_radius_mm": finite_or_none(1e3 * area.fold_radius),
                "twin_radius_mm": finite_or_none(1e3 * area.twin_radius),
                "error_radius_mm": 1e3 * area.error_radius,
                "unfolded_radius_mm": 1e3 * area.unfolded,
                "error_mm": 1e3 * area.error,
                "searched_mm": 1e3 * area.searched,
                "words": area.words,
            },
            "limits_in_working_area": [limits.summary() for limits in self.inside],
            "by_distance": {
                "distance_mm": (1e3 * rings.distance).tolist(),
                **{
                    f"{name}_position_mm_at_{limits.force:g}_N": (1e3 * statistic(limits.position, axis=1)).tolist()
                    for limits in self.maps
                    for name, statistic in (("median", np.median), ("worst", np.max))
                },
            },
            "folds_mm": (1e3 * area.folds).round(3).tolist(),
            "twins": _pair_rows(area),
        }


def identify(
    forward_map: ForwardMap, noise: NoiseModel, *, error: float = ERROR, charges: ChargeSpline | None = None
) -> Identification:
    """How well the charges determine contacts within the radius and the forces of a forward map: some 10 s.

    Args:
        forward_map: Charges of the sensor under the probe.
        noise: Noise of the readings, with white noise above zero.
        error: Largest Cramer-Rao position error allowed in the working area, m.
        charges: The forward map as splines; tabulated if absent.

    Raises:
        SceneError: If there are fewer than three electrodes.
    """
    check_determined(len(forward_map.electrode_names))
    charges = charges or ChargeSpline.of(forward_map)
    low, high = forward_map.force_range
    forces = sorted({low, min(max(low, 1.0), high), high})
    area = working_area(charges, noise, error=error)
    maps, inside = (
        tuple(LimitMap.of(charges, noise, force, Rings.spread(radius)) for force in forces if radius > 0.0)
        for radius in (charges.radius, area.radius)
    )
    return Identification(forward_map.sensor, forward_map.probe, noise, charges, area, maps, inside)


def search_radius(sensor: Sensor, probe: Probe) -> float:
    """Radius of the search for the working area, m: to the outermost corner of an electrode.

    Electrodes that surround the working area bound it, mostly by a fold that runs through them.
    """
    corners = np.concatenate([sensor.calibration.place(np.array(e.corners)) for e in sensor.electrodes])
    return min(float(np.hypot(*corners.T).max()), CLEAR * sensor.film.radius - probe.reach)


def map_to_search(
    sensor: Sensor, probe: Probe, force_range: tuple[float, float], progress: Progress | None = None
) -> ForwardMap:
    """A forward map over the search radius, or a smaller one if the charges cannot be interpolated so far out.

    Raises:
        SceneError: If some presses cannot exist.
        SolveError: If an equilibrium or the target of the interpolation error was not reached.
    """
    radius = search_radius(sensor, probe)
    for _ in range(RETREATS):
        try:
            return ForwardMap.build(sensor, probe, radius, force_range, progress=progress)
        except SolveError:
            radius *= RETREAT
    return ForwardMap.build(sensor, probe, radius, force_range, progress=progress)


def _quantile(values: Array, weights: Array, share: float) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, share * total[-1])])


def _pair_rows(area: WorkingArea, most: int = 20) -> list[dict[str, Any]]:
    def contact(row: Array) -> dict[str, float]:
        return {"x_mm": 1e3 * float(row[0]), "y_mm": 1e3 * float(row[1]), "force_N": float(row[2])}

    rows = zip(area.twins.first[:most], area.twins.second[:most], area.twins.distance[:most], strict=True)
    return [{"first": contact(a), "second": contact(b), "sigmas_apart": float(d)} for a, b, d in rows]
