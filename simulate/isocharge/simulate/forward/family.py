"""A family of presses of one probe: where it is solved, and how presses between are interpolated."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.stress import turn_stress
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values

TURNS = 7
"""Smallest number of orientations: only the first harmonics of the rim, far from the probe, reach the probe."""


@dataclass(frozen=True)
class Family:
    """Nodes at which a family of presses is solved.

    Attributes:
        radius: Largest distance from the centre, m.
        force_range: Smallest and largest force, N.
        distance: Distances from the centre, Chebyshev nodes, shape (n_distance,), m.
        force: Forces, Chebyshev nodes in the logarithm, shape (n_force,), N.
        turn: Orientations against the direction of the press, evenly spread over a full turn, shape (n_turn,), rad.
        folds: Order of the probe's rotational symmetry: how often it maps onto itself in a full turn.
    """

    radius: float
    force_range: tuple[float, float]
    distance: Array
    force: Array
    turn: Array
    folds: int

    @classmethod
    def spread(
        cls,
        radius: float,
        force_range: tuple[float, float],
        count: tuple[int, int],
        period: float,
        turns: int = TURNS,
    ) -> "Family":
        """Nodes for a probe.

        Args:
            radius: Largest distance from the centre, m.
            force_range: Smallest and largest force, N.
            count: Number of distances and of forces.
            period: Angle after which the probe looks the same, rad; 0 for a round one.
            turns: Smallest number of orientations.
        """
        low, high = np.log(force_range)
        force = np.exp(chebyshev_nodes(count[1], low, high)) if high > low else np.array([force_range[0]])
        folds = round(2.0 * np.pi / period) if period > 0.0 else 1
        n_turn = folds * (-(-turns // folds)) if period > 0.0 else 1
        turn = 2.0 * np.pi * np.arange(n_turn) / n_turn
        return cls(radius, force_range, chebyshev_nodes(count[0], 0.0, radius), force, turn, folds)

    @property
    def solved_turns(self) -> Array:
        """Orientations that must be solved: one period of the probe."""
        return self.turn[: self.turn.size // self.folds]

    def weights(self, distance: Array, force: Array, turn: Array) -> Array:
        """Interpolation weights for presses, shape (n, n_distance * n_force * n_turn)."""
        by_distance = lagrange_values(self.distance, barycentric_weights(self.distance), distance)
        logs = np.log(self.force)
        by_force = lagrange_values(logs, barycentric_weights(logs), np.log(force))
        both = by_distance[:, :, None, None] * by_force[:, None, :, None]
        weights: Array = (both * self._by_turn(turn)[:, None, None, :]).reshape(distance.size, -1)
        return weights

    def _by_turn(self, turn: Array) -> Array:
        """Trigonometric interpolation on an even spread: each weight is a Dirichlet kernel, shape (n, n_turn)."""
        harmonics = np.arange(1, (self.turn.size - 1) // 2 + 1)
        phase = (turn[:, None] - self.turn)[..., None] * harmonics
        kernel = 1.0 + 2.0 * np.cos(phase).sum(axis=-1)
        if self.turn.size % 2 == 0:
            kernel = kernel + np.cos(0.5 * self.turn.size * (turn[:, None] - self.turn))
        by_turn: Array = kernel / self.turn.size
        return by_turn

    def unfold(self, solved: Array, mesh: Template) -> Array:
        """Fields of all orientations from those that were solved, each node in its turned place.

        Args:
            solved: Shape (n_distance, n_solved_turn, n_force, n_element * n_local * 3), in the probe's frame.
            mesh: Their template.

        Returns:
            Shape (n_distance * n_force * n_turn, n_element * n_local * 3), ordered as `weights`.
        """
        n_distance, n_turn, n_force, _ = solved.shape
        field = np.moveaxis(solved, 1, 2).reshape(n_distance, n_force, n_turn, mesh.n_element, -1, 3)
        parts = [
            turn_stress(field[..., mesh.turned(fold, self.folds), :, :], -2.0 * np.pi * fold / self.folds)
            for fold in range(self.folds)
        ]
        unfolded: Array = np.concatenate(parts, axis=2).reshape(-1, solved.shape[-1])
        return unfolded

    def probes_between(self, count: int) -> Iterator[tuple[float, float, float, float]]:
        """Presses to check the interpolation with: between the nodes and, last, at the edge of the family.

        Yields:
            Distance (m), angle (rad), force (N) and orientation (rad).
        """
        shares = np.sqrt(chebyshev_nodes(count - 1, 0.0, 1.0))
        low, high = np.log(self.force_range)
        for number, share in enumerate([*shares, 1.0]):
            force = np.clip(np.exp(low + (high - low) * ((0.5 + 0.618 * number) % 1.0)), *self.force_range)
            yield float(self.radius * share), 2.4 * number, float(force), 0.7 * number
