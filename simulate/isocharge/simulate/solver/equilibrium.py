"""Equilibrium of the film under a press, its deflection and its stress.

Before a press is solved, the press and the film are rotated such that the press lies on the positive x axis. The
functions that evaluate an equilibrium rotate their results back into the axes of the film. If the film is axisymmetric,
the same equilibrium is valid for presses in all directions from the centre. An equilibrium is also valid for all
electrode layouts and all piezoelectric coefficients.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.theory import (
    DimensionlessGroups,
    Theory,
    principal_stresses,
    rotate_stress,
    strain,
)
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.mesh.template import locate_points
from isocharge.simulate.numerics.interpolation import gauss_reference_square, tensor_values
from isocharge.simulate.numerics.polygon import to_complex, to_corners
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.solver.newton import NewtonResult

SURFACE_HEIGHT = {"middle": 0.0, "top": 1.0, "bottom": -1.0}
"""Height of each surface above the mid-surface in units of half the film thickness, positive towards the probe."""


@dataclass(frozen=True, kw_only=True)
class Equilibrium(NewtonResult):
    """Equilibrium of a film under a press.

    The functions `deflection`, `touch_stress` and `touch_charge` compute the results of a press from its equilibrium.
    The class `NewtonResult` describes the attributes `field`, `status`, `message`, `iterations` and `residual`.

    Attributes:
        film: The film.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.
        force: Force, N, positive in the direction of the push.
        side_force: Force (Fx, Fy) of the probe on the film in the plane of the film, N.
        theory: Terms of the film theory that were modelled.
        mesh: Mesh under the press. The press is rotated onto the x axis.
        groups: Dimensionless groups of the press.
        seconds: CPU time of the process for meshing and solving, s.
        proven_error: Relative difference of the charges between this mesh and a mesh whose order is lower by one; None
            if the press was solved on one mesh only.
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
    groups: DimensionlessGroups
    seconds: float
    proven_error: float | None = None
    rest: "Equilibrium | None" = None

    @property
    def elastic(self) -> ElasticFilm:
        """Discrete model of the film, in which the press is rotated onto the x axis."""
        return ElasticFilm(self.mesh, self.groups)

    @property
    def direction(self) -> float:
        """Direction from the centre of the film to the press, rad."""
        x, y = self.at
        return math.atan2(y, x)

    def __repr__(self) -> str:
        """Return a summary of the press, the deflection and the largest stress.

        If the stress exceeds the limit at which PVDF yields, the summary contains a warning.
        """
        (probe_deflection,) = deflection(self, np.array([self.at]))
        _, largest_stress = principal_stress(self)
        exceeds_limit = largest_stress > DEFAULT_STRESS_LIMIT
        warning = f", beyond {DEFAULT_STRESS_LIMIT:g} MPa: PVDF yields" if exceeds_limit else ""
        x, y = self.at
        return (
            f"Equilibrium({self.force:g} N under {self.probe.notation} at ({x:g}, {y:g}) mm: {self.status}, deflection "
            f"{probe_deflection:.4g} mm, stress up to {largest_stress:.3g} MPa{warning})"
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
    # The last value, which is not needed, states which points were reflected into the meshed part. A reflection does
    # not change the deflection.
    element, xi, eta, _ = _locate(equilibrium, points)
    basis_values = tensor_values(mesh.resolution.order, xi, eta)  # shape (n, n_local)
    nodal_field = equilibrium.field[mesh.template.nodes[element]]  # (U1, U2, W), shape (n, n_local, 3)
    scaled_deflection = (basis_values * nodal_field[..., 2]).sum(axis=1)
    # The unit of the deflection W is the film radius times the amplitude.
    deflection_unit = equilibrium.film.radius * np.sqrt(equilibrium.groups.squared_amplitude)
    return np.asarray(deflection_unit * scaled_deflection)


def touch_stress(equilibrium: Equilibrium, points: Array, surface: Surface = "middle") -> Array:
    """Compute the second Piola-Kirchhoff stress that the press adds to the stress before the contact.

    Args:
        equilibrium: The solved press.
        points: Points (x, y) on the film, shape (n, 2), mm.
        surface: Surface of the film at which the stress is computed. The probe touches the surface "top". At an outer
            surface, the bending stress is included even if the theory neglects the bending stiffness of the film.

    Returns:
        Stress (s11, s22, s12) in the axes of the film, shape (n, 3), MPa, tension positive.

    Raises:
        SceneError: If a point lies outside the film.
    """
    # Compute the scaled stress in the frame of the press. The function in the third argument computes the derivatives
    # of fields at the points from their values at the nodes of every element.
    element, xi, eta, is_reflected = _locate(equilibrium, points)
    gradient = equilibrium.mesh.gradient(element, xi, eta)  # of the basis functions, shape (n, 2, n_local)
    scaled_stress = _induced_stress(equilibrium, surface, lambda values: gradient @ values[element])

    # Convert the stress to MPa. The shear stress has the opposite sign in the reflected half.
    stress_unit = equilibrium.film.young * equilibrium.groups.squared_amplitude
    press_frame_stress = stress_unit * scaled_stress
    press_frame_stress[is_reflected, 2] *= -1.0

    # Rotate the stress into the axes of the film, and subtract the stress of the film before the contact. `rest` is the
    # equilibrium before the contact under a static pressure alone, and has no `rest` of its own. Without a static
    # pressure, there is no stress before the contact.
    film_stress = rotate_stress(press_frame_stress, equilibrium.direction)
    if equilibrium.rest is None:
        return film_stress
    return film_stress - touch_stress(equilibrium.rest, points, surface)


def nodal_stress(equilibrium: Equilibrium, surface: Surface = "middle") -> Array:
    """Compute the scaled touch stress at the nodes of every element.

    The stress components refer to the frame in which the press lies on the positive x axis.

    Args:
        equilibrium: The solved press.
        surface: Surface of the film at which the stress is computed. The probe touches the surface "top".

    Returns:
        Stress (S11, S22, S12) in units of E_young A^2, shape (n_element, n_local, 3).
    """
    stress = _induced_stress(equilibrium, surface, equilibrium.mesh.node_derivatives)
    if equilibrium.rest is None:
        return stress
    return stress - nodal_stress(equilibrium.rest, surface)


def _induced_stress(equilibrium: Equilibrium, surface: Surface, derivatives_of: Callable[[Array], Array]) -> Array:
    """Compute the scaled induced stress at some points of the elements.

    The induced stress is the stress that the probe and the static pressure add to the pretension. At an outer surface,
    the induced stress includes the bending stress.

    Args:
        equilibrium: The solved press.
        surface: Surface of the film at which the stress is computed. The probe touches the surface "top".
        derivatives_of: Function that computes the derivatives of fields at the points. Its argument contains the values
            of the fields at the nodes of every element, shape (n_element, n_local, k). It returns the derivatives with
            respect to (X1, X2), shape (..., 2, k).

    Returns:
        Stress (S11, S22, S12) in units of E_young A^2, shape (..., 3). The amplitude A of the press is the approximate
        deflection of the film in film radii.
    """
    # The attribute `groups` contains the dimensionless numbers of the press, `field` the displacements (U1, U2, W).
    nodal_displacement = equilibrium.field[equilibrium.mesh.template.nodes]
    surface_strain = strain(derivatives_of(nodal_displacement), equilibrium.groups.squared_amplitude)
    if surface != "middle":
        # The second derivatives of W are the derivatives of its slope. The slope of the solved W jumps between the
        # elements, so it is first replaced by a slope that is continuous.
        second_derivatives = derivatives_of(_continuous_slope(equilibrium))
        surface_strain += _bending_strain(equilibrium, surface, second_derivatives)
    return surface_strain @ equilibrium.groups.elasticity


def principal_stress(equilibrium: Equilibrium) -> tuple[float, float]:
    """Compute the smallest and the largest principal stress in the film, including the pretension.

    The smallest stress is the minimum over the mid-surface. The largest stress is the maximum over the mid-surface and,
    if the theory includes bending, over both outer surfaces.

    Args:
        equilibrium: The solved press.

    Returns:
        Smallest and largest principal stress, MPa, tension positive.
    """
    # Compute the principal stresses, scaled and without the mean pretension. The stress tensor includes the uneven part
    # of the pretension, because this part changes the directions of the principal stresses.
    uneven_tension = equilibrium.groups.uneven_tension  # in the unit of the scaled stresses
    without_rest = replace(equilibrium, rest=None)  # so that the stress before the contact is not subtracted
    surfaces: list[Surface] = ["middle", "top", "bottom"] if equilibrium.theory.bending else ["middle"]
    stresses = [principal_stresses(nodal_stress(without_rest, surface) + uneven_tension) for surface in surfaces]
    smallest, _ = stresses[0]  # on the mid-surface
    largest = max(largest_at_surface for _, largest_at_surface in stresses)

    # Convert the stresses to MPa, and add the mean pretension, which is the same in all directions.
    stress_unit = equilibrium.film.young * equilibrium.groups.squared_amplitude
    smallest_MPa = stress_unit * smallest + equilibrium.film.pretension
    largest_MPa = stress_unit * largest + equilibrium.film.pretension
    return smallest_MPa, largest_MPa


def _continuous_slope(equilibrium: Equilibrium) -> Array:
    """Compute a slope of the deflection that is continuous from element to element.

    The slope that follows from the solved deflection has small jumps between the elements. The derivatives of the slope
    within the elements do not contain these jumps. If these derivatives were used, the mean bending stress of an
    electrode would be wrong near the edge of the footprint. Therefore, the slope at a node is set to the mean of the
    slopes in all elements that share the node. The slope is zero at the clamped rim.

    Args:
        equilibrium: The solved press.

    Returns:
        Derivatives of the deflection W with respect to (X1, X2) at the nodes of each element, shape (n_element,
        n_local, 2).
    """
    mesh = equilibrium.mesh
    template = mesh.template
    nodal_displacement = equilibrium.field[template.nodes]  # (U1, U2, W)
    element_slope = mesh.node_derivatives(nodal_displacement)[..., 2]  # of W, shape (n_element, n_local, 2)
    slope_sum = np.zeros((template.n_node, 2))
    np.add.at(slope_sum, template.nodes, element_slope)
    element_count = np.bincount(template.nodes.ravel())  # number of elements that share each node
    slope = slope_sum / element_count[:, None]
    slope[template.on_rim] = 0.0
    # The deflection of a half mesh is symmetric about the x axis, so its slope across this axis is zero there.
    slope[template.on_axis, 1] = 0.0
    return slope[template.nodes]


def _bending_strain(equilibrium: Equilibrium, surface: Surface, second_derivatives: Array) -> Array:
    """Compute the scaled bending strain at a surface of the film.

    The bending strain is the height of the surface above the mid-surface times the curvature of the film.

    Args:
        equilibrium: The solved press.
        surface: Surface of the film.
        second_derivatives: Second derivatives of W with respect to (X1, X2), shape (..., 2, 2).

    Returns:
        Strain (E11, E22, 2 E12), shape (..., 3), in units of A^2, where A is the amplitude of the press.
    """
    film = equilibrium.film
    amplitude = np.sqrt(equilibrium.groups.squared_amplitude)
    # Half of the thickness in the unit of the deflection, which is the film radius times the amplitude
    half_thickness = 0.5 * film.thickness / (film.radius * amplitude)
    curvature_11 = second_derivatives[..., 0, 0]
    curvature_22 = second_derivatives[..., 1, 1]
    double_curvature_12 = second_derivatives[..., 0, 1] + second_derivatives[..., 1, 0]
    curvature = np.stack([curvature_11, curvature_22, double_curvature_12], axis=-1)
    # The relative height is 0 in the middle, 1 at the top and -1 at the bottom.
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
    film = equilibrium.film
    complex_points = to_complex(np.asarray(points, dtype=float))

    # The condition is negated, so that points with NaN count as outside. The tolerance is for rounding errors.
    is_outside = ~(film.relative_distance(complex_points) <= 1.0 + 1e-9)
    if is_outside.any():
        x, y = points[np.argmax(is_outside)]
        raise SceneError(f"point ({x:.4g}, {y:.4g}) mm is off the film of radius {film.radius:.4g} mm")

    # Rotate the points, x + iy in film radii, into the frame in which the press lies on the positive x axis.
    rotated_points = complex_points / film.radius * np.exp(-1j * equilibrium.direction)

    # `locate_points` expects one row of points for each placement. Here, there is a single placement.
    mesh = equilibrium.mesh
    element, xi, eta, is_reflected = locate_points(mesh.placement[None], mesh.template, rotated_points[None])
    return element[0], xi[0], eta[0], is_reflected[0]


PATCH_RING_RADII = (0.0, 0.1, 0.22, 0.4, 0.6, 0.8)
"""Radii of the rings on which square patches are placed to compare the charges of two meshes, in film radii."""


def relative_difference(solved: Equilibrium, reference: Equilibrium) -> float:
    """Compute the largest relative difference between the charges of two equilibria of the same press.

    The function compares the charges that square patches of the film would collect. The charges are compared for a
    biaxial film and for a uniaxial film. The patches lie on rings around the centre of the film, and on a ring around
    the footprint. The difference between the two charges of a patch is divided by the largest charge of all patches on
    the same ring.

    Args:
        solved: The first equilibrium.
        reference: The second equilibrium. The differences are relative to the charges of this equilibrium.

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
    return float((np.abs(charges - reference_charges) / largest_on_ring).max())


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
    half_side = film_radius / 30.0  # half of a fifteenth
    complex_points = (centres[:, :, None] + half_side * (xi + 1j * eta)).ravel()
    points = to_corners(complex_points)

    # Stress at the integration points. The stress is set to zero outside the film.
    is_on_film = equilibrium.film.relative_distance(complex_points) < 1.0
    stress = np.zeros((len(points), 3))
    stress[is_on_film] = touch_stress(equilibrium, points[is_on_film])

    # Compute the mean stress of each patch. The sum of the weights of the integration points is 4. The matrix product
    # sums over the points.
    patch_stress = stress.reshape(*centres.shape, -1, 3)  # shape (n_ring, n_patch, n_point, 3)
    mean_stress = 0.25 * (weights @ patch_stress)

    # The charge per area is d31 s11 + d32 s22. The coefficients d31 and d32 of a biaxial film are equal. On a uniaxial
    # film, d31 is about ten times d32.
    biaxial_coefficients = [1.0, 1.0]
    uniaxial_coefficients = [10.0, 1.0]
    coefficients = np.column_stack([biaxial_coefficients, uniaxial_coefficients])
    return np.asarray(mean_stress[..., :2] @ coefficients)
