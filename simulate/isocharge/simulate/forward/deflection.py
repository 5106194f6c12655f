"""Table of the deflection of a film under a circular probe. The live page draws the film from the table."""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.progress import track
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.solver.equilibrium import Equilibrium, deflection
from isocharge.simulate.solver.load_case import SolveSettings
from isocharge.simulate.solver.press import press

RINGS = 20
"""Number of rings around the probe in the table of deflections."""

ANGLES = 13
"""Number of angles in the table, which cover half a turn around the probe."""

FORCES = (0.05, 0.3, 2.0)
"""Forces of the presses in the table, N."""

MAX_DISTANCE = 0.8
"""Largest distance of a press in the table from the centre of the film, in film radii, dimensionless."""

DISTANCES = 7
"""Number of distances of the presses in the table from the centre of the film."""

ACCURACY = 1e-2
"""Accuracy of the charges in the solves, dimensionless. A picture of the film needs no accurate mesh."""

INNER_RADIUS = 0.999999
"""Largest radius of the points at which the deflection is computed, in film radii, dimensionless.

The radius is less than 1, because rounding could move points on the rim out of the film.
"""


class DeflectionTable(NamedTuple):
    """Table of the deflection of one film under one probe.

    Attributes:
        probe_radius_mm: Radius of the round probe, mm.
        force_N: Forces in increasing order, N.
        distance_mm: Distances of the probe from the centre in increasing order from 0, mm.
        rings: Radii of the rings around the origin, before the automorphism (`points_mm`), from 0 to 1, in film radii.
        deflection_mm: Deflections, shape (forces, distances, rings, angles), mm, positive in the direction of the push.
            The angles range from 0 (outwards) to pi. The other half of the film is the mirror image.
    """

    probe_radius_mm: float
    force_N: tuple[float, ...]
    distance_mm: tuple[float, ...]
    rings: tuple[float, ...]
    deflection_mm: Array


def deflection_table(
    film: Film, probe: Circle, forces: tuple[float, ...] = FORCES, *, distances: int = DISTANCES
) -> DeflectionTable:
    """Compute a table of the deflection of a film under a circular probe.

    The table contains presses with several forces at several distances from the centre of the film. For each press, the
    table contains the deflection on rings around the probe.

    Args:
        film: Axisymmetric film on which the probe presses.
        probe: The circular probe.
        forces: Forces of the presses in ascending order, N.
        distances: Number of distances of the presses from the centre, from 0 to `MAX_DISTANCE`, at least 2.

    Returns:
        Deflections on rings around each press. The first ring is the centre of the probe, and the last ring is the rim
        of the film.

    Raises:
        SolveError: If a press has no equilibrium.
    """
    press_distances = np.linspace(0.0, MAX_DISTANCE * film.radius, distances).tolist()
    # The radii of the rings in film radii: the centre of the probe, then a geometric series from half of the radius of
    # the probe to the rim of the film.
    smallest_ring = 0.5 * probe.radius / film.radius
    rings = np.concatenate([[0.0], np.geomspace(smallest_ring, 1.0, RINGS - 1)])

    # The forces at one distance are solved one after the other, because a solve is faster if it starts from the
    # equilibrium under the previous force.
    deflections = np.zeros((len(forces), distances, RINGS, ANGLES))
    for distance_index, distance in enumerate(track(press_distances, "solving the film", distances)):
        equilibrium: Equilibrium | None = None
        for force_index, force in enumerate(forces):
            equilibrium = press(film, probe, (distance, 0.0), force, SolveSettings(ACCURACY), start=equilibrium)
            deflections[force_index, distance_index] = _deflection_on_rings(equilibrium, distance, rings)
    return DeflectionTable(
        probe_radius_mm=probe.radius,
        force_N=forces,
        distance_mm=tuple(press_distances),
        rings=tuple(rings.tolist()),
        deflection_mm=deflections,
    )


def points_mm(radius_mm: float, probe_radius_mm: float, distance_mm: float, rings: Array, angles: int) -> Complexes:
    """For a probe on the x axis, compute the points at which a deflection field contains the deflection.

    The points lie on rings. Rings around the origin are mapped to rings around the probe by the disk automorphism

        z -> (z + c) / (1 + c z),  c = tanh((atanh(p + r) + atanh(p - r)) / 2),

    where p is the distance of the probe from the centre and r is the radius of the probe, both in film radii. This
    value of the shift c maps a circle around the origin to the edge of the probe.

    Args:
        radius_mm: Radius of the film, mm.
        probe_radius_mm: Radius of the probe, mm.
        distance_mm: Distance of the probe from the centre, mm.
        rings: Radii of the rings around the origin, before the automorphism, shape (rings,), in film radii.
        angles: Number of angles, which range from 0 to pi.

    Returns:
        Points x + i y, shape (rings, angles), mm.
    """
    # Positions of the two edges of the probe on the x axis, in film radii
    probe_outer_edge = (distance_mm + probe_radius_mm) / radius_mm
    probe_inner_edge = (distance_mm - probe_radius_mm) / radius_mm
    shift = math.tanh(0.5 * (math.atanh(probe_outer_edge) + math.atanh(probe_inner_edge)))

    directions = np.exp(1j * np.linspace(0.0, math.pi, angles))
    points_around_origin = rings[:, None] * directions  # shape (rings, angles), in film radii
    points_around_probe = (points_around_origin + shift) / (1.0 + shift * points_around_origin)
    return np.asarray(radius_mm * points_around_probe)


def _deflection_on_rings(equilibrium: Equilibrium, distance: float, rings: Array) -> Array:
    """Compute the deflection of the film on rings around the probe.

    Args:
        equilibrium: Equilibrium of the film under the press.
        distance: Distance of the press from the centre, mm.
        rings: Radii of concentric rings of the unit disk, shape (n_ring,), dimensionless. The function `points_mm` maps
            the unit disk onto the film. It maps the radius 0 to a point under the probe, and the radius 1 to the rim.

    Returns:
        Deflection, shape (n_ring, n_angle), mm. It is zero at the rim.
    """
    film_radius = equilibrium.film.radius
    rings_in_mesh = np.minimum(rings, INNER_RADIUS)  # moves the last ring from the rim into the mesh
    complex_points = points_mm(film_radius, equilibrium.probe.reach, distance, rings_in_mesh, ANGLES).ravel()
    points = np.stack([complex_points.real, complex_points.imag], axis=1)  # x + iy becomes (x, y), mm
    deflection_mm = deflection(equilibrium, points).reshape(len(rings), ANGLES)
    deflection_mm[-1] = 0.0  # the last ring is the rim, where the film is clamped
    return deflection_mm
