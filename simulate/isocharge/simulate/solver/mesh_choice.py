"""Which mesh a press needs: as coarse as the accuracy allows."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.theory import ACCURACY, Theory, bending_length
from isocharge.simulate.mesh.conformal_map import CLEARANCE
from isocharge.simulate.mesh.placed_mesh import PlacedMesh, place
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Polygon, Probe, farthest
from isocharge.simulate.solver.error_estimate import shape_error

LAYER = 6.0
"""Width of the thin rings at the rim in bending lengths: any width from 4 to 14 changes a charge by at most 1e-4."""

FINER = ((0, 1), (1, 1), (0, 2), (2, 1), (1, 2), (0, 3), (2, 2), (1, 3), (2, 3), (3, 3))
"""Meshes that are tried in turn: (order added, factor on the number of elements round the circle)."""

RIM_RINGS = 0.8
"""Number of thin rings at the rim per factor of three that their widths span, dimensionless."""

TOO_COARSE = 0.05
"""Predicted relative error of a charge above which a press is refused as too near the rim."""


def layer_for(film: Film, force: float) -> float:
    """Width of the thin rings at the rim over the film's radius."""
    return LAYER * bending_length(film, force)


def choose_mesh(
    film: Film, probe: Probe, at: tuple[float, float], theory: Theory, accuracy: float, layer: float
) -> PlacedMesh:
    """The coarsest mesh whose shapes predict the accuracy for a press, or the finest if none does.

    More rings for a small probe, more of everything towards the rim, where the template is stretched.

    Raises:
        SceneError: If the press is so near the rim that even the finest mesh is too distorted.
    """
    for resolution in _ladder(film, probe, at, theory, accuracy, layer):
        mesh = place(film, probe, at, resolution, layer)
        error = shape_error(mesh)
        if error <= 0.5 * accuracy:
            return mesh
    if error > TOO_COARSE:
        raise too_near_the_rim(film, probe, at, resolution)
    return mesh


def too_near_the_rim(film: Film, probe: Probe, at: tuple[float, float], resolution: Resolution) -> SceneError:
    """The error for a press whose mesh is too distorted."""
    return SceneError(
        f"press at ({at[0] * 1e3:.4g}, {at[1] * 1e3:.4g}) mm comes within "
        f"{(film.radius - farthest(probe, at)) * 1e3:.3g} mm of the rim, too near for a mesh of order "
        f"{resolution.order} with {resolution.around} elements round the circle; press farther inside"
    )


def _ladder(
    film: Film, probe: Probe, at: tuple[float, float], theory: Theory, accuracy: float, layer: float
) -> Iterator[Resolution]:
    """Meshes from coarse to fine; the first is enough in the inner half of the film."""
    placement = place(film, probe, at, Resolution(2, 8, 1), 0.1).placement
    stretch = float((1.0 + placement.c) / (1.0 - placement.c))
    crowded = isinstance(probe, Polygon) and farthest(probe, at) + CLEARANCE * probe.reach > film.radius
    sharper = max(0, math.ceil(1.4 * math.log10(ACCURACY / accuracy)))
    base = Resolution(
        order=(5 if theory.bending else 4) + sharper,
        around=16 if crowded else 8,
        rings=max(3, math.ceil(-1.3 * math.log(float(placement.rho)) + min(2.0 * math.log(stretch), 4.0)))
        + sharper // 2,
        rim=_thin_rings(placement, layer) if theory.bending else 0,
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
