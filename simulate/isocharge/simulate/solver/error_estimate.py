"""How wrong a charge is, from one mesh: the shapes of its elements and the decay of their modes."""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.numerics.interpolation import modal_matrix

SAFETY = 2.0
"""Safety factor on the error predicted from element shape and modal decay, dimensionless.

Valid within 0.6 film radii; near the rim it is too small (see `mesh_comparison`).
"""

LEAST_ERROR = 5e-5
"""Smallest relative error of a charge that is claimed: thin rings and the electrodes' integration points leave it."""

DECAY_WEIGHT = 0.1
"""Relative error of a charge per share of the slopes that the elements' highest modes carry, dimensionless."""


def shape_error(mesh: PlacedMesh) -> float:
    """Relative error of a charge as predicted from the elements' shapes, infinite where an element is inside out.

    The elements carry the conformal map as a polynomial. How well they do shows in the film's own area: the worst
    charge's error is about a third of the square root of the area's (`tests/benchmarks/bench_hard_cases.py`).
    """
    geometry = mesh.geometry
    if geometry.weights.min() <= 0.0 or geometry.mass.min() <= 0.0:
        return np.inf
    return float(np.sqrt(abs(mesh.template.copies * geometry.weights.sum() / np.pi - 1.0)))


def decay(mesh: PlacedMesh, slope: Array) -> float:
    """Share of the deflection's slopes that the highest polynomial modes of the elements carry.

    Args:
        mesh: The mesh of the press.
        slope: grad W at the nodes of every element, shape (n_element, n_local, 2).

    Returns:
        Mean over the elements, weighted with the slopes' squares.
    """
    size = mesh.resolution.order + 1
    modal = modal_matrix(mesh.resolution.order)
    square = slope.transpose(0, 2, 1).reshape(len(slope), 2, size, size)
    weight = 1.0 / (2.0 * np.arange(size) + 1.0)
    power = ((modal @ square @ modal.T) ** 2 * np.outer(weight, weight)).sum(axis=1)
    total = power.sum(axis=(1, 2))
    top = total - power[:, :-1, :-1].sum(axis=(1, 2))
    area = mesh.geometry.weights.sum(axis=1)
    return float(np.sum(area * np.sqrt(np.maximum(top, 0.0) * total)) / max(np.sum(area * total), 1e-300))


def mesh_error(mesh: PlacedMesh, slope: Array) -> float:
    """Expected relative error of a charge from the mesh, by the elements' shapes and from the solution itself."""
    return max(LEAST_ERROR, SAFETY * shape_error(mesh), SAFETY * DECAY_WEIGHT * decay(mesh, slope))
