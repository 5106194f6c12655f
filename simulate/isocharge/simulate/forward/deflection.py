"""The deflection of a film under a round probe as a table over force and distance, for pictures of it."""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.deflection_field import DeflectionField, points_mm
from isocharge.common.progress import Progress
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.press import press

RINGS, ANGLES = 20, 13
"""Rings about the probe, and angles of half a turn, of the table."""

FORCES_N = (0.05, 0.3, 2.0)

FARTHEST = 16.0 / 45.0
"""Distance from the centre up to which the table goes, in film radii: beyond all working areas."""

DISTANCES = 5

INNER = 0.999999
"""Share of the film's radius within which a point of the rim lies for certain."""


def deflection_field(
    film: Film,
    probe: Circle,
    force_N: tuple[float, ...] = FORCES_N,
    *,
    distances: int = DISTANCES,
    progress: Progress | None = None,
) -> DeflectionField:
    """Solve the film under presses of several forces at several distances from its centre.

    Args:
        film: The film.
        probe: Its footprint, round.
        force_N: Forces, increasing, N.
        distances: Number of distances, from 0 to `FARTHEST`, at least 2.
        progress: Called with the number of presses that are solved, and of all.

    Raises:
        SolveError: If a press has no equilibrium.
    """
    distance_mm = np.linspace(0.0, 1e3 * FARTHEST * film.radius, distances)
    rings = np.concatenate([[0.0], np.geomspace(0.5 * probe.radius / film.radius, 1.0, RINGS - 1)])
    shape = (len(force_N), distances, RINGS, ANGLES)
    deflection_mm = np.zeros(shape)
    for column, distance in enumerate(distance_mm.tolist()):
        solved: Equilibrium | None = None
        for row, force in enumerate(force_N):
            solved = press(film, probe, (1e-3 * distance, 0.0), force, start=solved)
            deflection_mm[row, column] = _on_rings(solved, distance, rings)
            if progress is not None:
                progress(column * len(force_N) + row + 1, len(force_N) * distances)
    return DeflectionField(
        film=_constants(film),
        probe_radius_mm=1e3 * probe.radius,
        force_N=force_N,
        distance_mm=tuple(distance_mm.tolist()),
        rings=tuple(rings.tolist()),
        deflection_mm=deflection_mm,
    )


def _on_rings(solved: Equilibrium, distance_mm: float, rings: Array) -> Array:
    """Deflection on the rings, mm, shape (rings, angles); the rim does not move."""
    radius = solved.film.radius
    probe_mm = 1e3 * solved.probe.reach
    points = 1e-3 * points_mm(1e3 * radius, probe_mm, distance_mm, np.minimum(rings, INNER), ANGLES).ravel()
    deflection = 1e3 * solved.deflection(np.stack([points.real, points.imag], axis=1)).reshape(len(rings), ANGLES)
    deflection[-1] = 0.0
    return deflection


def _constants(film: Film) -> dict[str, float]:
    """What decides how a film deflects, in the units of a sensor file."""
    return {
        "radius_mm": 1e3 * film.radius,
        "thickness_um": 1e6 * film.thickness,
        "young_GPa": 1e-9 * film.young,
        "poisson": film.poisson,
        "pretension_MPa": 1e-6 * film.pretension,
    }
