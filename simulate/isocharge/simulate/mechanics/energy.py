"""The film's energy under a load: stretching, bending where the press needs it, and the probe's work.

    Pi = stretching + bending - load * mean of W over the footprint

as a function of the nodal field (U1, U2, W), shape (n_node, 3). Lengths are in units of the film's radius a, and with
an amplitude A (see `isocharge.simulate.mechanics.scaling`)

    w = a A W,   u = a A^2 U,   E = A^2 [ sym grad U + grad W (x) grad W / 2 + A^2 (grad U)^T grad U / 2 ],

so that the Green-Lagrange strain is A^2 times a number of order one whatever the force, and so is the stress: St.
Venant-Kirchhoff, plane stress, S = E_young A^2 (C : E' + tau I). Energies are in units of E_young h a^2 A^4. A film
that is not the same in all directions adds a matrix to C and a deviator to tau I (`scaling.Anisotropy`); its bending
keeps the mean stiffness.
"""

from dataclasses import replace

import numpy as np
from scipy.sparse import diags_array
from scipy.sparse.linalg import SuperLU, splu

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.scaling import DimensionlessGroups, scaled_stress
from isocharge.simulate.mechanics.stress import strain
from isocharge.simulate.mesh.placed_mesh import Geometry

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Pairs of displacement components whose tangent blocks are different."""

SHIFT = 5.0
"""Shift s of the linear solves with bending, dimensionless: between 0 and 11.56, twice the film's lowest eigenvalue."""


class ElasticFilm:
    """The discrete film for one geometry and one set of groups."""

    def __init__(self, geometry: Geometry, groups: DimensionlessGroups) -> None:
        self.geometry = geometry
        self.groups = groups
        self.membrane = Membrane(geometry, groups)
        self.bending = Bending(geometry, groups.bending) if groups.bending > 0.0 else None

    @property
    def components(self) -> int:
        """Unknowns per node of the linear solves."""
        return 3 if self.bending is None else 4

    def energy(self, field: Array) -> float:
        """Pi of a nodal field."""
        elastic = self.membrane.energy(field)
        if self.bending is not None:
            elastic += self.bending.energy(field[:, 2])
        return elastic - self.groups.load * float(self.geometry.load @ field[:, 2])

    def residual(self, field: Array) -> Array:
        """Gradient of Pi: internal minus external force on every node, shape (n_node, 3)."""
        forces = self.membrane.forces(field)
        if self.bending is not None:
            forces[..., 2] += self.bending.forces(field[:, 2])
        residual = np.stack([self.geometry.gather(forces[..., i]) for i in range(3)], axis=1)
        residual[:, 2] -= self.groups.load * self.geometry.load
        return residual

    def in_plane_scale(self, field: Array) -> float:
        """Norm of the in-plane forces before they balance: what their residual is to be compared with."""
        return float(np.linalg.norm(self.membrane.forces(field)[..., :2]))

    def tangent(self, field: Array, guard: float = 0.0) -> Array:
        """Element matrices of the linear solve, with some more tension as a guard.

        Shape (n_element, n_local, components, n_local, components).
        """
        tangent = Membrane(self.geometry, self.groups.stiffened(guard)).tangent(field)
        return tangent if self.bending is None else self.bending.extend(tangent)


class Membrane:
    """Stretching for one geometry and one set of groups: the geometrically nonlinear membrane.

    Its energy is integral( E' : C : E' / 2 + tau (tr E' - div U) ). The integral of div U over a clamped film is zero;
    left in, with a strong pretension its round-off would drown the others. F_ia = d_ia + A^2 U_i,a for i = 1, 2 and W,a
    for i = 3, so that the variation of E' is sym(F_ia v_i,b) for all three components alike.
    (Strain and stress: Bonet and Wood 2008, ch. 3 and 6; scaling: Schwerin 1929.)
    """

    def __init__(self, geometry: Geometry, groups: DimensionlessGroups) -> None:
        self.geometry = geometry
        self.groups = groups
        self._scale = np.array([groups.amplitude2, groups.amplitude2, 1.0])

    @property
    def _deviator(self) -> Array | None:
        """What the pretension adds to its mean, over E_young A^2, shape (2, 2)."""
        return None if self.groups.anisotropy is None else _tensor(self.groups.anisotropy.tension)

    def _stress(self, elastic: Array) -> Array:
        """C : E' of a strain at the quadrature points, shape (n_element, n_point, 3), that of a coat included."""
        borne = scaled_stress(elastic, self.groups)
        if self.geometry.coat is not None:
            stiffened, moduli = self.geometry.coat
            borne[stiffened] += (moduli @ elastic[stiffened][..., None])[..., 0]
        return borne

    def _slope(self, field: Array) -> Array:
        """d(U1, U2, W)/d(X1, X2) at the quadrature points, shape (n_element, n_point, 2, 3)."""
        slope = self.geometry.stacked @ field[self.geometry.nodes]
        return slope.reshape(*self.geometry.gradient.shape[:3], 3)

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
        density = 0.5 * np.sum(elastic * self._stress(elastic), axis=-1)
        density += 0.5 * self.groups.tension * np.sum(slope**2 @ self._scale, axis=-1)
        if self._deviator is not None:
            density += 0.5 * np.sum(slope * (self._deviator @ slope) @ self._scale, axis=-1)
        return float(np.sum(density * self.geometry.weights))

    def forces(self, field: Array) -> Array:
        """Gradient of the energy, element by element: internal forces, shape (n_element, n_local, 3)."""
        geometry, slope = self.geometry, self._slope(field)
        total = self._stress(strain(slope, self.groups.amplitude2))
        traction = _tensor(total) @ self._stretch(slope) + self.groups.tension * self._scale * slope
        if self._deviator is not None:
            traction += self._scale * (self._deviator @ slope)
        traction *= geometry.weights[..., None, None]
        return np.asarray(geometry.stacked.transpose(0, 2, 1) @ traction.reshape(len(traction), -1, 3))

    def tangent(self, field: Array) -> Array:
        """Second derivative of the energy, element by element.

        Returns:
            Shape (n_element, n_local, 3, n_local, 3): symmetric under exchange of the two (node, component) pairs.
        """
        geometry, gradient, slope = self.geometry, self.geometry.gradient, self._slope(field)
        stretch = self._stretch(slope)
        total = self._stress(strain(slope, self.groups.amplitude2))
        total[..., :2] += self.groups.tension
        if self.groups.anisotropy is not None:
            total += self.groups.anisotropy.tension
        weighted = _tensor(total * geometry.weights[..., None])
        n_element, _, _, n_local = gradient.shape
        left = np.ascontiguousarray(geometry.stacked.transpose(0, 2, 1))
        matrix = np.empty((n_element, 3, n_local, 3, n_local))
        for i, j in PAIRS:
            block = self._moduli(stretch, i, j) * geometry.weights[..., None, None]
            if i == j:
                block += self._scale[i] * weighted
            matrix[:, i, :, j] = left @ (block @ gradient).reshape(n_element, -1, n_local)
            if i != j:
                matrix[:, j, :, i] = matrix[:, i, :, j].transpose(0, 2, 1)
        return matrix.transpose(0, 2, 1, 4, 3)

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
        if self.groups.anisotropy is not None:
            block += _by_slope(a, b) @ self.groups.anisotropy.moduli @ _by_slope(c, d).swapaxes(-1, -2)
        if self.geometry.coat is not None:
            stiffened, moduli = self.geometry.coat
            left, right = _by_slope(a[stiffened], b[stiffened]), _by_slope(c[stiffened], d[stiffened])
            block[stiffened] += left @ moduli @ right.swapaxes(-1, -2)
        return block


class Bending:
    """Bending for one geometry and one stiffness beta: beta / 2 * integral( (lap W)^2 ), since the film is clamped.

    Elements are continuous but not smooth, so the Laplacian is taken weakly: m = lap W means

        integral( m phi ) = -integral( grad W . grad phi )   for every basis function phi, those on the rim included,

    which also clamps the slope at the rim (Ciarlet and Raviart 1974). With the left integral lumped on the
    Gauss-Lobatto nodes, m = -M^-1 L W with a diagonal M, and the energy is a plain function of W:
    beta / 2 W L^T M^-1 L W.

    That matrix couples elements that do not touch, so the linear solves carry m along as an unknown of its own. With
    any shift s, and mu = sqrt(beta) M^-1 (L - s M) W,

        [ K + beta (2 s L - s^2 M)    sqrt(beta) (L - s M)^T ] [W ]   [r]
        [ sqrt(beta) (L - s M)        -M                     ] [mu] = [0]

    is the same equation for W for every s: its Schur complement is K + beta L^T M^-1 L. A shift between 0 and twice the
    film's lowest eigenvalue, 5.78, makes the first block positive definite even where K vanishes (a thick film without
    tension), so the matrix is quasi-definite and needs no pivoting (Vanderbei 1995).
    """

    def __init__(self, geometry: Geometry, stiffness: float) -> None:
        self.geometry = geometry
        self.stiffness = stiffness
        weights = np.repeat(geometry.weights, 2, axis=1)[..., None]
        self._laplace = geometry.stacked.transpose(0, 2, 1) @ (weights * geometry.stacked)
        self._mass = replace(geometry, constraint=None).gather(geometry.mass)
        self._factor: SuperLU | None = None

    def laplacian(self, deflection: Array) -> Array:
        """lap W at the nodes, shape (n_node,), from W at the nodes."""
        weak = self.geometry.gather((self._laplace @ deflection[self.geometry.nodes][..., None])[..., 0])
        follow = self.geometry.constraint
        if follow is None:
            return np.asarray(-weak / self._mass)
        if self._factor is None:  # the mass of nodes that others follow is not quite diagonal
            hanging = diags_array((follow.diagonal() == 0.0).astype(float))
            self._factor = splu((follow.T @ diags_array(self._mass) @ follow + hanging).tocsc())
        return np.asarray(-(follow @ self._factor.solve(weak)))

    def energy(self, deflection: Array) -> float:
        """Bending energy of a nodal deflection, shape (n_node,)."""
        return float(0.5 * self.stiffness * np.sum(self._mass * self.laplacian(deflection) ** 2))

    def forces(self, deflection: Array) -> Array:
        """Gradient of the energy, element by element, shape (n_element, n_local)."""
        laplacian = self.laplacian(deflection)[self.geometry.nodes]
        return np.asarray(-self.stiffness * (self._laplace @ laplacian[..., None])[..., 0])

    def extend(self, tangent: Array) -> Array:
        """Element matrices over (U1, U2, W, mu) from those over (U1, U2, W).

        Shape (n_element, n_local, 4, n_local, 4).
        """
        n_element, n_local = self.geometry.nodes.shape
        matrix = np.zeros((n_element, 4, n_local, 4, n_local)).transpose(0, 2, 1, 4, 3)
        matrix[:, :, :3, :, :3] = tangent
        mass = np.eye(n_local) * self.geometry.mass[:, None]
        shifted = np.sqrt(self.stiffness) * (self._laplace - SHIFT * mass)
        matrix[:, :, 2, :, 2] += self.stiffness * (2.0 * SHIFT * self._laplace - SHIFT**2 * mass)
        matrix[:, :, 2, :, 3] = shifted
        matrix[:, :, 3, :, 2] = shifted
        matrix[:, :, 3, :, 3] = -mass
        return matrix


def _by_slope(one: Array, two: Array) -> Array:
    """d(E11, E22, 2 E12) / d(slope) of a component with this column of F, shape (..., 2, 3)."""
    by_slope = np.zeros((*one.shape, 2, 3))
    by_slope[..., 0, 0] = by_slope[..., 1, 2] = one
    by_slope[..., 1, 1] = by_slope[..., 0, 2] = two
    return by_slope


def _tensor(total: Array) -> Array:
    """(S11, S22, S12) as matrices, shape (..., 2, 2)."""
    return total[..., [0, 2, 2, 1]].reshape(*total.shape[:-1], 2, 2)
