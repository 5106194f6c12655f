"""Energy of a static pressure on the film and of trapped air behind the film, and the derivatives of this energy."""

from dataclasses import replace
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.theory import DimensionlessGroups
from isocharge.simulate.mesh.placed_mesh import PlacedMesh


class BackPressure:
    """Energy of the static pressure and of the trapped air for a given mesh and given dimensionless groups.

    Let V0 be the volume of the closed cavity behind the film, and let p0 be the pressure of the atmosphere. If the film
    displaces the volume V at constant temperature, the pressure of the trapped air rises by p0 V0 / (V0 - V) - p0
    (Boyle's law). The energy of the trapped air is -p0 V0 (ln(1 - V / V0) + V / V0).

    As in the theory of plates, the static pressure and the pressure of the air act perpendicular to the undeformed
    film, and on its undeformed area. In the units of `mechanics.theory`, the ratio V / V0 is the integral of the
    deflection W over the film, multiplied by the dimensionless group `compression`.

    Attributes:
        mesh: Mesh of the press.
        groups: Dimensionless groups of the press.
    """

    def __init__(self, mesh: PlacedMesh, groups: DimensionlessGroups) -> None:
        self.mesh = mesh
        self.groups = groups
        self._copies = mesh.template.copies

    @cached_property
    def weights(self) -> Array:
        """Weights that integrate nodal deflections over the meshed part of the film, shape (n_node,)."""
        return self.mesh.gather(self.mesh.node_weights)

    def energy(self, deflection: Array) -> float:
        """Compute the energy of the static pressure and of the trapped air for the meshed part of the film.

        The energy of the whole film is the energy of the trapped air minus the work of the static pressure. The energy
        of the trapped air is p0 V0 (-ln(1 - x) - x), where p0 is the pressure of the atmosphere, V0 is the volume of
        the air, and x is the share of this volume that the film displaces. The first term is the work that compresses
        the air at constant temperature. The second term is the work of the atmosphere on the front of the film. The
        energy of the meshed part is the energy of the whole film divided by the number of copies of the mesh that cover
        the film.

        Args:
            deflection: Scaled deflection W at the nodes, shape (n_node,).

        Returns:
            Energy, dimensionless. The energy is infinite if the film displaces the whole volume of the air.
        """
        volume = self._volume(deflection)
        energy = -self.groups.static_pressure * volume  # minus the work of the static pressure
        if self.groups.compression != 0.0:
            displaced_share = self._displaced_share(deflection)
            if displaced_share >= 1.0:
                return np.inf
            # In scaled units, the volume V0 of the air is 1 / compression. The function log1p(-x) is ln(1 - x).
            energy_unit = self.groups.ambient_pressure / self.groups.compression  # p0 V0
            energy += energy_unit * (-np.log1p(-displaced_share) - displaced_share)
        return float(energy / self._copies)

    def forces(self, deflection: Array) -> Array:
        """Compute the derivatives of the energy with respect to the deflection of each node.

        Args:
            deflection: Scaled deflection W at the nodes, shape (n_node,).

        Returns:
            Derivatives, shape (n_node,). The derivatives are infinite if the film displaces the whole volume of the
            air.
        """
        displaced_share = self._displaced_share(deflection)
        if displaced_share >= 1.0:
            return np.full_like(deflection, np.inf)
        return -self.at_constant_pressure(deflection).static_pressure * self.weights

    def at_constant_pressure(self, deflection: Array) -> DimensionlessGroups:
        """Return dimensionless groups in which an equal static pressure replaces the pressure of the trapped air.

        Args:
            deflection: Scaled deflection W at the nodes, shape (n_node,).
        """
        # At constant temperature, the pressure p0 of the air increases by p0 x / (1 - x), where x = V / V0.
        displaced_share = self._displaced_share(deflection)
        air_pressure = self.groups.ambient_pressure * displaced_share / (1.0 - displaced_share)
        static_pressure = self.groups.static_pressure - air_pressure
        return replace(self.groups, static_pressure=static_pressure, compression=0.0)

    def stiffness(self, deflection: Array) -> float:
        """Compute the factor c of the second derivatives of the energy with respect to the nodal deflections.

        The second derivative with respect to the deflections of the nodes i and j is c * weights[i] * weights[j].

        Args:
            deflection: Scaled deflection W at the nodes, shape (n_node,).
        """
        # The pressure of the air rises by p0 x / (1 - x), where the displaced share x is the compression times the
        # displaced volume. This is the derivative of the pressure with respect to the volume.
        displaced_share = self._displaced_share(deflection)
        pressure_per_volume = self.groups.ambient_pressure * self.groups.compression / (1.0 - displaced_share) ** 2

        # A change of the deflection displaces the volume `copies` times, once for each copy of the mesh.
        return float(self._copies * pressure_per_volume)

    def _volume(self, deflection: Array) -> float:
        """Compute the displaced volume, which is the integral of the scaled deflection over the whole film.

        Args:
            deflection: Scaled deflection W at the nodes of the meshed part of the film, shape (n_node,).
        """
        return self._copies * float(self.weights @ deflection)

    def _displaced_share(self, deflection: Array) -> float:
        """Compute the ratio of the displaced volume V to the volume V0 of the air behind the film, dimensionless.

        Args:
            deflection: Scaled deflection W at the nodes, shape (n_node,).
        """
        return self.groups.compression * self._volume(deflection)
