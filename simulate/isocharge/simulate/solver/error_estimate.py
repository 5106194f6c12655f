"""Estimates of the errors that the mesh and the theory cause in a charge, and warnings about omitted effects.

In the inner part of the film, the error of the mesh is estimated from the shapes of the elements and the decay of their
polynomial modes. This estimate is not reliable near the rim, nor for large footprints that are not circular. In these
cases, the coarse elements may be far from the elements with the largest stress. The press is then solved on meshes of
increasing order until two meshes agree. The same method is used if the required accuracy is better than the default.
Each order reduces the error by a factor of three to ten, so the difference between two meshes is an upper bound of the
error of the finer mesh.
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
"""Safety factor of the error that is predicted from element shapes and modal decay, dimensionless.

The factor is too small for presses at distances above 0.6 film radii.
"""

MIN_ERROR = 5e-5
"""Smallest reported relative error of a charge, which the thin rings and the integration over electrodes cause."""

DECAY_WEIGHT = 0.1
"""Ratio of the relative error of a charge to the share of the slopes in the highest modes, dimensionless."""

PATCH_RINGS = (0.0, 0.1, 0.22, 0.4, 0.6, 0.8)
"""Radii of the rings of square patches on which the charges of two meshes are compared, in film radii."""

PATCHES_PER_RING = 12
"""Number of patches on each ring."""

PATCH_SIDE = 1.0 / 15.0
"""Side of the patches, in film radii."""

PATCH_POINTS = 6
"""Number of Gauss points along the side of a patch."""

WRINKLE_SHARE = 1e-3
"""Ratio of the compression to the largest stress above which a warning is given, dimensionless."""


GROUPS = ("squared_amplitude", "load", "tension", "bending", "poisson")
"""Attributes of `DimensionlessGroups` that the JSON output contains."""


def shape_error(mesh: PlacedMesh) -> float:
    """Predict the relative error of a charge from the shapes of the elements.

    The elements approximate the conformal map by polynomials. Because of this approximation, the area of the mesh
    differs from the area of the film. The prediction is the square root of the relative error of the area. The largest
    error of a charge is about a third of the prediction (`tests/benchmarks/bench_hard_cases.py`).

    Args:
        mesh: Mesh of the press.

    Returns:
        The error, which is infinite if an element is folded.
    """
    geometry = mesh.geometry
    is_folded = geometry.weights.min() <= 0.0 or geometry.mass.min() <= 0.0
    if is_folded:
        return np.inf
    film_area = np.pi * (1.0 + 0.5 * abs(mesh.oval) ** 2)  # in squared film radii
    mesh_area = mesh.template.copies * geometry.weights.sum()
    return float(np.sqrt(abs(mesh_area / film_area - 1.0)))


def decay(mesh: PlacedMesh, slope: Array) -> float:
    """Compute the share of the highest polynomial modes of the elements in the slopes of the deflection.

    The slopes of each element are expanded in products of Legendre polynomials. If the share of the highest degrees is
    small, the mesh is fine enough.

    Args:
        mesh: Mesh of the press.
        slope: Gradient of W at the nodes of every element, shape (n_element, n_local, 2).

    Returns:
        Mean share over the elements, weighted with the squares of the slopes.
    """
    # Coefficients of products of Legendre polynomials in xi and eta, from the values on the square grid of nodes
    n_node = mesh.resolution.order + 1
    nodes_to_modes = modal_matrix(mesh.resolution.order)
    nodal_slope = slope.transpose(0, 2, 1).reshape(len(slope), 2, n_node, n_node)
    coefficients = nodes_to_modes @ nodal_slope @ nodes_to_modes.T

    # Power of each mode in both slopes: the mean square of its contribution. The mean square of the Legendre polynomial
    # of degree n is 1 / (2 n + 1).
    mean_square = 1.0 / (2.0 * np.arange(n_node) + 1.0)
    power = (coefficients**2 * np.outer(mean_square, mean_square)).sum(axis=1)  # shape (n_element, n_node, n_node)
    total_power = power.sum(axis=(1, 2))
    power_of_lower_modes = power[:, :-1, :-1].sum(axis=(1, 2))  # without the highest degree in xi or in eta
    highest_power = total_power - power_of_lower_modes

    # The share of an element is sqrt(highest power / total power), and its weight is area * total power.
    area = mesh.geometry.weights.sum(axis=1)
    weighted_share = area * np.sqrt(np.maximum(highest_power, 0.0) * total_power)
    return float(np.sum(weighted_share) / max(np.sum(area * total_power), 1e-300))


def mesh_error(equilibrium: Equilibrium) -> float:
    """Estimate the relative error that the mesh causes in a charge.

    The estimate is the difference from a second mesh if there is one. Otherwise it is predicted from the shapes of the
    elements and the decay of their modes.

    Args:
        equilibrium: The solved press.

    Returns:
        Relative error, at least `MIN_ERROR`.
    """
    if equilibrium.proven_error is not None:
        return max(MIN_ERROR, equilibrium.proven_error)
    mesh = equilibrium.mesh
    decay_error = DECAY_WEIGHT * decay(mesh, node_slope(equilibrium)[..., 2])
    return max(MIN_ERROR, SAFETY * shape_error(mesh), SAFETY * decay_error)


def estimated_error(equilibrium: Equilibrium) -> float:
    """Estimate the relative error that the mesh and the omitted terms of the theory cause in a charge.

    Args:
        equilibrium: The solved press.

    Returns:
        The error, which is infinite if the theory cannot describe the film.
    """
    film = equilibrium.film
    probe = equilibrium.probe
    force = equilibrium.force
    return mesh_error(equilibrium) + modelling_error(film, probe, force, equilibrium.theory)


def relative_difference(one: Equilibrium, other: Equilibrium) -> float:
    """Compute the largest relative difference between two equilibria of the same press.

    The function compares the deflections at the probe, and the charges of square patches on a biaxial and on a uniaxial
    film. The patches lie on rings about the centre of the film and around the footprint. The difference of the charges
    of a patch is relative to the largest charge on its ring.

    Args:
        one: First equilibrium.
        other: Second equilibrium, to which the differences are relative.

    Returns:
        Relative difference, dimensionless.
    """
    # Centres x + iy of the patches, shape (n_ring, PATCHES_PER_RING), mm
    film_radius = one.film.radius
    unit_circle = np.exp(2j * np.pi * np.arange(PATCHES_PER_RING) / PATCHES_PER_RING)
    rings_about_centre = film_radius * np.array(PATCH_RINGS)[:, None] * unit_circle
    ring_about_footprint = complex(*one.at) + one.probe.reach * unit_circle
    patch_centres = np.concatenate([rings_about_centre, ring_about_footprint[None]])

    # Largest difference of the charges, relative to the largest charge on the same ring
    one_charge = _patch_charges(one, patch_centres)
    other_charge = _patch_charges(other, patch_centres)
    largest_on_ring = np.maximum(np.abs(other_charge).max(axis=1, keepdims=True), 1e-300)
    charge_difference = float((np.abs(one_charge - other_charge) / largest_on_ring).max())

    # Difference of the deflections at the centroid of the footprint
    (one_depth,) = deflection(one, np.array([one.at]))
    (other_depth,) = deflection(other, np.array([one.at]))
    depth_difference = abs(float(one_depth / other_depth) - 1.0)
    return max(charge_difference, depth_difference)


def _patch_charges(equilibrium: Equilibrium, centres: Array) -> Array:
    """Compute the charges per area of square patches, for a biaxial and a uniaxial film.

    Args:
        equilibrium: The solved press.
        centres: Centres x + iy of the patches, shape (n_ring, n_patch), mm.

    Returns:
        Charges in arbitrary units, shape (n_ring, n_patch, 2). Points outside the film do not contribute.
    """
    film_radius = equilibrium.film.radius
    xi, eta, weights = gauss_reference_square(PATCH_POINTS)  # coordinates from -1 to 1
    half_side = 0.5 * PATCH_SIDE * film_radius
    complex_points = (centres[:, :, None] + half_side * (xi + 1j * eta)).ravel()
    points = np.stack([complex_points.real, complex_points.imag], axis=1)
    is_on_film = np.abs(complex_points) < film_radius
    stress = np.zeros((len(points), 3))
    stress[is_on_film] = touch_stress(equilibrium, points[is_on_film])

    # Mean over the integration points p, for each ring r, patch a and stress component c. The weights of the reference
    # square add up to 4.
    patch_stress = stress.reshape(*centres.shape, -1, 3)
    mean_stress = np.einsum("rapc,p->rac", patch_stress, 0.25 * weights)

    # On a uniaxial film, d31 is about ten times d32.
    s11 = mean_stress[..., 0]
    s22 = mean_stress[..., 1]
    biaxial_charge = s11 + s22
    uniaxial_charge = 10.0 * s11 + s22
    return np.stack([biaxial_charge, uniaxial_charge], axis=-1)


def cautions(equilibrium: Equilibrium) -> tuple[str, ...]:
    """Return warnings about effects in a real film that the theory does not model, one sentence for each."""
    smallest, largest = principal_stress(equilibrium)
    sentences = []
    if largest > DEFAULT_STRESS_LIMIT:
        sentences.append(f"the film is stressed to {largest:.3g} MPa; PVDF yields from {DEFAULT_STRESS_LIMIT:g} MPa on")
    if smallest < -WRINKLE_SHARE * largest:
        sentences.append(f"the film is compressed to {smallest:.3g} MPa somewhere; a thin film may wrinkle there")
    return tuple(sentences)


def summary(equilibrium: Equilibrium) -> dict[str, Any]:
    """Return the deflection, the theory, the estimated error and the outcome of the solve, for JSON output."""
    (centre_deflection,) = deflection(equilibrium, np.array([equilibrium.at]))
    return {
        "deflection_mm": float(centre_deflection),
        "theory": equilibrium.theory.name,
        "status": equilibrium.status,
        "iterations": equilibrium.iterations,
        "residual": equilibrium.residual,
        "seconds": equilibrium.seconds,
        "estimated_error": finite_or_none(estimated_error(equilibrium)),
        "groups": {
            **{name: getattr(equilibrium.groups, name) for name in GROUPS},
            "bending_length": bending_length(equilibrium.film, equilibrium.force),
        },
        "warnings": list(cautions(equilibrium)),
    }
