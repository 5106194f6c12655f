"""Newton's method for a film that may be flat and slack at the start, and the linear theories as its first step.

A flat film without pretension has no transverse stiffness and plain Newton fails in many ways. What holds up: a start
of Schwerin's shape, an energy line search, and some tension added to the tangent only, in proportion to the residual,
so that the step stays a descent direction and the quadratic end is untouched.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.arrays import Array
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.solver.assembly import Assembly, Factor

GUARD_TENSION = 0.4
"""Tension added to the tangent at a relative residual of one, over a slack film's own (5 MPa at 25 um and 1 N)."""

GUARD_BELOW = 1e-2
"""Relative residual below which the tangent is left as it is."""

MAX_ITERATIONS = 60
"""Limit of Newton steps; ordinary scenes take five to ten."""

PATIENCE = 8
"""Steps in which their size must halve, after the first as many."""

REFINEMENTS, REFINED = 5, 1e-5
"""Corrections of a linear solve, and their size in the energy norm from which on no other is needed."""

CHORD_FROM, CHORD_KEEPS = 0.15, 0.3
"""Share of the residual that a step leaves, below which its tangent is used again; the share each use must beat."""

ROUND_OFF = 1e-9
"""Size of a Newton step in the energy norm, relative to the load's work, from which on only round-off is left."""


@dataclass(frozen=True)
class NewtonResult:
    """What came out.

    Attributes:
        field: Nodal (U1, U2, W), shape (n_node, 3).
        converged: Whether the residual is below the tolerance or as low as round-off lets it.
        iterations: Newton steps, of a linear theory solves.
        residual: Out-of-balance force: the larger of transverse over load and in-plane over in-plane force. Of a linear
            theory the size of the correction that it asked for, in the energy norm.
        message: One sentence for people.
    """

    field: Array
    converged: bool
    iterations: int
    residual: float
    message: str


def schwerin_start(z: np.ndarray, rho: float, groups: DimensionlessGroups) -> Array:
    """A first field: Schwerin's point-load shape in the template's coordinate, no in-plane displacement.

    W = (3 / pi)^(1/3) (1 - r^(2/3)) solves a point load on a slack membrane exactly at Poisson 1/3 (Schwerin 1929).
    Tension and bending lower it.

    Args:
        z: Template coordinates of the nodes, shape (n_node,).
        rho: Footprint radius in the template.
        groups: The scene.

    Returns:
        Field of shape (n_node, 3).
    """
    shape = np.cbrt(1.0 + rho**2) - np.cbrt(np.abs(z) ** 2 + rho**2)
    field = np.zeros((z.size, 3))
    field[:, 2] = groups.height * shape
    field[np.abs(z) > 1.0 - 1e-9] = 0.0
    return field


def solve_linear(film: ElasticFilm, assembly: Assembly) -> NewtonResult:
    """The linear theories: W from load, tension and bending alone, then the in-plane displacement that W asks for.

    The stress that the deflection induces does not act back on it. The flat film's tangent does not couple W and U, so
    one solve serves both U and the correction that W needs (iterative refinement: each leaves about the square of the
    error), whose size in the energy norm tells how well W was solved.
    """
    flat = np.zeros((assembly.free.shape[0], 3))
    factor = assembly.factor(film.tangent(flat))
    field, size = factor.solve(-film.residual(flat)), np.inf
    for solves in range(2, 2 + REFINEMENTS):
        balance = film.residual(field)
        balance[:, 2] = _linear_residual(film, field)[:, 2]
        step = factor.solve(-balance)
        size = _energy_norm(film, field, step[:, 2], balance[:, 2])
        field = field + step
        if size <= REFINED:
            return NewtonResult(
                field, True, solves, size, f"linear theory, solved to round-off: corrected by {size:.0e}"
            )
    return NewtonResult(field, False, solves, size, "the linear system is too near to singular")


def _linear_residual(film: ElasticFilm, deflection: Array) -> Array:
    """The residual without the induced stress, whose force goes with the cube of W: two scales tell them apart."""
    flat, small = film.residual(np.zeros_like(deflection)), 0.01
    once, twice = (film.residual(scale * small * deflection) - flat for scale in (1.0, 2.0))
    return flat + (8.0 * once - twice) / (6.0 * small)


def solve_newton(
    film: ElasticFilm, assembly: Assembly, start: Array, tolerance: float, near: float = GUARD_BELOW
) -> NewtonResult:
    """Find the equilibrium from a start.

    Args:
        film: The discrete problem.
        assembly: Solver for its template.
        start: First field, shape (n_node, 3), zero where fixed.
        tolerance: Relative residual to reach.
        near: Relative residual below which Newton's own step is taken if it halves the residual, uphill or down.

    Returns:
        The result, converged or not; the caller decides what a failure means.
    """
    field, residual = start, film.residual(start)
    free = assembly.free[:, :3]
    sizes: list[float] = []
    for iteration in range(MAX_ITERATIONS + 1):
        relative = _relative(film, field, residual * free)
        if not np.isfinite(relative):
            return NewtonResult(field, False, iteration, relative, "the residual is not a finite number")
        if relative <= tolerance:
            return NewtonResult(field, True, iteration, relative, f"converged in {iteration} steps")
        if iteration == MAX_ITERATIONS or _stalled(sizes):
            return NewtonResult(field, False, iteration, relative, f"no progress any more after {iteration} steps")
        factor = assembly.factor(film.tangent(field, _guard(film, relative)))
        step = factor.solve(-residual)
        sizes.append(_energy_norm(film, field, step, residual))
        if sizes[-1] <= ROUND_OFF:
            return NewtonResult(field, True, iteration, relative, f"converged to round-off in {iteration} steps")
        taken = _local_step(film, field, step, relative, free) if relative <= near else None
        if taken is None:
            step = _downhill(film, assembly, field, residual, step)
            taken = _line_search(film, field, step, residual, free)
        if taken is None:
            return NewtonResult(field, False, iteration, relative, "no step lowers the energy any more")
        field, residual = _again(film, factor, *taken, relative, tolerance, free)
    raise AssertionError("the loop returns")


def _stalled(sizes: list[float]) -> bool:
    """Whether the steps have stopped shrinking: the film runs away along a direction without stiffness."""
    return len(sizes) > 2 * PATIENCE and min(sizes[-PATIENCE:]) > 0.5 * min(sizes[:-PATIENCE])


def _relative(film: ElasticFilm, field: Array, residual: Array) -> float:
    across = np.linalg.norm(residual[:, 2]) / (film.groups.load * np.linalg.norm(film.geometry.load))
    along = np.linalg.norm(residual[:, :2]) / max(film.in_plane_scale(field), 1e-300)
    return float(max(across, along))


def _energy_norm(film: ElasticFilm, field: Array, step: Array, residual: Array) -> float:
    """Square root of the energy a step would gain over the load's work."""
    work = film.groups.load * abs(float(film.geometry.load @ field[:, 2]))
    return float(np.sqrt(abs(float(np.sum(step * residual))) / max(work, 1e-300)))


def _guard(film: ElasticFilm, relative: float) -> float:
    """Tension to add to the tangent: none near the end."""
    slack = GUARD_TENSION * float(np.cbrt(film.groups.load)) ** 2
    return slack * min(1.0, relative) if relative > GUARD_BELOW else 0.0


def _local_step(
    film: ElasticFilm, field: Array, step: Array, relative: float, free: np.ndarray
) -> tuple[Array, Array] | None:
    """Newton's own step near the end, if it halves the residual at least, uphill or down.

    A compressed film can have a flat equilibrium that a wrinkle would lower by a hair: it is found, not fled from.
    """
    if not np.isfinite(step).all():
        return None
    trial = field + step
    residual = film.residual(trial)
    return (trial, residual) if _relative(film, trial, residual * free) < 0.5 * relative else None


def _again(
    film: ElasticFilm,
    factor: Factor,
    field: Array,
    residual: Array,
    before: float,
    tolerance: float,
    free: np.ndarray,
) -> tuple[Array, Array]:
    """Further steps with the same tangent while they pay, which cost a seventh of one with its own (chord method).

    A step that left the share s of the residual says that the next with its tangent will leave about 2 s (Kelley 1995).
    """
    relative = _relative(film, field, residual * free)
    if relative > CHORD_FROM * before:
        return field, residual
    while relative > tolerance:
        trial = field + factor.solve(-residual)
        trial_residual = film.residual(trial)
        left = _relative(film, trial, trial_residual * free)
        if not left < CHORD_KEEPS * relative:
            break
        field, residual, relative = trial, trial_residual, left
    return field, residual


def _downhill(film: ElasticFilm, assembly: Assembly, field: Array, residual: Array, step: Array) -> Array:
    """A step that goes downhill: the given one, or with more and more tension in the tangent."""
    tension = 0.05 * GUARD_TENSION * float(np.cbrt(film.groups.load)) ** 2
    for _ in range(12):
        if np.isfinite(step).all() and float(np.sum(step * residual)) < 0.0:
            break
        step = assembly.factor(film.tangent(field, tension)).solve(-residual)
        tension *= 2.0
    return step


def _line_search(
    film: ElasticFilm, field: Array, step: Array, residual: Array, free: np.ndarray
) -> tuple[Array, Array] | None:
    """Halve the step until the energy falls enough (Armijo), or, where the energy's digits end, the residual does."""
    energy, slope = film.energy(field), float(np.sum(step * residual))
    norm = np.linalg.norm(residual[free])
    share = 1.0
    for _ in range(30):
        trial = field + share * step
        change = film.energy(trial) - energy
        lower = change <= 1e-4 * share * slope
        if lower or abs(change) <= 1e-12 * abs(energy):
            trial_residual = film.residual(trial)
            if lower or np.linalg.norm(trial_residual[free]) < norm:
                return trial, trial_residual
        share *= 0.5
    return None
