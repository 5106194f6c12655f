"""Solver for many small nonlinear least-squares problems whose unknowns are bounded by a disk and an interval.

Each problem has three unknowns u, which are the coordinates of a point in the domain D. The domain D is the unit disk
times the interval [-1, 1]. The solution of a problem minimises the sum of the squared residuals |r(u)|^2 over D. The
Jacobian J contains the derivatives of the residuals r with respect to the unknowns u.

Each damped Gauss-Newton step du solves the equation (J'J + damping * trace(J'J) / 3 * I) du = -J'r (Levenberg 1944). If
a point lies on an edge of D and the negative gradient points out of D, the step follows the edge (active-set method).
On the edge of the disk, the curvature of the circle is added to the matrix J'J. A search along the circle therefore
converges within a few steps, even if the unconstrained minimum lies far outside D.
"""

from collections.abc import Callable

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.numerics.disk import ROUNDING

ResidualFunction = Callable[[Integers, Array], tuple[Array, Array]]
"""Function that evaluates the residuals of some of the problems.

Its arguments are the indices of the problems, shape (m,), and the points u, shape (m, 3). The function returns the
residuals r, shape (m, k), and their derivatives dr/du, shape (m, 3, k).
"""

MIN_CHANGE = 1e-7
"""Default value for the change of |r|^2 below which the iteration ends, relative to 1 + |r|^2."""


def minimise(
    evaluate: ResidualFunction,
    start: Array,
    max_steps: int = 60,
    min_change: float = MIN_CHANGE,
    initial_damping: float = 1e-4,
    damping_decrease: float = 0.2,
    damping_increase: float = 8.0,
) -> tuple[Array, Array]:
    """Find a local minimum of each problem by damped Gauss-Newton steps, which begin at a given starting point.

    Each problem minimises the sum of squares |r(u)|^2 over all points u of the domain D. The domain D is the unit disk
    times the interval [-1, 1]. A step that increases |r|^2 is rejected. The damping decreases after each accepted step
    and increases after each rejected step. The iteration of a problem ends when a step changes |r|^2 by less than a
    tolerance. Most problems converge in five steps; problems with large residuals may need more than thirty.

    Args:
        evaluate: Function that evaluates the residuals r and their derivatives dr/du for some of the problems. Its
            arguments are the indices of the problems, shape (m,), and a point of each problem, shape (m, 3).
        start: Starting points, shape (n, 3). Points outside D are replaced by the nearest point of D.
        max_steps: Largest number of steps.
        min_change: Change of |r|^2 below which the iteration ends, relative to 1 + |r|^2.
        initial_damping: Damping of the first step, relative to the mean of the diagonal of J'J.
        damping_decrease: Factor of the damping after a step that lowers |r|^2, dimensionless.
        damping_increase: Factor of the damping after a rejected step, dimensionless.

    Returns:
        Points in D, shape (n, 3), and the residuals at these points, shape (n, k).
    """
    point = into_domain(start)
    active = np.arange(len(start))  # indices of the problems whose iteration has not ended
    residual, slopes = (np.array(values) for values in evaluate(active, point))  # r and dr/du
    squared_norm = (residual**2).sum(axis=1)  # |r|^2, shape (n,)
    damping = np.full(len(point), initial_damping)
    for _ in range(max_steps):
        if not active.size:
            break
        trial_point = bounded_step(point[active], residual[active], slopes[active], damping[active])
        trial_residual, trial_slopes = evaluate(active, trial_point)
        trial_squared_norm = (trial_residual**2).sum(axis=1)
        change = (trial_squared_norm - squared_norm[active]) / (1.0 + trial_squared_norm)
        is_accepted = change < 0.0
        accepted = active[is_accepted]
        point[accepted] = trial_point[is_accepted]
        residual[accepted] = trial_residual[is_accepted]
        slopes[accepted] = trial_slopes[is_accepted]
        squared_norm[accepted] = trial_squared_norm[is_accepted]
        damping[active] *= np.where(is_accepted, damping_decrease, damping_increase)
        active = active[np.abs(change) >= min_change]
    return point, residual


def bounded_step(point: Array, residual: Array, slopes: Array, damping: Array) -> Array:
    """Take one damped Gauss-Newton step that does not leave the domain D.

    Args:
        point: Points of D, shape (n, 3).
        residual: Residuals r at the points, shape (n, k).
        slopes: Derivatives dr/du at the points, which are the transposed Jacobian J', shape (n, 3, k).
        damping: Damping relative to the mean of the diagonal of J'J, shape (n,).

    Returns:
        Points after the step, shape (n, 3).
    """
    # Damped normal equations. The addition to the trace avoids a singular matrix if all derivatives are zero.
    matrix: Array = slopes @ slopes.swapaxes(1, 2)  # J'J, shape (n, 3, 3)
    gradient: Array = (slopes @ residual[..., None])[..., 0]  # J'r, shape (n, 3)
    trace = np.trace(matrix, axis1=1, axis2=2)[:, None, None] + 1e-12
    matrix = matrix + damping[:, None, None] * trace * np.eye(3) / 3.0

    # The equations change only for points on an edge of D.
    edge = np.flatnonzero(
        (point[:, 0] ** 2 + point[:, 1] ** 2 > (1.0 - ROUNDING) ** 2) | (np.abs(point[:, 2]) > 1.0 - ROUNDING)
    )
    if edge.size:
        matrix[edge], gradient[edge] = _along_edges(point[edge], matrix[edge], gradient[edge], trace[edge])
    return into_domain(point - np.linalg.solve(matrix, gradient[..., None])[..., 0])


def _along_edges(point: Array, matrix: Array, gradient: Array, trace: Array) -> tuple[Array, Array]:
    """Modify the normal equations of points on an edge of the domain D such that each step does not leave D.

    Args:
        point: Points on the circle, or at an end of the interval, or both, shape (n, 3).
        matrix: Damped matrices J'J, shape (n, 3, 3).
        gradient: Gradients J'r, shape (n, 3).
        trace: Traces of the matrices J'J, shape (n, 1, 1).

    Returns:
        Modified matrices, shape (n, 3, 3), and modified gradients, shape (n, 3).
    """
    # The normals of the circle and of the end of the interval are (x, y, 0) and (0, 0, z), because the coordinates of a
    # point on an edge have these lengths. An edge is active if the negative gradient has an outward component.
    normals = point[:, None] * np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # shape (n, 2, 3)
    is_on_edge = np.linalg.norm(normals, axis=2) > 1.0 - ROUNDING
    outward = -np.einsum("nbi,ni->nb", normals, gradient) * is_on_edge
    normals = normals * (outward > 0.0)[..., None]

    # The curvature of the circle adds a second derivative along the tangent, which is the outward component.
    tangent = normals[:, 0, [1, 0, 2]] * np.array([-1.0, 1.0, 0.0])
    matrix = matrix + outward[:, 0, None, None] * tangent[:, :, None] * tangent[:, None, :]

    # Remove the components across the active edges. The trace makes the matrix regular in these directions.
    across: Array = np.einsum("nbi,nbj->nij", normals, normals)
    along = np.eye(3) - across
    return along @ matrix @ along + trace * across, (along @ gradient[..., None])[..., 0]


def into_domain(point: Array) -> Array:
    """Replace each point outside the domain D by the nearest point of D, which is the unit disk times [-1, 1].

    Args:
        point: Points, shape (n, 3). The first two coordinates belong to the disk, and the third to the interval.

    Returns:
        Points of D, shape (n, 3).
    """
    radius = np.hypot(point[:, 0], point[:, 1])
    in_disk = point[:, :2] / np.maximum(radius, 1.0)[:, None]
    return np.column_stack([in_disk, np.clip(point[:, 2], -1.0, 1.0)])
