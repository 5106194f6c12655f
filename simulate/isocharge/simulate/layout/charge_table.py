"""Table for computing the charges of electrodes at any position on the film.

The table also contains the derivatives of the charges with respect to the position and the force of the press, the
probe radius and the pretension. The equilibrium of a round film under a press depends on the distance of the press from
the centre, but not on the electrodes. A conformal map (see `mesh.placement`) transforms the edge of the probe into a
circle |z| = r0 around the origin. In the coordinate z of the conformal map, the stress is smooth except for a kink on
the circle.

The equilibrium is solved for presses at a few distances from the centre. In `distance_coordinate`, these distances are
Chebyshev nodes. The stress and its derivatives are stored on a polar grid in z. The derivatives are computed by finite
differences. The rows of the grid are equally spaced in |z| within the circle, and equally spaced in ln|z| between the
circle and the rim. Between the solved distances, the table is interpolated by polynomials in the distance coordinate.
If the film is not axisymmetric, presses are also solved in several directions from the centre, and the table is
interpolated by a trigonometric polynomial in the direction.
Between the nodes of the grid, the table is interpolated by local cubic polynomials. The charge of an electrode is its
area times the mean charge per area.
"""

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.common.progress import track
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.family import DIRECTION_PERIOD, DIRECTIONS, nearest_to_clamp
from isocharge.simulate.forward.readout import electrode_rule
from isocharge.simulate.mesh.conformal_map import automorphism_onto, distance_coordinate
from isocharge.simulate.mesh.placed_mesh import distance_on_circular_film, film_oval, from_oval, to_oval
from isocharge.simulate.numerics.interpolation import (
    chebyshev_nodes,
    cubic_weights,
    lagrange_values,
    periodic_weights,
)
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Electrode, Sensor
from isocharge.simulate.solver.equilibrium import touch_stress
from isocharge.simulate.solver.load_case import SolveSettings, layer_for
from isocharge.simulate.solver.press import needed_resolution, press

COLUMNS = ("charge", "x", "y", "ln force", "probe radius", "pretension")
"""Columns of a row, which contains the results for one press and one electrode.

The columns are the charge (pC) and its derivatives with respect to x and y (pC/mm), ln F (pC), the probe radius (pC/mm)
and the pretension (pC/MPa).
"""

INNER_ROWS = 10
"""Number of rows of the polar grid within the footprint of the probe."""

OUTER_ROWS = 49
"""Number of rows of the polar grid between the edge of the probe and the rim of the film."""

ANGLES = 64
"""Number of columns of the polar grid, at equal angles."""

MARGIN = 0.03
"""Width of the gap of the polar grid on either side of the circle |z| = r0, in units of r0, dimensionless.

The gap contains no nodes, because the finite differences would be wrong there: the stress has a kink on the circle.
"""

STEPS = {"x": 0.02, "y": 0.02, "ln force": 0.05, "probe radius": 0.02, "pretension": 0.1}
"""Steps of the finite differences of the stress.

The steps of the position and of the probe radius are in units of the probe radius, and that of the pretension is in
MPa.
"""

N_DISTANCES = 8
"""Number of distances of the solved presses from the centre."""

GAUSS_RULES = ((1.4, 10), (2.5, 4), (np.inf, 2))
"""Integration rules of electrodes in ascending order of the distance between the electrode and the press.

Each rule consists of the largest distance at which it is used, and of the number of Gauss points per side of the
electrode. The unit of the distances is the sum of the radius of the circle around the electrode and the probe radius.
The kink of the stress crosses only electrodes to which the first rule applies.
"""

PRESS_CHUNK = 256
"""Number of presses that are evaluated at once, which limits the required memory to about 100 MB."""

POINT_CHUNK = 20_000
"""Number of integration points that are evaluated at once, which limits the required memory to about 100 MB."""


@dataclass(frozen=True)
class ChargeTable:
    """Table for computing the charges of electrodes of any shape. All presses have the same probe and the same force.

    The presses may lie anywhere in a disk around the centre of the film.

    Attributes:
        film: Film that is pressed.
        probe: Circular probe that presses the film.
        piezo: Piezoelectric coefficients d31 and d32, pC/N.
        distance: Distances of the solved presses from the centre of the film, shape (n_distance,), mm.
        direction: Directions from the centre of the film to the solved presses, evenly spaced over half a turn, shape
            (n_direction,), rad. An axisymmetric film has a single direction.
        stress: Stress (s11, s22, s12) in MPa and its derivatives in the frame of the press, at the nodes of the polar
            grid. The array has the shape (n_distance * n_direction * 3, n_node * 6) and single precision. The first
            axis contains the stress components of each solved position. The second axis contains the `COLUMNS` of each
            node.
    """

    film: Film
    probe: Circle
    piezo: tuple[float, float]
    distance: Array
    direction: Array
    stress: np.ndarray

    @classmethod
    def solve(
        cls, sensor: Sensor, probe: Circle, force: float, radius: float, executor: Executor | None = None
    ) -> "ChargeTable":
        """Create a table by solving presses at a few distances from the centre.

        Args:
            sensor: Sensor with the film, its piezoelectric coefficients and the surface at which the stress is read.
            probe: Circular probe that presses the film.
            force: Force of the presses, N.
            radius: Largest distance of a press from the centre, mm.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SolveError: If a press has no equilibrium.
        """
        # All presses are solved with the mesh that the outermost press needs.
        film = sensor.film
        basic_settings = SolveSettings(layer=layer_for(film, force))
        resolution = needed_resolution(film, probe, nearest_to_clamp(film, radius), force, basic_settings)
        settings = replace(basic_settings, resolution=resolution)

        # The distances are Chebyshev nodes in `distance_coordinate`, whose inverse is `tanh`.
        largest_coordinate = float(distance_coordinate(radius / film.radius))
        distance = film.radius * np.tanh(chebyshev_nodes(N_DISTANCES, 0.0, largest_coordinate))
        n_direction = 1 if film.is_axisymmetric else DIRECTIONS
        direction = DIRECTION_PERIOD * np.arange(n_direction) / n_direction
        presses = list(product(distance.tolist(), direction.tolist()))
        solve = partial(_stress_at, film, sensor.surface, probe, force, settings)
        stresses = list(track(in_order(executor, solve, presses), "solving the film", len(presses)))

        # A column is one of the quantities in `COLUMNS`: the stress itself, or one of its derivatives. The axes
        # (press, column, node, stress component) become (press, stress component, node, column).
        component_before_node = np.stack(stresses).transpose(0, 3, 2, 1)
        stress = component_before_node.reshape(3 * len(presses), -1).astype(np.float32)
        return cls(film, probe, (sensor.piezo.d31, sensor.piezo.d32), distance, direction, stress)

    def rows(self, presses: Array, electrodes: Sequence[Electrode]) -> Array:
        """Compute the charges of electrodes under presses, and the derivatives of these charges.

        A row contains the charge of one electrode under one press, followed by the derivatives of this charge. The
        charge per area is averaged over the area of an electrode, even if the sensor has the edge readout.

        Args:
            presses: Positions (x, y) of the presses, shape (n, 2), mm.
            electrodes: Electrodes of any shape at their nominal positions.

        Returns:
            One row with the columns `COLUMNS` for each press and electrode, shape (n, n_electrode, 6).
        """
        chunks = np.array_split(presses, math.ceil(len(presses) / PRESS_CHUNK))
        return np.concatenate([PressedFilm.interpolate(self, chunk).rows(electrodes) for chunk in chunks])


@dataclass(frozen=True)
class PressedFilm:
    """Charge per area that several presses cause, at the nodes of the polar grid of each press.

    Attributes:
        table: Charge table from which the charges per area were interpolated.
        presses: Positions x + iy of the presses, shape (n,), mm.
        direction: Unit vector from the centre to each press as a complex number, shape (n,).
        map_parameter: Parameter c of the conformal map of each press, shape (n,), dimensionless.
        circle_radius: Radius r0 of the circle to which the conformal map of each press maps the edge of the probe,
            shape (n,), dimensionless.
        density: Charge per area (pC/mm^2) and its derivatives with the columns `COLUMNS`, shape (n * n_node, 6). The
            derivatives with respect to the position are along and across the direction of the press.
    """

    table: ChargeTable
    presses: Complexes
    direction: Complexes
    map_parameter: Array
    circle_radius: Array
    density: np.ndarray

    @classmethod
    def interpolate(cls, table: ChargeTable, presses: Array) -> "PressedFilm":
        """Compute the charges per area that several presses cause by interpolating a charge table.

        Args:
            table: Charge table that covers the presses.
            presses: Positions (x, y) of the presses, shape (n, 2), mm.
        """
        position = presses @ np.array([1.0, 1j])  # x + iy
        direction = np.exp(1j * np.angle(position))  # unit vector from the centre of the film to the press
        relative_distance = np.abs(position) / table.film.radius

        # Compute the weights that interpolate between the solved presses, shape (n, n_distance * n_direction).
        nodes = distance_coordinate(table.distance / table.film.radius)
        coordinate = distance_coordinate(relative_distance)
        distance_weights = lagrange_values(nodes, coordinate)
        direction_weights = periodic_weights(table.direction, DIRECTION_PERIOD, np.angle(position))
        press_weights = (distance_weights[:, :, None] * direction_weights[:, None, :]).reshape(len(position), -1)

        # Compute the coefficients that convert the three stress components into charge per area, shape (n, 3).
        coefficients = _piezo_in_press_frame(table.piezo, direction)

        # One matrix product interpolates the stress and converts it into charge per area, for all nodes of the grid.
        weights = press_weights[:, :, None] * coefficients[:, None, :]  # shape (n, n_distance * n_direction, 3)
        flat_weights = weights.reshape(len(position), -1).astype(np.float32)
        density = (flat_weights @ table.stress).reshape(-1, len(COLUMNS))  # shape (n * n_node, 6)

        # Compute the conformal map of each press, which transforms the edge of the probe into the circle |z| = r0.
        relative_radius = np.full(len(position), table.probe.radius / table.film.radius)
        circular_distance = distance_on_circular_film(table.film, np.abs(position), np.angle(position))
        map_parameter, circle_radius = automorphism_onto(circular_distance / table.film.radius, relative_radius)
        return cls(table, position, direction, map_parameter, circle_radius, density)

    def rows(self, electrodes: Sequence[Electrode]) -> Array:
        """Compute the charges of electrodes and their derivatives for all presses; see `ChargeTable.rows`."""
        rows = np.empty((len(self.presses), len(electrodes), len(COLUMNS)))
        for index, electrode in enumerate(electrodes):
            # Choose the integration rule of each press: the first rule whose largest distance is not below the distance
            # of the press. Then compute all presses with the same rule together, in chunks that limit the memory.
            corners = np.concatenate(electrode.parts) @ np.array([1.0, 1j])  # x + iy
            centre = corners.mean()
            reach = np.abs(corners - centre).max() + self.table.probe.radius
            limits = [largest_distance for largest_distance, _ in GAUSS_RULES]
            rule_of_press = np.searchsorted(limits, np.abs(self.presses - centre) / reach)
            for rule, (_, points_per_side) in enumerate(GAUSS_RULES):
                presses = np.flatnonzero(rule_of_press == rule)
                if not presses.size:
                    continue
                points, weights = electrode_rule(electrode, "area", points_per_side)
                for chunk in np.array_split(presses, 1 + presses.size * len(points) // POINT_CHUNK):
                    # The weights of s11, s22 and s12 are equal.
                    rows[chunk, index] = electrode.area * self.mean_rows(chunk, points, weights[:, 0])
        return rows

    def mean_rows(self, press_index: Integers, points: Array, weights: Array) -> Array:
        """Compute weighted means of the charge per area and of its derivatives over points on the film.

        Args:
            press_index: Indices of the presses, shape (k,).
            points: Points (x, y) over which the means are computed, shape (n_point, 2), mm.
            weights: Weights of the points, which add up to one, shape (n_point,).

        Returns:
            Means of the charge per area (pC/mm^2) and of its derivatives, in the order of `COLUMNS`, shape (k, 6).
        """
        # Rotate the points into the frame of the press, whose x axis is the direction from the centre to the press.
        n_mean = len(press_index)
        direction = self.direction[press_index]
        points_in_press_frame = (points @ np.array([1.0, 1j])) / direction[:, None]

        # Each mean is a weighted sum over the nodes of the grid that surround its points.
        nodes, node_weights = self._nodes_around(press_index, points_in_press_frame, weights)
        flat_weights = node_weights.reshape(n_mean, 1, -1).astype(np.float32)
        node_density = self.density[nodes.reshape(n_mean, -1)]  # shape (k, n_point * n_row * n_column, 6)
        mean: Array = np.matmul(flat_weights, node_density)[:, 0].astype(float)

        # The derivatives with respect to x and y are rotated from the frame of the press to the frame of the film.
        x_column = COLUMNS.index("x")
        y_column = COLUMNS.index("y")
        position_derivative = (mean[:, x_column] + 1j * mean[:, y_column]) * direction
        mean[:, x_column] = position_derivative.real
        mean[:, y_column] = position_derivative.imag
        return mean

    def _nodes_around(self, press_index: Integers, points: Complexes, point_weights: Array) -> tuple[Integers, Array]:
        """Find the grid nodes that surround given points, and the weights of these nodes for cubic interpolation.

        Args:
            press_index: Index of the press to whose grid each row of points belongs, shape (k,).
            points: Points x + iy in the frame of the press, shape (k, n_point), mm.
            point_weights: Weights of the points, by which the weights of the nodes are multiplied, shape (n_point,).

        Returns:
            Indices of the nodes in `density`, and their weights, each of shape (k, n_point, n_row, n_column), where
            n_row and n_column are 4.
        """
        # Find the four nearest rows and the four nearest columns of each point, and their weights, shape (k, n_point,
        # 4).
        row, column = self._grid_coordinates(press_index, points)
        rows, row_weights = _row_weights(row)
        columns, column_weights = cubic_weights(column, ANGLES, periodic=True)

        # Combine each row with each column. The array `density` contains the grid of one press after the other, and
        # each grid row by row.
        rows_per_press = INNER_ROWS + OUTER_ROWS
        first_row_of_press = press_index[:, None, None, None] * rows_per_press
        nodes = (first_row_of_press + rows[..., :, None]) * ANGLES + columns[..., None, :]
        node_weights = point_weights[:, None, None] * row_weights[..., :, None] * column_weights[..., None, :]
        return nodes, node_weights

    def _grid_coordinates(self, press_index: Integers, points: Complexes) -> tuple[Array, Array]:
        """Compute the fractional rows and columns of points on the polar grids.

        For example, the fractional row 2.5 lies halfway between the rows 2 and 3. Points beyond the rim are moved to
        the rim.

        Args:
            press_index: Index of the press to whose grid each row of points belongs, shape (k,).
            points: Points x + iy in the frame of the press, shape (k, n_point), mm.

        Returns:
            Fractional rows and columns, each of shape (k, n_point).
        """
        # Compute the coordinate z of the conformal map of the press, which maps the footprint onto the disk |z| <= r0.
        map_parameter = self.map_parameter[press_index, None]
        circle_radius = self.circle_radius[press_index, None]
        relative_points = points / self.table.film.radius
        if self.table.film.oval:
            oval = film_oval(self.table.film, np.angle(self.direction[press_index, None]))
            relative_points = from_oval(relative_points, oval)
        unit_points = relative_points / np.maximum(np.abs(relative_points), 1.0)  # moves points beyond the rim
        z = (unit_points - map_parameter) / (1.0 - map_parameter * unit_points)
        radius = np.abs(z)

        # Invert the formulas of `_grid_points`: the rows are equally spaced in |z| within the circle |z| = r0, and in
        # ln|z| outside.
        inner_row = radius / (circle_radius * (1.0 - MARGIN)) * (INNER_ROWS - 1)
        outer_radius = np.maximum(radius, circle_radius)  # avoids ln 0 for inner points, whose outer row is not used
        outer_fraction = 1.0 - np.log(outer_radius) / np.log(circle_radius * (1.0 + MARGIN))
        outer_row = INNER_ROWS + outer_fraction * (OUTER_ROWS - 1)
        row = np.where(radius <= circle_radius, inner_row, outer_row)
        column = np.angle(z) * ANGLES / (2.0 * np.pi)  # columns have equal angles
        return row, column


def _piezo_in_press_frame(piezo: tuple[float, float], direction: Complexes) -> Array:
    """Compute the coefficients that convert the stress in the frame of each press into charge per area.

    Axis 1 of the frame of a press is the direction from the centre of the film to the press. The charge per area is the
    sum of the stresses s11, s22 and s12 in this frame, each multiplied by its coefficient.

    Args:
        piezo: Coefficients d31 and d32, pC/N.
        direction: Unit vector from the centre of the film to each press as a complex number, shape (n,).

    Returns:
        Coefficients of s11, s22 and s12 for each press, shape (n, 3), pC/N.
    """
    # If the press lies at the angle a, the coefficients are d31 cos^2 a + d32 sin^2 a, d31 sin^2 a + d32 cos^2 a and
    # (d32 - d31) sin 2a. The first two are the mean of d31 and d32, plus or minus half their difference times cos 2a.
    d31, d32 = piezo
    mean = 0.5 * (d31 + d32)
    half_difference = 0.5 * (d31 - d32)
    double_angle = direction**2  # cosine and sine of twice the angle of the press
    s11_coefficient = mean + half_difference * double_angle.real
    s22_coefficient = mean - half_difference * double_angle.real
    s12_coefficient = -2.0 * half_difference * double_angle.imag
    return np.stack([s11_coefficient, s22_coefficient, s12_coefficient], axis=1)


def _row_weights(fractional_row: Array) -> tuple[Integers, Array]:
    """Find the rows of the polar grid between which values are interpolated, and the weights of these rows.

    A row of the grid contains the nodes at one distance from the origin, and is numbered from the inside to the
    outside. A fractional row is a position between rows: the fractional row 2.5 lies halfway between the rows 2 and 3.
    The inner rows lie inside the edge of the probe, and the outer rows lie outside. The interpolation does not cross
    this edge, because the stress has a kink there. Up to half a row beyond the last inner row, only inner rows are
    used. Farther outside, only outer rows are used.

    Args:
        fractional_row: Fractional rows, any shape. The outer rows are numbered after the inner rows.

    Returns:
        Indices of four rows for each fractional row, and the weights of these rows, each of shape (..., 4).
    """
    is_inner = (fractional_row < INNER_ROWS - 0.5)[..., None]
    inner_rows, inner_weights = cubic_weights(fractional_row, INNER_ROWS)
    outer_rows, outer_weights = cubic_weights(fractional_row - INNER_ROWS, OUTER_ROWS)
    rows = np.where(is_inner, inner_rows, outer_rows + INNER_ROWS)
    weights = np.where(is_inner, inner_weights, outer_weights)
    return rows, weights


def _stress_at(
    film: Film, surface: Surface, probe: Circle, force: float, settings: SolveSettings, polar: tuple[float, float]
) -> Array:
    """Compute the stress under a press and its derivatives on the polar grid, in the frame of the press.

    The derivatives are computed by finite differences between solved presses.

    Args:
        film: Film that is pressed.
        surface: Surface at which the stress is read: the middle, the top or the bottom of the film.
        probe: Circular probe that presses the film.
        force: Force of the press, N.
        settings: Theory and mesh of the solves.
        polar: Distance of the press from the centre, mm, and direction from the centre to the press, rad.

    Returns:
        Stress (s11, s22, s12) in MPa, and its derivatives in the order of `COLUMNS`, shape (6, n_node, 3).
    """
    # Instead of the press, the film is rotated, so that the press lies on the positive x axis.
    distance, direction = polar
    film = film.rotated(-direction)
    points = _grid_points(film, probe.radius, distance)
    unchanged_press = press(film, probe, (distance, 0.0), force, settings)
    stress = touch_stress(unchanged_press, points, surface)

    def changed_stress(column: str, change: float) -> Array:
        """Return the stress on the grid under a press that differs in the quantity of one column."""
        changes = dict.fromkeys(STEPS, 0.0) | {column: change}
        changed_press = press(
            replace(film, pretension=film.pretension + changes["pretension"]),
            Circle(probe.radius + changes["probe radius"]),
            (distance + changes["x"], changes["y"]),
            force * math.exp(changes["ln force"]),
            settings,
            start=unchanged_press,
        )
        return touch_stress(changed_press, points, surface)

    columns = [stress]
    for column, relative_step in STEPS.items():
        step = relative_step if column in ("ln force", "pretension") else relative_step * probe.radius
        forward = changed_stress(column, step)
        if column == "pretension":  # the pretension may be zero and must not become negative
            columns.append((forward - stress) / step)
        else:
            columns.append((forward - changed_stress(column, -step)) / (2.0 * step))
    return np.stack(columns)


def _grid_points(film: Film, probe_radius: float, distance: float) -> Array:
    """For a press on the positive x axis, compute the points of the polar grid.

    The grid is polar in the coordinate z of a conformal map. The conformal map transforms the edge of the probe into a
    circle |z| = r0 around the centre. The rows of the grid are equally spaced in |z| within the circle, and equally
    spaced in ln|z| outside the circle.

    Args:
        film: Film, rotated with the press.
        probe_radius: Radius of the probe, mm.
        distance: Distance of the press from the centre, mm.

    Returns:
        Points (x, y) on the film, row by row, shape (n_node, 2), mm.
    """
    # Create the grid in the plane of z, with a small gap on both sides of the circle |z| = r0.
    relative_distance = distance_on_circular_film(film, np.array(distance), 0.0) / film.radius
    relative_radius = np.array(probe_radius / film.radius)
    map_parameter, circle_radius = automorphism_onto(relative_distance, relative_radius)
    inner_radii = circle_radius * (1.0 - MARGIN) * np.linspace(0.0, 1.0, INNER_ROWS)
    outer_radii = (circle_radius * (1.0 + MARGIN)) ** np.linspace(1.0, 0.0, OUTER_ROWS)  # ends at 1, which is the rim
    radii = np.concatenate([inner_radii, outer_radii])
    directions = np.exp(2j * np.pi * np.arange(ANGLES) / ANGLES)
    z = radii[:, None] * directions

    # Map the grid onto the film by the inverse of the conformal map z = (p - c) / (1 - c p) of a point p. The
    # last factor keeps the outermost points on the film despite rounding errors.
    unit_points = ((z + map_parameter) / (1.0 + map_parameter * z)).ravel()
    points = film.radius * to_oval(unit_points * (1.0 - 1e-12), film_oval(film, 0.0))
    return np.stack([points.real, points.imag], axis=1)
