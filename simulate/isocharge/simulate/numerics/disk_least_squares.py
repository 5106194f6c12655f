"""Solver for many small nonlinear least-squares problems whose unknowns are bounded by a disk and an interval.

Each problem has three unknowns u, which are the coordinates of a point in the domain D. The domain D is the unit disk
times the interval [-1, 1]. The solution of a problem minimises the sum of the squared residuals |r(u)|^2 over D. The
Jacobian J contains the derivatives of the residuals r with respect to the unknowns u.

Each damped Gauss-Newton step du solves the equation (J'J + damping * trace(J'J) / 3 * I) du = -J'r (Levenberg 1944). An
active-set method keeps the points within the bounds of D. If a point lies on an edge of D and the negative gradient
points out of D, the step follows the edge. On the edge of the disk, the curvature of the circle is added to the matrix
J'J. A search along the circle therefore converges within a few steps, even if the unconstrained minimum lies far
outside D.
"""

from collections.abc import Callable

import numpy as np

from isocharge.common.arrays import Array, Integers

ResidualFunction = Callable[[Integers, Array], tuple[Array, Array]]
"""Function that evaluates the residuals of some of the problems.

Its arguments are the indices of the problems, shape (m,), and the points u, shape (m, 3). The function returns the
residuals r, shape (m, k), and their derivatives dr/du, shape (m, 3, k).
"""

MAX_STEPS = 60
"""Default value for the largest number of steps.

Most problems converge in five steps. Problems with large residuals may need more than thirty steps.
"""

MIN_CHANGE = 1e-7
"""Default value for the change of |r|^2 below which the iteration ends, relative to 1 + |r|^2."""

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
"""Stiffness added across an active edge to keep a point on the edge, divided by the trace of J'J, dimensionless."""

EDGE_TOLERANCE = 1e-9
"""Distance from an edge of D below which a point counts as lying on the edge."""

MEAN_OF_DIAGONAL = np.eye(3) / 3.0
"""Matrix whose product with the trace of a 3 x 3 matrix is a diagonal matrix.

All diagonal elements of the product are the mean of the diagonal of the 3 x 3 matrix.
"""


def minimise(
    evaluate: ResidualFunction, start: Array, max_steps: int = MAX_STEPS, min_change: float = MIN_CHANGE
) -> tuple[Array, Array]:
    """Find a local minimum of each problem by damped Gauss-Newton steps, which begin at a given starting point.

    Each problem minimises the sum of squares |r(u)|^2 over all points u of the domain D. The domain D is the unit disk
    times the interval [-1, 1]. A step that increases |r|^2 is rejected. The damping decreases after each accepted step
    and increases after each rejected step. The iteration of a problem ends when |r|^2 changes by less than a tolerance,
    or when the damping exceeds `MAX_DAMPING`.

    Args:
        evaluate: Function that evaluates the residuals r and their derivatives dr/du for some of the problems. Its
            arguments are the indices of the problems, shape (m,), and a point of each problem, shape (m, 3).
        start: Starting points, shape (n, 3). Points outside D are replaced by the nearest point of D.
        max_steps: Largest number of steps.
        min_change: Change of |r|^2 below which the iteration ends, relative to 1 + |r|^2.

    Returns:
        Points in D, shape (n, 3), and the residuals at these points, shape (n, k).
    """
    point = into_domain(start).copy()
    active_problems = np.arange(len(start))  # indices of the problems whose iteration has not ended
    start_residual, start_slopes = evaluate(active_problems, point)
    residual = np.array(start_residual)  # r, shape (n, k)
    slopes = np.array(start_slopes)  # dr/du, shape (n, 3, k)
    squared_norm = (residual**2).sum(axis=1)  # |r|^2, shape (n,)
    damping = np.full(len(point), INITIAL_DAMPING)
    for _ in range(max_steps):
        if not active_problems.size:
            break

        # A step is accepted if it does not increase |r|^2 by more than rounding errors.
        trial_point = bounded_step(
            point[active_problems], residual[active_problems], slopes[active_problems], damping[active_problems]
        )
        trial_residual, trial_slopes = evaluate(active_problems, trial_point)
        trial_squared_norm = (trial_residual**2).sum(axis=1)
        change = (trial_squared_norm - squared_norm[active_problems]) / (1.0 + trial_squared_norm)
        is_accepted = change <= MAX_INCREASE
        accepted_problems = active_problems[is_accepted]
        point[accepted_problems] = trial_point[is_accepted]
        residual[accepted_problems] = trial_residual[is_accepted]
        slopes[accepted_problems] = trial_slopes[is_accepted]
        squared_norm[accepted_problems] = trial_squared_norm[is_accepted]

        # Adapt the damping, and remove the problems whose iteration has ended.
        lower_damping = np.maximum(damping[active_problems] * DAMPING_DECREASE, MIN_DAMPING)
        higher_damping = damping[active_problems] * DAMPING_INCREASE
        damping[active_problems] = np.where(is_accepted, lower_damping, higher_damping)
        is_changing = np.abs(change) >= min_change
        is_damping_allowed = damping[active_problems] <= MAX_DAMPING
        active_problems = active_problems[is_changing & is_damping_allowed]
    return point, residual


def bounded_step(point: Array, residual: Array, slopes: Array, damping: Array | float) -> Array:
    """Take one damped Gauss-Newton step that does not leave the domain D.

    The domain D is the unit disk times the interval [-1, 1]. The step is -(J'J + damping * mean(diag(J'J)) * I)^-1 J'r,
    where r are the residuals and J is the Jacobian. For points on an edge of D, the step is modified such that it does
    not leave D.

    Args:
        point: Points of D, shape (..., 3).
        residual: Residuals r at the points, shape (..., k).
        slopes: Derivatives dr/du at the points, which are the transposed Jacobian J', shape (..., 3, k).
        damping: Damping relative to the mean of the diagonal of J'J, shape (...).

    Returns:
        Points after the step, shape (..., 3).
    """
    # Damped normal equations. The addition to the trace avoids a singular matrix if all derivatives are zero.
    squared_slopes: Array = slopes @ slopes.swapaxes(-1, -2)  # J'J, shape (..., 3, 3)
    residual_column = residual[..., None]  # shape (..., k, 1)
    gradient: Array = (slopes @ residual_column)[..., 0]  # J'r, shape (..., 3)
    trace = squared_slopes[..., 0, 0] + squared_slopes[..., 1, 1] + squared_slopes[..., 2, 2] + 1e-12
    normal_matrix = squared_slopes + (damping * trace)[..., None, None] * MEAN_OF_DIAGONAL

    # At the edge of the disk or at an end of the interval, a step must not leave D.
    is_on_circle, is_at_end = _is_outside_scaled_domain(point, 1.0 - EDGE_TOLERANCE)
    if np.count_nonzero(is_on_circle | is_at_end):
        normal_matrix, gradient = _restrict_to_edges(point, normal_matrix, gradient, trace, is_on_circle, is_at_end)
    gradient_column = gradient[..., None]  # shape (..., 3, 1)
    negative_step = np.linalg.solve(normal_matrix, gradient_column)[..., 0]  # shape (..., 3)
    return into_domain(np.asarray(point - negative_step))


def _is_outside_scaled_domain(point: Array, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which points lie outside the scaled disk, and which points lie outside the scaled interval.

    Args:
        point: Points, shape (..., 3). The first two coordinates belong to the disk, and the third to the interval.
        scale: Radius of the disk and half length of the interval.

    Returns:
        Whether each point lies outside the disk of radius `scale`, and whether it lies outside the interval
        [-scale, scale]. Each array has the shape (...).
    """
    squares = point * point
    is_outside_disk = squares[..., 0] + squares[..., 1] > scale * scale
    is_outside_interval = squares[..., 2] > scale * scale
    return is_outside_disk, is_outside_interval


def _restrict_to_edges(
    point: Array,
    normal_matrix: Array,
    gradient: Array,
    trace: Array,
    is_on_circle: np.ndarray,
    is_at_end: np.ndarray,
) -> tuple[Array, Array]:
    """Modify the normal equations such that each step from an edge of the domain D follows the edge or points inwards.

    The first two coordinates of D are bounded by the unit circle. The third coordinate is bounded by both ends of the
    interval [-1, 1].

    Args:
        point: Points of D, shape (..., 3).
        normal_matrix: Damped matrices J'J, shape (..., 3, 3), where J is the Jacobian of the residuals r.
        gradient: Gradients J'r, shape (..., 3).
        trace: Traces of the matrices J'J before the damping, shape (...).
        is_on_circle: Whether each point lies on the edge of the disk, shape (...).
        is_at_end: Whether each point lies at an end of the interval, shape (...).

    Returns:
        Modified matrices, shape (..., 3, 3), and modified gradients, shape (..., 3).
    """
    circle_normal, circle_tangent, end_normal = _edge_vectors(point)

    # An edge is active if the negative gradient at a point on this edge has an outward component. This component is the
    # Lagrange multiplier of the edge. The multiplier of an inactive edge is zero.
    circle_outward = -(gradient * circle_normal).sum(axis=-1)
    end_outward = -(gradient * end_normal).sum(axis=-1)
    circle_multiplier = np.where(is_on_circle, np.maximum(circle_outward, 0.0), 0.0)
    end_multiplier = np.where(is_at_end, np.maximum(end_outward, 0.0), 0.0)

    # Modify the matrices. The curvature of the circle adds a second derivative along the tangent. A large stiffness in
    # the direction of the normal keeps the step on an active edge.
    curvature = _outer_product(circle_tangent, circle_multiplier)
    stiffness = EDGE_STIFFNESS * trace
    circle_stiffness = _outer_product(circle_normal, np.where(circle_multiplier > 0.0, stiffness, 0.0))
    end_stiffness = _outer_product(end_normal, np.where(end_multiplier > 0.0, stiffness, 0.0))
    new_matrix = normal_matrix + curvature + circle_stiffness + end_stiffness

    # Remove the components of the negative gradient that point out of D, because the step must not follow them.
    circle_component = circle_multiplier[..., None] * circle_normal
    end_component = end_multiplier[..., None] * end_normal
    return new_matrix, gradient + circle_component + end_component


def _edge_vectors(point: Array) -> tuple[Array, Array, Array]:
    """Return unit vectors that describe the directions of the edges of the domain D at given points.

    The first two coordinates of D are bounded by the unit circle. The third coordinate is bounded by both ends of the
    interval [-1, 1].

    Args:
        point: Points of D, shape (..., 3).

    Returns:
        Outward normal of the circle, tangent of the circle, and outward normal of the nearest end of the interval, each
        of shape (..., 3).
    """
    radius = np.hypot(point[..., 0], point[..., 1])
    nonzero_radius = np.maximum(radius, EDGE_TOLERANCE)  # avoids a division by zero at the centre
    circle_normal = np.zeros_like(point)
    circle_normal[..., :2] = point[..., :2] / nonzero_radius[..., None]
    circle_tangent = np.zeros_like(point)
    circle_tangent[..., 0] = -circle_normal[..., 1]
    circle_tangent[..., 1] = circle_normal[..., 0]
    end_normal = np.zeros_like(point)
    end_normal[..., 2] = np.sign(point[..., 2])
    return circle_normal, circle_tangent, end_normal


def _outer_product(vector: Array, factor: Array) -> Array:
    """Multiply the outer product v v' of each vector v by a factor.

    Args:
        vector: Vectors v, shape (..., 3).
        factor: Factors, shape (...).

    Returns:
        Matrices, shape (..., 3, 3).
    """
    return factor[..., None, None] * vector[..., :, None] * vector[..., None, :]


def into_domain(point: Array) -> Array:
    """Replace each point outside the domain D by the nearest point of D.

    The domain D is the unit disk times the interval [-1, 1].

    Args:
        point: Points, shape (..., 3). The first two coordinates belong to the disk, and the third to the interval.

    Returns:
        Points of D, same shape. The input array itself is returned if all points already lie in D.
    """
    is_outside_disk, is_outside_interval = _is_outside_scaled_domain(point, 1.0)
    if not np.count_nonzero(is_outside_disk | is_outside_interval):
        return point
    radius = np.sqrt(point[..., 0] ** 2 + point[..., 1] ** 2)
    in_disk = point[..., :2] / np.maximum(radius, 1.0)[..., None]
    in_interval = np.clip(point[..., 2:], -1.0, 1.0)
    return np.concatenate([in_disk, in_interval], axis=-1)
