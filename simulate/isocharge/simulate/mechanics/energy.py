"""The film's energy under a load: stretching, bending where the press needs it, and the probe's work.

    Pi = stretching + bending - load * mean of W over the footprint

in the units of `mechanics.membrane`, as a function of the nodal field (U1, U2, W), shape (n_node, 3).
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.bending import Bending
from isocharge.simulate.mechanics.membrane import Membrane
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.mesh.elements import Geometry


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
