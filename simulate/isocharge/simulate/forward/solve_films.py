"""The solves of a family of films, and the modes that their stresses are made of."""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.progress import Progress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.forward.film_grid import FilmGrid
from isocharge.simulate.forward.solve_family import report_each
from isocharge.simulate.mechanics.theory import Theory
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.solver.press import press
from isocharge.simulate.solver.settings import SolveSettings

MODES_LEFT = 8e-5
"""Share of the stresses that the modes may leave out: root mean square, each node's stress relative to its own size."""

THEORY = Theory(stretching=True, bending=True, pretensioned=True)
"""All terms: a family holds slack films and taut ones."""


def solve_films(
    film: Film,
    surface: Surface,
    grid: FilmGrid,
    settings: SolveSettings,
    map_jobs: JobMap,
    progress: Progress | None,
) -> Array:
    """Scaled stress at the nodes of the template, shape (*grid.shape, n_element * n_local * 3)."""
    chains = [
        _Chain(film, surface, (distance, tension, thickness, reach), grid.load, settings)
        for distance in grid.distance
        for tension in grid.tension
        for thickness in grid.thickness
        for reach in grid.reach
    ]
    rows = np.stack(list(report_each(map_jobs(_solve_chain, chains), len(chains), progress)))
    by_axis = rows.reshape(*(grid.shape[axis] for axis in (0, 2, 3, 4, 1)), -1)
    return np.moveaxis(by_axis, 4, 1)


@dataclass(frozen=True)
class _Chain:
    """Presses of all loads on one film at one distance, by one probe.

    Attributes:
        film: The described film; its radius, modulus and Poisson's ratio are taken.
        surface: Where in the thickness the stress is read.
        groups: Distance, tension, thickness and reach as on the grid.
        load: F / (E h a), shape (n_load,), ascending.
        settings: Theory and mesh.
    """

    film: Film
    surface: Surface
    groups: tuple[float, float, float, float]
    load: Array
    settings: SolveSettings


def _solve_chain(chain: _Chain) -> Array:
    """Scaled stress at the nodes for each load, shape (n_load, ...); each is solved from the next larger one."""
    distance, tension, thickness, reach = chain.groups
    a, young = chain.film.radius, chain.film.young
    film = replace(chain.film, pretension=tension * young, thickness=thickness * a)
    probe, start, rows = Circle(reach * a), None, []
    for load in chain.load[::-1]:
        force = float(load) * young * film.thickness * a
        start = press(film, probe, (distance * a, 0.0), force, chain.settings, start=start)
        rows.append(start.nodal_stress(chain.surface).ravel())
    return np.stack(rows[::-1])


def decompose(stress: Array) -> tuple[Array, Array]:
    """Coefficients and modes of scaled stresses of shape (..., n): the fewest that leave out `MODES_LEFT`.

    Every node counts relative to its own stress: the peak under the probe would else hide the electrodes.
    """
    flat = stress.reshape(-1, stress.shape[-1])
    size = np.repeat(np.sqrt((flat.reshape(len(flat), -1, 3) ** 2).sum(axis=2).mean(axis=0)), 3)
    relative = flat / size
    values, vectors = np.linalg.eigh(relative.T @ relative)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    left = np.sqrt(np.maximum(1.0 - np.cumsum(values) / values.sum(), 0.0))
    count = int(np.argmax(left <= MODES_LEFT)) + 1
    modes = vectors[:, :count].T
    return (relative @ modes.T).reshape(*stress.shape[:-1], count), modes * size
