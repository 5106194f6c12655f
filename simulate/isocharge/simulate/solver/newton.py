"""Newton's method for the equilibrium of the film.

A flat film without pretension has no transverse stiffness, so Newton's method fails without modifications. Three
modifications make the method reliable. First, the iteration starts from a deflection with the shape of Schwerin's
solution. Second, a line search on the energy determines the length of each step. Third, a stabilising tension is added
to the tangent matrix, but not to the residual. Because of the stabilising tension, each Newton step is a descent
direction of the energy. The tension is proportional to the residual and vanishes near the equilibrium, so Newton's
method still converges quadratically.

The iteration stops after `MAX_ITERATIONS` steps.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.solver.assembly import SolveTangent, assembly, factor_tangent

STABILISING_TENSION = 0.4
"""Stabilising tension at a relative residual of one.

The unit is the tension that the load induces in a film without pretension.
"""

UNSTABILISED_BELOW = 1e-2
"""Relative residual below which no stabilising tension is added to the tangent, dimensionless."""

MAX_ITERATIONS = 60
"""Largest number of Newton steps. Typical presses need five to ten steps."""

ROUND_OFF = 1e-9
"""Largest size of a Newton step that is treated as an effect of rounding errors.

The size of a step is its energy norm relative to the work of the load.
"""


@dataclass(frozen=True, kw_only=True)
class NewtonResult:
    """Result of a solve.

    Attributes:
        field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3), dimensionless. The press is rotated
            onto the x axis.
        status: "converged" if the residual is below the tolerance or at the level of rounding errors, otherwise
            "failed".
        message: Description of the outcome in one sentence.
        iterations: Number of Newton steps with a new tangent.
        residual: Larger of two ratios: the transverse residual divided by the load, and the in-plane residual divided
            by the in-plane forces.
    """

    field: Array
    status: Literal["converged", "failed"]
    message: str
    iterations: int
    residual: float


def first_iterate(elastic: ElasticFilm) -> Array:
    """Compute the first iterate of Newton's method: an approximate deflection under the probe and the static pressure.

    The deflection under the probe is proportional to 1 - r^(2/3), where r is the distance from the origin of the
    template plane. This is the shape of a membrane without pretension under a point load if Poisson's ratio is 1/3
    (Schwerin 1929). A paraboloid is added for the deflection under the static pressure. The in-plane displacements are
    zero.

    Args:
        elastic: Discrete model of the film.

    Returns:
        Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
    """
    mesh = elastic.mesh
    groups = elastic.groups
    # Convert the nodes of a film with an oval clamp into points of a circular film, and these into the template plane.
    circular_points = mesh.placement.to_circular_film(mesh.node_points)
    template_distance = np.abs(mesh.placement.to_template(circular_points))
    # The cube root of r^2 has a sharp tip at r = 0. The squared radius of the innermost circle is added to r^2, which
    # makes the tip round.
    squared_radius = float(mesh.placement.template_radius) ** 2
    probe_shape = np.cbrt(1.0 + squared_radius) - np.cbrt(template_distance**2 + squared_radius)
    pressure_shape = 1.0 - np.abs(circular_points) ** 2
    # `height` and `static_height` are the approximate deflections of the centre under the probe and under the pressure.
    field = np.zeros((circular_points.size, 3))
    field[:, 2] = groups.height * probe_shape + groups.static_height * pressure_shape
    field[mesh.template.on_rim] = 0.0  # removes rounding errors
    return field


def solve_newton(
    elastic: ElasticFilm, first_field: Array, tolerance: float, full_steps_below: float = UNSTABILISED_BELOW
) -> NewtonResult:
    """Solve for the equilibrium of the film by Newton's method.

    Each iteration factorises the tangent and takes one Newton step. The factorised tangent is reused for further steps
    as long as these steps reduce the residual sufficiently.

    Args:
        elastic: Discrete model of the film.
        first_field: First iterate, shape (n_node, 3), which is zero where the film is fixed.
        tolerance: Largest relative residual that a converged solve may have.
        full_steps_below: Relative residual below which a full Newton step may increase the energy. Such a step is
            accepted if it halves the residual.

    Returns:
        The result, which may not have converged.
    """
    # Whether each displacement is free, shape (n_node, 3), without the auxiliary unknown of bending, which is the
    # fourth column. False means that the fields are even about the line of symmetry of a half mesh.
    free = assembly(elastic.mesh.template, elastic.unknowns_per_node, False).free[:, :3]
    iterate = _Iterate(elastic, free, first_field)
    iteration = 0
    while True:
        residual_before_step = iterate.relative_residual
        if not np.isfinite(residual_before_step):
            return iterate.result(iteration, "failed", "the residual is not a finite number")
        if residual_before_step <= tolerance:
            return iterate.result(iteration, "converged", f"converged in {iteration} steps")
        if iteration == MAX_ITERATIONS:
            return iterate.result(iteration, "failed", f"not converged after {iteration} steps")

        # Take a step with a new tangent, and further steps with the same tangent.
        stabilising_tension = _stabilising_tension(elastic, residual_before_step)
        solve = factor_tangent(elastic, iterate.field, stabilising_tension)
        step = solve(-iterate.residual)
        if iterate.size_of(step) <= ROUND_OFF:
            return iterate.result(iteration, "converged", f"converged to round-off in {iteration} steps")
        next_iterate = _take_step(iterate, step, full_steps_below)
        if next_iterate is None:
            return iterate.result(iteration, "failed", "no step lowers the energy any more")
        iterate = _chord_steps(next_iterate, solve, residual_before_step, tolerance)
        iteration += 1


@dataclass(frozen=True)
class _Iterate:
    """Iterate of Newton's method.

    Attributes:
        elastic: Discrete model of the film.
        free: Whether each displacement component at each node is free, shape (n_node, 3).
        field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
    """

    elastic: ElasticFilm
    free: Booleans
    field: Array

    def after(self, step: Array) -> Self:
        """Return the iterate whose field is the present field plus a step of shape (n_node, 3)."""
        return replace(self, field=self.field + step)

    @cached_property
    def element_forces(self) -> Array:
        """Internal forces of the elements, shape (n_element, n_local, 3)."""
        return self.elastic.element_forces(self.field)

    @cached_property
    def residual(self) -> Array:
        """Out-of-balance forces at the nodes, shape (n_node, 3)."""
        return self.elastic.out_of_balance(self.field, self.element_forces)

    @cached_property
    def relative_residual(self) -> float:
        """Larger of the relative transverse residual and the relative in-plane residual, dimensionless.

        The transverse residual is divided by the norm of the load. The in-plane residual is divided by the norm of the
        in-plane forces of the elements.
        """
        free_residual = self.residual * self.free  # without the reactions at fixed nodes
        in_plane_force = float(np.linalg.norm(self.element_forces[..., :2]))
        transverse_ratio = np.linalg.norm(free_residual[:, 2]) / np.linalg.norm(self.elastic.load)
        in_plane_ratio = np.linalg.norm(free_residual[:, :2]) / max(in_plane_force, 1e-300)  # avoids a division by zero
        return float(max(transverse_ratio, in_plane_ratio))

    def size_of(self, step: Array) -> float:
        """Compute the size of a step from this iterate: the square root of (energy of the step / work of the load).

        Args:
            step: Change of the displacements, shape (n_node, 3).
        """
        step_energy = abs(float(np.sum(step * self.residual)))
        work = max(abs(float(self.elastic.load @ self.field[:, 2])), 1e-300)  # the limit avoids a division by zero
        return float(np.sqrt(step_energy / work))

    def result(self, iterations: int, status: Literal["converged", "failed"], message: str) -> NewtonResult:
        """Return the result of a solve whose last iterate is this object.

        Args:
            iterations: Number of Newton steps with a new tangent.
            status: Status of the solve.
            message: Description of the outcome in one sentence.
        """
        return NewtonResult(
            field=self.field, status=status, message=message, iterations=iterations, residual=self.relative_residual
        )


def _stabilising_tension(elastic: ElasticFilm, relative_residual: float) -> float:
    """Compute the tension that is added to the tangent in order to stabilise Newton's method.

    A flat film without pretension has no transverse stiffness. The tension is proportional to the relative residual.
    The tension does not exceed `STABILISING_TENSION` times the tension that the load induces. The tension is zero if
    the relative residual is at most `UNSTABILISED_BELOW`.

    Args:
        elastic: Discrete model of the film.
        relative_residual: Relative residual of the present iterate.

    Returns:
        Tension, in units of E_young A^2.
    """
    if relative_residual <= UNSTABILISED_BELOW:
        return 0.0
    return STABILISING_TENSION * elastic.groups.induced_tension * min(1.0, relative_residual)


def _take_step(iterate: _Iterate, step: Array, full_steps_below: float) -> _Iterate | None:
    """Take a full Newton step if it is acceptable, and otherwise a shorter or modified step that lowers the energy.

    Close to the equilibrium, the full step is taken if it halves the residual, even if it increases the energy. The
    reason is that the flat equilibrium of a compressed film can have a slightly higher energy than the wrinkled
    equilibrium. In all other cases, a line search determines a step that lowers the energy.

    Args:
        iterate: Present iterate.
        step: Newton step, shape (n_node, 3).
        full_steps_below: Relative residual below which the iterate is close to the equilibrium.

    Returns:
        The iterate after the step; None if no step lowers the energy.
    """
    if iterate.relative_residual <= full_steps_below:
        after_full_step = iterate.after(step)
        if after_full_step.relative_residual < 0.5 * iterate.relative_residual:
            return after_full_step
    return _line_search(iterate, _descent_step(iterate, step))


def _chord_steps(iterate: _Iterate, solve: SolveTangent, previous_residual: float, tolerance: float) -> _Iterate:
    """Take further steps with the factorised tangent of the last Newton step, as long as they reduce the residual.

    This is the chord method. A step with a reused tangent takes about a seventh of the time of a Newton step. If the
    last step multiplied the residual by a factor s, the next step with the same tangent multiplies the residual by
    about 2 s (Kelley 1995). The tangent is reused if s is at most a half, and as long as each step halves the residual.
    Three such steps reduce the residual by a factor of at least eight, in half of the time of a Newton step. A step
    that is no descent direction of the energy would approach an unstable equilibrium, and is not taken.

    Args:
        iterate: Iterate after the Newton step.
        solve: Function that solves linear systems with the tangent of the last Newton step.
        previous_residual: Relative residual before the Newton step.
        tolerance: Largest relative residual that a converged solve may have.

    Returns:
        The last iterate whose step reduced the residual sufficiently.
    """
    if iterate.relative_residual > 0.5 * previous_residual:  # the Newton step reduced the residual too little
        return iterate
    while iterate.relative_residual > tolerance:
        step = solve(-iterate.residual)
        next_iterate = iterate.after(step)
        lowers_energy = np.sum(step * iterate.residual) < 0.0  # the residual is the gradient of the energy
        halves_residual = next_iterate.relative_residual < 0.5 * iterate.relative_residual
        if not (lowers_energy and halves_residual):  # also if a number is NaN
            break
        iterate = next_iterate
    return iterate


def _descent_step(iterate: _Iterate, newton_step: Array) -> Array:
    """Return the Newton step if it is a descent direction of the energy, and a modified step otherwise.

    The residual is the gradient of the energy. A step is therefore a descent direction if its scalar product with the
    residual is negative. The modified step is computed with a tension that is added to the tangent. The tension is
    doubled until the modified step is a descent direction, or until twelve tensions were tried.

    Args:
        iterate: Present iterate.
        newton_step: Newton step, shape (n_node, 3).

    Returns:
        The step, shape (n_node, 3). If no tension is sufficient, the step may not be a descent direction.
    """
    elastic = iterate.elastic
    step = newton_step
    # The first tension is a twentieth of the largest stabilising tension, which is `STABILISING_TENSION` times the
    # tension that the load induces.
    added_tension = 0.05 * STABILISING_TENSION * elastic.groups.induced_tension
    for _ in range(12):
        energy_slope = float(np.sum(step * iterate.residual))
        is_descent_direction = np.isfinite(step).all() and energy_slope < 0.0
        if is_descent_direction:
            break
        solve_stiffer = factor_tangent(elastic, iterate.field, added_tension)  # solves systems with this tangent
        step = solve_stiffer(-iterate.residual)
        added_tension *= 2.0
    return step


def _line_search(iterate: _Iterate, step: Array) -> _Iterate | None:
    """Halve a step until it lowers the energy sufficiently.

    According to Armijo's condition, the energy must decrease by at least 1e-4 times the decrease that the slope of the
    energy along the step predicts. If the change of the energy may be caused by rounding errors, the step must lower
    the residual instead. At most thirty step lengths are tried.

    Args:
        iterate: Present iterate.
        step: Full step, shape (n_node, 3).

    Returns:
        The iterate after the accepted step. None if no step length is accepted.
    """
    elastic = iterate.elastic
    energy = elastic.energy(iterate.field)
    energy_slope = float(np.sum(step * iterate.residual))  # derivative of the energy with respect to the step length
    residual_norm = np.linalg.norm(iterate.residual[iterate.free])  # without the reactions at fixed displacements
    step_length = 1.0
    for _ in range(30):
        next_iterate = iterate.after(step_length * step)
        energy_change = elastic.energy(next_iterate.field) - energy
        if energy_change <= 1e-4 * step_length * energy_slope:
            return next_iterate
        is_round_off = abs(energy_change) <= 1e-12 * abs(energy)
        if is_round_off and np.linalg.norm(next_iterate.residual[iterate.free]) < residual_norm:
            return next_iterate
        step_length *= 0.5
    return None
