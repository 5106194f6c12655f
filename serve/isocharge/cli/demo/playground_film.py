"""Chebyshev series that approximate the stress of a film under a round probe.

The playground computes charges from these series. The module is also a command, which writes the series of the built-in
film with a thickness of 25 um to a file:

    python -m isocharge.cli.demo.playground_film FILE.json
"""

import json
import sys
from pathlib import Path

import numpy as np
from numpy.polynomial import chebyshev

from isocharge.common.arrays import Array, Complexes
from isocharge.common.files import write_whole
from isocharge.serve.viewer.stress_series import StressSeries
from isocharge.simulate.forward.forward_map import EVEN_FIELD, ForwardMap
from isocharge.simulate.forward.readout import ReadoutPoints
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor_file import film_to_dict, load_sensor

SENSOR = "three-25um-biaxial"
"""Built-in sensor with a film of 25 um. The stress of the film does not depend on the electrodes of the sensor."""

PROBE = Circle(1.0)
"""Probe of the released models, with a radius of 1 mm."""

FORCE_RANGE_N = (0.05, 2.0)
"""Smallest and largest force of the released models, N."""

MAX_DISTANCE_mm = 30.0
"""Largest distance of a press from the centre, mm. This distance is four times the radius of the smallest working
area.
"""

MAX_RING = 0.97
"""Largest radius of the rings that the series cover, in film radii, dimensionless.

The series omit the rim of the film, where no electrode lies.
"""

N_DISTANCES = 7
N_FORCES = 4
N_INNER_RINGS = 6
N_OUTER_RINGS = 14
N_ANGLES = 7
"""Number of Chebyshev polynomials along each axis of the series.

Between the charges that are computed from the series and those of the forward map, the relative difference is 5e-5
(root mean square) and at most 4e-4.
"""


def stress_series(forward_map: ForwardMap) -> StressSeries:
    """Fit Chebyshev series to the logarithm of the stress sum s11 + s22 of a forward map.

    For each press, a conformal map of the film onto itself maps the footprint of the probe to a circle around the
    centre. The stress has a kink at the edge of the footprint. Therefore one series covers the rings inside the circle,
    and another series covers the rings outside the circle.

    Args:
        forward_map: Forward map of the film, with a round probe. The series cover its distances and forces.

    Returns:
        Chebyshev coefficients of the logarithm of the stress inside and outside the footprint.
    """
    max_distance_mm = forward_map.domain.radius
    min_force_N, max_force_N = forward_map.domain.force_range
    film = forward_map.sensor.film
    inner_log_stress = np.empty((N_DISTANCES, N_FORCES, N_INNER_RINGS, N_ANGLES))
    outer_log_stress = np.empty((N_DISTANCES, N_FORCES, N_OUTER_RINGS, N_ANGLES))

    # Map the Chebyshev nodes from [-1, 1] to fractions from 0 to 1 of the ranges of distance, force and ring.
    distances_mm = max_distance_mm * 0.5 * (_nodes(N_DISTANCES) + 1.0)
    forces_N = min_force_N * (max_force_N / min_force_N) ** (0.5 * (_nodes(N_FORCES) + 1.0))
    inner_fraction = 0.5 * (_nodes(N_INNER_RINGS) + 1.0)
    outer_fraction = 0.5 * (_nodes(N_OUTER_RINGS) + 1.0)
    direction: Complexes = np.exp(1j * np.arccos(_nodes(N_ANGLES)))  # unit vectors x + iy

    # The automorphism maps rings around the centre to rings around the probe. The ring with the radius `probe_ring`
    # becomes the edge of the probe.
    for distance_index, distance_mm in enumerate(distances_mm):
        shift, probe_ring = _automorphism(distance_mm / film.radius, forward_map.probe.reach / film.radius)
        inner_rings = probe_ring * np.sqrt(inner_fraction)
        outer_rings = probe_ring * (MAX_RING / probe_ring) ** outer_fraction
        inner_points_mm = film.radius * _image_points(inner_rings[:, None] * direction, shift)
        outer_points_mm = film.radius * _image_points(outer_rings[:, None] * direction, shift)
        for force_index, force_N in enumerate(forces_N):
            inner_stress = _stress_sum(forward_map, distance_mm, force_N, inner_points_mm)
            outer_stress = _stress_sum(forward_map, distance_mm, force_N, outer_points_mm)
            inner_log_stress[distance_index, force_index] = np.log(inner_stress)
            outer_log_stress[distance_index, force_index] = np.log(outer_stress)
    return StressSeries(
        film=film_to_dict(film),
        probe_radius_mm=forward_map.probe.reach,
        max_distance_mm=max_distance_mm,
        force_range_N=(min_force_N, max_force_N),
        max_ring=MAX_RING,
        inner=_coefficients(inner_log_stress),
        outer=_coefficients(outer_log_stress),
    )


def _nodes(count: int) -> Array:
    """Return the zeros of the Chebyshev polynomial of degree `count`, shape (count,), between -1 and 1."""
    return np.asarray(chebyshev.chebpts1(count))


def _automorphism(distance: float, probe_radius: float) -> tuple[float, float]:
    """Compute the conformal map of the unit disk onto itself that maps a circle around the centre to the probe's edge.

    The map has the form (z + c) / (1 + c z) with a parameter c. On the diameter through the probe, the map is a
    translation of atanh(z) by atanh(c).

    Args:
        distance: Distance of the probe from the centre, in film radii.
        probe_radius: Radius of the probe, in film radii.

    Returns:
        The parameter c of the map, and the radius of the circle in film radii.
    """
    outer_edge = np.arctanh(distance + probe_radius)
    inner_edge = np.arctanh(distance - probe_radius)
    return float(np.tanh(0.5 * (outer_edge + inner_edge))), float(np.tanh(0.5 * (outer_edge - inner_edge)))


def _image_points(points: Complexes, c: float) -> Complexes:
    """Compute the images (z + c) / (1 + c z) of points z of the unit disk under the map of `_automorphism`.

    Args:
        points: Points z as complex numbers, any shape, in film radii.
        c: Parameter of the map.

    Returns:
        Images of the points, of the same shape, in film radii.
    """
    return np.asarray((points + c) / (1.0 + c * points))


def _stress_sum(forward_map: ForwardMap, distance_mm: float, force_N: float, points_mm: Complexes) -> Array:
    """Compute the sum s11 + s22 of the stress components at given points, for a press on the positive x axis.

    Args:
        forward_map: Forward map of the film.
        distance_mm: Distance of the press from the centre, mm.
        force_N: Force of the press, N.
        points_mm: Points x + iy, any shape, mm.

    Returns:
        Sum of the stresses, of the shape of `points_mm`, MPa.
    """
    # Each point is treated as an electrode with one integration point. With weights of 1, 1 and 0 for s11, s22 and s12,
    # the charge of this electrode is s11 + s22 at the point.
    n_point = points_mm.size
    points = np.stack([points_mm.real.ravel(), points_mm.imag.ravel()], axis=1)
    weights = np.tile([1.0, 1.0, 0.0], (n_point, 1, 1))
    readout = ReadoutPoints(points[:, None], weights, np.ones(n_point, dtype=int))
    contact = np.array([[distance_mm, 0.0, force_N]])
    stress_sum = forward_map.field_charges(contact, EVEN_FIELD, readout)
    return np.asarray(stress_sum[0, :, 0].reshape(points_mm.shape))


def _coefficients(values: Array) -> Array:
    """Compute the Chebyshev coefficients of the polynomial that has given values on a grid of Chebyshev nodes.

    The values are transformed along one axis after the other.

    Args:
        values: Values on the grid, any number of axes. An axis of length n has n Chebyshev nodes.

    Returns:
        Chebyshev coefficients, of the shape of `values`.
    """
    coefficients = values
    for axis, count in enumerate(values.shape):
        values_from_coefficients = chebyshev.chebvander(_nodes(count), count - 1)  # shape (count, count)
        coefficients_from_values = np.linalg.inv(values_from_coefficients)
        # The product has the transformed axis as its first axis.
        transformed_values = np.tensordot(coefficients_from_values, coefficients, (1, axis))
        coefficients = np.moveaxis(transformed_values, 0, axis)
    return coefficients


def main() -> None:
    """Fit the series of the built-in film, and write them to a file. Its path is the first command-line argument."""
    forward_map = ForwardMap.build(load_sensor(SENSOR), PROBE, MAX_DISTANCE_mm, FORCE_RANGE_N)
    write_whole(Path(sys.argv[1]), json.dumps(stress_series(forward_map).to_json()).encode())


if __name__ == "__main__":
    main()
