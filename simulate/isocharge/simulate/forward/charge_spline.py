"""Approximation of a forward map by splines.

The splines compute charges and their derivatives about two hundred times faster than the forward map.

A scaled charge is a charge divided by the squared amplitude of the press. The module `mechanics.theory` computes the
squared amplitude from the force. The scaled charges depend only weakly on the force. At each of a few forces, a cubic
spline in (x, y) approximates the scaled charges. The spline is fitted by least squares to presses on a disk around the
centre of the film. For all other forces, the scaled charges are interpolated by Lagrange polynomials in ln F. A forward
map interpolates its stress fields between forces in the same way. The interpolation between forces therefore adds no
further error.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # scipy.interpolate is imported when it is used
from scipy.sparse import csr_array, diags_array, eye_array, kron, vstack

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.readout import contact_charges
from isocharge.simulate.mechanics.theory import amplitude_squared
from isocharge.simulate.numerics.disk import contacts_at, sunflower
from isocharge.simulate.numerics.interpolation import chebyshev_nodes, lagrange_values
from isocharge.simulate.numerics.polygon import to_corners
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.solver.assembly import factorise

MAX_KNOT_SPACING = 0.3
"""Largest distance between the knots, mm."""

RELATIVE_KNOT_SPACING = 0.25
"""Largest distance between the knots in units of the reach of the probe, dimensionless.

The reach is the largest distance of a point of the footprint from its centroid. The charge of an electrode changes
considerably if the press moves by the reach. If the knot spacing were a quarter of the width of a narrow footprint, the
spline would follow the readout error of the forward map. The derivatives of the spline would then be less accurate.
"""

MAX_CELLS = 200
"""Largest number of cells of a spline along x or y, which limits the time of the fit to a few seconds."""

EXTRA_FORCE_NODES = 2
"""Number of additional force nodes if the piezoelectric coefficient d33 is not zero.

The charges that d33 causes are proportional to the force, and not to the squared amplitude. With the additional nodes,
the relative error of these charges is at most 1e-4. Under a probe that grows with the force, the share of the force on
an electrode has kinks, and the error reaches 4 % of these charges.
"""


LOG_FORCE_STEP = 1e-4
"""Step of the central differences with respect to ln F, where F is the force, dimensionless."""

SMOOTHING = 5e-3
"""Weight of the third differences of the spline coefficients in the fit, dimensionless.

In regions without fitted positions, the third differences determine the coefficients.
"""


@dataclass(frozen=True)
class ChargeSpline:
    """Splines that compute touch charges as a function of the position (x, y) and the force F of a press.

    The splines are valid for one probe in a fixed orientation.

    Attributes:
        electrodes: Names of the electrodes, in the order of the charges.
        film: Film whose squared amplitude scales the charges.
        domain: Presses for which the splines are valid.
        force: Forces at which splines were fitted, shape (n_force,), N.
        table: Spline in x and y that returns the scaled charges, shape (n_force, n_electrode), pC. A scaled charge is a
            charge divided by the squared amplitude of the press.
    """

    electrodes: tuple[str, ...]
    film: Film
    domain: Domain
    force: Array
    table: "scipy.interpolate.NdBSpline"

    @classmethod
    def of(cls, forward_map: ForwardMap, spacing: float | None = None) -> "ChargeSpline":
        """Fit splines to the charges that a forward map computes. The fit takes a few seconds.

        Args:
            forward_map: Forward map to which the splines are fitted. The probe keeps the orientation with which the map
                was built.
            spacing: Largest distance between the knots, mm. If None, the distance is a quarter of the reach of the
                probe, but at most `MAX_KNOT_SPACING`. The reach of a circular probe is its radius. There are at most
                `MAX_CELLS` cells between the knots along each axis.
        """
        spacing = spacing or min(MAX_KNOT_SPACING, RELATIVE_KNOT_SPACING * forward_map.probe.reach)
        force = _force_nodes(forward_map)
        return cls(
            electrodes=forward_map.electrodes,
            film=forward_map.sensor.film,
            domain=forward_map.domain,
            force=force,
            table=_fit_disk(forward_map, force, spacing),
        )

    def charges(self, contact: Array) -> Array:
        """Compute the touch charges of presses.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = self.domain.check(contact, "table")
        weights = self.force_weights(np.log(contact[:, 2]))
        return np.asarray(np.einsum("nk,nke->ne", weights, self.table(contact[:, :2])))

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Compute the charges of presses, and their derivatives with respect to x, y and ln F.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC. Derivatives with respect to x, y and ln F, shape (n, n_electrode, 3),
            pC/mm, pC/mm and pC.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = self.domain.check(contact, "table")
        position = contact[:, :2]

        # Each charge is a weighted sum of the scaled charges at the forces of the splines. Only the weights depend on
        # the force. The derivatives of the weights with respect to ln F are computed by central differences.
        log_force = np.log(contact[:, 2])
        weights = self.force_weights(log_force)
        weights_above = self.force_weights(log_force + LOG_FORCE_STEP)
        weights_below = self.force_weights(log_force - LOG_FORCE_STEP)
        weight_slopes = (weights_above - weights_below) / (2.0 * LOG_FORCE_STEP)

        # Only the scaled charges depend on the position. The argument `nu` contains the orders of the derivative with
        # respect to x and y.
        scaled_charge = self.table(position)  # shape (n, n_force, n_electrode)
        scaled_gradient = np.stack([self.table(position, nu=(1, 0)), self.table(position, nu=(0, 1))], axis=-1)

        # Sum over the forces of the splines (index k), for each press (n) and electrode (e). The index i is x or y.
        charge = np.einsum("nk,nke->ne", weights, scaled_charge)
        position_derivative = np.einsum("nk,nkei->nei", weights, scaled_gradient)
        log_force_derivative = np.einsum("nk,nke->ne", weight_slopes, scaled_charge)
        return charge, np.concatenate([position_derivative, log_force_derivative[..., None]], axis=2)

    def force_weights(self, log_force: Array) -> Array:
        """Compute the weights that convert the scaled charges at the forces of the splines into a charge.

        The charge at a given force is the sum of the scaled charges at the forces of the splines, each multiplied by
        its weight. Each weight is the product of two factors. The Lagrange weight in ln F interpolates between the
        forces of the splines. The squared amplitude at the given force converts the scaled charge into a charge.

        Args:
            log_force: Natural logarithms of the given forces in N, shape (n,).

        Returns:
            Weights, shape (n, n_force).
        """
        weights = lagrange_values(np.log(self.force), log_force)
        return np.asarray(weights * amplitude_squared(self.film, np.exp(log_force))[:, None])


def _force_nodes(forward_map: ForwardMap) -> Array:
    """Return the forces at which splines are fitted, shape (n_force,), N.

    If the piezoelectric coefficient d33 is zero, the splines have the forces at which the forward map was solved. If
    d33 is not zero, the splines have a few more forces. The reason is that the charges caused by d33 are proportional
    to the force, but the charges caused by the stress are not. If the map has a single force, the splines have the same
    single force.
    """
    solved_force = forward_map.family.force
    min_log_force, max_log_force = np.log(forward_map.domain.force_range)
    if forward_map.sensor.piezo.d33 == 0.0 or min_log_force == max_log_force:
        return solved_force
    log_force = chebyshev_nodes(solved_force.size + EXTRA_FORCE_NODES, min_log_force, max_log_force)
    return np.exp(log_force)


def _scaled_charges(forward_map: ForwardMap, spline_force: Array, position: Array) -> Array:
    """Compute the scaled charges of presses at given positions. Splines are fitted to these charges.

    A scaled charge is a charge divided by the squared amplitude of the press. Each charge is the sum of two parts. The
    stress causes the first part by the coefficients d31, d32 and d12. The contact pressure causes the second part by
    the coefficient d33.

    Args:
        forward_map: Forward map that computes the charges.
        spline_force: Forces at which the splines are fitted, shape (n_force,), N.
        position: Positions (x, y), shape (n, 2), mm.

    Returns:
        Scaled charges, shape (n, n_force, n_electrode), pC.
    """
    # Compute the charges of the stress at the forces for which the map was solved. The last axis of the charges is for
    # several stress fields. This map has a single field, which has the index 0.
    sensor = forward_map.sensor
    solved_force = forward_map.family.force
    stress_charge = forward_map.charges_by_force(position)[..., 0].swapaxes(0, 1)  # (n, n_solved_force, n_electrode)
    solved_scaled_charge = stress_charge / amplitude_squared(sensor.film, solved_force)[:, None]

    # A sensor with d33 has more spline forces than solved forces. Interpolate the charges to the spline forces.
    force_weights = lagrange_values(np.log(solved_force), np.log(spline_force))
    scaled_charge = force_weights @ solved_scaled_charge  # shape (n, n_force, n_electrode)

    # Add the charge of the contact pressure. Then `calibration.read` adds the crosstalk between the electrodes.
    for index, one_force in enumerate(spline_force.tolist()):
        contact = contacts_at(position, one_force)
        pressure_charge = contact_charges(sensor, forward_map.probe, contact)
        scaled_charge[:, index] += pressure_charge / amplitude_squared(sensor.film, one_force)
    return sensor.calibration.read(scaled_charge)


def _fit_disk(forward_map: ForwardMap, force: Array, spacing: float) -> "scipy.interpolate.NdBSpline":
    """Fit a cubic spline to the scaled charges of all electrodes over the disk.

    A scaled charge is a charge divided by the squared amplitude of the press. The fit is by least squares, with a
    penalty on the third differences of the coefficients. The spline is defined on the square around the disk. The
    penalty determines the coefficients in the corners of the square, where there are no positions.

    Args:
        forward_map: Forward map that computes the charges.
        force: Forces at which the splines are fitted, shape (n_force,), N.
        spacing: Largest distance between the knots, mm.

    Returns:
        Spline in x and y that returns scaled charges, shape (n_force, n_electrode), pC.
    """
    # The knots along both axes are the edges of the cells. A cubic spline is only defined on the whole interval if the
    # first and the last edge occur four times, so each of them is repeated three times. There are always four fewer
    # coefficients than knots.
    radius = forward_map.domain.radius
    cells = int(np.clip(np.ceil(2.0 * radius / spacing), 8, MAX_CELLS))  # at least 8 on a small domain
    cell_edges = np.linspace(-radius, radius, cells + 1)
    line_knots = np.pad(cell_edges, 3, mode="edge")
    knots = (line_knots, line_knots)
    axis_count = line_knots.size - 4  # number of coefficients along an axis
    position = radius * _fit_positions(cells)  # the function returns positions in the unit disk
    scaled_charge = _scaled_charges(forward_map, force, position)  # shape (n, n_force, n_electrode)

    # The design matrix converts the coefficients into the values of the spline. The matrix of SciPy has no columns for
    # the last coefficients if they do not affect any position, so it is created again with its full shape.
    cubic_degree = 3
    entries = scipy.interpolate.NdBSpline.design_matrix(position, knots, cubic_degree)
    design = csr_array((entries.data, entries.indices, entries.indptr), shape=(len(position), axis_count**2))
    penalty = SMOOTHING * _third_differences(axis_count)

    # Solve the normal equations, with one column for each force and electrode. Their matrix is positive definite, so
    # the factorisation needs no pivoting. The unknowns are eliminated in the order of minimum degree (MMD), which keeps
    # the factors sparse.
    normal_matrix = (design.T @ design + penalty.T @ penalty).tocsc()
    right_side = np.ascontiguousarray(design.T @ scaled_charge.reshape(len(position), -1))
    solution = factorise(normal_matrix, "MMD_AT_PLUS_A").solve(right_side)
    coefficients = solution.reshape(axis_count, axis_count, *scaled_charge.shape[1:])
    return scipy.interpolate.NdBSpline(knots, coefficients, cubic_degree)


def _third_differences(count: int) -> "scipy.sparse.sparray":
    """Return the matrix that computes the third differences of the coefficients of a spline along both axes.

    Args:
        count: Number of coefficients along each axis.

    Returns:
        Sparse matrix, shape (2 * (count - 3) * count, count^2). The first half of its rows are the differences along x.
    """
    line_differences = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count))
    identity = eye_array(count)
    return vstack([kron(line_differences, identity), kron(identity, line_differences)])


def _fit_positions(cells: int) -> Array:
    """Return the positions at which a spline is fitted, in the unit disk and on its edge.

    There are 1.6 positions for each cell of the spline. On the edge of the disk, there are two further positions per
    side length of a cell.

    Args:
        cells: Number of cells of the spline along the diameter of the disk.

    Returns:
        Positions (x, y), shape (n, 2), in radii of the disk.
    """
    # In units of the side of a cell, the diameter of the disk is `cells`. The constants 16 and 8 ensure that there are
    # enough positions if there are only a few cells.
    disk_area = np.pi * (0.5 * cells) ** 2
    circumference = np.pi * cells
    inner_count = int(1.6 * disk_area) + 16
    edge_count = int(2.0 * circumference) + 8
    edge_positions = to_corners(np.exp(2j * np.pi * np.arange(edge_count) / edge_count))
    return np.concatenate([sunflower(inner_count), edge_positions])
