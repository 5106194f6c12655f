"""Newton's method for the equilibrium of the film, and the direct solution of the linear theories.

A flat film without pretension has no transverse stiffness, so the plain Newton method fails. Three measures make the
method reliable. The first iterate has the shape of Schwerin's solution. A line search on the energy determines the
length of each step. A tension proportional to the residual is added to the tangent matrix, but not to the residual.
With this tension, each step is a descent direction, and the convergence near the equilibrium remains quadratic. The
iteration stops after `MAX_ITERATIONS` steps, or if the steps no longer become smaller (`PATIENCE`).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.solver.assembly import Assembly
from isocharge.simulate.solver.tangent_factor import TangentFactor, factor_tangent

GUARD_TENSION = 0.4
"""Tension that is added to the tangent at a relative residual of one, in units of the induced tension of a film without
pretension."""

GUARD_BELOW = 1e-2
"""Relative residual below which no tension is added to the tangent, dimensionless."""

MAX_ITERATIONS = 60
"""Largest number of Newton steps. Typical presses need five to ten."""

PATIENCE = 8
"""Number of steps after which stagnation is detected.

The iteration stops if the smallest of the last PATIENCE steps is not below half of the smallest step before them."""

MAX_REFINEMENTS = 5
"""Largest number of corrections of a linear solve."""

REFINEMENT_TOLERANCE = 1e-5
"""Energy norm of a correction of a linear solve at which the solve has converged."""

CHORD_START = 0.15
"""Largest ratio of the residual after a Newton step to the residual before it at which the factorised tangent is used
again."""

CHORD_CONTINUE = 0.3
"""Largest ratio of the residual after a step with a reused tangent to the residual before it at which the tangent is
used once more."""

ROUND_OFF = 1e-9
"""Size of a Newton step that is caused by rounding errors only. The size is the energy norm relative to the work of the
load."""

FIRST_DESCENT_TENSION = 0.05
"""Smallest tension that is added to the tangent to obtain a descent direction, in units of the guard tension."""

MAX_DESCENT_TRIALS = 12
"""Largest number of tensions that are tried to obtain a descent direction. Each tension is twice the previous one."""

MAX_HALVINGS = 30
"""Largest number of step lengths that the line search tries."""

ARMIJO_SHARE = 1e-4
"""Smallest accepted ratio of the decrease of the energy to the decrease that the slope predicts, dimensionless."""

ENERGY_ROUND_OFF = 1e-12
"""Relative change of the energy that is caused by round-off only."""


@dataclass(frozen=True)
class NewtonResult:
    """Result of a solve.

    Attributes:
        field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
        converged: Whether the residual is below the tolerance or at the level of rounding errors.
        iterations: Number of Newton steps. For a linear theory, the number of linear solves.
        residual: Relative residual, which is the larger one of two ratios: the transverse residual to the load, and the
            in-plane residual to the in-plane forces. For a linear theory, the energy norm of the last correction.
        message: Description of the outcome in one sentence.
    """

    field: Array
    converged: bool
    iterations: int
    residual: float
    message: str


def schwerin_start(z: np.ndarray, rho: float, groups: DimensionlessGroups) -> Array:
    """Compute the first iterate of Newton's method: Schwerin's deflection, and no in-plane displacement.

    Schwerin's deflection is W = (3 / pi)^(1/3) (1 - r^(2/3)). This deflection is exact for a membrane without
    pretension under a point load if Poisson's ratio is 1/3 (Schwerin 1929). The radius r is measured in the template
    plane. For a film with pretension or bending, the deflection is reduced.

    Args:
        z: Nodes in the template plane, shape (n_node,).
        rho: Radius of the innermost circle in the template plane.
        groups: Dimensionless groups of the press.

    Returns:
        Scaled displacements (U1, U2, W), shape (n_node, 3).
    """
    # The height replaces the factor (3 / pi)^(1/3), which is about 1. The term rho^2 rounds the tip of the deflection
    # under the probe.
    shape = np.cbrt(1.0 + rho**2) - np.cbrt(np.abs(z) ** 2 + rho**2)
    field = np.zeros((z.size, 3))
    field[:, 2] = groups.height * shape
    is_on_rim = np.abs(z) > 1.0 - 1e-9
    field[is_on_rim] = 0.0
    return field


def parabolic_start(radius: np.ndarray, groups: DimensionlessGroups) -> Array:
    """Compute the first iterate for a film under static pressure without a probe.

    Args:
        radius: Distances of the nodes from the centre, shape (n_node,), in film radii.
        groups: Dimensionless groups of the film.

    Returns:
        Scaled displacements (U1, U2, W), shape (n_node, 3).
    """
    field = np.zeros((radius.size, 3))
    field[:, 2] = groups.static_height * np.maximum(1.0 - radius**2, 0.0)
    field[radius > 1.0 - 1e-9] = 0.0
    return field


def solve_linear(elastic: ElasticFilm, assembly: Assembly) -> NewtonResult:
    """Solve a linear theory: the deflection W under the load, and the in-plane displacement U that W causes.

    The induced stress does not affect the deflection. The tangent of the flat film does not couple W and U. Each
    further solve therefore computes U, and also a correction of W (iterative refinement). The energy norm of the
    correction is a measure of the error of W.

    Args:
        elastic: The discrete film.
        assembly: Linear solver for its mesh.

    Returns:
        The result, which has not converged if the linear system is nearly singular.
    """
    # The first solve computes W. All solves use the tangent of the flat film.
    flat_field = np.zeros((assembly.free.shape[0], 3))
    factor = assembly.factor(elastic.tangent(flat_field))
    field = factor.solve(-elastic.residual(flat_field))
    n_solve = 1
    correction_size = np.inf
    for _ in range(MAX_REFINEMENTS):
        # In-plane residual with the stress that W induces; transverse residual without it
        residual = elastic.residual(field)
        residual[:, 2] = _linear_residual(elastic, field)[:, 2]
        correction = factor.solve(-residual)
        n_solve += 1
        correction_size = _energy_norm(elastic, field, correction[:, 2], residual[:, 2])
        field = field + correction
        if correction_size <= REFINEMENT_TOLERANCE:
            message = f"linear theory, solved to round-off: corrected by {correction_size:.0e}"
            return NewtonResult(field, True, n_solve, correction_size, message)
    return NewtonResult(field, False, n_solve, correction_size, "the linear system is too near to singular")


def _linear_residual(elastic: ElasticFilm, field: Array) -> Array:
    """Compute the residual without the forces of the induced stress.

    The forces of the induced stress are cubic in the field, and the other forces are linear. A field with the amplitude
    a therefore changes the residual by r(a) = k a + c a^3. Two amplitudes determine the linear part k = (8 r(a) - r(2
    a)) / (6 a).

    Args:
        elastic: The discrete film.
        field: Scaled displacements, shape (n_node, 3).

    Returns:
        Residual, shape (n_node, 3).
    """
    amplitude = 0.01  # any amplitude gives the same linear part, except for rounding errors
    flat_residual = elastic.residual(np.zeros_like(field))
    single_change = elastic.residual(amplitude * field) - flat_residual
    double_change = elastic.residual(2.0 * amplitude * field) - flat_residual
    return flat_residual + (8.0 * single_change - double_change) / (6.0 * amplitude)


def solve_newton(
    elastic: ElasticFilm, assembly: Assembly, start: Array, tolerance: float, local_below: float = GUARD_BELOW
) -> NewtonResult:
    """Solve for the equilibrium with Newton's method.

    Each iteration factorises the tangent, takes one Newton step, and reuses the factorised tangent for further steps as
    long as they reduce the residual.

    Args:
        elastic: The discrete film.
        assembly: Linear solver for its mesh.
        start: First iterate, shape (n_node, 3), zero where the film is fixed.
        tolerance: Relative residual at which the solve has converged.
        local_below: Relative residual below which a full Newton step that halves the residual is accepted even if it
            increases the energy.

    Returns:
        The result, which may not have converged.
    """
    iterate = _Iterate.at(elastic, assembly.free[:, :3], start)
    step_sizes: list[float] = []
    for iteration in range(MAX_ITERATIONS + 1):
        relative_residual = iterate.relative_residual
        if not np.isfinite(relative_residual):
            return iterate.result(False, iteration, "the residual is not a finite number")
        if relative_residual <= tolerance:
            return iterate.result(True, iteration, f"converged in {iteration} steps")
        if iteration == MAX_ITERATIONS or _stalled(step_sizes):
            return iterate.result(False, iteration, f"no progress any more after {iteration} steps")

        # Compute the Newton step.
        guard_tension = _guard_tension(elastic, relative_residual)
        factor = factor_tangent(elastic, assembly, iterate.field, guard_tension)
        step = factor.solve(-iterate.residual)
        step_size = _energy_norm(elastic, iterate.field, step, iterate.residual)
        step_sizes.append(step_size)
        if step_size <= ROUND_OFF:
            return iterate.result(True, iteration, f"converged to round-off in {iteration} steps")

        # Close to the equilibrium, take the full step if it halves the residual. Otherwise search the step length.
        next_iterate = _local_step(iterate, step) if relative_residual <= local_below else None
        if next_iterate is None:
            next_iterate = _line_search(iterate, _descent_step(iterate, assembly, step))
        if next_iterate is None:
            return iterate.result(False, iteration, "no step lowers the energy any more")
        iterate = _chord_steps(next_iterate, factor, relative_residual, tolerance)
    raise AssertionError("the loop returns")  # at the latest in its last iteration


@dataclass(frozen=True)
class _Iterate:
    """An iterate of Newton's method.

    Attributes:
        elastic: The discrete film.
        free: Whether each component at each node is free, shape (n_node, 3).
        field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
        residual: Out-of-balance forces at the nodes, shape (n_node, 3).
    """

    elastic: ElasticFilm
    free: Booleans
    field: Array
    residual: Array

    @classmethod
    def at(cls, elastic: ElasticFilm, free: Booleans, field: Array) -> Self:
        """Return the iterate with a given field, shape (n_node, 3)."""
        return cls(elastic, free, field, elastic.residual(field))

    def moved(self, step: Array) -> Self:
        """Return the iterate after a step, shape (n_node, 3)."""
        return type(self).at(self.elastic, self.free, self.field + step)

    @cached_property
    def relative_residual(self) -> float:
        """Maximum of the relative transverse residual and the relative in-plane residual."""
        residual = self.residual * self.free
        load = self.elastic.load_scale
        in_plane_force = max(self.elastic.in_plane_scale(self.field), 1e-300)
        transverse_residual = np.linalg.norm(residual[:, 2]) / load
        in_plane_residual = np.linalg.norm(residual[:, :2]) / in_plane_force
        return float(max(transverse_residual, in_plane_residual))

    def result(self, converged: bool, iterations: int, message: str) -> NewtonResult:
        """Return the result of a solve that ends with this iterate."""
        return NewtonResult(self.field, converged, iterations, self.relative_residual, message)


def _stalled(step_sizes: list[float]) -> bool:
    """Return whether the sizes of the steps no longer decrease.

    This occurs along a direction in which the film has no stiffness.

    Args:
        step_sizes: Sizes of all steps so far, from the first to the last.
    """
    if len(step_sizes) <= 2 * PATIENCE:
        return False
    recent = step_sizes[-PATIENCE:]
    earlier = step_sizes[:-PATIENCE]
    return min(recent) > 0.5 * min(earlier)


def _energy_norm(elastic: ElasticFilm, field: Array, step: Array, residual: Array) -> float:
    """Compute the size of a step.

    The size of a step is the square root of the energy of the step divided by the work of the load.

    Args:
        elastic: The discrete film.
        field: Scaled displacements before the step, shape (n_node, 3).
        step: The step, shape (n_node, 3).
        residual: Out-of-balance forces before the step, shape (n_node, 3).
    """
    step_energy = abs(float(np.sum(step * residual)))
    return float(np.sqrt(step_energy / max(elastic.work(field), 1e-300)))


def _guard_tension(elastic: ElasticFilm, relative_residual: float) -> float:
    """Return the tension that is added to the tangent, because a flat film without pretension has no stiffness.

    The tension is proportional to the relative residual, and at most `GUARD_TENSION` times the tension that the load
    induces. It is zero if the relative residual is at most `GUARD_BELOW`.
    """
    if relative_residual <= GUARD_BELOW:
        return 0.0
    induced_tension = float(np.cbrt(elastic.groups.total_load)) ** 2
    return GUARD_TENSION * induced_tension * min(1.0, relative_residual)


def _local_step(iterate: _Iterate, step: Array) -> _Iterate | None:
    """Return the iterate after the full Newton step if this step at least halves the residual, and None otherwise.

    The step may increase the energy, because a compressed film can have a flat equilibrium with a slightly higher
    energy than the wrinkled equilibrium.
    """
    if not np.isfinite(step).all():
        return None
    trial = iterate.moved(step)
    halves_residual = trial.relative_residual < 0.5 * iterate.relative_residual
    return trial if halves_residual else None


def _chord_steps(iterate: _Iterate, factor: TangentFactor, residual_before: float, tolerance: float) -> _Iterate:
    """Continue with the factorised tangent of the last Newton step as long as it reduces the residual (chord method).

    A step with a reused tangent costs a seventh of a Newton step. If the last step multiplied the residual by s, the
    next step with the same tangent multiplies it by about 2 s (Kelley 1995).

    Args:
        iterate: Iterate after the Newton step.
        factor: Factorised tangent of this step.
        residual_before: Relative residual before this step.
        tolerance: Relative residual at which the solve has converged.

    Returns:
        The last iterate whose step reduced the residual sufficiently.
    """
    if iterate.relative_residual > CHORD_START * residual_before:
        return iterate
    while iterate.relative_residual > tolerance:
        trial = iterate.moved(factor.solve(-iterate.residual))
        if not trial.relative_residual < CHORD_CONTINUE * iterate.relative_residual:
            break
        iterate = trial
    return iterate


def _descent_step(iterate: _Iterate, assembly: Assembly, step: Array) -> Array:
    """Return the Newton step if it is a descent direction of the energy, and a modified step otherwise.

    A step is a descent direction if its product with the residual, which is the gradient of the energy, is negative.
    For a modified step, a tension is added to the tangent. The tension is doubled until the step is a descent
    direction, at most `MAX_DESCENT_TRIALS` times.

    Args:
        iterate: Present iterate.
        assembly: Linear solver for the mesh.
        step: Newton step, shape (n_node, 3).

    Returns:
        The step, shape (n_node, 3). After the largest number of trials, it may not be a descent direction.
    """
    elastic = iterate.elastic
    induced_tension = float(np.cbrt(elastic.groups.total_load)) ** 2
    tension = FIRST_DESCENT_TENSION * GUARD_TENSION * induced_tension
    for _ in range(MAX_DESCENT_TRIALS):
        energy_slope = float(np.sum(step * iterate.residual))
        is_descent_direction = np.isfinite(step).all() and energy_slope < 0.0
        if is_descent_direction:
            break
        stiffer_tangent = factor_tangent(elastic, assembly, iterate.field, tension)
        step = stiffer_tangent.solve(-iterate.residual)
        tension *= 2.0
    return step


def _line_search(iterate: _Iterate, step: Array) -> _Iterate | None:
    """Halve a step until it lowers the energy sufficiently (condition of Armijo).

    The energy must decrease by at least `ARMIJO_SHARE` times the decrease that the slope along the step predicts. If
    the change of the energy is not larger than its rounding errors, the step must lower the residual instead.

    Args:
        iterate: Present iterate.
        step: Full step, shape (n_node, 3).

    Returns:
        The iterate after the step, or None if no step length is accepted.
    """
    elastic = iterate.elastic
    energy = elastic.energy(iterate.field)
    energy_slope = float(np.sum(step * iterate.residual))  # along the step
    residual_norm = np.linalg.norm(iterate.residual[iterate.free])
    step_length = 1.0
    for _ in range(MAX_HALVINGS):
        field = iterate.field + step_length * step
        energy_change = elastic.energy(field) - energy
        lowers_energy = energy_change <= ARMIJO_SHARE * step_length * energy_slope
        is_round_off = abs(energy_change) <= ENERGY_ROUND_OFF * abs(energy)
        if lowers_energy or is_round_off:
            trial = _Iterate.at(elastic, iterate.free, field)
            if lowers_energy or np.linalg.norm(trial.residual[iterate.free]) < residual_norm:
                return trial
        step_length *= 0.5
    return None
