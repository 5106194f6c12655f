"""Nonlinear least squares over the product of a disk and an interval, for many small problems at once.

Each problem is to minimise |r(u)|^2 over u in D = unit disk x [-1, 1]. The residual r has a few components, and J is
the matrix of its derivatives. A damped Gauss-Newton step solves (J'J + damping trace(J'J) / 3) du = -J'r (Levenberg
1944). The bounds of D are treated by an active set. If u lies on an edge and the negative gradient points out of D, the
step follows the edge. On the edge of the disk, the curvature of the circle is added to the second derivatives. A search
along the circle therefore also converges within a few steps, even if the minimum without bounds lies far outside of D.
"""

from collections.abc import Callable

import numpy as np

from isocharge.common.arrays import Array, Integers

Residuals = Callable[[Integers, Array], tuple[Array, Array]]
"""Function of the indices of problems, shape (m,), and of their points u, shape (m, 3). It returns the residuals r,
shape (m, k), and their derivatives dr/du, shape (m, 3, k)."""

MAX_STEPS = 60
"""Default of the largest number of steps. Most problems converge in five. Problems with large residuals may need more
than thirty."""

MIN_CHANGE = 1e-7
"""Default of the change of |r|^2 below which the iteration ends, relative to 1 + |r|^2."""

MAX_INCREASE = 1e-12
"""Largest increase of |r|^2 that an accepted step may cause, relative to 1 + |r|^2.

Near the minimum, rounding errors cause such increases.
"""

INITIAL_DAMPING = 1e-4
"""Damping of the first step, relative to the mean of the diagonal of J'J."""

MIN_DAMPING = 1e-9
"""Smallest damping, relative to the mean of the diagonal of J'J."""

MAX_DAMPING = 1e4
"""Damping above which the iteration ends without convergence, relative to the mean of the diagonal of J'J."""

DAMPING_DECREASE = 0.2
"""Factor of the damping after a step that lowers |r|^2, dimensionless."""

DAMPING_INCREASE = 8.0
"""Factor of the damping after a rejected step, dimensionless."""

EDGE_STIFFNESS = 1e6
"""Stiffness that keeps a point on an active edge, relative to the trace of J'J."""

EDGE_TOLERANCE = 1e-9
"""Distance from an edge of D below which a point counts as lying on the edge."""

MEAN_OF_DIAGONAL = np.eye(3) / 3.0
"""Matrix whose product with the trace of a 3 x 3 matrix is a diagonal matrix.

All diagonal elements of the product are the mean of the diagonal of the 3 x 3 matrix.
"""


def minimise(
    residuals: Residuals, start: Array, steps: int = MAX_STEPS, min_change: float = MIN_CHANGE
) -> tuple[Array, Array]:
    """Find a local minimum of every problem by damped Gauss-Newton steps from a starting point.

    Each problem minimises |r(u)|^2 over the domain D of u, which is the unit disk times the interval [-1, 1]. The
    damping of a problem is reduced after a step that is accepted, and increased after a step that is rejected because
    it increases |r|^2. A problem is finished if |r|^2 hardly changes, or if the damping exceeds `MAX_DAMPING`.

    Args:
        residuals: Function that evaluates the residuals and their derivatives for some of the problems. Its arguments
            are the indices of the problems and their points.
        start: Starting points, shape (n, 3). Points outside D are replaced by the nearest point of D.
        steps: Largest number of steps.
        min_change: Change of |r|^2 below which the iteration ends, relative to 1 + |r|^2.

    Returns:
        Points in D, shape (n, 3), and their residuals, shape (n, k).
    """
    point = into_domain(start).copy()
    active = np.arange(len(start))  # indices of the problems that have not converged
    first_residual, first_slopes = residuals(active, point)
    residual = np.array(first_residual)
    slopes = np.array(first_slopes)
    square = (residual**2).sum(axis=1)  # |r|^2, shape (n,)
    damping = np.full(len(point), INITIAL_DAMPING)
    for _ in range(steps):
        if not active.size:
            break

        # A step is accepted if it does not increase |r|^2.
        trial = bounded_step(point[active], residual[active], slopes[active], damping[active])
        trial_residual, trial_slopes = residuals(active, trial)
        trial_square = (trial_residual**2).sum(axis=1)
        change = (trial_square - square[active]) / (1.0 + trial_square)
        is_accepted = change <= MAX_INCREASE
        accepted = active[is_accepted]
        point[accepted] = trial[is_accepted]
        residual[accepted] = trial_residual[is_accepted]
        slopes[accepted] = trial_slopes[is_accepted]
        square[accepted] = trial_square[is_accepted]

        # Adapt the damping, and remove the problems that have ended.
        lower_damping = np.maximum(damping[active] * DAMPING_DECREASE, MIN_DAMPING)
        higher_damping = damping[active] * DAMPING_INCREASE
        damping[active] = np.where(is_accepted, lower_damping, higher_damping)
        is_changing = np.abs(change) >= min_change
        is_damping_allowed = damping[active] <= MAX_DAMPING
        active = active[is_changing & is_damping_allowed]
    return point, residual


def bounded_step(unit: Array, residual: Array, slopes: Array, damping: Array | float) -> Array:
    """Take one damped Gauss-Newton step that stays within the domain D, the unit disk times [-1, 1].

    With the Jacobian J of the residuals, the step is -(J'J + damping * mean(diag(J'J)) I)^-1 J'r. It is modified for
    points on the edge of D.

    Args:
        unit: Points of D, shape (..., 3).
        residual: Residuals r at the points, shape (..., k).
        slopes: Derivatives dr/du at the points, shape (..., 3, k).
        damping: Damping relative to the mean of the diagonal of J'J, shape (...).

    Returns:
        Points after the step, shape (..., 3).
    """
    # Damped normal equations. The addition to the trace avoids a singular matrix if all derivatives are zero.
    normal_matrix: Array = slopes @ slopes.swapaxes(-1, -2)  # J'J, shape (..., 3, 3)
    gradient: Array = (slopes @ residual[..., None])[..., 0]  # J'r, shape (..., 3)
    trace = normal_matrix[..., 0, 0] + normal_matrix[..., 1, 1] + normal_matrix[..., 2, 2] + 1e-12
    normal_matrix = normal_matrix + (damping * trace)[..., None, None] * MEAN_OF_DIAGONAL

    # At the edge of the disk or at an end of the interval, a step must not leave D.
    is_on_circle, is_at_end = _is_beyond(unit, 1.0 - EDGE_TOLERANCE)
    if np.count_nonzero(is_on_circle | is_at_end):
        normal_matrix, gradient = _restrict_to_edges(unit, normal_matrix, gradient, trace, is_on_circle, is_at_end)
    descent = np.linalg.solve(normal_matrix, gradient[..., None])[..., 0]
    return into_domain(np.asarray(unit - descent))


def _is_beyond(unit: Array, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Compare points with the domain D scaled by a factor.

    Args:
        unit: Points, shape (..., 3).
        scale: Factor of the domain.

    Returns:
        Whether each point lies outside the disk of radius `scale`, and whether it lies outside the interval
        [-scale, scale], each of shape (...).
    """
    squares = unit * unit
    is_outside_disk = squares[..., 0] + squares[..., 1] > scale * scale
    is_outside_interval = squares[..., 2] > scale * scale
    return is_outside_disk, is_outside_interval


def _restrict_to_edges(
    unit: Array,
    normal_matrix: Array,
    gradient: Array,
    trace: Array,
    is_on_circle: np.ndarray,
    is_at_end: np.ndarray,
) -> tuple[Array, Array]:
    """Modify the normal equations so that steps do not leave D across an edge, but follow the edge.

    The edges of D are the unit circle for the first two coordinates, and both ends of the interval [-1, 1] for the
    third coordinate.

    Args:
        unit: Points of D, shape (..., 3).
        normal_matrix: Damped matrices J'J, shape (..., 3, 3).
        gradient: Gradients J'r, shape (..., 3).
        trace: Traces of J'J, shape (...).
        is_on_circle: Whether each point lies on the edge of the disk, shape (...).
        is_at_end: Whether each point lies at an end of the interval, shape (...).

    Returns:
        Modified matrices, shape (..., 3, 3), and modified gradients, shape (..., 3).
    """
    # Unit vectors at each point: normal and tangent of the circle, and normal of the end of the interval
    radius = np.hypot(unit[..., 0], unit[..., 1])
    circle_normal = np.zeros_like(unit)
    circle_normal[..., :2] = unit[..., :2] / np.maximum(radius, EDGE_TOLERANCE)[..., None]
    circle_tangent = np.zeros_like(unit)
    circle_tangent[..., 0] = -circle_normal[..., 1]
    circle_tangent[..., 1] = circle_normal[..., 0]
    end_normal = np.zeros_like(unit)
    end_normal[..., 2] = np.sign(unit[..., 2])

    # An edge is active if the negative gradient has an outward component, which is then the Lagrange multiplier.
    circle_outward = -(gradient * circle_normal).sum(axis=-1)
    end_outward = -(gradient * end_normal).sum(axis=-1)
    circle_multiplier = np.where(is_on_circle, np.maximum(circle_outward, 0.0), 0.0)
    end_multiplier = np.where(is_at_end, np.maximum(end_outward, 0.0), 0.0)

    # The curvature of the circle acts along its tangent. The stiffness keeps the point on the active edges.
    curvature = _outer_product(circle_tangent, circle_multiplier)
    stiffness = EDGE_STIFFNESS * trace
    circle_stiffness = _outer_product(circle_normal, np.where(circle_multiplier > 0.0, stiffness, 0.0))
    end_stiffness = _outer_product(end_normal, np.where(end_multiplier > 0.0, stiffness, 0.0))
    new_matrix = normal_matrix + curvature + circle_stiffness + end_stiffness

    # The components of the gradient that point out of D do not contribute to the step.
    circle_component = circle_multiplier[..., None] * circle_normal
    end_component = end_multiplier[..., None] * end_normal
    return new_matrix, gradient + circle_component + end_component


def _outer_product(vector: Array, factor: Array) -> Array:
    """Return the matrix factor * v v' for each vector v.

    Args:
        vector: Vectors v, shape (..., 3).
        factor: Factors, shape (...).

    Returns:
        Matrices, shape (..., 3, 3).
    """
    return factor[..., None, None] * vector[..., :, None] * vector[..., None, :]


def into_domain(unit: Array) -> Array:
    """Replace points outside of the domain D, the unit disk times [-1, 1], by the nearest points of D.

    Args:
        unit: Points, shape (..., 3).

    Returns:
        Points of D, same shape.
    """
    is_outside_disk, is_outside_interval = _is_beyond(unit, 1.0)
    if not np.count_nonzero(is_outside_disk | is_outside_interval):
        return unit
    radius = np.sqrt(unit[..., 0] ** 2 + unit[..., 1] ** 2)
    in_disk = unit[..., :2] / np.maximum(radius, 1.0)[..., None]
    in_interval = np.clip(unit[..., 2:], -1.0, 1.0)
    return np.concatenate([in_disk, in_interval], axis=-1)
