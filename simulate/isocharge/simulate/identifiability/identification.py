"""How well the charges of a sensor determine a contact: limits over the film, folds and the working area."""

from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.errors import SceneError, SolveError
from isocharge.common.json_values import finite_or_none
from isocharge.simulate.forward.charge_map import ChargeMap, check_determined
from isocharge.simulate.forward.charge_spline import with_fast_derivatives
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.folds import scaled_derivatives, singular_values
from isocharge.simulate.identifiability.working_area import (
    ERROR,
    Bound,
    WorkingArea,
    working_area,
)
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.simulate.numerics.disk import Rings
from isocharge.simulate.sensor.probe import Circle, Probe
from isocharge.simulate.sensor.sensor import Sensor

CLEAR = 0.75
"""Largest search radius over the film's radius, dimensionless: presses nearer to the rim take ever longer to solve."""

RETREAT, RETREATS = 0.9, 3
"""Factor on the search radius if the charges cannot be interpolated that far, and the largest number of reductions."""

USUAL_PROBE = Circle(1.0)
"""Probe of the released models, mm."""

MOST_PAIRS = 20
"""Most ambiguous pairs that the numbers for JSON list."""

CONTACT = ("x_mm", "y_mm", "force_N")
"""Keys of a contact in JSON."""

IN_JSON: dict[Bound, str] = {"fold": "fold", "ambiguous pair": "twins", "error": "error", "search": "searched"}
"""Names of the bounds in files and JSON."""


@dataclass(frozen=True)
class LimitMap:
    """Cramer-Rao limits under one force on rings about the centre.

    Attributes:
        force: Force, N.
        rings: Positions.
        position: Position error, root mean square, shape (n_ring, n_angle), mm.
        relative_force: Error of the force over the force, shape (n_ring, n_angle).
        condition: Largest over smallest standard deviation of the position by direction, shape (n_ring, n_angle).
    """

    force: float
    rings: Rings
    position: Array
    relative_force: Array
    condition: Array

    @classmethod
    def of(cls, charge_map: ChargeMap, noise: NoiseModel, force: float, rings: Rings) -> "LimitMap":
        """Limits at every position of the rings."""
        contact = rings.contacts(force)
        limits = limits_at(charge_map, contact, noise)
        largest, smallest = singular_values(scaled_derivatives(charge_map, contact, noise)).T
        values = (limits.position, limits.force, largest / np.maximum(smallest, 1e-12 * largest))
        return cls(force, rings, *(rings.per_ring(value) for value in values))

    def statistics(self) -> dict[str, float]:
        """Errors, each position weighted with its area."""
        area = np.repeat(self.rings.distance, self.position.shape[1])
        position, force = self.position.ravel(), 100.0 * self.relative_force.ravel()
        return {
            "force_N": self.force,
            "position_median_mm": _median(position, area),
            "position_rms_mm": float(np.sqrt(np.average(position**2, weights=area))),
            "position_worst_mm": float(position.max()),
            "force_median_percent": _median(force, area),
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
        charges: Charges of the sensor, with fast derivatives.
        area: The working area, with folds and ambiguous pairs.
        maps: Limits under the smallest force, 1 N if that is in the range, and the largest.
        inside: The same within the working area; none where that is a point.
    """

    sensor: Sensor
    probe: Probe
    noise: NoiseModel
    charges: ChargeMap = field(repr=False)
    area: WorkingArea
    maps: tuple[LimitMap, ...] = field(repr=False)
    inside: tuple[LimitMap, ...] = field(repr=False)

    @classmethod
    def of(cls, forward_map: ForwardMap, noise: NoiseModel, *, error: float = ERROR) -> "Identification":
        """See `identify`; within the radius and the forces of a forward map that is already solved."""
        check_determined(len(forward_map.electrodes))
        charges = with_fast_derivatives(forward_map)
        low, high = charges.domain.force_range
        forces = sorted({low, min(max(low, 1.0), high), high})
        area = working_area(charges, noise, error=error)
        maps, inside = (
            tuple(LimitMap.of(charges, noise, force, Rings.spread(radius)) for force in forces if radius > 0.0)
            for radius in (charges.domain.radius, area.radius)
        )
        return cls(forward_map.sensor, forward_map.probe, noise, charges, area, maps, inside)

    @property
    def determined_share(self) -> float:
        """Share of the searched disk in which the error is at most the allowed one at every force, dimensionless.

        That is on either side of the folds: where contacts are determined once it is known which of those with the same
        charges it is, as from the frames before.
        """
        good = np.all([limits.position <= self.area.error for limits in self.maps], axis=0)
        return float(np.average(good.mean(axis=1), weights=self.maps[0].rings.distance))

    @property
    def summary(self) -> str:
        """The working area in a few sentences."""
        area = self.area
        if not (len(area.folds) or len(area.pairs)):
            return area.summary
        return (
            f"{area.summary} If the frames before tell which of the contacts with the same charges it is, the position "
            f"error is at most {area.error:.3g} mm on {100.0 * self.determined_share:.0f} % of the "
            f"{area.searched:.3g} mm searched, of which the working area is "
            f"{100.0 * (area.radius / area.searched) ** 2:.0f} %."
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON; infinite radii are None."""
        area = self.area
        pairs = (area.pairs.first, area.pairs.second, area.pairs.distance)
        return {
            "sensor": self.sensor.name,
            "probe": self.probe.notation,
            "noise": self.noise.to_dict(),
            "force_N": list(area.force_range),
            "working_area": {
                "radius_mm": area.radius,
                "why": IN_JSON[area.bound],
                "fold_radius_mm": finite_or_none(area.fold_radius),
                "twin_radius_mm": finite_or_none(area.pairs.radius),
                "error_radius_mm": area.error_radius,
                "unfolded_radius_mm": area.unambiguous_radius,
                "error_mm": area.error,
                "searched_mm": area.searched,
                "determined_share": self.determined_share,
                "words": self.summary,
            },
            "limits_in_working_area": [limits.statistics() for limits in self.inside],
            "by_distance": {
                "distance_mm": self.maps[0].rings.distance.tolist(),
                **{
                    f"{name}_position_mm_at_{limits.force:g}_N": statistic(limits.position, axis=1).tolist()
                    for limits in self.maps
                    for name, statistic in (("median", np.median), ("worst", np.max))
                },
            },
            "folds_mm": area.folds.round(3).tolist(),
            "twins": [
                {
                    "first": dict(zip(CONTACT, first.tolist(), strict=True)),
                    "second": dict(zip(CONTACT, second.tolist(), strict=True)),
                    "sigmas_apart": float(distance),
                }
                for first, second, distance in zip(*(column[:MOST_PAIRS] for column in pairs), strict=True)
            ],
        }


def identify(
    sensor: Sensor,
    probe: Probe = USUAL_PROBE,
    noise: NoiseModel | None = None,
    *,
    force_range: tuple[float, float] = DEFAULT_FORCE_RANGE,
    radius: float | None = None,
    error: float = ERROR,
    executor: Executor | None = None,
) -> Identification:
    """How well the charges of a sensor determine contacts: some 20 s.

    Args:
        sensor: The sensor.
        probe: The object that presses.
        noise: Noise of the readings, with white noise above zero; `reference` if absent.
        force_range: Smallest and largest force, N.
        radius: Distance from the centre up to which contacts are searched, mm; to the electrodes' far corners if
            absent.
        error: Largest Cramer-Rao position error allowed in the working area, mm.
        executor: Runs the solves; this process if absent.

    Raises:
        SceneError: If there are fewer than three electrodes, no noise, or some presses cannot exist.
        SolveError: If an equilibrium or the target of the interpolation error was not reached.
    """
    check_determined(len(sensor.electrodes))
    noise = noise or noise_model("reference")
    if noise.white <= 0.0:
        raise SceneError(
            f"noise: expected white noise above 0 pC, got that of {noise.name!r}: without noise the errors have no "
            "lower limit"
        )
    forward_map = (
        map_to_search(sensor, probe, force_range, executor)
        if radius is None
        else ForwardMap.build(sensor, probe, radius, force_range, executor=executor)
    )
    return Identification.of(forward_map, noise, error=error)


def search_radius(sensor: Sensor, probe: Probe) -> float:
    """Radius of the search for the working area, mm: to the outermost corner of an electrode.

    Electrodes that surround the working area bound it, mostly by a fold that runs through them.
    """
    corners = np.concatenate([sensor.calibration.place(np.array(e.corners)) for e in sensor.electrodes])
    return min(float(np.hypot(*corners.T).max()), CLEAR * sensor.film.radius - probe.reach)


def map_to_search(
    sensor: Sensor, probe: Probe, force_range: tuple[float, float], executor: Executor | None = None
) -> ForwardMap:
    """A forward map over the search radius, or a smaller one if the charges cannot be interpolated so far out.

    Raises:
        SceneError: If some presses cannot exist.
        SolveError: If an equilibrium or the target of the interpolation error was not reached.
    """
    radius = search_radius(sensor, probe)
    for _ in range(RETREATS):
        try:
            return ForwardMap.build(sensor, probe, radius, force_range, executor=executor)
        except SolveError:
            radius *= RETREAT
    return ForwardMap.build(sensor, probe, radius, force_range, executor=executor)


def _median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
