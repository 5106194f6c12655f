"""What is decided about a press before it is solved: settings, theory, and a mesh as coarse as the accuracy allows."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from time import process_time
from typing import Literal, Self

import numpy as np

from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.scaling import DimensionlessGroups, amplitude_squared, scaled_stress
from isocharge.simulate.mechanics.stress import stress
from isocharge.simulate.mechanics.theory import ACCURACY, Theory, bending_length, choose_theory
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.conformal_map import CLEARANCE
from isocharge.simulate.mesh.placed_mesh import PlacedMesh, place
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.refinement import coated
from isocharge.simulate.numerics.polygon import to_complex
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.solver.error_estimate import shape_error

TOLERANCE = 1e-7
"""Out-of-balance force over load, dimensionless: far below the error of the mesh, well above round-off."""

Auto = Literal["auto"]
"""Choose it to suit the press, or all presses of a forward map."""

LAYER = 6.0
"""Width of the thin rings at the rim in bending lengths: any width from 4 to 14 changes a charge by at most 1e-4."""

LAYER_REUSE = (0.75, 2.0)
"""Width of the start's thin rings over six bending lengths: between these ratios the width is kept, so that the start's
field still fits."""

LARGEST_AMPLITUDE2 = 0.1
"""A^2, the size of the strains, dimensionless, above which St. Venant-Kirchhoff elasticity fails: 100 N at 25 um."""

SMALLEST_PROBE = 1e-5
"""Probe reach over film radius: below it the grading of the template exceeds what float64 resolves."""

FINER = ((0, 1), (1, 1), (0, 2), (2, 1), (1, 2), (0, 3), (2, 2), (1, 3), (2, 3), (3, 3))
"""Meshes that are tried in turn: (order added, factor on the number of elements round the circle)."""

RIM_RINGS = 0.8
"""Number of thin rings at the rim per factor of three that their widths span, dimensionless."""

TOO_COARSE = 0.05
"""Predicted relative error of a charge above which a press is refused as too near the rim."""

INNER = 0.6
"""Share of the film's radius within which the element shapes predict the error."""

LARGE = 0.08
"""Polygons with a larger reach (relative to the film's radius) need a second mesh: the element shapes no longer predict
the error."""


@dataclass(frozen=True)
class SolveSettings:
    """How the film is solved.

    Attributes:
        accuracy: Target for the relative error of a charge.
        theory: Which terms to model; "auto" for the fewest that the accuracy allows.
        resolution: Mesh of the template; "auto" for the coarsest that reaches the accuracy.
        layer: Width of the thin rings at the rim over the film's radius; "auto" for six bending lengths, or for the
            width of the equilibrium that the solve starts from if that is near.
        tolerance: Out-of-balance force over load at which a solve has converged.
    """

    accuracy: float = ACCURACY
    theory: Theory | Auto = "auto"
    resolution: Resolution | Auto = "auto"
    layer: float | Auto = "auto"
    tolerance: float = TOLERANCE


def check_press(film: Film, probe: Probe, at: tuple[float, float], force: float) -> None:
    """Refuse presses that cannot exist or that stretch the film beyond the range of St. Venant-Kirchhoff elasticity.

    Raises:
        SceneError: If the footprint is too small or not wholly on the film, the force is not positive and finite, or
            the film is stretched beyond small strains.
    """
    if not (np.isfinite(force) and force > 0.0):
        raise SceneError(f"force: expected a positive number of newtons (F > 0 pushes), got {force}")
    if probe.reach < SMALLEST_PROBE * film.radius:
        raise SceneError(
            f"probe: expected a reach of at least {SMALLEST_PROBE:g} of the film's radius ({film.radius:.4g} mm), got "
            f"{probe.reach:.4g} mm"
        )
    if not probe.farthest_distance(at) < film.radius * (1.0 - 1e-6):
        raise SceneError(
            f"probe off the film: centre ({at[0]:.4g}, {at[1]:.4g}) mm, farthest point of {probe.notation} "
            f"{probe.farthest_distance(at):.4g} mm from the film's centre, film radius {film.radius:.4g} mm"
        )
    amplitude2 = amplitude_squared(film, force)
    if amplitude2 > LARGEST_AMPLITUDE2:
        raise SceneError(
            f"force {force:.4g} N stretches a film of {film.thickness:.4g} mm beyond small strains: expected "
            f"(F / (E h a))^(2/3) up to {LARGEST_AMPLITUDE2:g}, got {amplitude2:.3g}"
        )


def layer_for(film: Film, force: float) -> float:
    """Width of the thin rings at the rim over the film's radius."""
    return LAYER * bending_length(film, force)


@dataclass(frozen=True)
class LoadCase:
    """A press with all that is decided about it but the mesh.

    Attributes:
        film: The film.
        probe: The footprint.
        at: Its centroid (x, y), mm.
        force: N.
        theory: Which terms to model.
        layer: Width of the thin rings at the rim over the film's radius.
        accuracy: Target for the relative error of a charge.
        tolerance: Out-of-balance force over load.
        began: Process CPU time when the work on the press began, s.
    """

    film: Film
    probe: Probe
    at: tuple[float, float]
    force: float
    theory: Theory
    layer: float
    accuracy: float
    tolerance: float
    began: float

    @classmethod
    def of(
        cls,
        film: Film,
        probe: Probe,
        at: tuple[float, float],
        force: float,
        settings: SolveSettings,
        start: PlacedMesh | None,
    ) -> Self:
        """Decide what the settings leave open; `start` is the mesh of the equilibrium that the solve starts from.

        Raises:
            SceneError: If the press cannot exist.
        """
        began = process_time()
        check_press(film, probe, at, force)
        theory = choose_theory(film, probe, force, settings.accuracy) if settings.theory == "auto" else settings.theory
        layer = _layer(film, force, probe, settings, start) if settings.layer == "auto" else settings.layer
        return cls(film, probe, at, force, theory, layer, settings.accuracy, settings.tolerance, began)

    def place(self, resolution: Resolution) -> PlacedMesh:
        """A mesh under this press."""
        return place_coated(self.film, self.probe, self.at, resolution, self.layer)


def place_coated(film: Film, probe: Probe, at: tuple[float, float], resolution: Resolution, layer: float) -> PlacedMesh:
    """As `place`, with the film's coat if it has one."""
    mesh, angle = place(film, probe, at, resolution, layer), float(np.arctan2(at[1], at[0]))
    if film.coat is None:
        return mesh
    turn = np.exp(-1j * angle) / film.radius
    layers = tuple(tuple(to_complex(np.array(part)) * turn for part in layer) for layer in film.coat.layers)
    bare = scaled_stress(np.eye(3), DimensionlessGroups.of(film, 1.0, bending=False, angle=angle))
    added = film.coat.stiffness / (film.young * film.thickness) * stress(np.eye(3), film.poisson)
    return coated(mesh, layers, bare, added)


def _layer(film: Film, force: float, probe: Probe, settings: SolveSettings, start: PlacedMesh | None) -> float:
    """Width of the thin rings: six bending lengths, or the start's width if that is near and its mesh the same."""
    layer = layer_for(film, force)
    if start is None or not LAYER_REUSE[0] < start.layer / layer < LAYER_REUSE[1]:
        return layer
    same_mesh = settings.resolution in ("auto", start.resolution) and probe.topology == start.template.topology
    return start.layer if same_mesh else layer


def choose_mesh(case: LoadCase) -> PlacedMesh:
    """The coarsest mesh whose shapes predict the accuracy for a press, or the finest if none does.

    More rings for a small probe, more of everything towards the rim, where the template is stretched.

    Raises:
        SceneError: If the press is so near the rim that even the finest mesh is too distorted.
    """
    for resolution in _ladder(case):
        mesh = case.place(resolution)
        error = shape_error(mesh)
        if error <= 0.5 * case.accuracy:
            return mesh
    if error > TOO_COARSE:
        raise too_near_the_rim(case, resolution)
    return mesh


def needs_second_mesh(case: LoadCase) -> bool:
    """Whether a press must be solved on two meshes to know its error; see `error_estimate`."""
    radius = case.film.radius
    large = not case.probe.topology.fills_circle and case.probe.reach > LARGE * radius
    return large or case.probe.farthest_distance(case.at) > INNER * radius or case.accuracy < ACCURACY


def too_near_the_rim(case: LoadCase, resolution: Resolution) -> SceneError:
    """The error for a press whose mesh is too distorted."""
    return SceneError(
        f"press at ({case.at[0]:.4g}, {case.at[1]:.4g}) mm comes within "
        f"{case.film.radius - case.probe.farthest_distance(case.at):.3g} mm of the rim, too near for a mesh of order "
        f"{resolution.order} with {resolution.around} elements round the circle; press farther inside"
    )


def _ladder(case: LoadCase) -> Iterator[Resolution]:
    """Meshes from coarse to fine; the first is enough in the inner half of the film."""
    film, probe, at = case.film, case.probe, case.at
    placement = place(film, probe, at, Resolution(2, 8, 1), 0.1).placement
    stretch = float((1.0 + placement.c) / (1.0 - placement.c))
    crowded = not probe.topology.fills_circle and probe.farthest_distance(at) + CLEARANCE * probe.reach > film.radius
    sharper = max(0, math.ceil(1.4 * math.log10(ACCURACY / case.accuracy)))
    base = Resolution(
        order=(5 if case.theory.bending and film.coat is None else 4) + sharper,
        around=16 if crowded else 8,
        rings=max(3, math.ceil(-1.3 * math.log(float(placement.rho)) + min(2.0 * math.log(stretch), 4.0)))
        + sharper // 2,
        rim=_thin_rings(placement, case.layer) if case.theory.bending else 0,
    )
    for order, around in FINER:
        yield replace(base, order=base.order + order, around=base.around * around)


def _thin_rings(placement: Placement, layer: float) -> int:
    """Number of rings at the rim.

    Each ring is a third of the one before. They lead from the layer's width next to the probe to its width on the far
    side of the film, where the conformal map compresses it.
    """
    stretch, depth = float((1.0 + placement.c) / (1.0 - placement.c)), -float(np.log(placement.rho))
    near, far = min(layer * stretch / depth, 1.0 / 8.0), min(min(layer, 0.2) / stretch / depth, 1.0 / 8.0)
    return 1 + math.floor(RIM_RINGS * math.log(near / far, 3.0))
