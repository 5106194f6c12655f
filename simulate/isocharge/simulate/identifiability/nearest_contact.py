"""Search for the contact whose charges are nearest to given charges.

Let Q be the given charges, Q(c) the charges of a contact c, and sigma the standard deviation of the noise of each
charge. The distance between Q and Q(c) is the norm |(Q - Q(c)) / sigma|. The distance is minimised over the contacts of
a domain.

The search solves many small least-squares problems. Each problem has three unknowns u, which are the coordinates of a
point in the domain D. The domain D is the unit disk times the interval [-1, 1]. The solution of a problem minimises the
sum of the squared residuals |r(u)|^2 over D. The Jacobian J contains the derivatives of the residuals r with respect to
the unknowns u.

Each damped Gauss-Newton step du solves the equation (J'J + damping * trace(J'J) / 3 * I) du = -J'r (Levenberg 1944). If
a point lies on an edge of D and the negative gradient points out of D, the step follows the edge (active-set method).
On the edge of the disk, the curvature of the circle is added to the matrix J'J. A search along the circle therefore
converges within a few steps, even if the unconstrained minimum lies far outside D.
"""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.contact_domain import Domain, into_unit_domain
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.numerics.disk import INNER_RADIUS, ROUNDING

ResidualFunction = Callable[[Integers, Array], tuple[Array, Array]]
"""Function that evaluates the residuals of selected least-squares problems.

The arguments are the indices of the problems, shape (m,), and the points u, shape (m, 3). The function returns the
residuals r, shape (m, k), and their derivatives dr/du, shape (m, 3, k).
"""

MIN_CHANGE = 1e-7
"""Default change of the sum of squared residuals |r|^2 below which an iteration ends, relative to 1 + |r|^2."""


def minimise(
    evaluate: ResidualFunction,
    start: Array,
    min_change: float = MIN_CHANGE,
) -> tuple[Array, Array]:
    """Find a local minimum of each problem by damped Gauss-Newton steps from a given starting point.

    Each problem minimises the sum of squares |r(u)|^2 over all points u of the domain D. The domain D is the unit disk
    times the interval [-1, 1]. A step that increases |r|^2 is rejected. The damping decreases after each accepted step
    and increases after each rejected step. The iteration of a problem ends when a step changes |r|^2 by less than a
    tolerance. Most problems converge in five steps; problems with large residuals may need more than thirty.

    Args:
        evaluate: Function that evaluates the residuals r and their derivatives dr/du for some of the problems. Its
            arguments are the indices of the problems, shape (m,), and a point of each problem, shape (m, 3).
        start: Starting points, shape (n, 3). A point outside D is replaced by the nearest point of D.
        min_change: Change of |r|^2 below which the iteration ends, relative to 1 + |r|^2.

    Returns:
        Points in D, shape (n, 3), and the residuals at these points, shape (n, k).
    """
    point = into_unit_domain(start)
    active = np.arange(len(start))  # indices of the problems whose iteration has not ended
    residual, slopes = evaluate(active, point)  # r and dr/du
    squared_norm = (residual**2).sum(axis=1)  # |r|^2, shape (n,)
    damping = np.full(len(point), 1e-4)  # relative to the mean of the diagonal of J'J
    for _ in range(60):  # few problems need more than half of these steps
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
        damping[active] *= np.where(is_accepted, 0.2, 8.0)
        active = active[np.abs(change) >= min_change]
    return point, residual


def bounded_step(point: Array, residual: Array, slopes: Array, damping: Array) -> Array:
    """Take one damped Gauss-Newton step that does not leave the domain D, the unit disk times the interval [-1, 1].

    Each of the n points belongs to an independent problem, which minimises the sum of squared residuals |r|^2.

    Args:
        point: Point u = (x, y, z) of each problem in D, shape (n, 3). The coordinates x and y belong to the disk, and z
            belongs to the interval.
        residual: Residuals r at the points, shape (n, k).
        slopes: Derivatives dr/du at the points, which are the transposed Jacobian J', shape (n, 3, k).
        damping: Damping relative to the mean of the diagonal of J'J, shape (n,).

    Returns:
        Points after the step, shape (n, 3).
    """
    # Damped normal equations. The addition to the trace avoids a singular matrix if all derivatives are zero.
    matrix = slopes @ slopes.swapaxes(1, 2)  # J'J, shape (n, 3, 3)
    gradient = (slopes @ residual[..., None])[..., 0]  # J'r, shape (n, 3)
    trace = np.trace(matrix, axis1=1, axis2=2)[:, None, None] + 1e-12
    matrix = matrix + damping[:, None, None] * trace * np.eye(3) / 3.0

    # For points on an edge of D, `_along_edges` changes the equations: a step that would cross the edge runs along it.
    # The edges are the circle that bounds x and y, and the ends of the interval that bounds z.
    x, y, z = point.T
    edge_coordinates = np.column_stack([np.hypot(x, y), np.abs(z)])  # 1 on the edge, shape (n, 2)
    is_on_edge = edge_coordinates > 1.0 - ROUNDING
    on_edge = np.flatnonzero(is_on_edge.any(axis=1))  # indices of the points on an edge
    if on_edge.size:
        # On the circle, (x, y, 0) is the unit normal. At an end of the interval, (0, 0, z) is the unit normal. The
        # normal of an edge on which a point does not lie is set to zero. The shape of `normals` is (m, 2, 3).
        normals = point[on_edge, None] * np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        normals[~is_on_edge[on_edge]] = 0.0
        matrix[on_edge], gradient[on_edge] = _along_edges(normals, matrix[on_edge], gradient[on_edge], trace[on_edge])
    step = -np.linalg.solve(matrix, gradient[..., None])[..., 0]
    return into_unit_domain(point + step)


def _along_edges(normals: Array, matrix: Array, gradient: Array, trace: Array) -> tuple[Array, Array]:
    """Modify the normal equations of points on an edge of the domain D such that each step runs along the edge.

    The domain D is the unit disk times the interval [-1, 1]. A step without a constraint solves the normal equations
    J'J step = -J'r, where r are the residuals and J is their Jacobian. The vector J'r is the gradient of the function
    f = |r|^2 / 2 that is minimised, and J'J approximates its second derivatives. A point leaves an edge towards the
    inside of D if this decreases f. Otherwise, the edge is active, and the step must not cross it.

    Args:
        normals: Outward normals of two edges of D at each point, shape (n, 2, 3). The first edge is the circle that
            bounds x and y, and the second edge is the end of the interval that bounds the force. The normal of an edge
            on which the point does not lie is zero.
        matrix: Damped matrices J'J, shape (n, 3, 3).
        gradient: Gradients J'r, shape (n, 3).
        trace: Traces of the matrices J'J, shape (n, 1, 1).

    Returns:
        Modified matrices, shape (n, 3, 3), and modified gradients, shape (n, 3).
    """
    # An edge is active if the negative gradient, the direction in which f decreases, has an outward component.
    outward = -(normals @ gradient[..., None])  # outward component of -J'r for each edge, shape (n, 2, 1)
    active_normals = normals * (outward > 0.0)  # the normal of an inactive edge becomes zero

    # The circle is curved. After a motion by the angle a along the circle, the displacement is a t - a^2 n / 2, where n
    # is the normal and t is the tangent. Because of the second term, the second derivative of f along the circle is
    # larger than t' J'J t by the outward component. Add the difference to the matrix.
    normal_x, normal_y, _ = active_normals[:, 0].T  # zeros if the circle is not active
    tangent = np.column_stack([-normal_y, normal_x, np.zeros_like(normal_x)])
    circle_outward = outward[:, :1]  # positive if the circle is active; otherwise the tangent is zero, shape (n, 1, 1)
    matrix = matrix + circle_outward * tangent[:, :, None] * tangent[:, None, :]

    # Remove the components across the active edges from the gradient and from the matrix. The matrix would then be
    # singular. The multiple of the projection onto the normals makes it regular, and does not change the step.
    onto_normals = active_normals.swapaxes(1, 2) @ active_normals  # projection matrices, shape (n, 3, 3)
    onto_edges = np.eye(3) - onto_normals
    projected_matrix = onto_edges @ matrix @ onto_edges
    projected_gradient = onto_edges @ gradient[..., None]
    return projected_matrix + trace * onto_normals, projected_gradient[..., 0]


CANDIDATES = 4096
"""Number of contacts among which the starting points of a search are chosen.

The contacts are distributed over the domain. A quarter of them lie on the edge of the disk.
"""

START_SEPARATION = 0.25
"""Smallest distance between the starting points of one search, in radii of the domain, dimensionless.

Starting points that are nearer to each other mostly lead to the same local minimum.
"""

CHUNK = 2048
"""Number of rows of charges that are compared with all candidates at once, which limits the required memory."""


def explain(
    charge_map: ChargeMap, charge: Array, sigma: Array, start: Array, *, min_change: float = MIN_CHANGE
) -> tuple[Array, Array]:
    """Find the contacts whose charges are nearest to given charges, starting from given contacts.

    The distance between charges is the norm of the residuals (Q - Q(c)) / sigma, where Q are the given charges and Q(c)
    the charges of a contact c. A least-squares descent leads from each starting point to a local minimum of the
    distance. The unknowns are x, y and ln F in unit coordinates. In these coordinates, the domain is the unit disk
    times the interval [-1, 1].

    Args:
        charge_map: Map that computes the charges of contacts.
        charge: Given charges, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        start: Contacts (x, y, F) from which the descents start, anywhere on the film, shape (n, 3), mm and N.
        min_change: A descent ends if the squared distance s of the charges changes by less than min_change * (1 + s).

    Returns:
        Contacts (x, y, F) within the domain of the map, shape (n, 3), mm and N. Residuals, which are the given charges
        minus the charges of the contacts, divided by `sigma`, shape (n, n_electrode), dimensionless.
    """
    domain = charge_map.domain.within(INNER_RADIUS * charge_map.domain.radius)  # smaller by a rounding error
    min_force, max_force = domain.force_range
    scale = domain.scale  # new array: derivatives of (x, y, ln F) with respect to the unit coordinates, shape (3,)
    if min_force == max_force:  # the charges do not depend on the third unit coordinate
        scale[2] = 0.0

    def residuals(rows: Integers, unit_coordinates: Array) -> tuple[Array, Array]:
        """Compute the residuals (Q - Q(c)) / sigma for selected rows of charges, and the derivatives of the residuals.

        Args:
            rows: Indices of the rows, shape (k,).
            unit_coordinates: Contacts c in unit coordinates, one for each of these rows, shape (k, 3).

        Returns:
            Residuals, shape (k, n_electrode). Their derivatives with respect to the unit coordinates, shape (k, 3,
            n_electrode).
        """
        predicted, charge_derivatives = charge_map.linearised(_to_contact(domain, unit_coordinates))
        # By the chain rule, the factor `scale` converts derivatives by (x, y, ln F) into those by unit coordinates.
        derivatives = -charge_derivatives * scale / sigma[rows][..., None]  # of the residuals, (k, n_electrode, 3)
        return (charge[rows] - predicted) / sigma[rows], derivatives.swapaxes(1, 2)

    unit_solution, residual = minimise(residuals, domain.to_unit(start), min_change=min_change)
    return _to_contact(domain, unit_solution), residual


def _to_contact(domain: Domain, unit_coordinates: Array) -> Array:
    """Convert unit coordinates, shape (k, 3), into contacts (x, y, F) in a domain, shape (k, 3), mm and N."""
    contact = domain.to_contact(unit_coordinates)
    contact[:, 2] = np.clip(contact[:, 2], *domain.force_range)  # rounding must not move it out of the range
    return contact


def search(
    charge_map: ChargeMap,
    charge: Array,
    sigma: Array,
    *,
    candidates: int = CANDIDATES,
) -> tuple[Array, Array]:
    """Find the contacts whose charges are nearest to given charges, without given starting points.

    For each row of charges, two least-squares descents start at different contacts. The better result is returned.

    Args:
        charge_map: Map that computes the charges of contacts.
        charge: Given charges, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        candidates: Number of candidates for the starting points.

    Returns:
        Contacts (x, y, F), shape (n, 3), mm and N. Residuals, which are the given charges minus the charges of the
        contacts, divided by `sigma`, shape (n, n_electrode), dimensionless.
    """
    contact, residual = local_minima(charge_map, charge, sigma, starts=2, candidates=candidates)
    best_start = (residual**2).sum(axis=2).argmin(axis=1)  # shape (n,)
    row = np.arange(len(charge))
    return contact[row, best_start], residual[row, best_start]


def local_minima(
    charge_map: ChargeMap,
    charge: Array,
    sigma: Array,
    *,
    starts: int,
    candidates: int = CANDIDATES,
    min_change: float = MIN_CHANGE,
) -> tuple[Array, Array]:
    """Descend from every contact that `starting_contacts` finds, and return the results of all descents.

    All descents run together, because the charge map is faster for many contacts at once.

    Args:
        charge_map: Map that computes the charges of contacts.
        charge: Given charges, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        starts: Number of descents for each row of charges.
        candidates: Number of candidates for the starting points.
        min_change: A descent ends if the squared distance s of the charges changes by less than min_change * (1 + s).

    Returns:
        Contact (x, y, F) that each descent finds, shape (n, starts, 3), mm and N. Residuals, which are the given
        charges minus the charges of the contacts, divided by `sigma`, shape (n, starts, n_electrode), dimensionless.
    """
    start = starting_contacts(charge_map, charge, sigma, starts=starts, candidates=candidates)
    contact, residual = explain(
        charge_map,
        np.repeat(charge, starts, axis=0),
        np.repeat(sigma, starts, axis=0),
        start.reshape(-1, 3),
        min_change=min_change,
    )
    return contact.reshape(start.shape), residual.reshape(*start.shape[:2], charge.shape[1])


def starting_contacts(
    charge_map: ChargeMap,
    charge: Array,
    sigma: Array,
    *,
    starts: int,
    candidates: int = CANDIDATES,
) -> Array:
    """Find starting points of descents for given charges.

    Candidates are contacts that are distributed over the domain. The function compares the given charges with the
    charges of the candidates.

    Args:
        charge_map: Map that computes the charges of contacts.
        charge: Given charges, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        starts: Number of starting points that are returned for each row of charges.
        candidates: Number of candidates among which the starting points are chosen.

    Returns:
        Contacts (x, y, F) with the nearest charges for each row, in ascending order of the distance between the
        charges, shape (n, starts, 3), mm and N. Contacts in a row do not lie close together.
    """
    # Compute the charges of the candidates, and find the pairs of candidates that lie close together.
    unit_candidates, is_neighbour = _unit_candidates(candidates)
    contact = _to_contact(charge_map.domain, INNER_RADIUS * unit_candidates)  # the factor is 1 - 1e-9
    candidate_charges = charge_map.charges(contact)

    start = np.empty((len(charge), starts, 3))
    for first_row in range(0, len(charge), CHUNK):
        chunk = slice(first_row, first_row + CHUNK)
        start[chunk] = contact[_nearest_rows(charge[chunk], sigma[chunk], candidate_charges, is_neighbour, starts)]
    return start


@cache
def _unit_candidates(count: int) -> tuple[Array, Booleans]:
    """Return evenly distributed contacts in a domain (Sobol sequence), and whether each pair of them is close together.

    A quarter of the contacts lie on the edge of the disk.

    Args:
        count: Number of contacts.

    Returns:
        Contacts in the coordinates (x, y, ln F), shape (count, 3). The coordinates are scaled such that the domain is
        the unit disk times the interval [-1, 1]. Whether each pair of contacts lies close together, shape (count,
        count).
    """
    radius_sample, angle_sample, force_sample = scipy.stats.qmc.Sobol(3, scramble=False).random(count).T
    radius = np.sqrt(radius_sample)  # uniform over the area of the disk
    # Move the first quarter of the points onto the edge. The beginning of a Sobol sequence is itself evenly
    # distributed, so the points on the edge have evenly distributed angles and forces.
    radius[: count // 4] = 1.0
    angle = math.tau * angle_sample
    position = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    log_force = 2.0 * force_sample - 1.0  # from the interval [0, 1] to [-1, 1]
    distance = scipy.spatial.distance.cdist(position, position)  # whatever the forces are
    return np.column_stack([position, log_force]), distance < START_SEPARATION


def _nearest_rows(
    charge: Array, sigma: Array, candidate_charges: Array, is_neighbour: Booleans, count: int
) -> Integers:
    """For each row of charges, find the candidates whose charges are nearest to the charges in the row.

    For each row, at most one of any two neighbouring candidates is returned. The function searches for the smallest
    distance several times, because sorting all distances would be slower.

    Args:
        charge: Given charges, shape (n, n_electrode), pC.
        sigma: Standard deviation of each charge, shape (n, n_electrode), pC.
        candidate_charges: Charges of the candidates, shape (n_candidate, n_electrode), pC.
        is_neighbour: Whether each pair of candidates lies close together, shape (n_candidate, n_candidate). A candidate
            is a neighbour of itself.
        count: Number of candidates to find for each row of charges.

    Returns:
        Indices of the candidates in ascending order of the distance between the charges, shape (n, count).
    """
    # The squared distance of the charges Q_c of a candidate from the given charges Q is
    #   sum((Q - Q_c)^2 / sigma^2) = sum(Q_c^2 / sigma^2 - 2 Q Q_c / sigma^2) + const.
    # Without the constant, the squared distances of all rows and candidates are one matrix product.
    inverse_variance = sigma**-2.0
    weights = np.hstack([inverse_variance, -2.0 * charge * inverse_variance])
    charge_powers = np.hstack([candidate_charges**2, candidate_charges])
    squared_distance = weights @ charge_powers.T  # shape (n, n_candidate)
    nearest = np.empty((len(charge), count), dtype=np.intp)
    for rank in range(count):
        nearest_candidate = squared_distance.argmin(axis=1)
        nearest[:, rank] = nearest_candidate
        # Exclude this candidate and its neighbours from the following searches.
        squared_distance[is_neighbour[nearest_candidate]] = np.inf
    return nearest
