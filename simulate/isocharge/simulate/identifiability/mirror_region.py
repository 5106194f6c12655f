"""The mirror region: positions outside the working area where a press has the same charges as a press inside it.

If all electrodes lie on one circle of radius R, the mirror region covers almost the whole film. A point load at the
distance r from the centre has nearly the same influence on the points of this circle as a point load at R^2 / r. The
reason is that an inversion in the circle preserves the ratios of the distances to the points of the circle. No method
can notice a press in the mirror region, because its charges are those of a press in the working area.
"""

from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.forward.charge_map import ChargeMap, Domain, within
from isocharge.simulate.forward.whole_film import outermost_distance, whole_film_map
from isocharge.simulate.identifiability.nearest_contact import search
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.sensor.probe import Circle, Probe
from isocharge.simulate.sensor.sensor import Sensor

DETECTABLE_SIGMAS = 5.0
"""Difference of charges above which a press can be noticed, in standard deviations of the noise.

It is the smallest limit of the misfit in `isocharge.serve`.
"""

FORCE_COUNT = 5
"""Number of forces of the presses at each position."""

FORCE_RATIO = 10.0
"""Largest ratio of the largest to the smallest of these forces, dimensionless."""

N_RINGS = 32
"""Number of rings between the working area and the clamp."""

N_SECTORS = 48
"""Number of sectors of each ring."""

N_CANDIDATES = 1024
"""Number of contacts from which the search for the nearest contact starts."""

INTERIOR = 0.98
"""Distance from the centre up to which a contact counts as inside the working area, in units of its radius.

A contact on the edge does not explain the charges; the search only stopped there.
"""


@dataclass(frozen=True)
class MirrorRegion:
    """Share of the presses outside the working area that have the same charges as a press inside it, at each position.

    Attributes:
        inner: Radius of the working area, mm.
        outer: Largest distance of the presses from the centre, mm.
        forces: Forces of the presses, shape (n_force,), N.
        share: Share of the forces at which a press has the charges of a press in the working area, shape (n_ring,
            n_sector), dimensionless. The rings have equal widths. The first sector begins at the x axis, and the others
            follow anticlockwise.
    """

    inner: float
    outer: float
    forces: Array
    share: Array

    @classmethod
    def of(cls, charges: ChargeMap, radius: float, whole_film: ChargeMap, noise: NoiseModel) -> "MirrorRegion":
        """Compare presses outside the working area with all presses inside it.

        Args:
            charges: Accurate charge map of the working area.
            radius: Radius of the working area, mm.
            whole_film: Charge map of the whole film.
            noise: Noise of the readings.

        Returns:
            The mirror region, from presses in the middle of each sector of each ring.
        """
        # Forces, and the middles of the rings and sectors between the working area and the edge of the map
        min_force, max_force = charges.domain.force_range
        forces = np.geomspace(max(min_force, max_force / FORCE_RATIO), max_force, FORCE_COUNT)
        outer_radius = whole_film.domain.radius
        ring_edges = np.linspace(radius, outer_radius, N_RINGS + 1)
        ring_distance = 0.5 * (ring_edges[1:] + ring_edges[:-1])
        sector_angle = 2.0 * np.pi * (np.arange(N_SECTORS) + 0.5) / N_SECTORS

        # Presses with every combination of ring, sector and force
        grids = np.meshgrid(ring_distance, sector_angle, forces, indexing="ij")
        distance, angle, force = (grid.ravel() for grid in grids)
        contact = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), force])

        # Whether a press in the working area has the same charges, and the share of the forces for which this is true
        is_mirrored = has_mirror(within(charges, radius), whole_film.charges(contact), noise)
        share_of_forces = is_mirrored.reshape(N_RINGS, N_SECTORS, FORCE_COUNT).mean(axis=2)
        return cls(radius, outer_radius, forces, share_of_forces)

    @property
    def distance(self) -> Array:
        """Distance of the middle of each ring from the centre, shape (n_ring,), mm."""
        edges = np.linspace(self.inner, self.outer, len(self.share) + 1)
        return np.asarray(0.5 * (edges[1:] + edges[:-1]))

    @property
    def total_share(self) -> float:
        """Share of the presses outside the working area that have the same charges as a press inside it,
        dimensionless."""
        return float(np.average(self.share.mean(axis=1), weights=self.distance))

    @property
    def summary(self) -> str:
        """Sentence about the share of presses outside the working area that have the same charges as a press inside
        it."""
        presses = (
            f"presses of {self.forces[0]:.2g} to {self.forces[-1]:.2g} N from {self.inner:.3g} to {self.outer:.3g} mm "
            "from the centre"
        )
        if not self.share.any():
            return f"All {presses} have charges that differ from those of every press in the working area."
        return (
            f"Of {presses}, {100.0 * self.total_share:.2g} % have the charges of a press in the working area, and no "
            "method can notice them."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the result for JSON."""
        return {
            "share": self.total_share,
            "from_mm": self.inner,
            "to_mm": self.outer,
            "force_N": [float(self.forces[0]), float(self.forces[-1])],
            "by_distance": {"distance_mm": self.distance.tolist(), "share": self.share.mean(axis=1).tolist()},
            "words": self.summary,
        }


def has_mirror(inside: ChargeMap, charge: Array, noise: NoiseModel) -> Booleans:
    """Return a mask of the charges that a press in a domain also causes, up to the noise.

    Args:
        inside: Charge map of the domain.
        charge: Charges without noise, shape (n, n_electrode), pC.
        noise: Noise of the readings.

    Returns:
        Whether a press in the domain causes the charges of each row, shape (n,).
    """
    nearest_contact, residual = search(inside, charge, noise.sigma(charge), candidates=N_CANDIDATES)
    is_same_charge = np.linalg.norm(residual, axis=1) < DETECTABLE_SIGMAS
    return np.asarray(is_same_charge & is_interior(inside.domain, nearest_contact))


def is_interior(domain: Domain, contact: Array) -> Booleans:
    """Return which contacts, shape (n, 3), lie inside a domain and not on its edge, shape (n,)."""
    unit_x, unit_y, unit_log_force = domain.to_unit(contact).T
    is_position_inside = np.hypot(unit_x, unit_y) < INTERIOR
    is_force_inside = np.abs(unit_log_force) < INTERIOR
    return np.asarray(is_position_inside & is_force_inside)


def mirror_region(
    sensor: Sensor,
    probe: Probe,
    charges: ChargeMap,
    radius: float,
    noise: NoiseModel,
    *,
    executor: Executor | None = None,
) -> MirrorRegion | None:
    """Solve a coarse map of the whole film, and find the mirror region of a sensor.

    Outside the working area, a probe that is not round is replaced by a disk with the same reach.

    Args:
        sensor: Sensor.
        probe: Probe that presses the film.
        charges: Accurate charge map of the working area.
        radius: Radius of the working area, mm.
        noise: Noise of the readings.
        executor: Executor that runs the solves; this process if absent.

    Returns:
        The mirror region; None if there is no working area, or if it reaches the clamp.

    Raises:
        SceneError: If some presses cannot exist.
        SolveError: If a press has no equilibrium.
    """
    if not 0.0 < radius < outermost_distance(sensor.film, probe):
        return None
    is_round = probe.period == 0.0
    round_probe = probe if is_round else Circle(probe.reach)
    whole_film = whole_film_map(sensor, round_probe, charges.domain.force_range, executor=executor)
    return MirrorRegion.of(charges, radius, whole_film, noise)
