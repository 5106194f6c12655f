"""Checks of a press before the solve, and choice of the mesh."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from time import process_time
from typing import Literal

import numpy as np

from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.theory import ACCURACY, WITH_BENDING, Theory, amplitude_squared, bending_length
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.conformal_map import CLEARANCE, map_stretch
from isocharge.simulate.mesh.oval import circular_distance, film_oval
from isocharge.simulate.mesh.placed_mesh import PlacedMesh, place
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.sensor.film import Film, check_range
from isocharge.simulate.sensor.footprint import Probe

TOLERANCE = 1e-7
"""Largest ratio of the out-of-balance force to the load that a converged solve may have, dimensionless.

The ratio is far below the error of the mesh, and well above rounding errors.
"""

Auto = Literal["auto"]
"""Value of a setting that the program chooses itself, either for one press or for all presses of a forward map."""

MAX_AMPLITUDE2 = 0.1
"""Largest squared amplitude A^2 for which Saint-Venant-Kirchhoff elasticity is valid, dimensionless.

The strains are of the order A^2.
"""

MIN_FORCE_N = 1e-12
"""Smallest force of a press, N. The dimensionless groups of a press with a far smaller force are not finite numbers."""

LAYER_WIDTH = 6.0
"""Total width of the thin rings at the rim, in bending lengths. Widths from 4 to 14 change a charge by at most 1e-4."""

MAX_SIDE_SHARE = 1.0
"""Largest ratio of the side force to the force of the press. A coefficient of friction of one results in this ratio."""

REFINEMENTS = ((0, 1), (1, 1), (0, 2), (2, 1), (1, 2), (0, 3), (2, 2), (1, 3), (2, 3), (3, 3))
"""Refinements of the mesh that are tried one after the other.

The first number of a pair is added to the polynomial order of the elements. The second number multiplies the number of
elements around the innermost circle.
"""

MAX_UNEVENNESS = 0.3
"""Eight elements around the probe suffice up to this ratio of the uneven pretension to the stress of the load.

With eight elements, the error of a charge is 1e-4 at a ratio of 0.24, 8e-4 at 0.45, and 4e-3 at 3.5.
"""

MAX_SHAPE_ERROR = 0.05
"""Largest relative error of a charge that may be predicted for the finest mesh.

A press with a larger predicted error is too close to the rim, and is rejected.
"""

RELIABLE_RADIUS = 0.6
"""Distance from the centre within which the shapes of the elements predict the error reliably, in film radii."""

MIN_RIM_DISTANCE = 0.2
"""Smallest distance between the rim and a curved footprint that is not circular, divided by the reach of the footprint.

If the footprint is closer to the rim, the mesh between the footprint and the innermost circle is so thin that points
cannot be located.
"""

RELIABLE_REACH = 0.08
"""Largest reach of a footprint, in film radii, for which the shapes of the elements predict the error reliably.

The limit applies to footprints that are not circular.
"""


@dataclass(frozen=True)
class SolveSettings:
    """Settings of a solve.

    Attributes:
        accuracy: Largest allowed relative error of a charge, from 1e-6 to 1.
        theory: Terms of the film theory.
        resolution: Fineness of the mesh; "auto" for the coarsest mesh that reaches the accuracy.
        layer: Total width of the thin rings at the rim, in film radii; "auto" for six bending lengths.
        tolerance: Largest ratio of the out-of-balance force to the load that a converged solve may have.
    """

    accuracy: float = ACCURACY
    theory: Theory = WITH_BENDING
    resolution: Resolution | Auto = "auto"
    layer: float | Auto = "auto"
    tolerance: float = TOLERANCE


def check_press(film: Film, probe: Probe, at: tuple[float, float], force: float) -> None:
    """Raise an error if a press cannot exist, or if the strains are too large for Saint-Venant-Kirchhoff elasticity.

    Args:
        film: The film.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.
        force: Force, N.

    Raises:
        SceneError: If the force is smaller than `MIN_FORCE_N` or not finite, if the footprint is too close to the rim
            or not completely on the film, or if the strains are not small.
    """
    if not MIN_FORCE_N <= force < np.inf:
        raise SceneError(f"force: expected at least {MIN_FORCE_N:g} N (F > 0 pushes), got {force:.4g} N")
    _check_position(film, probe, at)

    # The squared amplitude is of the order of the strains.
    with np.errstate(over="ignore"):  # the amplitude of a huge force is infinite, and is refused
        squared_amplitude = amplitude_squared(film, force)
    if not squared_amplitude <= MAX_AMPLITUDE2:  # the condition is negated, so that NaN raises the error
        raise SceneError(
            f"force {force:.4g} N stretches a film of {film.thickness:.4g} mm beyond small strains: expected "
            f"(F / (E h a))^(2/3) up to {MAX_AMPLITUDE2:g}, got {squared_amplitude:.3g}"
        )


def _check_position(film: Film, probe: Probe, at: tuple[float, float]) -> None:
    """Raise an error if a footprint is not completely on the film, or if it is too close to the rim for a mesh.

    Args:
        film: The film.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.

    Raises:
        SceneError: If the footprint is not completely on the film, or if it is too close to the rim.
    """
    # The mesh of an oval film is made on a circular film, which is then deformed. The function `farthest_distance`
    # measures the distance of the farthest point of the footprint from the centre of the circular film. The outline is
    # also compared with the oval rim itself. A NaN in the position makes both comparisons false.
    farthest_on_circular_film = farthest_distance(film, probe, at)
    outline = complex(*at) + probe.outline
    relative_distance = film.relative_distance(outline)  # 1 on the rim
    is_on_film = farthest_on_circular_film < film.radius * (1.0 - 1e-6) and relative_distance.max() < 1.0
    if not is_on_film:
        worst_angle = np.angle(outline[relative_distance.argmax()])
        raise SceneError(
            f"probe off the film: centre ({at[0]:.4g}, {at[1]:.4g}) mm, farthest point of {probe.notation} "
            f"{probe.farthest_distance(at):.4g} mm from the film's centre, the rim "
            f"{film.rim_distance(worst_angle):.4g} mm from it there"
        )

    # A curved footprint that is not circular has a layer of elements between itself and a circle around it. Close to
    # the rim, this layer would be too thin.
    rim_distance = film.radius - farthest_on_circular_film
    min_rim_distance = MIN_RIM_DISTANCE * probe.reach
    is_curved_but_not_round = probe.topology.is_curved and not probe.topology.fills_circle
    if is_curved_but_not_round and rim_distance < min_rim_distance:
        raise SceneError(
            f"{probe.notation} at ({at[0]:.4g}, {at[1]:.4g}) mm comes within {rim_distance:.3g} mm of the rim: "
            f"expected at least {min_rim_distance:.3g} mm, because the mesh around the footprint would be too thin; "
            "press farther inside"
        )


def farthest_distance(film: Film, probe: Probe, at: tuple[float, float]) -> float:
    """Compute the distance from the centre of the film to the farthest point of the footprint, mm.

    On every film, the footprint lies on the film if the returned distance is less than the radius of the film. The mesh
    of an oval film is the deformed mesh of a circular film. For a press on an oval film, the function therefore first
    computes the place of the press on the circular film before the deformation. The distance is measured at this place.

    Args:
        film: The film.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.
    """
    # Compute both distances of the press from the centre in film radii. The complex number `oval` describes the shape
    # of the clamp relative to the direction of the press, and is zero for a circular clamp.
    x, y = at
    direction = math.atan2(y, x)
    oval = film_oval(film, direction)
    with np.errstate(all="ignore"):  # the caller refuses a huge distance or NaN
        relative_distance = np.hypot(x, y) / film.radius
        relative_circular_distance = circular_distance(relative_distance, oval, probe.reach / film.radius)

    # Rotate the press onto the positive x axis. The method of the probe computes the distance of its farthest point.
    rotated_probe = probe.rotated(-direction)
    return rotated_probe.farthest_distance((film.radius * float(relative_circular_distance), 0.0))


def layer_for(film: Film, force: float, settings: SolveSettings) -> float:
    """Return the total width of the thin rings of elements at the rim of the film.

    Args:
        film: The film.
        force: Force of the press, N.
        settings: Settings of the solve. If their width of the thin rings is "auto", the function chooses the width.

    Returns:
        Width, in film radii.
    """
    return LAYER_WIDTH * bending_length(film, force) if settings.layer == "auto" else settings.layer


@dataclass(frozen=True)
class LoadCase:
    """A press, which is checked when the object is created.

    Attributes:
        film: The film.
        probe: The probe.
        at: Centroid (x, y) of the footprint, mm.
        force: Force, N.
        settings: Settings of the solve.
        side_force: Force (Fx, Fy) of the probe on the film in the plane of the film, N.
        began: CPU time of the process when the work on the press began, s.
    """

    film: Film
    probe: Probe
    at: tuple[float, float]
    force: float
    settings: SolveSettings
    side_force: tuple[float, float] = (0.0, 0.0)
    began: float = field(default_factory=process_time)

    def __post_init__(self) -> None:
        """Check the press and its side force.

        Raises:
            SceneError: If the press cannot exist, if the required accuracy is out of range, or if the side force is not
                finite or exceeds `MAX_SIDE_SHARE` times the force of the press.
        """
        check_range("accuracy", self.settings.accuracy, (1e-6, 1.0), "", SceneError)
        check_press(self.film, self.probe, self.at, self.force)
        side_force = np.hypot(*self.side_force)
        if not side_force <= MAX_SIDE_SHARE * self.force:  # the condition is negated, so that NaN raises the error
            raise SceneError(
                f"side force: expected at most {MAX_SIDE_SHARE:g} times the force of {self.force:.4g} N, got "
                f"{self.side_force} N"
            )

    @property
    def layer(self) -> float:
        """Total width of the thin rings at the rim, in film radii."""
        return layer_for(self.film, self.force, self.settings)

    def place(self, resolution: Resolution) -> PlacedMesh:
        """Create the mesh under this press with a given resolution. With a side force, the whole film is meshed."""
        return place(self.film, self.probe, self.at, resolution, self.layer, whole=any(self.side_force))


def choose_mesh(case: LoadCase) -> PlacedMesh:
    """Return the coarsest mesh whose predicted error is at most half of the required accuracy.

    The error is predicted from the shapes of the elements. If no mesh is sufficient, the finest mesh is returned,
    unless its predicted error exceeds `MAX_SHAPE_ERROR`.

    Args:
        case: The press and the required accuracy.

    Raises:
        SceneError: If the press is so close to the rim that even the finest mesh is too distorted.
    """
    max_error = 0.5 * case.settings.accuracy  # the other half is for the omitted terms of the theory
    *coarser_resolutions, finest_resolution = _candidate_resolutions(case)
    for resolution in coarser_resolutions:
        mesh = case.place(resolution)
        if mesh.shape_error <= max_error:
            return mesh

    finest_mesh = case.place(finest_resolution)
    if finest_mesh.shape_error > max(max_error, MAX_SHAPE_ERROR):
        raise too_near_the_rim(case, finest_resolution)
    return finest_mesh


def needs_second_mesh(case: LoadCase) -> bool:
    """Return whether a press must be solved on two meshes in order to estimate the error of the charges.

    The shapes of the elements of a single mesh do not predict the error reliably in four cases: for a large footprint
    that is not circular, for a press near the rim, for a pressure on the whole film, and if the required accuracy is
    better than the default accuracy.

    Args:
        case: The press and the required accuracy.
    """
    radius = case.film.radius
    # A footprint fills the innermost circle of the mesh if it is circular.
    is_large = not case.probe.topology.fills_circle and case.probe.reach > RELIABLE_REACH * radius
    is_near_rim = farthest_distance(case.film, case.probe, case.at) > RELIABLE_RADIUS * radius
    must_be_accurate = case.settings.accuracy < ACCURACY
    return is_large or is_near_rim or case.film.has_back_pressure or must_be_accurate


def too_near_the_rim(case: LoadCase, resolution: Resolution) -> SceneError:
    """Create the exception for a press so close to the rim that the mesh is too distorted.

    Args:
        case: The press.
        resolution: Fineness of the distorted mesh.
    """
    rim_distance = case.film.radius - farthest_distance(case.film, case.probe, case.at)
    return SceneError(
        f"press at ({case.at[0]:.4g}, {case.at[1]:.4g}) mm comes within {rim_distance:.3g} mm of the rim, too near for "
        f"a mesh of order {resolution.order} with {resolution.around} elements round the circle; press farther inside"
    )


def _candidate_resolutions(case: LoadCase) -> Iterator[Resolution]:
    """Generate the resolutions that are tried for a press, from coarse to fine.

    For presses in the inner half of the film, the first resolution is sufficient. The other resolutions have elements
    of a higher order, or more elements around the innermost circle, or both.

    Args:
        case: The press and the required accuracy.
    """
    # `around` is the number of elements around the innermost circle.
    first_resolution = _first_resolution(case)
    for order_increase, around_factor in REFINEMENTS:
        order = first_resolution.order + order_increase
        around = first_resolution.around * around_factor
        yield replace(first_resolution, order=order, around=around)


def _first_resolution(case: LoadCase) -> Resolution:
    """Choose the coarsest resolution that is tried for a press.

    The mesh is created in a unit disk, which a conformal map maps onto the film. A circle in the disk encloses the
    footprint, and rings of elements lie between this circle and the rim. The rings are divided into sectors, whose
    number is `around`. A small probe needs more rings. A press close to the rim needs more rings, and sometimes more
    sectors, because the conformal map stretches the mesh. Trapped air or a static pressure also bends the film in
    narrow strips between the probe and the rim. The narrow strips need more rings.

    Args:
        case: The press and the required accuracy.
    """
    has_bending = case.settings.theory.bending

    # Place a coarse mesh to obtain the conformal map, which is the same for all meshes under the press. It does not
    # depend on the width of the thin rings at the rim (`layer`).
    coarse_resolution = Resolution(order=2, around=8, rings=1)
    placement = place(case.film, case.probe, case.at, coarse_resolution, layer=0.1).placement

    # A better accuracy than the default `ACCURACY` requires a higher polynomial order. The factors are empirical.
    first_order = 5 if has_bending else 4
    extra_order = max(0, math.ceil(1.4 * math.log10(ACCURACY / case.settings.accuracy)))

    # A small radius of the innermost circle and the stretch of the conformal map at the rim, where the radius is 1,
    # require more rings, and so does a higher accuracy. The factors and the limits are empirical.
    rings_for_radius = -1.3 * math.log(float(placement.template_radius))
    rings_for_stretch = min(2.0 * math.log(map_stretch(placement.map_parameter, 1.0)), 4.0)
    rings = max(3, math.ceil(rings_for_radius + rings_for_stretch)) + extra_order // 2
    thin_rings = _thin_ring_count(placement, case.layer) if has_bending else 0
    if case.film.has_back_pressure:
        # Without these rings, the error of a charge of a slack film on a cavity is 0.5 % even with order 8.
        rings += 6
        thin_rings += 2
    around = 16 if _needs_more_sectors(case) else 8
    return Resolution(order=first_order + extra_order, around=around, rings=rings, rim=thin_rings)


def _needs_more_sectors(case: LoadCase) -> bool:
    """Return whether eight elements around the innermost circle of the mesh are too few for a press.

    The innermost circle encloses the footprint of the probe, and the rings of the mesh lie around it. Eight elements
    are too few in two cases:

    - The footprint is not circular, and the film has no room for the normal gap between the footprint and the innermost
      circle.
    - The uneven part of the pretension is not small compared with the stress that the force causes. The deflection
      around the probe then depends strongly on the direction.

    Args:
        case: The press.
    """
    film = case.film
    probe = case.probe
    normal_gap = CLEARANCE * probe.reach  # the reach is the distance from the centroid to the farthest point
    extent_with_gap = farthest_distance(film, probe, case.at) + normal_gap  # distance from the centre of the film
    # A circular footprint fills the innermost circle, so it has no gap.
    is_crowded = not probe.topology.fills_circle and extent_with_gap > film.radius

    # The strain that the force causes is of the order of the squared amplitude. The attribute `deviator` is the uneven
    # part of the pretension: half of the difference T11 - T22, and the shear T12, in MPa.
    load_stress = film.young * amplitude_squared(film, case.force)
    uneven_stress = np.hypot(*film.deviator)
    is_uneven = bool(uneven_stress > MAX_UNEVENNESS * load_stress)
    return is_crowded or is_uneven


def _thin_ring_count(placement: Placement, strip_width: float) -> int:
    """Compute the number of thin rings at the rim of the mesh.

    At the clamped rim, the film bends within a narrow strip, which the thin rings resolve. The mesh is created in a
    unit disk, the template plane, and a conformal map maps the disk onto the film. In the template plane, the strip is
    therefore widest next to the probe, and narrowest on the opposite side of the film. All thin rings together are as
    wide as the strip at its widest point. Towards the rim, each ring is a third as wide as the previous ring. The
    number of rings is chosen such that the last rings are thin enough for the strip at its narrowest point. One ring is
    added for each factor of three between the largest and the smallest width of the strip.

    Args:
        placement: Placement of the mesh under the press.
        strip_width: Width of the strip on the film, in film radii.
    """
    # Compute the largest and the smallest width of the strip in the template plane. Next to the probe, the conformal
    # map multiplies lengths by 1 / stretch, and on the opposite side by `stretch`. On the opposite side, a strip that
    # is wider than 0.2 film radii is resolved like a strip of 0.2 film radii.
    stretch = float(map_stretch(placement.map_parameter, 1.0))  # at the rim, where the distance from the origin is 1
    width_next_to_probe = strip_width * stretch
    opposite_width = min(strip_width, 0.2) / stretch

    # Divide the widths by the range of ln(r) that all rings cover, where r is the distance from the origin. At the rim,
    # r is 1, so a small width is equal to the difference of ln(r) across it. The upper limit keeps the thin rings near
    # the rim. Below the limit, the range has no effect on the ratio of both shares, which determines the number.
    log_range = -math.log(placement.template_radius)
    max_share = 1.0 / 8.0
    largest_share = min(width_next_to_probe / log_range, max_share)
    smallest_share = min(opposite_width / log_range, max_share)

    # At least two rings are needed: with a single ring, the error of a charge reaches 0.4 %. With fewer rings for each
    # factor of three, the error of a charge at the rim opposite a press beside the centre reaches 1 %.
    factors_of_three = math.log(largest_share / smallest_share, 3.0)
    return max(2, 1 + math.ceil(factors_of_three))
