"""Which mesh a press needs: templates for probes, and how fine for the wanted accuracy."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from isocharge.errors import SceneError
from isocharge.simulate.mechanics.theory import ACCURACY, Theory, bending_length
from isocharge.simulate.mesh.conformal_map import CLEARANCE
from isocharge.simulate.mesh.elements import Geometry
from isocharge.simulate.mesh.placement import Placement, place, template_for
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Polygon, Probe, farthest
from isocharge.simulate.solver.error_estimate import shape_error

LAYER = 6.0
"""Width of the thin rings at the rim in bending lengths: from 4 to 14 they cost at most 1e-4 of a charge."""

FINER = ((0, 1), (1, 1), (0, 2), (2, 1), (1, 2), (0, 3), (2, 2), (1, 3), (2, 3), (3, 3))
"""Meshes that are tried in turn: so much higher an order, so many times the elements round the circle."""

RIM_RINGS = 0.8
"""Thin rings at the rim over the number of thirds that their widths span."""

TOO_COARSE = 0.05
"""Relative error of a charge, as the mesh's shape foretells it, above which a press is refused."""


def layer_for(film: Film, force: float) -> float:
    """Width of the thin rings at the rim over the film's radius."""
    return LAYER * bending_length(film, force)


def resolution_for(
    film: Film, probe: Probe, at: tuple[float, float], theory: Theory, accuracy: float, layer: float
) -> Resolution:
    """The coarsest mesh that carries a press to the wanted accuracy.

    More rings for a small probe, more of everything towards the rim, where the template is stretched.

    Raises:
        SceneError: If the press is so near the rim that even the finest mesh carries it badly.
    """
    error = np.inf
    for resolution in _ladder(film, probe, at, theory, accuracy, layer):
        points = place(film, probe, at, resolution, layer).element_points(template_for(probe, resolution))
        error = shape_error(template_for(probe, resolution), Geometry.build(template_for(probe, resolution), points))
        if error <= 0.5 * accuracy:
            return resolution
    if error > TOO_COARSE:
        raise too_near_the_rim(film, probe, at, resolution)
    return resolution


def too_near_the_rim(film: Film, probe: Probe, at: tuple[float, float], resolution: Resolution) -> SceneError:
    """The error for a press that a mesh cannot carry."""
    return SceneError(
        f"press at ({at[0] * 1e3:.4g}, {at[1] * 1e3:.4g}) mm comes within "
        f"{(film.radius - farthest(probe, at)) * 1e3:.3g} mm of the rim, too near for a mesh of order "
        f"{resolution.order} with {resolution.around} elements round the circle; press farther inside"
    )


def _ladder(
    film: Film, probe: Probe, at: tuple[float, float], theory: Theory, accuracy: float, layer: float
) -> Iterator[Resolution]:
    """Meshes from coarse to fine; the first is enough in the inner half of the film."""
    placement = place(film, probe, at, Resolution(2, 8, 1), 0.1)
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
    """How many rings at the rim: as many as lead, each a third of the last, from the layer's width beside the probe to
    its width on the film's far side, where the map has drawn it together."""
    stretch, depth = float((1.0 + placement.c) / (1.0 - placement.c)), -float(np.log(placement.rho))
    near, far = min(layer * stretch / depth, 1.0 / 8.0), min(min(layer, 0.2) / stretch / depth, 1.0 / 8.0)
    return 1 + math.floor(RIM_RINGS * math.log(near / far, 3.0))
