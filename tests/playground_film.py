"""The Chebyshev series of the stress from which the playground computes charges; see `playground/charges.js`.

python tests/playground_film.py serve/isocharge/serve/viewer/playground/film-25um.json
"""

import base64
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from numpy.polynomial import chebyshev
from scipy.fft import dctn

from isocharge.simulate import Circle, ForwardMap, load_sensor
from isocharge.simulate.forward.forward_map import EVEN_FIELD
from isocharge.simulate.forward.readout import PieceRule
from isocharge.simulate.mesh.conformal_map import automorphism_onto
from isocharge.simulate.sensor.sensor_file import film_to_dict

PROBE = Circle(1.0)
FORCE_RANGE_N = (0.05, 2.0)
MAX_DISTANCE_mm = 30.0  # four times the radius of the smallest working area
MAX_RING = 0.97  # no electrode lies at the rim of the film
COUNTS = (7, 4)  # distances and forces
N_INNER_RINGS, N_OUTER_RINGS, N_ANGLES = 6, 14, 7
"""With these numbers of polynomials, the relative error of the charges is 5e-5 rms and at most 4e-4."""


def fraction(count):
    """Return the Chebyshev nodes, from 0 to 1."""
    return 0.5 * (chebyshev.chebpts1(count) + 1.0)


def stress_series():
    """Fit the series inside and outside the edge of the probe, at which the stress has a kink."""
    sensor = load_sensor("three-25um-biaxial")
    forward_map = ForwardMap.build(sensor, PROBE, MAX_DISTANCE_mm, FORCE_RANGE_N)
    radius = sensor.film.radius
    low_N, high_N = FORCE_RANGE_N
    direction = np.exp(1j * np.arccos(chebyshev.chebpts1(N_ANGLES)))
    inner = np.empty((*COUNTS, N_INNER_RINGS, N_ANGLES))
    outer = np.empty((*COUNTS, N_OUTER_RINGS, N_ANGLES))
    for i, distance_mm in enumerate(MAX_DISTANCE_mm * fraction(COUNTS[0])):
        shift, edge = automorphism_onto(distance_mm / radius, PROBE.radius / radius)
        inner_rings = edge * np.sqrt(fraction(N_INNER_RINGS))
        outer_rings = edge * (MAX_RING / edge) ** fraction(N_OUTER_RINGS)
        for stress, rings in ((inner, inner_rings), (outer, outer_rings)):
            points = rings[:, None] * direction
            points_mm = radius * (points + shift) / (1.0 + shift * points)
            for j, force_N in enumerate(low_N * (high_N / low_N) ** fraction(COUNTS[1])):
                stress[i, j] = stress_sum(forward_map, [distance_mm, 0.0, force_N], points_mm)
    return {
        "film": film_to_dict(sensor.film),
        "probe_radius_mm": PROBE.radius,
        "max_distance_mm": MAX_DISTANCE_mm,
        "force_range_N": FORCE_RANGE_N,
        "max_ring": MAX_RING,
        "inner": table(np.log(inner)),
        "outer": table(np.log(outer)),
    }


def stress_sum(forward_map, contact, points_mm):
    """Return s11 + s22, MPa, as charges of electrodes of one point with the weights 1, 1 and 0 of the stresses."""
    n_point = points_mm.size
    index = np.arange(n_point)
    rules = [PieceRule(np.zeros_like(index), index, points_mm.reshape(-1, 1), np.ones((n_point, 1)))]
    pieces = SimpleNamespace(electrode=index, kind=np.zeros_like(index), rules=lambda *_: rules)
    x, y, force = np.array(contact)[:, None]
    density = forward_map.charge_density(x + 1j * y, force, np.zeros(1), EVEN_FIELD, np.array([[1.0, 1.0, 0.0]]))
    return density.integrate(pieces)[0, :, 0].reshape(points_mm.shape)


def table(values):
    """Return the Chebyshev coefficients of values at the nodes, as in the file."""
    transformed = dctn(np.flip(values), type=2) / values.size  # the cosine transform begins at the largest node
    for axis in range(values.ndim):
        np.moveaxis(transformed, axis, 0)[0] /= 2.0
    return {"shape": values.shape, "data": base64.b64encode(transformed.astype("<f4").tobytes()).decode()}


def coefficients(stored):
    """Return the coefficients of a table in the file."""
    return np.frombuffer(base64.b64decode(stored["data"]), "<f4").reshape(stored["shape"])


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(stress_series()))
