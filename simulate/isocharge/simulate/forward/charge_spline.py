"""Spline approximation of a forward map, which computes charges and their derivatives about two hundred times faster.

The charges are divided by the squared amplitude of `mechanics.scaling`, which removes most of their dependence on the
force. For each of a few forces, the scaled charges are approximated by a cubic spline in (x, y). The spline is fitted
by least squares to presses on the disk. Near an electrode, its charge changes considerably over the length of the
probe. Around each electrode, a second spline with finer knots therefore corrects the charge of this electrode. Between
the forces, the charges are interpolated by Lagrange polynomials in ln F. A forward map interpolates its stress fields
in the same way, so the interpolation in the force adds no error.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy  # scipy.interpolate is imported when it is used

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.simulate.forward.charge_map import ChargeMap, Domain, check_radius
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.numerics.disk import lattice, onto_disk, sunflower
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.simulate.numerics.spline_fit import fit_spline, spline_knots
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.sensor import Calibration

COARSE_SPACING = 0.6
"""Largest distance between the knots of the spline over the disk, mm."""

PATCH_MARGIN = 3.0
"""Distance by which the fine spline of an electrode extends beyond the presses that touch the electrode, mm."""

MAX_KNOT_SPACING = 0.3
"""Largest distance between the knots near an electrode, mm."""

RELATIVE_KNOT_SPACING = 1.0 / 6.0
"""Largest distance between the knots near an electrode, in units of the reach of the probe, dimensionless.

The charge of an electrode changes over the length of this reach.
"""

MIN_CELLS = 8
"""Smallest number of cells of the spline across the disk."""

MAX_CELLS = 400
"""Largest number of cells of a spline along x or y."""

PRESSES_PER_CELL = 1.6
"""Number of fitted presses per cell of the disk."""

PRESSES_PER_EDGE_CELL = 2.0
"""Number of additional fitted presses on the edge of the disk, per cell along the edge."""

EDGE_RADIUS = 1.0 - 1e-12
"""Distance from the centre at which presses on the edge of the disk are fitted, in radii of the disk.

It is less than 1 by more than the rounding error, so that the presses lie in the domain of the forward map.
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
class Patch:
    """Correction of the charge of one electrode for presses in a rectangle around it.

    The correction and its slopes are zero on the edges of the rectangle.

    Attributes:
        electrode: Number of the electrode.
        low: Corner of the rectangle with the smallest coordinates, shape (2,), mm.
        high: Corner of the rectangle with the largest coordinates, shape (2,), mm.
        table: Spline of the correction in x and y, whose values have the shape (n_force,), pC.
    """

    electrode: int
    low: Array
    high: Array
    table: "scipy.interpolate.NdBSpline"

    def contains(self, position: Array) -> Booleans:
        """Return whether positions, shape (n, 2), mm, lie in the rectangle."""
        return np.asarray(((position > self.low) & (position < self.high)).all(axis=1))


@dataclass(frozen=True)
class ChargeSpline:
    """Touch charges as a function of (x, y, F), for one probe in one orientation.

    Attributes:
        electrodes: Names of the electrodes, in the order of the charges.
        film: Film whose amplitude scales the charges.
        calibration: Calibration that adds the crosstalk to the charges.
        domain: Presses that the splines cover.
        force: Forces of the splines, shape (n_force,), N.
        table: Spline of the scaled charges without crosstalk in x and y, whose values have the shape (n_force,
            n_electrode).
        patches: Corrections of the scaled charges near the electrodes.
        error: Largest error with respect to the forward map, relative to the largest charge of a press.
    """

    electrodes: tuple[str, ...]
    film: Film
    calibration: Calibration
    domain: Domain
    force: Array
    table: "scipy.interpolate.NdBSpline"
    patches: tuple[Patch, ...]
    error: float

    @classmethod
    def of(cls, forward_map: ForwardMap, radius: float | None = None, spacing: float | None = None) -> "ChargeSpline":
        """Fit splines to a forward map, which takes a few seconds.

        Args:
            forward_map: The forward map. The probe keeps the orientation with which the map was built.
            radius: Largest distance from the centre, mm; None for that of the map.
            spacing: Distance between the knots near the electrodes, mm; None for a sixth of the reach of the probe,
                and at most `MAX_KNOT_SPACING`.

        Raises:
            SceneError: If the radius is not positive or larger than that of the map.
        """
        map_domain = forward_map.domain
        domain = map_domain if radius is None else map_domain.within(radius)
        check_radius(domain.radius, map_domain.radius, "forward map")
        spacing = spacing or min(MAX_KNOT_SPACING, RELATIVE_KNOT_SPACING * forward_map.probe.reach)

        # Fit coarse splines of all charges over the disk, and a finer correction near each electrode.
        sensor = forward_map.sensor
        samples = _ScaledCharges(forward_map, _force_nodes(forward_map))
        coarse = _fit_disk(samples, domain.radius, max(spacing, COARSE_SPACING))
        patches: list[Patch] = []
        if spacing < COARSE_SPACING:
            for electrode in range(len(sensor.electrodes)):
                patch = _fit_patch(samples, electrode, domain.radius, spacing, coarse)
                if patch is not None:
                    patches.append(patch)

        # The error is measured with the finished splines, and is unknown (NaN) until then.
        spline = cls(
            electrodes=forward_map.electrodes,
            film=sensor.film,
            calibration=sensor.calibration,
            domain=domain,
            force=samples.force,
            table=coarse,
            patches=tuple(patches),
            error=np.nan,
        )
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
            Derivatives, shape (n, n_electrode, 3), pC/mm, pC/mm and pC.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        _, derivatives = self.linearised(contact)
        return derivatives

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Return the results of `charges` and `derivatives`, which are computed together in less time."""
        contact = self.domain.check(contact, "table")
        charge, position_derivative, log_force_derivative = self.first_order(contact[:, :2], contact[:, 2])
        return charge, np.concatenate([position_derivative, log_force_derivative[..., None]], axis=2)

    def first_order(self, position: Array, force: Array | float) -> tuple[Array, Array, Array]:
        """Compute charges and their derivatives.

        The positions may lie outside the disk, because a solver may try such positions.

        Args:
            position: Positions (x, y), shape (n, 2), mm. Positions outside the disk are moved to its edge.
            force: Forces, shape (n,) or a number, N.

        Returns:
            Charges, shape (n, n_electrode), pC. Derivatives with respect to (x, y), shape (n, n_electrode, 2), pC/mm.
            Derivatives with respect to ln F, shape (n, n_electrode), pC.
        """
        # Each charge is a weighted sum of the scaled charges at the forces of the splines. Only the weights depend on
        # the force. Their derivatives with respect to ln F are computed by central differences.
        position = onto_disk(position, self.domain.radius)
        log_force = np.log(np.broadcast_to(force, len(position)))
        weights = self.force_weights(log_force)
        weights_above = self.force_weights(log_force + LOG_FORCE_STEP)
        weights_below = self.force_weights(log_force - LOG_FORCE_STEP)
        weight_slopes = (weights_above - weights_below) / (2.0 * LOG_FORCE_STEP)

        # Only the scaled charges depend on the position.
        scaled_charge = self.scaled_charges(position)
        scaled_gradient = self.scaled_gradients(position)

        # Sum over k, the forces of the splines, for each press n and electrode e (i is x or y).
        charge = np.einsum("nk,nke->ne", weights, scaled_charge)
        position_derivative = np.einsum("nk,nkei->nei", weights, scaled_gradient)
        log_force_derivative = np.einsum("nk,nke->ne", weight_slopes, scaled_charge)
        return charge, position_derivative, log_force_derivative

    def force_weights(self, log_force: Array) -> Array:
        """Compute the weights with which the scaled charges at the forces of the splines are summed.

        The weighted sum is the charge. Each weight is a Lagrange weight in ln F, multiplied by the squared amplitude at
        the force, because the scaled charges are divided by the squared amplitude.

        Args:
            log_force: Logarithms of the forces (N), shape (...).

        Returns:
            Weights, shape (..., n_force).
        """
        nodes = np.log(self.force)
        flat_log_force = log_force.ravel()
        weights = lagrange_values(nodes, barycentric_weights(nodes), flat_log_force)
        weights *= amplitude_squared(self.film, np.exp(flat_log_force))[:, None]
        return weights.reshape(*log_force.shape, nodes.size)

    def scaled_charges(self, position: Array) -> Array:
        """Compute the scaled charges at the forces of the splines.

        A scaled charge is a charge divided by the squared amplitude at its force. The splines over the disk give all
        charges. Each patch corrects the charge of one electrode in a rectangle around it. The calibration adds the
        crosstalk last.

        Args:
            position: Positions (x, y), shape (n, 2), mm.

        Returns:
            Scaled charges, shape (n, n_force, n_electrode), pC.
        """
        scaled_charge = np.asarray(self.table(position))
        for patch in self.patches:
            is_inside = patch.contains(position)
            scaled_charge[is_inside, :, patch.electrode] += patch.table(position[is_inside])
        return self.calibration.read(scaled_charge)

    def scaled_gradients(self, position: Array) -> Array:
        """Compute the derivatives of `scaled_charges` with respect to x and y.

        Args:
            position: Positions (x, y), shape (n, 2), mm.

        Returns:
            Derivatives, shape (n, n_force, n_electrode, 2), pC/mm.
        """
        # A spline takes the orders of the derivative with respect to x and y.
        x_derivative_orders = (1, 0)
        y_derivative_orders = (0, 1)
        derivatives = []
        for orders in (x_derivative_orders, y_derivative_orders):
            derivative = np.asarray(self.table(position, nu=orders))
            for patch in self.patches:
                is_inside = patch.contains(position)
                derivative[is_inside, :, patch.electrode] += patch.table(position[is_inside], nu=orders)
            derivatives.append(self.calibration.read(derivative))
        return np.stack(derivatives, axis=-1)


def with_fast_derivatives(charge_map: ChargeMap) -> ChargeMap:
    """Return splines of a forward map, whose fit takes a few seconds. Any other charge map is returned unchanged."""
    if isinstance(charge_map, ForwardMap):
        return ChargeSpline.of(charge_map)
    return charge_map


def _force_nodes(forward_map: ForwardMap) -> Array:
    """Return the forces of the splines, shape (n_force,), N.

    If d33 is zero, these are the forces of the forward map. The charges of d33 depend on the force in another way than
    the charges of the stress, so that a sensor with d33 needs a few forces more. A single force is never extended.
    """
    solved_force = forward_map.family.force
    min_log_force, max_log_force = np.log(forward_map.domain.force_range)
    if forward_map.sensor.piezo.d33 == 0.0 or min_log_force == max_log_force:
        return solved_force
    log_force = chebyshev_nodes(solved_force.size + EXTRA_FORCE_NODES, min_log_force, max_log_force)
    return np.asarray(np.exp(log_force))


def _fit_positions(cells: int) -> Array:
    """Return the positions of the fitted presses on the unit disk: a lattice, and points on the edge.

    Args:
        cells: Number of cells of the spline across the disk.

    Returns:
        Positions (x, y), shape (n, 2).
    """
    # The disk has the diameter `cells`, in units of the side of a cell. A few presses are added for small numbers of
    # cells.
    cells_in_disk = np.pi * (0.5 * cells) ** 2
    cells_along_edge = np.pi * cells
    inner_count = int(PRESSES_PER_CELL * cells_in_disk) + 16
    edge_count = int(PRESSES_PER_EDGE_CELL * cells_along_edge) + 8

    # Positions are complex numbers x + iy. Those on the edge are moved inwards by more than the rounding error.
    inner_positions = lattice(inner_count)
    edge_positions = np.exp(2j * np.pi * np.arange(edge_count) / edge_count) * EDGE_RADIUS
    complex_positions = np.concatenate([inner_positions, edge_positions])
    return np.stack([complex_positions.real, complex_positions.imag], axis=1)


@dataclass(frozen=True)
class _ScaledCharges:
    """Scaled charges of a forward map without crosstalk, to which splines are fitted.

    Attributes:
        forward_map: The forward map.
        force: Forces of the splines, shape (n_force,), N.
    """

    forward_map: ForwardMap
    force: Array

    def at(self, position: Array, is_needed: Booleans) -> Array:
        """Compute the scaled charges of presses: the charges divided by the squared amplitude at their force.

        At each position, the press is computed with every force of the splines.

        Args:
            position: Positions (x, y), shape (n, 2), mm.
            is_needed: Whether the charge of each electrode is needed, shape (n_electrode,).

        Returns:
            Scaled charges, shape (n, n_force, n_electrode), pC.
        """
        forward_map = self.forward_map
        film = forward_map.sensor.film
        solved_force = forward_map.family.force
        scaled_stress_charge = forward_map.stress_charges_by_force(position, is_needed)
        scaled_stress_charge /= amplitude_squared(film, solved_force)[:, None]
        if forward_map.sensor.piezo.d33 == 0.0:
            return scaled_stress_charge

        # Interpolate from the solved forces to the forces of the splines.
        nodes = np.log(solved_force)
        force_weights = lagrange_values(nodes, barycentric_weights(nodes), np.log(self.force))
        scaled_charge = force_weights @ scaled_stress_charge  # shape (n, n_force, n_electrode)

        # Add the charge of the contact pressure, which is proportional to the force.
        pressure_charge_per_force = forward_map.pressure_charges(position)  # shape (n, n_electrode)
        scaled_force = self.force / amplitude_squared(film, self.force)  # shape (n_force,)
        scaled_pressure_charge = pressure_charge_per_force[:, None] * scaled_force[:, None]
        return np.asarray(scaled_charge + scaled_pressure_charge)


def _fit_disk(samples: _ScaledCharges, radius: float, spacing: float) -> "scipy.interpolate.NdBSpline":
    """Fit splines of all charges over the disk.

    Args:
        samples: Scaled charges to which the splines are fitted.
        radius: Radius of the disk, mm.
        spacing: Largest distance between the knots, mm.

    Returns:
        Splines in (x, y), whose values have the shape (n_force, n_electrode), pC.
    """
    cells = int(np.clip(np.ceil(2.0 * radius / spacing), MIN_CELLS, MAX_CELLS))
    knots = spline_knots(-radius, radius, cells)
    position = radius * _fit_positions(cells)
    all_electrodes = np.ones(len(samples.forward_map.electrodes), dtype=bool)
    charge = samples.at(position, all_electrodes)
    # No coefficients are fixed, because the splines cover the whole disk and need not vanish at its edge.
    return fit_spline(position, charge, (knots, knots), fixed=0)


def _fit_patch(
    samples: _ScaledCharges, electrode: int, radius: float, spacing: float, coarse: "scipy.interpolate.NdBSpline"
) -> Patch | None:
    """Fit a correction of the coarse splines for the charge of one electrode, in a rectangle around this electrode.

    The correction is the difference between the charge and the coarse spline.

    Args:
        samples: Scaled charges.
        electrode: Index of the electrode.
        radius: Radius of the disk, mm.
        spacing: Largest distance between the knots, mm.
        coarse: Splines of all charges over the disk.

    Returns:
        The correction; None if the rectangle lies outside the disk.
    """
    # Choose a rectangle around the electrode, outside of which its charge is smooth.
    sensor = samples.forward_map.sensor
    corners = np.concatenate([sensor.calibration.place(part) for part in sensor.electrodes[electrode].parts])
    margin = samples.forward_map.probe.reach + PATCH_MARGIN
    lower_left = corners.min(axis=0) - margin
    upper_right = corners.max(axis=0) + margin

    # Choose the knots along x and y.
    cells = np.clip(np.ceil((upper_right - lower_left) / spacing), MIN_CELLS, MAX_CELLS).astype(int)
    x_cells, y_cells = cells
    x_knots = spline_knots(lower_left[0], upper_right[0], x_cells)
    y_knots = spline_knots(lower_left[1], upper_right[1], y_cells)

    # Choose the fitted presses in the part of the rectangle that lies in the disk.
    cells_along_edge = 2.0 * np.pi * radius / spacing  # along the whole edge of the disk
    edge_count = int(PRESSES_PER_EDGE_CELL * cells_along_edge)
    position = _patch_positions(lower_left, upper_right, cells, radius, edge_count)
    if not len(position):
        return None

    # Fit the error of the coarse splines for this electrode. Two fixed coefficients at each end of an axis make the
    # correction and its slopes zero on the edges of the rectangle.
    is_needed = np.arange(len(sensor.electrodes)) == electrode
    residual = (samples.at(position, is_needed) - coarse(position))[:, :, electrode]
    table = fit_spline(position, residual, (x_knots, y_knots), fixed=2)
    return Patch(electrode, lower_left, upper_right, table)


def _patch_positions(lower_left: Array, upper_right: Array, cells: Integers, radius: float, edge_count: int) -> Array:
    """Return the positions of the fitted presses in a rectangle: a grid within the disk, and points on its edge.

    Args:
        lower_left: Corner (x, y) of the rectangle, shape (2,), mm.
        upper_right: Opposite corner, shape (2,), mm.
        cells: Numbers of cells of the spline along x and y, shape (2,).
        radius: Radius of the disk, mm.
        edge_count: Number of points on the whole edge of the disk.

    Returns:
        Positions (x, y), shape (n, 2), mm.
    """
    # The grid has PRESSES_PER_CELL points per cell, so the square root of this number along each side of a cell.
    x_count, y_count = np.ceil(np.sqrt(PRESSES_PER_CELL) * cells).astype(int)
    x_line = np.linspace(lower_left[0], upper_right[0], x_count)
    y_line = np.linspace(lower_left[1], upper_right[1], y_count)
    x_grid, y_grid = np.meshgrid(x_line, y_line)
    grid = np.stack([x_grid.ravel(), y_grid.ravel()], axis=1)
    is_in_disk = np.hypot(grid[:, 0], grid[:, 1]) < radius

    # Of the points on the edge of the disk, only those in the rectangle are used.
    edge_angle = 2.0 * np.pi * np.arange(edge_count) / edge_count
    edge = radius * EDGE_RADIUS * np.stack([np.cos(edge_angle), np.sin(edge_angle)], axis=1)
    is_in_rectangle = ((edge > lower_left) & (edge < upper_right)).all(axis=1)
    return np.concatenate([grid[is_in_disk], edge[is_in_rectangle]])


def _largest_error(spline: ChargeSpline, forward_map: ForwardMap) -> float:
    """Compute the largest relative error at evenly distributed presses that do not lie on the lattice of the fit.

    Args:
        spline: The spline.
        forward_map: Forward map that the spline approximates.

    Returns:
        The largest error of a charge, relative to the largest charge of the same press.
    """
    position = spline.domain.radius * sunflower(CHECK_COUNT)
    # Multiples of the golden ratio, modulo 1, distribute the logarithms of the forces evenly.
    log_force_fraction = np.arange(CHECK_COUNT) * 0.618 % 1.0
    min_force, max_force = spline.domain.force_range
    force = np.clip(min_force * (max_force / min_force) ** log_force_fraction, min_force, max_force)
    contact = np.stack([position.real, position.imag, force], axis=1)
    true_charge = forward_map.charges(contact)
    error = np.abs(spline.charges(contact) - true_charge).max(axis=1)
    largest_charge = np.abs(true_charge).max(axis=1)
    return float((error / largest_charge).max())
