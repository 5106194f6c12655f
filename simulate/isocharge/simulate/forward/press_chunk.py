"""Charges of several presses, computed by integration of the interpolated stress fields over the electrodes."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.mechanics.stress import rotate_stress
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.point_location import locate_points
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.numerics.interpolation import tensor_values


@dataclass(frozen=True)
class PressChunk:
    """Interpolated stress fields of some presses, from which charges are integrated.

    Attributes:
        mesh: Template of the mesh.
        placement: Position of the template under each press, with the press rotated onto the x axis.
        field: Scaled stress of all fields at the nodes of every element, shape (n, n_element * n_local * 3 * n_field).
        direction: Direction of each press from the centre of the film, shape (n,), rad.
        probe_angle: Angle of the probe relative to the direction of the press, shape (n,), rad. If the probe is not
            axisymmetric, the frame of its stress fields is rotated by this angle.
    """

    mesh: Template
    placement: Placement
    field: Array
    direction: Array
    probe_angle: Array

    def scaled_charges(self, press_index: Integers, points: Complexes, weights: Array, is_odd: Booleans) -> Array:
        """Integrate the charges of pairs of a press and an electrode.

        Args:
            press_index: Index of the press of each pair, shape (n_pair,).
            points: Integration points on the electrode of each pair, shape (n_pair, n_point), in film radii.
            weights: Charge per stress (s11, s22, s12), shape (n_pair, n_point, 3), pC/MPa.
            is_odd: Whether each field is odd, shape (n_field,). A reflection in the direction of the press leaves an
                even field unchanged, and changes the sign of an odd field.

        Returns:
            Charges over the unit of stress, shape (n_pair, n_field), pC/MPa.
        """
        stress, is_mirrored = self._interpolated_stress(press_index, points, is_odd.size)

        # The frame of the stress is rotated to the direction of the press. If the whole film is meshed, the frame also
        # rotates with the probe.
        frame_angle = self.direction[press_index]
        if not self.mesh.half:
            frame_angle = frame_angle + self.probe_angle[press_index]

        charge = np.empty((len(stress), is_odd.size))
        for field_index, odd in enumerate(is_odd):
            field_stress = stress[:, :, field_index]
            # Reflection changes the sign of s12 of an even field, and of s11 and s22 of an odd field.
            sign_changes = slice(0, 2) if odd else slice(2, 3)
            field_stress[is_mirrored, sign_changes] *= -1.0
            film_stress = rotate_stress(field_stress, frame_angle[:, None])
            # Sum over the points p and the stress components c of each pair k
            charge[:, field_index] = np.einsum("kpc,kpc->k", film_stress, weights)
        return charge

    def _interpolated_stress(self, press_index: Integers, points: Complexes, n_field: int) -> tuple[Array, Booleans]:
        """Interpolate the stress of all fields from the nodes of the mesh under each press to given points.

        If only half of the film is meshed, points of the other half are reflected into the meshed half.

        Args:
            press_index: Index of the press of each pair, shape (n_pair,).
            points: Points x + iy, shape (n_pair, n_point), in film radii.
            n_field: Number of fields.

        Returns:
            Stress (s11, s22, s12) in the frame of the mesh, shape (n_pair, n_point, n_field, 3). Whether each point was
            reflected, shape (n_pair, n_point).
        """
        # Find the points in the mesh after the press has been rotated onto the positive x axis.
        mesh = self.mesh
        rotated_points = points * np.exp(-1j * self.direction[press_index])[:, None]
        position, is_mirrored = mesh.into_meshed_half(rotated_points)
        element, xi, eta = locate_points(self.placement[press_index], mesh, position)

        # Interpolate the values of all fields from the nodes of the element of each point.
        n_value = 3 * n_field  # values at a node
        basis_values = tensor_values(mesh.resolution.order, xi.ravel(), eta.ravel()).astype(self.field.dtype)
        field_by_element = self.field.reshape(len(self.field), mesh.n_element, -1, n_value)
        nodal_stress = field_by_element[press_index[:, None], element]  # shape (n_pair, n_point, n_local, n_value)
        flat_stress = nodal_stress.reshape(*basis_values.shape, n_value)  # shape (n_pair * n_point, n_local, n_value)
        stress = np.matmul(basis_values[:, None, :], flat_stress)
        return stress.reshape(*position.shape, n_field, 3), is_mirrored
