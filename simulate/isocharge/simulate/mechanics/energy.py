"""Potential energy of the film under a load, and its first and second derivatives.

The potential energy of the film is

    Pi = stretching energy + bending energy + pressure energy - load * mean(W) - dot(side load, mean(U1, U2)).

Here, W is the deflection, and U1 and U2 are the displacements in the plane. The function mean(...) averages over the
footprint of the probe, with the pressure of the probe as the weight. The class `ElasticFilm` computes the potential
energy from the energies that the classes `Membrane`, `Bending` and `BackPressure` compute. The pressure energy has two
parts: the energy of a static pressure and the energy of trapped air.

The energy is a function of the scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3). Lengths are in units
of the film radius a. The displacements w and u, and the Green-Lagrange strain E, are

    w = a A W,   u = a A^2 U,   E = A^2 [ sym grad U + grad W (x) grad W / 2 + A^2 (grad U)^T grad U / 2 ],

where A is the amplitude of the press, which the module `mechanics.theory` computes. The expression in brackets is the
scaled strain E'. The scaled strain is of order one for every force.

The stress follows from Saint-Venant-Kirchhoff elasticity in plane stress as S = E_young A^2 (C : E' + tau I). Here, C
is the elasticity matrix divided by Young's modulus, tau is the scaled pretension, and I is the unit tensor. Energies
are in units of E_young h a^2 A^4, where h is the thickness of the film. If the pretension is uneven, the difference
between the pretension and its mean is added to tau I (see `theory.DimensionlessGroups`). The bending stiffness of an
orthotropic film is averaged over all directions.
"""

from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.back_pressure import BackPressure
from isocharge.simulate.mechanics.theory import DimensionlessGroups, strain
from isocharge.simulate.mesh.placed_mesh import PlacedMesh


class ElasticFilm:
    """Discrete elastic model of the film for a given mesh and given dimensionless groups.

    Attributes:
        mesh: Mesh of the press.
        groups: Dimensionless groups of the press.
        membrane: Stretching energy.
        bending: Bending energy; None if the theory omits bending.
        back_pressure: Energy of the pressure on the whole film; None without static pressure and trapped air.
        probe_force: Force of the probe along (U1, U2, W) at each node, shape (n_node, 3).
    """

    def __init__(self, mesh: PlacedMesh, groups: DimensionlessGroups) -> None:
        """Create one object for each part of the potential energy: stretching, bending and back pressure.

        Args:
            mesh: Mesh of the press.
            groups: Dimensionless groups of the press, such as its load and the bending stiffness of the film.
        """
        self.mesh = mesh
        self.groups = groups
        self.membrane = Membrane(mesh, groups)
        self.bending = Bending(mesh, groups.bending) if groups.bending > 0.0 else None
        has_back_pressure = groups.static_pressure != 0.0 or groups.compression != 0.0
        self.back_pressure = BackPressure(mesh, groups) if has_back_pressure else None

        # `mesh.load` is the share of each node in the force. Each share is multiplied by the force along U1, U2 and W.
        self.probe_force = np.outer(mesh.load, [*groups.side_load, groups.load])

    @property
    def unknowns_per_node(self) -> int:
        """Number of unknowns per node in the linear solves: 3, or 4 if bending adds an auxiliary unknown."""
        return 3 if self.bending is None else 4

    def energy(self, field: Array) -> float:
        """Compute the potential energy of a field as the stored energy minus the work of the probe.

        Args:
            field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
        """
        deflection = field[:, 2]
        stored_energy = self.membrane.energy(field)
        if self.bending is not None:
            stored_energy += self.bending.energy(deflection)
        if self.back_pressure is not None:
            stored_energy += self.back_pressure.energy(deflection)
        return stored_energy - float(np.sum(self.probe_force * field))

    def residual(self, field: Array) -> Array:
        """Compute the gradient of the potential energy: the internal force minus the external force at each node.

        Args:
            field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).

        Returns:
            Forces along (U1, U2, W), shape (n_node, 3).
        """
        return self.out_of_balance(field, self.element_forces(field))

    def element_forces(self, field: Array) -> Array:
        """Compute the internal forces of the elements, shape (n_element, n_local, 3).

        Args:
            field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
        """
        element_forces = self.membrane.forces(field)
        if self.bending is not None:
            element_forces[..., 2] += self.bending.forces(field[:, 2])
        return element_forces

    def out_of_balance(self, field: Array, element_forces: Array) -> Array:
        """Sum the internal forces of the elements at each node, and subtract the external force.

        Args:
            field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
            element_forces: Internal forces of the elements, shape (n_element, n_local, 3).

        Returns:
            Internal minus external forces along (U1, U2, W), shape (n_node, 3).
        """
        residual = np.stack([self.mesh.gather(element_forces[..., i]) for i in range(3)], axis=1)
        residual -= self.probe_force

        # The forces of the back pressure are derivatives of the energy like the internal forces, so they are added.
        if self.back_pressure is not None:
            residual[:, 2] += self.back_pressure.forces(field[:, 2])
        return residual

    @property
    def load(self) -> Array:
        """Magnitude of the load at each node, shape (n_node,).

        The load is the force of the probe. Without a probe, the load is the force of the static pressure.
        """
        if self.back_pressure is None or self.groups.load != 0.0:
            return self.probe_force[:, 2]
        return abs(self.groups.static_pressure) * self.back_pressure.weights

    def tangent(self, field: Array, added_tension: float = 0.0) -> Array:
        """Compute the tangent matrix of each element, without the stiffness of trapped air.

        The stiffness of trapped air couples all nodes of the mesh. Therefore `solver.assembly` adds the stiffness of
        trapped air separately.

        Args:
            field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
            added_tension: Tension that is added to the pretension, in units of E_young A^2.

        Returns:
            Element matrices, shape (n_element, n_unknown, n_local, n_unknown, n_local), where n_unknown is
            `unknowns_per_node`.
        """
        tangent = self.membrane.tangent(field, added_tension, self.unknowns_per_node)
        if self.bending is not None:
            self.bending.extend(tangent)
        return tangent


EQUAL_TENSION = np.array([1.0, 1.0, 0.0])
"""Stress (T11, T22, T12) that corresponds to a tension of one in every direction."""


class Membrane:
    """Stretching energy of a geometrically nonlinear membrane.

    The energy is integral( E' : C : E' / 2 + tau (tr E' - div U) ), where E' is the scaled strain, C is the elasticity
    matrix, tau is the scaled pretension and U is the in-plane displacement. The integral of div U over a clamped film
    is zero. However, the rounding errors of div U would exceed all other terms if the pretension is large. The formula
    therefore subtracts div U from tr E'.

    The scaled deformation gradient F has the components F_ia = d_ia + A^2 U_i,a for i = 1, 2, and F_3a = W,a. The
    symbol d_ia is the Kronecker delta, and an index after a comma denotes a derivative. If v is a test displacement
    with three components, the variation of the strain E' is sym(F_ia v_i,b), summed over i.

    Bonet and Wood (2008, chapters 3 and 6) derive the strain and the stress. Schwerin (1929) derives the scaling.
    """

    def __init__(self, mesh: PlacedMesh, groups: DimensionlessGroups) -> None:
        """Store the mesh and the dimensionless groups of the film.

        Args:
            mesh: Mesh of the press.
            groups: Dimensionless groups of the press.
        """
        self.mesh = mesh
        self.groups = groups
        # Factors of the squared slopes of U1, U2 and W in the strain: (A^2, A^2, 1) with the amplitude A of the press
        self._slope_factors = np.array([groups.squared_amplitude, groups.squared_amplitude, 1.0])
        # Pretension in units of E_young A^2, as stress (T11, T22, T12) and as a symmetric matrix
        self._pretension = groups.tension * EQUAL_TENSION + groups.uneven_tension
        self._pretension_matrix = _symmetric_matrix(self._pretension)

    def _slopes(self, field: Array) -> Array:
        """Compute the derivatives of (U1, U2, W) with respect to (X1, X2) at the quadrature points.

        Args:
            field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).

        Returns:
            Derivatives, shape (n_element, n_point, 2, 3). The last two axes are the coordinate and the displacement
            component.
        """
        mesh = self.mesh
        n_element, n_point, _, _ = mesh.gauss_gradient.shape
        slopes = mesh.stacked_gradient @ field[mesh.template.nodes]  # shape (n_element, n_point * 2, 3)
        return slopes.reshape(n_element, n_point, 2, 3)

    def _deformation_gradient(self, slopes: Array) -> Array:
        """Compute the scaled deformation gradient F.

        The components are F_ia = d_ia + A^2 U_i,a for i = 1, 2, and F_3a = W,a, where d_ia is the Kronecker delta.

        Args:
            slopes: Derivatives of (U1, U2, W) with respect to (X1, X2), shape (..., 2, 3).

        Returns:
            Components F_ia, shape (..., 2, 3). The last two axes are the indices a and i.
        """
        deformation: Array = slopes * self._slope_factors
        deformation[..., 0, 0] += 1.0
        deformation[..., 1, 1] += 1.0
        return deformation

    def energy(self, field: Array) -> float:
        """Compute the stretching energy of a field as the integral of two energy densities.

        The elastic energy density is E' : C : E' / 2, where E' is the scaled strain and C is the elasticity matrix. The
        energy density of the pretension T is T : (E' - sym grad U), where U is the in-plane displacement. The colon
        denotes the sum of the products of corresponding components.

        Args:
            field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).

        Returns:
            Energy of the meshed part of the film, dimensionless.
        """
        slopes = self._slopes(field)  # shape (n_element, n_point, 2, 3): coordinate and displacement component
        scaled_strain = strain(slopes, self.groups.squared_amplitude)
        scaled_stress = scaled_strain @ self.groups.elasticity
        elastic_density = 0.5 * np.sum(scaled_strain * scaled_stress, axis=-1)

        # Let U_i,a be the slope of the displacement component U_i along the coordinate a, where U_3 = W. The linear
        # part of E' is sym grad U. The remainder is the sum of factor_i U_i,a U_i,b / 2 over i, with the factors A^2
        # for U1 and U2 and 1 for W, where A is the amplitude of the press. The energy density of the pretension is
        # therefore the sum of factor_i U_i,a T_ab U_i,b / 2 over a, b and i.
        products_by_component = slopes * (self._pretension_matrix @ slopes)  # U_i,a T_ab U_i,b, summed over b
        pretension_density = 0.5 * np.sum(products_by_component @ self._slope_factors, axis=-1)
        return float(np.sum((elastic_density + pretension_density) * self.mesh.weights))

    def forces(self, field: Array) -> Array:
        """Compute the internal forces of the elements, which are the gradient of the stretching energy.

        Args:
            field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).

        Returns:
            Forces, shape (n_element, n_local, 3).
        """
        mesh = self.mesh
        slopes = self._slopes(field)
        scaled_strain = strain(slopes, self.groups.squared_amplitude)
        elastic_stress = scaled_strain @ self.groups.elasticity  # (S11, S22, S12), shape (n_element, n_point, 3)

        # The traction is the derivative of the energy density with respect to the slopes, shape (n_element, n_point, 2,
        # 3). Add the terms of the elastic stress and of the pretension. A^2 is the squared amplitude of the press.
        traction = _symmetric_matrix(elastic_stress) @ self._deformation_gradient(slopes)
        traction += self._slope_factors * (self._pretension_matrix @ slopes)  # factors A^2 for U1 and U2, and 1 for W

        # Integrate the product of the traction and the derivatives of the basis functions over each element.
        weighted_traction = traction * mesh.weights[..., None, None]
        stacked_traction = weighted_traction.reshape(len(traction), -1, 3)  # shape (n_element, n_point * 2, 3)
        transposed_gradient = mesh.stacked_gradient.transpose(0, 2, 1)  # shape (n_element, n_local, n_point * 2)
        return transposed_gradient @ stacked_traction

    def tangent(self, field: Array, added_tension: float, unknowns_per_node: int) -> Array:
        """Compute the second derivatives of the stretching energy of each element.

        The energy depends on the unknowns only through the slopes, which are the derivatives of the displacements with
        respect to the coordinates X1 and X2. The slopes are linear functions of the unknowns. Let the matrix G contain
        the factors of these linear functions, and let the matrix S contain the second derivatives of the energy with
        respect to the slopes. The second derivatives with respect to the unknowns are then the sum of G' S G over the
        quadrature points.

        Args:
            field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
            added_tension: Tension that is added to the pretension, in units of E_young A^2.
            unknowns_per_node: Number of unknowns per node. The first three are U1, U2 and W.

        Returns:
            Second derivatives, shape (n_element, unknowns_per_node, n_local, unknowns_per_node, n_local). The second
            and third axes are the component and the node of the first derivative. The last two axes are the component
            and the node of the second derivative. The derivatives with respect to a fourth unknown are zero.
        """
        mesh = self.mesh
        slopes = self._slopes(field)

        # Compute the two parts of S, multiplied by the integration weights of the points. One part is caused by the
        # stress (S11, S22, S12), which is the sum of the elastic stress, the pretension and the added tension. An equal
        # tension in all directions is the stress (1, 1, 0). The other part is the stiffness of the material. The last
        # four axes of the stiffness are the coordinate and the component of one slope, followed by those of another.
        elastic_stress = strain(slopes, self.groups.squared_amplitude) @ self.groups.elasticity
        total_stress = elastic_stress + self._pretension + added_tension * EQUAL_TENSION
        weighted_stress = _symmetric_matrix(total_stress * mesh.weights[..., None])  # (n_element, n_point, 2, 2)
        stiffness = self._material_stiffness(self._deformation_gradient(slopes))  # (n_element, n_point, 2, 3, 2, 3)
        weighted_stiffness = stiffness * mesh.weights[..., None, None, None, None]

        # Compute one block G' S G of the matrix for each pair (i, j) of displacement components. The matrix is
        # symmetric, so the blocks below the diagonal are transposed copies of the blocks above the diagonal. In G', the
        # points and the two coordinates share the last axis, shape (n_element, n_local, n_point * 2).
        gradient = mesh.gauss_gradient  # G, shape (n_element, n_point, 2, n_local)
        transposed_gradient = np.ascontiguousarray(mesh.stacked_gradient.transpose(0, 2, 1))  # G'
        n_element, _, _, n_local = gradient.shape
        matrix = np.zeros((n_element, unknowns_per_node, n_local, unknowns_per_node, n_local))
        for i, j in combinations_with_replacement(range(3), 2):
            # S for the slopes of the components i and j, shape (n_element, n_point, 2, 2). The stress contributes only
            # if i = j, because the strain contains no products of slopes of different components. The squared slopes of
            # a component have a factor in the strain: A^2 for U1 and U2, and 1 for W, with the amplitude A.
            slope_stiffness = weighted_stiffness[..., i, :, j].copy()
            if i == j:
                slope_stiffness += self._slope_factors[i] * weighted_stress

            # In S G, the points and the coordinates are stacked like in G'. The product with G' sums over all of them.
            stacked_product = (slope_stiffness @ gradient).reshape(n_element, -1, n_local)
            np.matmul(transposed_gradient, stacked_product, out=matrix[:, i, :, j])
            if i != j:
                matrix[:, j, :, i] = matrix[:, i, :, j].transpose(0, 2, 1)
        return matrix

    def _material_stiffness(self, deformation: Array) -> Array:
        """Compute the second derivatives of the elastic energy density with respect to all slopes.

        The result is the product B C B', where C is the elasticity matrix. The matrix B contains the derivatives of the
        strain (E11, E22, 2 E12) with respect to the slopes. The result does not include the second derivatives that the
        stress causes.

        Args:
            deformation: Scaled deformation gradient F, shape (n_element, n_point, 2, 3). The last two axes are the
                coordinate and the displacement component.

        Returns:
            Second derivatives, shape (n_element, n_point, 2, 3, 2, 3). The last four axes are the coordinate and the
            displacement component of the first slope, followed by the coordinate and the displacement component of the
            second slope.
        """
        strain_derivative = np.zeros((*deformation.shape, 3))  # last axis: E11, E22, 2 E12
        strain_derivative[..., 0, :, 0] = deformation[..., 0, :]  # d E11 / d U_i,1
        strain_derivative[..., 1, :, 1] = deformation[..., 1, :]  # d E22 / d U_i,2
        strain_derivative[..., 0, :, 2] = deformation[..., 1, :]  # d 2 E12 / d U_i,1
        strain_derivative[..., 1, :, 2] = deformation[..., 0, :]  # d 2 E12 / d U_i,2

        n_element, n_point, _, _ = deformation.shape
        derivatives = strain_derivative.reshape(n_element, n_point, 6, 3)  # B, with one row for each of the six slopes
        stiffness = derivatives @ self.groups.elasticity @ derivatives.swapaxes(-1, -2)
        return stiffness.reshape(n_element, n_point, 2, 3, 2, 3)


BENDING_SHIFT = 5.0
"""Shift s in the linear equations of a film that resists bending; see the class `Bending`.

The shift must lie between 0 and 11.56, which is twice the lowest eigenvalue of the film.
"""


class Bending:
    """Bending energy of a clamped film.

    The bending energy is beta / 2 * integral( m^2 ), where beta is the dimensionless bending stiffness and m is the
    Laplacian of the deflection W. The deflection is continuous, but its slope jumps between elements. The Laplacian is
    therefore defined weakly by

        integral( m phi ) = -integral( dot(grad W, grad phi) )   for every basis function phi.

    The weak definition also clamps the slope at the rim, because the functions phi include the basis functions on the
    rim (Ciarlet and Raviart 1974). The integral of m phi is computed with the Gauss-Lobatto rule, whose points are the
    nodes. This rule makes the matrix M of the integral diagonal. The Laplacian is therefore m = -M^-1 L W, where L is
    the matrix of the integral of dot(grad W, grad phi). The bending energy is beta / 2 * W L^T M^-1 L W.

    The matrix L^T M^-1 L couples elements that do not touch each other. In order to keep the matrix sparse, the linear
    solves have an additional unknown mu = sqrt(beta) M^-1 (L - s M) W at each node. The linear system for a right-hand
    side r is

        [ K + beta (2 s L - s^2 M)    sqrt(beta) (L - s M)^T ] [W ]   [r]
        [ sqrt(beta) (L - s M)        -M                     ] [mu] = [0],

    where K is the matrix without bending and s is a shift. The solution W does not depend on the shift, because the
    Schur complement is K + beta L^T M^-1 L for every shift. The lowest eigenvalue of the negative Laplacian on the film
    is 5.78. If the shift lies between 0 and twice this value, the first block is positive definite, even if K is zero.
    The complete matrix is then quasi-definite, and can be factorised without pivoting (Vanderbei 1995).

    A node in the interior of an element belongs to no other element, and M is diagonal. The unknowns mu of the interior
    nodes of each element are therefore eliminated before the matrix is assembled.
    """

    def __init__(self, mesh: PlacedMesh, stiffness: float) -> None:
        """Store the matrices L and M of a mesh, which determine the bending energy.

        The matrix L contains the integrals of dot(grad p, grad q) for all pairs of basis functions p and q. The mass
        matrix M contains the integrals of p q. The quadrature points are the nodes, so M is diagonal.

        Args:
            mesh: Mesh of the press.
            stiffness: Bending stiffness beta, dimensionless.
        """
        self.mesh = mesh
        self.stiffness = stiffness
        self._laplace = mesh.laplace  # L, shape (n_element, n_local, n_local)
        self._mass = mesh.gather(mesh.node_weights)  # diagonal of M, shape (n_node,)

    @cached_property
    def _system_blocks(self) -> tuple[Array, Array, Array]:
        """Blocks (W, W), (W, mu) and (mu, mu) of the linear system, each of shape (n_element, n_local, n_local).

        The class describes the linear system for the deflection W and an auxiliary unknown mu. L is the matrix of the
        weak Laplacian, M is the mass matrix, beta is the bending stiffness, and s is a shift. The unknowns mu of
        interior nodes are eliminated: their Schur complement is added to the block (W, W), and their coupling is zero.
        """
        mesh = self.mesh
        mass = np.eye(mesh.template.xi.size) * mesh.node_weights[:, None]  # M
        coupling = np.sqrt(self.stiffness) * (self._laplace - BENDING_SHIFT * mass)  # sqrt(beta) (L - s M), symmetric
        shift_terms = 2.0 * BENDING_SHIFT * self._laplace - BENDING_SHIFT**2 * mass  # 2 s L - s^2 M
        deflection_block = self.stiffness * shift_terms

        # Eliminate the unknowns mu of interior nodes. With their block -M, which is diagonal, and their coupling B, the
        # Schur complement is -B' (-M)^-1 B = B' M^-1 B.
        interior = mesh.template.is_interior
        interior_coupling = coupling[:, interior]  # B, shape (n_element, n_interior, n_local)
        interior_mass = mesh.node_weights[:, interior, None]
        deflection_block += interior_coupling.transpose(0, 2, 1) @ (interior_coupling / interior_mass)
        coupling[:, interior] = 0.0  # the rows of `coupling` belong to mu, but those of the returned block to W
        return deflection_block, coupling.transpose(0, 2, 1), -mass

    def laplacian(self, deflection: Array) -> Array:
        """Compute the Laplacian m = -M^-1 L W of the deflection W.

        The matrix L contains the integrals of dot(grad p, grad q) for all pairs of basis functions p and q. The mass
        matrix M contains the integrals of p q. The quadrature points are the nodes, so M is diagonal.

        Args:
            deflection: Scaled deflection W at the nodes, shape (n_node,).

        Returns:
            Laplacian of W at the nodes, shape (n_node,).
        """
        deflection_column = deflection[self.mesh.template.nodes][..., None]  # shape (n_element, n_local, 1)
        element_values = (self._laplace @ deflection_column)[..., 0]
        integrals = self.mesh.gather(element_values)  # L W, shape (n_node,)
        return -integrals / self._mass

    def energy(self, deflection: Array) -> float:
        """Compute the bending energy of a deflection.

        Args:
            deflection: Scaled deflection W at the nodes, shape (n_node,).

        Returns:
            Energy of the meshed part of the film, dimensionless.
        """
        return float(0.5 * self.stiffness * np.sum(self._mass * self.laplacian(deflection) ** 2))

    def forces(self, deflection: Array) -> Array:
        """Compute the internal forces of the elements, which are the gradient of the bending energy.

        The bending energy is beta / 2 * W L^T M^-1 L W, where W is the deflection, L and M are matrices of the mesh,
        and beta is the bending stiffness. The gradient of the energy is -beta L m, where m = -M^-1 L W is the Laplacian
        of W.

        Args:
            deflection: Scaled deflection W at the nodes, shape (n_node,).

        Returns:
            Forces, shape (n_element, n_local).
        """
        element_laplacian = self.laplacian(deflection)[self.mesh.template.nodes]  # shape (n_element, n_local)
        return -self.stiffness * (self._laplace @ element_laplacian[..., None])[..., 0]

    def extend(self, tangent: Array) -> None:
        """Add bending to the element matrices K of the membrane, which are changed in place.

        The equations for the deflection W and for an auxiliary unknown mu are

            [ K + beta (2 s L - s^2 M)    sqrt(beta) (L - s M)^T ] [W ]   [r]
            [ sqrt(beta) (L - s M)        -M                     ] [mu] = [0],

        where r is the right-hand side for W, beta is the bending stiffness, L is the matrix of the weak Laplacian, and
        M is the diagonal mass matrix. The solution W does not depend on the shift s. The unknowns mu of the interior
        nodes of the elements have already been eliminated from the blocks that this method adds to K.

        Args:
            tangent: Matrices for (U1, U2, W, mu), shape (n_element, 4, n_local, 4, n_local). The entries that belong to
                mu are zero before the call.
        """
        # The indices of the unknowns of a node are 0 for U1, 1 for U2, 2 for W and 3 for mu.
        deflection_block, coupling, auxiliary_block = self._system_blocks  # in (W, W), (W, mu) and (mu, mu)
        tangent[:, 2, :, 2] += deflection_block
        tangent[:, 2, :, 3] = coupling
        tangent[:, 3, :, 2] = coupling.transpose(0, 2, 1)
        tangent[:, 3, :, 3] = auxiliary_block


def _symmetric_matrix(stress: Array) -> Array:
    """Convert stresses (S11, S22, S12), shape (..., 3), into symmetric matrices, shape (..., 2, 2)."""
    matrix_elements = stress[..., [0, 2, 2, 1]]  # S11, S12, S12, S22
    return matrix_elements.reshape(*stress.shape[:-1], 2, 2)
