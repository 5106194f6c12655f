"""Computation of the equilibrium of a film under a probe.

The solver chooses the mesh, and solves the press with the selected theory. If the solve with the full load fails, the
load is applied in steps.
"""

from dataclasses import replace
from time import process_time

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SolveError
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.theory import DimensionlessGroups
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.numerics.interpolation import tensor_values
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.solver.assembly import single_threaded_blas
from isocharge.simulate.solver.equilibrium import Equilibrium, principal_stress, relative_difference
from isocharge.simulate.solver.load_case import (
    LoadCase,
    SolveSettings,
    choose_mesh,
    needs_second_mesh,
    too_near_the_rim,
)
from isocharge.simulate.solver.newton import (
    UNSTABILISED_BELOW,
    NewtonResult,
    first_iterate,
    solve_newton,
)

MAX_EXTRA_ORDERS = 3
"""Largest number of meshes that are tried after the first mesh. Each has the next higher order of the elements."""

DIFFERENT_EQUILIBRIUM = 0.1
"""Relative difference of the charges above which the solutions on two meshes are treated as different equilibria.

A film that wrinkles has many equilibria.
"""


def press(
    film: Film,
    probe: Probe,
    at: tuple[float, float],
    force: float,
    settings: SolveSettings = SolveSettings(),
    *,
    side_force: tuple[float, float] = (0.0, 0.0),
    start: Equilibrium | None = None,
) -> Equilibrium:
    """Solve the equilibrium of the film under a press.

    Args:
        film: The clamped film.
        probe: The probe. The direction of its pressure does not change while the film deflects. The attribute `probe`
            of the result is the probe with its footprint under the given force.
        at: Centroid (x, y) of the footprint, mm.
        force: Force, N, positive in the direction of the push.
        settings: Accuracy, theory and mesh.
        side_force: Force (Fx, Fy) of the probe on the film in the plane of the film, N. The side force is distributed
            over the footprint like the pressure, and its direction does not change. `solver.sensitivity.friction_force`
            computes the side force of a probe with friction.
        start: Equilibrium of a similar press on the same mesh, whose field is the first iterate; None if there is no
            such equilibrium.

    Returns:
        The equilibrium.

    Raises:
        SceneError: If the press cannot exist, or if the mesh is too distorted.
        SolveError: If the solve fails.
    """
    # `case.place` and `choose_mesh` return a mesh: with a given resolution, or with the coarsest sufficient resolution.
    case = LoadCase(film, probe.under(force), at, force, settings, side_force)
    with single_threaded_blas():
        if settings.resolution != "auto":
            solved = _solve(case, case.place(settings.resolution), start)
        elif needs_second_mesh(case):
            solved = _solve_until_meshes_agree(case, start)
        else:
            solved = _solve(case, choose_mesh(case), start)
    if solved.status != "converged":
        raise SolveError(_failure_reason(solved, settings.tolerance))
    return solved


def needed_resolution(
    film: Film, probe: Probe, at: tuple[float, float], force: float, settings: SolveSettings = SolveSettings()
) -> Resolution:
    """Return the resolution that the function `press` would choose for a press.

    The press is solved only if the solutions on two meshes must be compared.

    Args:
        film: The clamped film.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.
        force: Force, N.
        settings: Accuracy, theory and mesh.

    Raises:
        SceneError: If the press cannot exist, or if every mesh for the press is too distorted.
        SolveError: If two meshes must be compared and no equilibrium is found.
    """
    case = LoadCase(film, probe.under(force), at, force, settings)  # `under` returns the probe with its footprint
    if settings.resolution != "auto":
        return settings.resolution
    if needs_second_mesh(case):
        return press(film, probe, at, force, settings).mesh.resolution
    return choose_mesh(case).resolution


def _solve_until_meshes_agree(case: LoadCase, start: Equilibrium | None) -> Equilibrium:
    """Solve a press on meshes of increasing order until the charges on two meshes agree.

    The charges agree if their relative difference is at most half of the required accuracy. The order is increased at
    most `MAX_EXTRA_ORDERS` times.

    The status of the result is "failed" if no equilibrium is found on the first or the second mesh. The status is also
    "failed" if the charges on the last two meshes differ by more than `DIFFERENT_EQUILIBRIUM`. If no equilibrium is
    found on a later mesh, the result is the equilibrium on the previous mesh.

    Args:
        case: The press and the required accuracy.
        start: Equilibrium of a similar press from which the first solve starts; None if there is no such equilibrium.

    Returns:
        Equilibrium on the finest mesh. Its `proven_error` is the relative difference between the charges on this mesh
        and on the previous mesh.
    """
    solved = _solve(case, choose_mesh(case), start)
    if solved.status != "converged":
        return solved
    for _ in range(MAX_EXTRA_ORDERS):
        resolution = solved.mesh.resolution
        finer_mesh = case.place(replace(resolution, order=resolution.order + 1))
        finer_equilibrium = _solve(case, finer_mesh, solved)
        iterations = solved.iterations + finer_equilibrium.iterations
        if finer_equilibrium.status != "converged":
            if solved.proven_error is None:  # only one mesh is solved, so that its error is unknown
                return replace(finer_equilibrium, iterations=iterations)
            break  # the equilibrium on the previous mesh is the result
        error = relative_difference(solved, finer_equilibrium)
        solved = replace(finer_equilibrium, iterations=iterations, proven_error=error)
        if error <= 0.5 * case.settings.accuracy:
            break

    # If the charges differ very much, the two meshes have different equilibria.
    if solved.proven_error is not None and solved.proven_error > DIFFERENT_EQUILIBRIUM:
        order = solved.mesh.resolution.order
        message = f"a mesh of order {order - 1} and one of order {order} find charges that differ by "
        return replace(solved, status="failed", message=f"{message}{solved.proven_error:.0%}")
    return solved


def _solve(case: LoadCase, mesh: PlacedMesh, start: Equilibrium | None) -> Equilibrium:
    """Solve a press on a given mesh.

    Args:
        case: The press and the settings of its solve.
        mesh: The mesh.
        start: Equilibrium of a similar press from which the solve starts; None if there is no such equilibrium.

    Returns:
        The equilibrium. Its status is "failed" if no equilibrium was found.

    Raises:
        SceneError: If an element of the mesh is folded.
    """
    if np.isinf(mesh.shape_error):  # the predicted error is infinite if an element is folded
        raise too_near_the_rim(case, mesh.resolution)
    elastic = _elastic_film(case, mesh, case.force)

    # If Newton's method fails, the load is applied in steps.
    result = solve_newton(elastic, _first_field(start, elastic), case.settings.tolerance)
    if result.status == "failed":
        result = _solve_by_load_steps(case, result, elastic)

    # A compressed film can bulge to either side. Under a static pressure, a film may bulge against the push.
    mean_deflection = mesh.load @ result.field[:, 2]  # under the probe, weighted with its pressure
    has_static_pressure = case.film.static_pressure != 0.0
    if mean_deflection < 0.0 and not has_static_pressure:
        result = replace(result, status="failed", message="the film bulges against the push")

    equilibrium = Equilibrium(
        film=case.film,
        probe=case.probe,
        at=case.at,
        force=case.force,
        side_force=case.side_force,
        theory=case.settings.theory,
        mesh=mesh,
        groups=elastic.groups,
        seconds=process_time() - case.began,
        **vars(result),
    )
    # With a static pressure, add the equilibrium before the contact.
    if has_static_pressure:
        return _with_rest(equilibrium, case.settings.tolerance)
    return equilibrium


def _with_rest(equilibrium: Equilibrium, tolerance: float) -> Equilibrium:
    """Solve the film before the contact, and add the solution to an equilibrium as the attribute `rest`.

    Before the contact, only the static pressure acts on the film. The touch stress is the stress under the press minus
    the stress before the contact.

    Args:
        equilibrium: Equilibrium of the press.
        tolerance: Largest relative residual that a converged solve may have.

    Returns:
        Equilibrium of the press with the attribute `rest`. Its status is "failed" if no equilibrium before the contact
        is found.
    """
    # `groups` contains the dimensionless numbers of the press. Without the force of the probe, they still refer to the
    # units of the press, so that the stresses can be subtracted.
    groups = replace(equilibrium.groups, load=0.0, side_load=(0.0, 0.0))
    elastic = ElasticFilm(equilibrium.mesh, groups)
    result = solve_newton(elastic, first_iterate(elastic), tolerance)

    # The number of iterations includes those of both solves.
    rest = replace(equilibrium, groups=groups, field=result.field, force=0.0, side_force=(0.0, 0.0))
    iterations = equilibrium.iterations + result.iterations
    equilibrium_with_rest = replace(equilibrium, rest=rest, iterations=iterations)
    if result.status == "converged":
        return equilibrium_with_rest
    message = f"under the static pressure without a contact, {result.message}"
    return replace(equilibrium_with_rest, status="failed", message=message)


def _elastic_film(case: LoadCase, mesh: PlacedMesh, force: float) -> ElasticFilm:
    """Create the discrete model of the film for a given press and a given force.

    The force may differ from the force of the press. The side force is changed in proportion to the force.

    Args:
        case: The press.
        mesh: Mesh of the press.
        force: Force of the model, N.
    """
    x, y = case.at
    force_factor = force / case.force
    side_x, side_y = case.side_force
    direction = float(np.arctan2(y, x))  # from the centre of the film to the press
    groups = DimensionlessGroups.of(
        case.film,
        force,
        bending=case.settings.theory.bending,
        angle=direction,
        side_force=(force_factor * side_x, force_factor * side_y),
    )
    return ElasticFilm(mesh, groups)


def _solve_by_load_steps(case: LoadCase, failed: NewtonResult, full_load: ElasticFilm) -> NewtonResult:
    """Solve a press for increasing forces, because the solve with the full force has failed.

    The first force is a sixteenth of the full force. At most twelve forces are tried.

    Each solve starts from the field under the largest force for which an equilibrium was found. After each successful
    solve, the force is multiplied by a factor, which is two at the beginning. After each failed solve, the factor is
    replaced by its square root, and the smaller force is tried. The attempts end as soon as the remaining solves could
    not reach the full force, even if all of them succeeded. They also end if the solve with the first force fails. The
    early end saves time, because each failed solve of a film that wrinkles takes seconds.

    Args:
        case: The press.
        failed: Result of the failed solve with the full force.
        full_load: Discrete model of the film under the full force.

    Returns:
        Result of a successful solve with the full force. If no such solve succeeds, `failed` is returned with the total
        number of iterations.
    """
    solved_force = 0.0  # largest force with an equilibrium; 0 if there is none
    force_factor = 2.0  # ratio of the next force to `solved_force`
    iterations = failed.iterations  # of all solves
    field = first_iterate(full_load)
    force = case.force / 16.0
    for tries_left in reversed(range(12)):
        # Full Newton steps are allowed if the relative residual is below a limit. The field under a smaller force is
        # close to the solution, so full steps are then allowed from the start.
        full_steps_below = np.inf if solved_force > 0.0 else UNSTABILISED_BELOW
        elastic = _elastic_film(case, full_load.mesh, force)
        result = solve_newton(elastic, field, case.settings.tolerance, full_steps_below)
        iterations += result.iterations
        # The comparison of the forces is exact, because the last force is set to the full force by `min` below.
        if result.status == "converged" and force == case.force:
            message = f"converged in {iterations} steps, the load in parts"
            return replace(result, iterations=iterations, message=message)

        # Choose the next force.
        if result.status == "converged":
            solved_force = force
            field = result.field
        else:
            force_factor = np.sqrt(force_factor)
        # Stop if the full force is out of reach. This is always so if the first force failed: `solved_force` is zero.
        if solved_force * force_factor**tries_left < case.force:
            break
        force = min(case.force, solved_force * force_factor)
    return replace(failed, iterations=iterations)


def _first_field(start: Equilibrium | None, elastic: ElasticFilm) -> Array:
    """Return the first iterate of Newton's method, shape (n_node, 3).

    If the mesh of the starting equilibrium has the same elements, its field is interpolated to the nodes of the new
    mesh. The polynomial orders of the elements may differ. In all other cases, the first iterate is an approximate
    deflection under the probe and the static pressure.

    Args:
        start: Equilibrium of a similar press; None if there is no such equilibrium.
        elastic: Discrete model of the film under the press.
    """
    if start is None:
        return first_iterate(elastic)

    # Both meshes have the same elements if the topology, the symmetry (whether only half of the film is meshed), and
    # the resolution except for the order agree. The order is therefore made equal for the comparison.
    template = elastic.mesh.template
    start_template = start.mesh.template
    start_resolution = replace(start_template.resolution, order=template.resolution.order)
    start_elements = (start_template.topology, start_template.half, start_resolution)
    if start_elements != (template.topology, template.half, template.resolution):
        return first_iterate(elastic)

    # Evaluate the field of each element at the nodes of its new order. A node that several elements share is assigned
    # several times. The values are equal, because the field is continuous.
    basis_values = tensor_values(start_template.resolution.order, template.xi, template.eta)
    field = np.empty((template.n_node, 3))
    field[template.nodes] = basis_values @ start.field[start_template.nodes]
    return field


def _failure_reason(solved: Equilibrium, tolerance: float) -> str:
    """Return the error message of a failed solve.

    If the film is compressed, the message explains that the film wrinkles, and what the user can do.

    Args:
        solved: Result of the failed solve.
        tolerance: Relative residual that was required.
    """
    x, y = solved.at
    smallest_stress, _ = principal_stress(solved)
    message = (
        f"no equilibrium at {solved.force:.4g} N, position ({x:.4g}, {y:.4g}) mm: {solved.message}; "
        f"residual {solved.residual:.2g} (expected {tolerance:.2g}) after {solved.iterations} steps"
    )
    if smallest_stress < 0.0:
        # A larger force stretches a film that is slack in a direction, so that fewer wrinkles remain. The deviator is
        # the uneven part of the pretension. Its magnitude is the mean pretension minus the smallest pretension.
        is_slack = solved.film.pretension < np.hypot(*solved.film.deviator)
        message += (
            f"; the film is compressed to {smallest_stress:.3g} MPa on the way: it wrinkles, which has many solutions; "
            f"press farther from the rim, with {'more' if is_slack else 'less'} force, or give the film a pretension"
        )
    return message
