"""The error of a press, measured against the same press on a mesh of one order more.

In the inner part of the film the elements' shapes and the decay of their modes predict the error of a charge (see
`error_estimate`). Near the rim, and around polygons that are large on the film, they do not: the coarse elements may be
far from the stressed ones. There, and for accuracies below the default, a press is solved again one order higher, from
its own field, until two meshes agree. Each order divides the error by three to ten, so the difference of two meshes
bounds the error of the finer one.
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.theory import ACCURACY
from isocharge.simulate.numerics.quadrature import gauss_reference_square
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Polygon, Probe, farthest
from isocharge.simulate.solver.equilibrium import Equilibrium

INNER = 0.6
"""Share of the film's radius within which the element shapes predict the error."""

LARGE = 0.08
"""Polygons with a larger reach (relative to the film's radius) need a second mesh: the element shapes no longer predict
the error."""

MOST_ORDERS = 3
"""Largest number of orders that are tried beyond the first mesh."""

ANOTHER = 0.1
"""Relative difference above which two meshes have different equilibria: a film that wrinkles has many."""

RINGS, AROUND = (0.0, 0.1, 0.22, 0.4, 0.6, 0.8), 12
"""Radii of rings about the film's centre, in film radii, and number of patches on each, where charges are compared."""

SIDE = 1.0 / 15.0
"""Side of the patches, in film radii: 3 mm of 45."""

PER_SIDE = 6
"""Gauss points along a patch's side."""


def needs_second_mesh(film: Film, probe: Probe, at: tuple[float, float], accuracy: float) -> bool:
    """Whether a press must be solved on two meshes to know its error."""
    large = isinstance(probe, Polygon) and probe.reach > LARGE * film.radius
    return large or farthest(probe, at) > INNER * film.radius or accuracy < ACCURACY


def relative_difference(one: Equilibrium, other: Equilibrium) -> float:
    """Largest relative difference between two equilibria of a press, of patches' charges and of the deflection.

    A patch counts relative to the largest charge on its ring.
    """
    centres = _centres(one)
    offset, weight = _patch(SIDE * one.film.radius)
    points = (centres[:, :, None, None] + offset).ravel()
    position = np.stack([points.real, points.imag], axis=1)
    inside = np.abs(points) < one.film.radius
    charge = [np.zeros((points.size, 3)), np.zeros((points.size, 3))]
    for values, solved in zip(charge, (one, other), strict=True):
        values[inside] = solved.touch_stress(position[inside])
    means = [np.einsum("rapc,p->rac", values.reshape(*centres.shape, -1, 3), weight) for values in charge]
    read = [np.stack([mean[..., 0] + mean[..., 1], 10.0 * mean[..., 0] + mean[..., 1]], axis=-1) for mean in means]
    largest = np.maximum(np.abs(read[1]).max(axis=1, keepdims=True), 1e-300)
    middle = np.array([one.at])
    depth = float(other.deflection(middle)[0])
    return max(float((np.abs(read[0] - read[1]) / largest).max()), abs(float(one.deflection(middle)[0]) / depth - 1.0))


def _centres(solved: Equilibrium) -> np.ndarray:
    """Middles of the patches as complex numbers, m, shape (n_ring, AROUND); the last ring goes round the probe."""
    turn = np.exp(2j * np.pi * np.arange(AROUND) / AROUND)
    rings = solved.film.radius * np.array(RINGS)[:, None] * turn
    return np.concatenate([rings, (complex(*solved.at) + solved.probe.reach * turn)[None]])


def _patch(side: float) -> tuple[np.ndarray, Array]:
    """Gauss points of a square about zero as complex numbers, shape (1, n), and their weights, which add up to one."""
    xi, eta, weights = gauss_reference_square(PER_SIDE)
    return (0.5 * side * xi + 1j * (0.5 * side * eta))[None], 0.25 * weights
