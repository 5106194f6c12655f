"""The solves of a family of presses, on all workers."""

from collections.abc import Iterable, Iterator
from concurrent.futures import Executor

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import SceneError
from isocharge.progress import Progress
from isocharge.simulate.forward.family import Family
from isocharge.simulate.mechanics.stress import turn_stress
from isocharge.simulate.mechanics.theory import Theory
from isocharge.simulate.mesh.placement import template_for
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.press import check_scene, press


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
    film: Film,
    probe: Probe,
    surface: Surface,
    family: Family,
    theory: Theory,
    resolution: Resolution,
    layer: float,
    executor: Executor | None,
    progress: Progress | None,
) -> Array:
    """Scaled nodal stress of every member, shape (n_distance * n_force * n_turn, n_element * n_local * 3)."""
    jobs = [
        (film, probe.turned(float(turn)), surface, float(distance), family.force, theory, resolution, layer)
        for distance in family.distance
        for turn in family.solved_turns
    ]
    results: Iterable[Array] = executor.map(_solve_chain, jobs) if executor else map(_solve_chain, jobs)
    solved = np.stack(list(_report(results, len(jobs), progress)))
    shape = (family.distance.size, family.solved_turns.size, family.force.size, -1)
    return family.unfold(solved.reshape(shape), template_for(probe, resolution))


def _report(results: Iterable[Array], total: int, progress: Progress | None) -> Iterator[Array]:
    for done, result in enumerate(results, start=1):
        if progress:
            progress(done, total)
        yield result


def _solve_chain(job: tuple[Film, Probe, Surface, float, Array, Theory, Resolution, float]) -> Array:
    """One distance and orientation, all forces, each started from the one before; shape (n_force, ...)."""
    film, probe, surface, distance, forces, theory, resolution, layer = job
    start: Equilibrium | None = None
    rows = []
    for force in forces:
        start = press(
            film, probe, (distance, 0.0), float(force), theory=theory, resolution=resolution, layer=layer, start=start
        )
        rows.append(turn_stress(start.nodal_stress(surface), -probe.angle).ravel())
    return np.stack(rows)
