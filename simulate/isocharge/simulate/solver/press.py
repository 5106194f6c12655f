"""Solving the film under a press."""

from dataclasses import replace

from isocharge.common.errors import SolveError
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.mesh_comparison import ANOTHER, MOST_ORDERS, needs_second_mesh, relative_difference
from isocharge.simulate.solver.scene import Scene, check_scene
from isocharge.simulate.solver.settings import SolveSettings


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
        at: Centroid of the footprint (x, y), m.
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
    check_scene(film, probe, at, force)
    scene = Scene.of(film, probe, at, force, settings, start)
    with single_threaded_blas():
        if settings.resolution:
            solved = scene.solve(scene.place(settings.resolution), start)
        elif needs_second_mesh(film, probe, at, settings.accuracy):
            solved = _solve_until_meshes_agree(scene, start)
        else:
            solved = scene.solve(scene.choose_mesh(), start)
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
    check_scene(film, probe, at, force)
    if settings.resolution:
        return settings.resolution
    if needs_second_mesh(film, probe, at, settings.accuracy):
        return press(film, probe, at, force, settings).resolution
    return Scene.of(film, probe, at, force, settings, None).choose_mesh().resolution


def _solve_until_meshes_agree(scene: Scene, start: Equilibrium | None) -> Equilibrium:
    """Solve on meshes of rising order until two agree to half of the accuracy, or `MOST_ORDERS` have been tried.

    If a still finer mesh finds no equilibrium, the finer of the two before is the answer, with their difference as its
    error. Two meshes with different equilibria give no answer: the status is "failed".
    """
    solved = scene.solve(scene.choose_mesh(), start)
    for _ in range(MOST_ORDERS):
        if solved.status != "converged":
            return solved
        finer = scene.solve(scene.place(replace(solved.resolution, order=solved.resolution.order + 1)), solved)
        if finer.status != "converged" and solved.proven_error is not None:
            break
        error = relative_difference(solved, finer) if finer.status == "converged" else None
        solved = replace(finer, iterations=solved.iterations + finer.iterations, proven_error=error)
        if error is not None and error <= 0.5 * scene.accuracy:
            break
    if solved.proven_error is not None and solved.proven_error > ANOTHER:
        return replace(
            solved,
            status="failed",
            message=f"a mesh of order {solved.resolution.order - 1} and one of order {solved.resolution.order} find "
            f"charges that differ by {solved.proven_error:.0%}",
        )
    return solved


def _failure_reason(solved: Equilibrium, tolerance: float) -> str:
    """Why the solve failed, for the error message."""
    (x, y), smallest = solved.at, solved.principal_stress[0]
    wrinkles = (
        f"; the film is compressed to {smallest * 1e-6:.3g} MPa on the way: it wrinkles, which has many solutions; "
        "press farther from the rim, with less force, or give the film a pretension"
    )
    return (
        f"no equilibrium at {solved.force:.4g} N, position ({x * 1e3:.4g}, {y * 1e3:.4g}) mm: {solved.message}; "
        f"residual {solved.residual:.2g} (expected {tolerance:.2g}) after {solved.iterations} steps"
        + (wrinkles if smallest < 0.0 else "")
    )
