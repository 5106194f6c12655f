"""Choice of the integration rule for the charge of each electrode under each press.

The stress varies strongly near the probe and smoothly far from it. An electrode near the probe therefore needs an
integration rule with many points, and an electrode far from the probe needs only a few.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Booleans, Complexes
from isocharge.simulate.forward.readout import (
    COARSE,
    FAR,
    FAR_DISTANCE,
    FINE,
    NEAR,
    ReadoutPoints,
    electrode_distances,
    electrode_gaps,
)
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor

MIN_CLAMP_DISTANCE = 8.0
"""Smallest distance of a press from the clamp for the rule for far electrodes, in units of the probe's reach."""

MAX_RING_RATIO = 2.0
"""Largest ratio of the radii of successive rings of the mesh at which the rule for far electrodes is used.

On coarser meshes the stress is not smooth enough across an electrode. Meshes that are chosen automatically have a ratio
of about 1.9.
"""


@dataclass(frozen=True)
class ReadoutRules:
    """Integration rules for electrodes near the probe, between, and far from it.

    Attributes:
        sensor: The sensor.
        probe: The probe.
        resolution: Fineness of the mesh of the solves.
    """

    sensor: Sensor
    probe: Probe
    resolution: Resolution

    @cached_property
    def fine(self) -> ReadoutPoints:
        """Integration rule for electrodes near the probe."""
        return ReadoutPoints.of(self.sensor, FINE)

    @cached_property
    def coarse(self) -> ReadoutPoints:
        """Integration rule for electrodes that are neither near the probe nor far from it."""
        return ReadoutPoints.of(self.sensor, COARSE)

    @cached_property
    def far(self) -> ReadoutPoints:
        """Integration rule for electrodes far from the probe."""
        return ReadoutPoints.of(self.sensor, FAR)

    def select(self, position: Complexes) -> tuple[tuple[ReadoutPoints, Booleans], ...]:
        """Select the integration rule for each pair of a press and an electrode.

        The fine rule is for electrodes near the probe. The rule for far electrodes also requires that the press is far
        from the clamp, and that the mesh is fine there. The coarse rule is for all other pairs.

        Args:
            position: Positions x + iy of the presses, shape (n,), mm.

        Returns:
            Each rule with the pairs that use it, shape (n, n_electrode).
        """
        is_near = self.is_near(position)
        is_distant = electrode_distances(self.sensor, position) > FAR_DISTANCE
        clamp_distance = self.sensor.film.radius - np.abs(position)
        is_inner = clamp_distance >= MIN_CLAMP_DISTANCE * self.probe.reach  # shape (n,)
        is_far = ~is_near & is_distant & is_inner[:, None] & self.has_smooth_far_field
        is_between = ~is_near & ~is_far
        return (self.fine, is_near), (self.coarse, is_between), (self.far, is_far)

    def is_near(self, position: Complexes) -> Booleans:
        """Return whether electrodes are so near to presses that they need the fine rule.

        Args:
            position: Positions x + iy of the presses, shape (n,), mm.

        Returns:
            Whether each electrode is near to each press, shape (n, n_electrode).
        """
        return np.asarray(electrode_gaps(self.sensor, position) < self.probe.reach + NEAR)

    @cached_property
    def has_smooth_far_field(self) -> bool:
        """Whether the mesh is fine enough for the integration with few points over electrodes far from the probe."""
        ring_ratio = (self.sensor.film.radius / self.probe.reach) ** (1.0 / self.resolution.rings)
        return bool(ring_ratio <= MAX_RING_RATIO)
