"""Solving the film under a press."""

from dataclasses import replace
from time import process_time

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SolveError
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.placed_mesh import Geometry, PlacedMesh, from_oval
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.numerics.interpolation import tensor_values
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.solver.assembly import Assembly, assembly
from isocharge.simulate.solver.equilibrium import Equilibrium, principal_stress
from isocharge.simulate.solver.error_estimate import relative_difference, shape_error
from isocharge.simulate.solver.load_case import (
    LoadCase,
    SolveSettings,
    choose_mesh,
    needs_second_mesh,
    too_near_the_rim,
)
from isocharge.simulate.solver.newton import GUARD_BELOW, NewtonResult, schwerin_start, solve_linear, solve_newton

MOST_ORDERS = 3
"""Largest number of orders that are tried beyond the first mesh."""

ANOTHER = 0.1
"""Relative difference above which two meshes have different equilibria: a film that wrinkles has many."""

FIRST_LOAD, LOAD_STEPS = 0.0625, 12
"""If the full load fails at once: share of the load to begin with, and how many loads to try at most."""


def press(
    film: Film,
    probe: Probe,
    at: tuple[float, float],
    force: float,
    settings: SolveSettings = SolveSettings(),
    *,
    start: Equilibrium | None = None,
    throw: bool = True,
) -> Equilibrium:
    """Solve the film under a press.

    Args:
        film: The clamped film.
        probe: The footprint, pressing uniformly, dead load.
        at: Centroid of the footprint (x, y), mm.
        force: N, positive pushes.
        settings: Accuracy, theory and mesh.
        start: A neighbouring equilibrium of the same mesh to start from: another force, another position.
        throw: Whether a failure raises; if not, look at `status`.

    Returns:
        The equilibrium.

    Raises:
        SceneError: If the press cannot exist, or not on this mesh.
        SolveError: If no equilibrium is reached and `throw` is set.
    """
    case = LoadCase.of(film, probe, at, force, settings, start.mesh if start else None)
    with single_threaded_blas():
        if settings.resolution != "auto":
            solved = _solve(case, case.place(settings.resolution), start)
        elif needs_second_mesh(case):
            solved = _solve_until_meshes_agree(case, start)
        else:
            solved = _solve(case, choose_mesh(case), start)
    if throw and solved.status != "converged":
        raise SolveError(_failure_reason(solved, settings.tolerance))
    return solved


def needed_resolution(
    film: Film, probe: Probe, at: tuple[float, float], force: float, settings: SolveSettings = SolveSettings()
) -> Resolution:
    """The mesh that `press` would choose; the film is solved only where two meshes must be compared.

    Raises:
        SceneError: If the press cannot exist, or every mesh for it is too distorted.
        SolveError: If two meshes must be compared and no equilibrium is reached.
    """
    case = LoadCase.of(film, probe, at, force, settings, None)
    if settings.resolution != "auto":
        return settings.resolution
    if needs_second_mesh(case):
        return press(film, probe, at, force, settings).mesh.resolution
    return choose_mesh(case).resolution


def _solve_until_meshes_agree(case: LoadCase, start: Equilibrium | None) -> Equilibrium:
    """Solve on meshes of rising order until two agree to half of the accuracy, or `MOST_ORDERS` have been tried.

    If a still finer mesh finds no equilibrium, the finer of the two before is the answer, with their difference as its
    error. Two meshes with different equilibria give no answer: the status is "failed".
    """
    solved = _solve(case, choose_mesh(case), start)
    for _ in range(MOST_ORDERS):
        if solved.status != "converged":
            return solved
        resolution = solved.mesh.resolution
        finer = _solve(case, case.place(replace(resolution, order=resolution.order + 1)), solved)
        if finer.status != "converged" and solved.proven_error is not None:
            break
        error = relative_difference(solved, finer) if finer.status == "converged" else None
        solved = replace(finer, iterations=solved.iterations + finer.iterations, proven_error=error)
        if error is not None and error <= 0.5 * case.accuracy:
            break
    if solved.proven_error is not None and solved.proven_error > ANOTHER:
        order = solved.mesh.resolution.order
        return replace(
            solved,
            status="failed",
            message=f"a mesh of order {order - 1} and one of order {order} find charges that differ by "
            f"{solved.proven_error:.0%}",
        )
    return solved


def _solve(case: LoadCase, mesh: PlacedMesh, start: Equilibrium | None) -> Equilibrium:
    """Solve on one mesh."""
    if np.isinf(shape_error(mesh)):
        raise too_near_the_rim(case, mesh.resolution)
    solver = assembly(mesh.template, 4 if case.theory.bending else 3)
    elastic = _elastic(case, mesh.geometry, case.force)
    result = _newton(case, elastic, solver, mesh, start) if case.theory.stretching else solve_linear(elastic, solver)
    return Equilibrium(
        film=case.film,
        probe=case.probe,
        at=case.at,
        force=case.force,
        theory=case.theory,
        mesh=mesh,
        field=result.field,
        groups=elastic.groups,
        status="converged" if result.converged else "failed",
        message=result.message,
        iterations=result.iterations,
        residual=result.residual,
        seconds=process_time() - case.began,
    )


def _elastic(case: LoadCase, geometry: Geometry, force: float) -> ElasticFilm:
    angle = float(np.arctan2(case.at[1], case.at[0]))
    return ElasticFilm(geometry, DimensionlessGroups.of(case.film, force, bending=case.theory.bending, angle=angle))


def _newton(
    case: LoadCase, elastic: ElasticFilm, solver: Assembly, mesh: PlacedMesh, start: Equilibrium | None
) -> NewtonResult:
    """Newton's method from the start if its mesh fits, else from Schwerin's field; by load steps if that fails."""
    z = mesh.placement.to_template(from_oval(mesh.node_points, mesh.oval))
    cold = schwerin_start(z, float(mesh.placement.rho), elastic.groups)
    result = solve_newton(elastic, solver, _start_field(start, mesh.template, cold), case.tolerance)
    return result if result.converged else _by_load_steps(case, result, mesh.geometry, solver, cold)


def _by_load_steps(
    case: LoadCase, failed: NewtonResult, geometry: Geometry, solver: Assembly, cold: Array
) -> NewtonResult:
    """Follow the equilibrium up from a small force where at the full force the film runs away into wrinkles."""
    reached, ratio, steps, field = 0.0, 2.0, failed.iterations, cold
    force = FIRST_LOAD * case.force
    for _ in range(LOAD_STEPS):
        near = np.inf if reached else GUARD_BELOW
        result = solve_newton(_elastic(case, geometry, force), solver, field, case.tolerance, near)
        steps += result.iterations
        if result.converged and force == case.force:
            return replace(result, iterations=steps, message=f"converged in {steps} steps, the load in parts")
        if result.converged:
            reached, field = force, result.field
        elif reached == 0.0:
            break
        else:
            ratio = np.sqrt(ratio)
        force = min(case.force, reached * ratio)
    return replace(failed, iterations=steps)


def _start_field(start: Equilibrium | None, template: Template, cold: Array) -> Array:
    """The field of a neighbour on the same mesh, perhaps of another order; else the cold start."""
    if start is None or (start.mesh.template.topology, start.mesh.template.half) != (template.topology, template.half):
        return cold
    before, order = start.mesh.template, template.resolution.order
    is_other = replace(before.resolution, order=order) != template.resolution
    if is_other or not np.array_equal(before.splits, template.splits):
        return cold
    return start.field if before.resolution == template.resolution else resampled(start.field, before, template)


def resampled(field: Array, before: Template, after: Template) -> Array:
    """A nodal field on the nodes of the same mesh with elements of another order, shape (n_node, 3)."""
    values = tensor_values(before.resolution.order, after.xi, after.eta)
    other = np.empty((after.n_node, 3))
    other[after.nodes] = values @ field[before.nodes]
    return other


def _failure_reason(solved: Equilibrium, tolerance: float) -> str:
    """Why the solve failed, for the error message."""
    (x, y), smallest = solved.at, principal_stress(solved)[0]
    wrinkles = (
        f"; the film is compressed to {smallest:.3g} MPa on the way: it wrinkles, which has many solutions; "
        "press farther from the rim, with less force, or give the film a pretension"
    )
    return (
        f"no equilibrium at {solved.force:.4g} N, position ({x:.4g}, {y:.4g}) mm: {solved.message}; "
        f"residual {solved.residual:.2g} (expected {tolerance:.2g}) after {solved.iterations} steps"
        + (wrinkles if smallest < 0.0 else "")
    )
