"""Identification of a sensor: error limits, folds and working area, which state how well charges determine contacts."""

from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
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
from isocharge.simulate.identifiability.mirror_region import MirrorRegion, mirror_region
from isocharge.simulate.identifiability.side_force_limits import (
    MAX_SIDE_FORCE_ERROR,
    SideForceLimits,
    side_force_limits,
)
from isocharge.simulate.identifiability.working_area import (
    DEFAULT_ERROR,
    Bound,
    WorkingArea,
    working_area,
)
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.simulate.numerics.disk import Rings
from isocharge.simulate.sensor.probe import Circle, Probe
from isocharge.simulate.sensor.sensor import Sensor

MAX_SEARCH_RADIUS = 0.9
"""Largest search radius in units of the film radius, dimensionless.

Forward maps with larger radii need finer meshes.
"""

RADIUS_REDUCTION = 0.9
"""Factor by which the search radius is reduced if the charges cannot be interpolated, dimensionless."""

MAX_REDUCTIONS = 3
"""Largest number of reductions of the search radius."""

DEFAULT_PROBE = Circle(1.0)
"""Probe of the released models, mm."""

MAX_LISTED_PAIRS = 20
"""Largest number of ambiguous pairs that the JSON output lists."""

CONTACT_KEYS = ("x_mm", "y_mm", "force_N")
"""Keys of a contact in JSON."""

BOUND_NAMES: dict[Bound, str] = {"fold": "fold", "ambiguous pair": "twins", "error": "error", "search": "searched"}
"""Names of the bounds of a working area in JSON."""


@dataclass(frozen=True)
class LimitMap:
    """Cramer-Rao limits for one force on rings about the centre.

    Attributes:
        force: Force, N.
        rings: Positions at which the limits are evaluated.
        position: Position error (root mean square), shape (n_ring, n_angle), mm.
        relative_force: Standard deviation of the force divided by the force, shape (n_ring, n_angle), dimensionless.
        condition: Ratio of the largest to the smallest standard deviation of the position by direction, shape (n_ring,
            n_angle), dimensionless.
    """

    force: float
    rings: Rings
    position: Array
    relative_force: Array
    condition: Array

    @classmethod
    def of(cls, charge_map: ChargeMap, noise: NoiseModel, force: float, rings: Rings) -> "LimitMap":
        """Compute the limits at every position of the rings.

        Args:
            charge_map: Charges as a function of the contact.
            noise: Noise of the readings.
            force: Force of the contacts, N.
            rings: Positions of the contacts.
        """
        contact = rings.contacts(force)
        limits = limits_at(charge_map, contact, noise)

        # The singular values are the inverse standard deviations in the best and in the worst direction.
        largest, smallest = singular_values(scaled_derivatives(charge_map, contact, noise)).T
        condition = largest / np.maximum(smallest, 1e-12 * largest)  # at most 1e12, at a fold
        return cls(
            force,
            rings,
            position=rings.per_ring(limits.position),
            relative_force=rings.per_ring(limits.force),
            condition=rings.per_ring(condition),
        )

    def statistics(self) -> dict[str, float]:
        """Compute statistics of the errors. The weight of a position is the area that it represents."""
        # A position represents a part of its ring, whose area is proportional to the distance from the centre.
        n_angle = self.position.shape[1]
        area = np.repeat(self.rings.distance, n_angle)
        position = self.position.ravel()
        force = 100.0 * self.relative_force.ravel()
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
    """Result of `identify`.

    Attributes:
        sensor: Sensor.
        probe: Probe.
        noise: Noise of the readings.
        charges: Charge map of the sensor with fast derivatives.
        area: Working area with folds and ambiguous pairs.
        maps: Limits for the smallest force, for 1 N if it is in the range of forces, and for the largest force.
        inner_maps: Limits for the same forces within the working area; empty if the working area has the radius 0.
        side_force: Limits for the same forces if the side force of the probe is unknown; empty with fewer than six
            electrodes.
        mirror: Positions outside the working area where a press has the charges of a press inside the working area.
            None if the positions were not computed, or if there is no working area.
    """

    sensor: Sensor
    probe: Probe
    noise: NoiseModel
    charges: ChargeMap = field(repr=False)
    area: WorkingArea
    maps: tuple[LimitMap, ...] = field(repr=False)
    inner_maps: tuple[LimitMap, ...] = field(repr=False)
    side_force: tuple[SideForceLimits, ...] = field(repr=False, default=())
    mirror: MirrorRegion | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls,
        forward_map: ForwardMap,
        noise: NoiseModel,
        *,
        error: float = DEFAULT_ERROR,
        executor: Executor | None = None,
    ) -> "Identification":
        """Identify the sensor of a forward map within the radius and the forces of the map.

        Args:
            forward_map: Solved forward map.
            noise: Noise of the readings. The white noise must be positive.
            error: Largest Cramer-Rao position error allowed in the working area, mm.
            executor: Executor that runs the solves of the side forces; this process if absent.
        """
        check_determined(len(forward_map.electrodes))
        charges = with_fast_derivatives(forward_map)

        # Limits are computed for the smallest and the largest force, and for 1 N if it is between them.
        min_force, max_force = charges.domain.force_range
        middle_force = min(max(min_force, 1.0), max_force)
        forces = sorted({min_force, middle_force, max_force})

        # Limits up to the search radius, and within the working area
        area = working_area(charges, noise, error=error)
        maps = _limit_maps(charges, noise, forces, charges.domain.radius)
        inner_maps = _limit_maps(charges, noise, forces, area.radius)
        side_force = side_force_limits(forward_map, charges, noise, forces, area.radius, executor)
        return cls(forward_map.sensor, forward_map.probe, noise, charges, area, maps, inner_maps, side_force)

    @property
    def determined_share(self) -> float:
        """Share of the searched disk in which the error does not exceed its limit for any force, dimensionless.

        The disk includes the regions on both sides of folds. In these regions, different contacts may have the same
        charges. Other information, such as preceding frames, is then necessary to distinguish these contacts.
        """
        is_allowed = np.all([limits.position <= self.area.error for limits in self.maps], axis=0)
        return float(np.average(is_allowed.mean(axis=1), weights=self.maps[0].rings.distance))

    @property
    def summary(self) -> str:
        """Description of the working area. With six electrodes or more, the side force is described as well."""
        if not self.side_force:
            return self._area_summary
        return f"{self._area_summary} {self._side_force_summary}"

    @property
    def _area_summary(self) -> str:
        """Description of the working area."""
        area = self.area
        if not (len(area.folds) or len(area.pairs)):
            return area.summary
        return (
            f"{area.summary} If preceding frames distinguish contacts with the same charges, the position error is at "
            f"most {area.error:.3g} mm on {100.0 * self.determined_share:.0f} % of the disk of {area.searched:.3g} mm "
            f"that was searched. The working area is {100.0 * (area.radius / area.searched) ** 2:.0f} % of this disk."
        )

    @property
    def _side_force_summary(self) -> str:
        """Sentence that lists the forces at which the side force can be estimated, with its error at each force."""
        estimable = [limits for limits in self.side_force if limits.is_estimable]
        if not estimable:
            return (
                f"The side force of the probe cannot be estimated to {100.0 * MAX_SIDE_FORCE_ERROR:g} % of the force "
                "at any of these forces."
            )
        errors = []
        for limits in estimable:
            median_percent = limits.statistics()["side_force_median_percent"]
            errors.append(f"to {median_percent:.2g} % of the force at {limits.force:g} N")
        return f"The side force of the probe can be estimated {', '.join(errors)} (median)."

    def to_dict(self) -> dict[str, Any]:
        """Return the results as values for JSON. An infinite radius becomes None."""
        area = self.area
        return {
            "sensor": self.sensor.name,
            "probe": self.probe.notation,
            "noise": self.noise.to_dict(),
            "force_N": list(area.force_range),
            "working_area": {
                "radius_mm": area.radius,
                "why": BOUND_NAMES[area.bound],
                "fold_radius_mm": finite_or_none(area.fold_radius),
                "twin_radius_mm": finite_or_none(area.pairs.radius),
                "error_radius_mm": area.error_radius,
                "unfolded_radius_mm": area.unambiguous_radius,
                "error_mm": area.error,
                "searched_mm": area.searched,
                "determined_share": self.determined_share,
                "words": self.summary,
            },
            "mirror_region": None if self.mirror is None else self.mirror.to_dict(),
            "limits_in_working_area": [limits.statistics() for limits in self.inner_maps],
            "limits_with_side_force": [limits.statistics() for limits in self.side_force],
            "by_distance": self._errors_by_distance(),
            "folds_mm": area.folds.round(3).tolist(),
            "twins": self._listed_pairs(),
        }

    def _errors_by_distance(self) -> dict[str, list[float]]:
        """Return the median and the largest position error on each ring for each force, for JSON."""
        errors = {"distance_mm": self.maps[0].rings.distance.tolist()}
        for limits in self.maps:
            errors[f"median_position_mm_at_{limits.force:g}_N"] = np.median(limits.position, axis=1).tolist()
            errors[f"worst_position_mm_at_{limits.force:g}_N"] = np.max(limits.position, axis=1).tolist()
        return errors

    def _listed_pairs(self) -> list[dict[str, Any]]:
        """Return the first `MAX_LISTED_PAIRS` ambiguous pairs for JSON."""
        pairs = self.area.pairs
        return [
            {
                "first": dict(zip(CONTACT_KEYS, pairs.first[number].tolist(), strict=True)),
                "second": dict(zip(CONTACT_KEYS, pairs.second[number].tolist(), strict=True)),
                "sigmas_apart": float(pairs.distance[number]),
            }
            for number in range(min(len(pairs), MAX_LISTED_PAIRS))
        ]


def identify(
    sensor: Sensor,
    probe: Probe = DEFAULT_PROBE,
    noise: NoiseModel | None = None,
    *,
    force_range: tuple[float, float] = DEFAULT_FORCE_RANGE,
    radius: float | None = None,
    error: float = DEFAULT_ERROR,
    executor: Executor | None = None,
) -> Identification:
    """Compute how well the charges of a sensor determine contacts.

    The function solves a forward map, and finds the working area and the error limits within this area. It then finds
    the presses outside the working area that cannot be noticed (the mirror region).

    Args:
        sensor: Sensor.
        probe: Probe that presses the film.
        noise: Noise of the readings, whose white noise must be positive; the level `reference` if absent.
        force_range: Smallest and largest force, N.
        radius: Distance from the centre up to which contacts are searched, mm; the distance of the outermost corner of
            an electrode if absent.
        error: Largest Cramer-Rao position error allowed in the working area, mm.
        executor: Executor that runs the solves; this process if absent.

    Raises:
        SceneError: If there are fewer than three electrodes, if there is no white noise, or if the film cannot be
            pressed as required.
        SolveError: If an equilibrium or the allowed interpolation error is not reached.
    """
    check_determined(len(sensor.electrodes))
    noise = noise or noise_model("reference")
    if noise.white <= 0.0:
        raise SceneError(
            f"noise: expected white noise above 0 pC, got that of {noise.name!r}: without noise the errors have no "
            "lower limit"
        )
    if radius is None:
        forward_map = map_to_search(sensor, probe, force_range, executor)
    else:
        forward_map = ForwardMap.build(sensor, probe, radius, force_range, executor=executor)

    identification = Identification.of(forward_map, noise, error=error, executor=executor)
    area_radius = identification.area.radius
    mirror = mirror_region(sensor, probe, identification.charges, area_radius, noise, executor=executor)
    return replace(identification, mirror=mirror)


def search_radius(sensor: Sensor, probe: Probe) -> float:
    """Return the radius of the search for the working area, mm.

    The radius is the distance of the outermost corner of an electrode from the centre. It is limited by
    `MAX_SEARCH_RADIUS`. The working area is mostly bounded by a fold near the electrodes that surround it.
    """
    corners = [sensor.calibration.place(np.array(electrode.corners)) for electrode in sensor.electrodes]
    outermost = float(np.hypot(*np.concatenate(corners).T).max())
    return min(outermost, MAX_SEARCH_RADIUS * sensor.film.radius - probe.reach)


def map_to_search(
    sensor: Sensor, probe: Probe, force_range: tuple[float, float], executor: Executor | None = None
) -> ForwardMap:
    """Solve a forward map over the search radius. If the charges cannot be interpolated there, use a smaller radius.

    The radius is multiplied by `RADIUS_REDUCTION` at most `MAX_REDUCTIONS` times. After that, an error is raised.

    Args:
        sensor: Sensor.
        probe: Probe of the presses.
        force_range: Smallest and largest force, N.
        executor: Executor that runs the solves; this process if absent.

    Returns:
        The forward map, whose domain has the radius that was reached.

    Raises:
        SceneError: If the film cannot be pressed as required.
        SolveError: If an equilibrium or the allowed interpolation error is not reached.
    """
    radius = search_radius(sensor, probe)
    for _ in range(MAX_REDUCTIONS):
        try:
            return ForwardMap.build(sensor, probe, radius, force_range, executor=executor)
        except SolveError:
            radius *= RADIUS_REDUCTION
    # The last radius is outside the loop, because its error is not caught.
    return ForwardMap.build(sensor, probe, radius, force_range, executor=executor)


def _limit_maps(charges: ChargeMap, noise: NoiseModel, forces: list[float], radius: float) -> tuple[LimitMap, ...]:
    """Compute a map of the error limits for each force.

    Args:
        charges: Charges as a function of the contact.
        noise: Noise of the readings.
        forces: Forces, N.
        radius: Largest distance of a position from the centre, mm.

    Returns:
        A map of the limits for each force. There are no maps if the radius is 0.
    """
    if radius <= 0.0:
        return ()
    rings = Rings.spread(radius)
    return tuple(LimitMap.of(charges, noise, force, rings) for force in forces)


def _median(values: Array, weights: Array) -> float:
    """Compute the weighted median of values; both arguments have the shape (n,)."""
    order = np.argsort(values)
    cumulative_weight = np.cumsum(weights[order])
    middle = np.searchsorted(cumulative_weight, 0.5 * cumulative_weight[-1])
    return float(values[order][middle])
