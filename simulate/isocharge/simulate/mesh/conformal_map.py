"""The disk automorphism of `placement`: its parameters for a probe, and how sectors and rings are graded on it."""

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.mesh.blocks import Blocks, Resolution

CLEARANCE = 0.4
"""Gap between a polygon's farthest corner and the circle round it, in units of that corner's distance."""

LARGEST_TURN = 0.2
"""Largest angle, rad, between a sector's side and the ray through its corner: clustered corners would fold more."""

INNER_SHARE, OUTER_SHARE = 0.25, 0.35
"""Next to the rim: the gap between polygon and circle, and that between circle and rim, over that between polygon and
rim, dimensionless."""

GRADING = 0.65
"""Share of the map's stretching round the rim that the sectors take up there: 0 none, 1 all."""


def automorphism_onto(at: Array, radius: Array) -> tuple[Array, Array]:
    """(c, rho) that carry |z| = rho onto the circle of this centre and radius (film radius one); see `placement`."""
    outer, inner = np.arctanh(at + radius), np.arctanh(at - radius)
    return np.tanh(0.5 * (outer + inner)), np.tanh(0.5 * (outer - inner))


def enclosing_circle(corners: Complexes, at: Array) -> tuple[Array, Array]:
    """Centre and radius of a circle inside the film round each polygon: about the centroid if it fits."""
    gap = 1.0 - np.abs(corners).max(axis=-1)

    def radius(centre: Array) -> Array:
        reach = np.abs(corners - centre[..., None]).max(axis=-1)
        return np.asarray(reach + np.minimum(CLEARANCE * reach, INNER_SHARE * gap))

    fits = at + radius(at) <= 1.0 - OUTER_SHARE * gap
    if np.all(fits):
        return at, radius(at)
    low, high = np.zeros(at.shape), at.copy()
    for _ in range(40):
        middle = 0.5 * (low + high)
        inside = middle + radius(middle) <= 1.0 - OUTER_SHARE * gap
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    centre = np.where(fits, at, low)
    return centre, radius(centre)


def sector_angles(blocks: Blocks, corners: Complexes, centre: Array, radius: Array, pull: Array) -> Array:
    """Angles on the template's circle, where rays from the polygon's hub meet it.

    Their directions lie between those of the polygon's corners and an even spread. The narrower the gap between polygon
    and circle, the nearer they are to the corners: else elements would fold. `pull` is c rho.
    """
    hub = corners[..., -1:]
    stops = corners @ blocks.boundary[:: blocks.split].T
    angle = np.unwrap(np.angle(stops - hub), axis=-1)
    even = np.linspace(0.0, 2.0 * np.pi / blocks.copies, angle.shape[-1])
    even = even + np.mean(angle[..., :-1] - even[:-1], axis=-1)[..., None]
    reach = np.abs(corners - centre[..., None]).max(axis=-1)
    evenness = 0.5 * np.minimum((radius / reach - 1.0) / CLEARANCE, 1.0)[..., None]
    mixed = angle + LARGEST_TURN * np.tanh(evenness * (even - angle) / LARGEST_TURN)
    share = np.arange(blocks.split) / blocks.split
    steps = (mixed[..., :-1, None] + share * np.diff(mixed, axis=-1)[..., None]).reshape(*mixed.shape[:-1], -1)
    ray = np.exp(1j * np.concatenate([steps, mixed[..., -1:]], axis=-1))
    away = hub - centre[..., None]
    along = (away * np.conj(ray)).real
    point = away + ray * (np.sqrt(along**2 + radius[..., None] ** 2 - np.abs(away) ** 2) - along)
    first = np.angle(point[..., :1])
    rotated = np.cumsum(np.mod(np.angle(point[..., 1:] / point[..., :-1]), 2.0 * np.pi), axis=-1)
    return stretch_angles(np.concatenate([first, first + rotated], axis=-1), (1.0 + pull) / (1.0 - pull))


def rim_angles(angle: Array, c: Array, rho: Array) -> Array:
    """Angles on the rim, from those on the circle: moved towards pi, where the map compresses the far side of the film.

    Even spacing on the circle already does some of it.
    """
    stretch = ((1.0 + c) / (1.0 - c)) ** GRADING * (1.0 - c * rho) / (1.0 + c * rho)
    return stretch_angles(angle, np.maximum(stretch, 1.0))


def stretch_angles(angle: Array, factor: Array) -> Array:
    """Angles whose half has its tangent multiplied: what the map does to angles on a circle about its centre.

    |z| = rho is carried onto its circle with the factor (1 - c rho) / (1 + c rho), rho = 1 onto the rim.
    """
    turns = 2.0 * np.pi * np.round(angle / (2.0 * np.pi))
    return np.asarray(turns + 2.0 * np.arctan(factor[..., None] * np.tan(0.5 * (angle - turns))))


def ring_edges(resolution: Resolution, rho: Array, layer: Array) -> Array:
    """Edges of the rings: even steps, then thin rings, each a third of what is left of the layer."""
    even = np.linspace(0.0, 1.0, resolution.rings + 1)
    if resolution.rim == 0:
        return np.broadcast_to(even, (*rho.shape, even.size))
    thin = np.minimum(-layer / np.log(rho), 1.0 / (resolution.rings + 1))[..., None]
    inner = even * (1.0 - thin)
    outer = 1.0 - thin * 3.0 ** -np.arange(1.0, resolution.rim + 1)
    outer[..., -1] = 1.0
    return np.concatenate([inner, outer], axis=-1)
