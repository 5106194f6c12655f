"""Bending energy of the film, its residual, and how it enters the linear solves.

The film is clamped, so the Gaussian curvature integrates to nothing and the bending energy of a plate is, in units of
E_young h a^2 A^4 (see `isocharge.simulate.mechanics.membrane`),

    beta / 2 * integral( (lap W)^2 ).

Elements are continuous but not smooth, so the Laplacian is taken weakly: m = lap W means

    integral( m phi ) = -integral( grad W . grad phi )   for every basis function phi, those on the rim included,

which also clamps the slope at the rim (Ciarlet and Raviart 1974). With the left integral lumped on the Gauss-Lobatto
nodes, m = -M^-1 L W with a diagonal M, and the energy is a plain function of W: beta / 2 W L^T M^-1 L W.

That matrix couples elements that do not touch, so the linear solves carry m along as an unknown of its own. With any
shift s, and mu = sqrt(beta) M^-1 (L - s M) W,

    [ K + beta (2 s L - s^2 M)    sqrt(beta) (L - s M)^T ] [W ]   [r]
    [ sqrt(beta) (L - s M)        -M                     ] [mu] = [0]

is the same equation for W for every s: its Schur complement is K + beta L^T M^-1 L. A shift between 0 and twice the
film's lowest eigenvalue, 5.78, makes the first block positive definite even where K vanishes (a thick film without
tension), so the matrix is quasi-definite and needs no pivoting (Vanderbei 1995).
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mesh.elements import Geometry

SHIFT = 5.0
"""Shift s of the linear solves, dimensionless: between 0 and 11.56, twice the lowest eigenvalue of the film."""


class Bending:
    """Discrete bending for one geometry and one stiffness beta."""

    def __init__(self, geometry: Geometry, stiffness: float) -> None:
        self.geometry = geometry
        self.stiffness = stiffness
        flat = geometry.gradient.reshape(len(geometry.gradient), -1, geometry.gradient.shape[-1])
        weights = np.repeat(geometry.weights, 2, axis=1)[..., None]
        self._laplace = flat.transpose(0, 2, 1) @ (weights * flat)
        self._mass = geometry.gather(geometry.mass)

    def laplacian(self, deflection: Array) -> Array:
        """lap W at the nodes, shape (n_node,), from W at the nodes."""
        weak = self._laplace @ deflection[self.geometry.nodes][..., None]
        laplacian: Array = -self.geometry.gather(weak[..., 0]) / self._mass
        return laplacian

    def energy(self, deflection: Array) -> float:
        """Bending energy of a nodal deflection, shape (n_node,)."""
        return float(0.5 * self.stiffness * np.sum(self._mass * self.laplacian(deflection) ** 2))

    def forces(self, deflection: Array) -> Array:
        """Gradient of the energy, element by element, shape (n_element, n_local)."""
        laplacian = self.laplacian(deflection)[self.geometry.nodes]
        forces: Array = -self.stiffness * (self._laplace @ laplacian[..., None])[..., 0]
        return forces

    def extend(self, tangent: Array) -> Array:
        """Element matrices over (U1, U2, W, mu) from those over (U1, U2, W).

        Shape (n_element, n_local, 4, n_local, 4).
        """
        n_element, n_local = self.geometry.nodes.shape
        matrix = np.zeros((n_element, n_local, 4, n_local, 4))
        matrix[:, :, :3, :, :3] = tangent
        mass = np.eye(n_local) * self.geometry.mass[:, None]
        shifted = np.sqrt(self.stiffness) * (self._laplace - SHIFT * mass)
        matrix[:, :, 2, :, 2] += self.stiffness * (2.0 * SHIFT * self._laplace - SHIFT**2 * mass)
        matrix[:, :, 2, :, 3] = shifted
        matrix[:, :, 3, :, 2] = shifted
        matrix[:, :, 3, :, 3] = -mass
        return matrix
