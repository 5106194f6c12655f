"""Equilibrium of the film under a press, its deflection and stress, estimates of its error, and warnings.

Before a press is solved, the press and the film are rotated such that the press lies on the positive x axis. The
functions that evaluate an equilibrium rotate their results back into the axes of the film. If the film is axisymmetric,
the same equilibrium is valid for presses in all directions from the centre. An equilibrium is also valid for all
electrode layouts and all piezoelectric coefficients.

In the inner part of the film, two quantities indicate the error that the mesh causes: the shapes of the elements, and
the contribution of the highest polynomial modes to the slopes of the deflection. The estimate is not reliable for
presses near the rim or for large footprints that are not circular. Under such presses, elements that are too coarse may
lie far from the elements with the largest stress. The same holds for a pressure on the whole film, which also bends the
large elements far from the probe. The module `press` therefore solves these presses on meshes of increasing polynomial
order, until two successive meshes result in nearly the same charges. The module also does so if the required accuracy
is better than the default accuracy. If the polynomial order of the elements increases by one, the error decreases by a
factor of three to ten. The difference between the charges of two successive meshes is therefore an upper bound of the
error on the finer mesh.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import SceneError
from isocharge.common.structs import finite_or_none
from isocharge.simulate.mechanics.scaling import (
    DimensionlessGroups,
    Theory,
    bending_length,
    modelling_error,
    scaled_stress,
)
from isocharge.simulate.mechanics.stress import principal_stresses, rotate_stress, strain
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.numerics.interpolation import gauss_reference_square, modal_matrix, tensor_values
from isocharge.simulate.numerics.polygon import to_complex, to_corners
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Probe

SURFACE_HEIGHT = {"middle": 0.0, "top": 1.0, "bottom": -1.0}
"""Height of each surface above the mid-surface in half thicknesses, positive towards the probe."""


@dataclass(frozen=True, kw_only=True)
class Equilibrium:
    """Equilibrium of a film under a press.

    The functions `deflection`, `touch_stress` and `touch_charge` compute the results of a press from its equilibrium.

    Attributes:
        film: The film.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.
        force: Force, N, positive in the direction of the push.
        side_force: Force (Fx, Fy) of the probe on the film in the plane of the film, N.
        theory: Terms of the film theory that were modelled.
        mesh: Mesh under the press. The press is rotated onto the x axis.
        field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3), dimensionless. The press is rotated
            onto the x axis.
        groups: Dimensionless groups of the press.
        status: "converged" or "failed".
        message: Description of the outcome in one sentence.
        iterations: Number of Newton steps with a new tangent.
        residual: Out-of-balance force divided by the load.
        seconds: CPU time of the process for meshing and solving, s.
        proven_error: Relative difference of the charges between this mesh and a mesh whose order is lower by one; None
            if only one mesh was solved.
        rest: Equilibrium on the same mesh before the contact, under the static pressure alone; None if there is no
            static pressure. The touch stress does not include the stress of this equilibrium.
    """

    film: Film
    probe: Probe
    at: tuple[float, float]
    force: float
    side_force: tuple[float, float] = (0.0, 0.0)
    theory: Theory
    mesh: PlacedMesh
    field: Array
    groups: DimensionlessGroups
    status: Literal["converged", "failed"]
    message: str
    iterations: int
    residual: float
    seconds: float
    proven_error: float | None = None
    rest: "Equilibrium | None" = None

    def __repr__(self) -> str:
        """Return a summary of the press, the deflection and the largest stress.

        If the stress exceeds the limit at which PVDF yields, the summary contains a warning.
        """
        (depth,) = deflection(self, np.array([self.at]))
        _, largest_stress = principal_stress(self)
        exceeds_limit = largest_stress > DEFAULT_STRESS_LIMIT
        warning = f", beyond {DEFAULT_STRESS_LIMIT:g} MPa: PVDF yields" if exceeds_limit else ""
        x, y = self.at
        return (
            f"Equilibrium({self.force:g} N under {self.probe.notation} at ({x:g}, {y:g}) mm: {self.status}, deflection "
            f"{depth:.4g} mm, stress up to {largest_stress:.3g} MPa{warning})"
        )


def deflection(equilibrium: Equilibrium, points: Array) -> Array:
    """Compute the deflection of the film at given points, relative to the flat film.

    The result includes the deflection that a static pressure causes.

    Args:
        equilibrium: The solved press.
        points: Points (x, y) on the film, shape (n, 2), mm.

    Returns:
        Deflection, shape (n,), mm, positive in the direction of the push.

    Raises:
        SceneError: If a point lies outside the film.
    """
    mesh = equilibrium.mesh
    element, xi, eta, _ = _locate(equilibrium, points)  # a reflection of points does not change the deflection
    basis_values = tensor_values(mesh.resolution.order, xi, eta)  # shape (n, n_local)
    nodal_field = equilibrium.field[mesh.template.nodes[element]]  # (U1, U2, W), shape (n, n_local, 3)
    scaled_deflection = (basis_values * nodal_field[..., 2]).sum(axis=1)
    deflection_unit = equilibrium.film.radius * np.sqrt(equilibrium.groups.squared_amplitude)
    return np.asarray(deflection_unit * scaled_deflection)


def touch_stress(equilibrium: Equilibrium, points: Array, surface: Surface = "middle") -> Array:
    """Compute the second Piola-Kirchhoff stress that the press adds to the stress before the contact.

    Args:
        equilibrium: The solved press.
        points: Points (x, y) on the film, shape (n, 2), mm.
        surface: Surface of the film at which the stress is computed. The probe touches the surface "top". The bending
            stress is included even if the theory neglects the resistance of the film to bending.

    Returns:
        Stress (s11, s22, s12) in the axes of the film, shape (n, 3), MPa, tension positive.

    Raises:
        SceneError: If a point lies outside the film.
    """
    mesh = equilibrium.mesh
    groups = equilibrium.groups
    element, xi, eta, is_reflected = _locate(equilibrium, points)

    # Strain of the mid-surface
    gradient = mesh.gradient(element, xi, eta)  # derivatives of the basis functions, shape (n, 2, n_local)
    nodal_displacement = equilibrium.field[mesh.template.nodes[element]]  # (U1, U2, W), shape (n, n_local, 3)
    total_strain = strain(gradient @ nodal_displacement, groups.squared_amplitude)

    # Strain by bending, from the second derivatives of W
    if surface != "middle":
        second_derivatives = gradient @ _continuous_slope(equilibrium)[element]
        total_strain += _bending_strain(equilibrium, surface, second_derivatives)

    # Compute the stress in the frame of the press. The shear stress has the opposite sign in the reflected half.
    press_frame_stress = equilibrium.film.young * groups.squared_amplitude * scaled_stress(total_strain, groups)
    press_frame_stress[is_reflected, 2] *= -1.0

    # Rotate the stress into the axes of the film, and subtract the stress of the film before the contact, which is zero
    # without a static pressure.
    x, y = equilibrium.at
    film_stress = rotate_stress(press_frame_stress, np.arctan2(y, x))
    if equilibrium.rest is None:
        return film_stress
    return np.asarray(film_stress - touch_stress(equilibrium.rest, points, surface))


def nodal_stress(equilibrium: Equilibrium, surface: Surface = "middle") -> Array:
    """Compute the scaled touch stress at the nodes of every element.

    The stress components refer to the frame in which the press lies on the positive x axis.

    Args:
        equilibrium: The solved press.
        surface: Surface of the film at which the stress is computed; see `touch_stress`.

    Returns:
        Stress (S11, S22, S12) in units of E_young A^2, shape (n_element, n_local, 3).
    """
    if equilibrium.rest is None:
        return _induced_stress(equilibrium, surface)
    return np.asarray(_induced_stress(equilibrium, surface) - _induced_stress(equilibrium.rest, surface))


def _induced_stress(equilibrium: Equilibrium, surface: Surface) -> Array:
    """Compute the scaled induced stress at the nodes of every element.

    The induced stress is the stress that the probe and the static pressure add to the pretension.

    Args:
        equilibrium: The solved press.
        surface: Surface of the film at which the stress is computed; see `touch_stress`.

    Returns:
        Stress (S11, S22, S12) in units of E_young A^2, shape (n_element, n_local, 3).
    """
    slopes = node_slopes(equilibrium)
    total_strain = strain(slopes, equilibrium.groups.squared_amplitude)
    if surface != "middle":
        second_derivatives = equilibrium.mesh.node_derivatives(_continuous_slope(equilibrium))
        total_strain += _bending_strain(equilibrium, surface, second_derivatives)
    return scaled_stress(total_strain, equilibrium.groups)


def principal_stress(equilibrium: Equilibrium) -> tuple[float, float]:
    """Compute the smallest and the largest principal stress in the film, including the pretension.

    The smallest stress is the minimum over the mid-surface. The largest stress is the maximum over the mid-surface and,
    if the theory includes bending, over both outer surfaces.

    Args:
        equilibrium: The solved press.

    Returns:
        Smallest and largest principal stress, MPa, tension positive.
    """
    # Compute the scaled principal stresses without the mean pretension. The deviator of the pretension is added before,
    # because it changes the directions of the principal stresses.
    groups = equilibrium.groups
    deviator = groups.anisotropy.tension
    smallest, largest = principal_stresses(_induced_stress(equilibrium, "middle") + deviator)
    if equilibrium.theory.bending:
        for surface in ("top", "bottom"):
            _, largest_at_surface = principal_stresses(_induced_stress(equilibrium, surface) + deviator)
            largest = max(largest, largest_at_surface)

    # Convert the stresses to MPa, and add the mean pretension, which is the same in all directions.
    stress_unit = equilibrium.film.young * groups.squared_amplitude
    mean_pretension = equilibrium.film.pretension
    return stress_unit * smallest + mean_pretension, stress_unit * largest + mean_pretension


def node_slopes(equilibrium: Equilibrium) -> Array:
    """Compute the derivatives of (U1, U2, W) with respect to (X1, X2) at the nodes of every element.

    Args:
        equilibrium: The solved press.

    Returns:
        Derivatives, shape (n_element, n_local, 2, 3). The last two axes are the coordinate and the displacement
        component.
    """
    mesh = equilibrium.mesh
    return mesh.node_derivatives(equilibrium.field[mesh.template.nodes])


def _continuous_slope(equilibrium: Equilibrium) -> Array:
    """Compute a slope of the deflection that is continuous from element to element.

    The slope that follows from the solved deflection has small jumps between the elements. Its derivatives within the
    elements do not contain these jumps. The mean bending stress of an electrode would therefore be wrong near the edge
    of the footprint. Therefore, the slope at a node is the mean of the slopes of all elements that share the node. The
    slope is zero at the clamped rim.

    Args:
        equilibrium: The solved press.

    Returns:
        Derivatives of the deflection W with respect to (X1, X2) at the nodes of each element, shape (n_element,
        n_local, 2).
    """
    template = equilibrium.mesh.template
    slope_sum = np.zeros((template.n_node, 2))
    np.add.at(slope_sum, template.nodes, node_slopes(equilibrium)[..., 2])
    element_count = np.bincount(template.nodes.ravel())
    slope = slope_sum / element_count[:, None]
    slope[template.on_rim] = 0.0
    slope[template.on_axis, 1] = 0.0  # the deflection is symmetric about the axis of a half mesh
    return np.asarray(slope[template.nodes])


def _bending_strain(equilibrium: Equilibrium, surface: Surface, second_derivatives: Array) -> Array:
    """Compute the scaled bending strain at a surface of the film.

    The bending strain is the height of the surface above the mid-surface times the curvature of the film.

    Args:
        equilibrium: The solved press.
        surface: Surface of the film.
        second_derivatives: Second derivatives of W with respect to (X1, X2), shape (..., 2, 2).

    Returns:
        Strain (E11, E22, 2 E12), shape (..., 3), in units of A^2.
    """
    film = equilibrium.film
    amplitude = np.sqrt(equilibrium.groups.squared_amplitude)
    # Half of the thickness in the unit of the deflection, which is the film radius times the amplitude
    half_thickness = 0.5 * film.thickness / (film.radius * amplitude)
    curvature_11 = second_derivatives[..., 0, 0]
    curvature_22 = second_derivatives[..., 1, 1]
    double_curvature_12 = second_derivatives[..., 0, 1] + second_derivatives[..., 1, 0]
    curvature = np.stack([curvature_11, curvature_22, double_curvature_12], axis=-1)
    return np.asarray((SURFACE_HEIGHT[surface] * half_thickness) * curvature)


def _locate(equilibrium: Equilibrium, points: Array) -> tuple[Integers, Array, Array, Booleans]:
    """Find the elements that contain given points, and the local coordinates of the points in their elements.

    Args:
        equilibrium: The solved press.
        points: Points (x, y), shape (n, 2), mm.

    Returns:
        Index of the element, local coordinates xi and eta, and whether the point was reflected into the meshed half,
        each of shape (n,).

    Raises:
        SceneError: If a point lies outside the film.
    """
    points = np.asarray(points, dtype=float)
    film = equilibrium.film
    distance = np.hypot(points[:, 0], points[:, 1])  # from the centre of the film
    rim_distance = film.rim_distance(np.arctan2(points[:, 1], points[:, 0]))

    # The condition is negated, so that points with NaN count as outside. The tolerance is for rounding errors.
    is_outside = ~(distance <= rim_distance * (1.0 + 1e-9))
    if is_outside.any():
        first_outside = np.argmax(is_outside)
        x, y = points[first_outside]
        raise SceneError(f"point ({x:.4g}, {y:.4g}) mm is off the film of radius {film.radius:.4g} mm")

    # Rotate the points, x + iy in film radii, into the frame in which the press lies on the positive x axis.
    press_x, press_y = equilibrium.at
    return equilibrium.mesh.locate(to_complex(points) / film.radius * np.exp(-1j * np.arctan2(press_y, press_x)))


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


def shape_error(mesh: PlacedMesh) -> float:
    """Predict the relative error of a charge from the shapes of the elements.

    The elements approximate the conformal map by polynomials, so the area of the mesh differs slightly from the area of
    the film. The predicted error is the square root of the relative difference between the area of the mesh and the
    area of the film. The largest error of a charge of random presses is about a third of the predicted error.

    Args:
        mesh: Mesh of the press.

    Returns:
        Predicted error, which is infinite if an element is folded.
    """
    geometry = mesh.geometry
    is_folded = geometry.weights.min() <= 0.0 or geometry.mass.min() <= 0.0
    if is_folded:
        return np.inf
    film_area = np.pi * (1.0 + 0.5 * abs(mesh.oval) ** 2)  # in squared film radii
    mesh_area = mesh.template.copies * geometry.weights.sum()
    return float(np.sqrt(abs(mesh_area / film_area - 1.0)))


def highest_mode_share(mesh: PlacedMesh, slope: Array) -> float:
    """Compute the share of the highest polynomial modes in the slopes of the deflection.

    The slopes in each element are expanded in products of Legendre polynomials. A small share of the polynomials of the
    highest degree indicates that the mesh is fine enough.

    Args:
        mesh: Mesh of the press.
        slope: Gradient of W at the nodes of every element, shape (n_element, n_local, 2).

    Returns:
        Mean of the shares in all elements, weighted with the areas of the elements and the squares of the slopes.
    """
    # Convert the values on the square grid of nodes into coefficients of products of Legendre polynomials in xi and
    # eta, shape (n_element, 2, n_node, n_node).
    n_node = mesh.resolution.order + 1
    nodes_to_modes = modal_matrix(mesh.resolution.order)
    nodal_slope = slope.transpose(0, 2, 1).reshape(len(slope), 2, n_node, n_node)
    coefficients = nodes_to_modes @ nodal_slope @ nodes_to_modes.T

    # The power of a mode is the sum of its mean squares in both slopes. The mean square of the Legendre polynomial of
    # degree n is 1 / (2 n + 1).
    mean_square = 1.0 / (2.0 * np.arange(n_node) + 1.0)
    power = (coefficients**2 * np.outer(mean_square, mean_square)).sum(axis=1)  # shape (n_element, n_node, n_node)
    total_power = power.sum(axis=(1, 2))
    lower_power = power[:, :-1, :-1].sum(axis=(1, 2))  # of modes without the highest degree in xi and in eta
    highest_power = total_power - lower_power

    # The share of an element is sqrt(highest power / total power), and its weight is area * total power.
    area = mesh.geometry.weights.sum(axis=1)
    weighted_share = area * np.sqrt(np.maximum(highest_power, 0.0) * total_power)
    total_weight = max(np.sum(area * total_power), 1e-300)  # the limit avoids a division by zero
    return float(np.sum(weighted_share) / total_weight)


def mesh_error(equilibrium: Equilibrium) -> float:
    """Estimate the relative error that the mesh causes in a charge.

    If the press was solved on two meshes, the estimate is the relative difference between the results on both meshes.
    If the press was solved on one mesh, the estimate is the larger of two predictions. One is made from the shapes of
    the elements, and the other from the share of the highest polynomial modes in the slopes.

    Args:
        equilibrium: The solved press.

    Returns:
        Relative error, which is at least `MIN_MESH_ERROR`.
    """
    if equilibrium.proven_error is not None:
        return max(MIN_MESH_ERROR, equilibrium.proven_error)
    mesh = equilibrium.mesh
    slope_of_deflection = node_slopes(equilibrium)[..., 2]
    mode_error = MODE_SHARE_WEIGHT * highest_mode_share(mesh, slope_of_deflection)
    return max(MIN_MESH_ERROR, MESH_ERROR_SAFETY * shape_error(mesh), MESH_ERROR_SAFETY * mode_error)


def estimated_error(equilibrium: Equilibrium) -> float:
    """Estimate the relative error that the mesh and the omitted terms of the theory cause in a charge.

    Args:
        equilibrium: The solved press.

    Returns:
        Relative error, which is infinite if the theory cannot describe the film.
    """
    bending_error = modelling_error(equilibrium.film, equilibrium.probe, equilibrium.force, equilibrium.theory)
    return mesh_error(equilibrium) + bending_error


PATCH_RING_RADII = (0.0, 0.1, 0.22, 0.4, 0.6, 0.8)
"""Radii of the rings on which square patches are placed to compare the charges of two meshes, in film radii."""


def relative_difference(one: Equilibrium, other: Equilibrium, patches_per_ring: int = 12) -> float:
    """Compute the largest relative difference between two equilibria of the same press.

    The function compares the deflections at the probe, and the charges that square patches of the film would collect.
    The charges are compared for a biaxial film and for a uniaxial film. The patches lie on rings around the centre of
    the film, and on a ring around the footprint. The difference between the two charges of a patch is divided by the
    largest charge of all patches on the same ring.

    Args:
        one: First equilibrium.
        other: Second equilibrium. The differences are relative to its deflection and its charges.
        patches_per_ring: Number of patches on each ring.

    Returns:
        Relative difference, dimensionless.
    """
    # Centres x + iy of the patches, shape (n_ring, patches_per_ring), mm
    film_radius = one.film.radius
    unit_circle = np.exp(2j * np.pi * np.arange(patches_per_ring) / patches_per_ring)
    rings_around_centre = film_radius * np.array(PATCH_RING_RADII)[:, None] * unit_circle
    ring_around_footprint = complex(*one.at) + one.probe.reach * unit_circle
    patch_centres = np.concatenate([rings_around_centre, ring_around_footprint[None]])

    # Largest difference of the charges, relative to the largest charge on the same ring
    one_charge = _patch_charges(one, patch_centres)
    other_charge = _patch_charges(other, patch_centres)
    largest_on_ring = np.maximum(np.abs(other_charge).max(axis=1, keepdims=True), 1e-300)
    charge_difference = float((np.abs(one_charge - other_charge) / largest_on_ring).max())

    # Relative difference of the deflections at the centroid of the footprint
    (one_deflection,) = deflection(one, np.array([one.at]))
    (other_deflection,) = deflection(other, np.array([one.at]))
    deflection_difference = abs(float(one_deflection / other_deflection) - 1.0)
    return max(charge_difference, deflection_difference)


def _patch_charges(
    equilibrium: Equilibrium, centres: Complexes, relative_side: float = 1.0 / 15.0, points_per_side: int = 6
) -> Array:
    """Compute the charge per area of each square patch, for a biaxial film and for a uniaxial film.

    Args:
        equilibrium: The solved press.
        centres: Centres x + iy of the patches, shape (n_ring, n_patch), mm.
        relative_side: Side of the patches, in film radii.
        points_per_side: Number of Gauss points along the side of a patch.

    Returns:
        Charges per area in arbitrary units, shape (n_ring, n_patch, 2). The last axis is the kind of film. The part of
        a patch outside the film does not contribute.
    """
    # Integration points of all patches. The coordinates xi and eta range from -1 to 1.
    film_radius = equilibrium.film.radius
    xi, eta, weights = gauss_reference_square(points_per_side)
    half_side = 0.5 * relative_side * film_radius
    complex_points = (centres[:, :, None] + half_side * (xi + 1j * eta)).ravel()
    points = to_corners(complex_points)

    # Stress at the integration points. The stress is set to zero outside the film.
    is_on_film = np.abs(complex_points) < equilibrium.film.rim_distance(np.angle(complex_points))
    stress = np.zeros((len(points), 3))
    stress[is_on_film] = touch_stress(equilibrium, points[is_on_film])

    # Mean over the integration points p, for each ring r, patch a and stress component c. The weights of the reference
    # square are divided by their sum, which is 4.
    patch_stress = stress.reshape(*centres.shape, -1, 3)
    mean_stress = np.einsum("rapc,p->rac", patch_stress, 0.25 * weights)

    # The coefficients d31 and d32 of a biaxial film are equal. On a uniaxial film, d31 is about ten times d32.
    coefficients = np.array([[1.0, 10.0], [1.0, 1.0]])  # one column for each kind of film
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


REPORTED_GROUPS = ("squared_amplitude", "load", "tension", "bending", "poisson")
"""Attributes of `DimensionlessGroups` that the JSON output contains."""


def summary(equilibrium: Equilibrium) -> dict[str, Any]:
    """Return the results of a solved press as a dictionary for JSON output.

    The dictionary contains the deflection, the theory, the estimated error, the outcome of the solve, the dimensionless
    groups and the warnings.

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
        "estimated_error": finite_or_none(estimated_error(equilibrium)),
        "groups": {
            **{name: getattr(equilibrium.groups, name) for name in REPORTED_GROUPS},
            "bending_length": bending_length(equilibrium.film, equilibrium.force),
        },
        "warnings": list(cautions(equilibrium)),
    }
