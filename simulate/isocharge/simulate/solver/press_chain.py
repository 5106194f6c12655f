"""Presses with several forces at one position, solved one after the other. Several positions are solved in parallel."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.progress import track
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.mechanics.stress import rotate_stress
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.solver.equilibrium import Equilibrium, nodal_stress
from isocharge.simulate.solver.load_case import SolveSettings
from isocharge.simulate.solver.press import press

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
class Chain:
    """Presses with different forces at one position of one film. The presses are solved one after the other.

    Each solve starts from the equilibrium under the previous force.

    Attributes:
        film: Film on which the probe presses.
        probe: Probe in its rotated orientation.
        distance: Distance of the centroid of the footprint from the centre of the film, mm.
        forces: Forces in the order in which they are solved, shape (n_force,), N.
        surface: Surface at which the stress is read: the middle, the top or the bottom of the film.
        settings: Theory, mesh and width of the thin rings at the rim.
        read: Function that computes the returned values from each solved press.
    """

    film: Film
    probe: Probe
    distance: float
    forces: Array
    surface: Surface
    settings: SolveSettings
    read: Reading


def solve_chains(chains: Sequence[Chain], executor: Executor | None) -> Array:
    """Solve the presses of several chains, and show the progress.

    Args:
        chains: Chains with the same mesh and the same number of forces.
        executor: Executor that solves the chains in parallel; None for this process.

    Returns:
        Values that `Chain.read` computes for each press, shape (n_chain, n_force, n_value).
    """
    values_of_chains = in_order(executor, _solve_chain, chains)
    return np.stack(list(track(values_of_chains, "solving the film", len(chains))))


def _solve_chain(chain: Chain) -> Array:
    """Solve the presses of one chain.

    Args:
        chain: The chain, whose presses have the same position and different forces.

    Returns:
        Values that `Chain.read` computes for each force, shape (n_force, n_value).
    """
    position = (chain.distance, 0.0)
    values_of_forces = []
    equilibrium: Equilibrium | None = None
    for force in chain.forces.tolist():
        # The equilibrium under the previous force is a good start for the iterations of the solver.
        equilibrium = press(chain.film, chain.probe, position, force, chain.settings, start=equilibrium)
        values = chain.read(equilibrium, chain.surface)
        values_of_forces.append(values.ravel())
    return np.stack(values_of_forces)
