"""Estimates of the errors of a solved press, warnings, and a summary of its results.

In the inner part of the film, two quantities indicate the error that the mesh causes: the shapes of the elements, and
the contribution of the highest polynomial modes to the slopes of the deflection. The estimate is not reliable for
presses near the rim or for large footprints that are not circular. Under such presses, elements that are too coarse may
lie far from the elements with the largest stress. The estimate is not reliable for a pressure on the whole film,
either, because the pressure also bends the large elements far from the probe. The module `press` therefore solves these
presses on meshes of increasing polynomial order, until two successive meshes result in nearly the same charges. The
module also does so if the required accuracy is better than the default accuracy. If the polynomial order of the
elements increases by one, the error decreases by a factor of three to ten. The difference between the charges of two
successive meshes is therefore an upper bound of the error on the finer mesh.
"""

from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.structs import plain_values
from isocharge.simulate.mechanics.theory import bending_length, bending_stiffness
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.numerics.interpolation import gauss_reference_square, modal_matrix
from isocharge.simulate.numerics.polygon import to_corners
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.solver.equilibrium import Equilibrium, deflection, node_slopes, principal_stress, touch_stress

MESH_ERROR_SAFETY = 2.0
"""Safety factor of the error that is predicted from the elements and their modes, dimensionless.

The factor is too small for presses at distances above 0.6 film radii.
"""

MIN_MESH_ERROR = 5e-5
"""Smallest relative error of a charge that is reported.

The thin rings and the integration over the electrodes cause an error of this order.
"""

MODE_SHARE_WEIGHT = 0.1
"""Ratio of the relative error of a charge to the share of the highest modes in the slopes, dimensionless."""

BENDING_WEIGHT = 1.5
"""Factor in the estimate of the relative error of a charge that is computed without bending.

The factor multiplies the ratio of the bending length to the film radius. The largest factor in the reference cases of
tests/data is 1.41.
"""

DIRECTION_WEIGHT = 0.35
"""Ratio of the relative standard deviation of the bending stiffness over all directions to ln(E1 / E2)."""

MAX_MEMBRANE_BENDING_LENGTH = 0.3
"""Bending length, in film radii, above which a membrane does not describe the film. The error is then infinite."""


def highest_mode_share(mesh: PlacedMesh, slope: Array) -> float:
    """Compute the share of the highest polynomial modes in the slopes of the deflection.

    The slopes in each element are expanded in products of Legendre polynomials, the modes. A small share of the modes
    of the highest degree indicates that the mesh is fine enough.

    Args:
        mesh: Mesh of the press.
        slope: Gradient of W at the nodes of every element, shape (n_element, n_local, 2).

    Returns:
        Mean of the shares in all elements, weighted with the areas of the elements and the squares of the slopes.
    """
    # Arrange the nodes of each element in a square grid, whose rows belong to eta and whose columns belong to xi.
    # Convert the values along both axes into the coefficients of the Legendre polynomials of degree 0 to `order`.
    nodes_per_side = mesh.resolution.order + 1
    nodes_to_modes = modal_matrix(mesh.resolution.order)
    slope_by_component = slope.transpose(0, 2, 1)  # shape (n_element, 2, n_local)
    nodal_slope = slope_by_component.reshape(len(slope), 2, nodes_per_side, nodes_per_side)
    coefficients = nodes_to_modes @ nodal_slope @ nodes_to_modes.T  # shape (n_element, 2, n_degree, n_degree)

    # The power of a mode is its mean square over the element, summed over both slopes. The mean square of the Legendre
    # polynomial of degree n is 1 / (2 n + 1).
    mean_square = 1.0 / (2.0 * np.arange(nodes_per_side) + 1.0)
    power = (coefficients**2 * np.outer(mean_square, mean_square)).sum(axis=1)  # shape (n_element, n_degree, n_degree)
    total_power = power.sum(axis=(1, 2))
    lower_power = power[:, :-1, :-1].sum(axis=(1, 2))  # of the modes with a lower degree in both xi and eta
    highest_power = np.maximum(total_power - lower_power, 0.0)  # rounding errors could make it negative

    # The share of an element is sqrt(highest power / total power), and its weight is area * total power. The product
    # area * sqrt(highest power * total power) avoids a division by zero in a flat element.
    area = mesh.weights.sum(axis=1)
    weighted_share = area * np.sqrt(highest_power * total_power)
    total_weight = max(np.sum(area * total_power), 1e-300)  # the limit avoids a division by zero
    return float(np.sum(weighted_share) / total_weight)


def mesh_error(equilibrium: Equilibrium) -> float:
    """Estimate the relative error that the mesh causes in a charge.

    If the press was solved on two meshes, the estimate is the relative difference between the results on both meshes.
    If the press was solved on one mesh, the estimate is the larger of two predictions: that from the shapes of the
    elements, and that from the share of the highest polynomial modes in the slopes.

    Args:
        equilibrium: The solved press.

    Returns:
        Relative error, which is at least `MIN_MESH_ERROR`.
    """
    if equilibrium.proven_error is not None:
        return max(MIN_MESH_ERROR, equilibrium.proven_error)
    mesh = equilibrium.mesh
    slope_of_deflection = node_slopes(equilibrium)[..., 2]  # derivatives of W, after those of U1 and U2
    mode_error = MODE_SHARE_WEIGHT * highest_mode_share(mesh, slope_of_deflection)
    return max(MIN_MESH_ERROR, MESH_ERROR_SAFETY * mesh.shape_error, MESH_ERROR_SAFETY * mode_error)


def modelling_error(film: Film, probe: Probe, force: float) -> float:
    """Estimate the relative error that omitted bending causes in a charge.

    The error has two parts. The error that arises at the clamp is proportional to the bending length there. The error
    that arises at the footprint is proportional to the square of b / R, where b is the bending length at the footprint,
    and R is the reach of the footprint. This error is larger if most of the tension at the footprint is pretension.

    The slope w' of the film at the edge of the footprint follows from two equations. The vertical component of the
    stress S along the edge carries the force: 2 pi R h S w' = F. The slope stretches the film: S = E w'^2 / 2.
    Together, w'^3 = F / (pi R h E).

    Args:
        film: The film, with Young's modulus E and thickness h.
        probe: The probe, whose footprint has the reach R.
        force: Force F of the press, N.

    Returns:
        The error, which is infinite for a thick film.
    """
    clamp_length = bending_length(film, force)  # in film radii
    if clamp_length > MAX_MEMBRANE_BENDING_LENGTH:
        return np.inf
    clamp_error = BENDING_WEIGHT * clamp_length

    # Compute the stresses at the footprint, divided by Young's modulus. The tension is the pretension plus S.
    slope = np.cbrt(force / (np.pi * probe.reach * film.thickness * film.young))
    pretension = max(film.pretension, 0.0) / film.young
    tension = pretension + 0.5 * slope**2

    # The squared bending length b^2, in film radii, is the bending stiffness divided by the tension. The ratio of the
    # radii converts it to the unit R.
    squared_length_ratio = bending_stiffness(film) / tension * (film.radius / probe.reach) ** 2
    footprint_weight = 0.5 + 5.0 * pretension / tension  # empirical, for an electrode beside the footprint
    return float(clamp_error + footprint_weight * squared_length_ratio)


def estimated_error(equilibrium: Equilibrium) -> float:
    """Estimate the relative error that the mesh and the omitted terms of the theory cause in a charge.

    A theory with bending averages the bending stiffness of an orthotropic film over all directions. The error of this
    mean is the effect of bending on a charge, which is at most 1, multiplied by the relative standard deviation of the
    bending stiffness over the directions.

    Args:
        equilibrium: The solved press.

    Returns:
        Relative error, which is infinite if the theory cannot describe the film.
    """
    bending_error = modelling_error(equilibrium.film, equilibrium.probe, equilibrium.force)
    if equilibrium.theory.bending:
        stiffness_deviation = DIRECTION_WEIGHT * abs(np.log(equilibrium.film.young_ratio))
        bending_error = stiffness_deviation * min(bending_error, 1.0)
    return mesh_error(equilibrium) + bending_error


PATCH_RING_RADII = (0.0, 0.1, 0.22, 0.4, 0.6, 0.8)
"""Radii of the rings on which square patches are placed to compare the charges of two meshes, in film radii."""


def relative_difference(solved: Equilibrium, reference: Equilibrium) -> float:
    """Compute the largest relative difference of an equilibrium from another equilibrium of the same press.

    The function compares the deflections at the probe, and the charges that square patches of the film would collect.
    The charges are compared for a biaxial film and for a uniaxial film. The patches lie on rings around the centre of
    the film, and on a ring around the footprint. The difference between the two charges of a patch is divided by the
    largest charge of all patches on the same ring.

    Args:
        solved: The equilibrium.
        reference: The other equilibrium. The differences are relative to its deflection and its charges.

    Returns:
        Relative difference, dimensionless.
    """
    # Centres x + iy of the patches, shape (n_ring, patches_per_ring), mm
    patches_per_ring = 12
    film_radius = solved.film.radius
    unit_circle = np.exp(2j * np.pi * np.arange(patches_per_ring) / patches_per_ring)
    rings_around_centre = film_radius * np.array(PATCH_RING_RADII)[:, None] * unit_circle
    ring_around_footprint = complex(*solved.at) + solved.probe.reach * unit_circle
    patch_centres = np.concatenate([rings_around_centre, ring_around_footprint[None]])

    # Largest difference of the charges, relative to the largest charge on the same ring
    charges = _patch_charges(solved, patch_centres)
    reference_charges = _patch_charges(reference, patch_centres)
    largest_on_ring = np.abs(reference_charges).max(axis=1, keepdims=True)
    charge_unit = np.maximum(largest_on_ring, 1e-300)  # the limit avoids a division by zero
    charge_difference = float((np.abs(charges - reference_charges) / charge_unit).max())

    # Relative difference of the deflections at the centroid of the footprint
    position = np.array([solved.at])
    (solved_deflection,) = deflection(solved, position)
    (reference_deflection,) = deflection(reference, position)
    deflection_difference = abs(float(solved_deflection / reference_deflection) - 1.0)
    return max(charge_difference, deflection_difference)


def _patch_charges(equilibrium: Equilibrium, centres: Complexes) -> Array:
    """Compute the charge per area of each square patch, for a biaxial film and for a uniaxial film.

    The side of a patch is a fifteenth of the film radius.

    Args:
        equilibrium: The solved press.
        centres: Centres x + iy of the patches, shape (n_ring, n_patch), mm.

    Returns:
        Charges per area in arbitrary units, shape (n_ring, n_patch, 2). The last axis contains the charge of the
        biaxial film and the charge of the uniaxial film. The part of a patch outside the film does not contribute.
    """
    # Integration points of all patches, six along each side. The coordinates xi and eta range from -1 to 1.
    film_radius = equilibrium.film.radius
    xi, eta, weights = gauss_reference_square(6)
    half_side = film_radius / 30.0
    complex_points = (centres[:, :, None] + half_side * (xi + 1j * eta)).ravel()
    points = to_corners(complex_points)

    # Stress at the integration points. The stress is set to zero outside the film.
    is_on_film = equilibrium.film.relative_distance(complex_points) < 1.0
    stress = np.zeros((len(points), 3))
    stress[is_on_film] = touch_stress(equilibrium, points[is_on_film])

    # Compute the mean stress of each patch. The sum of the weights of the integration points is 4.
    patch_stress = stress.reshape(*centres.shape, -1, 3)  # shape (n_ring, n_patch, n_point, 3)
    mean_stress = 0.25 * (weights @ patch_stress)

    # The charge per area is d31 s11 + d32 s22. The coefficients d31 and d32 of a biaxial film are equal. On a uniaxial
    # film, d31 is about ten times d32.
    biaxial_coefficients = [1.0, 1.0]
    uniaxial_coefficients = [10.0, 1.0]
    coefficients = np.stack([biaxial_coefficients, uniaxial_coefficients], axis=1)
    return np.asarray(mean_stress[..., :2] @ coefficients)


WRINKLE_SHARE = 1e-3
"""Ratio of the compression to the largest stress above which a warning is given, dimensionless."""


def cautions(equilibrium: Equilibrium) -> tuple[str, ...]:
    """Return warnings about effects in a real film that the theory does not model.

    Args:
        equilibrium: The solved press.

    Returns:
        One sentence for each warning.
    """
    smallest, largest = principal_stress(equilibrium)
    sentences = []
    if largest > DEFAULT_STRESS_LIMIT:
        sentences.append(f"the film is stressed to {largest:.3g} MPa; PVDF yields from {DEFAULT_STRESS_LIMIT:g} MPa on")
    if smallest < -WRINKLE_SHARE * largest:
        sentences.append(f"the film is compressed to {smallest:.3g} MPa somewhere; a thin film may wrinkle there")
    smallest_tension = equilibrium.film.pretension - np.hypot(*equilibrium.film.deviator)
    if smallest_tension < 0.0:
        sentences.append(
            f"without a press, the film is compressed to {smallest_tension:.3g} MPa; if it wrinkles then, the measured "
            "charges are smaller, because touch charges are computed relative to the flat film"
        )
    return tuple(sentences)


def summary(equilibrium: Equilibrium) -> dict[str, Any]:
    """Return the results of a solved press as a dictionary for JSON output.

    The dictionary contains the deflection, the theory, the estimated error, the outcome of the solve and the warnings.

    Args:
        equilibrium: The solved press.
    """
    (centre_deflection,) = deflection(equilibrium, np.array([equilibrium.at]))
    return {
        "deflection_mm": float(centre_deflection),
        "theory": equilibrium.theory.name,
        "status": equilibrium.status,
        "iterations": equilibrium.iterations,
        "residual": equilibrium.residual,
        "seconds": equilibrium.seconds,
        "estimated_error": plain_values(estimated_error(equilibrium)),
        "warnings": list(cautions(equilibrium)),
    }
