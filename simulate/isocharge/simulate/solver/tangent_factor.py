"""Factorisation of the tangent of an equilibrium, with the stiffness of trapped air.

The air behind the film resists a deflection W that compresses it. The stiffness of the air is c v v'. The vector v
contains the weights with which the deflections of the nodes contribute to the volume. The matrix c v v' couples all
nodes, and its rank is one. The system (K + c v v') x = b is therefore solved with the factorisation of the sparse
matrix K (Sherman and Morrison 1950):

    x = K^-1 b - y c (v' K^-1 b) / (1 + c v' y),   y = K^-1 v.

Fields that are odd about the line of symmetry do not change the volume, so their matrix is K.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.solver.assembly import Assembly, Factor


class TangentFactor(Protocol):
    """Factorisation that solves linear systems with the tangent."""

    def solve(self, right: Array) -> Array:
        """Solve for the displacements (U1, U2, W) at the nodes; both arrays have the shape (n_node, 3)."""


@dataclass(frozen=True)
class _AirFactor:
    """Factorisation of K + c v v'.

    Attributes:
        film: Factorisation of K.
        weights: Integration weights v of the volume, shape (n_node,).
        response: Displacements y = K^-1 v by a uniform pressure, shape (n_node, 3).
        pressure_per_volume: c / (1 + c v . y), the pressure of the air for a unit volume without the air.
    """

    film: Factor
    weights: Array
    response: Array
    pressure_per_volume: float

    def solve(self, right: Array) -> Array:
        """See `TangentFactor`."""
        field = self.film.solve(right)
        volume = float(self.weights @ field[:, 2])
        return np.asarray(field - self.pressure_per_volume * volume * self.response)


def factor_tangent(elastic: ElasticFilm, assembly: Assembly, field: Array, guard: float = 0.0) -> TangentFactor:
    """Factorise the tangent at a field, including the stiffness of trapped air.

    The tangent is K + c v v', where K is the matrix of the film, v contains the integration weights of the volume, and
    c is the stiffness of the air. The formula of Sherman and Morrison uses only the factorisation of K.

    Args:
        elastic: The discrete film.
        assembly: Linear solver for its mesh.
        field: Scaled displacements, shape (n_node, 3).
        guard: Additional tension; see `ElasticFilm.tangent`.

    Returns:
        Factorisation of the tangent.
    """
    film_factor = assembly.factor(elastic.tangent(field, guard))
    if elastic.back is None or elastic.groups.compression == 0.0:  # no trapped air
        return film_factor
    if assembly.odd:  # odd fields do not compress the air
        return film_factor

    # The correction of a solution x is -c / (1 + c v . y) (v . x) y, with y = K^-1 v.
    weights = elastic.back.weights
    uniform_pressure = np.zeros_like(field)
    uniform_pressure[:, 2] = weights
    response = film_factor.solve(uniform_pressure)
    air_stiffness = elastic.back.stiffness(field[:, 2])
    pressure_per_volume = air_stiffness / (1.0 + air_stiffness * float(weights @ response[:, 2]))
    return _AirFactor(film_factor, weights, response, pressure_per_volume)
