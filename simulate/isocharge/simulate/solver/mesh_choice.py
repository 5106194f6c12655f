"""Which mesh a press needs: as coarse as the accuracy allows."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.theory import ACCURACY
from isocharge.simulate.mesh.conformal_map import CLEARANCE
from isocharge.simulate.mesh.placed_mesh import PlacedMesh, place
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.sensor.probe import Polygon, farthest
from isocharge.simulate.solver.error_estimate import shape_error
from isocharge.simulate.solver.load_case import LoadCase

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
    large = isinstance(case.probe, Polygon) and case.probe.reach > LARGE * radius
    return large or farthest(case.probe, case.at) > INNER * radius or case.accuracy < ACCURACY


def too_near_the_rim(case: LoadCase, resolution: Resolution) -> SceneError:
    """The error for a press whose mesh is too distorted."""
    return SceneError(
        f"press at ({case.at[0]:.4g}, {case.at[1]:.4g}) mm comes within "
        f"{case.film.radius - farthest(case.probe, case.at):.3g} mm of the rim, too near for a mesh of order "
        f"{resolution.order} with {resolution.around} elements round the circle; press farther inside"
    )


def _ladder(case: LoadCase) -> Iterator[Resolution]:
    """Meshes from coarse to fine; the first is enough in the inner half of the film."""
    film, probe, at = case.film, case.probe, case.at
    placement = place(film, probe, at, Resolution(2, 8, 1), 0.1).placement
    stretch = float((1.0 + placement.c) / (1.0 - placement.c))
    crowded = isinstance(probe, Polygon) and farthest(probe, at) + CLEARANCE * probe.reach > film.radius
    sharper = max(0, math.ceil(1.4 * math.log10(ACCURACY / case.accuracy)))
    base = Resolution(
        order=(5 if case.theory.bending else 4) + sharper,
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
