"""Spline approximation of a forward map, which computes charges and their derivatives about two hundred times faster.

The charges are divided by the squared amplitude of `mechanics.scaling`, which removes most of their dependence on the
force. For each of a few forces, the scaled charges are approximated by a cubic spline in (x, y), which is fitted by
least squares to presses on the disk. Between the forces, Lagrange polynomials in ln F interpolate. A forward map
interpolates its fields in the same way, so the interpolation in the force adds no error.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy  # scipy.interpolate is imported when it is used
from scipy.sparse import csr_array, diags_array, eye_array, kron, vstack
from scipy.sparse.linalg import splu

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import ChargeMap, Domain, check_radius
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.numerics.disk import lattice, onto_disk, sunflower
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.simulate.sensor.film import Film

MAX_KNOT_SPACING = 0.3
"""Largest distance between the knots, mm."""

KNOT_SPACING_SHARE = 1.0 / 6.0
"""Largest distance between the knots, over the reach of the probe, which is the length scale of the charges."""

MIN_CELLS = 8
"""Smallest number of cells of the spline across the disk."""

MAX_CELLS = 400
"""Largest number of cells of the spline across the disk."""

PRESSES_PER_CELL = 1.6
"""Number of fitted presses per cell of the disk."""

PRESSES_PER_EDGE_CELL = 2.0
"""Number of additional fitted presses on the edge of the disk, per cell along the edge."""

SMOOTHING = 5e-3
"""Weight of the third differences of the coefficients in the fit, dimensionless.

It determines the coefficients outside the disk, which few presses affect.
"""

EXTRA_FORCE_NODES = 2
"""Number of additional force nodes if d33 is not zero.

The charges of d33 are proportional to the force, and not to the squared amplitude. Their relative error is at most
1e-4.
"""

CHECK_COUNT = 400
"""Number of presses at which the splines are compared with the forward map."""

LOG_FORCE_STEP = 1e-4
"""Step of the central difference with respect to ln F, dimensionless."""


@dataclass(frozen=True)
class ChargeSpline:
    """Touch charges as a function of (x, y, F), for one probe in one orientation.

    Attributes:
        electrodes: Names of the electrodes, in the order of the charges.
        film: Film whose amplitude scales the charges.
        domain: Presses that the splines cover.
        force: Forces of the splines, shape (n_force,), N.
        table: Spline of the scaled charges in x and y, whose values have the shape (n_force, n_electrode).
        error: Largest error with respect to the forward map, relative to the largest charge of a press.
    """

    electrodes: tuple[str, ...]
    film: Film
    domain: Domain
    force: Array
    table: "scipy.interpolate.NdBSpline"
    error: float

    @classmethod
    def of(cls, forward_map: ForwardMap, radius: float | None = None, spacing: float | None = None) -> "ChargeSpline":
        """Fit splines to a forward map, which takes a few seconds.

        Args:
            forward_map: The forward map. The probe keeps the orientation with which the map was built.
            radius: Largest distance from the centre, mm; None for that of the map.
            spacing: Distance between the knots, mm; None for a sixth of the reach of the probe, and at most
                `MAX_KNOT_SPACING`.

        Raises:
            SceneError: If the radius is not positive or larger than that of the map.
        """
        map_domain = forward_map.domain
        domain = map_domain if radius is None else map_domain.within(radius)
        check_radius(domain.radius, map_domain.radius, "forward map")
        spacing = spacing or min(MAX_KNOT_SPACING, KNOT_SPACING_SHARE * forward_map.probe.reach)
        film = forward_map.sensor.film
        force = _force_nodes(forward_map)
        cells = int(np.clip(np.ceil(2.0 * domain.radius / spacing), MIN_CELLS, MAX_CELLS))
        at = domain.radius * _samples(cells)
        columns = []
        for newtons in force.tolist():
            contact = np.column_stack([at, np.full(len(at), newtons)])
            columns.append(forward_map.charges(contact) / amplitude_squared(film, newtons))
        table = _least_squares(at, np.stack(columns, axis=1), domain.radius, cells)
        spline = cls(forward_map.electrodes, film, domain, force, table, np.nan)
        return replace(spline, error=_largest_error(spline, forward_map))

    def charges(self, contact: Array) -> Array:
        """Compute touch charges.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = self.domain.check(contact, "table")
        weights = self.force_weights(np.log(contact[:, 2]))
        return np.asarray(np.einsum("nk,nke->ne", weights, self.scaled_charges(contact[:, :2])))

    def derivatives(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to x, y and ln F.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N.

        Returns:
            Shape (n, n_electrode, 3), pC/mm, pC/mm and pC.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        _, derivatives = self.linearised(contact)
        return derivatives

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Compute the results of `charges` and `derivatives` together."""
        contact = self.domain.check(contact, "table")
        charge, by_position, by_log_force = self.first_order(contact[:, :2], contact[:, 2])
        return charge, np.concatenate([by_position, by_log_force[..., None]], axis=2)

    def first_order(self, position: Array, force: Array | float) -> tuple[Array, Array, Array]:
        """Compute charges and their derivatives, also for iterates outside the disk.

        Args:
            position: Positions (x, y), shape (n, 2), mm. Positions outside the disk are moved to its edge.
            force: Forces, shape (n,) or a number, N.

        Returns:
            Charges, shape (n, n_electrode), pC; their derivatives with respect to (x, y), shape (n, n_electrode, 2),
            pC/mm; their derivatives with respect to ln F, shape (n, n_electrode), pC.
        """
        position = onto_disk(position, self.domain.radius)
        log_force = np.log(np.broadcast_to(force, len(position)))
        weights = self.force_weights(log_force)
        weights_above = self.force_weights(log_force + LOG_FORCE_STEP)
        weights_below = self.force_weights(log_force - LOG_FORCE_STEP)
        weights_by_log_force = (weights_above - weights_below) / (2.0 * LOG_FORCE_STEP)
        scaled = self.scaled_charges(position)
        charge = np.einsum("nk,nke->ne", weights, scaled)
        by_position = np.einsum("nk,nkei->nei", weights, self.scaled_gradients(position))
        by_log_force = np.einsum("nk,nke->ne", weights_by_log_force, scaled)
        return charge, by_position, by_log_force

    def force_weights(self, log_force: Array) -> Array:
        """Compute the weights with which the scaled charges at the forces of the splines give the charges.

        Args:
            log_force: Logarithms of the forces (N), shape (...).

        Returns:
            Shape (..., n_force).
        """
        nodes = np.log(self.force)
        weights = lagrange_values(nodes, barycentric_weights(nodes), log_force.ravel())
        weights *= amplitude_squared(self.film, np.exp(log_force.ravel()))[:, None]
        return weights.reshape(*log_force.shape, nodes.size)

    def scaled_charges(self, position: Array) -> Array:
        """Compute the scaled charges at the forces of the splines.

        Args:
            position: Positions (x, y), shape (n, 2), mm.

        Returns:
            Shape (n, n_force, n_electrode), pC.
        """
        return np.asarray(self.table(position))

    def scaled_gradients(self, position: Array) -> Array:
        """Compute the derivatives of `scaled_charges` with respect to x and y.

        Args:
            position: Positions (x, y), shape (n, 2), mm.

        Returns:
            Shape (n, n_force, n_electrode, 2), pC/mm.
        """
        return np.stack([self.table(position, nu=order) for order in ((1, 0), (0, 1))], axis=-1)


def with_fast_derivatives(charge_map: ChargeMap) -> ChargeMap:
    """Return splines of a forward map, whose fit takes seconds. Return any other map unchanged."""
    if isinstance(charge_map, ForwardMap):
        return ChargeSpline.of(charge_map)
    return charge_map


def _force_nodes(forward_map: ForwardMap) -> Array:
    """Return the force nodes of the splines, which are those of the forward map if d33 is zero, shape (n_force,), N."""
    low, high = np.log(forward_map.domain.force_range)
    if forward_map.sensor.piezo.d33 == 0.0 or low == high:
        return forward_map.family.force
    return np.asarray(np.exp(chebyshev_nodes(forward_map.family.force.size + EXTRA_FORCE_NODES, low, high)))


def _samples(cells: int) -> Array:
    """Return the positions of the fitted presses on the unit disk: a lattice, and points on the edge, shape (n, 2)."""
    inner = lattice(int(PRESSES_PER_CELL * np.pi * (0.5 * cells) ** 2) + 16)
    edge_count = int(PRESSES_PER_EDGE_CELL * np.pi * cells) + 8
    edge = np.exp(2j * np.pi * np.arange(edge_count) / edge_count) * (1.0 - 1e-12)
    at = np.concatenate([inner, edge])
    return np.stack([at.real, at.imag], axis=1)


def _least_squares(at: Array, values: Array, radius: float, cells: int) -> "scipy.interpolate.NdBSpline":
    """Fit a cubic spline by least squares with a penalty on the third differences of its coefficients.

    Args:
        at: Positions (x, y), shape (n, 2), mm.
        values: Values at the positions, shape (n, ...).
        radius: Radius of the disk, mm.
        cells: Number of cells across the disk.
    """
    knots = np.concatenate([[-radius] * 3, np.linspace(-radius, radius, cells + 1), [radius] * 3])
    count = knots.size - 4
    entries = scipy.interpolate.NdBSpline.design_matrix(at, (knots, knots), 3)  # has too few columns
    design = csr_array((entries.data, entries.indices, entries.indptr), shape=(len(at), count**2))
    third_difference = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count))
    smooth = SMOOTHING * vstack([kron(third_difference, eye_array(count)), kron(eye_array(count), third_difference)])
    normal = (design.T @ design + smooth.T @ smooth).tocsc()
    right = np.ascontiguousarray(design.T @ values.reshape(len(at), -1))
    factors = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    coefficients = factors.solve(right)  # the matrix is positive definite and needs no pivoting
    return scipy.interpolate.NdBSpline((knots, knots), coefficients.reshape(count, count, *values.shape[1:]), 3)


def _largest_error(spline: ChargeSpline, forward_map: ForwardMap) -> float:
    """Compute the largest relative error at evenly distributed presses that do not lie on the lattice of the fit."""
    at = spline.domain.radius * sunflower(CHECK_COUNT)
    number = np.arange(CHECK_COUNT)
    low, high = spline.domain.force_range
    force = np.clip(low * (high / low) ** (number * 0.618 % 1.0), low, high)
    contact = np.stack([at.real, at.imag, force], axis=1)
    truth = forward_map.charges(contact)
    error = spline.charges(contact) - truth
    return float((np.abs(error).max(axis=1) / np.abs(truth).max(axis=1)).max())
