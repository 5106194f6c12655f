"""Solving the film under a press."""

from dataclasses import dataclass, replace
from time import process_time

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import SceneError, SolveError
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import DimensionlessGroups, amplitude_squared
from isocharge.simulate.mechanics.theory import Theory, choose_theory
from isocharge.simulate.mesh.elements import Geometry
from isocharge.simulate.mesh.placement import Placement, place, template_for
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe, farthest
from isocharge.simulate.solver.assembly import Assembly, assembly
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.error_estimate import shape_error
from isocharge.simulate.solver.mesh_choice import layer_for, resolution_for, too_near_the_rim
from isocharge.simulate.solver.mesh_comparison import ANOTHER, MOST_ORDERS, needs_second_mesh, relative_difference
from isocharge.simulate.solver.newton import GUARD_BELOW, NewtonResult, schwerin_start, solve_linear, solve_newton
from isocharge.simulate.solver.settings import SolveSettings

LAYER_REUSE = (0.75, 2.0)
"""Width of a neighbour's thin rings over one's own, between which it is taken over, so that its field still fits."""

FIRST_LOAD, LOAD_STEPS = 1.0 / 16.0, 12
"""Where it did not go at once: share of the load to begin with, and how many parts to try."""

LARGEST_AMPLITUDE2 = 0.1
"""A^2, the size of the strains, above which St. Venant-Kirchhoff elasticity is out of its range: 100 N at 25 um."""

SMALLEST_PROBE = 1e-5
"""Probe reach over film radius below which the template's grading runs out of digits."""


def check_scene(film: Film, probe: Probe, at: tuple[float, float], force: float) -> None:
    """Refuse presses that cannot exist, and those outside of what St. Venant-Kirchhoff elasticity says anything about.

    Raises:
        SceneError: If the footprint is not wholly on the film or hardly there, the force is not positive and finite, or
            the film is stretched beyond small strains.
    """
    if not (np.isfinite(force) and force > 0.0):
        raise SceneError(f"force: expected a positive number of newtons (F > 0 pushes), got {force}")
    if not np.isfinite(at).all():
        raise SceneError(f"position: expected two finite numbers, got {at}")
    if probe.reach < SMALLEST_PROBE * film.radius:
        raise SceneError(
            f"probe: expected a reach of at least {SMALLEST_PROBE:g} of the film's radius "
            f"({film.radius * 1e3:.4g} mm), got {probe.reach * 1e3:.4g} mm"
        )
    if farthest(probe, at) >= film.radius * (1.0 - 1e-6):
        raise SceneError(
            f"probe off the film: centre ({at[0] * 1e3:.4g}, {at[1] * 1e3:.4g}) mm, farthest point of {probe.notation} "
            f"{farthest(probe, at) * 1e3:.4g} mm from the film's centre, film radius {film.radius * 1e3:.4g} mm"
        )
    amplitude2 = amplitude_squared(film, force)
    if amplitude2 > LARGEST_AMPLITUDE2:
        raise SceneError(
            f"force {force:.4g} N stretches a film of {film.thickness * 1e6:.4g} um beyond small strains: expected "
            f"(F / (E h a))^(2/3) up to {LARGEST_AMPLITUDE2:g}, got {amplitude2:.3g}"
        )


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
        SolveError: If no equilibrium was found and `throw` is set.
    """
    check_scene(film, probe, at, force)
    theory = settings.theory or choose_theory(film, probe, force, settings.accuracy)
    began = process_time()
    layer = settings.layer or _layer(film, force, probe, settings.resolution, start)
    scene = _Scene(film, probe, at, force, theory, layer, settings.tolerance)
    with single_threaded_blas():
        if settings.resolution is None and needs_second_mesh(film, probe, at, settings.accuracy):
            solved = _solve_until_meshes_agree(scene, settings.accuracy, start)
        else:
            solved = scene.solve(settings.resolution or scene.resolution(settings.accuracy), start)
    solved = replace(solved, seconds=process_time() - began)
    if throw and solved.status != "converged":
        raise SolveError(_failure_reason(solved, settings.tolerance))
    return solved


@dataclass(frozen=True)
class _Scene:
    """A press with all that is decided about it but the mesh; the attributes are those of `press`."""

    film: Film
    probe: Probe
    at: tuple[float, float]
    force: float
    theory: Theory
    layer: float
    tolerance: float

    def resolution(self, accuracy: float) -> Resolution:
        """The coarsest mesh that seems to be enough."""
        return resolution_for(self.film, self.probe, self.at, self.theory, accuracy, self.layer)

    def solve(self, resolution: Resolution, start: Equilibrium | None) -> Equilibrium:
        """Solve on one mesh."""
        mesh, placement = self._mesh(resolution)
        points = placement.element_points(mesh)
        geometry = Geometry.build(mesh, points)
        if np.isinf(shape_error(mesh, geometry)):
            raise too_near_the_rim(self.film, self.probe, self.at, resolution)
        solver = assembly(resolution, mesh.corners, 4 if self.theory.bending else 3)
        elastic = self._elastic(geometry, self.force)
        if self.theory.stretching:
            z = placement.to_template(points.ravel()[mesh.first_seen])
            cold = schwerin_start(z, float(placement.rho), elastic.groups)
            found = solve_newton(elastic, solver, self._start(start, resolution, cold), self.tolerance)
            found = found if found.converged else self._by_load_steps(found, geometry, solver, cold)
        else:
            found = solve_linear(elastic, solver)
        return Equilibrium(
            self.film, self.probe, self.at, self.force, self.theory, resolution, self.layer, found.field,
            elastic.groups,
            status="converged" if found.converged else "failed",
            message=found.message,
            iterations=found.iterations,
            residual=found.residual,
            seconds=0.0,
        )  # fmt: skip

    def _mesh(self, resolution: Resolution) -> tuple[Template, Placement]:
        mesh = template_for(self.probe, resolution)
        return mesh, place(self.film, self.probe, self.at, resolution, self.layer)

    def _elastic(self, geometry: Geometry, force: float) -> ElasticFilm:
        return ElasticFilm(geometry, DimensionlessGroups.of(self.film, force, bending=self.theory.bending))

    def _start(self, start: Equilibrium | None, resolution: Resolution, cold: Array) -> Array:
        """A neighbour's field where its mesh is the same, but perhaps for the order; else the cold start."""
        if start is None or start.mesh.corners != template_for(self.probe, resolution).corners:
            return cold
        if replace(start.resolution, order=resolution.order) != resolution:
            return cold
        return start.field if start.resolution == resolution else start.field_of_order(resolution.order)

    def _by_load_steps(self, failed: NewtonResult, geometry: Geometry, solver: Assembly, cold: Array) -> NewtonResult:
        """Follow the equilibrium up from a small force where the film at once runs away into wrinkles."""
        reached, ratio, steps, field = 0.0, 2.0, failed.iterations, cold
        wanted = FIRST_LOAD * self.force
        for _ in range(LOAD_STEPS):
            near = np.inf if reached else GUARD_BELOW
            found = solve_newton(self._elastic(geometry, wanted), solver, field, self.tolerance, near)
            steps += found.iterations
            if found.converged and wanted == self.force:
                return replace(found, iterations=steps, message=f"converged in {steps} steps, the load in parts")
            if found.converged:
                reached, field = wanted, found.field
            elif reached == 0.0:
                break
            else:
                ratio = np.sqrt(ratio)
            wanted = min(self.force, reached * ratio)
        return replace(failed, iterations=steps)


def _solve_until_meshes_agree(scene: _Scene, accuracy: float, start: Equilibrium | None) -> Equilibrium:
    """Solve on meshes of rising order until two agree to half of the accuracy, or `MOST_ORDERS` have been tried.

    Where a still finer mesh finds no rest, what two meshes agreed on stands, with their difference as its error.
    Two that have found different equilibria are no answer.
    """
    solved = scene.solve(scene.resolution(accuracy), start)
    for _ in range(MOST_ORDERS):
        if solved.status != "converged":
            return solved
        finer = scene.solve(replace(solved.resolution, order=solved.resolution.order + 1), solved)
        if finer.status != "converged" and solved.proven_error is not None:
            break
        error = relative_difference(solved, finer) if finer.status == "converged" else None
        solved = replace(finer, iterations=solved.iterations + finer.iterations, proven_error=error)
        if error is not None and error <= 0.5 * accuracy:
            break
    if solved.proven_error is not None and solved.proven_error > ANOTHER:
        return replace(
            solved,
            status="failed",
            message=f"a mesh of order {solved.resolution.order - 1} and one of order {solved.resolution.order} find "
            f"charges that differ by {solved.proven_error:.0%}",
        )
    return solved


def _layer(film: Film, force: float, probe: Probe, resolution: Resolution | None, start: Equilibrium | None) -> float:
    """Width of the thin rings: the scene's own, or the start's where that will do."""
    own = layer_for(film, force)
    if start is None or not LAYER_REUSE[0] < start.layer / own < LAYER_REUSE[1]:
        return own
    same = resolution in (None, start.resolution) and template_for(probe, start.resolution) is start.mesh
    return start.layer if same else own


def _failure_reason(solved: Equilibrium, tolerance: float) -> str:
    """Why there is no answer."""
    (x, y), smallest = solved.at, solved.principal_stress[0]
    wrinkles = (
        f"; the film is compressed to {smallest * 1e-6:.3g} MPa on the way: it wrinkles, which has many solutions; "
        "press farther from the rim, with less force, or give the film a pretension"
    )
    return (
        f"no equilibrium at {solved.force:.4g} N, position ({x * 1e3:.4g}, {y * 1e3:.4g}) mm: {solved.message}; "
        f"residual {solved.residual:.2g} ({tolerance:.2g} asked for) after {solved.iterations} steps"
        + (wrinkles if smallest < 0.0 else "")
    )
