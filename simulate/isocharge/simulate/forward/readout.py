"""Charge collected by an electrode on a stretched piezoelectric film.

The charge amplifiers hold the electrodes at virtual ground, so the electric field vanishes. An electrode of area A
collects only the polarisation caused by the in-plane stress (Mirbagheri et al., 2007, equation 2):

    Q = A * mean(d31 * s11 + d32 * s22).

The mid-surface stresses s11 and s22 refer to the axes of the film, and axis 1 is the drawn direction x. The area
readout computes the mean over the area of the electrode. The edge readout computes the mean of s11 over the left and
right edges, and the mean of s22 over the lower and upper edges (equation 3 of the paper). The touch charge is the
charge under load minus the charge without load. The charge of a uniform pretension therefore cancels.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.common.errors import SensorError
from isocharge.simulate.mechanics.stress import rotate_stress
from isocharge.simulate.mesh.placed_mesh import from_oval
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.point_location import locate_points
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.numerics.interpolation import gauss_line, tensor_values
from isocharge.simulate.numerics.polygon import gauss_quadrilateral
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import MAX_PART_SIDE, Electrode, Readout, Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium, touch_stress

DIRECT = 20
"""Number of Gauss points per side of an electrode for single presses.

The stress has a kink at the edge of the footprint. Even if this edge crosses an electrode, the relative error of the
charge is only 1e-5.
"""

GAUSS_RULES = ((1.4, 12), (np.inf, 4))
"""Integration rules of electrodes for many presses, in ascending order of the relative distance from the press.

Each rule consists of the relative distance below which it is used, and of the number of Gauss points per side of the
electrode. The function `relative_distances` computes the distances. The kink of the stress at the edge of the footprint
crosses only electrodes to which the first rule applies. The relative error of a charge is at most 1e-4.
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


def relative_distances(
    part_circles: Sequence[tuple[Complexes, Array]], probe_reach: float, position: Complexes
) -> Array:
    """Compute the distance between each press and each electrode.

    A distance is measured between the centres of the footprint and of a circle around a part of the electrode. The unit
    is the sum of the radii of the circles around the footprint and the part. The nearest part of an electrode counts.

    Args:
        part_circles: Centres x + iy and radii of the circles around the parts of each electrode, mm.
        probe_reach: Radius of the circle around the footprint, mm.
        position: Positions x + iy of the presses, shape (n,), mm.

    Returns:
        Distances, shape (n, n_electrode), dimensionless.
    """
    distances = np.empty((position.size, len(part_circles)))
    for index, (centres, radii) in enumerate(part_circles):
        distances[:, index] = (np.abs(position[:, None] - centres) / (radii + probe_reach)).min(axis=1)
    return distances


def pairs_by_rule(distances: Array) -> Iterator[tuple[int, Booleans]]:
    """Select one of the `GAUSS_RULES` for each pair of a press and an electrode.

    Args:
        distances: Relative distances, shape (n, n_electrode).

    Yields:
        The number of Gauss points per side of each rule, and an array that is True where a press and an electrode use
        the rule, shape (n, n_electrode).
    """
    smallest_distance = 0.0
    for largest_distance, per_side in GAUSS_RULES:
        yield per_side, (distances >= smallest_distance) & (distances < largest_distance)
        smallest_distance = largest_distance


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
    changes. The module `mechanics.stress` computes the change of the pretension.

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


@dataclass(frozen=True)
class PressMeshes:
    """Meshes under several presses.

    Attributes:
        template: Template of the meshes.
        placement: Position of the template under each press, after the press has been rotated onto the x axis.
        direction: Direction from the centre of the film to each press, shape (n,), rad.
        oval: Shape of an oval clamp, rotated with each press, shape (n,); see `mesh.placed_mesh.PlacedMesh`. Zero for a
            circular clamp.
    """

    template: Template
    placement: Placement
    direction: Array
    oval: Complexes

    def locate(self, press_index: Integers, points: Complexes) -> tuple[Integers, Array, Booleans]:
        """Find the elements that contain integration points, and evaluate the basis functions at the points.

        If only half of the film is meshed, points in the other half are reflected into the meshed half.

        Args:
            press_index: Index of the press of each pair, shape (n_pair,).
            points: Integration points x + iy, shape (n_pair, n_point), in film radii.

        Returns:
            Index of the element, shape (n_pair, n_point). Values of the basis functions, shape (n_pair, n_point,
            n_local). Whether each point was reflected, shape (n_pair, n_point).
        """
        # Rotate the film so that the press lies on the positive x axis.
        mesh = self.template
        rotated_points = points * np.exp(-1j * self.direction[press_index])[:, None]
        if self.oval.any():
            rotated_points = from_oval(rotated_points, self.oval[press_index, None])
        position, is_mirrored = mesh.into_meshed_half(rotated_points)
        element, xi, eta = locate_points(self.placement[press_index], mesh, position)
        basis_values = tensor_values(mesh.resolution.order, xi.ravel(), eta.ravel())
        return element, basis_values.reshape(*points.shape, mesh.xi.size), is_mirrored


@dataclass(frozen=True)
class PressChunk:
    """Stress fields under several presses, interpolated at the nodes of the mesh.

    Attributes:
        meshes: Meshes under the presses.
        field: Scaled stresses of all fields at the nodes of every element, shape (n, n_element * n_local * n_field *
            3), dimensionless. The values of all fields at one node are adjacent.
        frame_angle: Angle of axis 1 of the stress fields from the x axis, shape (n,), rad.
    """

    meshes: PressMeshes
    field: Array
    frame_angle: Array

    def charges_by_rules(
        self, rules: list[tuple[ReadoutPoints, Booleans]], film_radius: float, is_odd: Booleans
    ) -> Array:
        """Compute the charges of all electrodes under all presses, each with its integration rule.

        Args:
            rules: Pairs of an integration rule and an array, shape (n, n_electrode), that is True where a press and an
                electrode use this rule.
            film_radius: Radius of the film, mm.
            is_odd: Whether each field is odd, shape (n_field,); see `scaled_charges`.

        Returns:
            Charges divided by the unit of the scaled stress, shape (n, n_electrode, n_field), pC/MPa.
        """
        _, pairs_of_first_rule = rules[0]
        pairs_shape = pairs_of_first_rule.shape  # (n, n_electrode), the same for all rules
        scaled_charge = np.zeros((*pairs_shape, is_odd.size))
        for rule, uses_rule in rules:
            # Electrodes with the same number of points are integrated together, because their arrays have equal shapes.
            for n_point in np.unique(rule.count):
                press_index, electrode = np.nonzero(uses_rule & (rule.count == n_point))
                points_mm = rule.points[electrode, :n_point] @ np.array([1.0, 1j])  # (x, y) becomes x + iy
                points = points_mm / film_radius
                weights = rule.weights[electrode, :n_point]
                scaled_charge[press_index, electrode] = self.scaled_charges(press_index, points, weights, is_odd)
        return scaled_charge

    def scaled_charges(self, press_index: Integers, points: Complexes, weights: Array, is_odd: Booleans) -> Array:
        """Compute the charge of each pair of a press and an electrode, by integration of the stress fields.

        Args:
            press_index: Index of the press of each pair, shape (n_pair,).
            points: Integration points x + iy on the electrode of each pair, shape (n_pair, n_point), in film radii.
            weights: Charge per stress (s11, s22, s12) at each integration point, shape (n_pair, n_point, 3), pC/MPa.
            is_odd: Whether each field is odd, shape (n_field,). A reflection in the direction of the press leaves an
                even field unchanged, and changes the sign of an odd field.

        Returns:
            Charges divided by the unit of the scaled stress, shape (n_pair, n_field), pC/MPa.
        """
        stress, is_mirrored = self._interpolated_stress(press_index, points, is_odd.size)

        frame_angle = self.frame_angle[press_index]
        charge = np.empty((len(stress), is_odd.size))
        for field_index, is_field_odd in enumerate(is_odd):
            field_stress = stress[:, :, field_index]  # shape (n_pair, n_point, 3)
            # At reflected points, s12 of an even field changes its sign, and s11 and s22 of an odd field change theirs.
            reversed_components = slice(0, 2) if is_field_odd else slice(2, 3)
            field_stress[is_mirrored, reversed_components] *= -1.0
            film_stress = rotate_stress(field_stress, frame_angle[:, None])
            # For each pair (index k), sum over the points (p) and the stress components (c).
            charge[:, field_index] = np.einsum("kpc,kpc->k", film_stress, weights)
        return charge

    def _interpolated_stress(self, press_index: Integers, points: Complexes, n_field: int) -> tuple[Array, Booleans]:
        """Interpolate the stress of all fields from the nodes of the mesh to the integration points.

        Args:
            press_index: Index of the press of each pair, shape (n_pair,).
            points: Integration points x + iy, shape (n_pair, n_point), in film radii.
            n_field: Number of fields.

        Returns:
            Scaled stress (s11, s22, s12) in the frame of the mesh, shape (n_pair, n_point, n_field, 3), dimensionless.
            Whether each point was reflected, shape (n_pair, n_point).
        """
        element, basis_values, is_mirrored = self.meshes.locate(press_index, points)
        n_value = 3 * n_field  # number of values at a node
        field_by_element = self.field.reshape(len(self.field), self.meshes.template.n_element, -1, n_value)
        nodal_stress = field_by_element[press_index[:, None], element]  # shape (n_pair, n_point, n_local, n_value)
        stress = basis_values[..., None, :].astype(self.field.dtype) @ nodal_stress
        return stress.reshape(*points.shape, n_field, 3), is_mirrored
