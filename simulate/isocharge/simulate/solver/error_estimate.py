"""How wrong a charge is: from one mesh, from a second one, and from what the theory leaves out; and what to warn of.

In the inner part of the film the elements' shapes and the decay of their modes predict the error of a charge. Near the
rim, and around polygons that are large on the film, they do not: the coarse elements may be far from the stressed ones.
There, and for accuracies below the default, a press is solved again one order higher, from its own field, until two
meshes agree. Each order divides the error by three to ten, so the difference of two meshes bounds the error of the
finer one.
"""

from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.json_values import finite_or_none
from isocharge.simulate.mechanics.theory import bending_length, modelling_error
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.numerics.interpolation import gauss_reference_square, modal_matrix
from isocharge.simulate.solver.equilibrium import (
    Equilibrium,
    deflection,
    node_slope,
    principal_stress,
    touch_stress,
)

SAFETY = 2.0
"""Safety factor on the error predicted from element shape and modal decay, dimensionless.

Valid within 0.6 film radii; near the rim it is too small.
"""

LEAST_ERROR = 5e-5
"""Smallest relative error of a charge that is claimed: thin rings and the electrodes' integration points leave it."""

DECAY_WEIGHT = 0.1
"""Relative error of a charge per share of the slopes that the elements' highest modes carry, dimensionless."""

RINGS, AROUND = (0.0, 0.1, 0.22, 0.4, 0.6, 0.8), 12
"""Radii of rings about the film's centre, in film radii, and number of patches on each, where charges are compared."""

PATCH = 1.0 / 15.0
"""Side of the patches, in film radii: 3 mm of 45."""

PER_SIDE = 6
"""Gauss points along a patch's side."""

WRINKLE_SHARE = 1e-3
"""Compression over the largest stress, dimensionless, above which a warning is given."""


def shape_error(mesh: PlacedMesh) -> float:
    """Relative error of a charge as predicted from the elements' shapes, infinite where an element is inside out.

    The elements carry the conformal map as a polynomial. How well they do shows in the film's own area: the worst
    charge's error is about a third of the square root of the area's (`tests/benchmarks/bench_hard_cases.py`).
    """
    geometry = mesh.geometry
    if geometry.weights.min() <= 0.0 or geometry.mass.min() <= 0.0:
        return np.inf
    area = np.pi * (1.0 + 0.5 * abs(mesh.oval) ** 2)
    return float(np.sqrt(abs(mesh.template.copies * geometry.weights.sum() / area - 1.0)))


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


def mesh_error(equilibrium: Equilibrium) -> float:
    """Expected relative error of a charge from the mesh: proven by a second one, or by shapes and modes."""
    if equilibrium.proven_error is not None:
        return max(LEAST_ERROR, equilibrium.proven_error)
    mesh = equilibrium.mesh
    modes = DECAY_WEIGHT * decay(mesh, node_slope(equilibrium)[..., 2])
    return max(LEAST_ERROR, SAFETY * shape_error(mesh), SAFETY * modes)


def estimated_error(equilibrium: Equilibrium) -> float:
    """Expected relative error of a charge, from the terms that the theory leaves out and from the mesh.

    Infinite where the theory has no meaning for this film.
    """
    film, probe, force = equilibrium.film, equilibrium.probe, equilibrium.force
    return mesh_error(equilibrium) + modelling_error(film, probe, force, equilibrium.theory)


def relative_difference(one: Equilibrium, other: Equilibrium) -> float:
    """Largest relative difference between two equilibria of a press, of patches' charges and of the deflection.

    A patch counts relative to the largest charge on its ring.
    """
    around = np.exp(2j * np.pi * np.arange(AROUND) / AROUND)
    rings = one.film.radius * np.array(RINGS)[:, None] * around
    centres = np.concatenate([rings, (complex(*one.at) + one.probe.reach * around)[None]])
    xi, eta, weight = gauss_reference_square(PER_SIDE)
    points = (centres[:, :, None] + 0.5 * PATCH * one.film.radius * (xi + 1j * eta)).ravel()
    inside = np.abs(points) < one.film.radius
    position = np.stack([points.real, points.imag], axis=1)[inside]
    read = []
    for solved in (one, other):
        stress = np.zeros((points.size, 3))
        stress[inside] = touch_stress(solved, position)
        mean = np.einsum("rapc,p->rac", stress.reshape(*centres.shape, -1, 3), 0.25 * weight)
        read.append(np.stack([mean[..., 0] + mean[..., 1], 10.0 * mean[..., 0] + mean[..., 1]], axis=-1))
    largest = np.maximum(np.abs(read[1]).max(axis=1, keepdims=True), 1e-300)
    first, second = (deflection(solved, np.array([one.at]))[0] for solved in (one, other))
    return max(float((np.abs(read[0] - read[1]) / largest).max()), abs(float(first / second) - 1.0))


def cautions(equilibrium: Equilibrium) -> tuple[str, ...]:
    """Effects in a real film that the theory does not model, one sentence each."""
    smallest, largest = principal_stress(equilibrium)
    sentences = []
    if largest > DEFAULT_STRESS_LIMIT:
        sentences.append(f"the film is stressed to {largest:.3g} MPa; PVDF yields from {DEFAULT_STRESS_LIMIT:g} MPa on")
    if smallest < -WRINKLE_SHARE * largest:
        sentences.append(f"the film is compressed to {smallest:.3g} MPa somewhere; a thin film may wrinkle there")
    return tuple(sentences)


def summary(equilibrium: Equilibrium) -> dict[str, Any]:
    """For JSON: deflection under the probe, theory, estimated error, and how the solve went."""
    return {
        "deflection_mm": float(deflection(equilibrium, np.array([equilibrium.at]))[0]),
        "theory": equilibrium.theory.name,
        "status": equilibrium.status,
        "iterations": equilibrium.iterations,
        "residual": equilibrium.residual,
        "seconds": equilibrium.seconds,
        "estimated_error": finite_or_none(estimated_error(equilibrium)),
        "groups": {
            **{name: value for name, value in vars(equilibrium.groups).items() if name != "anisotropy"},
            "bending_length": bending_length(equilibrium.film, equilibrium.force),
        },
        "warnings": list(cautions(equilibrium)),
    }
