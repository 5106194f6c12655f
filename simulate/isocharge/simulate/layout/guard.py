"""Search for the position of a guard electrode, whose charge reveals presses outside the working area.

If all electrodes lie on one circle, a press outside the circle has nearly the same charges as a press inside the circle
(see `mirror_region`). These two presses cause different charges on a guard electrode, which is a square at another
distance from the centre.

The search first finds pairs of contacts that have the same charges without the guard electrode. One contact of a pair
is a press outside the working area, and the other contact is inside the working area. For each possible position of the
guard electrode, the charge of this electrode is added to the charges of each pair. A least-squares descent then starts
from the inner contact. If the descent finds a contact with the same charges, the guard electrode does not reveal the
press outside. For the chosen position, the mirror region is computed by a search over the whole working area.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.errors import InputError
from isocharge.common.progress import track
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.whole_film import whole_film_map
from isocharge.simulate.identifiability.identification import LimitMap
from isocharge.simulate.identifiability.mirror_region import (
    DETECTABLE_SIGMAS,
    MirrorRegion,
    is_interior,
    presses_outside,
)
from isocharge.simulate.identifiability.nearest_contact import explain, search
from isocharge.simulate.layout.case import NAMES, DesignCase
from isocharge.simulate.layout.design import DECIMALS
from isocharge.simulate.numerics.disk import Rings, square_grid
from isocharge.simulate.sensor.sensor import Electrode, Sensor

GRID_STEPS = 6
"""Number of steps, from the centre to the rim of the film, of the grid of possible positions of the guard electrode."""

PRESS_COUNTS = (8, 8, 3)
"""Numbers of rings, sectors and forces of the presses outside the working area that the positions are compared with."""

SHARE_TOLERANCE = 0.01
"""Difference between two shares of unnoticeable presses that counts as negligible, dimensionless.

Among the positions whose share exceeds the smallest share by at most this difference, the position errors decide.
"""

LIMIT_RINGS = 20
"""Number of rings of the presses whose position errors are compared."""

LIMIT_ANGLES = 36
"""Number of presses on each of these rings."""


@dataclass(frozen=True)
class GuardDesign:
    """Result of the search for a guard electrode.

    Attributes:
        case: Design case, in which all electrodes of the initial sensor are kept and one electrode is added.
        sensor: Sensor with the guard electrode.
        region_before: Mirror region of the sensor without the guard electrode.
        region_after: Mirror region of the sensor with the guard electrode.
        limits_before: Root mean square and maximum ("rms_mm", "worst_mm") of the Cramer-Rao limits of the position, for
            presses in the working area with the force of the case, without the guard electrode.
        limits_after: The same limits with the guard electrode.
    """

    case: DesignCase
    sensor: Sensor
    region_before: MirrorRegion
    region_after: MirrorRegion
    limits_before: dict[str, float]
    limits_after: dict[str, float]

    @property
    def guard(self) -> Electrode:
        """Guard electrode, which is the electrode that the initial sensor does not have."""
        (name,) = set(self.sensor.electrode_names) - set(self.case.keep)
        return next(electrode for electrode in self.sensor.electrodes if electrode.name == name)

    @property
    def summary(self) -> str:
        """Text that compares the share of unnoticeable presses without and with the guard electrode."""
        return (
            f"presses outside the working area that cannot be noticed: {100.0 * self.region_before.total_share:.2g} % "
            f"without electrode {self.guard.name}, {100.0 * self.region_after.total_share:.2g} % with it"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON with the case, the guard electrode, and the results without and with it."""
        return {
            "case": self.case.to_dict(),
            "sensor": self.sensor.name,
            "guard": {"name": self.guard.name, "centre_mm": np.round(self.guard.centre, DECIMALS).tolist()},
            "before": {"mirror_region": self.region_before.to_dict(), "position_limit": self.limits_before},
            "after": {"mirror_region": self.region_after.to_dict(), "position_limit": self.limits_after},
        }


def guard_case(sensor: Sensor, radius: float, **settings: Any) -> DesignCase:
    """Create a design case in which all electrodes of a sensor are kept and one square is added.

    Args:
        sensor: Sensor to which the square is added.
        radius: Radius of the working area, mm.
        settings: Further attributes of `DesignCase`.

    Raises:
        InputError: If the sensor already has the largest number of electrodes, or a setting is not allowed.
        SceneError: If a press within the radius cannot exist.
    """
    return DesignCase(sensor, len(sensor.electrodes) + 1, radius, keep=sensor.electrode_names, **settings)


def design_guard(case: DesignCase, *, executor: Executor | None = None) -> GuardDesign:
    """Find the position at which a guard electrode leaves the fewest presses outside the working area unnoticed.

    Several positions may have nearly the smallest share of unnoticed presses. The function then prefers the position
    with the smallest Cramer-Rao limits of the position error in the working area.

    Args:
        case: Design case that `guard_case` created.
        executor: Executor that runs the solves; None for this process.

    Returns:
        The sensor with the guard electrode, and its mirror region and position limits without and with this electrode.

    Raises:
        InputError: If a square does not fit at any position.
        SceneError: If a press in the working area or on the rest of the film cannot exist.
        SolveError: If a press has no equilibrium, or the interpolation error of the forward map is too large.
    """
    # Estimate the share of unnoticed presses for each position. The forward maps are solved only once, because all
    # sensors have the same film.
    sensors = [_with_guard(case, position) for position in _free_positions(case)]
    inner_map = ForwardMap.build(case.sensor, case.probe, case.radius, DEFAULT_FORCE_RANGE, executor=executor)
    outer_map = whole_film_map(case.sensor, case.probe, DEFAULT_FORCE_RANGE, executor=executor)
    shares = _estimated_shares(case, inner_map, outer_map, sensors)

    # Among the sensors with nearly the smallest share, choose the sensor with the smallest position limits.
    candidates = [sensors[index] for index in np.flatnonzero(shares <= shares.min() + SHARE_TOLERANCE)]
    limits = [_position_limits(case, replace(inner_map, sensor=candidate))["rms_mm"] for candidate in candidates]
    sensor = candidates[int(np.argmin(limits))]
    return GuardDesign(
        case,
        sensor,
        region_before=_mirror_region(case, inner_map, outer_map, case.sensor),
        region_after=_mirror_region(case, inner_map, outer_map, sensor),
        limits_before=_position_limits(case, inner_map),
        limits_after=_position_limits(case, replace(inner_map, sensor=sensor)),
    )


def _free_positions(case: DesignCase) -> Array:
    """Return the points of a regular grid over the film at which a further square electrode fits.

    Args:
        case: Design case with the kept electrodes, the side of the square and the distance rules.

    Returns:
        Centres (x, y) of the square, shape (n, 2), mm.

    Raises:
        InputError: If the square does not fit at any point of the grid.
    """
    film_radius = case.sensor.film.radius
    grid = square_grid(film_radius, film_radius / GRID_STEPS)
    free = grid[case.clearance(grid) >= 0.0]
    if not len(free):
        raise InputError(f"side: no square of {case.square_side:g} mm fits between the electrodes; give a smaller side")
    return np.asarray(free.round(DECIMALS))


def _with_guard(case: DesignCase, position: Array) -> Sensor:
    """Add a guard electrode to the sensor of a design case. The guard electrode becomes the last electrode.

    Args:
        case: Design case with the sensor and the side of the square.
        position: Centre (x, y) of the guard electrode, shape (2,), mm.
    """
    x, y = position.tolist()
    name = next(name for name in NAMES if name not in case.sensor.electrode_names)
    guard = replace(Electrode.of_square(name, (x, y), case.square_side), role="guard")
    return replace(
        case.sensor,
        name=f"{case.sensor.name}-guard",
        electrodes=(*case.sensor.electrodes, guard),
    )


def _mirror_region(case: DesignCase, inner_map: ForwardMap, outer_map: ForwardMap, sensor: Sensor) -> MirrorRegion:
    """Compute the mirror region of a sensor by means of forward maps of another sensor with the same film.

    Args:
        case: Design case with the radius of the working area and the noise.
        inner_map: Accurate forward map of the working area.
        outer_map: Coarse forward map of the whole film.
        sensor: Sensor whose mirror region is computed.
    """
    charges = ChargeSpline.of(replace(inner_map, sensor=sensor))
    return MirrorRegion.of(charges, case.radius, replace(outer_map, sensor=sensor), case.noise)


def _position_limits(case: DesignCase, charges: ChargeMap) -> dict[str, float]:
    """Compute the root mean square and the maximum of the Cramer-Rao limits of the position in the working area, mm."""
    rings = Rings.spread(case.radius, LIMIT_RINGS, LIMIT_ANGLES)
    limits = LimitMap.of(charges, case.noise, case.force, rings).statistics()
    return {"rms_mm": limits["position_rms_mm"], "worst_mm": limits["position_worst_mm"]}


def _estimated_shares(case: DesignCase, inner_map: ForwardMap, outer_map: ForwardMap, sensors: list[Sensor]) -> Array:
    """For several guard electrodes, estimate which share of the presses outside the working area cannot be noticed.

    A press outside cannot be noticed if a contact inside the working area has the same charges within the noise. This
    contact is said to explain the charges. Presses that are noticed without a guard electrode are also noticed with
    every guard electrode. For each of the other presses, the function adds the charge of the guard electrode, and
    searches again for a contact that explains all charges. This search starts from the contact that explains the
    charges without the guard electrode.

    Args:
        case: Design case with the radius of the working area and the noise.
        inner_map: Accurate forward map of the working area.
        outer_map: Coarse forward map of the whole film.
        sensors: Sensors whose last electrode is the guard electrode.

    Returns:
        Share of the presses for each sensor, shape (n_sensor,), dimensionless.
    """
    # Without a guard electrode, find the contacts in the working area that best explain the charges of the presses.
    presses = presses_outside(case.radius, outer_map.domain, *PRESS_COUNTS)
    area = np.broadcast_to(np.hypot(presses[..., 0], presses[..., 1]), presses.shape[:3]).ravel()  # of the sectors
    presses = presses.reshape(-1, 3)
    charge = outer_map.charges(presses)
    inner_charges = ChargeSpline.of(inner_map)
    contact, residual = search(inner_charges, charge, case.noise.sigma(charge))
    is_explained = np.linalg.norm(residual, axis=1) < DETECTABLE_SIGMAS  # distance in standard deviations of the noise
    is_mirrored = is_explained & is_interior(inner_charges.domain, contact)
    if not is_mirrored.any():
        return np.zeros(len(sensors))

    # For each guard electrode, add its charge to the charges of the presses that were not noticed, and search again for
    # contacts that explain the charges.
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
        shares.append(area[is_mirrored][is_unnoticed].sum() / area.sum())
    return np.array(shares)


@dataclass(frozen=True)
class JoinedMap:
    """Charge map that combines the electrodes of two charge maps with the same domain.

    Attributes:
        first: Charge map of the first electrodes.
        second: Charge map of the other electrodes.
    """

    first: ChargeMap
    second: ChargeMap

    @property
    def domain(self) -> Domain:
        """Set of contacts for which the map is valid."""
        return self.first.domain

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the electrodes, in the order of the charges."""
        return (*self.first.electrodes, *self.second.electrodes)

    def charges(self, contact: Array) -> Array:
        """Compute the charges of all electrodes; see `ChargeMap`."""
        return np.concatenate([self.first.charges(contact), self.second.charges(contact)], axis=1)

    def derivatives(self, contact: Array) -> Array:
        """Compute the derivatives of the charges of all electrodes; see `ChargeMap`."""
        return np.concatenate([self.first.derivatives(contact), self.second.derivatives(contact)], axis=1)
