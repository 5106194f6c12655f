"""The deflection of a film under a round probe as a table over force and distance, for pictures of it."""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.deflection_field import DeflectionField, points_mm
from isocharge.common.progress import track
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor_file import film_to_dict
from isocharge.simulate.solver.equilibrium import Equilibrium, deflection
from isocharge.simulate.solver.press import press

RINGS, ANGLES = 20, 13
"""Rings about the probe, and angles of half a turn, of the table."""

FORCES = (0.05, 0.3, 2.0)

FARTHEST = 16.0 / 45.0
"""Distance from the centre up to which the table goes, in film radii: beyond all working areas."""

DISTANCES = 5

INNER = 0.999999
"""Share of the film's radius within which a point of the rim lies for certain."""


def deflection_field(
    film: Film, probe: Circle, forces: tuple[float, ...] = FORCES, *, distances: int = DISTANCES
) -> DeflectionField:
    """Solve the film under presses of several forces at several distances from its centre.

    Args:
        film: The film.
        probe: Its footprint, round.
        forces: Increasing, N.
        distances: Number of distances, from 0 to `FARTHEST`, at least 2.

    Raises:
        SolveError: If a press has no equilibrium.
    """
    places = np.linspace(0.0, FARTHEST * film.radius, distances).tolist()
    rings = np.concatenate([[0.0], np.geomspace(0.5 * probe.radius / film.radius, 1.0, RINGS - 1)])
    table = np.zeros((len(forces), distances, RINGS, ANGLES))
    for column, distance in enumerate(track(places, "solving the film", distances)):
        solved: Equilibrium | None = None
        for row, force in enumerate(forces):
            solved = press(film, probe, (distance, 0.0), force, start=solved)
            table[row, column] = _on_rings(solved, distance, rings)
    return DeflectionField(
        film=film_to_dict(film),
        probe_radius_mm=probe.radius,
        force_N=forces,
        distance_mm=tuple(places),
        rings=tuple(rings.tolist()),
        deflection_mm=table,
    )


def _on_rings(solved: Equilibrium, distance: float, rings: Array) -> Array:
    """Deflection on the rings, mm, shape (rings, angles); the rim does not move."""
    points = points_mm(solved.film.radius, solved.probe.reach, distance, np.minimum(rings, INNER), ANGLES).ravel()
    deflected = deflection(solved, np.stack([points.real, points.imag], axis=1)).reshape(len(rings), ANGLES)
    deflected[-1] = 0.0
    return deflected
