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
            is_odd: Whether each field is odd about the direction of the press, shape (n_field,).

        Returns:
            Charges over the unit of stress, shape (n_pair, n_field), pC/MPa.
        """
        # Find the points in the mesh after the press has been rotated onto the positive x axis.
        mesh = self.mesh
        direction = self.direction[press_index]
        rotated_points = points * np.exp(-1j * direction)[:, None]
        position, is_mirrored = mesh.into_meshed_half(rotated_points)
        element, xi, eta = locate_points(self.placement[press_index], mesh, position)

        # Interpolate the three stress components of all fields from the nodes of the element of each point.
        n_component = 3 * is_odd.size
        basis_values = tensor_values(mesh.resolution.order, xi.ravel(), eta.ravel()).astype(self.field.dtype)
        # Shapes: (n_press, n_element, n_local, n_component), (n_pair * n_point, n_local, n_component), and
        # (n_pair, n_point, n_component).
        field_by_element = self.field.reshape(len(self.field), mesh.n_element, -1, n_component)
        nodal_stress = field_by_element[press_index[:, None], element].reshape(*basis_values.shape, n_component)
        stress = np.matmul(basis_values[:, None, :], nodal_stress).reshape(*position.shape, n_component)

        frame_angle = direction if mesh.half else direction + self.probe_angle[press_index]
        charge = np.empty((len(stress), is_odd.size))
        for field_index, odd in enumerate(is_odd):
            field_stress = stress[..., 3 * field_index : 3 * field_index + 3]
            # Reflection changes the sign of s12 of an even field, and of s11 and s22 of an odd field.
            sign_changes = slice(0, 2) if odd else slice(2, 3)
            field_stress[is_mirrored, sign_changes] *= -1.0
            film_stress = rotate_stress(field_stress, frame_angle[:, None])
            # Sum over the points p and the stress components c of each pair k
            charge[:, field_index] = np.einsum("kpc,kpc->k", film_stress, weights)
        return charge
