"""Least squares over a disk and an interval: damped Gauss-Newton steps for many small problems at once.

    min |r(u)|^2   over   u in D = unit disk x [-1, 1],

r with a few components and derivatives J. A step solves (J'J + damping trace(J'J) / 3) du = -J'r (Levenberg 1944). D is
held by an active set: where u lies on an edge and the gradient leads out, u moves along the edge only. On the circle
the edge's own curvature joins the second derivatives, so the nearest point of the circle takes a few steps as well,
however far the minimum without bounds lies outside.
"""

from collections.abc import Callable

import numpy as np

from isocharge.common.arrays import Array, Integers

Residuals = Callable[[Integers, Array], tuple[Array, Array]]
"""From numbers of problems (m,) and their points u (m, 3) to r, shape (m, k), and dr/du, shape (m, 3, k)."""

MOST_STEPS = 30
"""Steps at most; most problems need five."""

CHANGE = 1e-7
"""Least change of |r|^2 that is worth another step, relative to 1 + |r|^2."""

ROUNDING = 1e-12
"""A step that raises |r|^2 by no more than this, relative to 1 + |r|^2, is taken: it may be the last to the minimum."""

FIRST, LEAST, MOST = 1e-4, 1e-9, 1e4
"""Damping at the start and its bounds, relative to the mean diagonal of J'J; above the last, no step helps any more."""

EASIER, HARDER = 0.2, 8.0
"""Factors of the damping after a step that lowered |r|^2 and one that did not."""

WALL = 1e6
"""Stiffness against leaving an active edge, relative to the trace of J'J."""

ON_EDGE = 1e-9
"""Distance from an edge up to which a point counts as on it: rounding."""


def minimise(residuals: Residuals, start: Array, steps: int = MOST_STEPS, least: float = CHANGE) -> tuple[Array, Array]:
    """The minimum that descent from a start leads to, for every problem.

    Args:
        residuals: The problems.
        start: Shape (n, 3); points outside D start from its nearest point.
        steps: Largest number of steps.
        least: Least change of |r|^2 that is worth another step, relative to 1 + |r|^2.

    Returns:
        Points in D, shape (n, 3), and their residuals, shape (n, k).
    """
    unit, active = into_domain(start).copy(), np.arange(len(start))
    residual, slopes = (np.array(part) for part in residuals(active, unit))
    square, damping = (residual**2).sum(axis=1), np.full(len(unit), FIRST)
    for _ in range(steps):
        if not active.size:
            break
        trial = bounded_step(unit[active], residual[active], slopes[active], damping[active])
        new_residual, new_slopes = residuals(active, trial)
        new_square = (new_residual**2).sum(axis=1)
        change = (new_square - square[active]) / (1.0 + new_square)
        lower = change <= ROUNDING
        better = active[lower]
        unit[better], residual[better], slopes[better] = trial[lower], new_residual[lower], new_slopes[lower]
        square[better] = new_square[lower]
        damping[active] = np.where(lower, np.maximum(damping[active] * EASIER, LEAST), damping[active] * HARDER)
        active = active[(np.abs(change) >= least) & (damping[active] <= MOST)]
    return unit, residual


def bounded_step(unit: Array, residual: Array, slopes: Array, damping: Array | float) -> Array:
    """Where a damped step ends, within D.

    Args:
        unit: Points of D, shape (..., 3).
        residual: r there, shape (..., k).
        slopes: dr/du there, shape (..., 3, k).
        damping: Relative to the mean diagonal of J'J, shape (...).

    Returns:
        Shape (..., 3).
    """
    normal: Array = slopes @ slopes.swapaxes(-1, -2)
    gradient: Array = (slopes @ residual[..., None])[..., 0]
    trace = normal[..., 0, 0] + normal[..., 1, 1] + normal[..., 2, 2] + 1e-12
    normal = normal + (damping * trace)[..., None, None] * MEAN_DIAGONAL
    on_rim, at_end = _beyond(unit, 1.0 - ON_EDGE)
    if np.count_nonzero(on_rim | at_end):
        normal, gradient = _along_edges(unit, normal, gradient, trace, on_rim, at_end)
    trial: Array = unit - np.linalg.solve(normal, gradient[..., None])[..., 0]
    return into_domain(trial)


MEAN_DIAGONAL = np.eye(3) / 3.0
"""Times the trace of a 3 x 3 matrix: its mean diagonal as a matrix."""


def _beyond(unit: Array, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Which points lie beyond a share `edge` of the disk, and of the interval."""
    squares = unit * unit
    return squares[..., 0] + squares[..., 1] > edge * edge, squares[..., 2] > edge * edge


def _along_edges(
    unit: Array, normal: Array, gradient: Array, trace: Array, on_rim: np.ndarray, at_end: np.ndarray
) -> tuple[Array, Array]:
    """Normal equations and gradient for steps along the edges that the gradient leads out of."""
    outward, along, end = np.zeros_like(unit), np.zeros_like(unit), np.zeros_like(unit)
    reach = np.hypot(unit[..., 0], unit[..., 1])
    outward[..., :2] = unit[..., :2] / np.maximum(reach, ON_EDGE)[..., None]
    along[..., 0], along[..., 1] = -outward[..., 1], outward[..., 0]
    end[..., 2] = np.sign(unit[..., 2])
    push, press = -(gradient * outward).sum(axis=-1), -(gradient * end).sum(axis=-1)
    push, press = np.where(on_rim, np.maximum(push, 0.0), 0.0), np.where(at_end, np.maximum(press, 0.0), 0.0)
    normal = normal + _outer(along, push)
    normal = normal + _outer(outward, (push > 0.0) * WALL * trace) + _outer(end, (press > 0.0) * WALL * trace)
    return normal, gradient + push[..., None] * outward + press[..., None] * end


def _outer(vector: Array, weight: Array) -> Array:
    return weight[..., None, None] * vector[..., :, None] * vector[..., None, :]


def into_domain(unit: Array) -> Array:
    """The nearest points of D, shape (..., 3); those in D are left as they are."""
    beyond_rim, beyond_end = _beyond(unit, 1.0)
    if not np.count_nonzero(beyond_rim | beyond_end):
        return unit
    reach = np.maximum(np.sqrt(unit[..., 0] ** 2 + unit[..., 1] ** 2), 1.0)
    return np.concatenate([unit[..., :2] / reach[..., None], np.clip(unit[..., 2:], -1.0, 1.0)], axis=-1)
