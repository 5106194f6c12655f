"""Equilibrium of the film under one press, and what can be read from it at any point.

The film is round and its elasticity isotropic, so every press is solved on the positive x axis and turned when it is
read: one equilibrium serves all angles, electrode layouts and piezoelectric coefficients.
"""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from time import process_time
from typing import Any, Literal

import numpy as np
from threadpoolctl import ThreadpoolController

from isocharge.errors import SceneError, SolveError
from isocharge.simulate.arrays import Array, Complexes
from isocharge.simulate.assembly import assembly
from isocharge.simulate.membrane import Geometry, Groups, Membrane, film_gradient, strain, stress
from isocharge.simulate.newton import schwerin_start, solve_newton
from isocharge.simulate.probe import Circle
from isocharge.simulate.sensor import Film
from isocharge.simulate.template import Placement, Resolution, Template, template

STANDARD = Resolution(order=4, around=8, rings=6)
"""Charges within 0.03 % of the membrane's own solution up to 10 mm from the centre, 0.05 % with the probe on an
electrode, in 0.06 s (`tests/benchmarks/bench_solve.py`)."""

LADDER = (STANDARD, Resolution(5, 8, 6), Resolution(6, 8, 6), Resolution(7, 8, 8), Resolution(8, 8, 8))
"""Meshes that are tried in turn when none is asked for: a higher order pays more than more elements round the circle,
and keeps `mesh_error` true, which does not see rings that are too few."""

MESH_TOLERANCE = 2e-3
"""`mesh_error` at which a mesh is fine enough: the standard one up to some 13 mm from the centre of a film of 45 mm."""

TOO_COARSE = 0.05
"""`mesh_error` of the finest mesh above which a press is refused: some 5 mm from the rim of a film of 45 mm."""

DISCRETISATION_ERROR = 3e-4
"""Relative error of a charge that any mesh is taken to make: what the standard one makes up to 8 mm from the centre."""

BENDING_WEIGHT = 1.5
"""Worst error of a charge over `bending_share`: at most 1.41 in the solutions of a 25 um film in tests/data."""

MOSTLY_BENT = 0.3
"""`bending_share` above which a membrane says nothing about a real film; its error is then given as infinite."""

LARGEST_AMPLITUDE2 = 0.1
"""A^2, the size of the strains, above which St. Venant-Kirchhoff elasticity is out of its range: 100 N at 25 um."""

SMALLEST_PROBE = 1e-5
"""Probe radius over film radius below which the template's grading runs out of digits."""

_THREADS = ThreadpoolController()


def single_threaded_blas() -> AbstractContextManager[object]:
    """For many small matrices: BLAS threads would spin at barriers, many times slower when the other cores are busy."""
    limiter: AbstractContextManager[object] = _THREADS.limit(limits=1, user_api="blas")
    return limiter


@dataclass(frozen=True)
class Equilibrium:
    """The film at rest under a press.

    Attributes:
        film: The film.
        probe: The footprint.
        at: Centre of the footprint (x, y), m.
        force: N.
        resolution: Mesh.
        field: Nodal (U1, U2, W), dimensionless, of the press turned onto the x axis; shape (n_node, 3).
        groups: Dimensionless groups of the scene.
        status: "converged" or "failed".
        message: One sentence.
        iterations: Newton steps.
        residual: Out-of-balance force over load.
        seconds: Process CPU time of mesh and solve.
        theory: What was modelled.
        mesh_error: Relative error of a charge to expect from the mesh; see the function of that name.
        estimated_error: Bound to expect of a charge's relative error from what the theory leaves out (bending) and from
            the mesh. On a film thicker than some 25 um it holds away from the probe only: under it bending does more.
    """

    film: Film
    probe: Circle
    at: tuple[float, float]
    force: float
    resolution: Resolution
    field: Array
    groups: Groups
    status: Literal["converged", "failed"]
    message: str
    iterations: int
    residual: float
    seconds: float
    theory: str = "nonlinear membrane"
    mesh_error: float = DISCRETISATION_ERROR

    @property
    def estimated_error(self) -> float:
        """See the class."""
        if bending_share(self.film, self.groups.amplitude2) > MOSTLY_BENT:
            return np.inf
        return self.mesh_error + BENDING_WEIGHT * bending_share(self.film, self.groups.amplitude2)

    @property
    def placement(self) -> Placement:
        """Where the template lies, the press turned onto the x axis."""
        return _place(self.film, self.probe, self.at)

    def deflection(self, points: Array) -> Array:
        """Deflection w at film points.

        Args:
            points: (x, y), shape (n, 2), m, on the film.

        Returns:
            Shape (n,), m, positive the way the probe pushes.
        """
        mesh, element, basis, _ = self._find(points)
        scaled = np.einsum("pn,pn->p", basis, self.field[mesh.nodes[element], 2])
        deflection: Array = self.film.radius * np.sqrt(self.groups.amplitude2) * scaled
        return deflection

    def touch_stress(self, points: Array) -> Array:
        """Mid-surface second Piola-Kirchhoff stress that the press adds to the pretension.

        Args:
            points: (x, y), shape (n, 2), m, on the film.

        Returns:
            (s11, s22, s12) in the film's axes, shape (n, 3), Pa, tension positive.
        """
        mesh, element, _, by_local = self._find(points)
        nodes = self.placement.to_film(mesh.element_points(self.placement.rho))
        gradient = film_gradient(by_local[:, :, None, :], nodes[element])[0][:, 0]
        slope = gradient @ self.field[mesh.nodes[element]]
        local = stress(strain(slope, self.groups.amplitude2), self.groups.poisson)
        scale = self.film.young * self.groups.amplitude2
        return turn_stress(scale * local, np.arctan2(self.at[1], self.at[0]))

    def _find(self, points: Array) -> tuple[Template, np.ndarray, Array, Array]:
        """Template, element of each point, basis and its local derivatives there; a SceneError off the film."""
        points = np.asarray(points, dtype=float)
        off = ~(np.hypot(points[:, 0], points[:, 1]) <= self.film.radius * (1.0 + 1e-9))
        if off.any():
            x, y = 1e3 * points[np.argmax(off)]
            raise SceneError(f"point ({x:.4g}, {y:.4g}) mm is off the film of radius {self.film.radius * 1e3:.4g} mm")
        mesh, placement = template(self.resolution), self.placement
        z = placement.to_template(_on_axis(points, self.at) / self.film.radius)
        element, xi, eta = mesh.locate(z, placement.rho)
        return mesh, element, *mesh.basis_at(xi, eta)


def _on_axis(points: Array, at: tuple[float, float]) -> Complexes:
    """Film points as complex numbers, turned so that `at` comes to lie on the positive x axis; m."""
    turned: Complexes = (points[..., 0] + 1j * points[..., 1]) * np.exp(-1j * np.arctan2(at[1], at[0]))
    return turned


def turn_stress(local: Array, angle: float | Array) -> Array:
    """Stress (s11, s22, s12), shape (..., 3), of a frame turned by `angle` (rad) into the frame it was turned from."""
    mean, half, shear = (
        0.5 * (local[..., 0] + local[..., 1]),
        0.5 * (local[..., 0] - local[..., 1]),
        local[..., 2],
    )
    c, s = np.cos(2.0 * np.asarray(angle)), np.sin(2.0 * np.asarray(angle))
    first, second = half * c - shear * s, half * s + shear * c
    return np.stack([mean + first, mean - first, second], axis=-1)


def amplitude_squared(film: Film, force: Array | float) -> Any:
    """A^2 with w / a ~ A = (F / (E h a))^(1/3), which makes the load one (Schwerin 1929); shape and type of `force`."""
    return np.cbrt(force / (film.young * film.thickness * film.radius)) ** 2


def dimensionless(film: Film, force: float) -> Groups:
    """The groups of a scene."""
    amplitude2 = float(amplitude_squared(film, force))
    return Groups(amplitude2, 1.0, film.pretension / (film.young * amplitude2), film.poisson)


def bending_share(film: Film, amplitude2: float) -> float:
    """How much bending, which the membrane leaves out, would change a charge, roughly.

    Bending matters within l = sqrt(D / (h s)) of rim and probe, s the tension between them; the worst charge of a press
    changes by about l / a (0.5 to 1.4 times that in the solutions of a 25 um film with bending in tests/data).
    """
    tension = film.young * amplitude2 * 0.44 + film.pretension
    stiffness = film.young * film.thickness**2 / (12.0 * (1.0 - film.poisson**2))
    return float(np.sqrt(stiffness / tension) / film.radius)


def _place(film: Film, probe: Circle, at: tuple[float, float]) -> Placement:
    return Placement.of_circle(float(np.hypot(*at)) / film.radius, probe.radius / film.radius)


def resolution_for(film: Film, probe: Circle, at: tuple[float, float]) -> Resolution:
    """The coarsest mesh of `LADDER` that carries a press well: towards the rim the template is stretched.

    Raises:
        SceneError: If the press is so near the rim that even the finest mesh carries it badly.
    """
    placement = _place(film, probe, at)
    for resolution in LADDER:
        error = mesh_error(Geometry.build(template(resolution), placement))
        if error <= MESH_TOLERANCE:
            return resolution
    if error > TOO_COARSE:
        raise _too_near_the_rim(at, resolution)
    return resolution


def _too_near_the_rim(at: tuple[float, float], resolution: Resolution) -> SceneError:
    return SceneError(
        f"press at ({at[0] * 1e3:.4g}, {at[1] * 1e3:.4g}) mm is too near the rim for a mesh of order "
        f"{resolution.order} with {resolution.around} elements round the circle; press farther inside"
    )


def mesh_error(geometry: Geometry) -> float:
    """Relative error of a charge to expect from the mesh, infinite where elements are turned inside out.

    From how well the mesh carries the film's own area: for the meshes of `LADDER` and probes of 0.5 mm or more, the
    worst charge's error is at most 1.2 times the square root of the area's, up to 33 mm from the centre of a film of
    45 mm; 2.2 times for a probe of 0.2 mm (`tests/benchmarks/bench_solve.py`).
    """
    if geometry.weights.min() <= 0.0:
        return np.inf
    return max(DISCRETISATION_ERROR, float(np.sqrt(abs(geometry.weights.sum() / np.pi - 1.0))))


def check_scene(film: Film, probe: Circle, at: tuple[float, float], force: float) -> None:
    """Refuse presses that cannot exist, and those outside of what St. Venant-Kirchhoff elasticity says anything about.

    Raises:
        SceneError: If the footprint is not wholly on the film or hardly there, the force is not positive and finite, or
            the film is stretched beyond small strains.
    """
    if not (np.isfinite(force) and force > 0.0):
        raise SceneError(f"force: expected a positive number of newtons (F > 0 pushes), got {force}")
    if not np.isfinite(at).all():
        raise SceneError(f"position: expected two finite numbers, got {at}")
    if probe.radius < SMALLEST_PROBE * film.radius:
        raise SceneError(
            f"probe radius: expected at least {SMALLEST_PROBE:g} of the film's ({film.radius * 1e3:.4g} mm), "
            f"got {probe.radius * 1e3:.4g} mm"
        )
    if np.hypot(*at) + probe.radius >= film.radius * (1.0 - 1e-6):
        raise SceneError(
            f"probe off the film: centre ({at[0] * 1e3:.4g}, {at[1] * 1e3:.4g}) mm, probe radius "
            f"{probe.radius * 1e3:.4g} mm, film radius {film.radius * 1e3:.4g} mm"
        )
    amplitude2 = amplitude_squared(film, force)
    if amplitude2 > LARGEST_AMPLITUDE2:
        raise SceneError(
            f"force {force:.4g} N stretches a film of {film.thickness * 1e6:.4g} um beyond small strains: expected "
            f"(F / (E h a))^(2/3) up to {LARGEST_AMPLITUDE2:g}, got {amplitude2:.3g}"
        )


def press(
    film: Film,
    probe: Circle,
    at: tuple[float, float],
    force: float,
    *,
    resolution: Resolution | None = None,
    start: Equilibrium | None = None,
    tolerance: float = 1e-9,
    throw: bool = True,
) -> Equilibrium:
    """Solve the film under a press.

    Args:
        film: The clamped film.
        probe: The footprint, pressing uniformly, dead load.
        at: Centre of the footprint (x, y), m.
        force: N, positive pushes.
        resolution: Mesh of the template; the coarsest that carries the press well if absent.
        start: A neighbouring equilibrium of the same resolution to start from: another force, another position.
        tolerance: Out-of-balance force over load.
        throw: Whether a failure raises; if not, look at `status`.

    Returns:
        The equilibrium.

    Raises:
        SceneError: If the press cannot exist, or not on this mesh.
        SolveError: If no equilibrium was found and `throw` is set.
    """
    check_scene(film, probe, at, force)
    began = process_time()
    resolution = resolution or resolution_for(film, probe, at)
    mesh, placement, groups = template(resolution), _place(film, probe, at), dimensionless(film, force)
    with single_threaded_blas():
        membrane = Membrane(Geometry.build(mesh, placement), groups)
        from_mesh = mesh_error(membrane.geometry)
        if np.isinf(from_mesh):
            raise _too_near_the_rim(at, resolution)
        if start is not None and start.resolution == resolution:
            first = start.field
        else:
            first = schwerin_start(
                mesh.node_points(placement.rho), float(placement.rho), probe.radius / film.radius, groups
            )
        found = solve_newton(membrane, assembly(resolution), first, tolerance)
    if throw and not found.converged:
        raise SolveError(
            f"no equilibrium at {force:.4g} N, position ({at[0] * 1e3:.4g}, {at[1] * 1e3:.4g}) mm: {found.message}; "
            f"residual {found.residual:.2g} > {tolerance:.2g} after {found.iterations} steps"
        )
    return Equilibrium(
        film, probe, at, force, resolution, found.field, groups,
        status="converged" if found.converged else "failed",
        message=found.message,
        iterations=found.iterations,
        residual=found.residual,
        seconds=process_time() - began,
        mesh_error=from_mesh,
    )  # fmt: skip
