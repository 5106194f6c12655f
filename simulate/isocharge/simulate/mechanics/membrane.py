"""Stretching energy of the film, its residual and tangent: the geometrically nonlinear membrane, dimensionless.

Lengths are in units of the film's radius a. With an amplitude A (see `isocharge.simulate.mechanics.scaling`)

    w = a A W,   u = a A^2 U,   E = A^2 [ sym grad U + grad W (x) grad W / 2 + A^2 (grad U)^T grad U / 2 ],

the Green-Lagrange strain is A^2 times a number of order one whatever the force, and so is the stress: St. Venant-
Kirchhoff, plane stress, S = E_young A^2 (C : E' + tau I). The energy in units of E_young h a^2 A^4 is

    integral( E' : C : E' / 2 + tau (tr E' - div U) ).

The integral of div U over a clamped film is zero; left in, with a strong pretension its
round-off would drown the others.
(Strain and stress: Bonet and Wood 2008, ch. 3 and 6; scaling: Schwerin 1929.)

Field values are (U1, U2, W) per node, shape (n_node, 3). F_ia = d_ia + A^2 U_i,a for i = 1, 2 and W,a for i = 3, so
that the variation of E' is sym(F_ia v_i,b) for all three components alike.
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.mechanics.stress import strain, stress
from isocharge.simulate.mesh.elements import Geometry

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Pairs of displacement components whose tangent blocks are different."""


class Membrane:
    """The discrete membrane: functions of the nodal field for one geometry and one set of groups."""

    def __init__(self, geometry: Geometry, groups: DimensionlessGroups) -> None:
        self.geometry = geometry
        self.groups = groups
        self._scale = np.array([groups.amplitude2, groups.amplitude2, 1.0])

    def _slope(self, field: Array) -> Array:
        """d(U1, U2, W)/d(X1, X2) at the quadrature points, shape (n_element, n_point, 2, 3)."""
        gradient = self.geometry.gradient
        flat = gradient.reshape(gradient.shape[0], -1, gradient.shape[-1])
        return (flat @ field[self.geometry.nodes]).reshape(*gradient.shape[:3], 3)

    def _stretch(self, slope: Array) -> Array:
        """F with index (..., derivative, component)."""
        stretch: Array = slope * self._scale
        stretch[..., 0, 0] += 1.0
        stretch[..., 1, 1] += 1.0
        return stretch

    def energy(self, field: Array) -> float:
        """Stretching energy of a nodal field of shape (n_node, 3)."""
        slope = self._slope(field)
        elastic = strain(slope, self.groups.amplitude2)
        density = 0.5 * np.sum(elastic * stress(elastic, self.groups.poisson), axis=-1)
        density += 0.5 * self.groups.tension * np.sum(slope**2 @ self._scale, axis=-1)
        return float(np.sum(density * self.geometry.weights))

    def forces(self, field: Array) -> Array:
        """Gradient of the energy, element by element: internal forces, shape (n_element, n_local, 3)."""
        geometry, slope = self.geometry, self._slope(field)
        total = stress(strain(slope, self.groups.amplitude2), self.groups.poisson)
        traction = _tensor(total) @ self._stretch(slope) + self.groups.tension * self._scale * slope
        traction *= geometry.weights[..., None, None]
        flat = geometry.gradient.reshape(geometry.gradient.shape[0], -1, geometry.gradient.shape[-1])
        forces: Array = flat.transpose(0, 2, 1) @ traction.reshape(traction.shape[0], -1, 3)
        return forces

    def tangent(self, field: Array) -> Array:
        """Second derivative of the energy, element by element.

        Returns:
            Shape (n_element, n_local, 3, n_local, 3): symmetric under exchange of the two (node, component) pairs.
        """
        geometry, gradient, slope = self.geometry, self.geometry.gradient, self._slope(field)
        stretch = self._stretch(slope)
        total = stress(strain(slope, self.groups.amplitude2), self.groups.poisson)
        total[..., :2] += self.groups.tension
        weighted = _tensor(total * geometry.weights[..., None])
        n_element, _, _, n_local = gradient.shape
        left = np.ascontiguousarray(gradient.reshape(n_element, -1, n_local).transpose(0, 2, 1))
        matrix = np.empty((n_element, n_local, 3, n_local, 3))
        for i, j in PAIRS:
            block = self._moduli(stretch, i, j) * geometry.weights[..., None, None]
            if i == j:
                block += self._scale[i] * weighted
            right = block[..., 0, None] * gradient[:, :, None, 0] + block[..., 1, None] * gradient[:, :, None, 1]
            matrix[:, :, i, :, j] = left @ right.reshape(n_element, -1, n_local)
            if i != j:
                matrix[:, :, j, :, i] = matrix[:, :, i, :, j].transpose(0, 2, 1)
        return matrix

    def _moduli(self, stretch: Array, i: int, j: int) -> Array:
        """Material part of d(traction_ia)/d(slope_jb) for one pair of components, shape (n_element, n_point, 2, 2)."""
        poisson = self.groups.poisson
        plane, shear = 1.0 / (1.0 - poisson**2), 0.5 / (1.0 + poisson)
        a, b = stretch[..., 0, i], stretch[..., 1, i]
        c, d = stretch[..., 0, j], stretch[..., 1, j]
        block = np.empty((*a.shape, 2, 2))
        block[..., 0, 0] = plane * a * c + shear * b * d
        block[..., 1, 1] = plane * b * d + shear * a * c
        block[..., 0, 1] = plane * poisson * a * d + shear * b * c
        block[..., 1, 0] = plane * poisson * b * c + shear * a * d
        return block


def _tensor(total: Array) -> Array:
    """(S11, S22, S12) as matrices, shape (..., 2, 2)."""
    return total[..., [0, 2, 2, 1]].reshape(*total.shape[:-1], 2, 2)
