"""A family of presses of one probe: the presses that are solved, and the interpolation between them."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.common.progress import track
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.film_grid import FilmGrid
from isocharge.simulate.mechanics.stress import rotate_stress
from isocharge.simulate.mesh.conformal_map import distance_coordinate
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Circle, Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium, nodal_stress
from isocharge.simulate.solver.load_case import SolveSettings, check_press
from isocharge.simulate.solver.press import press

ROTATIONS = 7
"""Smallest number of orientations. The influence of the distant rim on the probe has only a few harmonics."""


@dataclass(frozen=True)
class Family:
    """Nodes at which a family of presses is solved.

    Attributes:
        domain: Presses that the family covers.
        film_radius: Radius of the film, mm.
        distance: Distances from the centre, at Chebyshev nodes in `distance_coordinate`, shape (n_distance,), mm.
        force: Forces, at Chebyshev nodes in the logarithm, shape (n_force,), N.
        rotation: Rotations of the probe relative to the direction of the press, evenly spaced over a full turn, shape
            (n_rotation,), rad.
        folds: Order of the rotational symmetry of the probe: the number of periods in a full turn.
    """

    domain: Domain
    film_radius: float
    distance: Array
    force: Array
    rotation: Array
    folds: int

    @classmethod
    def spread(
        cls, domain: Domain, film_radius: float, count: tuple[int, int], period: float, rotations: int = ROTATIONS
    ) -> "Family":
        """Distribute the nodes for a probe.

        Args:
            domain: Presses to cover.
            film_radius: Radius of the film, mm.
            count: Number of distances and number of forces.
            period: Smallest rotation that maps the probe onto itself, rad; 0 for an axisymmetric probe.
            rotations: Smallest number of orientations of a probe that is not axisymmetric.

        Returns:
            The family. It has a single force if the range of forces is a single value.
        """
        distance_count, force_count = count
        min_log, max_log = np.log(domain.force_range)
        force = np.array([domain.force_range[0]])
        if max_log > min_log:
            force = np.exp(chebyshev_nodes(force_count, min_log, max_log))

        # The rotations cover a full turn, with the same number of rotations in each period of the probe.
        folds = 1
        n_rotation = 1
        if period > 0.0:
            folds = round(2.0 * np.pi / period)
            n_rotation = folds * math.ceil(rotations / folds)
        rotation = 2.0 * np.pi * np.arange(n_rotation) / n_rotation

        largest_coordinate = float(distance_coordinate(domain.radius / film_radius))
        distance = film_radius * np.tanh(chebyshev_nodes(distance_count, 0.0, largest_coordinate))
        return cls(domain, film_radius, distance, force, rotation, folds)

    @property
    def solved_rotations(self) -> Array:
        """Orientations that must be solved, which cover one period of the probe, rad."""
        return self.rotation[: self.rotation.size // self.folds]

    def weights(self, distance: Array, force: Array, rotation: Array) -> Array:
        """Compute the weights of the nodes for the interpolation to presses.

        Args:
            distance: Distances from the centre, shape (n,), mm.
            force: Forces, shape (n,), N.
            rotation: Rotations of the probe relative to the direction of the press, shape (n,), rad.

        Returns:
            Shape (n, n_distance * n_force * n_rotation).
        """
        nodes = distance_coordinate(self.distance / self.film_radius)
        at = distance_coordinate(distance / self.film_radius)
        distance_weights = lagrange_values(nodes, barycentric_weights(nodes), at)
        log_force = np.log(self.force)
        force_weights = lagrange_values(log_force, barycentric_weights(log_force), np.log(force))
        products = distance_weights[:, :, None, None] * force_weights[:, None, :, None]
        rotation_weights = self._rotation_weights(rotation)[:, None, None, :]
        return np.asarray((products * rotation_weights).reshape(distance.size, -1))

    def _rotation_weights(self, rotation: Array) -> Array:
        """Compute the weights of trigonometric interpolation (Dirichlet kernels), shape (n, n_rotation)."""
        count = self.rotation.size
        harmonics = np.arange(1, count // 2 + 1)
        factor = np.where(2 * harmonics == count, 1.0, 2.0)  # the sine of the highest harmonic is zero at all nodes
        phase = (rotation[:, None] - self.rotation)[..., None] * harmonics
        return np.asarray((1.0 + np.cos(phase) @ factor) / count)

    def solve(self, sensor: Sensor, probe: Probe, settings: SolveSettings, executor: Executor | None) -> Array:
        """Solve the presses of the family.

        Args:
            sensor: The sensor.
            probe: The probe.
            settings: Theory, mesh and width of the thin rings, which are the same for all presses.
            executor: Executor that runs the solves; None for this process.

        Returns:
            Scaled stress at the nodes of the mesh, shape
            (n_distance, n_solved_rotation, n_force, n_element * n_local * 3), which is the argument of `unfold`.
        """
        chains = [
            Chain(sensor.film, probe.rotated(float(rotation)), float(distance), self.force, sensor.surface, settings)
            for distance in self.distance
            for rotation in self.solved_rotations
        ]
        solved = solve_chains(chains, executor)
        return solved.reshape(self.distance.size, self.solved_rotations.size, self.force.size, -1)

    def unfold(self, solved: Array, mesh: Template) -> Array:
        """Compute the fields of all orientations from the solved orientations, by the symmetry of the probe.

        Args:
            solved: Scaled stress in a frame that rotates with the probe, shape
                (n_distance, n_solved_rotation, n_force, n_element * n_local * 3).
            mesh: Template of the mesh.

        Returns:
            Shape (n_distance * n_force * n_rotation, n_element * n_local * 3), in the order of `weights`.
        """
        n_distance, n_rotation, n_force, _ = solved.shape
        field = np.moveaxis(solved, 1, 2).reshape(n_distance, n_force, n_rotation, mesh.n_element, -1, 3)
        parts = [
            rotate_stress(field[..., mesh.rotated(fold, self.folds), :, :], -2.0 * np.pi * fold / self.folds)
            for fold in range(self.folds)
        ]
        return np.asarray(np.concatenate(parts, axis=2).reshape(-1, solved.shape[-1]))


class CheckPress(NamedTuple):
    """A press at which the interpolation of a family is compared with a direct solve.

    Attributes:
        distance: Distance from the centre, mm.
        angle: Direction from the centre, rad.
        force: Force, N.
        rotation: Further rotation of the probe, rad.
    """

    distance: float
    angle: float
    force: float
    rotation: float

    @property
    def position(self) -> tuple[float, float]:
        """Position (x, y), mm."""
        return self.distance * math.cos(self.angle), self.distance * math.sin(self.angle)


def check_presses(domain: Domain, count: int) -> list[CheckPress]:
    """Return presses that cover the distances and forces of a domain. The last press lies at the largest distance.

    Args:
        domain: Presses that a family covers.
        count: Number of presses.
    """
    distance_shares = np.sqrt(chebyshev_nodes(count - 1, 0.0, 1.0))
    min_log, max_log = np.log(domain.force_range)
    presses = []
    for index, distance_share in enumerate([*distance_shares, 1.0]):
        # Multiples of the golden ratio, modulo 1, distribute the logarithms of the forces evenly.
        force_share = (0.5 + 0.618 * index) % 1.0
        force = np.clip(np.exp(min_log + (max_log - min_log) * force_share), *domain.force_range)
        distance = float(domain.radius * distance_share)
        presses.append(CheckPress(distance, angle=2.4 * index, force=float(force), rotation=0.7 * index))
    return presses


def check_family(film: Film, probe: Probe, domain: Domain) -> None:
    """Raise an error if some presses of a domain cannot exist.

    Args:
        film: The film.
        probe: The probe.
        domain: The presses.

    Raises:
        SceneError: If the radius or the forces are not positive numbers, if the film is not axisymmetric, or if the
            outermost press with the largest force cannot exist.
    """
    radius = domain.radius
    low, high = domain.force_range
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


Reading = Callable[[Equilibrium, Surface], Array]
"""Function that computes values of a solved press, such as the stresses at a surface in the thickness, any shape."""


def probe_frame_stress(solved: Equilibrium, surface: Surface) -> Array:
    """Compute the scaled touch stress at the nodes in a frame that rotates with the probe.

    Args:
        solved: The solved press.
        surface: Surface in the thickness; see `touch_stress`.

    Returns:
        (S11, S22, S12) in units of E_young A^2, shape (n_element, n_local, 3).
    """
    return rotate_stress(nodal_stress(solved, surface), -solved.probe.angle)


@dataclass(frozen=True)
class Chain:
    """Presses on one film at one position with different forces. Each solve starts from the equilibrium before.

    Attributes:
        film: The film.
        probe: The probe, with its rotation.
        distance: Distance of the centroid of the footprint from the centre of the film, mm.
        forces: Forces in the order in which they are solved, shape (n_force,), N.
        surface: Surface in the thickness at which the stress is read.
        settings: Theory, mesh and width of the thin rings.
        read: Function that computes the values of each press.
    """

    film: Film
    probe: Probe
    distance: float
    forces: Array
    surface: Surface
    settings: SolveSettings
    read: Reading = probe_frame_stress


def solve_chains(chains: Sequence[Chain], executor: Executor | None) -> Array:
    """Solve chains of presses.

    Args:
        chains: The chains, which have the same mesh and number of forces.
        executor: Executor that runs the chains; None for this process.

    Returns:
        Values that `Chain.read` computes, shape (n_chain, n_force, n_value).
    """
    return np.stack(list(track(in_order(executor, _solve_chain, chains), "solving the film", len(chains))))


def solve_films(
    film: Film,
    surface: Surface,
    grid: FilmGrid,
    settings: SolveSettings,
    executor: Executor | None,
    read: Reading = probe_frame_stress,
) -> Array:
    """Solve presses with circular probes on the films of a grid.

    Args:
        film: Film whose radius, Young's modulus and Poisson's ratio all films have.
        surface: Surface in the thickness at which the stress is read.
        grid: Grid of distances, loads, pretensions, thicknesses and probe radii.
        settings: Theory, mesh and width of the thin rings.
        executor: Executor that runs the solves; None for this process.
        read: Function that computes the values of each press.

    Returns:
        Values that `read` computes, shape (*grid.shape, n_value).
    """
    radius = film.radius
    chains = []
    for distance, tension, thickness, reach in product(grid.distance, grid.tension, grid.thickness, grid.reach):
        grid_film = replace(film, pretension=float(tension) * film.young, thickness=float(thickness) * radius)
        forces = grid.load[::-1] * film.young * grid_film.thickness * radius  # from the largest force on
        probe = Circle(float(reach) * radius)
        chains.append(Chain(grid_film, probe, float(distance) * radius, forces, surface, settings, read))
    rows = solve_chains(chains, executor)[:, ::-1]
    by_axis = rows.reshape(*(grid.shape[axis] for axis in (0, 2, 3, 4, 1)), -1)
    return np.moveaxis(by_axis, 4, 1)


def _solve_chain(chain: Chain) -> Array:
    """Solve one chain, and return the values of its presses, shape (n_force, n_value)."""
    start: Equilibrium | None = None
    rows = []
    for force in chain.forces.tolist():
        start = press(chain.film, chain.probe, (chain.distance, 0.0), force, chain.settings, start=start)
        rows.append(chain.read(start, chain.surface).ravel())
    return np.stack(rows)
