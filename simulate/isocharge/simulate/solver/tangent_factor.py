"""Factorisation of the tangent of an equilibrium, including the stiffness of trapped air.

The trapped air behind the film resists deflections that compress the air. The stiffness matrix of the air is c v v',
where c is a number. The vector v contains the weights with which the deflections of the nodes contribute to the
displaced volume. The matrix c v v' couples all nodes, but has only rank one. Therefore the system (K + c v v') x = b
can be solved with the factorisation of the sparse matrix K (Sherman and Morrison 1950). The solution is

    x = K^-1 b - y c (v' K^-1 b) / (1 + c v' y),   y = K^-1 v.

Fields that are odd about the line of symmetry do not change the volume of the air. For these fields, the matrix is K.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.solver.assembly import Assembly, Factor


class TangentFactor(Protocol):
    """Interface of a factorised tangent matrix, with which linear systems are solved."""

    def solve(self, right: Array) -> Array:
        """Solve for the displacements at the nodes.

        Args:
            right: Forces along (U1, U2, W) at the nodes, shape (n_node, 3).

        Returns:
            Displacements (U1, U2, W) at the nodes, shape (n_node, 3).
        """


@dataclass(frozen=True)
class _AirFactor:
    """Factorisation of the tangent K + c v v' of a film with trapped air.

    Attributes:
        film: Factorisation of the matrix K of the film.
        weights: Integration weights v of the displaced volume, shape (n_node,).
        response: Displacements y = K^-1 v of the film under a uniform pressure, shape (n_node, 3).
        pressure_per_volume: Factor c / (1 + c v . y). Multiplied by the volume that the film would displace without the
            air, the factor results in the pressure of the air.
    """

    film: Factor
    weights: Array
    response: Array
    pressure_per_volume: float

    def solve(self, right: Array) -> Array:
        """Solve for the displacements at the nodes; see `TangentFactor.solve`."""
        field_without_air = self.film.solve(right)
        volume = float(self.weights @ field_without_air[:, 2])
        return np.asarray(field_without_air - self.pressure_per_volume * volume * self.response)


def factor_tangent(elastic: ElasticFilm, assembly: Assembly, field: Array, added_tension: float = 0.0) -> TangentFactor:
    """Factorise the tangent of the film for given displacements, including the stiffness of trapped air.

    The tangent is K + c v v', where K is the matrix of the film, v contains the integration weights of the displaced
    volume, and c is the stiffness of the air. The formula of Sherman and Morrison needs only the factorisation of K.

    Args:
        elastic: Discrete model of the film.
        assembly: Linear solver for the mesh of the film.
        field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
        added_tension: Tension that is added to the pretension, in units of E_young A^2.

    Returns:
        Factorisation of the tangent.
    """
    film_factor = assembly.factor(elastic.tangent(field, added_tension))
    if elastic.back is None or elastic.groups.compression == 0.0:  # there is no trapped air
        return film_factor
    if assembly.odd:  # odd fields do not compress the air
        return film_factor

    # The air changes a solution x by -c / (1 + c v . y) (v . x) y, where y = K^-1 v is the response of the film to a
    # uniform pressure.
    weights = elastic.back.weights  # v
    uniform_pressure = np.zeros_like(field)
    uniform_pressure[:, 2] = weights
    response = film_factor.solve(uniform_pressure)  # y
    air_stiffness = elastic.back.stiffness(field[:, 2])
    pressure_per_volume = air_stiffness / (1.0 + air_stiffness * float(weights @ response[:, 2]))
    return _AirFactor(film_factor, weights, response, pressure_per_volume)
