"""Pressure on the whole film: a static pressure, and the pressure of the air that is trapped behind the film.

Let V0 be the volume of a closed cavity, and p0 the pressure of the atmosphere. If the film displaces the volume V, the
pressure of the trapped air rises by p0 V0 / (V0 - V) - p0 (Boyle's law, at constant temperature). The energy of the air
is -p0 V0 (ln(1 - V / V0) + V / V0). The static pressure and the pressure of the air act along the direction of the push
on the area of the undeformed film, as in the theory of plates. In the units of `mechanics.scaling`, V / V0 is the
product of `compression` and the integral of W over the film.
"""

from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.mesh.placed_mesh import Geometry

SERIES_BELOW = 1e-3
"""Compression below which the energy of the air is computed by a series, because the formula with the logarithm loses
digits."""


class BackPressure:
    """Energy of the static pressure and of the trapped air, for one mesh and one set of dimensionless groups.

    Attributes:
        geometry: Elements of the mesh.
        groups: Dimensionless groups of the press.
    """

    def __init__(self, geometry: Geometry, groups: DimensionlessGroups) -> None:
        self.geometry = geometry
        self.groups = groups
        self._copies = 1.0 / float(geometry.load.sum())  # number of copies of the mesh that cover the film

    @cached_property
    def weights(self) -> Array:
        """Integration weights of the nodes for the volume of the meshed part of the film, shape (n_node,)."""
        return self.geometry.gather(self.geometry.mass)

    def energy(self, deflection: Array) -> float:
        """Compute the energy of the pressures on the meshed part of the film for a deflection W, shape (n_node,).

        The result is the energy of the trapped air minus the work of the static pressure, divided by the number of
        copies of the mesh that cover the film. The energy is infinite if the film displaces the whole volume of the
        air.
        """
        volume = self._volume(deflection)
        static_work = self.groups.static_pressure * volume
        if self.groups.compression == 0.0:
            return -static_work / self._copies
        # `_air_energy` is relative to p0 V0. In scaled units, V0 is 1 / compression.
        air_energy = self.groups.ambient_pressure / self.groups.compression * self._air_energy(deflection)
        return (air_energy - static_work) / self._copies

    def forces(self, deflection: Array) -> Array:
        """Compute the derivatives of the energy with respect to W at the nodes, shape (n_node,).

        The derivatives are infinite if the film displaces the whole volume of the air.

        Args:
            deflection: W at the nodes, shape (n_node,).
        """
        # At constant temperature, the pressure p0 of the air increases by p0 x / (1 - x), where x = V / V0 is the
        # displaced share of its volume.
        compression = self.groups.compression * self._volume(deflection)
        if compression >= 1.0:
            return np.full_like(deflection, np.inf)
        air_pressure = 0.0
        if compression != 0.0:
            air_pressure = self.groups.ambient_pressure * compression / (1.0 - compression)
        pressure = air_pressure - self.groups.static_pressure
        return pressure * self.weights

    def stiffness(self, deflection: Array) -> float:
        """Compute the factor c of the second derivatives c * weights[i] * weights[j] of the energy.

        Args:
            deflection: W at the nodes, shape (n_node,).
        """
        compression = self.groups.compression * self._volume(deflection)
        slope = self.groups.ambient_pressure * self.groups.compression / (1.0 - compression) ** 2
        return float(self._copies * slope)

    def static_work(self, deflection: Array) -> float:
        """Compute the work of the static pressure on the meshed part, for W of shape (n_node,)."""
        return self.groups.static_pressure * self._volume(deflection) / self._copies

    def _volume(self, deflection: Array) -> float:
        """Compute the integral of W over the whole film."""
        return self._copies * float(self.weights @ deflection)

    def _air_energy(self, deflection: Array) -> float:
        """Compute the ratio of the energy of the air to p0 V0.

        The ratio is -ln(1 - x) - x for the relative compression x = V / V0.

        Args:
            deflection: W at the nodes, shape (n_node,).

        Returns:
            Energy, dimensionless; infinite if no air remains.
        """
        x = self.groups.compression * self._volume(deflection)
        if x >= 1.0:
            return np.inf
        if abs(x) >= SERIES_BELOW:
            return float(-np.log1p(-x) - x)

        # Taylor series x^2 / 2 + x^3 / 3 + ... + x^6 / 6, evaluated by Horner's scheme
        series = 1.0 / 6.0
        for exponent in (5.0, 4.0, 3.0, 2.0):
            series = 1.0 / exponent + x * series
        return x**2 * series
