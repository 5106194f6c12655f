"""Which mesh a press needs: templates for probes, and how fine for the wanted accuracy."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import SceneError
from isocharge.simulate.geometry import Geometry
from isocharge.simulate.placement import CLEARANCE, Placement, template
from isocharge.simulate.probe import Polygon, Probe
from isocharge.simulate.sensor import Film
from isocharge.simulate.spectral import modal_matrix
from isocharge.simulate.template import Resolution, Template
from isocharge.simulate.theory import ACCURACY, Theory, bending_length

LAYER = 6.0
"""Width of the thin rings at the rim in bending lengths: from 4 to 14 they cost at most 1e-4 of a charge."""

FINER = ((0, 1), (1, 1), (0, 2), (2, 1), (1, 2), (0, 3), (2, 2), (1, 3), (2, 3), (3, 3))
"""Meshes that are tried in turn: so much higher an order, so many times the elements round the circle."""

RIM_RINGS = 0.8
"""Thin rings at the rim over the number of thirds that their widths span."""

TOO_COARSE = 0.05
"""Relative error of a charge, as the mesh's shape foretells it, above which a press is refused."""

SAFETY = 2.0
"""Over the error that shape and decay foretell, in the inner 0.6 of the film's radius; beside the rim too little."""

LEAST_ERROR = 5e-5
"""What thin rings at the rim and the electrodes' integration points leave, however smooth the rest is."""

DECAY_WEIGHT = 0.1
"""Relative error of a charge over the share of the slopes that the elements' highest modes carry."""


def template_for(probe: Probe, resolution: Resolution) -> Template:
    """The template that follows a probe's outline."""
    return template(resolution, len(probe.corners) if isinstance(probe, Polygon) else 0)


def place(film: Film, probe: Probe, at: tuple[float, float], resolution: Resolution, layer: float) -> Placement:
    """Where the template lies, the press turned onto the positive x axis; `layer` over the film's radius."""
    turned = probe.turned(-float(np.arctan2(at[1], at[0])))
    return Placement.of(template_for(probe, resolution), turned, np.array(np.hypot(*at)), film.radius, layer)


def layer_for(film: Film, force: float) -> float:
    """Width of the thin rings at the rim over the film's radius."""
    return LAYER * bending_length(film, force)


def farthest(probe: Probe, at: tuple[float, float]) -> float:
    """Distance of the footprint's farthest point from the film's centre, m."""
    if isinstance(probe, Polygon):
        return float(np.abs(complex(*at) + probe.outline).max())
    return float(np.hypot(*at)) + probe.radius


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


def shape_error(mesh: Template, geometry: Geometry) -> float:
    """Relative error of a charge that the elements' shapes foretell, infinite where one is turned inside out.

    The elements carry the conformal map as a polynomial. How well they do shows in the film's own area: the worst
    charge's error is about a third of the square root of the area's (`tests/benchmarks/bench_hard_cases.py`).
    """
    if geometry.weights.min() <= 0.0 or geometry.mass.min() <= 0.0:
        return np.inf
    return float(np.sqrt(abs(mesh.copies * geometry.weights.sum() / np.pi - 1.0)))


def decay(mesh: Template, geometry: Geometry, slope: Array) -> float:
    """Share of the deflection's slopes that the highest polynomial modes of the elements carry.

    Args:
        mesh: The template.
        geometry: Where it lies.
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
    area = geometry.weights.sum(axis=1)
    return float(np.sum(area * np.sqrt(np.maximum(top, 0.0) * total)) / max(np.sum(area * total), 1e-300))


def mesh_error(mesh: Template, geometry: Geometry, slope: Array) -> float:
    """Relative error of a charge to expect from the mesh, from the elements' shapes and from the solution itself."""
    return max(LEAST_ERROR, SAFETY * shape_error(mesh, geometry), SAFETY * DECAY_WEIGHT * decay(mesh, geometry, slope))
