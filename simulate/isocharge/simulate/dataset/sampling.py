"""Sampling of the presses of a sweep: their positions, forces, probes and orientations.

The presses are scrambled Sobol points, which cover the domain more evenly than independent random numbers (Owen 1998),
with a separate sequence for each probe. The positions are uniformly distributed over the disk, and so are the
logarithms of their forces over the range of forces. A sweep is a simulation of many presses. If it has several probes,
successive presses cycle through the probes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import SceneError
from isocharge.simulate.sensor.footprint import Probe

MAX_SAMPLES = 10_000_000
"""Largest number of presses of a sweep. The files of a dataset with so many presses occupy about 600 MB."""

FULL_TURN = 2.0 * np.pi
"""Angle of a full turn, rad."""

SAMPLING = "scrambled Sobol, uniform over the disk, log-uniform in force"
"""Description of the sampling in the manifest of a dataset."""

OUTSIDE_PROBE = -1
"""Index of the round probe of the presses outside the disk, which is the last of all probes."""

Orientation = Literal["fixed", "random"]
"""Whether all presses have the given orientation of the probe, or each press has a random orientation."""


@dataclass(frozen=True)
class SweepPresses:
    """Presses of a sweep, which is a simulation of many presses.

    Attributes:
        probe: Index of the probe of each press, shape (n,); `OUTSIDE_PROBE` for a press outside the disk of the sweep.
        contact: Contact (x, y, F) of each press, shape (n, 3), mm and N.
        rotation: Rotation of the probe in addition to its own orientation, anticlockwise, shape (n,), rad.
    """

    probe: Integers
    contact: Array
    rotation: Array

    def __len__(self) -> int:
        return self.probe.size

    @property
    def is_outside(self) -> Booleans:
        """Whether each press lies outside the disk of the sweep, shape (n,)."""
        return np.asarray(self.probe == OUTSIDE_PROBE)

    def __getitem__(self, part: slice | Integers) -> "SweepPresses":
        """Return the presses that a slice or an array of indices selects."""
        return SweepPresses(self.probe[part], self.contact[part], self.rotation[part])


@dataclass(frozen=True)
class Sweep:
    """Definition of the presses of a sweep.

    Attributes:
        radius: Largest distance of a press from the centre, mm.
        force_range: Smallest and largest force, N.
        samples: Number of presses, which are divided equally among the probes.
        seed: Seed of the random numbers.
        orientation: "fixed" if all presses have the orientation of the given probes, "random" for orientations over a
            full turn.
        outside: Number of additional presses between the disk and the clamp; 0 for none.
    """

    radius: float = DEFAULT_RADIUS
    force_range: tuple[float, float] = DEFAULT_FORCE_RANGE
    samples: int = 20_000
    seed: int = 0
    orientation: Orientation = "fixed"
    outside: int = 16_384

    def __post_init__(self) -> None:
        """Check the definition of the sweep.

        Raises:
            SceneError: If a value is not allowed.
        """
        if not 0.0 < self.radius < np.inf:
            raise SceneError(f"radius: expected a positive number of mm, got {self.radius:g}")
        if not 1 <= self.samples <= MAX_SAMPLES:
            bound = "at least 1" if self.samples < 1 else f"at most {MAX_SAMPLES}"
            raise SceneError(f"samples: expected {bound}, got {self.samples}")
        if not 0 <= self.outside <= MAX_SAMPLES:
            raise SceneError(f"outside: expected 0 to {MAX_SAMPLES} presses outside the radius, got {self.outside}")
        min_force, max_force = self.force_range
        if not 0.0 < min_force <= max_force < np.inf:
            raise SceneError(f"force: expected 0 < smallest <= largest force in N, got {min_force:g} and {max_force:g}")
        if self.orientation not in get_args(Orientation):
            raise SceneError(f"orientation: expected 'fixed' or 'random', got {self.orientation!r}")

    def contacts(self) -> Array:
        """Return the contacts (x, y, F) of a sweep with one probe, shape (n, 3), mm and N."""
        return self._draw(self.samples, 0).contact

    def outside_presses(self, outer_radius: float) -> SweepPresses:
        """Return presses between the disk of the sweep and a larger circle.

        The positions are uniformly distributed over the ring, and the logarithms of the forces over the range of
        forces.

        Args:
            outer_radius: Radius of the larger circle, mm.
        """
        distance_fraction, angle_fraction, force_fraction, _ = self._unit_cube(self.outside, 0, 1).T
        # The area within a distance is proportional to the square of the distance.
        distance = np.sqrt(self.radius**2 + (outer_radius**2 - self.radius**2) * distance_fraction)
        angle = FULL_TURN * angle_fraction
        force = self._force(force_fraction)
        contact = np.stack([distance * np.cos(angle), distance * np.sin(angle), force], axis=1)
        return SweepPresses(np.full(self.outside, OUTSIDE_PROBE), contact, np.zeros(self.outside))

    def over(self, probes: Sequence[Probe]) -> SweepPresses:
        """Return the presses of a sweep with several probes.

        Successive presses cycle through the probes.

        Args:
            probes: Probes of the sweep.

        Raises:
            SceneError: If there are no probes.
        """
        if not probes:
            raise SceneError("probes: expected at least one, got none")
        # Successive presses belong to successive probes, each of which has a sequence of points of its own.
        n_probe = len(probes)
        presses = SweepPresses(
            np.empty(self.samples, dtype=np.intp), np.empty((self.samples, 3)), np.empty(self.samples)
        )
        for index in range(n_probe):
            own = slice(index, None, n_probe)
            drawn = self._draw(len(range(index, self.samples, n_probe)), index)
            presses.probe[own] = drawn.probe
            presses.contact[own] = drawn.contact
            presses.rotation[own] = drawn.rotation
        return presses

    def _draw(self, count: int, probe_index: int) -> SweepPresses:
        """Draw the presses of one probe.

        The positions are uniformly distributed over the disk. The logarithms of the forces are uniformly distributed
        over the range of forces. The rotations are uniformly distributed over a full turn, or zero if the orientation
        is "fixed".

        Args:
            count: Number of presses.
            probe_index: Index of the probe in the sweep.
        """
        fractions = self._unit_cube(count, probe_index)
        distance_fraction, angle_fraction, force_fraction, rotation_fraction = fractions.T
        distance = self.radius * np.sqrt(distance_fraction)  # the area within a distance is proportional to its square
        position = distance * np.exp(1j * FULL_TURN * angle_fraction)
        rotation = FULL_TURN * rotation_fraction if self.orientation == "random" else np.zeros(count)
        contact = np.stack([position.real, position.imag, self._force(force_fraction)], axis=1)
        return SweepPresses(np.full(count, probe_index), contact, rotation)

    def _unit_cube(self, count: int, *stream: int) -> Array:
        """Draw points that are uniformly distributed over the unit cube in four dimensions.

        Args:
            count: Number of points.
            stream: Numbers that select a sequence of random numbers: the index of a probe, or 0 and 1 for the presses
                outside the disk.

        Returns:
            Points, shape (count, 4), with coordinates from 0 to 1. The coordinates are for the distance, the angle, the
            force and the rotation of a press.
        """
        rng = np.random.default_rng([self.seed, *stream])
        # A Sobol sequence is balanced if the number of points is a power of two. Draw the next larger power of two, and
        # use the first `count` points. A probe may have no presses if there are more probes than presses.
        log2_count = int(np.ceil(np.log2(max(count, 2))))
        points = scipy.stats.qmc.Sobol(4, rng=rng).random_base2(log2_count)
        return np.asarray(points[:count])

    def _force(self, fraction: Array) -> Array:
        """Convert numbers from 0 to 1 into forces by linear interpolation of the logarithm of the force.

        Args:
            fraction: Fractions from 0 (smallest force) to 1 (largest force), shape (n,).

        Returns:
            Forces, shape (n,), N.
        """
        min_log_force, max_log_force = np.log(self.force_range)
        force = np.exp(min_log_force + (max_log_force - min_log_force) * fraction)
        return np.asarray(np.clip(force, *self.force_range))  # rounding must not move a force out of the range
