"""Selection of the integration rule with which the charge of an electrode under a press is computed.

The stress varies strongly near the probe and smoothly far from the probe. An electrode near the probe therefore needs
an integration rule with many points. An electrode far from the probe needs only a few points.
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
"""Distance of a press from the clamp above which the rule for far electrodes may be used, in reaches of the probe."""

MAX_RING_RATIO = 2.0
"""Ratio of the radii of successive rings of the mesh up to which the rule for far electrodes may be used.

On coarser meshes, the computed stress is not smooth enough across an electrode. Meshes that are chosen automatically
have a ratio of about 1.9.
"""


@dataclass(frozen=True)
class ReadoutRules:
    """Three integration rules: for electrodes near the probe, for electrodes far from the probe, and for all others.

    Attributes:
        sensor: Sensor with the electrodes.
        probe: Probe that presses the film.
        resolution: Fineness of the mesh on which the stress is solved.
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
        """Select an integration rule for each pair of a press and an electrode.

        The fine rule is used for electrodes near the probe. The far rule is used for electrodes far from the probe, if
        the press is also far from the clamp, and if the mesh is fine enough. The coarse rule is used for all other
        pairs.

        Args:
            position: Positions x + iy of the presses, shape (n,), mm.

        Returns:
            The three rules. Each rule is followed by an array, shape (n, n_electrode), that is True where a press and
            an electrode use this rule.
        """
        is_near = self.is_near(position)
        is_distant = electrode_distances(self.sensor, position) > FAR_DISTANCE
        clamp_distance = self.sensor.film.radius - np.abs(position)
        is_inner = clamp_distance >= MIN_CLAMP_DISTANCE * self.probe.reach  # shape (n,)
        is_far = ~is_near & is_distant & is_inner[:, None] & self.has_smooth_far_field
        is_neither = ~is_near & ~is_far
        return (self.fine, is_near), (self.coarse, is_neither), (self.far, is_far)

    def is_near(self, position: Complexes) -> Booleans:
        """Return whether each electrode is so near to each press that the fine rule is needed.

        Args:
            position: Positions x + iy of the presses, shape (n,), mm.

        Returns:
            Whether the fine rule is needed, shape (n, n_electrode).
        """
        return np.asarray(electrode_gaps(self.sensor, position) < self.probe.reach + NEAR)

    @cached_property
    def has_smooth_far_field(self) -> bool:
        """Whether the mesh is so fine that the rule with few points suffices for electrodes far from the probe."""
        # The radii of the rings increase by a constant ratio from the edge of the probe to the rim of the film.
        ring_ratio = (self.sensor.film.radius / self.probe.reach) ** (1.0 / self.resolution.rings)
        return bool(ring_ratio <= MAX_RING_RATIO)
