"""Position limits, folds and ambiguous pairs of the sensors for almost the whole film.

Run: python tests/benchmarks/bench_outer_radius.py
"""

from dataclasses import replace

import numpy as np

from isocharge.simulate import ChargeSpline, Circle, ForwardMap, limits_at, load_sensor, noise_model
from isocharge.simulate.identifiability.working_area import find_ambiguous_pairs, find_folds
from isocharge.simulate.numerics.disk import Rings

CASES = {"eight-25um-biaxial-36mm": (36.0, 40.0), "six-25um-biaxial-30mm": (30.0, 36.0)}
"""Radii of the disks that are examined, by sensor, mm."""

FORCES = (0.05, 0.2, 1.0, 2.0)
"""Forces of the presses, N."""

NOISE = noise_model("reference")


def main() -> None:
    largest_radius = max(max(radii) for radii in CASES.values())
    first_sensor = load_sensor(next(iter(CASES)))
    forward_map = ForwardMap.build(first_sensor, Circle(1.0), largest_radius, (FORCES[0], FORCES[-1]))
    print(f"forward map up to {largest_radius:g} mm: relative error {forward_map.error:.1e}")
    print(f"{'sensor':24} {'radius, mm':>10} {'force, N':>8} {'worst, mm':>9} {'rms, mm':>8} {'folds':>5} {'pairs':>5}")
    for name, radii in CASES.items():
        for radius in radii:
            sensor = load_sensor(name)
            charges = ChargeSpline.of(replace(forward_map, sensor=sensor), radius)
            for force in FORCES:
                print(f"{name:24} {radius:10g} {force:8g} {_row(charges, radius, force)}", flush=True)


def _row(charges: ChargeSpline, radius: float, force: float) -> str:
    """Format the largest limit, its root mean square over the disk, and the numbers of folds and ambiguous pairs."""
    rings = Rings.spread(radius)
    limits = rings.per_ring(limits_at(charges, rings.contacts(force), NOISE).position)
    rms = np.sqrt(np.average((limits**2).mean(axis=1), weights=rings.distance))
    folds = len(find_folds(charges, rings, force, NOISE))
    pairs = len(find_ambiguous_pairs(charges, NOISE, force))
    return f"{limits.max():9.3f} {rms:8.3f} {folds:5d} {pairs:5d}"


if __name__ == "__main__":
    main()
