"""Least-squares fit of a cubic spline of two variables, with a penalty that makes the spline smooth."""

import numpy as np
import scipy  # scipy.interpolate is imported when it is used
from scipy.sparse import csr_array, dia_array, diags_array, eye_array, kron, sparray, vstack
from scipy.sparse.linalg import splu

from isocharge.common.arrays import Array
from isocharge.simulate.numerics.disk import lattice


def spline_knots(low: float, high: float, cells: int) -> Array:
    """Return the knots of a cubic spline that divide an interval into equal cells.

    Each end of the interval occurs four times among the knots, so that the spline is defined on the whole interval.

    Args:
        low: Lower end of the interval.
        high: Upper end of the interval.
        cells: Number of cells.

    Returns:
        Knots in ascending order, shape (cells + 7,).
    """
    return np.concatenate([[low] * 3, np.linspace(low, high, cells + 1), [high] * 3])


def fit_spline(position: Array, values: Array, knots: tuple[Array, Array]) -> "scipy.interpolate.NdBSpline":
    """Fit a cubic spline by least squares with a penalty on the third differences of its coefficients.

    Args:
        position: Positions (x, y), shape (n, 2), mm.
        values: Values at the positions, shape (n, ...).
        knots: Knots along x and along y.

    Returns:
        The spline. Its values have the shape of `values` without the first axis.
    """
    # A cubic spline has 4 coefficients fewer than knots along each axis.
    x_knots, y_knots = knots
    x_count = x_knots.size - 4
    y_count = y_knots.size - 4

    # Solve the normal equations. Their matrix is positive definite, so the factorisation needs no pivoting.
    design = _design_matrix(position, knots)
    penalty = _penalty_matrix(x_count, y_count)
    normal_matrix = (design.T @ design + penalty.T @ penalty).tocsc()
    right_side = np.ascontiguousarray(design.T @ values.reshape(len(position), -1))
    factors = splu(normal_matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    coefficients = factors.solve(right_side).reshape(x_count, y_count, *values.shape[1:])
    cubic_degree = 3
    return scipy.interpolate.NdBSpline(knots, coefficients, cubic_degree)


def _design_matrix(position: Array, knots: tuple[Array, Array]) -> csr_array:
    """Return the matrix that converts the coefficients of a cubic spline into its values at given positions.

    Args:
        position: Positions (x, y), shape (n, 2), mm.
        knots: Knots along x and along y.

    Returns:
        Matrix, shape (n, x_count * y_count), where x_count and y_count are the numbers of coefficients along x and y.
    """
    # A cubic spline has 4 coefficients fewer than knots along each axis.
    x_knots, y_knots = knots
    n_coefficient = (x_knots.size - 4) * (y_knots.size - 4)
    cubic_degree = 3
    entries = scipy.interpolate.NdBSpline.design_matrix(position, knots, cubic_degree)
    # The matrix of SciPy has no columns for the last coefficients if they do not affect any position. The matrix is
    # therefore created again with its full shape.
    return csr_array((entries.data, entries.indices, entries.indptr), shape=(len(position), n_coefficient))


def _penalty_matrix(x_count: int, y_count: int, smoothing: float = 5e-3) -> sparray:
    """Return the matrix that converts spline coefficients into their weighted third differences along x and along y.

    Args:
        x_count: Number of coefficients along x, which is the first axis of the coefficients.
        y_count: Number of coefficients along y.
        smoothing: Weight of the third differences of the spline coefficients in the fit, dimensionless. The third
            differences determine the coefficients in regions without points.
    """
    x_differences = kron(_third_differences(x_count), eye_array(y_count))
    y_differences = kron(eye_array(x_count), _third_differences(y_count))
    return smoothing * vstack([x_differences, y_differences])


def _third_differences(count: int) -> dia_array:
    """Return the matrix that computes the third differences of neighbouring coefficients, shape (count - 3, count)."""
    return diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count))


def disk_positions(
    cells: int, per_cell: float = 1.6, per_edge_cell: float = 2.0, edge_radius: float = 1.0 - 1e-12
) -> Array:
    """Return positions on the unit disk to which a spline is fitted.

    The positions are the points of a lattice in the disk, and points on the edge of the disk.

    Args:
        cells: Number of cells of the spline along the diameter of the disk.
        per_cell: Number of positions per cell to which a spline is fitted.
        per_edge_cell: Number of additional positions on the edge of the disk to which a spline is fitted, per cell
            along the edge.
        edge_radius: Distance of the positions on the edge of the disk from the centre, in radii of the disk,
            dimensionless. This distance is less than 1 by more than the rounding error. The positions therefore lie in
            the disk.

    Returns:
        Positions (x, y), shape (n, 2), in radii of the disk.
    """
    # In units of the side of a cell, the diameter of the disk is `cells`. The constants 16 and 8 ensure that there are
    # enough positions if there are only a few cells.
    cells_in_disk = np.pi * (0.5 * cells) ** 2
    cells_along_edge = np.pi * cells
    inner_count = int(per_cell * cells_in_disk) + 16
    edge_count = int(per_edge_cell * cells_along_edge) + 8

    # Positions are complex numbers x + iy. edge_radius moves the points on the edge slightly into the disk.
    inner_positions = lattice(inner_count)
    edge_positions = np.exp(2j * np.pi * np.arange(edge_count) / edge_count) * edge_radius
    complex_positions = np.concatenate([inner_positions, edge_positions])
    return np.stack([complex_positions.real, complex_positions.imag], axis=1)
