"""Potential energy of the film under a load, with its first and second derivatives.

    Pi = stretching energy + bending energy + pressure energy - load * mean(W) - dot(side load, mean(U1, U2)).

The means are taken over the footprint and weighted with the pressure of the probe. The module `mechanics.back_pressure`
computes the pressure energy, which belongs to the pressure on the whole film.

The energy is a function of the scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3). Lengths are in units
of the film radius a. With the amplitude A of `isocharge.simulate.mechanics.scaling`, the displacements and the
Green-Lagrange strain are

    w = a A W,   u = a A^2 U,   E = A^2 [ sym grad U + grad W (x) grad W / 2 + A^2 (grad U)^T grad U / 2 ].

The expression in brackets is the scaled strain E', which is of order one for every force. The stress is that of
Saint-Venant-Kirchhoff elasticity in plane stress, S = E_young A^2 (C : E' + tau I). Energies are in units of E_young h
a^2 A^4. If the film is anisotropic, a matrix is added to C and a deviator to tau I (`scaling.Anisotropy`). The bending
stiffness of an anisotropic film is that of the isotropic film.
"""

from dataclasses import replace

import numpy as np
from scipy.sparse import diags_array
from scipy.sparse.linalg import SuperLU, splu

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.back_pressure import BackPressure
from isocharge.simulate.mechanics.scaling import DimensionlessGroups, scaled_stress
from isocharge.simulate.mechanics.stress import strain
from isocharge.simulate.mesh.placed_mesh import Geometry

COMPONENT_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Pairs of displacement components whose blocks of the tangent are computed. The other blocks follow by symmetry."""

SHIFT = 5.0
"""Shift s of the linear solves with bending; see `Bending`.

It must lie between 0 and 11.56, which is twice the lowest eigenvalue of the film.
"""


class ElasticFilm:
    """The film as a discrete elastic system, for one mesh and one set of dimensionless groups.

    Attributes:
        geometry: Elements of the mesh.
        groups: Dimensionless groups of the press.
        membrane: Stretching energy.
        bending: Bending energy; None if the theory omits bending.
        back: Energy of the pressure on the whole film; None if there is none.
    """

    def __init__(self, geometry: Geometry, groups: DimensionlessGroups) -> None:
        self.geometry = geometry
        self.groups = groups
        self.membrane = Membrane(geometry, groups)
        self.bending = Bending(geometry, groups.bending) if groups.bending > 0.0 else None
        self.back = BackPressure(geometry, groups) if groups.has_back_pressure else None

    @property
    def components(self) -> int:
        """Number of unknowns per node of the linear solves."""
        return 3 if self.bending is None else 4

    @property
    def has_side_load(self) -> bool:
        """Whether the force of the probe has a component in the plane of the film."""
        return self.groups.side_load != (0.0, 0.0)

    def energy(self, field: Array) -> float:
        """Compute the potential energy Pi of a field: the stored energy minus the work of the probe.

        Args:
            field: Scaled displacements (U1, U2, W), shape (n_node, 3).
        """
        in_plane = field[:, :2]
        deflection = field[:, 2]
        stored_energy = self.membrane.energy(field)
        if self.bending is not None:
            stored_energy += self.bending.energy(deflection)
        if self.back is not None:
            stored_energy += self.back.energy(deflection)
        work = self.groups.load * float(self.geometry.load @ deflection)
        if self.has_side_load:
            work += float(self.geometry.load @ in_plane @ np.array(self.groups.side_load))
        return stored_energy - work

    def residual(self, field: Array) -> Array:
        """Compute the gradient of Pi: internal minus external forces at the nodes.

        Args:
            field: Scaled displacements (U1, U2, W), shape (n_node, 3).

        Returns:
            Forces along (U1, U2, W), shape (n_node, 3).
        """
        deflection = field[:, 2]
        element_forces = self.membrane.forces(field)  # shape (n_element, n_local, 3)
        if self.bending is not None:
            element_forces[..., 2] += self.bending.forces(deflection)
        residual = np.stack([self.geometry.gather(element_forces[..., i]) for i in range(3)], axis=1)

        # Subtract the external forces: of the probe along W, of the pressure on the whole film, and of the probe in the
        # plane. `back.forces` is a derivative of the energy, so it already has the opposite sign.
        residual[:, 2] -= self.groups.load * self.geometry.load
        if self.back is not None:
            residual[:, 2] += self.back.forces(deflection)
        if self.has_side_load:
            residual[:, :2] -= np.outer(self.geometry.load, self.groups.side_load)
        return residual

    @property
    def load_scale(self) -> float:
        """Norm of the nodal forces of the probe, or of the static pressure if there is no probe."""
        if self.groups.load == 0.0 and self.back is not None:
            return abs(self.groups.static_pressure) * float(np.linalg.norm(self.back.weights))
        return self.groups.load * float(np.linalg.norm(self.geometry.load))

    def work(self, field: Array) -> float:
        """Compute the magnitude of the work of the probe, or of the static pressure if there is no probe.

        Args:
            field: Scaled displacements, shape (n_node, 3).
        """
        if self.groups.load == 0.0 and self.back is not None:
            return abs(self.back.static_work(field[:, 2]))
        return self.groups.load * abs(float(self.geometry.load @ field[:, 2]))

    def in_plane_scale(self, field: Array) -> float:
        """Compute the norm of the in-plane forces of the elements. The in-plane residual is divided by this norm.

        Args:
            field: Scaled displacements, shape (n_node, 3).
        """
        return float(np.linalg.norm(self.membrane.forces(field)[..., :2]))

    def tangent(self, field: Array, guard: float = 0.0) -> Array:
        """Compute the element matrices of the linear solve, without the stiffness of trapped air.

        The stiffness of trapped air couples all nodes, so `solver.tangent_factor` adds it separately.

        Args:
            field: Scaled displacements, shape (n_node, 3).
            guard: Additional tension, in units of E_young A^2.

        Returns:
            Element matrices, shape (n_element, n_local, components, n_local, components).
        """
        tangent = Membrane(self.geometry, self.groups.stiffened(guard)).tangent(field)
        if self.bending is None:
            return tangent
        return self.bending.extend(tangent)


class Membrane:
    """Stretching energy of the geometrically nonlinear membrane.

    The energy is integral( E' : C : E' / 2 + tau (tr E' - div U) ). The integral of div U over a clamped film is zero.
    The term div U is subtracted, because its rounding errors would dominate the other terms for a large pretension. Let
    F_ia = d_ia + A^2 U_i,a for i = 1, 2, and F_3a = W,a. The variation of E' is then sym(F_ia v_i,b) for all three
    components of a test displacement v. The strain and the stress are derived by Bonet and Wood (2008, chapters 3 and
    6), and the scaling by Schwerin (1929).
    """

    def __init__(self, geometry: Geometry, groups: DimensionlessGroups) -> None:
        """Store the mesh and the dimensionless groups of the film.

        Args:
            geometry: Integration rules of the elements.
            groups: Dimensionless groups of the press.
        """
        self.geometry = geometry
        self.groups = groups
        # Weights of the squares of the slopes of U1, U2 and W in the strain
        self._scale = np.array([groups.squared_amplitude, groups.squared_amplitude, 1.0])

    @property
    def _deviator(self) -> Array | None:
        """Difference between the pretension and its mean, over E_young A^2, shape (2, 2); None if isotropic."""
        return None if self.groups.anisotropy is None else _tensor(self.groups.anisotropy.tension)

    def _stress(self, elastic_strain: Array) -> Array:
        """Compute the stress C : E' of the film and its coat at the quadrature points, without the pretension.

        Args:
            elastic_strain: Scaled strain E' as (E11, E22, 2 E12), shape (n_element, n_point, 3).

        Returns:
            (S11, S22, S12), same shape.
        """
        elastic_stress = scaled_stress(elastic_strain, self.groups)
        if self.geometry.coat is not None:
            coated_elements, moduli = self.geometry.coat
            elastic_stress[coated_elements] += (moduli @ elastic_strain[coated_elements][..., None])[..., 0]
        return elastic_stress

    def _slope(self, field: Array) -> Array:
        """Compute the derivatives of (U1, U2, W) with respect to (X1, X2) at the quadrature points.

        Args:
            field: Scaled displacements, shape (n_node, 3).

        Returns:
            Derivatives, shape (n_element, n_point, 2, 3): the derivative, then the component.
        """
        slope = self.geometry.stacked @ field[self.geometry.nodes]
        return slope.reshape(*self.geometry.gradient.shape[:3], 3)

    def _stretch(self, slope: Array) -> Array:
        """Compute the scaled deformation gradient F = d_ia + A^2 U_i,a for i = 1, 2 and F_3a = W,a.

        Args:
            slope: d(U1, U2, W)/d(X1, X2), shape (..., 2, 3).

        Returns:
            F with the indices (..., a, i), shape (..., 2, 3).
        """
        stretch: Array = slope * self._scale
        stretch[..., 0, 0] += 1.0
        stretch[..., 1, 1] += 1.0
        return stretch

    def energy(self, field: Array) -> float:
        """Compute the stretching energy of a field: integral( E' : C : E' / 2 + tau (tr E' - div U) ).

        Here E' is the scaled strain, C the elasticity matrix, and tau the scaled pretension.

        Args:
            field: Scaled displacements (U1, U2, W), shape (n_node, 3).

        Returns:
            Energy of the meshed part of the film, dimensionless.
        """
        slope = self._slope(field)  # shape (n_element, n_point, 2, 3): the derivative, then the component
        elastic_strain = strain(slope, self.groups.squared_amplitude)
        energy_density = 0.5 * np.sum(elastic_strain * self._stress(elastic_strain), axis=-1)

        # tr E' - div U is half of the weighted sum of the squared slopes. If the pretension is not uniform in all
        # directions, its deviator adds a similar term.
        energy_density += 0.5 * self.groups.tension * np.sum(slope**2 @ self._scale, axis=-1)
        if self._deviator is not None:
            deviator_products = slope * (self._deviator @ slope)
            energy_density += 0.5 * np.sum(deviator_products @ self._scale, axis=-1)
        return float(np.sum(energy_density * self.geometry.weights))

    def forces(self, field: Array) -> Array:
        """Compute the internal forces of the elements, which are the gradient of the stretching energy.

        Args:
            field: Scaled displacements, shape (n_node, 3).

        Returns:
            Forces, shape (n_element, n_local, 3).
        """
        geometry = self.geometry
        slope = self._slope(field)
        elastic_stress = self._stress(strain(slope, self.groups.squared_amplitude))

        # Derivative of the energy density with respect to the slopes, shape (n_element, n_point, 2, 3)
        traction = _tensor(elastic_stress) @ self._stretch(slope)
        traction += self.groups.tension * self._scale * slope
        if self._deviator is not None:
            traction += self._scale * (self._deviator @ slope)

        # Integral over the elements, with the derivatives of the basis functions
        weighted_traction = traction * geometry.weights[..., None, None]
        transposed_gradient = geometry.stacked.transpose(0, 2, 1)
        return np.asarray(transposed_gradient @ weighted_traction.reshape(len(traction), -1, 3))

    def tangent(self, field: Array) -> Array:
        """Compute the second derivatives of the stretching energy of the elements.

        Args:
            field: Scaled displacements, shape (n_node, 3).

        Returns:
            Second derivatives, shape (n_element, n_local, 3, n_local, 3), symmetric under exchange of the two pairs of
            node and component.
        """
        geometry = self.geometry
        gradient = geometry.gradient
        slope = self._slope(field)
        stretch = self._stretch(slope)

        # Total stress (S11, S22, S12): the elastic stress, the mean pretension, and the deviator of the pretension.
        # It is multiplied by the integration weights.
        total_stress = self._stress(strain(slope, self.groups.squared_amplitude))
        total_stress[..., :2] += self.groups.tension
        if self.groups.anisotropy is not None:
            total_stress += self.groups.anisotropy.tension
        weighted_stress = _tensor(total_stress * geometry.weights[..., None])

        # One block for each pair (i, j) of displacement components: the material part, and for i = j the part of the
        # stress. The matrix is symmetric, so the blocks below the diagonal are transposed copies.
        n_element, _, _, n_local = gradient.shape
        transposed_gradient = np.ascontiguousarray(geometry.stacked.transpose(0, 2, 1))
        matrix = np.empty((n_element, 3, n_local, 3, n_local))
        for i, j in COMPONENT_PAIRS:
            block = self._moduli(stretch, i, j) * geometry.weights[..., None, None]
            if i == j:
                block += self._scale[i] * weighted_stress
            matrix[:, i, :, j] = transposed_gradient @ (block @ gradient).reshape(n_element, -1, n_local)
            if i != j:
                matrix[:, j, :, i] = matrix[:, i, :, j].transpose(0, 2, 1)
        return matrix.transpose(0, 2, 1, 4, 3)  # the node before the component

    def _moduli(self, stretch: Array, i: int, j: int) -> Array:
        """Compute the material part of d(traction_ia)/d(slope_jb) for a pair of displacement components.

        The result is the product B_i C B_j', where B_i is the derivative of the strain (E11, E22, 2 E12) with respect
        to the slopes of component i. For the isotropic elasticity matrix C, the product is written out.

        Args:
            stretch: F, shape (n_element, n_point, 2, 3).
            i: Displacement component of the traction, from 0 to 2.
            j: Displacement component of the slope, from 0 to 2.

        Returns:
            Second derivatives, shape (n_element, n_point, 2, 2), with the indices a and b.
        """
        # Isotropic film
        poisson = self.groups.poisson
        plane_modulus = 1.0 / (1.0 - poisson**2)
        shear_modulus = 0.5 / (1.0 + poisson)
        f_i1 = stretch[..., 0, i]
        f_i2 = stretch[..., 1, i]
        f_j1 = stretch[..., 0, j]
        f_j2 = stretch[..., 1, j]
        block = np.empty((*f_i1.shape, 2, 2))
        block[..., 0, 0] = plane_modulus * f_i1 * f_j1 + shear_modulus * f_i2 * f_j2
        block[..., 1, 1] = plane_modulus * f_i2 * f_j2 + shear_modulus * f_i1 * f_j1
        block[..., 0, 1] = plane_modulus * poisson * f_i1 * f_j2 + shear_modulus * f_i2 * f_j1
        block[..., 1, 0] = plane_modulus * poisson * f_i2 * f_j1 + shear_modulus * f_i1 * f_j2

        # Additional moduli of an orthotropic film and of a coat
        if self.groups.anisotropy is not None:
            i_derivative = _strain_derivative(f_i1, f_i2)
            j_derivative = _strain_derivative(f_j1, f_j2)
            block += i_derivative @ self.groups.anisotropy.moduli @ j_derivative.swapaxes(-1, -2)
        if self.geometry.coat is not None:
            coated_elements, moduli = self.geometry.coat
            i_derivative = _strain_derivative(f_i1[coated_elements], f_i2[coated_elements])
            j_derivative = _strain_derivative(f_j1[coated_elements], f_j2[coated_elements])
            block[coated_elements] += i_derivative @ moduli @ j_derivative.swapaxes(-1, -2)
        return block


class Bending:
    """Bending energy beta / 2 * integral( (lap W)^2 ) of a clamped film with the dimensionless stiffness beta.

    The elements are continuous, but their slopes are not. The Laplacian m = lap W is therefore defined weakly by

        integral( m phi ) = -integral( dot(grad W, grad phi) )   for every basis function phi.

    Since the basis functions on the rim are included, this definition also clamps the slope at the rim (Ciarlet and
    Raviart 1974). The integral on the left is lumped on the Gauss-Lobatto nodes. The result is m = -M^-1 L W with a
    diagonal matrix M. The energy is then beta / 2 W L^T M^-1 L W.

    The matrix of this energy couples elements that do not touch. The linear solves therefore have an additional unknown
    mu = sqrt(beta) M^-1 (L - s M) W, where s is a shift:

        [ K + beta (2 s L - s^2 M)    sqrt(beta) (L - s M)^T ] [W ]   [r]
        [ sqrt(beta) (L - s M)        -M                     ] [mu] = [0]

    The solution W does not depend on s, because the Schur complement is K + beta L^T M^-1 L for every s. The lowest
    eigenvalue of the film is 5.78. If s lies between 0 and twice this eigenvalue, the first block is positive definite
    even if K vanishes, as in a thick film without tension. The matrix is then quasi-definite and needs no pivoting
    (Vanderbei 1995).
    """

    def __init__(self, geometry: Geometry, stiffness: float) -> None:
        """Compute the matrices L and M of a mesh.

        Args:
            geometry: Integration rules of the elements.
            stiffness: Bending stiffness beta, dimensionless.
        """
        self.geometry = geometry
        self.stiffness = stiffness

        # Matrix L of each element, shape (n_element, n_local, n_local)
        weights = np.repeat(geometry.weights, 2, axis=1)[..., None]  # one weight for each of both derivatives
        self._laplace = geometry.stacked.transpose(0, 2, 1) @ (weights * geometry.stacked)

        # Diagonal of M at all nodes, including hanging nodes, and its factorisation if there are hanging nodes
        self._mass = replace(geometry, constraint=None).gather(geometry.mass)
        self._factor: SuperLU | None = None

    def laplacian(self, deflection: Array) -> Array:
        """Compute the Laplacian -M^-1 L W of the deflection W, where L W is the integral( dot(grad W, grad phi) ).

        The mass matrix M contains the integrals of products of basis functions phi, lumped on the nodes.

        Args:
            deflection: W at the nodes, shape (n_node,).

        Returns:
            lap W at the nodes, shape (n_node,).
        """
        element_values = (self._laplace @ deflection[self.geometry.nodes][..., None])[..., 0]
        weak_laplacian = self.geometry.gather(element_values)  # L W
        constraint = self.geometry.constraint
        if constraint is None:
            return np.asarray(-weak_laplacian / self._mass)

        # With hanging nodes, the mass matrix is not diagonal. It is factorised once.
        if self._factor is None:
            constrained_mass = constraint.T @ diags_array(self._mass) @ constraint
            is_hanging = constraint.diagonal() == 0.0
            unit_diagonal = diags_array(is_hanging.astype(float))  # the rows of hanging nodes would be zero otherwise
            self._factor = splu((constrained_mass + unit_diagonal).tocsc())
        return np.asarray(-(constraint @ self._factor.solve(weak_laplacian)))

    def energy(self, deflection: Array) -> float:
        """Compute the bending energy of a deflection W, shape (n_node,)."""
        return float(0.5 * self.stiffness * np.sum(self._mass * self.laplacian(deflection) ** 2))

    def forces(self, deflection: Array) -> Array:
        """Compute the internal forces of the elements, which are the gradient of the bending energy.

        Args:
            deflection: W at the nodes, shape (n_node,).

        Returns:
            Forces, shape (n_element, n_local).
        """
        laplacian = self.laplacian(deflection)[self.geometry.nodes]
        return np.asarray(-self.stiffness * (self._laplace @ laplacian[..., None])[..., 0])

    def extend(self, tangent: Array) -> Array:
        """Add bending to the element matrices K of the membrane.

        With the bending stiffness beta, the matrix L of the weak Laplacian, the diagonal mass matrix M and the shift s,
        the equations for W and for the auxiliary unknown mu are

            [ K + beta (2 s L - s^2 M)    sqrt(beta) (L - s M)^T ] [W ]   [r]
            [ sqrt(beta) (L - s M)        -M                     ] [mu] = [0].

        Args:
            tangent: Matrices for (U1, U2, W), shape (n_element, n_local, 3, n_local, 3).

        Returns:
            Matrices for (U1, U2, W, mu), shape (n_element, n_local, 4, n_local, 4).
        """
        n_element, n_local = self.geometry.nodes.shape
        mass = np.eye(n_local) * self.geometry.mass[:, None]  # M of each element, shape (n_element, n_local, n_local)
        coupling = np.sqrt(self.stiffness) * (self._laplace - SHIFT * mass)  # symmetric

        # Numbers of the unknowns of a node: 0 for U1, 1 for U2, 2 for W and 3 for mu. In memory, the values of one
        # unknown at all nodes of an element lie side by side.
        matrix = np.zeros((n_element, 4, n_local, 4, n_local)).transpose(0, 2, 1, 4, 3)
        matrix[:, :, :3, :, :3] = tangent
        matrix[:, :, 2, :, 2] += self.stiffness * (2.0 * SHIFT * self._laplace - SHIFT**2 * mass)
        matrix[:, :, 2, :, 3] = coupling
        matrix[:, :, 3, :, 2] = coupling
        matrix[:, :, 3, :, 3] = -mass
        return matrix


def _strain_derivative(f_i1: Array, f_i2: Array) -> Array:
    """Compute the derivatives of the strain with respect to the slopes U_i,1 and U_i,2 of one displacement component.

    Args:
        f_i1: Element F_i1 of the deformation gradient, shape (...).
        f_i2: Element F_i2 of the deformation gradient, shape (...).

    Returns:
        Derivatives of (E11, E22, 2 E12), shape (..., 2, 3), with one row for each slope.
    """
    derivative = np.zeros((*f_i1.shape, 2, 3))
    derivative[..., 0, 0] = f_i1  # d E11 / d U_i,1
    derivative[..., 1, 1] = f_i2  # d E22 / d U_i,2
    derivative[..., 0, 2] = f_i2  # d 2 E12 / d U_i,1
    derivative[..., 1, 2] = f_i1  # d 2 E12 / d U_i,2
    return derivative


def _tensor(stress: Array) -> Array:
    """Convert stresses (S11, S22, S12), shape (..., 3), into symmetric matrices, shape (..., 2, 2)."""
    return stress[..., [0, 2, 2, 1]].reshape(*stress.shape[:-1], 2, 2)
