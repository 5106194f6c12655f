"""Families of presses with one probe. Only a few presses of a family are solved.

The solved presses are the nodes of the family. For every other press, the stress is interpolated between the nodes.

The functions of the module prepare and check a family. They choose the numbers of nodes and the mesh, check that
the presses of a domain can exist, and compare interpolated charges with the charges of direct solves. The class
`forward_map.ForwardMap` combines these steps.
"""

import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import SceneError
from isocharge.common.progress import track
from isocharge.simulate.execution import in_order
from isocharge.simulate.forward.readout import touch_charge
from isocharge.simulate.mechanics.theory import rotate_stress
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.conformal_map import distance_coordinate
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.numerics.disk import log_spaced_forces
from isocharge.simulate.numerics.interpolation import Turns, chebyshev_nodes, lagrange_values
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium, nodal_stress
from isocharge.simulate.solver.load_case import SolveSettings, check_press, layer_for
from isocharge.simulate.solver.press import needed_resolution, press

DEFAULT_HARMONICS = (4, 3, 2, 1)
"""Default value of the largest harmonics of a family; see `Turns.spread`.

Two examples on a film of 45 mm radius show the resulting error of a charge. Let T1 / T2 be the ratio of the pretensions
along the two axes. If T1 / T2 is 1.7, the error under a rectangle of 4 mm by 2 mm is at most 2e-4. If T1 / T2 is 3, the
error under a triangle of 4 mm is at most 3e-4.
"""


class NodeCount(NamedTuple):
    """Numbers of distances and forces, and harmonics of the angles, for which a family of presses is solved.

    Attributes:
        distances: Number of distances of the presses from the centre of the film.
        forces: Number of forces of the presses.
        largest_harmonics: Largest harmonic of the rotation of a probe, for each harmonic of the direction; see
            `Turns.spread`.
    """

    distances: int
    forces: int
    largest_harmonics: tuple[int, ...] = DEFAULT_HARMONICS


NODE_COUNTS = (
    NodeCount(5, 3),
    NodeCount(8, 5, (6,)),
    NodeCount(10, 7, (10,)),
    NodeCount(13, 12, (10,)),
)
"""Numbers of nodes that are tried one after the other, until the interpolation is sufficiently accurate.

The last entry is for films with a large pretension. As the force increases, the charges of such a film first follow one
power of the force and then another, and pass through zero.
"""

ASYMMETRIC_NODE_COUNTS = (
    NodeCount(5, 3),
    NodeCount(5, 7),
    NodeCount(5, 12, (6, 4, 2, 1)),
    NodeCount(8, 12, (7, 5, 3, 2, 1)),
    NodeCount(13, 12, (10, 8, 6, 4, 2, 1)),
)
"""Numbers of nodes that are tried for a film that is not axisymmetric.

The number of forces is increased first, because a taut film needs many forces. A further force also costs less than a
further distance, because the solve for a force starts from the equilibrium under the previous force. For a film with a
pretension, the first entry is omitted.
"""


Orientation = Literal["fixed", "random"]
"""Whether all presses have the given orientation of the probe, or each press has a random orientation."""

Reading = Callable[[Equilibrium, Surface], Array]
"""Type of a function that computes values from a solved press, such as the stresses at a surface of the film.

The returned array has any shape.
"""


def probe_frame_stress(solved: Equilibrium, surface: Surface) -> Array:
    """Compute the scaled touch stress at the nodes of the mesh in a frame that rotates with the probe.

    Args:
        solved: Equilibrium of the film under the press.
        surface: Surface at which the stress is read: the middle, the top or the bottom of the film.

    Returns:
        Stress components (S11, S22, S12), shape (n_element, n_local, 3), in units of Young's modulus times the squared
        amplitude, dimensionless.
    """
    return rotate_stress(nodal_stress(solved, surface), -solved.probe.angle)


@dataclass(frozen=True)
class Family:
    """Solved presses, from which the stress under every press in a domain is interpolated.

    Attributes:
        domain: Presses for which the stress can be interpolated.
        film_radius: Radius of the film, mm.
        distance: Distances of the solved presses from the centre of the film, shape (n_distance,), mm. The values of
            `distance_coordinate` for these distances are Chebyshev nodes.
        force: Forces of the solved presses, shape (n_force,), N. Their logarithms are Chebyshev nodes.
        turns: Directions of the presses on the film, and rotations of the probe.
        is_oriented: Whether the probe has the same orientation on the film in all presses. Otherwise, each press may
            have another orientation.
    """

    domain: Domain
    film_radius: float
    distance: Array
    force: Array
    turns: Turns
    is_oriented: bool

    @classmethod
    def spread(
        cls, domain: Domain, film: Film, probe: Probe, count: NodeCount, orientation: Orientation = "fixed"
    ) -> "Family":
        """Create a family whose solved presses are distributed over a domain.

        Args:
            domain: Presses for which the stress will be interpolated.
            film: Film on which the probe presses.
            probe: Probe that presses the film.
            count: Numbers of distances and of forces, and the largest harmonics of the angles.
            orientation: Whether the probe keeps its own orientation ("fixed") or may be rotated ("random"). If the film
                or the probe is axisymmetric, a rotation needs no further solves.

        Returns:
            The family. It has only one force if the smallest and the largest force of the domain are equal.
        """
        # The distance coordinate is atanh(distance / film radius), and tanh is its inverse.
        largest_coordinate = float(distance_coordinate(domain.radius / film.radius))
        distance = film.radius * np.tanh(chebyshev_nodes(count.distances, 0.0, largest_coordinate))

        # The logarithms of the forces are Chebyshev nodes.
        min_log_force, max_log_force = np.log(domain.force_range)
        n_force = count.forces if max_log_force > min_log_force else 1
        force = np.exp(chebyshev_nodes(n_force, min_log_force, max_log_force))

        # Find the period, which is the smallest rotation of the probe relative to the direction of the press after
        # which the stress repeats. If the orientation of the probe on the film may change, or does not affect the
        # stress, this is the period of the probe.
        period = probe.period
        # Whether the probe keeps its orientation on the film, and this orientation affects the stress
        is_oriented = orientation == "fixed" and not film.is_axisymmetric and not probe.is_axisymmetric
        if is_oriented:
            # The film and the probe rotate together. Half a turn maps the film onto itself. Half a turn also maps the
            # probe onto itself if its symmetry order, the number of its periods in a full turn, is even.
            symmetry_order = round(math.tau / period)
            period = math.pi if symmetry_order % 2 == 0 else math.tau

        # Choose the turns. A turn is a pair of a direction of the press on the film and a rotation of the probe. The
        # direction has no effect of its own if the film is axisymmetric or rotates together with the probe.
        has_directions = not film.is_axisymmetric and not is_oriented
        turns = Turns.spread(count.largest_harmonics, period, has_directions=has_directions)
        return cls(domain, film.radius, distance, force, turns, is_oriented)

    def weights(self, position: Complexes, force: Array, rotation: Array) -> Array:
        """Compute the weights that interpolate the stress between the solved presses (nodes).

        Lagrange polynomials interpolate in a coordinate that depends on the distance from the centre, and in the
        logarithm of the force. A Fourier series interpolates in the direction of the press and in the rotation of the
        probe. A pair of these two angles is called a turn.

        Args:
            position: Positions x + iy of the interpolated presses, shape (n,), mm.
            force: Forces of the interpolated presses, shape (n,), N.
            rotation: Rotations of the probe relative to the direction of the press, shape (n,), rad. Zero if the probe
                is axisymmetric.

        Returns:
            Weights, shape (n, n_distance * n_force * n_turn), dimensionless. An interpolated value is the sum of the
            values at all nodes, each multiplied by the weight of its node.
        """
        # Compute the interpolation weights along each axis. The first angle of a turn is the sum of the direction of
        # the press and the rotation of the probe, and the second angle is the rotation.
        node_coordinates = distance_coordinate(self.distance / self.film_radius)
        press_coordinates = distance_coordinate(np.abs(position) / self.film_radius)
        distance_weights = lagrange_values(node_coordinates, press_coordinates)
        force_weights = lagrange_values(np.log(self.force), np.log(force))
        turn_weights = self.turns.weights(np.angle(position) + rotation, rotation)

        # The weight of a node is the product of its weights along the axes (press, distance, force, turn).
        distance_force_weights = distance_weights[:, :, None, None] * force_weights[:, None, :, None]
        weights = distance_force_weights * turn_weights[:, None, None, :]
        return weights.reshape(position.size, -1)

    def solve(
        self,
        sensor: Sensor,
        probe: Probe,
        settings: SolveSettings,
        executor: Executor | None,
        read: Reading,
    ) -> Array:
        """Solve the presses of the family, and compute values such as the stress from each of them.

        A turn is a pair of two angles: the direction of the press, and the rotation of the probe. Only the rotations
        within one period of the probe are solved.

        Args:
            sensor: Sensor with the film, and with the surface at which the stress is read.
            probe: Probe that presses the film.
            settings: Theory, mesh and width of the thin rings at the rim, which are the same for all presses.
            executor: Executor that runs the solves; None for this process.
            read: Function that computes the returned values from each solved press.

        Returns:
            Values that `read` computes, shape (n_distance, n_force, n_solved_turn, n_value), dimensionless. The method
            `unfold` extends stresses to all rotations.
        """
        # A place is a distance and a turn. The presses at one place are solved in one job.
        turns = self.turns.solved  # pairs of angles within one period of the probe
        places = [(distance, turn) for distance in self.distance.tolist() for turn in turns]
        solve_place = partial(self._solve_forces, sensor, probe, settings, read)
        values_of_places = track(in_order(executor, solve_place, places), "solving the film", len(places))

        # Split the axis of the places into the axes of the distances and of the turns.
        values = np.stack(list(values_of_places)).reshape(self.distance.size, len(turns), self.force.size, -1)
        return values.swapaxes(1, 2)  # from (distance, turn, force, value) to (distance, force, turn, value)

    def _solve_forces(
        self,
        sensor: Sensor,
        probe: Probe,
        settings: SolveSettings,
        read: Reading,
        place: tuple[float, tuple[float, float]],
    ) -> Array:
        """Solve the presses at one position and rotation for all forces of the family, one after the other.

        Args:
            sensor: Sensor with the film, and with the surface at which the stress is read.
            probe: Probe that presses the film.
            settings: Theory and mesh, which are the same for all presses.
            read: Function that computes the returned values from each solved press.
            place: Distance from the centre of the film, mm, and a turn. A turn is a pair of angles, rad. Its first
                angle is the sum of the direction of the press and the rotation of the probe. Its second angle is the
                rotation of the probe.

        Returns:
            Values that `read` computes, shape (n_force, n_value).
        """
        distance, (angle_sum, rotation) = place
        direction = angle_sum - rotation
        # Rotate the film by the opposite of the direction of the press, so that the press lies on the positive x axis.
        film = sensor.film.rotated(-direction)
        rotated_probe = probe.rotated(rotation)
        values_by_force = []
        equilibrium = None
        for force in self.force.tolist():
            # The equilibrium under the previous force is a good start for the iterations of the solver.
            equilibrium = press(film, rotated_probe, (distance, 0.0), force, settings, start=equilibrium)
            values_by_force.append(read(equilibrium, sensor.surface).ravel())
        return np.stack(values_by_force)

    def unfold(self, solved: Array, mesh: Template) -> Array:
        """Copy the stress from the rotations within one period of the probe to all rotations.

        A turn is a pair of a direction of the press and a rotation of the probe. A period is the smallest rotation that
        maps the probe onto itself, and contains n_solved_turn turns. A rotation of the probe by one period does not
        change the press, but rotates the mesh. The stress of each further period is therefore obtained from the stress
        of the solved period: the elements of the mesh are renumbered, and the stress components are rotated.

        Args:
            solved: Scaled stress in a frame that rotates with the probe, as returned by `solve`, shape
                (n_distance, n_force, n_solved_turn, n_element * n_local * 3), dimensionless.
            mesh: Template of the mesh of the solves.

        Returns:
            Scaled stress, shape (n_distance * n_force * n_turn, n_element * n_local * 3), dimensionless. There is one
            row for each press. The presses are ordered by distance, force and turn, as in `weights`.
        """
        symmetry_order = self.turns.symmetry_order  # number of periods in a full turn
        values_per_press = solved.shape[-1]
        if symmetry_order == 1:  # nothing to copy; the code below would need four times the memory of a large table
            return solved.reshape(-1, values_per_press)

        # Shape (n_distance, n_force, n_solved_turn, n_element, n_local, 3)
        solved_stress = solved.reshape(*solved.shape[:-1], mesh.n_element, -1, 3)
        stress_of_periods = []
        for period_index in range(symmetry_order):
            angle = math.tau * period_index / symmetry_order
            rotated_elements = mesh.rotated_elements(period_index, symmetry_order)
            renumbered_stress = solved_stress[..., rotated_elements, :, :]
            # The stress itself does not change, but its components refer to a frame that was rotated by `angle`.
            stress_of_periods.append(rotate_stress(renumbered_stress, -angle))

        stress_of_turns = np.concatenate(stress_of_periods, axis=2)  # the axis of the turns
        return stress_of_turns.reshape(-1, values_per_press)


def node_counts(film: Film) -> tuple[NodeCount, ...]:
    """Return the numbers of nodes that are tried one after the other for a film."""
    if film.is_axisymmetric:
        return NODE_COUNTS
    is_taut = film.pretension != 0.0 or film.deviator != (0.0, 0.0)
    return ASYMMETRIC_NODE_COUNTS[1:] if is_taut else ASYMMETRIC_NODE_COUNTS


def spread_check_presses(domain: Domain, count: int) -> tuple[Array, Array]:
    """Return presses at which an interpolation is checked. They are spread over the area and the forces of a domain.

    The last press lies at the largest distance from the centre. The squared distances of the other presses are
    Chebyshev nodes, because the area of a disk is proportional to its squared radius.

    Args:
        domain: Domain of the family that is checked.
        count: Number of presses to be returned, including the last press.

    Returns:
        Contacts (x, y, F), shape (count, 3), mm and N. Rotations of the probe in addition to its own orientation, shape
        (count,), rad.
    """
    press_index = np.arange(float(count))
    squared_distance = np.append(chebyshev_nodes(count - 1, 0.0, 1.0), 1.0)  # relative to the squared radius
    distance = domain.radius * np.sqrt(squared_distance)

    # Multiples of the golden ratio (0.618), modulo 1, distribute the logarithms of the forces evenly.
    force = log_spaced_forces((0.5 + 0.618 * press_index) % 1.0, domain.force_range)

    # The golden angle (2.4 rad) distributes the directions evenly. The rotation of the probe changes by a different
    # angle, so that the rotation and the direction are independent.
    position = distance * np.exp(2.4j * press_index)
    rotation = 0.7 * press_index
    return np.column_stack([position.real, position.imag, force]), rotation


def check_domain(domain: Domain) -> None:
    """Raise an error if the radius or the forces of a domain are not positive numbers.

    Args:
        domain: Presses that are to be simulated.

    Raises:
        SceneError: If a value is not positive or not finite, or if the smallest force exceeds the largest force.
    """
    min_force, max_force = domain.force_range
    if not 0.0 < min_force <= max_force < np.inf:
        raise SceneError(f"force range: expected 0 < MIN <= MAX in N, got {min_force:g} to {max_force:g}")
    if not 0.0 < domain.radius < np.inf:
        raise SceneError(f"radius: expected a positive number, got {domain.radius:g} mm")


def check_family(film: Film, probe: Probe, domain: Domain) -> None:
    """Raise an error if no forward map can be built for a film, a probe and a domain.

    A forward map is built from solved presses of the domain, which are called a family. Only the outermost press with
    the largest force is checked. If the outermost press with the largest force can exist, all other presses of the
    domain can exist, too. On an oval film, the outermost press lies on the shorter semi-axis.

    Args:
        film: Film of the forward map.
        probe: Probe of the forward map.
        domain: Presses that the forward map would cover.

    Raises:
        SceneError: If the radius or the forces are not positive numbers, or if the outermost press with the largest
            force cannot exist.
    """
    check_domain(domain)
    radius = domain.radius
    _, max_force = domain.force_range
    largest_probe = probe.under(max_force)
    if radius + largest_probe.reach >= film.radius:
        raise SceneError(
            f"radius: presses up to {radius:.4g} mm from the centre with {probe.notation}, which reaches "
            f"{largest_probe.reach:.4g} mm, leave the film of radius {film.radius:.4g} mm; state a smaller radius"
        )
    check_press(film, largest_probe, nearest_to_clamp(film, radius), max_force)


def nearest_to_clamp(film: Film, distance: float) -> tuple[float, float]:
    """Return the position (x, y), mm, nearest to the clamp among all positions at a given distance from the centre.

    Args:
        film: The film.
        distance: Distance from the centre of the film, mm.
    """
    angle = film.oval_axis + 0.5 * math.pi if film.oval > 0.0 else film.oval_axis  # of the shorter semi-axis
    return distance * math.cos(angle), distance * math.sin(angle)


def family_mesh(film: Film, probe: Probe, domain: Domain, settings: SolveSettings) -> tuple[Resolution, float]:
    """Choose a common mesh for all presses of a domain.

    Args:
        film: Film of the forward map.
        probe: Probe that presses the film.
        domain: Presses of the forward map.
        settings: Required accuracy, theory, and parts of the mesh. A part that is "auto" is chosen here.

    Returns:
        Fineness of the mesh (order of the elements and numbers of elements and rings), and total width of the thin
        rings at the rim, in film radii. The setting `layer` of the solver is this width.
    """
    min_force, max_force = domain.force_range
    middle_force = math.sqrt(min_force * max_force)
    ring_width = layer_for(film, middle_force, settings)

    # The press that is nearest to the clamp needs the finest mesh. If the film is not axisymmetric, for example because
    # its pretension is uneven, or if the footprint grows with the force, the smallest force needs the finest mesh.
    force = min_force if probe.grows or not film.is_axisymmetric else middle_force
    outermost_position = nearest_to_clamp(film, domain.radius)
    resolution = needed_resolution(film, probe, outermost_position, force, replace(settings, layer=ring_width))
    return resolution, ring_width


def direct_charges(
    sensor: Sensor, probe: Probe, settings: SolveSettings, check: tuple[float, float, float, float]
) -> Array:
    """Compute the charges of one press by a direct solve, without interpolation.

    Args:
        sensor: Sensor whose charges are computed.
        probe: Probe in its own orientation, to which the rotation of the press is added.
        settings: Theory and mesh of the solve.
        check: Position (x, y), mm, force, N, and rotation of the probe, rad.

    Returns:
        Charges, shape (n_electrode,), pC.
    """
    x, y, force, rotation = check
    return touch_charge(sensor, press(sensor.film, probe.rotated(rotation), (x, y), force, settings))


CHARGE_FLOOR = 0.1
"""Smallest charge by which an error is divided, in units of the largest charge of the press, dimensionless."""


def relative_error(charge: Array, direct_charge: Array) -> float:
    """Compute the largest relative difference between interpolated and directly solved charges.

    The difference at each electrode is divided by the directly solved charge of the electrode. The divisor is at least
    `CHARGE_FLOOR` times the largest charge of the press.

    Args:
        charge: Interpolated charges, shape (n, n_electrode), pC.
        direct_charge: Directly solved charges, shape (n, n_electrode), pC.

    Returns:
        The largest relative difference of an electrode, dimensionless.
    """
    magnitude = np.abs(direct_charge)
    divisor = np.maximum(magnitude, CHARGE_FLOOR * magnitude.max(axis=1, keepdims=True))
    return float((np.abs(charge - direct_charge) / divisor).max())
