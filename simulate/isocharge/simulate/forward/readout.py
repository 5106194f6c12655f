"""Charge collected by an electrode on a stretched piezoelectric film.

The charge amplifiers hold the electrodes at virtual ground, so the electric field vanishes. An electrode of area A
collects only the polarisation caused by the in-plane stress (Mirbagheri et al., 2007, equation 2):

    Q = A * mean(d31 * s11 + d32 * s22).

The mid-surface stresses s11 and s22 refer to the axes of the film, and axis 1 is the drawn direction x. The area
readout computes the mean over the area of the electrode. The edge readout computes the mean of s11 over the left and
right edges, and the mean of s22 over the lower and upper edges (equation 3 of the paper). The touch charge is the
charge under load minus the charge without load. The charge of a uniform pretension therefore cancels.
"""

import cmath
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.common.errors import SensorError
from isocharge.simulate.mechanics.warming import tension_change
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.template import Template, locate_points
from isocharge.simulate.numerics.interpolation import tensor_values
from isocharge.simulate.numerics.polygon import (
    gauss_quadrilaterals,
    halve_quadrilaterals,
    to_complex,
    to_corners,
)
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.sensor import Electrode, Readout, Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium, touch_stress

DIRECT_COUNTS = (20, 8)
"""Numbers of Gauss points along a side of an electrode piece for single presses: (near piece, distant piece)."""

MAP_COUNTS = (12, 4)
"""Numbers of Gauss points along a side of an electrode piece for many presses: (near piece, distant piece).

The relative error of a charge is at most 1e-4.
"""

NEAR_DISTANCE = 1.4
"""Relative distance from the press below which a piece of an electrode is near; see `ElectrodePieces.rules`."""

NEAR_SIDE = 5.0
"""Longest side of a near piece of an electrode, in units of half the width of the footprint.

Half the width of a circle is its radius. The stress has a peak at the probe and a kink at the edge of the footprint.
With longer sides, the error of a charge exceeds 1e-4. With sides of 8 units, the error is 9e-4. With sides of 20 units
and 20 points, the error is 1e-3.
"""

NEAR_SURFACE_SIDE = 1.25
"""Longest side of a near piece if the stress is read at an outer surface, in units of half the width of the footprint.

The bending stress changes within a few bending lengths from the edge of the footprint. With sides of 5 units, the error
of a charge reaches 1.4e-3.
"""

RIM_SIDE = 8.0
"""Longest side of a piece in units of its distance from the rim, if the stress is read at an outer surface.

At the rim, the bending stress decreases within a few bending lengths, each of which exceeds the thickness of the film.
"""


STRESS_WEIGHTS = {"area": np.ones((1, 3)), "edge": np.eye(3)[:2]}
"""Weights of the stresses s11, s22 and s12 in the charges of each readout, with one row for each kind of piece.

The edge readout has two kinds of pieces: lines on the left and right edges, and lines on the lower and upper edges.
"""


def piece_charge_per_stress(sensor: Sensor) -> Array:
    """Return the charge density per stress (s11, s22, s12) for each kind of piece, shape (n_kind, 3), pC/N.

    Args:
        sensor: Sensor with the readout and the piezoelectric coefficients.
    """
    return STRESS_WEIGHTS[sensor.readout] * sensor.piezo.charge_per_stress


class PieceRule(NamedTuple):
    """Integration points for pairs of a press and a piece of an electrode.

    Attributes:
        press: Index of the press of each pair, shape (n_pair,).
        piece: Index of the piece of each pair in `ElectrodePieces`, shape (n_pair,). If a piece was halved, several
            pairs have the same press and piece.
        points: Points x + iy, shape (n_pair, n_point), mm.
        area: Area that each point represents, shape (n_pair, n_point), mm^2.
    """

    press: Integers
    piece: Integers
    points: Complexes
    area: Array


class Piece(NamedTuple):
    """Piece of an electrode: a quadrilateral for the area readout, or a line along an edge for the edge readout.

    Attributes:
        corners: Nominal corners (x, y), anticlockwise, shape (4, 2), mm; see `ElectrodePieces.corners`.
        line_area: Area that a line represents, mm^2. Zero for a quadrilateral.
        kind: Index of the row of `STRESS_WEIGHTS` that contains the weights of the piece.
    """

    corners: Array
    line_area: float
    kind: int


@dataclass(frozen=True)
class ElectrodePieces:
    """All pieces of the electrodes of a sensor: quadrilaterals that cover the electrodes, or lines along their edges.

    Attributes:
        corners: Corners x + iy of each piece, anticlockwise, shape (n_piece, 4), mm. In a triangle, the last two
            corners are equal. In a line, the first and the last corner are equal, and so are the second and the third.
        line_area: Area that a line represents, shape (n_piece,), mm^2. Zero for a quadrilateral.
        electrode: Index of the electrode to which each piece belongs, shape (n_piece,).
        kind: Index of the row of `STRESS_WEIGHTS` that contains the weights of each piece, shape (n_piece,).
        surface_film: Film whose stress is read at an outer surface; None if the stress is read in the middle of the
            film.
    """

    corners: Complexes
    line_area: Array
    electrode: Integers
    kind: Integers
    surface_film: Film | None = None

    @classmethod
    def covering(
        cls, electrodes: Sequence[Electrode], readout: Readout = "area", rotation: float = 0.0
    ) -> "ElectrodePieces":
        """Divide electrodes at their nominal positions into pieces: quadrilaterals, or the lines of the edge readout.

        Args:
            electrodes: Electrodes of a layout, at least one.
            readout: "area" for a mean over the area of an electrode, "edge" for a mean over its edges.
            rotation: Angle by which the electrodes are turned later, rad. The angle determines which edges count as
                left edges.
        """
        pieces_of = partial(_edge_lines, rotation=rotation) if readout == "edge" else _area_pieces
        pieces = [(index, piece) for index, electrode in enumerate(electrodes) for piece in pieces_of(electrode)]
        return cls(
            corners=to_complex(np.array([piece.corners for _, piece in pieces])),
            line_area=np.array([piece.line_area for _, piece in pieces]),
            electrode=np.array([index for index, _ in pieces]),
            kind=np.array([piece.kind for _, piece in pieces]),
        )

    @classmethod
    def of(cls, sensor: Sensor) -> "ElectrodePieces":
        """Return the pieces of the electrodes of a sensor at their calibrated positions.

        Args:
            sensor: Sensor with the electrodes, the readout and the calibration.
        """
        nominal = cls.covering(sensor.electrodes, sensor.readout, sensor.calibration.rotation)
        corners = to_complex(sensor.calibration.place(to_corners(nominal.corners)))
        surface_film = None if sensor.surface == "middle" else sensor.film
        return replace(nominal, corners=corners, surface_film=surface_film)

    def rules(self, probe: Probe, position: Complexes, counts: tuple[int, int] = MAP_COUNTS) -> Iterator[PieceRule]:
        """Compute the integration points of all pieces of the electrodes under several presses.

        Near a press, the stress changes strongly, so a near piece gets more integration points. One circle encloses the
        footprint, and another circle encloses the piece. The piece is near if the distance between the centres of the
        circles is less than `NEAR_DISTANCE` times the sum of their radii. A near piece is halved repeatedly until each
        part is distant or small. Each time, the longest side is halved. A part is small if its sides are at most
        `NEAR_SIDE` times half of the footprint width. If the stress is read at an outer surface, a near part must be
        smaller. A part beside the rim then also counts as near, and its sides are at most `RIM_SIDE` times its distance
        from the rim.

        Args:
            probe: Probe of the presses.
            position: Positions x + iy of the presses, shape (n,), mm.
            counts: Numbers of Gauss points along a side of a near piece and of a distant piece.

        Yields:
            Rules with the integration points of some pairs of a press and a piece. Together, the rules contain every
            pair.
        """
        # Four arrays describe the pairs of a press and a piece, or of a press and a part of a piece: both indices, the
        # corners, and the area (mm^2) that a line represents, which is zero for a quadrilateral. The first round has
        # all pairs. Each further round has the parts into which near pieces are divided.
        near_count, distant_count = counts
        film = self.surface_film  # None if the stress is read in the middle of the film, not at an outer surface
        near_side = (NEAR_SIDE if film is None else NEAR_SURFACE_SIDE) * probe.half_width
        press_index, piece_index = np.indices((position.size, len(self.corners))).reshape(2, -1)
        corners = self.corners[piece_index]
        line_area = self.line_area[piece_index]
        while press_index.size:
            centre = corners.mean(axis=1)
            radius = np.abs(corners - centre[:, None]).max(axis=1)
            is_near = np.abs(position[press_index] - centre) < NEAR_DISTANCE * (radius + probe.reach)
            sides = np.abs(np.roll(corners, -1, axis=1) - corners)
            longest_side = sides.max(axis=1)
            is_halved = is_near & (longest_side > near_side)
            if film is not None:
                rim_gap = film.radius * (1.0 - film.relative_distance(corners).max(axis=1))
                is_halved |= longest_side > RIM_SIDE * np.maximum(rim_gap, film.thickness)
                # This further condition gives a part beside the rim more points, but does not halve the part.
                is_near |= longest_side > 0.5 * rim_gap
            for count, is_selected in ((near_count, is_near & ~is_halved), (distant_count, ~is_near & ~is_halved)):
                # With longer chunks, the working arrays would exceed 100 MB.
                for chunk in _chunks(np.flatnonzero(is_selected), 50_000 // count**2):
                    points, area = gauss_quadrilaterals(corners[chunk], line_area[chunk], count)
                    yield PieceRule(press_index[chunk], piece_index[chunk], points, area)

            # Replace each halved part by its two halves.
            press_index = np.tile(press_index[is_halved], 2)
            piece_index = np.tile(piece_index[is_halved], 2)
            line_area = np.tile(0.5 * line_area[is_halved], 2)
            corners = halve_quadrilaterals(corners[is_halved])


def _chunks(indices: Integers, size: int) -> Iterator[Integers]:
    """Divide indices into chunks of a given size. The last chunk may be smaller."""
    for start in range(0, indices.size, size):
        yield indices[start : start + size]


def touch_charge(sensor: Sensor, equilibrium: Equilibrium) -> Array:
    """Compute the touch charge of each electrode under a solved press.

    Args:
        sensor: Sensor whose film was solved.
        equilibrium: Equilibrium of the film under the press.

    Returns:
        Charges in the order of `sensor.electrode_names`, shape (n_electrode,), pC. A tension along a direction with a
        positive coefficient causes a positive charge.

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
    contact = np.array([[*equilibrium.at, equilibrium.force]])
    (pressure_charge,) = contact_charges(sensor, equilibrium.probe, contact)
    # The charge has two parts, which the stress in the film and the contact pressure cause. `read` adds the crosstalk.
    return sensor.calibration.read(stress_charge(sensor, equilibrium) + pressure_charge)


def stress_charge(sensor: Sensor, equilibrium: Equilibrium, counts: tuple[int, int] = DIRECT_COUNTS) -> Array:
    """Compute the charge that the stress under a solved press causes, without crosstalk.

    The stress is integrated over pieces of the electrodes. Pieces near the probe get more integration points.

    Args:
        sensor: Sensor whose film was solved.
        equilibrium: Equilibrium of the film under the press.
        counts: Numbers of Gauss points along a side of a near piece and of a distant piece of an electrode.

    Returns:
        Charges, shape (n_electrode,), pC.
    """
    pieces = ElectrodePieces.of(sensor)
    charge_per_stress = piece_charge_per_stress(sensor)  # one row for each kind of piece
    charge = np.zeros(len(sensor.electrodes))
    # A rule contains the integration points and their areas for some pairs of the press and a piece.
    for rule in pieces.rules(equilibrium.probe, np.array([complex(*equilibrium.at)]), counts):
        # `touch_stress` expects one list of points.
        stress_of_points = touch_stress(equilibrium, to_corners(rule.points.ravel()), sensor.surface)
        stress = stress_of_points.reshape(*rule.points.shape, 3)  # shape (n_pair, n_point, 3)
        pair_charge_per_stress = charge_per_stress[pieces.kind[rule.piece]]  # shape (n_pair, 3)
        # Sum over the points (index p) and the stress components (c) of each pair of press and piece (k).
        pair_charge = np.einsum("kpc,kp,kc->k", stress, rule.area, pair_charge_per_stress)
        np.add.at(charge, pieces.electrode[rule.piece], pair_charge)
    return sensor.gains * charge


def contact_charges(sensor: Sensor, probe: Probe, contact: Array, orientation: Array | float = 0.0) -> Array:
    """Compute the charges that the contact pressure of a probe induces on the electrodes.

    The charge per area is the coefficient d33 times the mean of the stress s33 over the thickness. The stress s33 is
    minus the contact pressure at the probe, and zero at the free back of the film. Its mean over the thickness is
    minus half of the contact pressure. The charge of an electrode is therefore -d33 / 2 times the part of the force
    that acts on the electrode, times the gain. The coefficient d33 of PVDF is negative, so the charge is positive.

    Args:
        sensor: Sensor with the electrodes.
        probe: Probe that presses the film.
        contact: Presses (x, y, F), shape (n, 3), mm and N.
        orientation: Rotation of the probe in addition to its own orientation, shape (n,) or a number, rad.

    Returns:
        Charges without crosstalk, shape (n, n_electrode), pC.
    """
    force_shares = np.zeros((len(contact), len(sensor.electrodes)))  # fraction of the force that acts on each electrode
    if sensor.piezo.d33 == 0.0 or not len(contact):
        return force_shares  # all shares are zero, and so are all charges
    position = contact[:, :2]
    force = contact[:, 2]
    rotation = np.broadcast_to(orientation, len(contact))
    largest_reach = probe.under(float(force.max())).reach
    for electrode_index, electrode in enumerate(sensor.electrodes):
        for part in electrode.collecting_polygons:
            corners = sensor.calibration.place(part)
            centre = corners.mean(axis=0)
            part_radius = np.linalg.norm(corners - centre, axis=1).max()
            # Only presses whose footprint meets the circle around the part can contribute.
            is_near = np.linalg.norm(position - centre, axis=1) < part_radius + largest_reach
            for press in np.flatnonzero(is_near):
                pressed_probe = probe.under(float(force[press])).rotated(float(rotation[press]))
                force_shares[press, electrode_index] += pressed_probe.force_share(corners, complex(*position[press]))
    return -0.5 * sensor.piezo.d33 * force[:, None] * sensor.gains * force_shares


def thermal_charge(sensor: Sensor, step: float) -> Array:
    """Compute the charge that a uniform temperature change of the film causes without a touch.

    The charge contains the pyroelectric charge of a free film. If the film has expansion coefficients, its pretension
    changes as well, because the temperature of the ring remains constant. The charge that this change causes is added.
    The result does not contain the change of the stress that a static pressure causes.

    Args:
        sensor: Sensor with the electrodes, the film and its coefficients.
        step: Change of the temperature, K, positive if the film becomes warmer. The charge of a PVDF film with a
            positive coefficient d31 decreases if the film becomes warmer.

    Returns:
        Charges, shape (n_electrode,), pC. They are proportional to the areas of the electrodes.
    """
    areas = np.array([electrode.area for electrode in sensor.electrodes])
    charge_per_stress = piece_charge_per_stress(sensor).sum(axis=0)  # an electrode has pieces of each kind
    tension_charge = charge_per_stress @ tension_change(sensor.film, step, 0.0)  # pC/mm^2
    return sensor.calibration.read(sensor.gains * areas * (sensor.piezo.pyro * step + tension_charge))


def _area_pieces(electrode: Electrode) -> Iterator[Piece]:
    """Divide the area of an electrode into quadrilaterals, and yield them one after the other.

    All pieces have the kind 0, because the area readout has only one kind. Their `line_area` is zero, because only a
    line needs a separate area.

    Args:
        electrode: Electrode over whose area the stress is averaged.
    """
    for polygon in electrode.collecting_polygons:
        # Divide the convex polygon into quadrilaterals that share its first corner. If the number of its corners is
        # odd, the last quadrilateral is a triangle, whose last corner is repeated.
        last = len(polygon) - 1
        for second in range(1, last, 2):
            third = second + 1
            fourth = min(second + 2, last)
            yield Piece(polygon[[0, second, third, fourth]], line_area=0.0, kind=0)


def _edge_lines(electrode: Electrode, rotation: float) -> Iterator[Piece]:
    """Yield the lines of the edge readout (Mirbagheri et al., 2007, equation 3).

    The charge is the area of the electrode times the sum d31 mean(s11) + d32 mean(s22). The stress s11 is averaged over
    the left and right edges of the rotated electrode, and the stress s22 over its lower and upper edges. Each edge is
    divided into two lines, because the fixed number of integration points on a line would be too small for a whole
    edge.

    Args:
        electrode: A square electrode.
        rotation: Angle by which the electrode is rotated, rad.

    Yields:
        A line as a quadrilateral without width. Its corners are the first end, twice the last end, and the first end
        again.
    """
    line_area = 0.25 * electrode.area  # each mean is over two edges, so four lines represent the whole area
    corners = np.array(electrode.corners)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        middle = 0.5 * (start + end)
        rotated_edge = complex(*(end - start)) * cmath.rect(1.0, rotation)
        is_horizontal = abs(rotated_edge.real) > abs(rotated_edge.imag)
        # The kind selects the stress: 0 for s11 on the left and right edges, 1 for s22 on the lower and upper edges.
        kind = 1 if is_horizontal else 0
        for first, last in ((start, middle), (middle, end)):
            yield Piece(np.array([first, last, last, first]), line_area, kind)


@dataclass(frozen=True)
class ChargeDensity:
    """Charge per area that several presses cause, at the nodes of the mesh under each press.

    Attributes:
        position: Positions x + iy of the presses, shape (n,), mm.
        probe: Probe of the presses.
        film_radius: Radius of the film, mm.
        template: Template of the meshes.
        placement: Position of the template under each press, after the press has been rotated onto the x axis.
        values: Charge per area that each stress field causes, shape (n_sign, n_kind, n, n_element, n_local, n_field),
            pC/mm^2. The first entry of the first axis is for points of the meshed part of the film. If only half of the
            film is meshed, a second entry is for points that are reflected into the meshed half. The second axis is the
            kind of a piece; see `STRESS_WEIGHTS`.
    """

    position: Complexes
    probe: Probe
    film_radius: float
    template: Template
    placement: Placement
    values: np.ndarray

    def integrate(self, pieces: ElectrodePieces) -> Array:
        """Integrate the charge per area over electrodes, and return the charges of the electrodes.

        Each electrode consists of pieces. The integral over a piece is a sum over integration points. At a point, the
        charge per area is interpolated between the nodes of the element that contains the point. If only half of the
        film is meshed, points in the other half are reflected into the meshed half. Positions are complex numbers
        x + iy.

        Args:
            pieces: Pieces of the electrodes.

        Returns:
            Charges without gains and crosstalk under n presses, shape (n, n_electrode, n_field), pC.
        """
        n_field = self.values.shape[-1]
        charge = np.zeros((self.position.size, pieces.electrode.max() + 1, n_field))
        # The mesh is made for a press on the x axis, in units of the radius of the film. This factor rotates and scales
        # a film point (x + iy) to the coordinates of the mesh under each press, shape (n,).
        rotation_and_scale = np.exp(-1j * np.angle(self.position)) / self.film_radius

        # A rule contains the integration points and their areas, shape (n_pair, n_point), of some pairs of a press and
        # a piece, and the indices of the press and of the piece of each pair, shape (n_pair,).
        for rule in pieces.rules(self.probe, self.position):
            press_index = rule.press[:, None]  # shape (n_pair, 1): the same press for all points of a pair
            piece_index = rule.piece[:, None]

            # Find the element of each point. All four arrays have the shape (n_pair, n_point).
            points = rule.points * rotation_and_scale[press_index]
            element, xi, eta, is_reflected = locate_points(self.placement[rule.press], self.template, points)

            # Select the charge per area at the nodes of the element of each point. The axes of `values` are the side
            # (0: meshed half, 1: reflected half), the kind of the piece, the press, the element, the node, and the
            # field. The arrays of indices are broadcast with each other, so the selection has the shape (n_pair,
            # n_point, n_local, n_field).
            side_index = is_reflected.astype(np.intp)
            nodal_density = self.values[side_index, pieces.kind[piece_index], press_index, element]

            # The weight of a node in the integral is the area of the point times the basis function of the node.
            basis_values = tensor_values(self.template.resolution.order, xi.ravel(), eta.ravel())
            node_weights = rule.area.reshape(-1, 1) * basis_values  # shape (n_pair * n_point, n_local)

            # For each pair, sum over its points and over the nodes of their elements, which are combined in one axis.
            # Then add the charge of the piece to the charge of its electrode.
            n_pair = len(press_index)
            pair_density = nodal_density.reshape(n_pair, -1, n_field)  # shape (n_pair, n_point * n_local, n_field)
            pair_weights = node_weights.reshape(n_pair, 1, -1).astype(pair_density.dtype)
            pair_charge = pair_weights @ pair_density  # shape (n_pair, 1, n_field)
            np.add.at(charge, (rule.press, pieces.electrode[rule.piece]), pair_charge[:, 0])
        return charge
