"""Where the presses of a sweep lie: spread over probes, the disk, the forces and, if asked, the orientations.

    sobol   scrambled Sobol points: fewer gaps and clumps than independent draws (Owen 1998); each probe has its own
    random  independent draws
    grid    every force at every orientation at every place of a square lattice: no more presses than asked for

Sobol and random presses are uniform over the disk and in the logarithm of the force; the probes take turns.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import SceneError
from isocharge.simulate.numerics.disk import lattice
from isocharge.simulate.sensor.probe import Probe

MOST_SAMPLES = 10_000_000
"""Largest sweep: about 600 MB on disk."""

FULL_TURN = 2.0 * np.pi

PLANS = {
    "sobol": "scrambled Sobol, uniform over the disk, log-uniform in force",
    "random": "independent, uniform over the disk, log-uniform in force",
    "grid": "grid: square lattice over the disk, forces in equal steps of the logarithm, evenly spread orientations",
}
"""What the manifest says of a sampling."""

Sampling = Literal["sobol", "random", "grid"]

Orientation = Literal["fixed", "random"]


@dataclass(frozen=True)
class SweepPresses:
    """Presses of a sweep, in its order.

    Attributes:
        probe: Number of the probe, shape (n,).
        contact: (x, y, F), shape (n, 3), mm and N.
        rotation: Angle by which the probe is turned against its notation, shape (n,), rad.
    """

    probe: Integers
    contact: Array
    rotation: Array

    def __len__(self) -> int:
        return self.probe.size

    def __getitem__(self, part: slice | Integers) -> "SweepPresses":
        return SweepPresses(self.probe[part], self.contact[part], self.rotation[part])


@dataclass(frozen=True)
class Sweep:
    """What to sample.

    Attributes:
        radius: Largest distance of a press from the centre, mm.
        force_range: Smallest and largest force, N.
        samples: Number of presses, shared equally among the probes; a grid may have fewer, see `sampling`.
        seed: Seed of the sequence; a grid uses none.
        orientation: "fixed" (as the probe is given) or "random": spread over a full turn, or, in a grid, evenly over
            the turn after which the probe looks the same.
        sampling: "sobol", "random" or "grid".
    """

    radius: float = DEFAULT_RADIUS
    force_range: tuple[float, float] = DEFAULT_FORCE_RANGE
    samples: int = 20_000
    seed: int = 0
    orientation: Orientation = "fixed"
    sampling: Sampling = "sobol"

    def __post_init__(self) -> None:
        if not 0.0 < self.radius < np.inf:
            raise SceneError(f"radius: expected a positive number of mm, got {self.radius:g}")
        if not 1 <= self.samples <= MOST_SAMPLES:
            bound = "at least 1" if self.samples < 1 else f"at most {MOST_SAMPLES}"
            raise SceneError(f"samples: expected {bound}, got {self.samples}")
        low, high = self.force_range
        if not 0.0 < low <= high < np.inf:
            raise SceneError(f"force: expected 0 < smallest <= largest force in N, got {low:g} and {high:g}")
        if self.orientation not in get_args(Orientation):
            raise SceneError(f"orientation: expected 'fixed' or 'random', got {self.orientation!r}")
        if self.sampling not in get_args(Sampling):
            raise SceneError(f"sampling: expected 'sobol', 'random' or 'grid', got {self.sampling!r}")

    def contacts(self) -> Array:
        """(x, y, F) of every press of a sweep with one probe, shape (n, 3), mm and N."""
        return self._of_probe(0, 1, FULL_TURN).contact

    def over(self, probes: Sequence[Probe]) -> SweepPresses:
        """Every press of a sweep with these probes, which take turns.

        Raises:
            SceneError: If there are no probes, or a grid has fewer samples than probes.
        """
        if not probes:
            raise SceneError("probes: expected at least one, got none")
        if self.sampling == "grid" and self.samples < len(probes):
            raise SceneError(f"samples: expected at least one for each of {len(probes)} probes, got {self.samples}")
        parts = [self._of_probe(number, len(probes), probe.period) for number, probe in enumerate(probes)]
        order = np.argsort(np.concatenate([np.arange(len(part)) for part in parts]), kind="stable")
        columns = ([getattr(part, name) for part in parts] for name in ("probe", "contact", "rotation"))
        return SweepPresses(*(np.concatenate(column) for column in columns))[order]

    def _of_probe(self, number: int, probes: int, period: float) -> SweepPresses:
        if self.sampling == "grid":
            at, force, rotation = self._grid(self.samples // probes, period)
        else:
            unit = self._unit(len(range(number, self.samples, probes)), number)
            at = self.radius * np.sqrt(unit[:, 0]) * np.exp(1j * FULL_TURN * unit[:, 1])
            force = self._force(unit[:, 2])
            rotation = FULL_TURN * unit[:, 3] if self.orientation == "random" else np.zeros(len(unit))
        return SweepPresses(np.full(at.size, number), np.stack([at.real, at.imag, force], axis=1), rotation)

    def _unit(self, count: int, number: int) -> Array:
        """Points of the unit cube (distance, angle, force, rotation), shape (count, 4)."""
        rng = np.random.default_rng([self.seed, number])
        if self.sampling == "random":
            return rng.random((count, 4))
        bits = int(np.ceil(np.log2(max(count, 2))))
        return np.asarray(scipy.stats.qmc.Sobol(4, rng=rng).random_base2(bits)[:count])

    def _force(self, share: Array) -> Array:
        """Forces (N) at shares of the range in ln F."""
        low, high = np.log(self.force_range)
        return np.asarray(np.clip(np.exp(low + (high - low) * share), *self.force_range))

    def _grid(self, most: int, period: float) -> tuple[Complexes, Array, Array]:
        """At most `most` positions, forces and rotations: equal numbers of steps in each direction, then all forces
        that still fit."""
        forces, rotations = self.force_range[0] < self.force_range[1], self.orientation == "random" and period > 0.0
        side = max(1, round(most ** (1.0 / (2 + forces + rotations))))
        n_rotation = side if rotations else 1
        place: Complexes = self.radius * lattice(most // (n_rotation * (side if forces else 1)))
        n_force = most // (place.size * n_rotation) if forces else 1
        force = self._force(np.linspace(0.0, 1.0, n_force) if n_force > 1 else np.array([0.5]))
        rotation: Array = period * np.arange(n_rotation) / n_rotation
        at, pushed, rotated = np.indices((place.size, n_force, n_rotation)).reshape(3, -1)
        return place[at], force[pushed], rotation[rotated]
