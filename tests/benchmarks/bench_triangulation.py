"""Triangulation over the working area: how many positions are found, how well, and what one costs.

python tests/benchmarks/bench_triangulation.py [--presses 2000] [--seed 0]
"""

import argparse
import time
from dataclasses import replace

import numpy as np

from isocharge.simulate import ChargeSpline, ForwardMap, Polygon, Sweep, Triangulation, load_sensor, noise_model

RADIUS, FORCES = 8.0, (0.05, 2.0)


def main() -> None:
    """Three and four electrodes, force known and unknown, clean and noisy."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--presses", type=int, default=2000)
    options.add_argument("--seed", type=int, default=0)
    chosen = options.parse_args()
    contact = Sweep(RADIUS, FORCES, chosen.presses, chosen.seed, sampling="random").contacts()
    solved = ForwardMap.build(load_sensor("three-25um-biaxial"), Polygon.triangle(4.0), 10.0, FORCES)
    for layout in ("three", "four"):
        film = replace(solved, sensor=load_sensor(f"{layout}-25um-biaxial"))
        began = time.process_time()
        splines = ChargeSpline.of(film)
        print(f"{layout}: tabulated in {time.process_time() - began:.1f} s, to {splines.error:.1e}")
        contours, clean = Triangulation(splines), film.charges(contact)
        contours.locate(clean[:1], contact[:1, 2])  # the grid of starting points is made once
        for noise in ("clean", "reference"):
            charge = noise_model(noise).add(clean, np.random.default_rng(chosen.seed))
            for known in (True, False):
                began = time.process_time()
                fix = contours.locate(charge, contact[:, 2]) if known else contours.locate_with_force(charge)
                each = (time.process_time() - began) / chosen.presses
                error = np.hypot(*(fix.contact - contact)[fix.found, :2].T)
                median, most = np.percentile(error, (50, 95))
                print(
                    f"{layout}, force {'known' if known else 'unknown'}, {noise}: {fix.found.sum()} found, "
                    f"median {median:.2g} mm, 95 % {most:.2g} mm, {1e3 * each:.2f} ms of CPU"
                )


if __name__ == "__main__":
    main()
