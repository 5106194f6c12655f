"""Families of presses with one probe. The presses at the nodes are solved, and all other presses are interpolated."""

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
"""Smallest number of orientations of the probe.

A few orientations suffice, because the rim of the film is far from the probe, so that the stress depends on the
orientation through a few harmonics only.
"""


class NodeCount(NamedTuple):
    """Number of nodes of a family.

    Attributes:
        distances: Number of distances.
        forces: Number of forces.
        min_orientations: Smallest number of orientations.
    """

    distances: int
    forces: int
    min_orientations: int


NODE_COUNTS = (
    NodeCount(5, 3, ROTATIONS),
    NodeCount(8, 5, 2 * ROTATIONS),
    NodeCount(10, 7, 3 * ROTATIONS),
    NodeCount(13, 12, 3 * ROTATIONS),
)
"""Numbers of nodes that are tried one after the other.

The last entry is for films with a large pretension, whose charges change from one power of the force to another and
pass through zero.
"""


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
        symmetry_order: Order of the rotational symmetry of the probe: the number of rotations within a full turn that
            map the probe onto itself.
    """

    domain: Domain
    film_radius: float
    distance: Array
    force: Array
    rotation: Array
    symmetry_order: int

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
        n_distance, n_force = count

        # `tanh` is the inverse of `distance_coordinate`.
        largest_coordinate = float(distance_coordinate(domain.radius / film_radius))
        distance = film_radius * np.tanh(chebyshev_nodes(n_distance, 0.0, largest_coordinate))

        min_log_force, max_log_force = np.log(domain.force_range)
        if max_log_force > min_log_force:
            force = np.exp(chebyshev_nodes(n_force, min_log_force, max_log_force))
        else:
            force = np.array([domain.force_range[0]])

        # The rotations cover a full turn, with the same number of rotations in each period of the probe.
        symmetry_order = 1
        n_rotation = 1
        if period > 0.0:
            symmetry_order = round(2.0 * np.pi / period)
            n_rotation = symmetry_order * math.ceil(rotations / symmetry_order)
        rotation = 2.0 * np.pi * np.arange(n_rotation) / n_rotation
        return cls(domain, film_radius, distance, force, rotation, symmetry_order)

    @property
    def solved_rotations(self) -> Array:
        """Orientations that must be solved, which cover one period of the probe, rad."""
        return self.rotation[: self.rotation.size // self.symmetry_order]

    def weights(self, distance: Array, force: Array, rotation: Array) -> Array:
        """Compute the weights of the nodes for the interpolation to presses.

        The interpolation is polynomial in the distance coordinate and in the logarithm of the force (Lagrange), and
        trigonometric in the rotation.

        Args:
            distance: Distances from the centre, shape (n,), mm.
            force: Forces, shape (n,), N.
            rotation: Rotations of the probe relative to the direction of the press, shape (n,), rad.

        Returns:
            Weights, shape (n, n_distance * n_force * n_rotation). An interpolated value is the sum of the values at the
            nodes, multiplied by these weights.
        """
        distance_nodes = distance_coordinate(self.distance / self.film_radius)
        press_coordinates = distance_coordinate(distance / self.film_radius)
        distance_weights = lagrange_values(distance_nodes, barycentric_weights(distance_nodes), press_coordinates)
        force_nodes = np.log(self.force)
        force_weights = lagrange_values(force_nodes, barycentric_weights(force_nodes), np.log(force))
        rotation_weights = self._rotation_weights(rotation)

        # The weight of a node is the product of its weights along the axes (distance, force, rotation).
        distance_force_weights = distance_weights[:, :, None, None] * force_weights[:, None, :, None]
        node_weights = distance_force_weights * rotation_weights[:, None, None, :]
        return np.asarray(node_weights.reshape(distance.size, -1))

    def _rotation_weights(self, rotation: Array) -> Array:
        """Compute the weights of the rotation nodes for trigonometric interpolation.

        With N evenly spaced nodes, the weight of a node at the angular distance t is the Dirichlet kernel

            (1 + 2 cos(t) + 2 cos(2 t) + ...) / N

        with all harmonics up to N / 2. If N is even, the highest harmonic has the amplitude 1 in place of 2, because
        its sine is zero at all nodes.

        Args:
            rotation: Rotations of the probe relative to the direction of the press, shape (n,), rad.

        Returns:
            Weights, shape (n, n_rotation). The weights of each press sum to 1.
        """
        n_rotation = self.rotation.size
        harmonics = np.arange(1, n_rotation // 2 + 1)
        amplitudes = np.where(2 * harmonics == n_rotation, 1.0, 2.0)
        angle_from_node = rotation[:, None] - self.rotation  # shape (n, n_rotation)
        phase = angle_from_node[..., None] * harmonics  # shape (n, n_rotation, n_harmonic)
        return np.asarray((1.0 + np.cos(phase) @ amplitudes) / n_rotation)

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
        """Compute the stress of all orientations from that of the solved orientations, by the symmetry of the probe.

        If a probe is rotated by one of its periods, the press remains the same. The mesh, however, is rotated. The
        stress of each further period is therefore that of the solved period, after a rotation of the elements and of
        the components.

        Args:
            solved: Scaled stress in a frame that rotates with the probe, shape
                (n_distance, n_solved_rotation, n_force, n_element * n_local * 3).
            mesh: Template of the mesh.

        Returns:
            Scaled stress, shape (n_distance * n_force * n_rotation, n_element * n_local * 3), in the order of
            `weights`.
        """
        # The order of the axes becomes (distance, force, rotation), as in `weights`.
        n_distance, n_rotation, n_force, n_value = solved.shape
        solved_period = np.moveaxis(solved, 1, 2).reshape(n_distance, n_force, n_rotation, mesh.n_element, -1, 3)
        stress_of_periods = []
        for period_index in range(self.symmetry_order):
            angle = 2.0 * np.pi * period_index / self.symmetry_order
            rotated_elements = mesh.rotated(period_index, self.symmetry_order)
            reordered_stress = solved_period[..., rotated_elements, :, :]
            # The components refer to a frame that rotates with the probe, so they rotate in the opposite direction.
            stress_of_periods.append(rotate_stress(reordered_stress, -angle))
        all_rotations = np.concatenate(stress_of_periods, axis=2)
        return np.asarray(all_rotations.reshape(-1, n_value))


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

    The square roots of Chebyshev nodes are used as distances, so that the presses cover the area of the disk.

    Args:
        domain: Presses that a family covers.
        count: Number of presses.
    """
    relative_distances = np.sqrt(chebyshev_nodes(count - 1, 0.0, 1.0))
    min_force, max_force = domain.force_range
    min_log_force, max_log_force = np.log(domain.force_range)
    presses = []
    for index, relative_distance in enumerate([*relative_distances, 1.0]):
        distance = float(domain.radius * relative_distance)

        # Multiples of the golden ratio, modulo 1, distribute the logarithms of the forces evenly. Rounding must not
        # move a force out of the range.
        log_force_fraction = (0.5 + 0.618 * index) % 1.0
        force = np.exp(min_log_force + (max_log_force - min_log_force) * log_force_fraction)
        force_in_range = float(np.clip(force, min_force, max_force))

        # The golden angle (2.4 rad) distributes the directions evenly. The rotation changes by another angle.
        angle = 2.4 * index
        rotation = 0.7 * index
        presses.append(CheckPress(distance, angle, force_in_range, rotation))
    return presses


def check_family(film: Film, probe: Probe, domain: Domain) -> None:
    """Raise an error if a forward map cannot cover a domain.

    If the outermost press with the largest force can exist, all other presses of the domain can exist, too.

    Args:
        film: The film.
        probe: The probe.
        domain: Largest distance of a press from the centre, and range of forces.

    Raises:
        SceneError: If the radius or the forces are not positive numbers, if the film is not axisymmetric, or if the
            outermost press with the largest force cannot exist.
    """
    radius = domain.radius
    min_force, max_force = domain.force_range
    if not (0.0 < min_force <= max_force and np.isfinite(max_force)):
        raise SceneError(f"force range: expected 0 < MIN <= MAX in N, got {min_force} to {max_force}")
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
    check_press(film, probe, (radius, 0.0), max_force)


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
    """Presses on one film at one position with different forces. Each solve starts from the previous equilibrium.

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
    # The values of the grid are dimensionless: lengths are divided by the radius of the film, tensions by Young's
    # modulus, and forces by Young's modulus, the thickness and the radius. Each chain begins with the largest force.
    radius = film.radius
    chains = []
    for distance, tension, thickness, reach in product(grid.distance, grid.tension, grid.thickness, grid.reach):
        grid_film = replace(film, pretension=float(tension) * film.young, thickness=float(thickness) * radius)
        descending_forces = grid.load[::-1] * film.young * grid_film.thickness * radius
        probe = Circle(float(reach) * radius)
        chains.append(Chain(grid_film, probe, float(distance) * radius, descending_forces, surface, settings, read))
    values = solve_chains(chains, executor)[:, ::-1]  # the load ascends along the second axis

    # The order of the solves is (distance, tension, thickness, reach, load). In the grid, the load is the second axis.
    n_distance, n_load, n_tension, n_thickness, n_reach = grid.shape
    load_last = values.reshape(n_distance, n_tension, n_thickness, n_reach, n_load, -1)
    return np.moveaxis(load_last, 4, 1)


def _solve_chain(chain: Chain) -> Array:
    """Solve the presses of one chain, and return the values that `Chain.read` computes, shape (n_force, n_value)."""
    position = (chain.distance, 0.0)
    values_of_forces = []
    equilibrium: Equilibrium | None = None
    for force in chain.forces.tolist():  # each solve starts from the equilibrium under the previous force
        equilibrium = press(chain.film, chain.probe, position, force, chain.settings, start=equilibrium)
        values = chain.read(equilibrium, chain.surface)
        values_of_forces.append(values.ravel())
    return np.stack(values_of_forces)
