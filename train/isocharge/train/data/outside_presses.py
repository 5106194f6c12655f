"""Presses outside the working area, for training the misfit network and for measuring its detection rate.

The charges are computed with a coarse map of the whole film, whose error is a few percent near the clamp. The error
does not affect the training, because the misfit network is trained on the exact misfits of the computed charges. The
error hardly changes the measured share of wrong answers without a flag.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import SceneError, SolveError
from isocharge.serve.model.metadata import UnnoticedPresses
from isocharge.simulate import Circle, Sensor, parse_probe
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.forward.whole_film import outermost_distance, whole_film_map
from isocharge.train.data.presses import LabelledPresses

_log = logging.getLogger(__name__)

MIN_WIDTH = 1.0
"""Smallest width of the ring between the working area and the clamp, mm. In a narrower ring, no presses are drawn."""

FORCE_RATIO = 10.0
"""Largest ratio of the largest to the smallest force of the presses of `OutsidePresses.grid`, dimensionless."""

N_FORCES = 5
"""Number of forces of the presses at each place of `OutsidePresses.grid`."""

N_RINGS = 24
"""Number of rings into which `OutsidePresses.grid` divides the area outside the working area."""

N_SECTORS = 36
"""Number of sectors into which `OutsidePresses.grid` divides each ring."""

SHARE_DECIMALS = 2
"""Number of decimals to which the measured shares of presses are rounded."""


@dataclass(frozen=True)
class OutsidePresses:
    """Presses on the part of a film between the working area and the clamp.

    Attributes:
        charge_map: Map of the whole film from contacts to charges.
        inner: Radius of the working area, mm.
    """

    charge_map: ChargeMap
    inner: float

    @classmethod
    def simulate(
        cls, sensor: Sensor, probes: tuple[str, ...], force_range: tuple[float, float]
    ) -> "OutsidePresses | None":
        """Simulate a coarse forward map of the whole film, and return presses whose charges this map gives.

        The map is simulated for a single probe, which is a disk whose radius is the largest reach of the given probes.
        The reach of a probe is the distance from the centroid of its footprint to the farthest point of the footprint.

        Args:
            sensor: The sensor.
            probes: Notations of the probes of the model.
            force_range: Smallest and largest force of the model, N.

        Returns:
            Presses on the whole film, which `beyond` restricts to the part outside the working area. None if the film
            cannot be simulated.
        """
        largest_reach = max(parse_probe(notation).reach for notation in probes)
        probe = Circle(largest_reach)
        if outermost_distance(sensor.film, probe) < MIN_WIDTH:  # the probe is nearly as large as the film
            return None
        try:
            charge_map = whole_film_map(sensor, probe, force_range)
        except (SceneError, SolveError) as error:
            _log.warning("presses outside the working area are not simulated: %s", error)
            return None
        # The working area is not known yet, so its radius is zero at first. `beyond` sets the true radius.
        return cls(charge_map, inner=0.0)

    def beyond(self, radius: float) -> "OutsidePresses | None":
        """Restrict the presses to the ring outside a working area.

        The result is None if the working area nearly reaches the clamp.

        Args:
            radius: Radius of the working area, mm.
        """
        if self.outer < radius + MIN_WIDTH:
            return None
        return replace(self, inner=radius)

    @property
    def outer(self) -> float:
        """Largest distance of a press from the centre, mm."""
        return self.charge_map.domain.radius

    def draw(self, count: int, seed: int) -> LabelledPresses:
        """Draw presses with positions uniformly distributed over the ring and with log-uniform forces.

        The squared distances from the centre are uniformly distributed, because the area grows with the square of the
        distance.

        Args:
            count: Number of presses.
            seed: Seed of the random numbers.
        """
        rng = np.random.default_rng(seed)
        distance = np.sqrt(rng.uniform(self.inner**2, self.outer**2, count))
        angle = rng.uniform(0.0, 2.0 * np.pi, count)
        min_log_force, max_log_force = np.log(self.charge_map.domain.force_range)
        force = np.exp(rng.uniform(min_log_force, max_log_force, count))
        return self._simulate(distance, angle, force)

    def grid(self) -> LabelledPresses:
        """Return a grid of presses: `N_FORCES` presses with different forces in the middle of each sector of each ring.

        The area outside the working area is divided into `N_RINGS` rings, and each ring into `N_SECTORS` sectors.
        """
        ring_edges = np.linspace(self.inner, self.outer, N_RINGS + 1)
        distance = 0.5 * (ring_edges[1:] + ring_edges[:-1])
        angle = 2.0 * np.pi * (np.arange(N_SECTORS) + 0.5) / N_SECTORS
        # All combinations of distance, angle and force
        distances, angles, forces = np.meshgrid(distance, angle, self._measured_forces(), indexing="ij")
        return self._simulate(distances.ravel(), angles.ravel(), forces.ravel())

    def unnoticed_shares(self, is_unnoticed: Booleans) -> UnnoticedPresses:
        """For each sector of each ring, compute the share of presses with a wrong answer that carries no flag.

        Args:
            is_unnoticed: Whether the answer to each press is wrong and carries no flag, shape (n,), in the order of
                `grid`.
        """
        is_unnoticed_at_place = is_unnoticed.reshape(N_RINGS, N_SECTORS, N_FORCES)
        share_of_forces = is_unnoticed_at_place.mean(axis=2)  # shape (N_RINGS, N_SECTORS)
        shares = share_of_forces.round(SHARE_DECIMALS)
        forces = self._measured_forces()
        return UnnoticedPresses(
            from_mm=round(self.inner, 4),
            to_mm=round(self.outer, 4),
            force_N=(float(f"{forces[0]:.4g}"), float(f"{forces[-1]:.4g}")),
            share=tuple(tuple(ring) for ring in shares.tolist()),
        )

    def _measured_forces(self) -> Array:
        """Return the forces of the presses of `grid`, shape (N_FORCES,), N."""
        min_force, max_force = self.charge_map.domain.force_range
        smallest_measured = max(min_force, max_force / FORCE_RATIO)
        return np.geomspace(smallest_measured, max_force, N_FORCES)

    def _simulate(self, distance: Array, angle: Array, force: Array) -> LabelledPresses:
        """Compute the charges of presses at given places with given forces, and return the presses.

        Args:
            distance: Distances of the presses from the centre, shape (n,), mm.
            angle: Angles of the positions from the x axis, anticlockwise, shape (n,), rad.
            force: Forces, shape (n,), N.
        """
        min_force, max_force = self.charge_map.domain.force_range
        limited_force = np.clip(force, min_force, max_force)  # rounding errors can exceed the range
        contact = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), limited_force])
        return LabelledPresses(contact, self.charge_map.charges(contact))
