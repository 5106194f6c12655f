"""Position limits, folds and ambiguous pairs of the sensors for almost the whole film.

Run: python tests/benchmarks/bench_outer_radius.py [--json]
"""

from dataclasses import replace

import numpy as np
from shared import arguments, print_results

from isocharge.simulate import ChargeSpline, Circle, ForwardMap, limits_at, load_sensor, noise_model
from isocharge.simulate.identifiability.working_area import find_ambiguous_pairs, find_folds
from isocharge.simulate.numerics.disk import Rings

CASES = (
    ("eight-25um-biaxial-36mm", 36.0),
    ("eight-25um-biaxial-36mm", 40.0),
    ("six-25um-biaxial-30mm", 30.0),
    ("six-25um-biaxial-30mm", 36.0),
)
"""Sensors and radii of the disks that are examined, mm."""

FORCES = (0.05, 0.2, 1.0, 2.0)
"""Forces of the presses, N."""

NOISE = noise_model("reference")


def main() -> None:
    options = arguments(__doc__)
    first_sensor, _ = CASES[0]
    largest_radius = max(radius for _, radius in CASES)
    forward_map = ForwardMap.build(load_sensor(first_sensor), Circle(1.0), largest_radius, (FORCES[0], FORCES[-1]))
    results = {}
    for name, radius in CASES:
        charges = ChargeSpline.of(replace(forward_map, sensor=load_sensor(name)), radius)
        rings = Rings.spread(radius)
        for force in FORCES:
            limits = rings.per_ring(limits_at(charges, rings.contacts(force), NOISE).position)
            mean_square = np.average((limits**2).mean(axis=1), weights=rings.distance)
            results[f"{name}, {radius:g} mm, {force:g} N"] = {
                "worst_mm": round(float(limits.max()), 3),
                "rms_mm": round(float(np.sqrt(mean_square)), 3),
                "folds": len(find_folds(charges, rings, force, NOISE)),
                "pairs": len(find_ambiguous_pairs(charges, NOISE, force)),
            }
    print_results("outer_radius", options, results)


if __name__ == "__main__":
    main()
