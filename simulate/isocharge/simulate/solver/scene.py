"""A press with what is decided about it, solved on one mesh."""

from dataclasses import dataclass, replace
from time import process_time
from typing import Self

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import DimensionlessGroups, amplitude_squared
from isocharge.simulate.mechanics.theory import Theory, choose_theory
from isocharge.simulate.mesh.elements import Geometry
from isocharge.simulate.mesh.placed_mesh import PlacedMesh, place
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.mesh.template import Template, corners_of
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe, farthest
from isocharge.simulate.solver.assembly import Assembly, assembly
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.error_estimate import shape_error
from isocharge.simulate.solver.mesh_choice import choose_mesh, layer_for, too_near_the_rim
from isocharge.simulate.solver.newton import GUARD_BELOW, NewtonResult, schwerin_start, solve_linear, solve_newton
from isocharge.simulate.solver.settings import SolveSettings

LAYER_REUSE = (0.75, 2.0)
"""Width of the start's thin rings over six bending lengths: between these ratios the width is kept, so that the start's
field still fits."""

FIRST_LOAD, LOAD_STEPS = 1.0 / 16.0, 12
"""If the full load fails at once: share of the load to begin with, and how many loads to try at most."""

LARGEST_AMPLITUDE2 = 0.1
"""A^2, the size of the strains, dimensionless, above which St. Venant-Kirchhoff elasticity fails: 100 N at 25 um."""

SMALLEST_PROBE = 1e-5
"""Probe reach over film radius: below it the grading of the template exceeds what float64 resolves."""


def check_scene(film: Film, probe: Probe, at: tuple[float, float], force: float) -> None:
    """Refuse presses that cannot exist or that stretch the film beyond the range of St. Venant-Kirchhoff elasticity.

    Raises:
        SceneError: If the footprint is too small or not wholly on the film, the force is not positive and finite, or
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


@dataclass(frozen=True)
class Scene:
    """A press with all that is decided about it but the mesh.

    Attributes:
        film: The film.
        probe: The footprint.
        at: Its centroid (x, y), m.
        force: N.
        theory: Which terms to model.
        layer: Width of the thin rings at the rim over the film's radius.
        accuracy: Target for the relative error of a charge.
        tolerance: Out-of-balance force over load.
        began_s: Process CPU time when the work on the press began, s.
    """

    film: Film
    probe: Probe
    at: tuple[float, float]
    force: float
    theory: Theory
    layer: float
    accuracy: float
    tolerance: float
    began_s: float

    @classmethod
    def of(
        cls,
        film: Film,
        probe: Probe,
        at: tuple[float, float],
        force: float,
        settings: SolveSettings,
        start: Equilibrium | None,
    ) -> Self:
        """Decide what the settings leave open."""
        began_s = process_time()
        theory = settings.theory or choose_theory(film, probe, force, settings.accuracy)
        layer = settings.layer or _layer(film, force, probe, settings.resolution, start)
        return cls(film, probe, at, force, theory, layer, settings.accuracy, settings.tolerance, began_s)

    def place(self, resolution: Resolution) -> PlacedMesh:
        """A mesh under this press."""
        return place(self.film, self.probe, self.at, resolution, self.layer)

    def choose_mesh(self) -> PlacedMesh:
        """The coarsest mesh whose shapes predict the accuracy."""
        return choose_mesh(self.film, self.probe, self.at, self.theory, self.accuracy, self.layer)

    def solve(self, mesh: PlacedMesh, start: Equilibrium | None) -> Equilibrium:
        """Solve on one mesh."""
        if np.isinf(shape_error(mesh)):
            raise too_near_the_rim(self.film, self.probe, self.at, mesh.resolution)
        solver = assembly(mesh.resolution, mesh.template.corners, 4 if self.theory.bending else 3)
        elastic = self._elastic(mesh.geometry, self.force)
        result = self._newton(elastic, solver, mesh, start) if self.theory.stretching else solve_linear(elastic, solver)
        return Equilibrium(
            film=self.film,
            probe=self.probe,
            at=self.at,
            force=self.force,
            theory=self.theory,
            placed_mesh=mesh,
            field=result.field,
            groups=elastic.groups,
            status="converged" if result.converged else "failed",
            message=result.message,
            iterations=result.iterations,
            residual=result.residual,
            seconds=process_time() - self.began_s,
        )

    def _newton(
        self, elastic: ElasticFilm, solver: Assembly, mesh: PlacedMesh, start: Equilibrium | None
    ) -> NewtonResult:
        """Newton's method from the start if its mesh fits, else from Schwerin's field; by load steps if that fails."""
        z = mesh.placement.to_template(mesh.node_points)
        cold = schwerin_start(z, float(mesh.placement.rho), elastic.groups)
        result = solve_newton(elastic, solver, _start_field(start, mesh.template, cold), self.tolerance)
        return result if result.converged else self._by_load_steps(result, mesh.geometry, solver, cold)

    def _elastic(self, geometry: Geometry, force: float) -> ElasticFilm:
        return ElasticFilm(geometry, DimensionlessGroups.of(self.film, force, bending=self.theory.bending))

    def _by_load_steps(self, failed: NewtonResult, geometry: Geometry, solver: Assembly, cold: Array) -> NewtonResult:
        """Follow the equilibrium up from a small force where at the full force the film runs away into wrinkles."""
        reached, ratio, steps, field = 0.0, 2.0, failed.iterations, cold
        force = FIRST_LOAD * self.force
        for _ in range(LOAD_STEPS):
            near = np.inf if reached else GUARD_BELOW
            result = solve_newton(self._elastic(geometry, force), solver, field, self.tolerance, near)
            steps += result.iterations
            if result.converged and force == self.force:
                return replace(result, iterations=steps, message=f"converged in {steps} steps, the load in parts")
            if result.converged:
                reached, field = force, result.field
            elif reached == 0.0:
                break
            else:
                ratio = np.sqrt(ratio)
            force = min(self.force, reached * ratio)
        return replace(failed, iterations=steps)


def _start_field(start: Equilibrium | None, template: Template, cold: Array) -> Array:
    """The field of a neighbour on the same mesh, perhaps of another order; else the cold start."""
    if start is None or start.mesh.corners != template.corners:
        return cold
    if replace(start.resolution, order=template.resolution.order) != template.resolution:
        return cold
    return start.field if start.resolution == template.resolution else start.field_of_order(template.resolution.order)


def _layer(film: Film, force: float, probe: Probe, resolution: Resolution | None, start: Equilibrium | None) -> float:
    """Width of the thin rings: six bending lengths, or the start's width if that is near and its mesh the same."""
    layer = layer_for(film, force)
    if start is None or not LAYER_REUSE[0] < start.layer / layer < LAYER_REUSE[1]:
        return layer
    same_mesh = resolution in (None, start.resolution) and corners_of(probe) == start.mesh.corners
    return start.layer if same_mesh else layer
