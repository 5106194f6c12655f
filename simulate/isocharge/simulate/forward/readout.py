"""Charge collected by an electrode on a stretched piezoelectric film.

The charge amplifiers hold the electrodes at virtual ground, so the electric field vanishes. An electrode of area A
collects only the polarisation caused by the in-plane stress (Mirbagheri et al., 2007, equation 2):

    Q = A * mean(d31 * s11 + d32 * s22).

The mid-surface stresses s11 and s22 refer to the axes of the film, and axis 1 is the drawn direction x. The area
readout computes the mean over the area of the electrode. The edge readout computes the mean of s11 over the left and
right edges, and the mean of s22 over the lower and upper edges (equation 3 of the paper). The touch charge is the
charge under load minus the charge without load. The charge of a uniform pretension therefore cancels.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.common.errors import SensorError
from isocharge.simulate.numerics.interpolation import gauss_line
from isocharge.simulate.numerics.polygon import gauss_quadrilateral
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import MAX_PART_SIDE, Electrode, Readout, Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium, touch_stress

DIRECT = 20
"""Number of Gauss points per side of an electrode for single presses.

The stress has a kink at the edge of the footprint. Even if this edge crosses an electrode, the relative error of the
charge is only 1e-5.
"""

FINE = 12
"""Number of Gauss points per side of an electrode near the probe, for many presses.

The relative error of the charge is 8e-5.
"""

COARSE = 4
"""Number of Gauss points per side of an electrode away from the probe, for many presses."""

NEAR = 1.0
"""Distance between the footprint and an electrode below which the fine rule is used, mm.

At larger distances, the relative error of the coarse rule is at most 1e-4 for square electrodes with sides of 1 to
6 mm.
"""


@dataclass(frozen=True)
class ReadoutPoints:
    """Integration points on the electrodes, and weights that convert the stress at these points into charges.

    Attributes:
        points: Points (x, y) on the film, shape (n_electrode, n_point, 2), mm.
        weights: Charge per stress (s11, s22, s12) at each point, shape (n_electrode, n_point, 3), pC/MPa.
        count: Number of points of each electrode, shape (n_electrode,). An electrode with fewer than n_point points is
            filled up with points of zero weight.
    """

    points: Array
    weights: Array
    count: Integers

    @classmethod
    def of(cls, sensor: Sensor, per_side: int) -> "ReadoutPoints":
        """Return the integration points on the electrodes of a sensor, with the weights of its readout.

        Args:
            sensor: Sensor with the electrodes, the readout, the gains and the piezoelectric coefficients.
            per_side: Number of Gauss points per side of an electrode.
        """
        nominal = layout_points(sensor.electrodes, sensor.readout, per_side)
        # The factor 2 accounts for s12 and s21, which contribute equally.
        charge_per_stress = np.array([sensor.piezo.d31, sensor.piezo.d32, 2.0 * sensor.piezo.d12])
        weights = sensor.gains[:, None, None] * nominal.weights * charge_per_stress
        return cls(sensor.calibration.place(nominal.points), weights, nominal.count)

    def charge(self, stress: Array) -> Array:
        """Compute charges from the stress at the points.

        Args:
            stress: Stress (s11, s22, s12), shape (..., n_electrode, n_point, 3), MPa.

        Returns:
            Charges, shape (..., n_electrode), pC.
        """
        # For each electrode (index e), sum over the points (p) and the stress components (c).
        return np.asarray(np.einsum("...epc,epc->...e", stress, self.weights))


@lru_cache(maxsize=32)
def layout_points(electrodes: tuple[Electrode, ...], readout: Readout, per_side: int) -> ReadoutPoints:
    """Return the integration points at the nominal positions of the electrodes, with areas as weights.

    The result is cached, because many films have the same layout.

    Args:
        electrodes: Electrodes of the layout.
        readout: "area" for a mean over the area of an electrode, "edge" for a mean over its edges.
        per_side: Number of Gauss points along a side of an electrode.

    Returns:
        Points, with weights that are the areas which the points represent, mm^2. An electrode with fewer points than
        others is filled up with points of zero area.
    """
    rules = [electrode_rule(electrode, readout, per_side) for electrode in electrodes]
    counts = np.array([len(shares) for _, shares in rules], dtype=np.intp)
    points = np.zeros((len(electrodes), counts.max(initial=0), 2))
    areas = np.zeros(
        (len(electrodes), counts.max(initial=0), 3)
    )  # an area for each component of the stress (s11, s22, s12)
    for index, electrode in enumerate(electrodes):
        electrode_points, shares = rules[index]
        n_point = counts[index]
        points[index, :n_point] = electrode_points
        # The shares are the weights of a mean over the electrode. They sum to 1 for each component of the stress.
        areas[index, :n_point] = electrode.area * shares
    return ReadoutPoints(points, areas, counts)


def touch_charge(sensor: Sensor, equilibrium: Equilibrium) -> Array:
    """Compute the touch charge of each electrode under a solved press.

    Args:
        sensor: Sensor whose film was solved.
        equilibrium: Equilibrium of the film under the press.

    Returns:
        Charges in the order of `sensor.electrode_names`, shape (n_electrode,), pC. Positive for tension along a
        direction with a positive coefficient.

    Raises:
        SensorError: If another film was solved, or if the readout is at an outer surface and the theory omits bending.
    """
    if sensor.film != equilibrium.film:
        raise SensorError(f"the equilibrium belongs to another film: expected {sensor.film}, got {equilibrium.film}")
    if sensor.surface != "middle" and not equilibrium.theory.bending:
        raise SensorError(
            f"surface {sensor.surface!r} needs bending, but the film was solved as a {equilibrium.theory.name}; solve "
            "it with SolveSettings(theory=Theory(bending=True))"
        )
    # Compute the stress at the integration points of all electrodes. `touch_stress` expects one list of points.
    readout = ReadoutPoints.of(sensor, DIRECT)
    n_electrode, n_point, _ = readout.points.shape
    flat_stress = touch_stress(equilibrium, readout.points.reshape(-1, 2), sensor.surface)
    charge = readout.charge(flat_stress.reshape(n_electrode, n_point, 3))

    # Add the charge of the contact pressure and the crosstalk.
    charge += contact_charge(sensor, equilibrium.probe, equilibrium.at, equilibrium.force)
    return sensor.calibration.read(charge)


def are_near(sensor: Sensor, probe: Probe, position: Complexes) -> Booleans:
    """Return whether each electrode is so near to each press that the fine integration rule is needed.

    Each part of an electrode is enclosed by a circle. The electrode is near if the distance between the footprint and
    one of these circles is less than `NEAR`.

    Args:
        sensor: Sensor with the electrodes.
        probe: Probe that presses the film.
        position: Positions x + iy of the presses, shape (n,), mm.

    Returns:
        Whether each electrode is near, shape (n, n_electrode).
    """
    smallest_gaps = []
    for part_centres, part_radii in sensor.part_circles:
        gap_of_parts = np.abs(position[:, None] - part_centres) - part_radii  # shape (n, n_part)
        smallest_gaps.append(gap_of_parts.min(axis=1))
    return np.asarray(np.stack(smallest_gaps, axis=1) < probe.reach + NEAR)


def contact_charge(sensor: Sensor, probe: Probe, at: tuple[float, float], force: float) -> Array:
    """Compute the charge that the contact pressure of a probe induces on the electrodes.

    The charge per area is the coefficient d33 times the mean of the stress s33 over the thickness. The stress s33 is
    minus the contact pressure at the probe, and zero at the free back of the film. The mean of s33 over the thickness
    is therefore minus half of the contact pressure. The charge of an electrode is therefore -d33 / 2 times the part of
    the force that acts on the electrode, times the gain of the electrode. The coefficient d33 of PVDF is negative, so
    the charge is positive.

    Args:
        sensor: Sensor with the electrodes.
        probe: Probe that presses the film.
        at: Centroid (x, y) of the footprint, mm.
        force: Force of the press, N.

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
    """Compute the pyroelectric charge that a uniform change of the temperature causes.

    The clamp is assumed to expand like the film. If the clamp expands differently, the pretension of the film also
    changes. The module `mechanics.film_temperature` computes the change of the pretension.

    Args:
        sensor: Sensor with the electrodes and the pyroelectric coefficient.
        step: Change of the temperature, K, positive if the film becomes warmer. The charge of a PVDF film with a
            positive coefficient d31 decreases if the film becomes warmer.

    Returns:
        Charges, shape (n_electrode,), pC. They are proportional to the areas of the electrodes.
    """
    areas = np.array([electrode.area for electrode in sensor.electrodes])
    return sensor.calibration.read(sensor.gains * areas * sensor.piezo.pyro * step)


def electrode_rule(electrode: Electrode, readout: Readout, per_side: int) -> tuple[Array, Array]:
    """Return the integration points of one electrode, and their weights in the mean stress of the electrode.

    Args:
        electrode: Electrode over which the mean is computed.
        readout: "area" for a mean over the area of the electrode, "edge" for a mean over its edges.
        per_side: Number of Gauss points along a side of the electrode.

    Returns:
        Points (x, y), shape (n, 2), mm. Weights of each point in the means of s11, s22 and s12, shape (n, 3).
    """
    if readout == "edge":
        return _edge_rule(electrode, per_side)
    return _area_rule(electrode, per_side)


def _area_rule(electrode: Electrode, per_side: int) -> tuple[Array, Array]:
    """Return the integration points and weights for the mean of the stress over the area of an electrode.

    Args:
        electrode: Electrode over which the mean is computed.
        per_side: Number of points along a side of a square, or along the longest side of a part.

    Returns:
        Points (x, y), shape (n, 2), mm. Weights of each point in the means of s11, s22 and s12, shape (n, 3). The three
        weights of a point are equal. The sum of each weight over all points is 1.
    """
    if len(electrode.parts) == 1:
        corners = electrode.parts[0]
        pieces = _quadrilaterals(corners)
        full_length = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min())
    else:  # sides that are shorter than the longest possible side have fewer points
        pieces = list(electrode.parts)
        full_length = MAX_PART_SIDE
    rules = [gauss_quadrilateral(piece, per_side, full_length) for piece in pieces]
    points = np.concatenate([piece_points for piece_points, _ in rules])
    weights = np.concatenate([piece_weights for _, piece_weights in rules])
    shares = weights / weights.sum()
    return points, np.repeat(shares[:, None], 3, axis=1)


def _quadrilaterals(corners: Array) -> list[Array]:
    """Divide a convex polygon into quadrilaterals, and possibly one triangle, that share the first corner.

    Args:
        corners: Corners (x, y), shape (n, 2), mm.
    """
    n_corner = len(corners)
    return [corners[[0, *range(second, min(second + 3, n_corner))]] for second in range(1, n_corner - 1, 2)]


def _edge_rule(electrode: Electrode, per_side: int) -> tuple[Array, Array]:
    """Return the integration points and weights of the edge readout (Mirbagheri et al., 2007, equation 3).

    The stress s11 is averaged over the left and right edges of the electrode. The stress s22 is averaged over the lower
    and upper edges of the electrode.

    Args:
        electrode: A square electrode.
        per_side: Half of the number of points on each edge.

    Returns:
        Points (x, y), shape (n, 2), mm. Weights of each point in the means of s11, s22 and s12, shape (n, 3). The
        weights in the mean of s12 are zero.
    """
    # The corners are listed anticlockwise from the lower left corner. Each edge leads from a corner to the next one, so
    # the first edge is the lower edge.
    relative_position, line_shares = gauss_line(2 * per_side)  # from 0 at the start of an edge to 1 at its end
    corners = np.array(electrode.corners)
    edges = np.roll(corners, -1, axis=0) - corners
    edge_points = corners[:, None] + relative_position[:, None] * edges[:, None]  # shape (4, n_edge_point, 2)
    lower, right, upper, left = edge_points

    # Each mean is over two edges, so each edge contributes half of the mean. The columns belong to s11, s22 and s12.
    half_shares = 0.5 * line_shares
    zero = np.zeros_like(line_shares)
    s11_shares = np.stack([half_shares, zero, zero], axis=1)
    s22_shares = np.stack([zero, half_shares, zero], axis=1)
    points = np.concatenate([left, right, lower, upper])
    return points, np.concatenate([s11_shares, s11_shares, s22_shares, s22_shares])
