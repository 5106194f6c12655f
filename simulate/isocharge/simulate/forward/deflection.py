"""Computation of the deflection of the film under a circular probe, which the live page shows."""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.deflection_field import DeflectionField, points_mm
from isocharge.common.progress import track
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor_file import film_to_dict
from isocharge.simulate.solver.equilibrium import Equilibrium, deflection
from isocharge.simulate.solver.press import press

RINGS = 20
"""Number of rings about the probe in the table."""

ANGLES = 13
"""Number of angles of half a turn in the table."""

FORCES = (0.05, 0.3, 2.0)
"""Forces of the table, N."""

MAX_DISTANCE = 16.0 / 45.0
"""Largest distance of a press from the centre in the table, in film radii."""

DISTANCES = 5
"""Number of distances in the table."""

INNER_RADIUS = 0.999999
"""Largest radius of the points at which the deflection is computed, in film radii.

Points on the rim may lie outside the film because of rounding.
"""


def deflection_field(
    film: Film, probe: Circle, forces: tuple[float, ...] = FORCES, *, distances: int = DISTANCES
) -> DeflectionField:
    """Compute the deflection of a film on rings about presses with several forces at several distances from the centre.

    Args:
        film: The film.
        probe: The circular probe.
        forces: Increasing forces, N.
        distances: Number of distances from 0 to `MAX_DISTANCE`, at least 2.

    Returns:
        Deflections on rings about each press. The first ring is the centre of the probe, and the last one is the rim of
        the film.

    Raises:
        SolveError: If a press has no equilibrium.
    """
    press_distances = np.linspace(0.0, MAX_DISTANCE * film.radius, distances).tolist()
    smallest_ring = 0.5 * probe.radius / film.radius
    rings = np.concatenate([[0.0], np.geomspace(smallest_ring, 1.0, RINGS - 1)])  # radii in film radii
    deflections = np.zeros((len(forces), distances, RINGS, ANGLES))
    for distance_index, distance in enumerate(track(press_distances, "solving the film", distances)):
        equilibrium: Equilibrium | None = None
        for force_index, force in enumerate(forces):  # each solve starts from the equilibrium under the previous force
            equilibrium = press(film, probe, (distance, 0.0), force, start=equilibrium)
            deflections[force_index, distance_index] = _deflection_on_rings(equilibrium, distance, rings)
    return DeflectionField(
        film=film_to_dict(film),
        probe_radius_mm=probe.radius,
        force_N=forces,
        distance_mm=tuple(press_distances),
        rings=tuple(rings.tolist()),
        deflection_mm=deflections,
    )


def _deflection_on_rings(equilibrium: Equilibrium, distance: float, rings: Array) -> Array:
    """Compute the deflection on rings about the probe; see `isocharge.common.deflection_field`.

    Args:
        equilibrium: The solved press.
        distance: Distance of the press from the centre, mm.
        rings: Radii of concentric rings of the unit disk, shape (n_ring,). `points_mm` maps this disk onto the film
            so that 0 becomes a point under the probe, and 1 remains the rim of the film.

    Returns:
        Deflection, shape (n_ring, n_angle), mm. It is zero at the rim.
    """
    film_radius = equilibrium.film.radius
    rings_in_mesh = np.minimum(rings, INNER_RADIUS)  # the last ring, at the rim, is replaced below
    complex_points = points_mm(film_radius, equilibrium.probe.reach, distance, rings_in_mesh, ANGLES).ravel()
    points = np.stack([complex_points.real, complex_points.imag], axis=1)  # x + iy becomes (x, y), mm
    deflection_mm = deflection(equilibrium, points).reshape(len(rings), ANGLES)
    deflection_mm[-1] = 0.0  # the film is clamped at the rim
    return deflection_mm
