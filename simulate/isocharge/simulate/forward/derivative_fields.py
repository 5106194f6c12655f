"""Solver of the derivatives of the stress field, for example with respect to a side force or the pretension.

Derivatives are small corrections and need less accuracy than the stress itself. They are therefore solved at fewer
presses than the stress of a forward map.
"""

from concurrent.futures import Executor
from dataclasses import replace

from isocharge.simulate.forward.family import Chain, Family, Reading, solve_chains
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.solver.load_case import SolveSettings

NODE_COUNTS = (6, 6)
"""Number of distances and number of forces at which the derivatives are solved."""


def solve_derivatives(film: ForwardMap, read: Reading, executor: Executor | None) -> ForwardMap:
    """Solve presses in the domain of a forward map. The solves of all `NODE_COUNTS` presses take about ten seconds.

    Args:
        film: Forward map of the film, whose probe is a circle. Its mesh and its readout are used.
        read: Function that computes the derivatives of the stress at the nodes from a solved press.
        executor: Executor that runs the solves; None for this process.

    Returns:
        Map whose table contains the values that `read` computes, shape (n_distance * n_force, n_value).

    Raises:
        SolveError: If a press has no equilibrium.
    """
    sensor = film.sensor
    family = Family.spread(film.domain, sensor.film.radius, NODE_COUNTS, period=0.0)
    theory = replace(film.theory, stretching=True)  # the tangent of the equilibrium requires it
    settings = SolveSettings(theory=theory, resolution=film.resolution, layer=film.layer)
    chains = [
        Chain(sensor.film, film.probe, distance, family.force, sensor.surface, settings, read)
        for distance in family.distance.tolist()
    ]
    rows = solve_chains(chains, executor)
    table = rows.reshape(-1, rows.shape[-1])
    return replace(film, family=family, theory=theory, table=table)
