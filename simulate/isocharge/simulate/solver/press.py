"""Solver of a press.

The solver chooses the mesh and solves with the selected theory. If this solve fails, the load is applied in steps.
"""

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
from isocharge.simulate.solver.newton import (
    GUARD_BELOW,
    NewtonResult,
    parabolic_start,
    schwerin_start,
    solve_linear,
    solve_newton,
)

MAX_EXTRA_ORDERS = 3
"""Largest number of increases of the order after the first mesh."""

DIFFERENT_EQUILIBRIUM = 0.1
"""Relative difference of the charges above which the solutions on two meshes count as different equilibria. A film that
wrinkles has many equilibria."""

FIRST_LOAD_SHARE = 0.0625
"""Share of the load with which the load steps begin if the solve with the full load fails."""

MAX_LOAD_STEPS = 12
"""Largest number of load steps."""


def press(
    film: Film,
    probe: Probe,
    at: tuple[float, float],
    force: float,
    settings: SolveSettings = SolveSettings(),
    *,
    side_force: tuple[float, float] = (0.0, 0.0),
    start: Equilibrium | None = None,
    throw: bool = True,
) -> Equilibrium:
    """Solve the film under a press.

    Args:
        film: The clamped film.
        probe: The probe. The direction of its pressure does not change as the film deflects.
        at: Centroid (x, y) of the footprint, mm.
        force: Force, N, positive in the direction of the push.
        settings: Accuracy, theory and mesh.
        side_force: Force (Fx, Fy) of the probe on the film along the film, N. It is spread over the footprint like
            the pressure and keeps its direction. `solver.friction.friction_force` computes the side force of a probe
            with friction.
        start: Equilibrium of a similar press on the same mesh, whose field is the first iterate.
        throw: Whether to raise an error if the solve fails. Otherwise `status` of the result is "failed".

    Returns:
        The equilibrium.

    Raises:
        SceneError: If the press cannot exist, or the mesh is too distorted.
        SolveError: If the solve fails and `throw` is True.
    """
    start_mesh = start.mesh if start else None
    case = LoadCase.of(film, probe, at, force, settings, start_mesh, side_force)
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
    """Return the resolution that `press` would choose. The press is solved only if two meshes must be compared.

    Args:
        film: The clamped film.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.
        force: Force, N.
        settings: Accuracy, theory and mesh.

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
    """Solve on meshes of increasing order until the charges of two meshes agree within half of the accuracy.

    The order is increased at most `MAX_EXTRA_ORDERS` times. If no equilibrium is found on the first or the second mesh,
    the result is failed. If no equilibrium is found on a further mesh, the result is the equilibrium on the previous
    mesh. If the last two meshes have different equilibria, the status of the result is "failed".

    Args:
        case: The press and its accuracy.
        start: Equilibrium of a similar press from which the first solve starts; None if there is none.

    Returns:
        Equilibrium on the finest mesh. Its `proven_error` is the difference from the previous mesh.
    """
    solved = _solve(case, choose_mesh(case), start)
    if solved.status != "converged":
        return solved
    for _ in range(MAX_EXTRA_ORDERS):
        resolution = solved.mesh.resolution
        finer_mesh = case.place(replace(resolution, order=resolution.order + 1))
        finer = _solve(case, finer_mesh, solved)
        iterations = solved.iterations + finer.iterations
        if finer.status != "converged":
            if solved.proven_error is None:  # only one mesh has an equilibrium, so its error is unknown
                return replace(finer, iterations=iterations)
            break
        error = relative_difference(solved, finer)
        solved = replace(finer, iterations=iterations, proven_error=error)
        if error <= 0.5 * case.accuracy:
            break

    if solved.proven_error is not None and solved.proven_error > DIFFERENT_EQUILIBRIUM:
        order = solved.mesh.resolution.order
        return replace(
            solved,
            status="failed",
            message=f"a mesh of order {order - 1} and one of order {order} find charges that differ by "
            f"{solved.proven_error:.0%}",
        )
    return solved


def _solve(case: LoadCase, mesh: PlacedMesh, start: Equilibrium | None) -> Equilibrium:
    """Solve a press on one mesh.

    Args:
        case: The press and its accuracy.
        mesh: The mesh.
        start: Equilibrium of a similar press from which the solve starts; None if there is none.

    Returns:
        The equilibrium. Its status is "failed" if no equilibrium was found.

    Raises:
        SceneError: If an element of the mesh is folded.
    """
    if np.isinf(shape_error(mesh)):
        raise too_near_the_rim(case, mesh.resolution)
    components = 4 if case.theory.bending else 3  # bending has an auxiliary unknown
    solver = assembly(mesh.template, components)
    elastic = _elastic(case, mesh.geometry, case.force)
    if case.theory.stretching:
        result = _solve_nonlinear(case, elastic, solver, mesh, start)
    else:
        result = solve_linear(elastic, solver)
    equilibrium = Equilibrium(
        film=case.film,
        probe=case.probe,
        at=case.at,
        force=case.force,
        side_force=case.side_force,
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
    if case.film.static_pressure == 0.0:
        return equilibrium
    return _with_rest(equilibrium, case.tolerance)


def _with_rest(equilibrium: Equilibrium, tolerance: float) -> Equilibrium:
    """Solve the film under the static pressure alone, and store the solution as `rest` of the equilibrium of a press.

    Args:
        equilibrium: Equilibrium of the press.
        tolerance: Relative residual at which the solve has converged.

    Returns:
        The equilibrium of the press with the film before the contact as `rest`.
    """
    mesh = equilibrium.mesh
    elastic = ElasticFilm(mesh.geometry, equilibrium.groups.without_probe)
    solver = assembly(mesh.template, elastic.components)
    first_field = _static_start(mesh, elastic.groups)
    result = solve_newton(elastic, solver, first_field, tolerance)

    # Both solves count as iterations, and both must converge.
    rest = replace(equilibrium, groups=elastic.groups, field=result.field, force=0.0, side_force=(0.0, 0.0))
    equilibrium = replace(equilibrium, rest=rest, iterations=equilibrium.iterations + result.iterations)
    if result.converged:
        return equilibrium
    message = f"under the static pressure without a contact, {result.message}"
    return replace(equilibrium, status="failed", message=message)


def _static_start(mesh: PlacedMesh, groups: DimensionlessGroups) -> Array:
    """Return the first iterate of a film under the static pressure, shape (n_node, 3)."""
    return parabolic_start(np.abs(from_oval(mesh.node_points, mesh.oval)), groups)


def _elastic(case: LoadCase, geometry: Geometry, force: float) -> ElasticFilm:
    """Return the discrete film for a press with another force. The side force is scaled by the same factor.

    Args:
        case: The press.
        geometry: Integration rules of the elements.
        force: The other force, N.
    """
    x, y = case.at
    force_factor = force / case.force
    side_x, side_y = case.side_force
    direction = float(np.arctan2(y, x))  # of the press from the centre
    groups = DimensionlessGroups.of(
        case.film,
        force,
        bending=case.theory.bending,
        angle=direction,
        side_force=(force_factor * side_x, force_factor * side_y),
    )
    return ElasticFilm(geometry, groups)


def _solve_nonlinear(
    case: LoadCase, elastic: ElasticFilm, solver: Assembly, mesh: PlacedMesh, start: Equilibrium | None
) -> NewtonResult:
    """Solve with Newton's method.

    The first iterate is the field of the starting equilibrium if this equilibrium has the same mesh. Otherwise it is
    the field of `schwerin_start`. If Newton's method fails, the load is applied in steps.

    Args:
        case: The press and its tolerance.
        elastic: The discrete film.
        solver: Linear solver for the mesh.
        mesh: The mesh.
        start: Equilibrium of a similar press; None if there is none.

    Returns:
        The result, which may not have converged.
    """
    # First iterate without a starting equilibrium
    template_points = mesh.placement.to_template(from_oval(mesh.node_points, mesh.oval))
    schwerin_field = schwerin_start(template_points, float(mesh.placement.rho), elastic.groups)
    if elastic.groups.static_pressure != 0.0:
        schwerin_field += _static_start(mesh, elastic.groups)

    start_field = _start_field(start, mesh.template, default=schwerin_field)
    result = solve_newton(elastic, solver, start_field, case.tolerance)
    if result.converged:
        return result
    return _solve_by_load_steps(case, result, mesh.geometry, solver, schwerin_field)


def _solve_by_load_steps(
    case: LoadCase, failed: NewtonResult, geometry: Geometry, solver: Assembly, first_field: Array
) -> NewtonResult:
    """Solve with increasing forces, after the solve with the full force has failed.

    Each solve starts from the field of the largest force with an equilibrium. The force is doubled after a solve. If a
    solve fails, the factor is reduced to its square root. If the solve with the smallest force fails, no further force
    is tried.

    Args:
        case: The press.
        failed: Result of the solve with the full force.
        geometry: Elements of the mesh.
        solver: Linear solver for the mesh.
        first_field: First iterate of the smallest force, shape (n_node, 3).

    Returns:
        The result with the full force, or `failed` with the total number of iterations.
    """
    solved_force = 0.0  # largest force with an equilibrium
    force_ratio = 2.0  # of the next force to `solved_force`
    iterations = failed.iterations
    field = first_field
    force = FIRST_LOAD_SHARE * case.force
    for _ in range(MAX_LOAD_STEPS):
        # A start from an equilibrium is close to the solution, so full Newton steps are allowed from the beginning.
        local_below = np.inf if solved_force else GUARD_BELOW
        result = solve_newton(_elastic(case, geometry, force), solver, field, case.tolerance, local_below)
        iterations += result.iterations
        if result.converged and force == case.force:
            message = f"converged in {iterations} steps, the load in parts"
            return replace(result, iterations=iterations, message=message)
        if result.converged:
            solved_force = force
            field = result.field
        elif solved_force == 0.0:
            break
        else:
            force_ratio = np.sqrt(force_ratio)
        force = min(case.force, solved_force * force_ratio)
    return replace(failed, iterations=iterations)


def _start_field(start: Equilibrium | None, template: Template, default: Array) -> Array:
    """Return the first iterate of Newton's method, shape (n_node, 3).

    This is the field of the starting equilibrium if its mesh has the same elements. If the elements have another order,
    the field is interpolated.

    Args:
        start: Equilibrium of a similar press; None if there is none.
        template: Template of the mesh.
        default: Field that is returned if the mesh of `start` differs in more than the order of its elements.
    """
    if start is None:
        return default
    start_template = start.mesh.template
    # Compare the blocks, the resolution except for the order, and the refinement along a coat.
    if (start_template.topology, start_template.half) != (template.topology, template.half):
        return default
    resolution_with_same_order = replace(start_template.resolution, order=template.resolution.order)
    has_same_elements = resolution_with_same_order == template.resolution
    if not has_same_elements or not np.array_equal(start_template.splits, template.splits):
        return default
    if start_template.resolution == template.resolution:
        return start.field
    return resampled(start.field, start_template, template)


def resampled(field: Array, before: Template, after: Template) -> Array:
    """Interpolate a nodal field to the same mesh with elements of another order.

    Args:
        field: Values at the nodes of `before`, shape (n_node_before, 3).
        before: Template of the field.
        after: Template with elements of another order.

    Returns:
        Values at the nodes of `after`, shape (n_node, 3).
    """
    values = tensor_values(before.resolution.order, after.xi, after.eta)
    interpolated = np.empty((after.n_node, 3))
    # A node of several elements is assigned several times. The field is continuous, so the values are equal.
    interpolated[after.nodes] = values @ field[before.nodes]
    return interpolated


def _failure_reason(solved: Equilibrium, tolerance: float) -> str:
    """Return the error message of a failed solve.

    Args:
        solved: Result of the failed solve.
        tolerance: Relative residual that was expected.
    """
    x, y = solved.at
    smallest_stress, _ = principal_stress(solved)
    message = (
        f"no equilibrium at {solved.force:.4g} N, position ({x:.4g}, {y:.4g}) mm: {solved.message}; "
        f"residual {solved.residual:.2g} (expected {tolerance:.2g}) after {solved.iterations} steps"
    )
    if smallest_stress < 0.0:
        message += (
            f"; the film is compressed to {smallest_stress:.3g} MPa on the way: it wrinkles, which has many solutions; "
            "press farther from the rim, with less force, or give the film a pretension"
        )
    return message
