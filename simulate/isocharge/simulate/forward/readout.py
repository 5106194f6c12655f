"""Charge collected by an electrode on a stretched piezoelectric film.

The charge amplifiers hold the electrodes at virtual ground, so the electric field vanishes. An electrode of area A
collects only the polarisation caused by the in-plane stress (Mirbagheri et al., 2007, equation 2):

    Q = A * mean(d31 * s11 + d32 * s22).

Here s is the mid-surface stress in the axes of the film, and axis 1 is the drawn direction x. The area readout computes
the mean over the electrode. The edge readout computes the mean of s11 over the left and right edges, and the mean of
s22 over the lower and upper edges, as in equation 3 of the paper. The touch charge is the charge under load minus the
charge without load, so a uniform pretension cancels.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.common.errors import SensorError
from isocharge.simulate.numerics.interpolation import gauss_line, gauss_square
from isocharge.simulate.numerics.polygon import gauss_polygon, gauss_quadrilateral
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import MAX_PART_SIDE, Electrode, Readout, Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium, touch_stress

DIRECT = 20
"""Number of Gauss points per side of an electrode for single presses.

The stress has a kink at the edge of the footprint. If this edge crosses an electrode, the relative error of the charge
is 1e-5.
"""

FINE = 12
"""Number of Gauss points per side of an electrode near the probe, for many presses. The relative error is 8e-5."""

COARSE = 4
"""Number of Gauss points per side of an electrode away from the probe, for many presses."""

FAR = 2
"""Number of Gauss points per side of an electrode far from the probe, for many presses."""

LINE_POINTS = 8
"""Number of Gauss points on a line."""

NEAR = 1.0
"""Distance between the footprint and an electrode below which the fine rule is used, mm.

At larger distances the relative error of the coarse rule is at most 1e-4 for squares of 1 to 6 mm.
"""

FAR_DISTANCE = 8.0
"""Distance between the press and the parts of an electrode above which `FAR` points are used, in radii of the parts,
dimensionless. The relative error of this rule is about 2e-5."""


@dataclass(frozen=True)
class ReadoutPoints:
    """Integration points and weights that convert the stress of the film into charges.

    Attributes:
        points: Points (x, y) on the film, shape (n_electrode, n_point, 2), mm.
        weights: Charge per stress (s11, s22, s12), shape (n_electrode, n_point, 3), pC/MPa.
        count: Number of points of each electrode, shape (n_electrode,). The remaining points have zero weight.
    """

    points: Array
    weights: Array
    count: Integers

    @classmethod
    def of(cls, sensor: Sensor, per_side: int) -> "ReadoutPoints":
        """Return the integration points for the electrodes and the readout of a sensor.

        Args:
            sensor: The sensor.
            per_side: Number of Gauss points per side of an electrode.
        """
        layout_points = _layout_points(sensor.electrodes, sensor.readout, per_side)
        # The factor 2 is there because s12 and s21 contribute equally.
        charge_per_stress = np.array([sensor.piezo.d31, sensor.piezo.d32, 2.0 * sensor.piezo.d12])
        weights = sensor.gains[:, None, None] * layout_points.weights * charge_per_stress
        return cls(sensor.calibration.place(layout_points.points), weights, layout_points.count)

    @classmethod
    def along(cls, sensor: Sensor, lines: Array) -> "ReadoutPoints":
        """Return the integration points for straight lines of metal that belong to the electrodes, such as traces.

        Args:
            sensor: Sensor whose coefficients and calibration are used.
            lines: End points (x, y) of the lines in the layout, shape (n_electrode, n_line, 2, 2), mm.

        Returns:
            Points for n_electrode * n_line lines, ordered by electrode. The weights are per width of the line,
            pC/(MPa mm).
        """
        # The Gauss points divide a line from its start (0) to its end (1).
        relative_position, line_weights = gauss_line(LINE_POINTS)
        start = lines[:, :, :1]  # shape (n_electrode, n_line, 1, 2)
        start_to_end = lines[:, :, 1:] - start
        points = start + relative_position[:, None] * start_to_end  # shape (n_electrode, n_line, LINE_POINTS, 2)
        placed_points = sensor.calibration.place(points.reshape(-1, LINE_POINTS, 2))

        # Weight of a point: gain * length that the point represents * charge per area and stress (s11, s22, s12). The
        # factor 2 is there because s12 and s21 contribute equally.
        length = np.linalg.norm(start_to_end, axis=3)  # shape (n_electrode, n_line, 1)
        point_length = length * line_weights  # shape (n_electrode, n_line, LINE_POINTS)
        amplified_length = sensor.gains[:, None, None] * point_length
        charge_per_stress = np.array([sensor.piezo.d31, sensor.piezo.d32, 2.0 * sensor.piezo.d12])
        weights = amplified_length.reshape(-1, LINE_POINTS, 1) * charge_per_stress
        point_counts = np.full(len(placed_points), LINE_POINTS)
        return cls(placed_points, weights, point_counts)

    def charge(self, stress: Array) -> Array:
        """Compute charges from the stress at the points.

        Args:
            stress: Stress (s11, s22, s12), shape (..., n_electrode, n_point, 3), MPa.

        Returns:
            Charges, shape (..., n_electrode), pC.
        """
        # sum over the points p and the stress components c of each electrode e
        return np.asarray(np.einsum("...epc,epc->...e", stress, self.weights))


@lru_cache(maxsize=32)
def _layout_points(electrodes: tuple[Electrode, ...], readout: Readout, per_side: int) -> ReadoutPoints:
    """Return the integration points at the nominal positions of the electrodes. The weights are areas (mm^2).

    The result is cached, because many films have the same layout.

    Args:
        electrodes: Electrodes of the layout.
        readout: Mean over the area of an electrode, or over its edges.
        per_side: Number of points along a side of an electrode.

    Returns:
        Points and areas. Electrodes with fewer points than others are filled up with points of the area zero.
    """
    rules = [electrode_rule(electrode, readout, per_side) for electrode in electrodes]
    counts = np.array([len(shares) for _, shares in rules])
    points = np.zeros((len(electrodes), counts.max(), 2))
    areas = np.zeros((len(electrodes), counts.max(), 3))
    for index, electrode in enumerate(electrodes):
        electrode_points, shares = rules[index]
        n_point = counts[index]
        points[index, :n_point] = electrode_points
        # The shares are weights of a mean over the electrode, which sum to 1 for each component of the stress.
        areas[index, :n_point] = electrode.area * shares
    return ReadoutPoints(points, areas, counts)


def touch_charge(sensor: Sensor, equilibrium: Equilibrium) -> Array:
    """Compute the touch charge of each electrode.

    Args:
        sensor: Sensor whose `coated_film` was solved.
        equilibrium: The solved press.

    Returns:
        Charges in the order of `sensor.electrode_names`, shape (n_electrode,), pC. Positive for tension along a
        direction with a positive coefficient.

    Raises:
        SensorError: If another film was solved, or if the readout is at an outer surface and the theory omits bending.
    """
    if sensor.coated_film != equilibrium.film:
        raise SensorError(
            f"the equilibrium belongs to another film: expected {sensor.coated_film}, got {equilibrium.film}"
        )
    if sensor.surface != "middle" and not equilibrium.theory.bending:
        raise SensorError(
            f"surface {sensor.surface!r} needs bending, but the film was solved as a {equilibrium.theory.name}; solve "
            "it with SolveSettings(theory=theory_for(sensor, probe, (force, force)))"
        )
    # Integrate the stress at the points of all electrodes, which `touch_stress` expects in one list.
    readout = ReadoutPoints.of(sensor, DIRECT)
    n_electrode, n_point, _ = readout.points.shape
    flat_stress = touch_stress(equilibrium, readout.points.reshape(-1, 2), sensor.surface)
    charge = readout.charge(flat_stress.reshape(n_electrode, n_point, 3))

    # Add the charge of the contact pressure and the crosstalk.
    charge += contact_charge(sensor, equilibrium.probe, equilibrium.at, equilibrium.force)
    return sensor.calibration.read(charge)


def electrode_gaps(sensor: Sensor, position: Complexes) -> Array:
    """Compute the gaps between positions and the circles around the nearest parts of the electrodes.

    Args:
        sensor: Sensor with the electrodes.
        position: Positions x + iy, shape (n,), mm.

    Returns:
        Gaps, shape (n, n_electrode), mm. A gap is negative if the position lies in the circle.
    """
    gaps = []
    for part_centres, part_radii in sensor.part_circles:
        gap_of_parts = np.abs(position[:, None] - part_centres) - part_radii  # shape (n, n_part)
        gaps.append(gap_of_parts.min(axis=1))
    return np.stack(gaps, axis=1)


def electrode_distances(sensor: Sensor, position: Complexes) -> Array:
    """Compute the distances of positions from the nearest parts of the electrodes, in radii of the parts.

    Args:
        sensor: Sensor with the electrodes.
        position: Positions x + iy, shape (n,), mm.

    Returns:
        Distances from the centres of the parts, shape (n, n_electrode), dimensionless.
    """
    distances = []
    for part_centres, part_radii in sensor.part_circles:
        distance_of_parts = np.abs(position[:, None] - part_centres) / part_radii  # shape (n, n_part)
        distances.append(distance_of_parts.min(axis=1))
    return np.stack(distances, axis=1)


def contact_charge(sensor: Sensor, probe: Probe, at: tuple[float, float], force: float) -> Array:
    """Compute the charge that the contact pressure induces on the electrodes. The charge per area is d33 * mean(s33).

    The back of the film is free. Through the thickness, s33 changes from minus the contact pressure at the probe to
    zero at the back. The mean of s33 is therefore minus half of the contact pressure. Only the part of an electrode
    under the footprint contributes. The charge is therefore -d33 / 2 times the part of the force that acts on the
    electrode. The negative d33 of PVDF results in a positive charge.

    Args:
        sensor: The sensor.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.
        force: Force, N.

    Returns:
        Charges, shape (n_electrode,), pC.
    """
    if sensor.piezo.d33 == 0.0:
        return np.zeros(len(sensor.electrodes))
    position = complex(*at)  # x + iy
    force_shares = []  # fraction of the force that acts on each electrode
    for electrode, (part_centres, part_radii) in zip(sensor.electrodes, sensor.part_circles, strict=True):
        # Only parts whose enclosing circle meets the footprint can contribute.
        near_parts = np.flatnonzero(np.abs(position - part_centres) < part_radii + probe.reach)
        force_share = 0.0
        for part in near_parts:
            placed_corners = sensor.calibration.place(electrode.parts[part])
            force_share += probe.force_share(placed_corners, position)
        force_shares.append(force_share)
    return np.asarray(-0.5 * sensor.piezo.d33 * force * sensor.gains * np.array(force_shares))


def thermal_charge(sensor: Sensor, step: float) -> Array:
    """Compute the pyroelectric charge of a uniform change of the temperature.

    The clamp is assumed to expand like the film. If the clamp expands differently, the pretension of the film changes
    as well; see `mechanics.film_temperature`.

    Args:
        sensor: The sensor.
        step: Change of the temperature, K, positive for warming. Warming a PVDF film with d31 > 0 lowers the charge.

    Returns:
        Charges, shape (n_electrode,), pC, proportional to the areas of the electrodes.
    """
    areas = np.array([electrode.area for electrode in sensor.electrodes])
    return sensor.calibration.read(sensor.gains * areas * sensor.piezo.pyro * step)


def electrode_rule(electrode: Electrode, readout: Readout, per_side: int) -> tuple[Array, Array]:
    """Return the integration points of one electrode, and their shares of the mean stress.

    Args:
        electrode: The electrode.
        readout: Mean over the area of the electrode, or over its edges.
        per_side: Number of Gauss points per side.

    Returns:
        Points (x, y), shape (n, 2), mm. Weights of each point in the means of s11, s22 and s12, shape (n, 3).
    """
    if readout == "edge":
        return _edge_rule(electrode, per_side)
    return _area_rule(electrode, per_side)


def _area_rule(electrode: Electrode, per_side: int) -> tuple[Array, Array]:
    """Return the integration points for the mean of the stress over the area of an electrode.

    Args:
        electrode: The electrode.
        per_side: Number of points along a side of a square, or along the longest side of a part.

    Returns:
        Points (x, y), shape (n, 2), mm. Weights of each point in the means of s11, s22 and s12, shape (n, 3). The three
        weights of a point are equal.
    """
    if electrode.square:  # a product of one-dimensional Gauss rules
        unit_points, shares = gauss_square(per_side)
        lower_left, _, upper_right, _ = np.array(electrode.corners)
        points = lower_left + unit_points * (upper_right - lower_left)
    elif len(electrode.parts) == 1:
        points, shares = gauss_polygon(electrode.parts[0], per_side)
    else:  # an electrode of several quadrilaterals
        rules = [gauss_quadrilateral(part, per_side, MAX_PART_SIDE) for part in electrode.parts]
        points = np.concatenate([part_points for part_points, _ in rules])
        weights = np.concatenate([part_weights for _, part_weights in rules])
        shares = weights / weights.sum()
    return points, np.repeat(shares[:, None], 3, axis=1)


def _edge_rule(electrode: Electrode, per_side: int) -> tuple[Array, Array]:
    """Return the integration points of the edge readout (Mirbagheri et al., 2007, equation 3).

    The mean of s11 is over the left and right edges, and the mean of s22 is over the lower and upper edges.

    Args:
        electrode: A square electrode.
        per_side: Half of the number of points on each edge.

    Returns:
        Points (x, y), shape (n, 2), mm. Weights of each point in the means of s11, s22 and s12, shape (n, 3).
    """
    # The corners start at the lower left one and go anticlockwise, and so do the edges from each corner to the next.
    relative_position, line_shares = gauss_line(2 * per_side)  # from 0 at the start of an edge to 1 at its end
    corners = np.array(electrode.corners)
    edges = np.roll(corners, -1, axis=0) - corners
    edge_points = corners[:, None] + relative_position[:, None] * edges[:, None]  # shape (4, n_edge_point, 2)
    lower, right, upper, left = edge_points

    # Each mean is over two edges, so each edge contributes half of the mean. A row is (s11, s22, s12).
    half_shares = 0.5 * line_shares
    zero = np.zeros_like(line_shares)
    s11_shares = np.stack([half_shares, zero, zero], axis=1)
    s22_shares = np.stack([zero, half_shares, zero], axis=1)
    points = np.concatenate([left, right, lower, upper])
    return points, np.concatenate([s11_shares, s11_shares, s22_shares, s22_shares])
