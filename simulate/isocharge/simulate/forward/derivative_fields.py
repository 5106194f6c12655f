"""Derivatives of the stress in a film with respect to a side force or to the pretension.

The derivatives are used for small corrections, so they need not be as accurate as the stress itself. The derivatives
are therefore computed for fewer presses than the stress of a forward map.
"""

from concurrent.futures import Executor
from dataclasses import replace

from isocharge.simulate.forward.family import Family, NodeCount, Reading
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.solver.load_case import SolveSettings

NODE_COUNT = NodeCount(distances=6, forces=6)
"""Numbers of distances, forces and directions at which the derivatives are solved."""


def solve_derivatives(forward_map: ForwardMap, read: Reading, executor: Executor | None) -> ForwardMap:
    """Compute derivatives of the stress for a few presses, and return a map that interpolates the derivatives.

    The presses are distributed over the domain of a forward map, and are solved with the mesh of the forward map. The
    solves take about ten seconds.

    Args:
        forward_map: Forward map of the film under a circular probe. It provides the domain, the mesh and the readout.
        read: Function that computes the derivatives of the stress at the nodes of the mesh from a solved press.
        executor: Executor that runs the solves; None for this process.

    Returns:
        Copy of the forward map. In place of the stress, its table contains the derivatives that `read` computes, shape
        (n_distance * n_force * n_direction, n_value).

    Raises:
        SolveError: If a press has no equilibrium.
    """
    sensor = forward_map.sensor
    film = sensor.film
    # Choose the distances and forces of the presses. A circular probe has no orientation.
    family = Family.spread(forward_map.domain, film, forward_map.probe, NODE_COUNT)
    theory = replace(forward_map.theory, stretching=True)  # `read` needs a theory that includes stretching
    settings = SolveSettings(theory=theory, resolution=forward_map.resolution, layer=forward_map.layer)

    derivatives = family.solve(sensor, forward_map.probe, settings, executor, read)
    table = derivatives.reshape(-1, derivatives.shape[-1])
    return replace(forward_map, family=family, theory=theory, table=table)
