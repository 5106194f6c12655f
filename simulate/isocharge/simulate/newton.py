"""Newton's method for a membrane that may be flat and slack at the start.

A flat film without pretension has no transverse stiffness and plain Newton fails in many ways. What holds up: a start
of Schwerin's shape, an energy line search, and some tension added to the tangent only, in proportion to the residual,
so that the step stays a descent direction and the quadratic end is untouched.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.simulate.arrays import Array
from isocharge.simulate.assembly import Assembly
from isocharge.simulate.membrane import Groups, Membrane

GUARD_TENSION = 0.4
"""Tension added to the tangent at a relative residual of one, in units of E_young A^2 (5 MPa at 25 um and 1 N)."""

GUARD_BELOW = 1e-2
"""Relative residual below which the tangent is left as it is."""

MAX_ITERATIONS = 60
"""Limit of Newton steps; ordinary scenes take six to ten."""


@dataclass(frozen=True)
class NewtonResult:
    """What came out.

    Attributes:
        field: Nodal (U1, U2, W), shape (n_node, 3).
        converged: Whether the residual is below the tolerance.
        iterations: Linear solves done.
        residual: Norm of the out-of-balance force over the norm of the load.
        message: One sentence for people.
    """

    field: Array
    converged: bool
    iterations: int
    residual: float
    message: str


def schwerin_start(z: np.ndarray, rho: float, radius: float, groups: Groups) -> Array:
    """A first field: Schwerin's point-load shape in the template's coordinate, no in-plane displacement.

    W = (3 / pi)^(1/3) (1 - r^(2/3)) solves a point load exactly at Poisson 1/3 (Schwerin 1929). With pretension its
    height comes from the cubic that joins W ~ load^(1/3) to W ~ load / tension.

    Args:
        z: Template coordinates of the nodes, shape (n_node,).
        rho: Footprint radius in the template.
        radius: Footprint radius over film radius.
        groups: The scene.

    Returns:
        Field of shape (n_node, 3).
    """
    shape = np.cbrt(1.0 + rho**2) - np.cbrt(np.abs(z) ** 2 + rho**2)
    slack = np.cbrt(3.0 / np.pi * groups.load)
    taut = -np.log(radius) / (2.0 * np.pi * max(shape.max(), 1e-3)) * groups.load
    roots = np.roots([slack**-3, 0.0, groups.tension / taut, -1.0])
    height = float(roots[np.argmin(np.abs(roots.imag))].real)
    field = np.zeros((z.size, 3))
    field[:, 2] = height * shape
    field[np.abs(z) > 1.0 - 1e-9] = 0.0
    return field


def solve_newton(membrane: Membrane, assembly: Assembly, start: Array, tolerance: float) -> NewtonResult:
    """Find the equilibrium from a start.

    Args:
        membrane: The discrete problem.
        assembly: Solver for its template.
        start: First field, shape (n_node, 3), zero on the rim.
        tolerance: Relative residual to reach.

    Returns:
        The result, converged or not; the caller decides what a failure means.
    """
    free = slice(0, assembly.n_free)
    load_norm = membrane.groups.load * float(np.linalg.norm(membrane.geometry.load))
    field, residual = start, membrane.residual(start)
    for iteration in range(MAX_ITERATIONS):
        relative = float(np.linalg.norm(residual[free])) / load_norm
        if not np.isfinite(relative):
            return NewtonResult(field, False, iteration, relative, "the residual is not a finite number")
        if relative <= tolerance:
            return NewtonResult(field, True, iteration, relative, f"converged in {iteration} steps")
        step = _descent_step(membrane, assembly, field, residual, relative)
        taken = _line_search(membrane, field, step, residual, free)
        if taken is None:
            return NewtonResult(field, False, iteration, relative, "no step lowers the energy any more")
        field, residual = taken
    relative = float(np.linalg.norm(residual[free])) / load_norm
    done = relative <= tolerance
    return NewtonResult(field, done, MAX_ITERATIONS, relative, f"stopped after {MAX_ITERATIONS} steps")


def _descent_step(membrane: Membrane, assembly: Assembly, field: Array, residual: Array, relative: float) -> Array:
    """Newton step, with more and more tension in the tangent until it goes downhill."""
    tension = GUARD_TENSION * min(1.0, relative) if relative > GUARD_BELOW else 0.0
    for _ in range(12):
        guarded = Membrane(membrane.geometry, membrane.groups.stiffened(tension))
        step = assembly.solve(guarded.tangent(field), -residual)
        if np.isfinite(step).all() and float(np.sum(step * residual)) < 0.0:
            break
        tension = max(2.0 * tension, 0.05 * GUARD_TENSION)
    return step


def _line_search(
    membrane: Membrane, field: Array, step: Array, residual: Array, free: slice
) -> tuple[Array, Array] | None:
    """Halve the step until the energy falls enough (Armijo), or, where the energy's digits end, the residual does."""
    energy, slope = membrane.energy(field), float(np.sum(step * residual))
    norm = np.linalg.norm(residual[free])
    share = 1.0
    for _ in range(30):
        trial = field + share * step
        change = membrane.energy(trial) - energy
        lower = change <= 1e-4 * share * slope
        if lower or abs(change) <= 1e-12 * abs(energy):
            trial_residual = membrane.residual(trial)
            if lower or np.linalg.norm(trial_residual[free]) < norm:
                return trial, trial_residual
        share *= 0.5
    return None
