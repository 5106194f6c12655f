"""Analysis of how well the charges of a sensor determine contacts: error limits, folds and working area."""

from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.errors import SceneError, SolveError
from isocharge.common.structs import plain_values
from isocharge.simulate.forward.charge_map import ChargeMap, check_electrode_count
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.mirror_region import MirrorRegion, mirror_region
from isocharge.simulate.identifiability.working_area import DEFAULT_ERROR, WorkingArea, working_area
from isocharge.simulate.measuring_chain import noise_model
from isocharge.simulate.noise import NoiseModel
from isocharge.simulate.numerics.disk import Rings
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Sensor, outermost_corner

MAX_SEARCH_RADIUS = 0.9
"""Largest search radius in units of `Film.inner_radius`, dimensionless.

A forward map with a larger radius needs a finer mesh.
"""

RADIUS_REDUCTION = 0.9
"""Factor by which the search radius is multiplied if the charges cannot be interpolated accurately, dimensionless."""

MAX_REDUCTIONS = 3
"""Largest number of reductions of the search radius."""

DEFAULT_PROBE = Circle(1.0)
"""Probe of the released models, which has a radius of 1 mm."""

MAX_LISTED_PAIRS = 20
"""Largest number of ambiguous pairs that the JSON output lists."""

CONTACT_KEYS = ("x_mm", "y_mm", "force_N")
"""Keys of the position and the force of a contact in JSON."""


@dataclass(frozen=True)
class LimitMap:
    """Cramer-Rao limits of contacts that lie on rings around the centre of the film and have the same force.

    Attributes:
        force: Force of all contacts, N.
        rings: Positions of the contacts, with equal distances between the rings (`Rings.spread`).
        position: Smallest root mean square error of the position, shape (n_ring, n_angle), mm.
        relative_force: Smallest standard deviation of the force divided by the force, shape (n_ring, n_angle),
            dimensionless.
    """

    force: float
    rings: Rings
    position: Array
    relative_force: Array

    @classmethod
    def of(cls, charge_map: ChargeMap, noise: NoiseModel, force: float, rings: Rings) -> "LimitMap":
        """Compute the Cramer-Rao limits at every position of the rings.

        Args:
            charge_map: Map that computes the charges of contacts.
            noise: Noise of the readings.
            force: Force of the contacts, N.
            rings: Positions of the contacts.
        """
        limits = limits_at(charge_map, rings.contacts(force), noise)
        return cls(force, rings, rings.per_ring(limits.position), rings.per_ring(limits.force))

    def statistics(self) -> dict[str, float]:
        """Return a dictionary for JSON with the median, the root mean square and the maximum of the error limits.

        The attributes `position` (mm) and `relative_force` contain the error limits of contacts on rings. Each limit is
        weighted by the area that its contact represents. Errors of the force are in percent of the force.
        """
        # Each position represents a part of a strip around its ring. All strips have the same width, so the area of a
        # strip is proportional to the radius of its ring, and thus to the number 1, 2, ..., n_ring of the ring. Only
        # half of the outermost strip lies inside the disk. Twice these areas are the integers 2, 4, ..., 2 (n_ring - 1)
        # and n_ring. The median needs integers, because it repeats each error as often as its weight.
        n_ring, n_angle = self.position.shape
        ring_weight = np.append(2 * np.arange(1, n_ring), n_ring)
        weight = np.repeat(ring_weight, n_angle)  # of each position, shape (n_ring * n_angle,)
        statistics = {"force_N": self.force}
        for quantity, unit, errors in (
            ("position", "mm", self.position.ravel()),
            ("force", "percent", 100.0 * self.relative_force.ravel()),
        ):
            median = np.quantile(np.repeat(errors, weight), 0.5, method="inverted_cdf")
            root_mean_square = np.sqrt(np.average(errors**2, weights=weight))
            statistics[f"{quantity}_median_{unit}"] = float(median)
            statistics[f"{quantity}_rms_{unit}"] = float(root_mean_square)
            statistics[f"{quantity}_worst_{unit}"] = float(errors.max())
        return statistics


@dataclass(frozen=True)
class Identification:
    """Result of `identify`: a description of how well the charges of a sensor determine contacts.

    Attributes:
        sensor: Sensor that was analysed.
        probe: Probe that presses the film.
        noise: Noise of the readings.
        charges: Charge map of the sensor with fast derivatives.
        area: Working area with folds and ambiguous pairs.
        maps: Error limits on the searched disk for the smallest force, for 1 N if 1 N is in the range of forces, and
            for the largest force.
        inner_maps: Error limits within the working area for the same forces; empty if the working area has the
            radius 0.
        mirror: Share of the presses outside the working area that have the charges of a press inside the working area;
            None if the share was not computed; see `mirror_region`.
    """

    sensor: Sensor
    probe: Probe
    noise: NoiseModel
    charges: ChargeMap = field(repr=False)
    area: WorkingArea
    maps: tuple[LimitMap, ...] = field(repr=False)
    inner_maps: tuple[LimitMap, ...] = field(repr=False)
    mirror: MirrorRegion | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls,
        forward_map: ForwardMap,
        noise: NoiseModel,
        *,
        error: float = DEFAULT_ERROR,
    ) -> "Identification":
        """Compute how well the charges of a sensor determine the contacts in the domain of a forward map.

        The mirror region is not computed. The error limits are computed both on the whole disk of the forward map and
        within the working area.

        Args:
            forward_map: Forward map of the sensor.
            noise: Noise of the readings. The white noise must be positive.
            error: Largest Cramer-Rao position error that is allowed in the working area, mm.
        """
        charges = ChargeSpline.of(forward_map)

        # The limits are computed for the smallest and the largest force, and for 1 N if 1 N lies between both. If it
        # does not, the middle force equals one of the other forces, which the set contains only once.
        min_force, max_force = charges.domain.force_range
        middle_force = min(max(min_force, 1.0), max_force)
        forces = sorted({min_force, middle_force, max_force})

        def limit_maps(radius: float) -> tuple[LimitMap, ...]:
            """Compute the limits on a disk for each force."""
            return tuple(LimitMap.of(charges, noise, force, Rings.spread(radius)) for force in forces)

        area = working_area(charges, noise, error=error)
        maps = limit_maps(charges.domain.radius)
        inner_maps = limit_maps(area.radius) if area.radius > 0.0 else ()
        return cls(forward_map.sensor, forward_map.probe, noise, charges, area, maps, inner_maps)

    def to_dict(self) -> dict[str, Any]:
        """Return the results as a dictionary for JSON, in which an infinite radius is None."""
        area = self.area
        table = {
            "sensor": self.sensor.name,
            "probe": self.probe.rotated_notation,
            "noise": self.noise.to_dict(),
            "force_N": area.force_range,
            "working_area": {
                "radius_mm": area.radius,
                "why": area.bound,
                "fold_radius_mm": area.fold_radius,
                "twin_radius_mm": area.pairs.radius,
                "error_radius_mm": area.error_radius,
                "unfolded_radius_mm": area.unambiguous_radius,
                "error_mm": area.error,
                "searched_mm": area.search_radius,
                "words": area.summary,
            },
            "mirror_region": None if self.mirror is None else self.mirror.to_dict(),
            "limits_in_working_area": [limits.statistics() for limits in self.inner_maps],
            "folds_mm": area.folds.round(3),
            "twins": self._listed_pairs(),
        }
        return dict(plain_values(table))

    def _listed_pairs(self) -> list[dict[str, Any]]:
        """Return the first `MAX_LISTED_PAIRS` ambiguous pairs as dictionaries for JSON."""
        pairs = self.area.pairs
        pair_values = zip(pairs.first, pairs.second, pairs.charge_difference, strict=True)
        return [
            {
                "first": dict(zip(CONTACT_KEYS, first, strict=True)),
                "second": dict(zip(CONTACT_KEYS, second, strict=True)),
                "sigmas_apart": charge_difference,
            }
            for first, second, charge_difference in islice(pair_values, MAX_LISTED_PAIRS)
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

    The function builds a forward map, and computes the working area and the error limits. The function also computes
    the mirror region, which contains the presses outside the working area that have the same charges as a press inside
    the working area.

    Args:
        sensor: Sensor to be analysed.
        probe: Probe that presses the film.
        noise: Noise of the readings, with positive white noise. If None, the noise level is `reference`.
        force_range: Smallest and largest force, N.
        radius: Distance from the centre up to which contacts are analysed, mm. If None, `map_to_search` chooses the
            distance of the outermost corner of an electrode, or a smaller distance if the map cannot reach it.
        error: Largest Cramer-Rao position error that is allowed in the working area, mm.
        executor: Executor that runs the solves; None to run the solves in this process.

    Raises:
        SceneError: If there are fewer than three electrodes, if the forces are equal, if there is no white noise, or if
            a press in the domain cannot exist.
        SolveError: If a press has no equilibrium, or the interpolation error of the forward map is too large.
    """
    noise = noise or noise_model("reference")
    noise.check_white()
    forward_map = map_to_search(sensor, probe, force_range, radius, executor=executor)
    identification = Identification.of(forward_map, noise, error=error)
    area_radius = identification.area.radius
    mirror = mirror_region(sensor, probe, identification.charges, area_radius, noise, executor=executor)
    return replace(identification, mirror=mirror)


def search_radius(sensor: Sensor, probe: Probe) -> float:
    """Return the radius of the disk that the search for the working area covers, mm.

    In most cases, a fold near the outer electrodes bounds the working area. The radius of the disk is therefore the
    distance of the outermost corner of an electrode from the centre. If the outermost corner is near the clamp, the
    radius is smaller, because the probe must not reach the clamp.

    Args:
        sensor: Sensor with the electrodes.
        probe: Probe that presses the film.

    Raises:
        SceneError: If the probe is so large that it cannot move on the film.
    """
    # Every point of the probe must lie within this distance from the centre.
    largest_distance = MAX_SEARCH_RADIUS * sensor.film.inner_radius
    if probe.reach >= largest_distance:
        raise SceneError(
            f"{probe.notation}: expected a probe that can move on this film, which reaches less than "
            f"{largest_distance:.4g} mm from its centroid, got {probe.reach:.4g} mm; use a smaller probe"
        )
    pads = [electrode.corners for electrode in sensor.electrodes]  # without traces, which may extend to the clamp
    return min(outermost_corner(sensor, pads), largest_distance - probe.reach)


def map_to_search(
    sensor: Sensor,
    probe: Probe,
    force_range: tuple[float, float],
    radius: float | None = None,
    *,
    executor: Executor | None = None,
) -> ForwardMap:
    """Build the forward map in which the working area will be searched for.

    If no radius is given, a map with the radius `search_radius` is tried first. If the charges cannot be interpolated
    accurately up to this radius, the radius is multiplied by `RADIUS_REDUCTION`, at most `MAX_REDUCTIONS` times.

    Args:
        sensor: Sensor of the forward map.
        probe: Probe that presses the film.
        force_range: Smallest and largest force, N.
        radius: Radius of the map, mm; None to choose the radius.
        executor: Executor that runs the solves; None to run the solves in this process.

    Returns:
        The forward map with the given radius, or else with the largest tried radius at which the charges can be
        interpolated accurately.

    Raises:
        SceneError: If there are fewer than three electrodes, if the forces are equal, or if a press in the domain
            cannot exist.
        SolveError: If even the map with the smallest radius cannot be built.
    """
    check_electrode_count(len(sensor.electrodes))
    min_force, max_force = force_range
    if min_force == max_force:
        raise SceneError(
            "force: expected a smaller and a larger force, which determine how the charges change, "
            f"got {min_force:g} N twice"
        )
    if radius is None:
        # Try the radii in descending order, and return the first map that can be built. The smallest radius is tried
        # after this block, where a SolveError is not suppressed.
        first_radius = search_radius(sensor, probe.under(max_force))
        descending_radii = first_radius * RADIUS_REDUCTION ** np.arange(MAX_REDUCTIONS + 1.0)
        *larger_radii, radius = descending_radii.tolist()
        for larger_radius in larger_radii:
            with suppress(SolveError):
                return ForwardMap.build(sensor, probe, larger_radius, force_range, executor=executor)
    return ForwardMap.build(sensor, probe, radius, force_range, executor=executor)
