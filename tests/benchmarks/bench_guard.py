"""Share of the film outside the working area where presses cannot be noticed, with one additional electrode.

Run: python tests/benchmarks/bench_guard.py
"""

from dataclasses import replace

import numpy as np

from isocharge.simulate import ChargeSpline, Circle, Electrode, limits_at, load_sensor, noise_model
from isocharge.simulate.forward.whole_film import whole_film_map
from isocharge.simulate.identifiability import mirror_region
from isocharge.simulate.identifiability.mirror_region import MirrorRegion
from isocharge.simulate.numerics.disk import Rings

WORKING_RADII = {"three-25um-biaxial": 7.5, "four-25um-biaxial": 8.0}
"""Radius of the working area of each sensor, mm."""

DIRECTIONS = {"three-25um-biaxial": np.pi / 2.0, "four-25um-biaxial": np.pi / 4.0}
"""Direction of the additional electrode from the centre, midway between two electrodes, rad."""

DISTANCES = (0.0, 25.0, 30.0, 35.0)
"""Distances of the additional electrode from the centre, mm."""

FORCE_RANGE = (0.05, 2.0)
"""Smallest and largest force, N."""

NOISE = noise_model("reference")


def main() -> None:
    # 1,296 presses are enough for a comparison of layouts.
    mirror_region.N_RINGS = 18
    mirror_region.N_SECTORS = 24
    mirror_region.FORCE_COUNT = 3
    film_map = whole_film_map(load_sensor("four-25um-biaxial"), Circle(1.0), FORCE_RANGE)
    print(f"{'sensor':20} {'additional':>12} {'not noticed':>11} {'rms at 1 N, mm':>14} {'worst':>6}")
    for name, radius in WORKING_RADII.items():
        sensor = load_sensor(name)
        direction = np.array([np.cos(DIRECTIONS[name]), np.sin(DIRECTIONS[name])])
        layouts = {"none": sensor}
        for distance in DISTANCES:
            x, y = (distance * direction).tolist()
            guard = Electrode.of_square("G", (x, y), 3.0)
            layouts[f"at {distance:g} mm"] = replace(sensor, electrodes=(*sensor.electrodes, guard))
        for layout, changed in layouts.items():
            charges = ChargeSpline.of(replace(film_map, sensor=changed))
            region = MirrorRegion.of(charges, radius, charges, NOISE)
            limits = limits_at(charges, Rings.spread(radius, 20, 36).contacts(1.0), NOISE).position
            rms = np.sqrt(np.mean(limits**2))
            share = f"{100.0 * region.total_share:.1f} %"
            print(f"{name:20} {layout:>12} {share:>11} {rms:14.3f} {limits.max():6.3f}", flush=True)


if __name__ == "__main__":
    main()
