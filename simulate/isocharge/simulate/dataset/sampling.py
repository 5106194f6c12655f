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
from scipy.stats import qmc

from isocharge.common.arrays import Array, Integers
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import SceneError
from isocharge.simulate.numerics.disk import lattice
from isocharge.simulate.sensor.probe import Probe

MOST_SAMPLES = 10_000_000
"""Largest sweep: about 600 MB on disk."""

FULL_TURN = 2.0 * np.pi

Sampling = Literal["sobol", "random", "grid"]

Orientation = Literal["fixed", "random"]


@dataclass(frozen=True)
class SweepPresses:
    """Presses of a sweep, in its order.

    Attributes:
        probe: Number of the probe, shape (n,).
        x: Position along the drawn direction, shape (n,), m.
        y: Position across it, shape (n,), m.
        force: Shape (n,), N.
        turn: How far the probe is turned further, shape (n,), rad.
    """

    probe: Integers
    x: Array
    y: Array
    force: Array
    turn: Array

    def __len__(self) -> int:
        return self.x.size

    def __getitem__(self, part: slice | Integers) -> "SweepPresses":
        return SweepPresses(self.probe[part], self.x[part], self.y[part], self.force[part], self.turn[part])


@dataclass(frozen=True)
class Sweep:
    """What to sample.

    Attributes:
        radius: Largest distance of a press from the centre, m.
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

    def presses(self) -> tuple[Array, Array, Array, Array]:
        """x, y (m), force (N) and orientation (rad) of every sample of a sweep with one probe, each of shape (n,)."""
        return self._of_probe(0, 1, FULL_TURN)

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
        counts = [part[0].size for part in parts]
        order = np.argsort(np.concatenate([np.arange(count) for count in counts]), kind="stable")
        x, y, force, turn = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return SweepPresses(np.repeat(np.arange(len(probes)), counts), x, y, force, turn)[order]

    def _of_probe(self, number: int, probes: int, period: float) -> tuple[Array, Array, Array, Array]:
        if self.sampling == "grid":
            return self._grid(self.samples // probes, period)
        unit = self._unit(len(range(number, self.samples, probes)), number)
        distance, angle = self.radius * np.sqrt(unit[:, 0]), FULL_TURN * unit[:, 1]
        turn = FULL_TURN * unit[:, 3] if self.orientation == "random" else np.zeros(len(unit))
        return distance * np.cos(angle), distance * np.sin(angle), self._force(unit[:, 2]), turn

    def _unit(self, count: int, number: int) -> Array:
        """Points of the unit cube (distance, angle, force, turn), shape (count, 4)."""
        rng = np.random.default_rng([self.seed, number])
        if self.sampling == "random":
            return rng.random((count, 4))
        bits = int(np.ceil(np.log2(max(count, 2))))
        unit: Array = qmc.Sobol(4, rng=rng).random_base2(bits)[:count]
        return unit

    def _force(self, share: Array) -> Array:
        """Forces (N) at shares of the range in ln F."""
        low, high = np.log(self.force_range)
        force: Array = np.clip(np.exp(low + (high - low) * share), *self.force_range)
        return force

    def _grid(self, most: int, period: float) -> tuple[Array, Array, Array, Array]:
        """At most `most` presses: equal numbers of steps in each direction, then all forces that still fit."""
        forces, turns = self.force_range[0] < self.force_range[1], self.orientation == "random" and period > 0.0
        side = max(1, round(most ** (1.0 / (2 + forces + turns))))
        n_turn = side if turns else 1
        place = self.radius * lattice(most // (n_turn * (side if forces else 1)))
        n_force = most // (place.size * n_turn) if forces else 1
        force = self._force(np.linspace(0.0, 1.0, n_force) if n_force > 1 else np.array([0.5]))
        turn = period * np.arange(n_turn) / n_turn
        at, pushed, turned = (axis.ravel() for axis in np.meshgrid(place, force, turn, indexing="ij"))
        return at.real, at.imag, pushed, turned
