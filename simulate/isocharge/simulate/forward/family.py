"""A family of presses of one probe: where it is solved, and how presses between are interpolated."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.common.progress import track
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.film_grid import FilmGrid
from isocharge.simulate.mechanics.stress import rotate_stress
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Circle, Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium, nodal_stress
from isocharge.simulate.solver.load_case import SolveSettings, check_press
from isocharge.simulate.solver.press import press

ROTATIONS = 7
"""Smallest number of orientations: only the first harmonics of the rim, far from the probe, reach the probe."""


@dataclass(frozen=True)
class Family:
    """Nodes at which a family of presses is solved.

    Attributes:
        domain: The presses that it covers.
        distance: Distances from the centre, Chebyshev nodes, shape (n_distance,), mm.
        force: Forces, Chebyshev nodes in the logarithm, shape (n_force,), N.
        rotation: Of the probe against the direction of the press, evenly spread over a turn, shape (n_rotation,), rad.
        folds: Order of the probe's rotational symmetry: how often it maps onto itself in a full turn.
    """

    domain: Domain
    distance: Array
    force: Array
    rotation: Array
    folds: int

    @classmethod
    def spread(cls, domain: Domain, count: tuple[int, int], period: float, rotations: int = ROTATIONS) -> "Family":
        """Nodes for a probe.

        Args:
            domain: The presses to cover.
            count: Number of distances and of forces.
            period: Angle after which the probe looks the same, rad; 0 for a round one.
            rotations: Smallest number of orientations.
        """
        low, high = np.log(domain.force_range)
        force = np.exp(chebyshev_nodes(count[1], low, high)) if high > low else np.array([domain.force_range[0]])
        folds = round(2.0 * np.pi / period) if period > 0.0 else 1
        n_rotation = folds * (-(-rotations // folds)) if period > 0.0 else 1
        rotation = 2.0 * np.pi * np.arange(n_rotation) / n_rotation
        return cls(domain, chebyshev_nodes(count[0], 0.0, domain.radius), force, rotation, folds)

    @property
    def solved_rotations(self) -> Array:
        """Orientations that must be solved: one period of the probe."""
        return self.rotation[: self.rotation.size // self.folds]

    def weights(self, distance: Array, force: Array, rotation: Array) -> Array:
        """Interpolation weights for presses, shape (n, n_distance * n_force * n_rotation)."""
        by_distance = lagrange_values(self.distance, barycentric_weights(self.distance), distance)
        logs = np.log(self.force)
        by_force = lagrange_values(logs, barycentric_weights(logs), np.log(force))
        both = by_distance[:, :, None, None] * by_force[:, None, :, None]
        return np.asarray((both * self._by_rotation(rotation)[:, None, None, :]).reshape(distance.size, -1))

    def _by_rotation(self, rotation: Array) -> Array:
        """Trigonometric interpolation on an even spread: each weight is a Dirichlet kernel, shape (n, n_rotation)."""
        count = self.rotation.size
        harmonics = np.arange(1, count // 2 + 1)
        factor = np.where(2 * harmonics == count, 1.0, 2.0)  # an even spread does not see the highest one's sine
        phase = (rotation[:, None] - self.rotation)[..., None] * harmonics
        return np.asarray((1.0 + np.cos(phase) @ factor) / count)

    def solve(self, sensor: Sensor, probe: Probe, settings: SolveSettings, executor: Executor | None) -> Array:
        """Scaled stress at the nodes, as `unfold` takes it: (n_distance, n_solved_rotation, n_force, ...).

        The settings give theory, mesh and width of the thin rings, the same for all members.
        """
        chains = [
            Chain(sensor.film, probe.rotated(float(rotation)), float(distance), self.force, sensor.surface, settings)
            for distance in self.distance
            for rotation in self.solved_rotations
        ]
        solved = solve_chains(chains, executor)
        return solved.reshape(self.distance.size, self.solved_rotations.size, self.force.size, -1)

    def unfold(self, solved: Array, mesh: Template) -> Array:
        """Fields of all orientations from those that were solved, each node in its rotated place.

        Args:
            solved: Shape (n_distance, n_solved_rotation, n_force, n_element * n_local * 3), in the probe's frame.
            mesh: Their template.

        Returns:
            Shape (n_distance * n_force * n_rotation, n_element * n_local * 3), ordered as `weights`.
        """
        n_distance, n_rotation, n_force, _ = solved.shape
        field = np.moveaxis(solved, 1, 2).reshape(n_distance, n_force, n_rotation, mesh.n_element, -1, 3)
        parts = [
            rotate_stress(field[..., mesh.rotated(fold, self.folds), :, :], -2.0 * np.pi * fold / self.folds)
            for fold in range(self.folds)
        ]
        return np.asarray(np.concatenate(parts, axis=2).reshape(-1, solved.shape[-1]))

    def probes_between(self, count: int) -> Iterator[tuple[float, float, float, float]]:
        """Presses to check the interpolation with: between the nodes and, last, at the edge of the family.

        Yields:
            Distance (mm), angle (rad), force (N) and orientation (rad).
        """
        shares = np.sqrt(chebyshev_nodes(count - 1, 0.0, 1.0))
        low, high = np.log(self.domain.force_range)
        for number, share in enumerate([*shares, 1.0]):
            force = np.clip(np.exp(low + (high - low) * ((0.5 + 0.618 * number) % 1.0)), *self.domain.force_range)
            yield float(self.domain.radius * share), 2.4 * number, float(force), 0.7 * number


def check_family(film: Film, probe: Probe, domain: Domain) -> None:
    """Refuse domains that hold presses which cannot exist.

    Raises:
        SceneError: If radius or forces are no positive numbers, or the outermost or strongest press cannot exist.
    """
    radius, (low, high) = domain.radius, domain.force_range
    if not (0.0 < low <= high and np.isfinite(high)):
        raise SceneError(f"force range: expected 0 < MIN <= MAX in N, got {low} to {high}")
    if not (np.isfinite(radius) and radius > 0.0):
        raise SceneError(f"radius: expected a positive number, got {radius} mm")
    if not film.is_axisymmetric:
        raise SceneError(
            f"film: expected an axisymmetric film, got {film.asymmetries}: a forward map computes charges of presses "
            "in all directions from presses along one radius; use `press` or `isocharge simulate point` for this film"
        )
    if radius + probe.reach >= film.radius:
        raise SceneError(
            f"radius: presses up to {radius:.4g} mm from the centre with {probe.notation}, which reaches "
            f"{probe.reach:.4g} mm, leave the film of radius {film.radius:.4g} mm"
        )
    check_press(film, probe, (radius, 0.0), high)


@dataclass(frozen=True)
class Chain:
    """Presses on one film at one place that differ by their forces; each is solved from the one before.

    Attributes:
        film: The film.
        probe: The footprint, rotated as it is.
        distance: Of its centroid from the centre, mm.
        forces: N, in their order.
        surface: Where in the thickness the stress is read.
        settings: Theory, mesh and width of the thin rings.
        read: What is wanted of each: stresses at the nodes, shape (..., 3).
    """

    film: Film
    probe: Probe
    distance: float
    forces: Array
    surface: Surface
    settings: SolveSettings
    read: Callable[[Equilibrium, Surface], Array] = nodal_stress


def solve_chains(chains: Sequence[Chain], executor: Executor | None) -> Array:
    """What each chain reads at the nodes, seen from the probe, shape (n_chain, n_force, its size)."""
    return np.stack(list(track(in_order(executor, _solve_chain, chains), "solving the film", len(chains))))


def solve_films(
    film: Film,
    surface: Surface,
    grid: FilmGrid,
    settings: SolveSettings,
    executor: Executor | None,
    read: Callable[[Equilibrium, Surface], Array] = nodal_stress,
) -> Array:
    """What presses of round probes read on the films of a grid, of the radius and Young's modulus of one of them.

    Returns:
        What `read` gives at the nodes of the template, shape (*grid.shape, its size).
    """
    a, chains = film.radius, []
    for distance, tension, thickness, reach in product(grid.distance, grid.tension, grid.thickness, grid.reach):
        other = replace(film, pretension=float(tension) * film.young, thickness=float(thickness) * a)
        forces = grid.load[::-1] * film.young * other.thickness * a
        chains.append(Chain(other, Circle(float(reach) * a), float(distance) * a, forces, surface, settings, read))
    rows = solve_chains(chains, executor)[:, ::-1]
    by_axis = rows.reshape(*(grid.shape[axis] for axis in (0, 2, 3, 4, 1)), -1)
    return np.moveaxis(by_axis, 4, 1)


def _solve_chain(chain: Chain) -> Array:
    start: Equilibrium | None = None
    rows = []
    for force in chain.forces.tolist():
        start = press(chain.film, chain.probe, (chain.distance, 0.0), force, chain.settings, start=start)
        rows.append(rotate_stress(chain.read(start, chain.surface), -chain.probe.angle).ravel())
    return np.stack(rows)
