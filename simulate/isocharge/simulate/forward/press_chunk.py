"""Computation of the charges of several presses, by integration of interpolated stress fields over the electrodes."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.forward.readout import ReadoutPoints
from isocharge.simulate.mechanics.stress import rotate_stress
from isocharge.simulate.mesh.placed_mesh import from_oval
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.point_location import locate_points
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.numerics.interpolation import tensor_values


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
        self, rules: tuple[tuple[ReadoutPoints, Booleans], ...], film_radius: float, is_odd: Booleans
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
