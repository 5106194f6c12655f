"""Position of a guard electrode: one further square, whose charge reveals presses outside the working area.

Electrodes on one circle give a press outside the circle nearly the charges of a press inside it (`mirror_region`). A
further electrode at another distance from the centre has different charges under both presses. The search first finds
pairs of contacts with the same charges: a press outside the working area, which cannot be noticed, and a contact inside
it. For each position of the further square, the search then starts a descent from the inner contact of each pair. The
search counts the pairs for which the descent still finds a contact with the same charges. The mirror region of the best
positions is computed by a search over the whole working area.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.errors import InputError
from isocharge.common.progress import track
from isocharge.simulate.forward.charge_map import ChargeMap, Domain
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.whole_film import whole_film_map
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.mirror_region import DETECTABLE_SIGMAS, FORCE_RATIO, MirrorRegion, is_interior
from isocharge.simulate.identifiability.nearest_contact import explain, search
from isocharge.simulate.layout.case import NAMES, DesignCase
from isocharge.simulate.layout.design import DECIMALS
from isocharge.simulate.numerics.disk import Rings, square_grid, sunflower
from isocharge.simulate.sensor.sensor import Electrode, Sensor

GRID_STEPS = 6
"""Number of steps of the grid of candidate positions from the centre to the rim."""

N_OUTSIDE = 200
"""Number of presses outside the working area with which candidate positions are compared."""

N_FORCES = 3
"""Number of different forces of these presses."""

SHARE_TOLERANCE = 0.01
"""Share of unnoticeable presses by which a position may exceed the smallest share and still be chosen for its smaller
position errors, dimensionless."""

MAX_CHECKED = 3
"""Largest number of positions whose mirror region is computed."""

LIMIT_RINGS = 20
LIMIT_ANGLES = 36
"""Numbers of rings and angles of the presses whose position errors are compared."""


@dataclass(frozen=True)
class PositionLimits:
    """Cramer-Rao limits of the position over the working area, for presses with the force that the design case states.

    Attributes:
        rms: Root mean square over the working area, mm.
        worst: Largest limit, mm.
    """

    rms: float
    worst: float

    @classmethod
    def of(cls, charges: ChargeMap, case: DesignCase) -> "PositionLimits":
        """Compute the limits of a sensor.

        Args:
            charges: Charge map of the working area.
            case: Radius of the working area, force and noise.
        """
        rings = Rings.spread(case.radius, LIMIT_RINGS, LIMIT_ANGLES)
        limits = limits_at(charges, rings.contacts(case.force), case.noise).position
        # A ring represents an area that is proportional to its distance from the centre.
        mean_square_of_rings = (rings.per_ring(limits) ** 2).mean(axis=1)
        mean_square = np.average(mean_square_of_rings, weights=rings.distance)
        return cls(float(np.sqrt(mean_square)), float(limits.max()))

    def to_dict(self) -> dict[str, float]:
        """Return the limits for JSON."""
        return {"rms_mm": self.rms, "worst_mm": self.worst}


@dataclass(frozen=True)
class GuardDesign:
    """Result of the search for a guard electrode.

    Attributes:
        case: Requirements. The electrodes of its sensor are kept, and one is added.
        sensor: Sensor with the guard electrode.
        region_before: Mirror region of the sensor without the guard electrode.
        region_after: Mirror region of the sensor with it.
        limits_before: Position limits of the sensor without the guard electrode.
        limits_after: Position limits of the sensor with it.
    """

    case: DesignCase
    sensor: Sensor
    region_before: MirrorRegion
    region_after: MirrorRegion
    limits_before: PositionLimits
    limits_after: PositionLimits

    @property
    def guard(self) -> Electrode:
        """The guard electrode."""
        (name,) = set(self.sensor.electrode_names) - set(self.case.keep)
        return next(electrode for electrode in self.sensor.electrodes if electrode.name == name)

    @property
    def summary(self) -> str:
        """Sentence about the share of presses that cannot be noticed, without and with the guard electrode."""
        return (
            f"presses outside the working area that cannot be noticed: {100.0 * self.region_before.total_share:.2g} % "
            f"without electrode {self.guard.name}, {100.0 * self.region_after.total_share:.2g} % with it"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the case, the guard electrode, and the results without and with it, for JSON."""
        return {
            "case": self.case.to_dict(),
            "sensor": self.sensor.name,
            "guard": {"name": self.guard.name, "centre_mm": np.round(self.guard.centre, DECIMALS).tolist()},
            "before": {"mirror_region": self.region_before.to_dict(), "position_limit": self.limits_before.to_dict()},
            "after": {"mirror_region": self.region_after.to_dict(), "position_limit": self.limits_after.to_dict()},
        }


def guard_case(sensor: Sensor, radius: float, **settings: Any) -> DesignCase:
    """Return the design case in which all electrodes of a sensor are kept and one square is added.

    Args:
        sensor: The sensor.
        radius: Radius of the working area, mm.
        settings: Further attributes of `DesignCase`.

    Raises:
        InputError: If a further electrode is not possible, or a setting is not allowed.
        SceneError: If the film cannot be pressed as required.
    """
    return DesignCase(sensor, len(sensor.electrodes) + 1, radius, keep=sensor.electrode_names, **settings)


def design_guard(case: DesignCase, *, executor: Executor | None = None) -> GuardDesign:
    """Find the position of one further square with which the fewest presses outside the working area go unnoticed.

    Several positions may have nearly the smallest share of such presses. Among these positions, the position with the
    smallest position limits in the working area is chosen.

    Args:
        case: Case of `guard_case`.
        executor: Executor that runs the solves; this process if absent.

    Returns:
        The sensor with the guard electrode, and what it improves.

    Raises:
        InputError: If no position is free.
        SceneError: If the working area reaches the clamp.
        SolveError: If an equilibrium is not reached.
    """
    # Estimate the share of unnoticed presses for each position. All sensors have the same film, and therefore the same
    # solutions of the film.
    sensors = [_with_guard(case, position) for position in _free_positions(case)]
    inner_map = ForwardMap.build(case.sensor, case.probe, case.radius, DEFAULT_FORCE_RANGE, executor=executor)
    outer_map = whole_film_map(case.sensor, case.probe, DEFAULT_FORCE_RANGE, executor=executor)
    shares = _estimated_shares(case, inner_map, outer_map, sensors)

    # Sort the sensors with nearly the smallest share by their position limits.
    accepted_share = shares.min() + SHARE_TOLERANCE
    candidates = [sensors[index] for index in np.flatnonzero(shares <= accepted_share)]
    limits = [PositionLimits.of(replace(inner_map, sensor=candidate), case) for candidate in candidates]
    order = np.argsort([limit.rms for limit in limits], kind="stable")
    best_candidates = [candidates[index] for index in order[:MAX_CHECKED]]

    # The shares are estimates. Check the best sensors by a full search until one confirms its estimate.
    results: list[tuple[MirrorRegion, Sensor]] = []
    for candidate in track(best_candidates, "computing mirror regions"):
        region = _mirror_region(case, inner_map, outer_map, candidate)
        results.append((region, candidate))
        if region.total_share <= accepted_share:
            break
    region_after, sensor = min(results, key=lambda result: result[0].total_share)
    return GuardDesign(
        case,
        sensor,
        region_before=_mirror_region(case, inner_map, outer_map, case.sensor),
        region_after=region_after,
        limits_before=PositionLimits.of(inner_map, case),
        limits_after=PositionLimits.of(replace(inner_map, sensor=sensor), case),
    )


def _free_positions(case: DesignCase) -> Array:
    """Return the positions at which a further square electrode fits, shape (n, 2), mm.

    The positions are points of a regular grid over the film.

    Raises:
        InputError: If no square fits.
    """
    film_radius = case.sensor.film.radius
    grid = square_grid(film_radius, film_radius / GRID_STEPS)
    free = grid[case.clearance(grid) >= 0.0]
    if not len(free):
        raise InputError(f"side: no square of {case.square_side:g} mm fits between the electrodes; give a smaller side")
    return np.asarray(free.round(DECIMALS))


def _with_guard(case: DesignCase, position: Array) -> Sensor:
    """Return the sensor of a case with a guard electrode at a position, shape (2,), mm."""
    x, y = position.tolist()
    name = next(name for name in NAMES if name not in case.sensor.electrode_names)
    guard = replace(Electrode.of_square(name, (x, y), case.square_side), role="guard")
    return replace(
        case.sensor,
        name=f"{case.sensor.name}-guard",
        electrodes=(*case.sensor.electrodes, guard),
    )


def _mirror_region(case: DesignCase, inner_map: ForwardMap, outer_map: ForwardMap, sensor: Sensor) -> MirrorRegion:
    """Compute the mirror region of a sensor whose film is that of both maps."""
    charges = ChargeSpline.of(replace(inner_map, sensor=sensor))
    return MirrorRegion.of(charges, case.radius, replace(outer_map, sensor=sensor), case.noise)


def _estimated_shares(case: DesignCase, inner_map: ForwardMap, outer_map: ForwardMap, sensors: list[Sensor]) -> Array:
    """Estimate the share of presses outside the working area that cannot be noticed, for several guard electrodes.

    A press is not noticed if some contact in the working area explains its charges. Presses that are noticed without a
    guard electrode are noticed with any guard electrode. For the other presses, the search for a contact is repeated
    with the charge of each guard electrode, from the contact that was found without it.

    Args:
        case: Radius of the working area and noise.
        inner_map: Accurate forward map of the working area.
        outer_map: Coarse forward map of the whole film.
        sensors: Sensors whose last electrode is the guard electrode.

    Returns:
        Shares, shape (n_sensor,), dimensionless.
    """
    # Contacts in the working area that best explain the charges of presses outside
    presses = _presses_outside(case, outer_map)
    charge = outer_map.charges(presses)
    inner_charges = ChargeSpline.of(inner_map)
    contact, residual = search(inner_charges, charge, case.noise.sigma(charge))
    is_explained = np.linalg.norm(residual, axis=1) < DETECTABLE_SIGMAS
    is_mirrored = is_explained & is_interior(inner_charges.domain, contact)
    if not is_mirrored.any():
        return np.zeros(len(sensors))

    # Add the charge of each guard electrode, and search again for contacts that explain the charges of these presses.
    mirrored_presses = presses[is_mirrored]
    shares = []
    for sensor in track(sensors, "comparing positions"):
        guard_only = replace(case.sensor, electrodes=sensor.electrodes[-1:])  # the guard electrode is the last one
        guard_charge = replace(outer_map, sensor=guard_only).charges(mirrored_presses)
        charge_with_guard = np.concatenate([charge[is_mirrored], guard_charge], axis=1)
        map_with_guard = JoinedMap(inner_charges, replace(inner_map, sensor=guard_only))
        sigma = case.noise.sigma(charge_with_guard)
        _, new_residual = explain(map_with_guard, charge_with_guard, sigma, contact[is_mirrored])
        is_unnoticed = np.linalg.norm(new_residual, axis=1) < DETECTABLE_SIGMAS
        shares.append(np.count_nonzero(is_unnoticed) / len(presses))
    return np.array(shares)


@dataclass(frozen=True)
class JoinedMap:
    """Charge map of the electrodes of two charge maps with the same domain.

    Attributes:
        first: Map of the first electrodes.
        second: Map of the other electrodes.
    """

    first: ChargeMap
    second: ChargeMap

    @property
    def domain(self) -> Domain:
        """Contacts for which the map holds."""
        return self.first.domain

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the electrodes, in the order of the charges."""
        return (*self.first.electrodes, *self.second.electrodes)

    def charges(self, contact: Array) -> Array:
        """Return the charges of contacts; see `ChargeMap`."""
        return np.concatenate([self.first.charges(contact), self.second.charges(contact)], axis=1)

    def derivatives(self, contact: Array) -> Array:
        """Return the derivatives of the charges; see `ChargeMap`."""
        return np.concatenate([self.first.derivatives(contact), self.second.derivatives(contact)], axis=1)


def _presses_outside(case: DesignCase, outer_map: ForwardMap) -> Array:
    """Return presses that are spread over the film outside the working area, shape (n, 3), mm and N.

    The presses have `N_FORCES` different forces in turn, in the range of the mirror region.

    Args:
        case: Radius of the working area.
        outer_map: Forward map whose domain contains the presses.
    """
    min_force, max_force = outer_map.domain.force_range
    forces = np.geomspace(max(min_force, max_force / FORCE_RATIO), max_force, N_FORCES)

    # Spread points over the whole disk, so many that about `N_OUTSIDE` of them lie outside the working area.
    outer_radius = outer_map.domain.radius
    share_outside = 1.0 - (case.radius / outer_radius) ** 2
    points = sunflower(round(N_OUTSIDE / share_outside)) * outer_radius  # x + iy, mm
    position = points[np.abs(points) > case.radius]
    return np.stack([position.real, position.imag, np.resize(forces, position.size)], axis=1)
