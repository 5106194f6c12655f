"""Newton's method for a film that may be flat and slack at the start, and the linear theories as its first step.

A flat film without pretension has no transverse stiffness, and plain Newton fails in many ways. What works: a start
of Schwerin's shape, an energy line search, and some tension added to the tangent only, in proportion to the residual,
so that the step stays a descent direction and the convergence near the equilibrium stays quadratic. It gives up after
`MAX_ITERATIONS`, or where steps no longer shrink (`PATIENCE`); how small a residual has to be is in `settings`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.solver.assembly import Assembly, Factor

GUARD_TENSION = 0.4
"""Tension added to the tangent at a relative residual of one, over a slack film's own (5 MPa at 25 um and 1 N)."""

GUARD_BELOW = 1e-2
"""Relative residual, dimensionless, below which no tension is added to the tangent."""

MAX_ITERATIONS = 60
"""Limit of Newton steps; ordinary presses take five to ten."""

PATIENCE = 8
"""Number of steps. Newton stops as stalled if, after the first PATIENCE steps, the smallest step of the last PATIENCE
is not below half of the smallest before."""

REFINEMENTS, REFINED = 5, 1e-5
"""Largest number of corrections of a linear solve, and size of a correction in the energy norm that ends them."""

CHORD_FROM, CHORD_KEEPS = 0.15, 0.3
"""Reuse the factorised tangent if the last step reduced the residual below CHORD_FROM of its value, and as long as each
reuse reduces it below CHORD_KEEPS."""

ROUND_OFF = 1e-9
"""Size of a Newton step in the energy norm, relative to the load's work, below which only round-off is left."""


@dataclass(frozen=True)
class NewtonResult:
    """Outcome of a solve.

    Attributes:
        field: Nodal (U1, U2, W), shape (n_node, 3).
        converged: Whether the residual is below the tolerance or as low as round-off lets it.
        iterations: Newton steps; of a linear theory, solves.
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
    """The first field: Schwerin's point-load shape in the template's coordinate, no in-plane displacement.

    W = (3 / pi)^(1/3) (1 - r^(2/3)) solves a point load on a slack membrane exactly at Poisson 1/3 (Schwerin 1929).
    Tension and bending lower it.

    Args:
        z: Template coordinates of the nodes, shape (n_node,).
        rho: Footprint radius in the template.
        groups: Dimensionless groups of the press.

    Returns:
        Field of shape (n_node, 3).
    """
    shape = np.cbrt(1.0 + rho**2) - np.cbrt(np.abs(z) ** 2 + rho**2)
    field = np.zeros((z.size, 3))
    field[:, 2] = groups.height * shape
    field[np.abs(z) > 1.0 - 1e-9] = 0.0
    return field


def solve_linear(elastic: ElasticFilm, assembly: Assembly) -> NewtonResult:
    """The linear theories: W from load, tension and bending alone, then the in-plane displacement U that W causes.

    The stress that the deflection induces does not act back on it. The flat film's tangent does not couple W and U, so
    one solve gives both U and a correction of W (iterative refinement: each squares the error, roughly). The size of
    the correction in the energy norm shows how well W was solved.
    """
    flat = np.zeros((assembly.free.shape[0], 3))
    factor = assembly.factor(elastic.tangent(flat))
    field, size = factor.solve(-elastic.residual(flat)), np.inf
    for solves in range(2, 2 + REFINEMENTS):
        balance = elastic.residual(field)
        balance[:, 2] = _linear_residual(elastic, field)[:, 2]
        step = factor.solve(-balance)
        size = _energy_norm(elastic, field, step[:, 2], balance[:, 2])
        field = field + step
        if size <= REFINED:
            return NewtonResult(
                field, True, solves, size, f"linear theory, solved to round-off: corrected by {size:.0e}"
            )
    return NewtonResult(field, False, solves, size, "the linear system is too near to singular")


def _linear_residual(elastic: ElasticFilm, deflection: Array) -> Array:
    """The residual without the induced stress, whose force goes with W^3: two amplitudes separate it."""
    flat, small = elastic.residual(np.zeros_like(deflection)), 0.01
    once, twice = (elastic.residual(scale * small * deflection) - flat for scale in (1.0, 2.0))
    return flat + (8.0 * once - twice) / (6.0 * small)


def solve_newton(
    elastic: ElasticFilm, assembly: Assembly, start: Array, tolerance: float, local_below: float = GUARD_BELOW
) -> NewtonResult:
    """Find the equilibrium from a start.

    Args:
        elastic: The discrete problem.
        assembly: Solver for its template.
        start: First field, shape (n_node, 3), zero where fixed.
        tolerance: Relative residual to reach.
        local_below: Relative residual below which a full Newton step that halves the residual is taken even if it
            raises the energy.

    Returns:
        The result, converged or not; the caller decides what a failure means.
    """
    iterate = _Iterate.at(elastic, assembly.free[:, :3], start)
    sizes: list[float] = []
    for iteration in range(MAX_ITERATIONS + 1):
        relative = iterate.relative
        if not np.isfinite(relative):
            return iterate.result(False, iteration, "the residual is not a finite number")
        if relative <= tolerance:
            return iterate.result(True, iteration, f"converged in {iteration} steps")
        if iteration == MAX_ITERATIONS or _stalled(sizes):
            return iterate.result(False, iteration, f"no progress any more after {iteration} steps")
        factor = assembly.factor(elastic.tangent(iterate.field, _regularisation(elastic, relative)))
        step = factor.solve(-iterate.residual)
        sizes.append(_energy_norm(elastic, iterate.field, step, iterate.residual))
        if sizes[-1] <= ROUND_OFF:
            return iterate.result(True, iteration, f"converged to round-off in {iteration} steps")
        following = _local_step(iterate, step) if relative <= local_below else None
        if following is None:
            following = _line_search(iterate, _descent_step(iterate, assembly, step))
        if following is None:
            return iterate.result(False, iteration, "no step lowers the energy any more")
        iterate = _chord_steps(following, factor, relative, tolerance)
    raise AssertionError("the loop returns")


@dataclass(frozen=True)
class _Iterate:
    """A field on the way to the equilibrium.

    Attributes:
        elastic: The discrete problem.
        free: Which components of the nodes are not fixed, shape (n_node, 3).
        field: Nodal (U1, U2, W), shape (n_node, 3).
        residual: Out-of-balance force at the nodes, shape (n_node, 3).
    """

    elastic: ElasticFilm
    free: Booleans
    field: Array
    residual: Array

    @classmethod
    def at(cls, elastic: ElasticFilm, free: Booleans, field: Array) -> Self:
        """A field with its residual."""
        return cls(elastic, free, field, elastic.residual(field))

    def moved(self, step: Array) -> Self:
        """The field after a step."""
        return type(self).at(self.elastic, self.free, self.field + step)

    @cached_property
    def relative(self) -> float:
        """Relative residual: the larger of transverse over load and in-plane over in-plane force."""
        residual = self.residual * self.free
        across = np.linalg.norm(residual[:, 2]) / (
            self.elastic.groups.load * np.linalg.norm(self.elastic.geometry.load)
        )
        along = np.linalg.norm(residual[:, :2]) / max(self.elastic.in_plane_scale(self.field), 1e-300)
        return float(max(across, along))

    def result(self, converged: bool, iterations: int, message: str) -> NewtonResult:
        """This field as the outcome."""
        return NewtonResult(self.field, converged, iterations, self.relative, message)


def _stalled(sizes: list[float]) -> bool:
    """Whether the steps have stopped shrinking: the film runs away along a direction without stiffness."""
    return len(sizes) > 2 * PATIENCE and min(sizes[-PATIENCE:]) > 0.5 * min(sizes[:-PATIENCE])


def _energy_norm(elastic: ElasticFilm, field: Array, step: Array, residual: Array) -> float:
    """Square root of the energy a step would gain over the load's work."""
    work = elastic.groups.load * abs(float(elastic.geometry.load @ field[:, 2]))
    return float(np.sqrt(abs(float(np.sum(step * residual))) / max(work, 1e-300)))


def _regularisation(elastic: ElasticFilm, relative: float) -> float:
    """Tension to add to the tangent: in proportion to the residual, none near the equilibrium."""
    slack = GUARD_TENSION * float(np.cbrt(elastic.groups.load)) ** 2
    return slack * min(1.0, relative) if relative > GUARD_BELOW else 0.0


def _local_step(iterate: _Iterate, step: Array) -> _Iterate | None:
    """The full Newton step if it at least halves the residual.

    Accept a full Newton step that raises the energy: a compressed film may have an unwrinkled equilibrium whose energy
    is slightly above the wrinkled one.
    """
    if not np.isfinite(step).all():
        return None
    trial = iterate.moved(step)
    return trial if trial.relative < 0.5 * iterate.relative else None


def _chord_steps(iterate: _Iterate, factor: Factor, before: float, tolerance: float) -> _Iterate:
    """Further steps with the same tangent while they pay (chord method): each costs a seventh of a Newton step.

    A step that left the share s of the residual suggests that the next with its tangent leaves about 2 s (Kelley 1995).
    """
    if iterate.relative > CHORD_FROM * before:
        return iterate
    while iterate.relative > tolerance:
        trial = iterate.moved(factor.solve(-iterate.residual))
        if not trial.relative < CHORD_KEEPS * iterate.relative:
            break
        iterate = trial
    return iterate


def _descent_step(iterate: _Iterate, assembly: Assembly, step: Array) -> Array:
    """A step that lowers the energy: the given one, or one with more and more tension in the tangent."""
    elastic = iterate.elastic
    tension = 0.05 * GUARD_TENSION * float(np.cbrt(elastic.groups.load)) ** 2
    for _ in range(12):
        if np.isfinite(step).all() and float(np.sum(step * iterate.residual)) < 0.0:
            break
        step = assembly.factor(elastic.tangent(iterate.field, tension)).solve(-iterate.residual)
        tension *= 2.0
    return step


def _line_search(iterate: _Iterate, step: Array) -> _Iterate | None:
    """Halve the step until the energy falls enough (Armijo) or, where its digits end, until the residual falls."""
    elastic, residual = iterate.elastic, iterate.residual
    energy, slope = elastic.energy(iterate.field), float(np.sum(step * residual))
    norm = np.linalg.norm(residual[iterate.free])
    share = 1.0
    for _ in range(30):
        field = iterate.field + share * step
        change = elastic.energy(field) - energy
        lower = change <= 1e-4 * share * slope
        if lower or abs(change) <= 1e-12 * abs(energy):
            trial = _Iterate.at(elastic, iterate.free, field)
            if lower or np.linalg.norm(trial.residual[iterate.free]) < norm:
                return trial
        share *= 0.5
    return None
