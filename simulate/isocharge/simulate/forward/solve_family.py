"""The solves of a family of presses, on all workers."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.common.progress import Progress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.forward.family import Family
from isocharge.simulate.mechanics.stress import turn_stress
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.press import press
from isocharge.simulate.solver.scene import check_scene
from isocharge.simulate.solver.settings import SolveSettings


@dataclass(frozen=True)
class _Chain:
    """Presses of one distance and orientation.

    Attributes:
        film: The film.
        probe: The footprint, turned as it presses.
        surface: Where in the thickness the stress is read.
        distance: Distance of the presses from the film's centre, m.
        forces: N, shape (n_force,), in the order in which they are solved.
        settings: Theory and mesh.
    """

    film: Film
    probe: Probe
    surface: Surface
    distance: float
    forces: Array
    settings: SolveSettings


def check_family(film: Film, probe: Probe, radius: float, force_range: tuple[float, float]) -> None:
    low, high = force_range
    if not (0.0 < low <= high and np.isfinite(high)):
        raise SceneError(f"force range: expected 0 < MIN <= MAX in N, got {low} to {high}")
    if not (np.isfinite(radius) and radius > 0.0):
        raise SceneError(f"radius: expected a positive number, got {radius * 1e3} mm")
    if radius + probe.reach >= film.radius:
        raise SceneError(
            f"radius: presses up to {radius * 1e3:.4g} mm from the centre with {probe.notation}, which reaches "
            f"{probe.reach * 1e3:.4g} mm, leave the film of radius {film.radius * 1e3:.4g} mm"
        )
    check_scene(film, probe, (radius, 0.0), high)


def solve_family(
    sensor: Sensor,
    probe: Probe,
    family: Family,
    settings: SolveSettings,
    map_jobs: JobMap,
    progress: Progress | None,
) -> Array:
    """Scaled stress at the nodes, as `Family.unfold` takes it: (n_distance, n_solved_turn, n_force, ...).

    The settings give theory, mesh and width of the thin rings, the same for all members.
    """
    chains = [
        _Chain(sensor.film, probe.turned(float(turn)), sensor.surface, float(distance), family.force, settings)
        for distance in family.distance
        for turn in family.solved_turns
    ]
    stress = np.stack(list(report_each(map_jobs(_solve_chain, chains), len(chains), progress)))
    return stress.reshape(family.distance.size, family.solved_turns.size, family.force.size, -1)


def report_each(results: Iterable[Array], total: int, progress: Progress | None) -> Iterator[Array]:
    """The results one by one; `progress` is called with (done, total) after each."""
    for done, result in enumerate(results, start=1):
        if progress:
            progress(done, total)
        yield result


def _solve_chain(chain: _Chain) -> Array:
    """Scaled stress at the nodes for each force, solved from the one before; shape (n_force, ...)."""
    start: Equilibrium | None = None
    rows = []
    for force in chain.forces:
        start = press(chain.film, chain.probe, (chain.distance, 0.0), float(force), chain.settings, start=start)
        rows.append(turn_stress(start.nodal_stress(chain.surface), -chain.probe.angle).ravel())
    return np.stack(rows)
